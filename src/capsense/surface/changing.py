"""Surfaces without energies of their own: depth images, cloth, bodies that the box cuts off.

Their clusters are fixed; charge, centres and second moments follow the panels at every step, and
clusters meet each other as rectangles of the same moments.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from capsense.scene import Layers
from capsense.scene.layers import STEP_SLOPE
from capsense.surface import tree_kernels
from capsense.surface.place_kernels import BODY
from capsense.surface.rigid import Clusters, split

Array = NDArray[np.float64]

_FILLED = 10.0
"""Backs farther than this [m] are not known: the image is filled from the front on."""
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


@dataclass(frozen=True, eq=False)
class Surface:
    """Pieces of a surface as arrays."""

    centers: Array
    areas: Array
    moments: Array


class ChangingBody:
    """A surface as the step takes it; ``record`` points to arrays that are held here.

    Args:
        tree: Clusters of all pieces.
        surface: The pieces as they are now.
        wanted: Which of them count, at least one, shape (n,); all by default.
    """

    def __init__(
        self, tree: Clusters, surface: Pieces, wanted: NDArray[np.bool_] | None = None
    ) -> None:
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


def layer_pieces(layers: Layers) -> tuple[Clusters, Surface, NDArray[np.bool_]]:
    """The surfaces that a layered image shows, a piece a pixel.

    Backs count where they lie farther behind than two pixels are wide, and before 10 m.

    Returns:
        Clusters of all pixels; the pieces; and which of them there are.
    """
    dx, dy = layers.pixel
    fields, hit = layers.fields[..., :2].astype(float), layers.hit
    slots, rows, columns = hit.shape
    behind = hit & (fields[..., 1] - fields[..., 0] > 2 * max(dx, dy)) & (fields[..., 1] < _FILLED)
    views = [(fields[k, ..., 0], hit[k]) for k in range(slots)]
    views += [(fields[k, ..., 1], behind[k]) for k in range(slots) if behind[k].any()]
    tall, wide = layers.resolution
    corner = np.rint((layers.grid.origin[:2] + 0.5 * np.array(layers.size)) / (dx, dy) - 0.5)
    column, row = corner.astype(int)
    j0, i0 = max(0, -row), max(0, -column)
    j1, i1 = min(rows, tall - row), min(columns, wide - column)
    shape = (len(views), tall, wide)
    centers, areas = np.zeros((*shape, 3)), np.ones(shape)
    moments, wanted = np.zeros((*shape, 3, 3)), np.zeros(shape, bool)
    centers[..., 0] = (np.arange(wide) + 0.5) * dx - 0.5 * layers.size[0]
    centers[..., 1] = ((np.arange(tall) + 0.5) * dy - 0.5 * layers.size[1])[:, None]
    for k, (depth, seen) in enumerate(views):
        at = (k, slice(row + j0, row + j1), slice(column + i0, column + i1))
        slope_x, slope_y = _slopes(depth, seen, 1, dx), _slopes(depth, seen, 0, dy)
        part = np.where(seen, depth, 0.0)[j0:j1, i0:i1]
        slope_x, slope_y = slope_x[j0:j1, i0:i1], slope_y[j0:j1, i0:i1]
        centers[(*at, 2)], wanted[at] = part, seen[j0:j1, i0:i1]
        areas[at] = dx * dy * np.sqrt(1 + slope_x**2 + slope_y**2)
        moments[(*at, 0, 0)], moments[(*at, 1, 1)] = dx * dx / 12, dy * dy / 12
        moments[(*at, 0, 2)] = moments[(*at, 2, 0)] = dx * dx / 12 * slope_x
        moments[(*at, 1, 2)] = moments[(*at, 2, 1)] = dy * dy / 12 * slope_y
        moments[(*at, 2, 2)] = (dx * slope_x) ** 2 / 12 + (dy * slope_y) ** 2 / 12
    pieces = Surface(centers.reshape(-1, 3), areas.ravel(), moments.reshape(-1, 3, 3))
    return _pixel_tree(*shape, dx / dy), pieces, wanted.ravel()


def _slopes(depth: Array, seen: NDArray[np.bool_], axis: int, pitch: float) -> Array:
    """Slope of a depth image along an axis; beside a step, that on the near side."""
    step = np.diff(np.where(seen, depth, np.nan), axis=axis) / pitch
    pad = [(0, 0), (0, 0)]
    pad[axis] = (1, 0)
    before = np.pad(step, pad, constant_values=np.nan)
    pad[axis] = (0, 1)
    after = np.pad(step, pad, constant_values=np.nan)
    steep = (np.abs(before) > STEP_SLOPE) | (np.abs(after) > STEP_SLOPE)
    smaller = np.where(np.abs(before) < np.abs(after), before, after)
    out = np.where(steep, smaller, 0.5 * (before + after))
    out = np.where(np.isnan(before), after, np.where(np.isnan(after), before, out))
    return np.clip(np.nan_to_num(out), -STEP_SLOPE, STEP_SLOPE)


@lru_cache(maxsize=16)
def _pixel_tree(views: int, rows: int, columns: int, ratio: float) -> Clusters:
    """Clusters of the pixels of images that lie behind each other."""
    view, row, column = np.indices((views, rows, columns)).reshape(3, -1).astype(float)
    far = 2.0 * max(rows, columns * ratio)
    features = np.zeros((len(view), 6))
    features[:, :3] = np.stack([column * ratio, row, far * view], axis=1)
    return split(features, np.ones(len(view)))
