"""Primitives, triangle meshes and terrains of simulators, made into solids."""

from __future__ import annotations

import math
import warnings
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense.errors import SceneError
from capsense.scene import Box, Capsule, Cylinder, Ellipsoid, Shape, Sphere, TriMesh
from capsense.scene.surface import Faces, connected_parts, read_triangles

Array = NDArray[np.float64]

_TILE = 0.3
"""Tiles of a terrain, from one to the next of which another part of it is seen, are about so wide
[m], or a cell if that is wider."""
_WIDE = 0.4
"""Of terrains of larger half extents [m], the part around the sensor is given out."""
_KEPT = 8
"""So many parts of a terrain are kept, with all that was worked out for them."""


class UnusableShape(SceneError):
    """A shape of a model that can be left out: it has no volume, or its file cannot be read."""


def primitive(kind: str, sizes: Sequence[float]) -> Shape | None:
    """The primitive of a simulator, or None for other kinds.

    Args:
        kind: ``"SPHERE"``, ``"CAPSULE"``, ``"CYLINDER"``, ``"ELLIPSOID"`` or ``"BOX"``.
        sizes: Three numbers [m] as MuJoCo and Newton give them: half edges or semi-axes; for a
            round shape its radius and its half length along z.
    """
    a, b, c = sizes
    if kind == "SPHERE" or (kind == "CAPSULE" and b <= 0):
        return Sphere(a)
    if kind == "CAPSULE":
        return Capsule(a, 2 * b)
    if kind == "CYLINDER":
        return Cylinder(a, 2 * b)
    if kind == "ELLIPSOID":
        return Ellipsoid((a, b, c))
    return Box((2 * a, 2 * b, 2 * c)) if kind == "BOX" else None


def solid_mesh(vertices: ArrayLike, faces: ArrayLike, label: str, *, hull: bool = False) -> TriMesh:
    """A solid from a triangle mesh.

    Args:
        vertices: Points [m], shape (n, 3).
        faces: Vertex indices, shape (m, 3).
        label: What it is called, for messages.
        hull: Take the convex hull instead of the surface itself.

    Raises:
        SceneError: The mesh is not a closed surface of sound size.
    """
    if hull:
        vertices, faces = _hull(np.asarray(vertices, dtype=float), label)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # faces of no area are usual, and harmless
            return TriMesh(vertices, faces)
    except SceneError as error:
        raise SceneError(
            f"{label!r}: {error}; or take its convex hull with hull=[{label!r}], or leave it "
            f"out with exclude=[{label!r}]"
        ) from None


def load_triangles(path: str | Path, scale: ArrayLike, label: str) -> tuple[Array, Faces]:
    """Vertices [m] and faces of a mesh file, all its parts together.

    Args:
        path: The file, of any kind that trimesh reads.
        scale: Factors along x, y, z that turn its unit into metres, shape (3,).
        label: What it is called, for messages.

    Raises:
        SceneError: The file is missing or unreadable, or holds no triangles.
    """
    file = Path(path)
    if not file.is_file():
        raise SceneError(
            f"{label!r}: there is no mesh file {file}; exclude it, or correct its path"
        )
    try:
        vertices, faces = read_triangles(file)
    except SceneError as error:
        raise UnusableShape(f"{label!r}: {file} {error}") from None
    return vertices * np.asarray(scale, dtype=float), faces


def is_flat(vertices: ArrayLike) -> bool:
    """Whether points, shape (n, 3), lie in a plane to within a millionth of their extent."""
    v = np.asarray(vertices, dtype=float)
    spread = np.linalg.svd(v - v.mean(axis=0), compute_uv=False)
    return len(spread) < 3 or bool(spread[2] <= 1e-6 * spread[0])


def height_field(heights: ArrayLike, size: ArrayLike, base: float) -> tuple[Array, Array]:
    """A closed surface around a terrain: its top, side walls and a flat bottom.

    Args:
        heights: Heights [m] over z = 0 of its frame, rows along y and columns along x,
            shape (rows, columns), at least 2 × 2.
        size: Half extents of the terrain along x and y [m], shape (2,).
        base: Depth of the bottom below z = 0 [m], positive.

    Returns:
        Vertices [m], shape (2 · rows · columns, 3), and faces, normals out.
    """
    z = np.asarray(heights, dtype=float)
    rows, columns = z.shape
    half_x, half_y = np.asarray(size, dtype=float)
    x, y = np.meshgrid(np.linspace(-half_x, half_x, columns), np.linspace(-half_y, half_y, rows))
    n = rows * columns
    vertices = np.empty((2 * n, 3))
    vertices[:, 0], vertices[:, 1] = np.tile(x.ravel(), 2), np.tile(y.ravel(), 2)
    vertices[:n, 2], vertices[n:, 2] = z.ravel(), -base
    index = np.arange(n).reshape(rows, columns)
    a, b = index[:-1, :-1].ravel(), index[:-1, 1:].ravel()
    c, d = index[1:, 1:].ravel(), index[1:, :-1].ravel()
    top = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    rim = np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])
    ahead = np.roll(rim, -1)
    walls = np.concatenate(
        [np.stack([rim, rim + n, ahead], axis=1), np.stack([ahead, rim + n, ahead + n], axis=1)]
    )
    return vertices, np.concatenate([top, top[:, ::-1] + n, walls])


