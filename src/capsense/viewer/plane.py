"""A plane through the lattice: potentials sampled on it, and their colours."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

if TYPE_CHECKING:
    from capsense.design import Design
    from capsense.field.lattice import Lattice

Array = NDArray[np.float64]

POINTS = 240
"""Points along the longer side."""
REACH = 0.12
"""Planes end so far from the electrodes [m]; twice as far along z."""
OCTAVES = 8
"""Potentials down to two to the minus this are drawn."""


def region(design: Design) -> Array:
    """What planes cross: the surroundings of the electrodes, as far as they are in the domain.

    Returns:
        Ends along x, y and z [m], shape (3, 2).
    """
    low, high = np.array([e.surface.bounds for e in design.electrodes]).transpose(1, 0, 2)
    far = np.array([REACH, REACH, 2 * REACH])
    return np.stack(
        [
            np.maximum(low.min(axis=0) - far, design.domain.lower),
            np.minimum(high.max(axis=0) + far, design.domain.upper),
        ],
        axis=1,
    )


class Plane:
    """A plane across a region, at a coordinate along one axis, as a grid of points.

    Potentials are linear between nodes, as a product with a sparse matrix, so that sampling them
    costs next to nothing.

    Args:
        lattice: Where potentials are given.
        bounds: Ends of the region that planes cross [m], shape (3, 2); within the domain.
        axis: Which coordinate is fixed: 0, 1 or 2.
        at: Its value [m]; taken into the region.
    """

    def __init__(self, lattice: Lattice, bounds: Array, axis: int, at: float) -> None:
        self.axis = axis
        self.at = float(np.clip(at, *bounds[axis]))
        sides = [k for k in range(3) if k != axis]
        self.pitch = float(np.ptp(bounds[sides], axis=1).max()) / POINTS
        """Distance of neighbouring points [m]."""
        u, v = (np.arange(low + self.pitch / 2, high, self.pitch) for low, high in bounds[sides])
        grid = np.empty((len(u), len(v), 3))
        grid[..., axis] = self.at
        grid[..., sides[0]] = u[:, None]
        grid[..., sides[1]] = v[None, :]
        self.points = grid
        """Where the points stand [m], shape (rows, columns, 3)."""
        self._matrix = interpolation(lattice, grid.reshape(-1, 3))

    def sample(self, potential: Array) -> Array:
        """Potentials [V] at the points, shape (rows, columns), from those at the nodes, (n,)."""
        return (self._matrix @ potential).reshape(self.points.shape[:2])


def interpolation(lattice: Lattice, points: Array) -> csr_array:
    """The matrix, shape (k, n), that takes values at the nodes to points [m], shape (k, 3).

    Linear along each axis. The points must lie in the domain.
    """
    own = [_own_planes(lattice, k) for k in range(len(lattice.storeys))]
    levels = np.concatenate([s.axes[2][o] for s, o in zip(lattice.storeys, own, strict=True)])
    storey = np.concatenate([np.full(len(o), k) for k, o in enumerate(own)])
    plane = np.concatenate(own)
    below, part = _bracket(levels, points[:, 2])
    rows, columns, values = [], [], []
    for level, share in ((below, 1.0 - part), (below + 1, part)):
        for k, s in enumerate(lattice.storeys):
            here = np.flatnonzero(storey[level] == k)
            _, ny, nz = s.shape
            i, a = _bracket(s.axes[0], points[here, 0])
            j, b = _bracket(s.axes[1], points[here, 1])
            for di, wi in ((0, 1 - a), (1, a)):
                for dj, wj in ((0, 1 - b), (1, b)):
                    rows.append(here)
                    columns.append(s.first + ((i + di) * ny + j + dj) * nz + plane[level[here]])
                    values.append(share[here] * wi * wj)
    where = np.concatenate(rows), np.concatenate(columns)
    return csr_array((np.concatenate(values), where), shape=(len(points), lattice.n_nodes))


def paint(potential: Array) -> tuple[NDArray[np.bool_], NDArray[np.uint8]]:
    """Colours of a sampled plane: one colour for each halving of the potential.

    Args:
        potential: As :meth:`Plane.sample` gives it.

    Returns:
        Which points are shown, shape (rows, columns), and their red, green and blue, shape (n, 3).
    """
    floor = 2.0**-OCTAVES
    band = np.floor(np.log2(np.maximum(potential, floor / 2) / floor)).astype(int)
    band = np.minimum(band, OCTAVES - 1)
    shown = band >= 0
    return shown, palette()[band[shown]]


def _own_planes(lattice: Lattice, number: int) -> NDArray[np.int64]:
    """Planes of a storey that do not stand in for those of another."""
    s = lattice.storeys[number]
    last = number == len(lattice.storeys) - 1
    return np.arange(1 if number else 0, s.shape[2] - (0 if last else 1))


def _bracket(nodes: Array, at: Array) -> tuple[NDArray[np.int64], Array]:
    """Between which nodes coordinates lie: the lower one, and how far to the next, 0 to 1."""
    k = np.clip(np.searchsorted(nodes, at, side="right") - 1, 0, len(nodes) - 2)
    return k, np.clip((at - nodes[k]) / (nodes[k + 1] - nodes[k]), 0.0, 1.0)


@cache
def palette() -> NDArray[np.uint8]:
    """The colours, from the lowest potentials to the highest, shape (OCTAVES, 3)."""
    from matplotlib import colormaps

    return colormaps["YlGnBu"](np.linspace(0.12, 1.0, OCTAVES), bytes=True)[:, :3]
