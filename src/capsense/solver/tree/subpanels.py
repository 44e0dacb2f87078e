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

from capsense.scene.shapes import Shape, ShapeKind
from capsense.solver.bodies.panels import SurfacePanels
from capsense.solver.tree.dynamic_surface import OWN
from capsense.solver.tree.rigid import HALF_SPACE, SOFT, RigidShape

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

_MOST = 5
"""Panels are halved at most so often: to 32 parts."""


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
        return _with_parts(self)

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
    if _sides(_flat(shape.panels)[0]).max() <= finest:
        return shape
    return RefinedShape(
        shape.panels,
        shape.tree,
        shape.potential_coefficients,
        shape.capacitance,
        shape,
        finest,
        surface,
    )


def _flat(panels: SurfacePanels) -> tuple[Array, Array]:
    """Corners in the plane of each panel [m], (2, 4, n), and the axes of these planes, (2, n, 3).

    Their origins are the panels' centres.
    """
    first = panels.corners[:, 1] - panels.corners[:, 0]
    first = first / np.linalg.norm(first, axis=1)[:, None]
    axes = np.stack([first, np.cross(panels.normals, first)])
    return np.einsum("nqi,ani->aqn", panels.corners - panels.centers[:, None], axes), axes


def _sides(corners: Array) -> Array:
    """Mean lengths of the two pairs of opposite sides [m], (2, 4, n) -> (2, n)."""
    length = np.hypot(*(np.roll(corners, -1, axis=1) - corners))
    return np.asarray(0.5 * (length[:2] + length[2:]))


def halved(corners: Array, finest: float) -> tuple[Array, Ints, Ints]:
    """Halve polygons across their longer sides, breadth first.

    Args:
        corners: Of n panels in planes of their own [m], shape (2, 4, n).
        finest: Those with a longer side are halved [m].

    Returns:
        Corners of the panels and all their parts, shape (2, 4, k); the parts of each, -1 where it
        has none, shape (k, 2); and the panel that it lies in, shape (k,).
    """
    levels, children, panel, count = [corners], [], [np.arange(corners.shape[2])], corners.shape[2]
    for level in range(_MOST + 1):
        sides = _sides(levels[-1])
        long = np.flatnonzero((sides.max(axis=0) > finest) & (level < _MOST))
        parts = np.full((sides.shape[1], 2), -1)
        parts[long] = count + np.arange(2 * len(long)).reshape(-1, 2)
        children.append(parts)
        if not len(long):
            break
        count += 2 * len(long)
        whole = levels[-1][:, :, long]
        # brought to where sides (0, 1) and (2, 3) are the longer ones
        whole = np.where(sides[1, long] > sides[0, long], np.roll(whole, -1, axis=1), whole)
        a, b, c, d = whole.transpose(1, 0, 2)
        near, far = 0.5 * (a + b), 0.5 * (c + d)
        both = np.stack([np.stack([a, near, far, d], 1), np.stack([near, b, c, far], 1)], axis=3)
        levels.append(both.reshape(2, 4, -1))
        panel.append(np.repeat(panel[-1][long], 2))
    return np.concatenate(levels, axis=2), np.concatenate(children), np.concatenate(panel)


def _moments(corners: Array) -> tuple[Array, Array, Array]:
    """Areas (n,), centroids (2, n) and second central moments xx, yy, xy (3, n) of polygons."""
    origin = corners[:, 0]
    u, v, w = (corners[:, k] - origin for k in (1, 2, 3))
    double = np.stack([u[0] * v[1] - u[1] * v[0], v[0] * w[1] - v[1] * w[0]])
    area = double.sum(axis=0)
    center, moments = np.zeros_like(origin), np.zeros((3, len(area)))
    for part, (a, b) in zip(double / area, ((u, v), (v, w)), strict=True):
        # of a triangle with one corner at the origin
        center += part * (a + b) / 3
        for x in (a, b, a + b):
            moments += part / 12 * np.stack([x[0] * x[0], x[1] * x[1], x[0] * x[1]])
    moments -= np.stack([center[0] ** 2, center[1] ** 2, center[0] * center[1]])
    return 0.5 * np.abs(area), origin + center, moments


def _with_parts(shape: RefinedShape) -> dict[str, NDArray[Any]]:
    """What a record points to of a shape's clusters and, behind them, of its panels' parts."""
    panels, tree, m = shape.panels, shape.tree, len(shape.panels)
    flat, axes = _flat(panels)
    corners, children, panel = halved(flat, shape.finest)
    area, center, (xx, yy, xy) = _moments(corners[:, :, m:])
    axes, middle = axes[:, panel[m:]], panels.centers[panel[m:]]
    # the four points of each, as ``rigid.four_points_of`` finds them
    turn, spread = 0.5 * np.arctan2(2 * xy, xx - yy), np.hypot(0.5 * (xx - yy), xy)
    long = np.sqrt(0.5 * (xx + yy) + spread)
    short = np.sqrt(np.maximum(0.5 * (xx + yy) - spread, 0.0))
    cos, sin = np.cos(turn), np.sin(turn)
    first, second = _lines(axes, long * cos, long * sin), _lines(axes, -short * sin, short * cos)
    centers = middle + _lines(axes, *center)
    points = np.empty((len(area), 4, 3))
    for q, (p, r) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        points[:, q] = centers + p * first + r * second
    if shape.surface.kind not in (ShapeKind.BOX, ShapeKind.MESH):
        normals = panels.normals[panel[m:]]
        for q in range(4):
            points[:, q] -= shape.surface.signed_distance(points[:, q])[:, None] * normals
        centers = points.mean(axis=1)
    place = np.arange(len(panel)) + m - 1  # clusters of panels and parts
    place[tree.panel[tree.panel >= 0]] = np.flatnonzero(tree.panel >= 0)
    cut = np.flatnonzero(children[:, 0] >= 0)
    all_kids = np.concatenate([tree.children, np.full((len(area), 2), -1)])
    all_kids[place[cut]] = place[children[cut]]
    function = np.concatenate([tree.function, np.full(len(area), -1)])
    function[place[cut]] = m + np.arange(len(cut))
    density = tree.charge[place[:m]] / panels.areas
    extent = math.sqrt(12.0) * long
    size = np.concatenate([tree.extent, extent])
    return {
        "children": all_kids, "function": function, "extent": size,
        "own": np.concatenate([shape.own, OWN / size[place[cut]]]),
        "charge": np.concatenate([tree.charge, density[panel[m:]] * area]),
        "center": np.concatenate([tree.center, centers]),
        "points": np.concatenate([tree.points, points]),
        "softening_length": np.concatenate([tree.softening_length, SOFT * extent]),
    }  # fmt: skip


def _lines(axes: Array, x: Array, y: Array) -> Array:
    """From coordinates in planes of axes (2, n, 3) to vectors, (n, 3)."""
    return np.asarray(x[:, None] * axes[0] + y[:, None] * axes[1])