@dataclass(frozen=True, eq=False)
class Terrain:
    """A height field, of which a part around the sensor is given out."""

    heights: Array
    """Heights [m] over z = 0 of its frame, rows along y and columns along x, (rows, columns)."""
    half: tuple[float, float]
    """Half extents along x and y [m]."""
    base: float
    """Depth of its floor below z = 0 [m]."""
    solid: bool
    """Whether parts have walls and a floor, as matter that does not conduct must have."""
    label: str
    """What it is called, for messages."""
    _parts: OrderedDict[tuple[int, int, int, int], TriMesh] = field(
        default_factory=OrderedDict, repr=False
    )

    def bounds(self) -> Array:
        """Lower and upper corner of the bounding box [m] in its frame, shape (2, 3)."""
        x, y = self.half
        low, high = float(self.heights.min()), float(self.heights.max())
        return np.array([[-x, -y, min(low, -self.base)], [x, y, high]])

    def tiles(self, centres: Array) -> NDArray[np.int64]:
        """Numbers of the tiles along x and y that points, shape (..., 3), are over."""
        out = np.empty((*centres.shape[:-1], 2), np.int64)
        for axis in (0, 1):
            out[..., axis] = self._first(axis, centres[..., axis]) // self._cells(axis)
        return out

    def near(self, centre: Array, reach: float) -> TriMesh:
        """The part within a distance [m] along x and y of the tile that a point (3,) is over.

        It is the same mesh for all points over a tile: its charge functions are made once.
        """
        columns, rows = (self._nodes(axis, centre[axis], reach) for axis in (0, 1))
        key = rows.start, rows.stop, columns.start, columns.stop
        if key in self._parts:
            self._parts.move_to_end(key)
            return self._parts[key]
        part = self.heights[rows, columns]
        half = [0.5 * self._cell(axis) * (n - 1) for axis, n in enumerate(part.shape[::-1])]
        vertices, faces = height_field(part, half, self.base)
        for axis, nodes in enumerate((columns, rows)):
            vertices[:, axis] += nodes.start * self._cell(axis) - self.half[axis] + half[axis]
        if not self.solid:
            faces = faces[: 2 * (part.shape[0] - 1) * (part.shape[1] - 1)]
        mesh = self._parts[key] = solid_mesh(vertices, faces, self.label)
        if len(self._parts) > _KEPT:
            self._parts.popitem(last=False)
        return mesh

    def _cell(self, axis: int) -> float:
        """Width of a cell along x (0) or y (1) [m]."""
        return 2.0 * self.half[axis] / (self.heights.shape[1 - axis] - 1)

    def _nodes(self, axis: int, at: float, reach: float) -> slice:
        """Rows or columns of the part that is seen from a place [m] along an axis."""
        width, cells, many = self._cell(axis), self.heights.shape[1 - axis] - 1, self._cells(axis)
        more, first = math.ceil(reach / width), int(self._first(axis, np.asarray(at)))
        return slice(max(0, first - more), min(cells, first + many + more) + 1)

    def _cells(self, axis: int) -> int:
        """How many cells a tile has along x (0) or y (1)."""
        return max(1, round(_TILE / self._cell(axis)))

    def _first(self, axis: int, at: Array) -> Any:
        """First cells of the tiles that places [m] along an axis are over."""
        width, cells, many = self._cell(axis), self.heights.shape[1 - axis] - 1, self._cells(axis)
        place = np.minimum(np.maximum(at + self.half[axis], 0.0), (cells - 0.5) * width)
        return (place / (many * width)).astype(np.int64) * many


def terrain_shape(
    heights: Array, half: tuple[float, float], base: float, label: str, *, solid: bool
) -> TriMesh | Terrain:
    """A terrain, or the whole of it as a mesh where it is small; arguments as of its fields."""
    if max(half) > _WIDE:
        return Terrain(heights, half, base, solid, label)
    return solid_mesh(*height_field(heights, half, base), label)


def joined_hulls(vertices: ArrayLike, faces: ArrayLike, label: str) -> tuple[Array, Array]:
    """The convex hulls of the connected parts of a mesh, as one mesh.

    Parts hang together by corners at the same place. Flat ones, such as stray triangles, have
    no inside and are dropped.

    Raises:
        SceneError: No part has a volume.
    """
    v, f = np.asarray(vertices, dtype=float), np.asarray(faces)
    places, same = np.unique(v.round(9), axis=0, return_inverse=True)
    part = connected_parts(same.reshape(-1)[f], len(places))
    all_vertices, all_faces, count = [], [], 0
    for k in range(part.max() + 1):
        points = v[np.unique(f[part == k])]
        try:
            points, triangles = _hull(points, label)
        except SceneError:
            continue
        all_vertices.append(points)
        all_faces.append(triangles + count)
        count += len(points)
    if not count:
        raise UnusableShape(f"{label!r} has no part with a volume; is it flat?")
    return np.concatenate(all_vertices), np.concatenate(all_faces)


