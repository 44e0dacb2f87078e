"""Checks and repairs of triangle surfaces, so that "inside" has a meaning."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense.errors import SceneError

Array = NDArray[np.float64]
Faces = NDArray[np.int64]

_MAX_EXTENT = 10.0
_MERGE = 1e-8


def clean_surface(vertices: ArrayLike, faces: ArrayLike) -> tuple[Array, Faces]:
    """Check a closed surface and bring it into order.

    Coinciding vertices are merged, unused ones and faces with a repeated vertex are dropped,
    and faces are turned so that normals point out. Where the given winding is consistent, it is
    kept up to a common sign, so cavities stay cavities.

    Args:
        vertices: Points [m], shape (n, 3).
        faces: Vertex indices, shape (m, 3).

    Returns:
        Cleaned vertices and faces.

    Raises:
        SceneError: Wrong shapes or types, a number that is not finite, an index out of range,
            an extent above 10 m, a surface with holes, or one that encloses no volume.
    """
    v, f = _checked_arrays(vertices, faces)
    v, f = _merged(v, f)
    f = _consistent(f, v)
    volume = enclosed_volume(v, f)
    if abs(volume) <= 1e-12 * float(np.ptp(v, axis=0).max()) ** 3:
        raise SceneError("TriMesh: the surface encloses no volume; give a sheet some thickness")
    return v, (f[:, ::-1].copy() if volume < 0 else f)


def enclosed_volume(vertices: Array, faces: Faces) -> float:
    """Volume [m³] that a closed surface encloses, positive where normals point out."""
    a, b, c = np.moveaxis(vertices[faces] - vertices[0], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def _checked_arrays(vertices: ArrayLike, faces: ArrayLike) -> tuple[Array, Faces]:
    try:
        v = np.array(vertices, dtype=float)
    except (TypeError, ValueError):
        raise SceneError("TriMesh: vertices are not numbers; give shape (n, 3), metres") from None
    f = np.asarray(faces)
    if v.ndim != 2 or v.shape[1] != 3:
        raise SceneError(f"TriMesh: vertices have shape {v.shape}; give (n, 3), metres")
    if f.ndim != 2 or f.shape[1] != 3 or not len(f):
        raise SceneError(f"TriMesh: faces have shape {f.shape}; give (m, 3), triangles only")
    if f.dtype.kind not in "iu":
        raise SceneError(f"TriMesh: faces have type {f.dtype}; give integer vertex indices")
    f = f.astype(np.int64)
    bad = np.flatnonzero(~np.isfinite(v).all(axis=1))
    if len(bad):
        raise SceneError(f"TriMesh: vertex {bad[0]} is {v[bad[0]].tolist()}, not finite")
    bad = np.flatnonzero(((f < 0) | (f >= len(v))).any(axis=1))
    if len(bad):
        raise SceneError(
            f"TriMesh: face {bad[0]} is {f[bad[0]].tolist()}, but there are {len(v)} vertices; "
            f"indices run from 0 to {len(v) - 1}"
        )
    extent = float(np.ptp(v[f].reshape(-1, 3), axis=0).max())
    if extent > _MAX_EXTENT:
        raise SceneError(
            f"TriMesh: the mesh is {extent:g} m long; units are metres, so scale a file in "
            f"millimetres with vertices * 1e-3 (longest allowed: {_MAX_EXTENT:g} m)"
        )
    return v, f


def _merged(v: Array, f: Faces) -> tuple[Array, Faces]:
    """Merge coinciding vertices, drop unused ones and faces with a repeated vertex."""
    used, f = np.unique(f, return_inverse=True)
    v, f = v[used], f.reshape(-1, 3)
    cell = max(_MERGE * float(np.ptp(v, axis=0).max()), 1e-300)
    keys = np.round((v - v.min(axis=0)) / cell).astype(np.int64)
    _, first, merged = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    f = merged.reshape(-1)[f]
    repeated = (f == np.roll(f, 1, axis=1)).any(axis=1)
    if repeated.any():
        warnings.warn(
            f"TriMesh: dropped {repeated.sum()} of {len(f)} faces that repeat a vertex",
            stacklevel=5,
        )
        f = f[~repeated]
    if not len(f):
        raise SceneError("TriMesh: every face repeats a vertex; are the vertices distinct?")
    return v[first], f


def _consistent(f: Faces, v: Array) -> Faces:
    """Return the faces with a consistent winding, or refuse a surface that is not closed."""
    start, end = f.reshape(-1), np.roll(f, -1, axis=1).reshape(-1)
    key = np.minimum(start, end) * len(v) + np.maximum(start, end)
    sign = np.where(start < end, 1, -1)
    _, edge, count = np.unique(key, return_inverse=True, return_counts=True)
    balance = np.bincount(edge.reshape(-1), weights=sign)
    if not balance.any():
        return f
    open_edges = int((count % 2 == 1).sum())
    if open_edges or not np.all(count == 2):
        raise SceneError(
            f"TriMesh: the surface is not closed ({open_edges} of {len(count)} edges have a face "
            f"on one side only), so it has no inside; fill the holes "
            f"(trimesh.repair.fill_holes) or pass the convex hull (mesh.convex_hull)"
        )
    return _rewound(f, v, edge.reshape(-1), sign)


def _rewound(f: Faces, v: Array, edge: Faces, sign: NDArray[np.int64]) -> Faces:
    """Turn faces until neighbours agree, each connected part with its normals out.

    Every face is split in two states, as given and turned; an edge joins equal states of two
    faces that agree and unequal states of two that do not. Connected sets of states are then
    consistent windings. A one-sided surface joins both states of one face.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    n = len(f)
    order = np.argsort(edge, kind="stable").reshape(-1, 2)
    a, b = order[:, 0] // 3, order[:, 1] // 3
    turned = np.where(sign[order[:, 0]] == sign[order[:, 1]], n, 0)
    row = np.concatenate([a, a + n])
    column = np.concatenate([b + turned, b + n - turned])
    graph = coo_matrix((np.ones(len(row)), (row, column)), shape=(2 * n, 2 * n))
    _, label = connected_components(graph, directed=False)
    if np.any(label[:n] == label[n:]):
        raise SceneError("TriMesh: the surface is one-sided, so it has no inside; repair the mesh")
    flip = label[:n] > label[n:]
    f = np.where(flip[:, None], f[:, ::-1], f)
    part = np.minimum(label[:n], label[n:])
    a3, b3, c3 = np.moveaxis(v[f] - v[0], 1, 0)
    volume = np.bincount(part, weights=np.einsum("ij,ij->i", a3, np.cross(b3, c3)))
    inward = volume[part] < 0
    return np.where(inward[:, None], f[:, ::-1], f)
