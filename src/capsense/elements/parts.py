"""What lies below the panels of a rigid shape: parts of them, for bodies that are near a sensor.

A shape's energies are those of its panels. Where these are wider than a gap, charge gathers within
them. So the tree goes on below the panels, each halved across its longer side until its parts are
small. There are no energies of these: the step works out what the parts that it uses meet, see
:mod:`capsense.surface.part_kernels`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capsense.elements.panels import SurfacePanels, polygon_panels
from capsense.elements.pieces import OWN
from capsense.elements.rigid import HALF_SPACE, SOFT, RigidShape

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

_MOST = 6
"""Panels are halved at most so often."""


@dataclass(frozen=True, eq=False)
class RefinedShape(RigidShape):
    """A rigid shape whose tree goes on below the panels."""

    whole: RigidShape
    """The shape without parts, whose inside is shared."""
    finest: float
    """Parts with a side longer than this are halved [m]."""

    @property
    def impedance(self) -> NDArray[np.float32]:
        """As of :class:`RigidShape`, of the functions of whole panels."""
        return self.whole.impedance

    @cached_property
    def _parts(self) -> dict[str, NDArray[Any]]:
        return _with_parts(self)

    @cached_property
    def record(self) -> np.void:
        """As of :class:`RigidShape`; clusters and functions of parts follow those of panels."""
        record = self.whole.record.copy()
        record["n"] = (len(self._parts["kids"]) + 1) // 2
        record["inside"] = HALF_SPACE
        for name, values in self._parts.items():
            record[name] = values.ctypes.data
        return record

    @property
    def nbytes(self) -> int:
        """Room that the matrices and the parts take up [bytes]."""
        return self.whole.nbytes + sum(a.nbytes for a in self._parts.values())


def refined(shape: RigidShape, finest: float) -> RigidShape:
    """A shape with parts of its panels where these are longer than ``finest`` [m], else itself."""
    if _sides(shape.panels.corners).max() <= finest:
        return shape
    return RefinedShape(
        shape.panels, shape.tree, shape.energy, shape.capacitance, shape, finest
    )


def _sides(corners: Array) -> Array:
    """Mean lengths of the two pairs of opposite sides (0, 1) and (1, 2), (n, 4, 3) -> (n, 2)."""
    length = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    return 0.5 * (length[:, :2] + length[:, 2:])


def halved(corners: Array, finest: float) -> tuple[Array, Ints, Ints]:
    """Halve polygons across their longer sides, breadth first.

    Args:
        corners: Of n panels [m], shape (n, 4, 3).
        finest: Those with a longer side are halved [m].

    Returns:
        Corners of the panels and all their parts, shape (k, 4, 3); the parts of each, -1 where it
        has none, shape (k, 2); and the panel that it lies in, shape (k,).
    """
    levels, kids, panel, count = [corners], [], [np.arange(len(corners))], len(corners)
    for level in range(_MOST + 1):
        last = levels[-1]
        sides = _sides(last)
        long = np.flatnonzero((sides.max(axis=1) > finest) & (level < _MOST))
        parts = np.full((len(last), 2), -1)
        parts[long] = count + np.arange(2 * len(long)).reshape(-1, 2)
        kids.append(parts)
        if not len(long):
            break
        count += 2 * len(long)
        # brought to where sides (0, 1) and (2, 3) are the longer ones
        turn = (np.arange(4) + (sides[long, 1] > sides[long, 0])[:, None]) % 4
        a, b, c, d = np.take_along_axis(last[long], turn[:, :, None], axis=1).transpose(1, 0, 2)
        near, far = 0.5 * (a + b), 0.5 * (c + d)
        both = np.stack([np.stack([a, near, far, d], 1), np.stack([near, b, c, far], 1)], axis=1)
        levels.append(both.reshape(-1, 4, 3))
        panel.append(np.repeat(panel[-1][long], 2))
    return np.concatenate(levels), np.concatenate(kids), np.concatenate(panel)


def _four_points(panels: SurfacePanels) -> tuple[Array, Array]:
    """As ``rigid.four_points_of`` of flat panels: points (n, 4, 3) and extents (n,) [m]."""
    first = panels.corners[:, 1] - panels.corners[:, 0]
    first = first / np.linalg.norm(first, axis=1)[:, None]
    second = np.cross(panels.normals, first)
    across = (panels.moments @ second[:, :, None])[:, :, 0]
    xx = np.einsum("ni,nij,nj->n", first, panels.moments, first)
    yy, xy = (second * across).sum(axis=1), (first * across).sum(axis=1)
    spread = np.hypot(0.5 * (xx - yy), xy)
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)[:, None]
    long = np.sqrt(0.5 * (xx + yy) + spread)
    short = np.sqrt(np.maximum(0.5 * (xx + yy) - spread, 0.0))
    u = long[:, None] * (np.cos(angle) * first + np.sin(angle) * second)
    v = short[:, None] * (np.cos(angle) * second - np.sin(angle) * first)
    arms = np.stack([u + v, u - v, v - u, -u - v], axis=1)
    return panels.centers[:, None] + arms, math.sqrt(12.0) * long


def _with_parts(shape: RefinedShape) -> dict[str, NDArray[Any]]:
    """What a record points to of a shape's clusters and, behind them, of its panels' parts."""
    tree, m = shape.tree, len(shape.panels)
    corners, kids, panel = halved(shape.panels.corners, shape.finest)
    parts = polygon_panels(corners[m:])
    points, extent = _four_points(parts)
    place = np.arange(len(corners)) + m - 1  # clusters of panels and parts
    place[tree.panel[tree.panel >= 0]] = np.flatnonzero(tree.panel >= 0)
    cut = np.flatnonzero(kids[:, 0] >= 0)
    all_kids = np.concatenate([tree.kids, np.full((len(parts), 2), -1)])
    all_kids[place[cut]] = place[kids[cut]]
    function = np.concatenate([tree.function, np.full(len(parts), -1)])
    function[place[cut]] = m + np.arange(len(cut))
    density = tree.charge[place[:m]] / shape.panels.areas
    size = np.concatenate([tree.extent, extent])
    own = np.concatenate([shape.own, OWN / size[place[cut]]])
    return {
        "kids": all_kids, "function": function, "own": own,
        "charge": np.concatenate([tree.charge, density[panel[m:]] * parts.areas]),
        "center": np.concatenate([tree.center, parts.centers]),
        "points": np.concatenate([tree.points, points]), "extent": size,
        "soft": np.concatenate([tree.soft, SOFT * extent]),
    }  # fmt: skip
