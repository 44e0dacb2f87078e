"""Meshes of designs.

Planes follow the edges and faces of a design's sheets and layers, and spread out with distance.
Tetrahedra take the material at their centroid.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray

from capsense.design.geometry import Facet, Surface
from capsense.design.model import Design
from capsense.errors import SceneError
from capsense.field.background import MeshSettings
from capsense.field.boundary import terminal_of
from capsense.masked.mesh_sensor import MeshSensor
from capsense.mesh import kuhn_tets
from capsense.mesh.tetmesh import GROUND

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
        stops = np.concatenate([[lower[axis]], planes, [upper[axis]]])
        out.append(_graded(stops, edges, size, growth, far, tall))
    return out[0], out[1], out[2]


def _sheet_planes(sheet: Surface, axis: int) -> Array:
    """Coordinates that planes should follow: edges and faces across an axis, bounds."""
    rims = sheet.rims
    flat = np.abs(rims[:, 0, axis] - rims[:, 1, axis]) < 1e-9
    length = np.linalg.norm(rims[:, 1] - rims[:, 0], axis=1)
    # short segments are the facets of an arc, not edges worth a plane of their own
    at, which = np.unique(np.round(rims[flat, 0, axis], 9), return_inverse=True)
    long = np.bincount(which, length[flat], len(at)) > 0.002
    return np.concatenate([at[long], sheet.bounds[:, axis]])


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
    stops: Array, edges: Array, size: Array, growth: float, far: float, tall: float
) -> Array:
    """Lay planes through ``stops``, spaced by ``size`` at ``edges`` and growing from there.

    The spacing is at most ``far``, or the fraction ``tall`` of the distance from the edges.
    """
    out = [stops[0]]
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


Axes = tuple[Array, Array, Array]
Owner = NDArray[np.int64]

FREE, WALL = -1, -2
"""Owners of nodes that belong to no terminal: an unknown, or a node at 0 V."""

_ON_PLANE = 1e-7


def hold_nodes(design: Design, axes: Axes) -> Owner:
    """Return the owner of each node, shape (nx, ny, nz): a terminal's number, FREE or WALL.

    Nodes on the outer faces belong to ``WALL``.
    """
    owner = np.full(tuple(len(a) for a in axes), FREE, dtype=np.int64)
    for body in design.sheets:
        number = terminal_of(body, design)
        who = number if number >= 0 else WALL
        for facet in body.surface.facets:
            _claim(axes, owner, facet, who)
    for axis in range(3):
        face: list[slice | int] = [slice(None)] * 3
        for end in (0, -1):
            face[axis] = end
            owner[tuple(face)] = WALL
    return owner


def _claim(axes: Axes, owner: Owner, facet: Facet, who: int) -> None:
    """Mark the nodes that a facet goes through."""
    for axis in range(3):
        if abs(facet.axes[2, axis]) < 1e-6:
            continue
        p, q = [a for a in range(3) if a != axis]
        # project the outline along the axis; the plane gives the coordinate
        coords = facet.to_sensor(shapely.get_coordinates(facet.polygon))[:, [p, q]]
        shadow = shapely.set_coordinates(shapely.Polygon(facet.polygon), coords)
        shadow = shadow.buffer(1e-8, join_style="mitre")
        x0, y0, x1, y1 = shadow.bounds
        ip = np.flatnonzero((axes[p] >= x0) & (axes[p] <= x1))
        iq = np.flatnonzero((axes[q] >= y0) & (axes[q] <= y1))
        if not len(ip) or not len(iq):
            continue
        gp, gq = np.repeat(ip, len(iq)), np.tile(iq, len(ip))
        inside = shapely.contains_xy(shadow, axes[p][gp], axes[q][gq])
        gp, gq = gp[inside], gq[inside]
        n = facet.axes[2]
        t = (
            facet.origin[axis]
            - (n[p] * (axes[p][gp] - facet.origin[p]) + n[q] * (axes[q][gq] - facet.origin[q]))
            / n[axis]
        )
        near = np.abs(axes[axis][:, None] - t[None]).argmin(axis=0)
        on_node = np.abs(axes[axis][near] - t) < _ON_PLANE
        index = [gp, gq]
        index.insert(axis, near)
        owner[tuple(i[on_node] for i in index)] = who


def lattice_sensor(design: Design, terminals: Sequence[str], settings: MeshSettings) -> MeshSensor:
    """The Kuhn tetrahedra of a graded mesh for a design, its sheets and walls held.

    Raises:
        SceneError: The mesh has no node on a terminal.
    """
    axes = plan_axes(design, settings)
    mesh = kuhn_tets(*axes)
    owner = hold_nodes(design, axes).ravel()
    groups = {name: np.flatnonzero(owner == k) for k, name in enumerate(terminals)}
    if missing := [name for name, nodes in groups.items() if not len(nodes)]:
        raise SceneError(
            f"method 'fem_masked' needs mesh nodes on every electrode; {missing[0]!r} has none: "
            "raise [build] resolution, or use method 'surface'"
        )
    mesh = mesh.with_groups(node_groups={**groups, GROUND: np.flatnonzero(owner == WALL)})
    eps = np.ones(mesh.n_tets)
    for layer in design.layers:
        eps[layer.contains(mesh.centroids)] = layer.eps_r
    return MeshSensor(mesh, tuple(terminals), (GROUND,), eps)
