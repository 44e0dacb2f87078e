"""Triangle meshes from STL files: reading, welding, manifoldness, flat regions and rims."""

from __future__ import annotations

import re
from collections import defaultdict, deque
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon
from shapely.geometry.polygon import orient

from capsense._validate import read_file
from capsense.design.geometry import Facet, Surface
from capsense.errors import DesignError

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

MAX_FACETS = 20_000
WELD = 1e-9
"""Vertices that agree to this [m] are one."""
CREASE_DEGREES = 30.0
"""Edges sharper than this are rims, where charge piles up."""


def read_stl(path: Path) -> Array:
    """Triangles of a binary or ASCII STL file, in the file's unit, shape (n, 3, 3).

    Raises:
        DesignError: If the file cannot be read, or is no STL file, or has more than 20,000
            triangles.
    """
    try:
        raw = read_file(path)
    except OSError as error:
        raise DesignError(
            f"{path} cannot be read: {error.strerror}; give file relative to the design's .toml"
        ) from None
    count = int.from_bytes(raw[80:84], "little") if len(raw) >= 84 else -1
    if count >= 0 and len(raw) == 84 + 50 * count:
        record = np.dtype([("normal", "<f4", 3), ("points", "<f4", (3, 3)), ("attribute", "<u2")])
        triangles = np.frombuffer(raw, record, offset=84)["points"].astype(float)
    else:
        numbers = re.findall(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", raw, flags=re.IGNORECASE)
        if not raw.lstrip().lower().startswith(b"solid") or len(numbers) % 3:
            raise DesignError(
                f"{path} is neither a binary nor an ASCII STL file, or is cut off; export it anew"
            )
        try:
            triangles = np.array(numbers, dtype=float).reshape(-1, 3, 3)
        except ValueError:
            raise DesignError(
                f"{path} has a vertex that is not three numbers; export it anew"
            ) from None
    if len(triangles) == 0:
        raise DesignError(f"{path} has no triangles; export it anew")
    if len(triangles) > MAX_FACETS:
        raise DesignError(
            f"{path} has {len(triangles)} triangles, more than the {MAX_FACETS} allowed; "
            "export it with a coarser tolerance"
        )
    if not np.isfinite(triangles).all():
        raise DesignError(f"{path} has a vertex that is not finite; export it anew")
    return triangles


@dataclass(frozen=True, eq=False)
class SheetMesh:
    """A welded triangle mesh that is known to be a manifold sheet or shell."""

    vertices: Array
    """Vertices [m], shape (n, 3)."""
    faces: Ints
    """Vertex numbers of each triangle, shape (m, 3)."""
    pairs: Ints
    """Face numbers on both sides of each inner edge, shape (k, 2)."""
    pair_edges: Ints
    """Vertex numbers of each inner edge, shape (k, 2)."""
    opposed: NDArray[np.bool_]
    """Whether both faces of an inner edge run through it in opposite senses, shape (k,)."""
    boundary: Ints
    """Vertex numbers of each boundary edge, shape (b, 2)."""

    @property
    def closed(self) -> bool:
        """Whether there is no boundary edge: the surface of a solid."""
        return len(self.boundary) == 0

    @cached_property
    def normals(self) -> Array:
        """Unit normals, shape (m, 3)."""
        a, b, c = np.moveaxis(self.vertices[self.faces], 1, 0)
        normal = np.cross(b - a, c - a)
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)

    @cached_property
    def flatness(self) -> float:
        """How far [m] vertices of a flat region may be off its plane: single precision."""
        return max(WELD, 1.2e-7 * float(np.abs(self.vertices).max()))


