"""Planes on which potentials are drawn."""

from __future__ import annotations

import math
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

if TYPE_CHECKING:
    from capsense.design import Design
    from capsense.field.green import GreenFunction

Array = NDArray[np.float64]

POINTS = 240
"""Points that are drawn along the longer side."""
SAMPLES = 48
"""Points along the longer side where potentials are taken; between these they are linear."""
REACH = 0.12
"""Planes end so far from the electrodes [m]; twice as far along z."""
OCTAVES = 8
"""Potentials down to two to the minus this are drawn."""
AXES = ("x", "y", "z")
NEAR = 1e-3
"""Points closer than this to a point charge of the sensor's field are not drawn [m]."""


def is_flat(design: Design) -> bool:
    """Whether all electrodes and conductors are horizontal, so that the front is above them."""
    return all(
        abs(facet.axes[2, 2]) > 1 - 1e-9 for body in design.sheets for facet in body.surface.facets
    )


def region(design: Design) -> Array:
    """What planes cross: the surroundings of the electrodes, as far as they are in the domain.

    That of a flat design begins at its highest layer or sheet: behind it potentials have no
    meaning.

    Returns:
        Ends along x, y and z [m], shape (3, 2).
    """
    low, high = np.array([e.surface.bounds for e in design.electrodes]).transpose(1, 0, 2)
    far = np.array([REACH, REACH, 2 * REACH])
    ends = np.stack(
        [
            np.maximum(low.min(axis=0) - far, design.domain.lower),
            np.minimum(high.max(axis=0) + far, design.domain.upper),
        ],
        axis=1,
    )
    if is_flat(design):
        tops = [b.surface.bounds[1, 2] for b in design.sheets]
        ends[2, 0] = max([*tops, *(layer.upper[2] for layer in design.layers)])
    return ends


class Plane:
    """A plane across a region, at a coordinate along one axis.

    Potentials take some 20 µs a point: they are taken on a coarse grid and carried to a fine one.

    Args:
        green: Of the sensor; points close to its charges are not drawn.
        bounds: Ends of the region that planes cross [m], shape (3, 2); within the domain.
        axis: Which coordinate is fixed: 0, 1 or 2.
        at: Its value [m]; taken into the region.
    """

    def __init__(self, green: GreenFunction, bounds: Array, axis: int, at: float) -> None:
        self.axis = axis
        self.at = float(np.clip(at, *bounds[axis]))
        sides = [k for k in range(3) if k != axis]
        longest = float(np.ptp(bounds[sides], axis=1).max())
        self.pitch = longest / POINTS
        """Distance of neighbouring points that are drawn [m]."""
        coarse, fine, self._carry = [], [], []
        for low, high in bounds[sides]:
            coarse.append(np.linspace(low, high, 1 + math.ceil(SAMPLES * (high - low) / longest)))
            fine.append(np.arange(low + self.pitch / 2, high, self.pitch))
            unit = np.eye(len(coarse[-1]))
            self._carry.append(np.stack([np.interp(fine[-1], coarse[-1], e) for e in unit], axis=1))
        self.points = self._grid(*coarse)
        """Where potentials are taken [m], shape (n, 3)."""
        points, self._fine = self._grid(*fine), fine
        near = NEAR * green.unit
        away = cKDTree(green.unit * green.near_sources).query(points, distance_upper_bound=near)[0]
        self._drawn = ~(away < near).reshape(len(fine[0]), len(fine[1]))
        self.drawn = points[self._drawn.ravel()]
        """Where they are drawn [m], shape (m, 3)."""

    def carried(self, potential: Array) -> Array:
        """Potentials [V] where they are drawn, shape (m,), from those at ``points``, (n,)."""
        return self._carried(potential)[self._drawn]

    def contours(self, potential: Array) -> tuple[Array, NDArray[np.uint8]]:
        """Lines of equal potential, two from each halving to the next.

        Args:
            potential: At ``points`` [V], shape (n,).

        Returns:
            Ends of straight pieces [m], shape (s, 2, 3), and the red, green and blue of these ends,
            same shape.
        """
        from contourpy import LineType, contour_generator

        values = np.ma.masked_array(self._carried(potential), ~self._drawn)
        across, along = self._fine[::-1]
        made: Any = contour_generator(across, along, values, line_type=LineType.Separate)
        pieces, colours = [np.empty((0, 2, 2))], [np.empty((0, 2, 3), np.uint8)]
        for level, colour in zip(levels(), palette(), strict=True):
            for line in made.lines(level):
                pieces.append(np.stack([line[:-1, ::-1], line[1:, ::-1]], axis=1))
                colours.append(np.broadcast_to(colour, (len(line) - 1, 2, 3)))
        return np.insert(np.concatenate(pieces), self.axis, self.at, axis=-1), np.concatenate(
            colours
        )

    def _carried(self, potential: Array) -> Array:
        rows, columns = self._carry
        return rows @ potential.reshape(rows.shape[1], columns.shape[1]) @ columns.T

    def _grid(self, u: Array, v: Array) -> Array:
        """Points of the plane, shape (len(u) · len(v), 3)."""
        lines = [u, v]
        lines.insert(self.axis, np.array([self.at]))
        return np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)


def levels() -> Array:
    """Potentials that have a line [V], from the lowest on, shape (2 · OCTAVES,)."""
    return 2.0 ** (-OCTAVES + np.arange(2 * OCTAVES) / 2)


@cache
def palette() -> NDArray[np.uint8]:
    """The colours, from the lowest potentials to the highest, shape (2 · OCTAVES, 3)."""
    from matplotlib import colormaps

    return colormaps["YlGnBu"](np.linspace(0.25, 1.0, 2 * OCTAVES), bytes=True)[:, :3]
