"""Checks and repairs of triangle surfaces, and whether they have an inside."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense.errors import SceneError
from capsense.scene.pose import as_float

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

_MAX_EXTENT = 10.0
_MANY = 0.01
"""Share of faces without area from which a mesh is worth a warning; exporters leave some."""
_MERGE = 1e-8


class CleanSurface(NamedTuple):
    """A triangle surface brought into order."""

    vertices: Array
    """Vertices [m], shape (n, 3)."""
    faces: Faces
    """Vertex indices, shape (m, 3); normals point out of a closed surface."""
    flaw: str
    """Why it has no inside; empty for a closed surface."""


def clean_surface(vertices: ArrayLike, faces: ArrayLike) -> CleanSurface:
    """Check a surface, bring it into order, and find out whether it has an inside.

    Coinciding vertices are merged; unused ones, faces with a repeated vertex and copies of faces
    are dropped. Faces of closed surfaces are turned so that normals point out. Where the given
    winding is consistent, it is kept up to a common sign, so cavities stay cavities.

    Args:
        vertices: Points [m], shape (n, 3).
        faces: Vertex indices, shape (m, 3).

    Raises:
        SceneError: Wrong shapes or types, a number that is not finite, an index out of range,
            or an extent above 10 m.
    """
    v, f = checked_mesh(vertices, faces)
    extent = float(np.ptp(v[f].reshape(-1, 3), axis=0).max())
    if extent > _MAX_EXTENT:
        raise SceneError(
            f"TriMesh: the mesh is {extent:g} m long; units are metres, so scale a file in "
            f"millimetres with vertices * 1e-3 (longest allowed: {_MAX_EXTENT:g} m)"
        )
    v, f = _merged(v, f)
    edge, count = _edges(f, len(v))
    if not _is_balanced(f, edge):
        once = _without_copies(f)
        if len(once) < len(f):
            f = once
            edge, count = _edges(f, len(v))
        if not _is_balanced(f, edge):
            turned = _rewound(f, v, edge, count)
            f = f if turned is None else turned
            rims = int((count == 1).sum())
            if rims:
                return CleanSurface(
                    v, f,
                    f"the surface is not closed ({rims} of {len(count)} edges have a face on one "
                    "side only)",
                )  # fmt: skip
            if not (count == 2).all():
                return CleanSurface(v, f, "more than two faces meet at some edges of the surface")
            if turned is None:
                return CleanSurface(v, f, "the surface is one-sided")
    volume = enclosed_volume(v, f)
    if abs(volume) <= 1e-12 * float(np.ptp(v, axis=0).max()) ** 3:
        return CleanSurface(v, _without_copies(f), "the surface encloses no volume")
    return CleanSurface(v, f[:, ::-1].copy() if volume < 0 else f, "")


def read_triangles(path: Path) -> tuple[Array, Faces]:
    """Vertices, shape (n, 3), and faces, shape (m, 3), of all parts of a file, in its own unit.

    Raises:
        SceneError: The file, of which the message says no more, cannot be read or is empty.
    """
    import trimesh

    try:
        mesh = trimesh.load_mesh(path, process=False)
        if isinstance(mesh, trimesh.Scene):
            mesh = mesh.to_mesh()
    except Exception as error:  # trimesh's readers raise whatever they meet
        raise SceneError(f"cannot be read: {error}") from None
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise SceneError("holds no triangles")
    return np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)


def enclosed_volume(vertices: Array, faces: Faces) -> float:
    """Volume [m³] that a closed surface encloses, positive where normals point out."""
    a, b, c = np.moveaxis(vertices[faces] - vertices[0], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def is_closed(faces: Faces, n: int) -> bool:
    """Whether faces of n vertices leave no rim and wind alike."""
    return _is_balanced(faces, _edges(faces, n)[0])


def connected_parts(faces: Faces, n: int) -> Faces:
    """Number of the connected part of each face, shape (m,); parts share none of the n vertices."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    row = np.concatenate([faces[:, 0], faces[:, 1]])
    column = np.concatenate([faces[:, 1], faces[:, 2]])
    graph = coo_matrix((np.ones(len(row), dtype=bool), (row, column)), shape=(n, n))
    label = connected_components(graph, directed=False)[1]
    _, out = np.unique(label[faces[:, 0]], return_inverse=True)
    return out.reshape(-1).astype(np.int64)


def checked_mesh(vertices: ArrayLike, faces: ArrayLike) -> tuple[Array, Faces]:
    """Check the arrays of a surface, open or closed.

    Raises:
        SceneError: Wrong shapes or types, a vertex that is not finite, an index out of range.
    """
    f = np.asarray(faces)
    if f.ndim != 2 or f.shape[1] != 3 or not len(f):
        raise SceneError(f"faces have shape {f.shape}; give (m, 3), triangles only")
    if f.dtype.kind not in "iu":
        raise SceneError(f"faces have type {f.dtype}; give integer vertex indices")
    v = checked_vertices(vertices)
    low, high = int(f.min()), int(f.max())
    if low < 0 or high >= len(v):
        raise SceneError(
            f"faces name vertices {low} to {high}, but there are {len(v)}; indices run from 0 to "
            f"{len(v) - 1}"
        )
    return v, np.ascontiguousarray(f, dtype=np.int64)


