"""Surfaces without energies of their own: depth images, cloth, bodies that the box cuts off.

Their clusters are fixed; charge, centres and second moments follow the panels at every step, and
clusters meet each other as rectangles of the same moments.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from capsense.surface import tree_kernels
from capsense.surface.place_kernels import BODY
from capsense.surface.rigid import Clusters

Array = NDArray[np.float64]

_OWN = 4.0
"""Energy of a charge function times the extent of its cluster, as far as scores need it."""


class Pieces(Protocol):
    """Small flat pieces of a surface, n of them, in the frame of their body."""

    @property
    def centers(self) -> Array:
        """[m], shape (n, 3)."""

    @property
    def areas(self) -> Array:
        """[m²], shape (n,)."""

    @property
    def moments(self) -> Array:
        """Second central moments of area over the area [m²], shape (n, 3, 3)."""


class ChangingBody:
    """A surface as the step takes it; ``record`` points to arrays that are held here.

    Args:
        tree: Clusters of all pieces.
        surface: The pieces as they are now.
        wanted: Which of them count, at least one, shape (n,); all by default.
        sheet: Thickness of an open sheet [m]; 0 for the surface of a solid.
    """

    def __init__(
        self,
        tree: Clusters,
        surface: Pieces,
        wanted: NDArray[np.bool_] | None = None,
        sheet: float = 0.0,
    ) -> None:
        self.sheet = sheet
        n = len(surface.areas)
        self._kids, self._panel, self._function = tree.kids, tree.panel, tree.function
        if wanted is not None and not wanted.all():
            self._kids, self._panel, self._function = (
                np.empty_like(a) for a in (tree.kids, tree.panel, tree.function)
            )
            n = tree_kernels.prune(
                tree.kids, tree.panel, wanted, self._kids, self._panel, self._function,
                np.empty((2, len(tree.kids)), np.int64),
            )  # fmt: skip
            self._kids, self._panel, self._function = (
                np.ascontiguousarray(a[: 2 * n - 1])
                for a in (self._kids, self._panel, self._function)
            )
        nodes = 2 * n - 1
        single = self._panel >= 0
        at = self._panel[single]
        self._charge, self._center, self._spread = (
            np.empty(nodes),
            np.empty((nodes, 3)),
            np.empty((nodes, 3, 3)),
        )
        self._charge[single] = surface.areas[at]
        self._center[single], self._spread[single] = surface.centers[at], surface.moments[at]
        tree_kernels.moments(self._kids, self._panel, self._charge, self._center, self._spread)
        extent = np.sqrt(6.0 * np.trace(self._spread, axis1=1, axis2=2)) + 1e-9
        self._extent = extent
        self.capacitance = 0.35 * float(extent[0])
        """About that in free space over 4π eps0 [m]."""
        self._own = np.empty(n)
        self._own[0] = 0.5 * _OWN / extent[0]
        self._own[self._function[~single]] = _OWN / extent[~single]
        record = np.zeros(1, BODY)[0]
        record["n"], record["scale"] = n, 1.0
        for name in ("kids", "function", "charge", "center", "spread", "own", "extent"):
            record[name] = getattr(self, f"_{name}").ctypes.data
        self.record = record
