"""Surfaces without energies of their own, such as depth images and cloth.

Clusters of theirs meet each other as rectangles of the same second moments, at every step. The
clusters are fixed; charge, centres and moments follow the pieces.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from capsense.field.face_kernels import Space
from capsense.scene import Layers, RestSurface, SurfaceMesh
from capsense.solver.bodies.panels import SurfacePanels
from capsense.solver.tree import tree_kernels
from capsense.solver.tree.refit_kernels import (
    Refit,
    count_halves,
    pieces_of,
    pieces_within,
    refit,
)
from capsense.solver.tree.rigid import (
    BODY,
    HALF_SPACE,
    INSIDE,
    Clusters,
    features,
    split,
)

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Ints = NDArray[np.int64]

STEP_SLOPE = 3.0
"""Slope of a surface, depth over width, from which a jump between two pixels is a step."""
_FILLED = 10.0
"""Backs farther than this [m] are not known: the image is filled from the front on."""
_PIECES = 500
"""Triangles are cut until no edge is longer than those of so many equal ones."""
_HALVINGS = 60
"""Triangles are halved at most so often."""
_LEAST_AREA = 1e-9
"""Smallest area of a piece, as a part of the mean: those that shrink to a line have none."""
_APART = 0.02
"""Opposite normals of a mesh count as twice so far apart at most [m], in telling faces apart: those
of a finger are, hands and trunks are cut across first. A cluster of one face of several fingers is
not met well as a rectangle."""
_DEMAND = 2.0
"""Functions of a mesh count from a score on that is this plus one times lower than usual: they are
weighted with areas, so that more of them are needed than of rigid bodies."""


@dataclass(frozen=True, eq=False)
class PieceArrays:
    """Small flat pieces of a surface, n of them, in the frame of their body."""

    centers: Array
    """[m], shape (n, 3)."""
    areas: Array
    """[m²], shape (n,)."""
    moments: Array
    """Second central moments of area over the area [m²], shape (n, 3, 3)."""
    corners: Array | None = None
    """Corners of triangles [m], shape (n, 3, 3); None for rectangles, which moments tell."""
    grid: tuple[int, int, int] = 0, 0, 0
    """Images, rows and columns of the first pieces, which are pixels."""


@dataclass(frozen=True, eq=False)
class PieceLayout:
    """How the n pieces of a deforming surface lie in its triangles."""

    face: Ints
    """The triangle that each lies in, shape (n,)."""
    corner: Ints
    """Vertices of the triangle that a piece belongs to, shape (n, 3)."""
    shares: Array
    """Corners of the pieces as shares of the triangle's corners, shape (n, 3, 3); empty where all
    pieces are whole triangles."""
    first: Array
    """Corners of the pieces as they were first [m], shape (n, 3, 3)."""
    longest: Array
    """Their longest edges then [m], shape (n,)."""
    least: float
    """Smallest area of a piece [m²]."""
    tree: Clusters
    """Clusters of all pieces, from the form that the surface had first."""
    order: Ints
    """The pieces, those of a cluster one after another, shape (n,)."""
    capacitance: float
    """About that of the surface in free space over 4π eps0 [m]."""


_LAYOUTS: WeakKeyDictionary[RestSurface, PieceLayout] = WeakKeyDictionary()


def mesh_pieces(shape: SurfaceMesh) -> tuple[PieceLayout, PieceArrays]:
    """The triangles of a deforming surface, long and large ones cut into parts, a piece each.

    Returns:
        How the pieces lie in the triangles, the same at every instant; and the pieces.
    """
    cut = layout_of(shape.rest)
    return cut, _pieces(shape.vertices, cut.corner, cut.shares, cut.least)


def layout_of(rest: RestSurface) -> PieceLayout:
    """How the triangles of a surface are cut into pieces; worked out once."""
    if rest not in _LAYOUTS:
        _LAYOUTS[rest] = _cut(rest)
    return _LAYOUTS[rest]


def _cut(rest: RestSurface) -> PieceLayout:
    """Halve triangles at their longest edges until all edges are short; make clusters."""
    corners = rest.vertices[rest.faces]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    ).sum() / 2  # fmt: skip
    limit = 2 * math.sqrt(area / _PIECES)
    face, shares = np.arange(len(corners)), np.tile(np.eye(3), (len(corners), 1, 1))
    for _ in range(_HALVINGS):
        points = shares @ corners[face]
        length = np.linalg.norm(np.roll(points, -1, axis=1) - points, axis=2)
        long = np.flatnonzero(length.max(axis=1) > limit * (1 + 1e-9))
        if not len(long):
            break
        start = length[long].argmax(axis=1)
        end, row = (start + 1) % 3, np.arange(len(long))
        other = shares[long]
        middle = (other[row, start] + other[row, end]) / 2
        other[row, start] = middle
        shares[long, end] = middle
        face, shares = np.concatenate([face, face[long]]), np.concatenate([shares, other])
    if len(face) == len(corners):
        shares = np.empty((0, 3, 3))
    corner = np.ascontiguousarray(rest.faces[face])
    found = _pieces(rest.vertices, corner, shares, 0.0)
    assert found.corners is not None
    least = max(_LEAST_AREA * float(found.areas.mean()), 1e-300)
    areas = np.maximum(found.areas, least)
    edges = np.roll(found.corners, -1, axis=1) - found.corners
    tree = split(features(found.centers, normals_of(found.corners), _APART), areas)
    size = DynamicBody(tree, PieceArrays(found.centers, areas, found.moments)).capacitance
    # pieces stand in the order of their clusters, so that memory is read from end to end
    single = np.flatnonzero(tree.panel >= 0)
    at = tree.panel[single]
    tree.panel[single] = np.arange(len(at))
    return PieceLayout(
        face[at], corner[at], shares[at] if len(shares) else shares, found.corners[at],
        np.linalg.norm(edges[at], axis=2).max(axis=1), least, tree,
        tree_kernels.in_order(tree.children, tree.panel), size,
    )  # fmt: skip


def _pieces(vertices: Array, corner: Ints, shares: Array, least: float) -> PieceArrays:
    """Pieces, see :class:`PieceLayout`."""
    n = len(corner)
    out = np.empty((n, 3)), np.empty(n), np.empty((n, 3, 3)), np.empty((n, 3, 3))
    pieces_of(np.ascontiguousarray(vertices), corner, shares, *out)
    return PieceArrays(out[0], np.maximum(out[1], least), out[2], out[3])


def normals_of(corners: Array) -> Array:
    """Unit normals of triangles, (n, 3, 3) -> (n, 3)."""
    out = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(out / np.maximum(np.linalg.norm(out, axis=1), 1e-300)[:, None])


def layer_pieces(layers: Layers) -> tuple[Clusters, PieceArrays, NDArray[np.bool_], float]:
    """The surfaces that a layered image shows, a piece a pixel.

    Backs count where they lie farther behind than two pixels are wide, and before 10 m; there, the
    sides between front and back count too, at pixels whose neighbour begins farther behind. Where
    every back is nearer than that, the image is one of a sheet.

    Returns:
        Clusters of all pixels; the pieces; which of them there are; and the mean thickness of a
        sheet [m], 0 for the surface of a solid.
    """
    dx, dy = layers.pixel
    front, back = layers.front.astype(float), layers.back.astype(float)
    deep = back - front > 2 * max(dx, dy)
    known = deep & (back < _FILLED)
    back = np.where(known, back, np.nan)[known.any(axis=(1, 2))]
    depth = np.concatenate([front, back])
    slope_x, slope_y = _slopes(depth, 2, dx), _slopes(depth, 1, dy)
    centers, moments = np.empty((*depth.shape, 3)), np.zeros((*depth.shape, 3, 3))
    centers[..., 0], centers[..., 1] = _pixel_centers(layers)
    centers[..., 2] = depth
    areas = dx * dy * np.sqrt(1 + slope_x**2 + slope_y**2)
    moments[..., 0, 0], moments[..., 1, 1] = dx * dx / 12, dy * dy / 12
    moments[..., 0, 2] = moments[..., 2, 0] = dx * dx / 12 * slope_x
    moments[..., 1, 2] = moments[..., 2, 1] = dy * dy / 12 * slope_y
    moments[..., 2, 2] = (dx * slope_x) ** 2 / 12 + (dy * slope_y) ** 2 / 12
    if len(back):
        sides = _sides(layers, front, np.where(known, layers.back, np.nan))
        centers, areas, moments = (
            np.concatenate(both) for both in zip((centers, areas, moments), sides, strict=True)
        )
    wanted = ~np.isnan(centers[..., 2])
    sheet = 0.0 if deep.any() else layers.volume / float(areas[wanted].sum())
    centers[..., 2][~wanted] = 0.0
    centers, moments = centers.reshape(-1, 3), moments.reshape(-1, 3, 3)
    pieces = PieceArrays(centers, areas.ravel(), moments, grid=depth.shape)
    tree = _pixel_tree(len(depth), (len(wanted) - len(depth)) // 4, *front.shape[1:], dx / dy)
    return tree, pieces, wanted.ravel(), sheet


def _pixel_centers(layers: Layers) -> tuple[Array, Array]:
    """Coordinates x and y of the pixels [m], shapes (columns,) and (rows, 1)."""
    (dx, dy), (rows, columns) = layers.pixel, layers.resolution
    x = (np.arange(columns, dtype=np.float64) + 0.5) * dx - 0.5 * layers.size[0]
    y = (np.arange(rows, dtype=np.float64) + 0.5) * dy - 0.5 * layers.size[1]
    return x, y[:, None]


def _sides(layers: Layers, front: Array, back: Array) -> tuple[Array, Array, Array]:
    """Upright rectangles at the edges of pixels, from the front to the back or the neighbour.

    Args:
        layers: The image.
        front, back: Depths [m], NaN where nothing is or no back is known, (slots, rows, columns).

    Returns:
        Centres [m], (4 slots, rows, columns, 3), NaN where there is no side; areas [m²]; moments.
    """
    pitch = layers.pixel
    shape = (4 * len(front), *front.shape[1:])
    centers, areas, moments = np.full((*shape, 3), np.nan), np.ones(shape), np.zeros((*shape, 3, 3))
    first = 0
    for axis, along in ((0, 2), (1, 1)):
        for way in (-1, 1):
            beside = np.roll(np.where(np.isnan(front), np.inf, front), -way, axis=along)
            rim: list[int | slice] = [slice(None)] * 3
            rim[along] = -1 if way > 0 else 0
            beside[tuple(rim)] = np.inf
            end = np.minimum(back, beside)
            tall = np.where(end - front > STEP_SLOPE * pitch[axis], end - front, np.nan)
            part = slice(first, first + len(front))
            first += len(front)
            centers[part, ..., 0], centers[part, ..., 1] = _pixel_centers(layers)
            centers[part, ..., axis] += 0.5 * way * pitch[axis]
            centers[part, ..., 2] = front + 0.5 * tall
            areas[part] = pitch[1 - axis] * np.nan_to_num(tall, nan=1.0)
            moments[part, ..., 1 - axis, 1 - axis] = pitch[1 - axis] ** 2 / 12
            moments[part, ..., 2, 2] = np.nan_to_num(tall) ** 2 / 12
    return centers, areas, moments


def _slopes(depth: Array, axis: int, pitch: float) -> Array:
    """Slope of depth images, NaN where nothing is; beside a step, that on the near side."""
    step = np.diff(depth, axis=axis) / pitch
    none = np.full_like(depth.take([0], axis), np.nan)
    before, after = np.concatenate([none, step], axis), np.concatenate([step, none], axis)
    steep = (np.abs(before) > STEP_SLOPE) | (np.abs(after) > STEP_SLOPE)
    smaller = np.where(np.abs(before) < np.abs(after), before, after)
    out = np.where(steep, smaller, 0.5 * (before + after))
    out = np.where(np.isnan(before), after, np.where(np.isnan(after), before, out))
    return np.clip(np.nan_to_num(out), -STEP_SLOPE, STEP_SLOPE)


@lru_cache(maxsize=16)
def _pixel_tree(views: int, sides: int, rows: int, columns: int, ratio: float) -> Clusters:
    """Clusters of the pixels of images that lie behind each other, and of their sides.

    The sides of an image, ``sides`` for each of four directions as of :func:`_sides`, go with the
    fronts: on slanting edges and steep faces, they take turns.
    """
    view, row, column = np.indices((views + 4 * sides, rows, columns)).astype(float)
    for direction, (x, y) in enumerate(((-0.5, 0), (0.5, 0), (0, -0.5), (0, 0.5))):
        of = slice(views + direction * sides, views + (direction + 1) * sides)
        column[of] += x
        row[of] += y
        view[of] -= views + direction * sides
    view, row, column = view.ravel(), row.ravel(), column.ravel()
    far = 2.0 * max(rows, columns * ratio)
    features = np.zeros((len(view), 6))
    features[:, :3] = np.stack([column * ratio, row, far * view], axis=1)
    return split(features, np.ones(len(view)))


OWN = 4.0
"""Energy of a charge function times the extent of its cluster, as far as scores need it."""


class DynamicBody:
    """A surface of pieces as the step takes it; ``record`` points to arrays that are held here.

    Args:
        tree: Clusters of all pieces.
        surface: The pieces as they are now.
        wanted: Which of them count, at least one, shape (n,); all by default.
        sheet: Thickness of an open sheet [m]; 0 for the surface of a solid.
        charge: Charges of the pieces, above zero, shape (n,); by default they go with the areas.
    """

    def __init__(
        self,
        tree: Clusters,
        surface: PieceArrays | SurfacePanels,
        wanted: NDArray[np.bool_] | None = None,
        sheet: float = 0.0,
        charge: Array | None = None,
    ) -> None:
        self.sheet = sheet
        self.pieces = surface if isinstance(surface, PieceArrays) else None
        n = len(surface.areas)
        self._children, self._panel, self._function = tree.children, tree.panel, tree.function
        if wanted is not None and not wanted.all():
            self._children, self._panel, self._function = (
                np.empty_like(a) for a in (tree.children, tree.panel, tree.function)
            )
            n = tree_kernels.prune(
                tree.children, tree.panel, wanted, self._children, self._panel, self._function,
                np.empty((2, len(tree.children)), np.int64),
            )  # fmt: skip
            self._children, self._panel, self._function = (
                np.ascontiguousarray(a[: 2 * n - 1])
                for a in (self._children, self._panel, self._function)
            )
        nodes = 2 * n - 1
        single = self._panel >= 0
        at = self._panel[single]
        self._charge, self._center, self._spread = (
            np.empty(nodes),
            np.empty((nodes, 3)),
            np.empty((nodes, 3, 3)),
        )
        self._charge[single] = (surface.areas if charge is None else charge)[at]
        self._center[single], self._spread[single] = surface.centers[at], surface.moments[at]
        tree_kernels.moments(self._children, self._panel, self._charge, self._center, self._spread)
        extent = np.sqrt(6.0 * np.trace(self._spread, axis1=1, axis2=2)) + 1e-9
        self._extent = extent
        self.capacitance = 0.35 * float(extent[0])
        """About that in free space over 4π eps0 [m]."""
        self._own = np.empty(n)
        self._own[0] = 0.5 * OWN / extent[0]
        self._own[self._function[~single]] = OWN / extent[~single]
        record = np.zeros(1, BODY)[0]
        record["n"], record["n_panel_clusters"], record["scale"] = n, nodes, 1.0
        record["inside"] = INSIDE if sheet == 0.0 else 0.0
        record["capacitance"] = self.capacitance
        for name in ("children", "function", "charge", "center", "spread", "own", "extent"):
            record[name] = getattr(self, f"_{name}").ctypes.data
        if sheet > 0.0:
            self._faces = np.zeros(n)  # of an image
            record["faces"] = self._faces.ctypes.data
        self.record = record

    table: Array32 | None = None
    """See :attr:`neumann_to_dirichlet`."""

    @property
    def neumann_to_dirichlet(self) -> Array32 | None:
        """What the inside has beyond ``record["inside"]`` times the energy, if that is known."""
        return self.table

    @cached_property
    def order(self) -> Ints:
        """The pieces that count, those of a cluster one after another, shape (n,)."""
        return tree_kernels.in_order(self._children, self._panel)

    @property
    def radius(self) -> float:
        """Radius of a ball about the origin that holds the surface [m]."""
        single = self._panel >= 0
        off = np.linalg.norm(self._center[single], axis=1)
        return float((off + 0.75 * self._extent[single]).max())

    @property
    def nbytes(self) -> int:
        """Room that the arrays take up [bytes]."""
        z = self.__dict__.get("_impedance")
        return self._made + (0 if z is None else z.nbytes)

    @cached_property
    def _made(self) -> int:
        """That of all but the impedance, which may come later."""
        held = (a for name, a in self.__dict__.items() if name != "_impedance")
        return sum(a.nbytes for a in held if isinstance(a, np.ndarray))


def _on_both_faces(area: Array, thickness: float) -> Array:
    """Energy of unit charge on a sheet, less that of half of it on either face [1/m].

    With wave number k along the sheet, charge on both faces has (1 + exp(-k t)) / 2 of the energy
    2π σ² / k per area that it has in the middle, π t σ² less where parts are large. Where they are
    small, half is lost; parts count as squares, and a fraction joins both limits.
    """
    square = 4.0 * math.asinh(1.0) + 4.0 / 3.0 * (1.0 - math.sqrt(2.0))  # mean of 1/r in one of 1 m
    return math.pi * thickness / (area + 2.0 * math.pi / square * thickness * np.sqrt(area))


class MeshBody(DynamicBody):
    """A deforming mesh at one instant. Where it stands, :meth:`enter` completes its record.

    Args:
        shape: The mesh.
        conducting: Whether it is a conductor. Triangles of others are not divided near a design:
            what is known of their inside is that of their pieces.
    """

    def __init__(self, shape: SurfaceMesh, conducting: bool) -> None:
        self.sheet = 0.0 if shape.closed else shape.rest.thickness
        self._layout, self.vertices = layout_of(shape.rest), np.ascontiguousarray(shape.vertices)
        self.capacitance, self._divided = self._layout.capacitance, conducting
        self.record = np.zeros(1, BODY)[0]
        self.record["scale"], self.record["capacitance"] = 1.0, self.capacitance
        self.record["inside"] = HALF_SPACE if self.sheet == 0.0 else 0.0
        self.record["demand"] = _DEMAND if conducting else 0.0

    def enter(self, record: np.void, space: Space, finest: float) -> NamedTuple:
        """Complete the record of the mesh where it stands; clusters near a design are divided.

        Args:
            record: Where it stands; changed.
            space: Surroundings of the design.
            finest: Triangles with no edge longer than this at rest stay whole [m].

        Returns:
            What the record points to.
        """
        made = self._refit(record, space, finest if self._divided else math.inf)
        _point(record, made)
        if self._divided or self.sheet == 0.0:
            return made
        out = SheetArrays(_faces(made, self.sheet), made)
        _point(record, out)
        return out

    def _refit(self, record: np.void, space: Space, finest: float) -> Refit:
        """Clusters where the mesh stands; their numbers are entered."""
        cut = self._layout
        place = record["scale"] * record["rotation"], record["position"].copy()
        pieces = cut.corner, cut.shares, cut.first, cut.longest
        halves = count_halves(self.vertices, pieces, place, space, finest)
        tree = cut.tree.children, cut.tree.function, cut.tree.panel
        limits = cut.least, finest, OWN
        made = refit(self.vertices, pieces, tree, halves, place, space, limits)
        record["n"], record["n_panel_clusters"] = len(made.own), len(made.charge)
        return made

    def corners_within(
        self, turn: Array, position: Array, walls: Array, low: float, high: float
    ) -> Array | None:
        """Corners of the pieces that reach between walls and below a height [m], (k, 3, 3).

        Args:
            turn, position: Where the mesh stands: rotation, times its size, and position.
            walls: Along x and y, shape (2, 2).
            low, high: Heights; None is returned where nothing reaches below the first.
        """
        at = self.vertices @ turn.T + position
        if at[:, 2].min() >= low:
            return None
        cut = self._layout
        chosen = pieces_within(at, cut.corner, cut.order, walls, high)
        corners = self.vertices[cut.corner[chosen]]
        return corners if not len(cut.shares) else cut.shares[chosen] @ corners

    @property
    def nbytes(self) -> int:
        """Room that the vertices take up [bytes]."""
        return self.vertices.nbytes


class SheetArrays(NamedTuple):
    """What records of thin sheets of dielectrics have beside those of :class:`Refit`."""

    faces: Array
    """By how much energies of functions are less as charge is on both faces [1/m], shape (f,)."""
    clusters: Refit


def _faces(made: Refit, thickness: float) -> Array:
    """See :class:`SheetArrays`; of parts in the middle of a sheet so thick [m]."""
    out, split_ = np.zeros(len(made.own)), made.function >= 0
    less = _on_both_faces(made.charge, thickness)
    out[made.function[split_]] = less[made.children[split_]].sum(axis=1)
    return out


class LayerArrays(NamedTuple):
    """What records of layers of dipoles have beside those of :class:`Refit`; k clusters."""

    normals: Array
    """Mean normals of clusters, shape (k, 3)."""
    own: Array
    """Energy of each function across the sheet [1/m], shape (f,)."""
    pieces: Array
    """Of each piece three points [m], its normal and its area [m²], shape (n, 13)."""
    clusters: Refit


class DipoleLayer(MeshBody):
    """The dipoles across a thin sheet of a dielectric, on the clusters of its charges.

    A charge function is an even layer of charge on the front of its cluster, and the opposite one
    on the back; see ``interaction.layer_kernels``.

    Args:
        shape: The sheet.
    """

    def __init__(self, shape: SurfaceMesh) -> None:
        super().__init__(shape, False)
        self._thickness, self.sheet = self.sheet, 0.0
        self.record["layer"] = self._thickness

    def enter(self, record: np.void, space: Space, finest: float) -> NamedTuple:
        """Complete the record of the layer, as of :meth:`MeshBody.enter`."""
        made, cut = self._refit(record, space, math.inf), self._layout
        pieces = _pieces(self.vertices, cut.corner, cut.shares, cut.least)
        assert pieces.corners is not None
        normal, split_ = normals_of(pieces.corners), cut.tree.panel < 0
        normals = np.empty((len(made.charge), 3))
        normals[~split_] = normal[cut.tree.panel[~split_]]
        tree_kernels.means(made.children, made.charge, normals)
        across = 4.0 * math.pi * self._thickness
        own = np.empty(len(made.own))
        own[0] = across / made.charge[0]
        first, second = made.charge[made.children[split_]].T
        own[made.function[split_]] = across * (1.0 / first + 1.0 / second)
        inner = pieces.centers[:, None] + 0.5 * (pieces.corners - pieces.centers[:, None])
        whole = np.concatenate(  # which are good to the second order, at Gauss points
            [inner.reshape(-1, 9), normal, pieces.areas[:, None]], axis=1
        )
        out = LayerArrays(normals, own, whole, made)
        _point(record, made)
        _point(record, out)
        return out


def _point(record: np.void, arrays: NamedTuple) -> None:
    """Let the fields of a record point to arrays of these names."""
    for name, values in arrays._asdict().items():
        if isinstance(values, np.ndarray):  # `.ctypes` takes much longer
            record[name] = values.__array_interface__["data"][0]
