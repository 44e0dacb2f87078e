"""A plane through the lattice: potentials sampled on it, and their picture."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

if TYPE_CHECKING:
    from capsense.field.lattice import Lattice

Array = NDArray[np.float64]

PIXELS = 160
"""Samples along each side."""
OCTAVES = 8
"""Potentials down to two to the minus this are drawn."""


class Plane:
    """A plane across the domain, at a coordinate along one axis.

    The other two axes, in their order, are those of its picture. Potentials are linear between
    nodes, as a product with a sparse matrix, so that a picture costs next to nothing.

    Args:
        lattice: Where potentials are given.
        axis: Which coordinate is fixed: 0, 1 or 2.
        at: Its value [m]; taken into the domain.
    """

    def __init__(self, lattice: Lattice, axis: int, at: float) -> None:
        bounds = np.array(lattice.bounds)
        self.axis = axis
        self.at = float(np.clip(at, *bounds[axis]))
        self.sides = [k for k in range(3) if k != axis]
        """The axes of the picture."""
        self.low, self.high = bounds[self.sides, 0], bounds[self.sides, 1]
        """Ends of the picture along its axes [m]."""
        pitch = (self.high - self.low) / PIXELS
        u, v = (lo + p * (np.arange(PIXELS) + 0.5) for lo, p in zip(self.low, pitch, strict=True))
        points = np.empty((PIXELS, PIXELS, 3))
        points[..., axis] = self.at
        points[..., self.sides[0]] = u[:, None]
        points[..., self.sides[1]] = v[None, :]
        self._matrix = interpolation(lattice, points.reshape(-1, 3))

    def sample(self, potential: Array) -> Array:
        """Potentials [V] at the pixels, shape (PIXELS, PIXELS), from those at the nodes, (n,)."""
        return (self._matrix @ potential).reshape(PIXELS, PIXELS)


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


def picture(potential: Array) -> NDArray[np.uint8]:
    """Colours of a sampled plane: one colour a halving of the potential, with lines between them.

    Args:
        potential: As :meth:`Plane.sample` gives it.

    Returns:
        Red, green, blue and opacity, shape (PIXELS, PIXELS, 4); the first row is at the high end of
        the second axis, columns run along the first.
    """
    octave = np.log2(np.maximum(potential.T[::-1], 2.0 ** -(OCTAVES + 1)))
    strength = np.clip(1 + octave / OCTAVES, 0.0, 1.0)
    out = _colours()[(255 * strength).astype(int)]
    out[..., 3] = np.where(strength > 0, 70 + 150 * strength, 0).astype(np.uint8)
    band = np.floor(octave)
    line = np.zeros(band.shape, dtype=bool)
    line[:-1] |= band[:-1] != band[1:]
    line[:, :-1] |= band[:, :-1] != band[:, 1:]
    out[line, :3] //= 2
    return out


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
def _colours() -> NDArray[np.uint8]:
    from matplotlib import colormaps

    return colormaps["viridis"](np.arange(256), bytes=True)