def round_cylinder(vertices: ArrayLike) -> Cylinder | None:
    """The cylinder along z that a prism stands for, or None for anything else.

    Bullet makes prisms of the cylinders of a URDF, with 32 corners on either end.

    Args:
        vertices: Points [m], shape (n, 3).
    """
    v = np.asarray(vertices, dtype=float)
    radius, half = np.hypot(v[:, 0], v[:, 1]), np.abs(v[:, 2])
    size = max(float(radius.max()), float(half.max()))
    slack = 1e-3 * size
    if len(v) != 64 or np.ptp(radius) > slack or np.ptp(half) > slack or half.max() <= slack:
        return None
    return Cylinder(float(radius.max()), 2 * float(half.max()))


def _hull(vertices: Array, label: str) -> tuple[Array, Array]:
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(vertices)
    except (QhullError, ValueError) as error:
        reason = str(error).partition("\n")[0]
        raise UnusableShape(f"{label!r} has no convex hull with a volume: {reason}") from None
    kept = np.unique(hull.simplices)
    return vertices[kept], np.searchsorted(kept, hull.simplices)


_SIDES = 8
"""Sides of the tube that stands for a cable."""


def tube(points: Array, radius: float, sides: int = _SIDES) -> Array:
    """Vertices of a tube along a line, of the cross-section of a round one.

    Rings are carried from point to point without twist (the double reflection of Wang et al.,
    *Computation of Rotation Minimizing Frames*, ACM Transactions on Graphics 27, 2008), so that
    they move smoothly with the points.

    Args:
        points: Points of the line [m], shape (n, 3), at least two.
        radius: Of the round cross-section [m].
        sides: How many flat sides it has.

    Returns:
        Shape (n * sides + 2, 3): the rings, then the middles of both ends.
    """
    n = len(points)
    way = np.gradient(points, axis=0)
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-300)
    across = np.empty((n, 3))
    across[0] = np.eye(3)[np.abs(way[0]).argmin()]
    across[0] -= (across[0] @ way[0]) * way[0]
    across[0] /= np.linalg.norm(across[0])
    for k in range(n - 1):
        first = points[k + 1] - points[k]
        size = max(float(first @ first), 1e-300)
        left = across[k] - 2 / size * (first @ across[k]) * first
        turned = way[k] - 2 / size * (first @ way[k]) * first
        second = way[k + 1] - turned
        size = max(float(second @ second), 1e-300)
        across[k + 1] = left - 2 / size * (second @ left) * second
    angle = 2 * math.pi / sides * np.arange(sides)
    reach = radius * math.sqrt(angle[1] / math.sin(angle[1]))  # of equal area
    other = np.cross(way, across)
    ring = np.cos(angle)[:, None] * across[:, None] + np.sin(angle)[:, None] * other[:, None]
    rings = points[:, None] + reach * ring
    return np.concatenate([rings.reshape(-1, 3), points[[0, -1]]])


def tube_faces(count: int, sides: int = _SIDES) -> Faces:
    """Triangles of :func:`tube` along ``count`` points, shape (2 count sides, 3)."""
    a = np.arange(count * sides).reshape(count, sides)
    low, high = a[:-1], a[1:]
    low_next, high_next = np.roll(low, -1, axis=1), np.roll(high, -1, axis=1)
    parts = [
        np.stack([low, low_next, high_next], axis=-1).reshape(-1, 3),
        np.stack([low, high_next, high], axis=-1).reshape(-1, 3),
    ]
    for ring, middle, way in ((a[0], count * sides, -1), (a[-1], count * sides + 1, 1)):
        parts.append(np.stack([np.full(sides, middle), np.roll(ring, way), ring], axis=-1))
    return np.concatenate(parts)


def path_order(lines: NDArray[np.integer[Any]]) -> NDArray[np.int64] | None:
    """Points of line segments (n, 2) from end to end; None where they are no open path."""
    beside: dict[int, list[int]] = {}
    for a, b in lines.tolist():
        beside.setdefault(a, []).append(b)
        beside.setdefault(b, []).append(a)
    ends = [k for k, others in beside.items() if len(others) == 1]
    if len(ends) != 2 or len(beside) != len(lines) + 1:
        return None
    order = [min(ends)]
    while len(order) < len(beside):
        ahead = [k for k in beside[order[-1]] if len(order) == 1 or k != order[-2]]
        if len(ahead) != 1:
            return None
        order.append(ahead[0])
    return np.array(order, dtype=np.int64)
