"""Where the planes of the masked scheme's mesh lie.

Planes follow the edges and faces of a design's sheets and layers and spread out with distance from
them.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from capsense.design.geometry import Surface
from capsense.design.model import Design
from capsense.mesh.settings import MeshSettings

Array = NDArray[np.float64]


def plan_axes(design: Design, s: MeshSettings) -> tuple[Array, Array, Array]:
    """Coordinates [m] of the planes across x, y and z, in increasing order."""
    lower, upper = design.domain.lower, design.domain.upper
    sheets = [b.surface for b in design.sheets]
    out = []
    for axis in range(3):
        edges = np.concatenate([_sheet_planes(sheet, axis) for sheet in sheets])
        edges = _merge(edges, s.merge, lower[axis], upper[axis])
        faces = np.array([[la.lower[axis], la.upper[axis]] for la in design.layers]).ravel()
        planes = _merge(np.concatenate([edges, faces]), s.merge, lower[axis], upper[axis])
        if axis < 2:
            gaps = np.diff(np.concatenate([[lower[axis]], edges, [upper[axis]]]))
            size = np.clip(0.5 * np.minimum(gaps[1:], gaps[:-1]), 1.2 * s.merge, s.edge)
            growth, far = s.growth, s.far
        else:
            size, growth, far = np.full(len(edges), s.face), s.growth_z, s.far_z
        tall = s.tall if axis == 2 else 0.0
        out.append(_graded(lower[axis], upper[axis], planes, edges, size, growth, far, tall))
    return out[0], out[1], out[2]


def _sheet_planes(sheet: Surface, axis: int) -> Array:
    """Coordinates that planes should follow: edges and faces across an axis, bounds."""
    rims = sheet.rims
    flat = np.abs(rims[:, 0, axis] - rims[:, 1, axis]) < 1e-9
    length = np.linalg.norm(rims[:, 1] - rims[:, 0], axis=1)
    # short segments are the facets of an arc, not edges worth a plane of their own
    total: dict[float, float] = {}
    for c, ell in zip(np.round(rims[flat, 0, axis], 9), length[flat], strict=True):
        total[c] = total.get(c, 0.0) + ell
    keep = [c for c, ell in total.items() if ell > 0.002]
    return np.concatenate([keep, sheet.bounds[:, axis]])


def _merge(values: Array, distance: float, lower: float, upper: float) -> Array:
    """Sort, drop what lies on the walls, and replace close groups by their middle."""
    values = np.unique(np.round(values, 9))
    values = values[(values > lower + distance / 2) & (values < upper - distance / 2)]
    groups: list[list[float]] = []
    for v in values:
        if groups and v - groups[-1][0] < distance:
            groups[-1].append(v)
        else:
            groups.append([v])
    return np.array([(g[0] + g[-1]) / 2 for g in groups])


def _graded(
    lower: float,
    upper: float,
    planes: Array,
    edges: Array,
    size: Array,
    growth: float,
    far: float,
    tall: float,
) -> Array:
    """Lay planes through ``planes``, spaced by ``size`` at ``edges`` and growing from there.

    The spacing is at most ``far``, or the fraction ``tall`` of the distance from the edges.
    """
    stops = np.concatenate([[lower], planes, [upper]])
    out = [lower]
    for a, b in pairwise(stops):
        t = np.linspace(a, b, 801)
        mid = 0.5 * (t[1:] + t[:-1])
        away = np.abs(mid[:, None] - edges[None])
        h = (size[None] + growth * away).min(axis=1)
        h = np.minimum(h, np.maximum(far, tall * away.min(axis=1)))
        count = np.concatenate([[0.0], np.cumsum(np.diff(t) / h)])
        n = max(1, int(np.ceil(count[-1] - 0.1)))
        out.extend(np.interp(np.arange(1, n) * count[-1] / n, count, t))
        out.append(b)
    return np.array(out)
