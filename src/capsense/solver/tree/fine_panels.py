"""Bodies that are wide, on small panels: far more than energies could be worked out for.

Their clusters meet each other as those of :mod:`capsense.solver.tree.dynamic_surface` do.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from heapq import heappop, heappush
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

from capsense.errors import SolveError
from capsense.scene import TriMesh
from capsense.scene.shapes import Box, Shape, ShapeKind
from capsense.scene.surface import enclosed_volume
from capsense.solver.bodies.blocks import free_block, impedance
from capsense.solver.bodies.grids import box_tiles
from capsense.solver.bodies.panels import SurfacePanels, panels_of, polygon_panels
from capsense.solver.tree import tree_kernels
from capsense.solver.tree.dynamic_surface import DynamicBody
from capsense.solver.tree.mean_kernels import means_between, patch_means, points_of_each
from capsense.solver.tree.rigid import (
    HALF_SPACE,
    Clusters,
    equilibrium,
    features,
    once,
    split,
    spread_out,
)

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Ints = NDArray[np.int64]

WIDE = 0.16
"""Shapes of a second-largest extent above this [m] are solved for on a :class:`FinePanelBody`."""
_ROUND = {
    ShapeKind.SPHERE: math.pi / 6, ShapeKind.ELLIPSOID: math.pi / 6,
    ShapeKind.CAPSULE: math.pi / 4, ShapeKind.CYLINDER: math.pi / 4,
}  # fmt: skip
"""About how much of the surface of its bounding box that of a shape is."""
_EDGELESS = (ShapeKind.SPHERE, ShapeKind.ELLIPSOID, ShapeKind.CAPSULE)
_BENT, _FILLED = 0.4, 0.36
"""How much of the surface of what is no box counts, as less of it is near a sensor at a time; and
how much of that of dielectrics, of whose inside few panels tell."""
_SLENDER = 4.0
"""Lengths beyond so many widths do not make panels too wide."""
_PIECE = 4e-3
"""Edges of the pieces of wide bodies [m]: what can be resolved at gaps of some millimetres."""
_FEWEST, _DOUBLINGS = 5000, 3
"""Pieces of wide bodies are so many, doubled at most so often."""
_COARSE, _THICK = 1000, 2.0
"""Panels from which the impedance of the inside of wide shapes is found, if they are round and at
least so many times as thick as these are wide: edges and two near faces take finer ones …"""
_FINER, _THIN, _THINNER, _BROAD = 2000, 1.2, 0.6, 0.02
"""… which are so many, and do not do for shapes less than 1.2 times as thick as these are wide, or
0.6 times where they are wider than the last [m]: other panels would then be much too wide."""
_FOIL = 5e-4
"""Primitives thinner than this part of their width have no energies: their faces would be one."""
FACES, _LIMBS, _FLAT = 12.0, 0.1, 0.5
"""Clusters of a wide body that are more than twice so many times as wide as it is thick hold both
of its faces: the first of those with flat sides, of which four points do not tell the faces apart
there; the second of others, whose limbs are separated first. Those with flat sides are thicker
than the third of their least extent."""
_CLUSTERS = 1000
"""Clusters from which the charges of wide bodies are found, and the energies of larger ones."""
_LEFT = 1e-5
"""How exactly these charges are found, see :func:`equilibrium`."""


class _Wide(NamedTuple):
    """What a shape comes to as a wide one."""

    conductor: float
    """Surface that counts [m²], infinite where the shape is wide whatever is in front of it …"""
    dielectric: float
    """… and as a dielectric; 0 where it cannot be a wide one."""
    area: float
    """Its surface, roughly [m²]."""
    pieces: int
    """About how many pieces it is cut into."""
    coarse: int
    """Panels from which the impedance of its inside is found."""


def _wide(shape: Shape) -> _Wide:
    held: _Wide | None = shape.__dict__.get("_as_wide")
    if held is None:
        counts = 1.0 if shape.kind is ShapeKind.BOX else _BENT
        low, middle, high = np.sort(np.ptp(shape.bounds(), axis=0)).tolist()
        part, area = (
            2 * (low * middle + (low + middle) * length) * _ROUND.get(shape.kind, 1.0)
            for length in (min(high, _SLENDER * middle), high)
        )
        wide, thickness = middle > WIDE or low < _FOIL * middle, low
        if isinstance(shape, TriMesh):
            wide, thickness = middle > WIDE, _mean_thickness(shape)
        doublings = math.ceil(math.log2(max(area / _PIECE**2 / _FEWEST, 1.0)))
        pieces = _FEWEST * 2 ** min(doublings, _DOUBLINGS)
        conductor, filled = (math.inf if wide else part * x for x in (counts, _FILLED))
        width = math.sqrt(area / _FINER)
        solid = thickness >= width * (_THIN if width < _BROAD else _THINNER)
        thick = thickness >= _THICK * math.sqrt(area / _COARSE)
        coarse = _COARSE if thick and shape.kind in _EDGELESS else _FINER
        held = _Wide(conductor, filled if solid else 0.0, area, pieces, coarse)
        shape.__dict__["_as_wide"] = held
    return held


def _mean_thickness(mesh: TriMesh) -> float:
    """Twice the volume of a closed mesh over its surface, which of a plate is its thickness [m]."""
    if not mesh.closed:
        return 0.0
    return 2.0 * abs(enclosed_volume(mesh.vertices, mesh.faces)) / _area(mesh)


def _area(mesh: TriMesh) -> float:
    """Surface of a mesh [m²]."""
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2


def wall_squares(mesh: TriMesh) -> float:
    """Surface of a closed mesh over the square of its mean thickness; 0 for an open one."""
    held: float | None = mesh.__dict__.get("_wall_squares")
    if held is None:
        area, thickness = _area(mesh), _mean_thickness(mesh)
        held = mesh.__dict__["_wall_squares"] = area / thickness**2 if thickness > 0.0 else 0.0
    return held


def wide_pieces(shape: Shape, conducting: bool, largest: float, finest: float | None = None) -> int:
    """About how many pieces a shape is cut into; 0 where it is neither wide nor a foil.

    Nor are dielectrics that are very thin for their size, or open.

    Args:
        shape: A primitive or a mesh.
        conducting: Whether it holds no field inside.
        largest: Shapes of so much surface or more [m²] are wide too; not all of long ones counts.
        finest: Edges of the pieces of conductors [m], if smaller than usual.
    """
    as_wide = _wide(shape)
    enough = (as_wide.conductor if conducting else as_wide.dielectric) >= largest
    if not enough:
        return 0
    if finest is None or not conducting or finest >= _PIECE:
        return as_wide.pieces
    doublings = math.ceil(math.log2(max(as_wide.area / finest**2 / _FEWEST, 1.0)))
    return _FEWEST * 2 ** min(doublings, _DOUBLINGS + 1)


def wide_body(
    shape: Shape, pieces: int, conducting: bool, known: FineTree | None = None
) -> FinePanelBody:
    """A wide shape, of about so many pieces, or of those that are known."""
    coarse = _wide(shape).coarse
    if known is not None:
        return FinePanelBody(known.panels, lambda: panels_of(shape, coarse), known)
    panels = panels_of(shape, pieces, merge=False)
    if isinstance(shape, Box) and not conducting:
        tiles = box_tiles(shape.size, coarse)
        parts = panels.areas / tiles.side(panels.centers) ** 2
        ahead = fine_tree(panels, parts)
        return FinePanelBody(panels, lambda: polygon_panels(tiles.polygons()), ahead)
    return FinePanelBody(panels, lambda: panels_of(shape, coarse))


class FineTree(NamedTuple):
    """Panels of a wide body in clusters."""

    panels: SurfacePanels
    """The panels, n of them."""
    clusters: Clusters
    """Clusters of all of them."""
    weights: Array
    """Charges of the panels that functions are weighted with, shape (n,)."""


def fine_tree(panels: SurfacePanels, parts: Array | None = None) -> FineTree:
    """Put panels into clusters.

    Args:
        panels: The panels.
        parts: What each counts in the order of clusters, shape (n,); by default they are breadth
            first.
    """
    tree = split(features(panels.centers, panels.normals, _most_apart(panels)), panels.areas)
    if parts is not None:
        tree = _ahead(tree, parts, _FINER)
    _, number, above = _coarsest(tree.children, tree.panel, _CLUSTERS)
    cluster = np.empty(len(panels), np.int64)
    cluster[tree.panel[tree.panel >= 0]] = number[above]
    return FineTree(panels, tree, _equilibrium(panels, cluster))


def fine_tree_of_mesh(mesh: TriMesh, pieces: int) -> FineTree:
    """About so many triangles of a mesh, in clusters."""
    return fine_tree(panels_of(mesh, pieces, merge=False))


def _ahead(tree: Clusters, parts: Array, count: int) -> Clusters:
    """Reorder clusters: those come first that are split to get ``count`` with equal sums of parts.

    Args:
        tree: Clusters, breadth first.
        parts: What each panel counts, shape (n,).
        count: So many are not split among those that come first.
    """
    total = np.zeros(len(tree.children))
    single = tree.panel >= 0
    total[single] = parts[tree.panel[single]]
    for k in np.flatnonzero(~single)[::-1].tolist():
        total[k] = total[tree.children[k]].sum()
    heap, order = [(-total[0], 0)], [0]
    while heap and len(order) < 2 * count - 1:
        children = tree.children[heappop(heap)[1]].tolist()
        if children[0] >= 0:
            order += children
            for k in children:
                heappush(heap, (-total[k], k))
    late = np.ones(len(total), np.bool_)
    late[order] = False
    old = np.concatenate([order, np.flatnonzero(late)])
    new = np.empty_like(old)
    new[old] = np.arange(len(old))
    children = np.where(tree.children < 0, -1, new[tree.children])[old]
    return Clusters(children, (children[:, 0] + 1) // 2 - (children[:, 0] < 0), tree.panel[old])


def _thickness(panels: SurfacePanels) -> tuple[float, bool]:
    """Thickness of a wide body [m], and whether it has flat sides."""
    arms = panels.centers - panels.centers.mean(axis=0)
    low = float(np.ptp(arms @ np.linalg.eigh(arms.T @ arms)[1], axis=0).min())
    thickness = panels.thickness if panels.closed else low / 3  # as of a ball
    return thickness, thickness > _FLAT * low


def _most_apart(panels: SurfacePanels) -> float:
    """How far apart opposite normals count, see :func:`features` [m]."""
    thickness, flat = _thickness(panels)
    return thickness * (FACES if flat else _LIMBS)


def _coarsest(children: Ints, panel: Ints, count: int) -> tuple[Ints, Ints, Ints]:
    """The first clusters of a tree, as far as ``count`` of them are not split among them.

    Returns:
        Parts of these clusters, -1 where they are not split, shape (t, 2); numbers of those that
        are not, shape (t,); and the one that each cluster of a single panel is in, shape (n,).
    """
    top = min(2 * count - 1, len(children))
    first = np.where(children[:top] < top, children[:top], -1)
    last = first[:, 0] < 0
    parent = np.zeros(len(children), np.int64)
    parent[children[panel < 0]] = np.flatnonzero(panel < 0)[:, None]
    above = np.flatnonzero(panel >= 0)
    while (below := above >= top).any():
        above[below] = parent[above[below]]
    return first, np.where(last, np.cumsum(last) - 1, -1), above


def _equilibrium(panels: SurfacePanels, cluster: Ints) -> Array:
    """About the charges that put all panels at one potential, from clusters of them, (n,) -> (n,).

    Limbs and edges carry more than their share of the surface. What is wrong here, functions of
    smaller clusters make right.
    """
    area: Array = np.bincount(cluster, panels.areas).astype(float)
    center = np.stack([np.bincount(cluster, panels.areas * x) / area for x in panels.centers.T])
    try:
        charge = equilibrium(patch_means(center, area), left=_LEFT)
    except SolveError:  # of faces that coincide
        return panels.areas
    return np.asarray((spread_out(charge, area) / area)[cluster] * panels.areas)


class FinePanelBody(DynamicBody):
    """A rigid shape on many panels, which meet each other without a block of energies.

    Args:
        panels: The many panels.
        coarse: Makes some hundred panels of the same shape, from which the impedance of the inside
            is found.
        known: The panels in clusters, where that is known.

    Attributes:
        weights: Charges of the panels that functions are weighted with, shape (n,).
        keep: Returns the impedance from where it is kept, or from what makes it.
    """

    def __init__(
        self,
        panels: SurfacePanels,
        coarse: Callable[[], SurfacePanels],
        known: FineTree | None = None,
    ) -> None:
        self._coarse = coarse
        self.keep: Callable[[Callable[[], Array32]], Array32] = lambda make: make()
        self._fine, tree, self.weights = known or fine_tree(panels)
        super().__init__(tree, panels, charge=self.weights)
        children, number, _ = _coarsest(tree.children, tree.panel, _CLUSTERS)
        self._points, self._softening_length = points_of_each(self._center, self._spread)
        # the body is rigid: they are needed at every step
        for name in ("points", "softening_length"):
            self.record[name] = getattr(self, f"_{name}").ctypes.data
        last = np.flatnonzero(number >= 0)
        # of rectangles: these stand badly for larger clusters, which may be bent or have limbs
        near = means_between(self._points[last])
        count = len(children)
        room = np.empty((count, len(last)), np.float32)
        self._means = np.empty(count * (count + 1) // 2, np.float32)  # large: in large pages
        tree_kernels.means_of_clusters(near, last, children, self._charge, room, self._means)
        """Means of 1/r within the body's first clusters, row by row up to the diagonal [1/m]."""
        self.record["inside"] = HALF_SPACE
        self.record["means"], self.record["top"] = self._means.ctypes.data, count

    @property
    def nbytes(self) -> int:
        """Room that the arrays and the panels take up [bytes]."""
        return super().nbytes + self._panel_bytes

    @cached_property
    def _panel_bytes(self) -> int:
        return sum(a.nbytes for a in vars(self._fine).values() if isinstance(a, np.ndarray))

    @property
    def most(self) -> float:
        """How far apart opposite normals count, see :func:`features` [m]."""
        return _most_apart(self._fine)

    @property
    def neumann_to_dirichlet(self) -> Array32:
        """As in :class:`DynamicBody`, shape (f, f).

        Z − 2F is smooth: charges within a small place that add to zero have none of it. So it is
        that of a few panels, for the charge functions of clusters as large as these and larger.
        """
        return once(self, "_impedance", lambda: self.keep(self._inside))

    def _inside(self) -> Array32:
        panels, fine, most = self._coarse(), self._fine, self.most
        with threadpool_limits(1, "blas"):  # bits depend on how many threads a BLAS has
            free = free_block(panels)
            more = impedance(panels, free) - HALF_SPACE * free
        children, number, above = _coarsest(self._children, self._panel, len(panels))
        single = np.flatnonzero(self._panel >= 0)
        at, on = (features(p.centers, p.normals, most) for p in (fine, panels))
        on = cKDTree(on).query(at)[1]
        share = self._charge[single] / self._charge[above]
        places = number[above], on[self._panel[single]]
        shares = csr_array((share, places), (number.max() + 1, len(panels)))
        block = np.ascontiguousarray(shares @ (shares @ more).T)
        tree = children, number, self._charge[: len(children)], self._function[: len(children)]
        return tree_kernels.table_of_functions(block, *tree)