def checked_vertices(vertices: ArrayLike) -> Array:
    """Check the vertices of a surface.

    Raises:
        SceneError: Wrong shape or type, or a vertex that is not finite.
    """
    try:
        v = np.array(vertices, dtype=float, order="C")
    except (TypeError, ValueError, OverflowError):
        raise SceneError("vertices are not numbers; give shape (n, 3), metres") from None
    if v.ndim != 2 or v.shape[1] != 3:
        raise SceneError(f"vertices have shape {v.shape}; give (n, 3), metres")
    if not np.isfinite(v).all():
        bad = int(np.flatnonzero(~np.isfinite(v).all(axis=1))[0])
        raise SceneError(f"vertex {bad} is {v[bad].tolist()}, not finite")
    return v


def checked_thickness(thickness: object) -> float:
    """Check the thickness of a sheet [m].

    Raises:
        SceneError: Not a positive finite number.
    """
    number = as_float(thickness)
    if not 0 < number < np.inf:
        raise SceneError(
            f"thickness is {thickness!r}; give a positive length in metres, or None for a closed "
            "surface"
        )
    return number


def _merged(v: Array, f: Faces) -> tuple[Array, Faces]:
    """Merge coinciding vertices, drop unused ones and faces with a repeated vertex."""
    used, f = np.unique(f, return_inverse=True)
    v, f = v[used], f.reshape(-1, 3)
    cell = max(_MERGE * float(np.ptp(v, axis=0).max()), 1e-300)
    keys = np.round((v - v.min(axis=0)) / cell).astype(np.int64)
    _, first, merged = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    f = merged.reshape(-1)[f]
    repeated = (f == np.roll(f, 1, axis=1)).any(axis=1)
    if repeated.sum() > _MANY * len(f):
        warnings.warn(
            f"TriMesh: dropped {repeated.sum()} of {len(f)} faces that repeat a vertex",
            stacklevel=5,
        )
    f = f[~repeated]
    if not len(f):
        raise SceneError("TriMesh: every face repeats a vertex; are the vertices distinct?")
    return v[first], f


def _edges(f: Faces, n: int) -> tuple[Faces, Faces]:
    """Number of the edge that follows each corner, shape (3 m,), and faces at each edge."""
    start, end = f.reshape(-1), np.roll(f, -1, axis=1).reshape(-1)
    key = np.minimum(start, end) * n + np.maximum(start, end)
    _, edge, count = np.unique(key, return_inverse=True, return_counts=True)
    return edge.reshape(-1), count


def _signs(f: Faces) -> Faces:
    return np.where(f < np.roll(f, -1, axis=1), 1, -1).reshape(-1)


def _is_balanced(f: Faces, edge: Faces) -> bool:
    """Whether every edge is passed as often one way as the other: closed, and wound alike."""
    return not np.bincount(edge, weights=_signs(f)).any()


def _without_copies(f: Faces) -> Faces:
    _, first = np.unique(np.sort(f, axis=1), axis=0, return_index=True)
    return f[np.sort(first)]


def _rewound(f: Faces, v: Array, edge: Faces, count: Faces) -> Faces | None:
    """Turn faces until neighbours agree, each connected part with its normals out.

    Neighbours are faces at an edge that no third one shares. Every face is split in two states, as
    given and turned; an edge joins equal states of two faces that agree and unequal states of two
    that do not. Connected sets of states are then consistent windings. A one-sided surface joins
    both states of one face: None.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    n, sign = len(f), _signs(f)
    order = np.argsort(edge, kind="stable")
    order = order[count[edge[order]] == 2].reshape(-1, 2)
    a, b = order[:, 0] // 3, order[:, 1] // 3
    turned = np.where(sign[order[:, 0]] == sign[order[:, 1]], n, 0)
    row = np.concatenate([a, a + n])
    column = np.concatenate([b + turned, b + n - turned])
    graph = coo_matrix((np.ones(len(row)), (row, column)), shape=(2 * n, 2 * n))
    _, label = connected_components(graph, directed=False)
    if np.any(label[:n] == label[n:]):
        return None
    flip = label[:n] > label[n:]
    f = np.where(flip[:, None], f[:, ::-1], f)
    part = np.minimum(label[:n], label[n:])
    a3, b3, c3 = np.moveaxis(v[f] - v[0], 1, 0)
    volume = np.bincount(part, weights=np.einsum("ij,ij->i", a3, np.cross(b3, c3)))
    inward = volume[part] < 0
    return np.where(inward[:, None], f[:, ::-1], f)
