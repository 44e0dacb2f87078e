"""What lies below the panels of a rigid shape: parts of them, for bodies that are near a sensor.

A shape's energies are those of its panels. Where these are wider than a gap, charge gathers within
them. So the tree goes on below the panels, each halved across its longer side until its parts are
small. There are no energies of these: the step works out what the parts that it uses meet, see
:mod:`capsense.solver.interaction.subpanel_kernels`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capsense._jit import compiled, kernel
from capsense.scene.geometry_kernels import primitive_distance
from capsense.scene.shapes import Shape, ShapeKind
from capsense.solver.bodies.panels import SurfacePanels
from capsense.solver.tree.dynamic_surface import OWN
from capsense.solver.tree.rigid import HALF_SPACE, SOFT, RigidShape

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

_MOST = 5
"""Panels are halved at most so often: to 32 parts."""
_OF_CLUSTERS = "children", "function", "charge", "center", "points", "extent", "softening_length"
"""Arrays of a tree that go on below its panels."""


@dataclass(frozen=True, eq=False)
class RefinedShape(RigidShape):
    """A rigid shape whose tree goes on below the panels."""

    whole: RigidShape
    """The shape without parts, whose inside is shared."""
    finest: float
    """Parts with a side longer than this are halved [m]."""
    surface: Shape
    """Where they lie: panels of a round shape go through it, its parts are moved onto it."""

    @property
    def neumann_to_dirichlet(self) -> NDArray[np.float32]:
        """As of :class:`RigidShape`, of the functions of whole panels."""
        return self.whole.neumann_to_dirichlet

    @cached_property
    def _parts(self) -> dict[str, NDArray[Any]]:
        return _with_parts(self, *_flat(self.panels))

    @cached_property
    def record(self) -> np.void:
        """As of :class:`RigidShape`; clusters and functions of parts follow those of panels."""
        record = self.whole.record.copy()
        record["n"] = (len(self._parts["children"]) + 1) // 2
        record["inside"] = HALF_SPACE
        for name, values in self._parts.items():
            record[name] = values.ctypes.data
        return record

    @property
    def nbytes(self) -> int:
        """Room that the matrices and the parts take up [bytes]."""
        return self.whole.nbytes + self._more

    @cached_property
    def _more(self) -> int:
        return sum(a.nbytes for a in self._parts.values())


def refined(shape: RigidShape, finest: float, surface: Shape) -> RigidShape:
    """A shape with parts of its panels where these are longer than ``finest`` [m], else itself.

    Args:
        shape: The shape.
        finest: Parts with a side longer than this are halved [m].
        surface: The surface that its panels approximate.
    """
    flat = _flat(shape.panels)
    if _longest(flat[0]) <= finest:
        return shape
    out = RefinedShape(
        shape.panels,
        shape.tree,
        shape.potential_coefficients,
        shape.capacitance,
        shape,
        finest,
        surface,
    )
    out.__dict__["_parts"] = _with_parts(out, *flat)
    return out


def _flat(panels: SurfacePanels) -> tuple[Array, Array]:
    """Corners in the plane of each panel [m], (n, 4, 2), and the axes of these planes, (2, n, 3).

    Their origins are the panels' centres.
    """
    first = panels.corners[:, 1] - panels.corners[:, 0]
    first = first / np.linalg.norm(first, axis=1)[:, None]
    axes = np.stack([first, np.cross(panels.normals, first)])
    return np.einsum("nqi,ani->nqa", panels.corners - panels.centers[:, None], axes), axes


@kernel
def _sides(corners: Array) -> tuple[float, float]:
    """Mean lengths of the two pairs of opposite sides of a polygon in its plane [m], (4, 2)."""
    one = other = 0.0
    for q in range(0, 4, 2):
        a, b, c = corners[q], corners[q + 1], corners[(q + 2) % 4]
        one += 0.5 * math.hypot(b[0] - a[0], b[1] - a[1])
        other += 0.5 * math.hypot(c[0] - b[0], c[1] - b[1])
    return one, other


@compiled
def _longest(corners: Array) -> float:
    """The longest such length of any polygon, (n, 4, 2)."""
    out = 0.0
    for k in range(corners.shape[0]):
        out = max(out, max(_sides(corners[k])))
    return out


@compiled
def halved(whole: Array, finest: float) -> tuple[Array, Ints, Ints]:
    """Halve polygons across their longer sides, breadth first.

    Args:
        whole: Corners of n panels in planes of their own [m], shape (n, 4, 2).
        finest: Those with a longer side are halved [m].

    Returns:
        Corners of the panels and all their parts, shape (k, 4, 2); the parts of each, -1 where it
        has none, shape (k, 2); and the panel that it lies in, shape (k,).
    """
    count = whole.shape[0]
    room = count * (2 ** (_MOST + 1) - 1)
    corners, children = np.empty((room, 4, 2)), np.empty((room, 2), np.int64)
    panel = np.empty(room, np.int64)
    for k in range(count):
        corners[k], panel[k] = whole[k], k
    first = 0
    for level in range(_MOST + 1):
        last = count
        for k in range(first, last):
            children[k] = -1
            one, other = _sides(corners[k])
            if level == _MOST or max(one, other) <= finest:
                continue
            turn = 1 if other > one else 0  # sides (0, 1) and (2, 3) are the longer ones then
            for d in range(2):
                a, b = corners[k, turn, d], corners[k, turn + 1, d]
                c, e = corners[k, turn + 2, d], corners[k, (turn + 3) % 4, d]
                near, far = 0.5 * (a + b), 0.5 * (c + e)
                left, right = corners[count], corners[count + 1]
                left[0, d], left[1, d], left[2, d], left[3, d] = a, near, far, e
                right[0, d], right[1, d], right[2, d], right[3, d] = near, b, c, far
            for side in range(2):
                children[k, side], panel[count + side] = count + side, panel[k]
            count += 2
        first = last
    return corners[:count], children[:count], panel[:count]


@kernel
def _double(corners: Array, q: int) -> float:
    """Twice the area of the triangle of corners 0, q and q + 1 of a polygon [m²], (4, 2)."""
    x, y = corners[0]
    ax, ay = corners[q, 0] - x, corners[q, 1] - y
    return ax * (corners[q + 1, 1] - y) - ay * (corners[q + 1, 0] - x)


@compiled
def _fill_parts(parts: Any, planes: Any, surface: tuple[int, Array], out: Any) -> None:
    """Fill in what follows the clusters of panels, at the end of arrays: parts of panels.

    Their four points are as ``rigid.four_points_of`` finds those of clusters, moved onto the
    surface along the panel's normal.

    Args:
        parts: Panels and their parts as :func:`halved` gives them: corners, the parts of each, and
            its panel.
        planes: Of the panels: axes, shape (2, n, 3); origins [m], normals, and charge densities.
        surface: The ``ShapeKind`` of what parts are moved onto, -1 for nothing, and its sizes [m].
        out: The cluster of each panel, shape (n,); and arrays of clusters and of functions, whose
            entries of clusters of panels are there: children, function, charge, center, points,
            extent, softening length, own.
    """
    (corners, below, panel), (axes, middles, normals, density) = parts, planes
    (kind, size), (place, children, function, charge, center, points, extent, soft, own) = (
        surface, out,
    )  # fmt: skip
    n, made = middles.shape[0], middles.shape[0]
    for k in range(corners.shape[0]):
        c = place[k] if k < n else k + n - 1
        if below[k, 0] >= 0:
            children[c, 0], children[c, 1] = below[k, 0] + n - 1, below[k, 1] + n - 1
            function[c] = made
            made += 1
        elif k >= n:
            children[c], function[c] = -1, -1
        if k < n:
            if below[k, 0] >= 0:
                own[made - 1] = OWN / extent[c]
            continue
        x0, y0 = corners[k, 0, 0], corners[k, 0, 1]
        total = x = y = xx = yy = xy = 0.0
        for q in range(1, 3):
            total += _double(corners[k], q)
        for q in range(1, 3):
            ax, ay = corners[k, q, 0] - x0, corners[k, q, 1] - y0
            bx, by = corners[k, q + 1, 0] - x0, corners[k, q + 1, 1] - y0
            part, sx, sy = _double(corners[k], q) / total, ax + bx, ay + by
            x += part * sx / 3
            y += part * sy / 3
            for u, v in ((ax, ay), (bx, by), (sx, sy)):
                xx += part / 12 * (u * u)
                yy += part / 12 * (v * v)
                xy += part / 12 * (u * v)
        xx, yy, xy = xx - x * x, yy - y * y, xy - x * y
        turn, spread = 0.5 * math.atan2(2 * xy, xx - yy), math.hypot(0.5 * (xx - yy), xy)
        long = math.sqrt(0.5 * (xx + yy) + spread)
        short = math.sqrt(max(0.5 * (xx + yy) - spread, 0.0))
        cos, sin = math.cos(turn), math.sin(turn)
        extent[c], p, four = math.sqrt(12.0) * long, panel[k], points[c]
        charge[c], soft[c] = density[p] * (0.5 * abs(total)), SOFT * extent[c]
        if below[k, 0] >= 0:
            own[made - 1] = OWN / extent[c]
        for d in range(3):
            u, v = axes[0, p, d], axes[1, p, d]
            middle = middles[p, d] + ((x0 + x) * u + (y0 + y) * v)
            first = long * cos * u + long * sin * v
            second = -short * sin * u + short * cos * v
            four[0, d] = middle + first + second
            four[1, d] = middle + first - second
            four[2, d] = middle - first + second
            four[3, d] = middle - first - second
        if kind >= 0:
            for q in range(4):
                off = primitive_distance(kind, size, four[q, 0], four[q, 1], four[q, 2])
                for d in range(3):
                    four[q, d] -= off * normals[p, d]
        for d in range(3):
            center[c, d] = 0.25 * (four[0, d] + four[1, d] + four[2, d] + four[3, d])


def _with_parts(shape: RefinedShape, flat: Array, axes: Array) -> dict[str, NDArray[Any]]:
    """What a record points to of a shape's clusters and, behind them, of its panels' parts.

    Args:
        shape: The shape.
        flat, axes: Its panels as :func:`_flat` gives them.
    """
    panels, tree, m = shape.panels, shape.tree, len(shape.panels)
    corners, children, panel = halved(flat, shape.finest)
    single = np.flatnonzero(tree.panel >= 0)
    place = np.empty(m, np.int64)  # clusters of panels
    place[tree.panel[single]] = single
    arrays = {name: getattr(tree, name) for name in _OF_CLUSTERS} | {"own": shape.own}
    out = {}
    for name, values in arrays.items():
        count = m + (len(panel) - m) // 2 if name == "own" else len(panel) + m - 1
        out[name] = np.empty((count, *values.shape[1:]), values.dtype)
        out[name][: len(values)] = values
    surface = shape.surface
    curved = surface.kind not in (ShapeKind.BOX, ShapeKind.MESH)
    _fill_parts(
        (corners, children, panel),
        (axes, panels.centers, panels.normals, tree.charge[place] / panels.areas),
        (int(surface.kind), surface.params) if curved else (-1, np.zeros(3)),
        (place, *out.values()),
    )
    return out