def weld(triangles: Array) -> SheetMesh:
    """Weld triangles [m], shape (n, 3, 3), to a mesh and make sure that it is a manifold.

    Raises:
        DesignError: If triangles are degenerate or double, if an edge has more than two faces, or
            if the sheet has only one side.
    """
    grid = np.rint(triangles.reshape(-1, 3) / WELD).astype(np.int64)
    _, first, inverse = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    vertices = triangles.reshape(-1, 3)[first]
    faces = inverse.reshape(-1, 3).astype(np.int64)
    corners = vertices[faces]
    edges = np.roll(corners, -1, axis=1) - corners
    longest = np.linalg.norm(edges, axis=2).max(axis=1)
    height = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / np.maximum(longest, WELD)
    bad = np.flatnonzero(height < WELD)
    if len(bad):
        raise DesignError(
            f"{len(bad)} of {len(faces)} triangles are degenerate (no area), the first is number "
            f"{bad[0] + 1}; repair the mesh in CAD, or export it anew"
        )
    if len(np.unique(np.sort(faces, axis=1), axis=0)) < len(faces):
        raise DesignError("some triangles are there twice; remove double faces in CAD")

    directed = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    ordered = np.sort(directed, axis=1)
    unique, group, count = np.unique(ordered, axis=0, return_inverse=True, return_counts=True)
    if count.max() > 2:
        worst = int(np.argmax(count))
        a, b = vertices[unique[worst]] * 1e3
        raise DesignError(
            f"{np.count_nonzero(count > 2)} edges are not manifold: the edge from "
            f"({a[0]:.6g}, {a[1]:.6g}, {a[2]:.6g}) to ({b[0]:.6g}, {b[1]:.6g}, {b[2]:.6g}) mm "
            f"has {count[worst]} faces, two is the most; export one plain sheet or solid"
        )
    order = np.argsort(group.ravel(), kind="stable")
    starts = np.concatenate([[0], np.cumsum(count)[:-1]])
    inner = count == 2
    left, right = order[starts[inner]], order[starts[inner] + 1]
    opposed = directed[left, 0] != directed[right, 0]
    pairs = np.stack([left // 3, right // 3], axis=1)
    _require_two_sides(len(faces), pairs, opposed)
    return SheetMesh(vertices, faces, pairs, unique[inner], opposed, unique[~inner])


def _require_two_sides(n: int, pairs: Ints, opposed: NDArray[np.bool_]) -> None:
    """Refuse a sheet with one side: one whose faces no choice of senses makes consistent."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    a, b = pairs.T
    flip = np.where(opposed, 0, n)
    rows, cols = np.concatenate([a, a + n]), np.concatenate([b + flip, b + n - flip])
    graph = coo_matrix((np.ones(len(rows)), (rows, cols)), shape=(2 * n, 2 * n))
    label = connected_components(graph, directed=False)[1]
    if np.any(label[:n] == label[n:]):
        raise DesignError("the sheet has only one side (a Möbius strip); export a two-sided sheet")


def sheet_surface(mesh: SheetMesh) -> Surface:
    """Facets and rims of a mesh; coplanar neighbours become one polygon.

    Rims are boundary edges and edges whose faces meet at more than 30°.
    """
    facets: list[Facet] = []
    for region in flat_regions(mesh):
        facets += _region_facets(mesh, region)
    sign = np.where(mesh.opposed, 1.0, -1.0)
    a, b = mesh.pairs.T
    cosine = sign * np.einsum("ij,ij->i", mesh.normals[a], mesh.normals[b])
    sharp = mesh.pair_edges[cosine < np.cos(np.radians(CREASE_DEGREES))]
    rims = _straighten(mesh, np.concatenate([mesh.boundary, sharp]))
    return Surface(tuple(facets), rims)


def flat_regions(mesh: SheetMesh) -> list[list[int]]:
    """Face numbers of each connected flat region, grown from its largest face.

    A region grows over the neighbours that lie in its plane; then the plane is fitted anew to the
    whole region and growth goes on, so that single precision in one small face does not end it.
    """
    neighbours: dict[int, list[tuple[int, float]]] = defaultdict(list)
    for (a, b), opposed in zip(mesh.pairs.tolist(), mesh.opposed.tolist(), strict=True):
        neighbours[a].append((b, 1.0 if opposed else -1.0))
        neighbours[b].append((a, 1.0 if opposed else -1.0))
    corners = mesh.vertices[mesh.faces]
    edges = corners[:, 1:] - corners[:, :1]
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    taken = np.zeros(len(mesh.faces), dtype=bool)
    regions = []
    for seed in np.argsort(-area, kind="stable").tolist():
        if taken[seed]:
            continue
        taken[seed] = True
        normal, point = mesh.normals[seed], corners[seed, 0]
        senses, grown = {seed: 1.0}, 0
        while len(senses) > grown:
            grown = len(senses)
            queue = deque(senses)
            while queue:
                face = queue.popleft()
                for other, relative in neighbours[face]:
                    sense = senses[face] * relative
                    if taken[other] or sense * float(mesh.normals[other] @ normal) < 0.999:
                        continue
                    if np.abs((corners[other] - point) @ normal).max() <= mesh.flatness:
                        taken[other] = True
                        senses[other] = sense
                        queue.append(other)
            if len(senses) > max(grown, 1):
                normal, point = _fitted_plane(corners[list(senses)].reshape(-1, 3), normal)
        regions.append(list(senses))
    return regions


def _fitted_plane(points: Array, normal: Array) -> tuple[Array, Array]:
    """Unit normal, on the side of ``normal``, and centre of the plane nearest to the points."""
    center = points.mean(axis=0)
    fitted = np.linalg.svd(points - center, full_matrices=False)[2][2]
    return fitted * np.sign(fitted @ normal), center


def _region_facets(mesh: SheetMesh, region: list[int]) -> list[Facet]:
    corners = mesh.vertices[mesh.faces[region]]
    normal, center = mesh.normals[region[0]], corners[0].mean(axis=0)
    if len(region) > 1:
        normal, center = _fitted_plane(corners.reshape(-1, 3), normal)
    if np.ptp(corners[..., 2]) <= mesh.flatness:
        axes, origin = np.eye(3), np.array([0.0, 0.0, float(np.median(corners[..., 2]))])
    else:
        helper = np.eye(3)[int(np.argmin(np.abs(normal)))]
        u = np.cross(helper, normal)
        u /= np.linalg.norm(u)
        axes, origin = np.array([u, np.cross(normal, u), normal]), center
    flat = (corners - origin) @ axes[:2].T
    if len(region) == 1:
        return [Facet(orient(Polygon(flat[0])), origin, axes)]
    united = shapely.union_all(shapely.polygons(flat), grid_size=WELD).simplify(mesh.flatness)
    parts = [p for p in shapely.get_parts(united) if isinstance(p, Polygon)]
    return [Facet(orient(p), origin, axes) for p in parts]


def _straighten(mesh: SheetMesh, edges: Ints) -> Array:
    """Rim segments [m], shape (k, 2, 3), with straight runs of edges joined to one segment."""
    links: dict[int, set[int]] = defaultdict(set)
    for a, b in edges.tolist():
        links[a].add(b)
        links[b].add(a)
    for vertex in sorted(links):
        if len(links[vertex]) != 2:
            continue
        a, b = sorted(links[vertex])
        before = mesh.vertices[vertex] - mesh.vertices[a]
        after = mesh.vertices[b] - mesh.vertices[vertex]
        whole = mesh.vertices[b] - mesh.vertices[a]
        off = np.linalg.norm(np.cross(before, whole)) / max(float(np.linalg.norm(whole)), WELD)
        if before @ after > 0.0 and off <= mesh.flatness and b not in links[a]:
            links[a].remove(vertex)
            links[b].remove(vertex)
            links[a].add(b)
            links[b].add(a)
            del links[vertex]
    joined = [(a, b) for a in sorted(links) for b in sorted(links[a]) if a < b]
    if not joined:
        return np.empty((0, 2, 3))
    return mesh.vertices[np.array(joined)]
