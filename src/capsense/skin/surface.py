"""Points spread over the outer surface of a link, and how the surface bends there."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import KDTree

from capsense._validate import UNITS
from capsense.errors import SceneError
from capsense.scene.surface import checked_mesh, read_triangles

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

_PER_PATCH = 60
"""Samples of the surface on the area of one patch,"""
_SAMPLES = (4_000, 200_000)
"""and the least and the most of them."""
_EDGE = 0.2
"""The mean of a patch's samples lies off its middle by less than this part of its radius, or an
edge of the link crosses it."""
_OFF_SURFACE = 1e-6
"""Rays start this far [m] off the surface."""
_ROUND = 0.3
"""Principal directions count where the curvatures times the radius differ by this."""


class LinkMesh(NamedTuple):
    """The triangles of a link."""

    vertices: Array
    """[m] in the frame of the link, shape (n, 3)."""
    faces: Ints
    """Vertex indices, shape (m, 3)."""


class Samples(NamedTuple):
    """Points on a surface."""

    points: Array
    """[m], shape (n, 3)."""
    normals: Array
    """Unit normals of their faces, out of the link, shape (n, 3)."""


class Fit(NamedTuple):
    """The frames of patches, and how the surface is curved there."""

    rotation: Array
    """Columns are the axes of each frame: x along the strongest convex curvature, z out of the
    link, shape (n, 3, 3)."""
    curvature: Array
    """Along x and y [1/m], positive where convex, shape (n, 2)."""


def read_link(link: object, unit: str) -> LinkMesh:
    """The triangles of a mesh file, a ``TriMesh``, or anything with ``vertices`` and ``faces``.

    Raises:
        SceneError: There is no such file, it cannot be read, or the arrays are wrong.
    """
    if unit not in UNITS:
        raise SceneError(f"unit is {unit!r}; give one of {', '.join(UNITS)}")
    if isinstance(link, str | Path):
        path = Path(link)
        if not path.is_file():
            raise SceneError(f"there is no mesh file {path}; check the path")
        try:
            vertices, faces = read_triangles(path)
        except SceneError as error:
            raise SceneError(f"{path} {error}") from None
    elif hasattr(link, "vertices") and hasattr(link, "faces"):
        vertices, faces = link.vertices, link.faces
    else:
        raise SceneError(
            f"link is a {type(link).__name__}; give the path of a mesh file, a TriMesh, or "
            "something that has vertices and faces"
        )
    v, f = checked_mesh(vertices, faces)
    v = v * UNITS[unit]
    extent = float(np.ptp(v[f].reshape(-1, 3), axis=0).max())
    if not 1e-3 < extent < 10.0:
        raise SceneError(f"the link is {extent:.3g} m long; set unit, such as unit='mm'")
    return LinkMesh(v, f)


def link_area(mesh: LinkMesh) -> float:
    """Area of all triangles [m²]."""
    return float(_areas(mesh).sum())


def sample(mesh: LinkMesh, size: float) -> Samples:
    """Points spread evenly over all triangles, some tens on the area of a patch.

    They depend on the order of the triangles only, so they turn and move with the mesh.
    """
    area = _areas(mesh)
    count = int(np.clip(_PER_PATCH * area.sum() / (0.25 * math.pi * size**2), *_SAMPLES))
    reached = np.cumsum(area)
    at = (np.arange(count) + 0.5) / count * reached[-1]
    face = np.minimum(np.searchsorted(reached, at), len(area) - 1)
    # a sequence of low discrepancy, folded into the triangle
    u, v = np.modf(np.outer([0.7548776662466927, 0.5698402909980532], np.arange(1, count + 1)))[0]
    fold = u + v > 1.0
    u, v = np.where(fold, 1.0 - u, u)[:, None], np.where(fold, 1.0 - v, v)[:, None]
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces[face]], 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return Samples(a + u * (b - a) + v * (c - a), normal)


def visible(mesh: LinkMesh, samples: Samples) -> Bools:
    """Whether points can be seen from outside along one of 26 directions, shape (n,)."""
    axes = principal_axes(mesh)
    grid = np.array([(i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)])
    directions = np.delete(grid, 13, axis=0) / np.linalg.norm(
        np.delete(grid, 13, axis=0), axis=1, keepdims=True
    )
    out = np.zeros(len(samples.points), dtype=bool)
    facing = samples.normals @ (directions @ axes.T).T
    for k in np.argsort(-facing.mean(axis=0)).tolist():
        todo = np.flatnonzero(~out & (facing[:, k] > 0.3))
        if len(todo):
            start = samples.points[todo] + _OFF_SURFACE * samples.normals[todo]
            out[todo] = ~_blocked(mesh, start, axes @ directions[k])
    return out


def principal_axes(mesh: LinkMesh) -> Array:
    """Right-handed axes of the link as columns, the longest first; they turn with the link."""
    area, middle = _areas(mesh), mesh.vertices[mesh.faces].mean(axis=1)
    arm = middle - np.average(middle, axis=0, weights=area)
    _, axes = np.linalg.eigh((arm * area[:, None]).T @ arm)
    axes = axes[:, ::-1]
    skew = (((arm @ axes) ** 3) * area[:, None]).sum(axis=0)
    axes = axes * np.where(skew < 0, -1.0, 1.0)
    return np.column_stack([axes[:, 0], axes[:, 1], np.cross(axes[:, 0], axes[:, 1])])


def on_smooth_surface(points: Samples, all_samples: Samples, tree: KDTree, radius: float) -> Bools:
    """Whether no edge of the link crosses a patch of a radius [m] about each point, shape (n,)."""
    out = np.zeros(len(points.points), dtype=bool)
    for i, near in enumerate(tree.query_ball_point(points.points, radius)):
        near = np.asarray(near, dtype=int)
        along = all_samples.normals[near] @ points.normals[i]
        same = near[along > 0.5]
        off = np.linalg.norm((all_samples.points[same] - points.points[i]).mean(axis=0))
        out[i] = not ((along > -0.5) & (along <= 0.5)).any() and off < _EDGE * radius
    return out


def spread(points: Samples, count: int, spacing: float) -> Ints:
    """Indices of at most ``count`` points, each ``spacing`` [m] or more from the others.

    Each is the one farthest from those before it. Points that face away do not count as near.
    """
    p, n = points
    if not len(p):
        return np.zeros(0, dtype=np.int64)
    apart = np.full(len(p), np.inf)
    nearest = int(np.linalg.norm(p - p.mean(axis=0), axis=1).argmax())
    chosen: list[int] = []
    while len(chosen) < count and apart[nearest] >= spacing:
        chosen.append(nearest)
        off = np.linalg.norm(p - p[nearest], axis=1)
        off[n @ n[nearest] < -0.5] = np.inf
        off[nearest] = 0.0
        np.minimum(apart, off, out=apart)
        # points that face away from all others have no distance yet: first come, first taken
        nearest = int(apart.argmax())
    return np.array(chosen, dtype=np.int64)


def fit(points: Samples, samples: Samples, tree: KDTree, radius: float, axes: Array) -> Fit:
    """Fit a paraboloid to the surface within a radius [m] of each point.

    The y axis of a frame is that of weakest curvature, on the side of the link's long axis.

    Args:
        points: Middles of the patches, with normals.
        samples: The surface.
        tree: Of the samples.
        radius: That of a patch [m].
        axes: The axes of the link, see :func:`principal_axes`.
    """
    count = len(points.points)
    rotation, curvature = np.empty((count, 3, 3)), np.zeros((count, 2))
    for i in range(count):
        p, n = points.points[i], points.normals[i]
        near = np.asarray(tree.query_ball_point(p, radius))
        if len(near) < 12:
            near = tree.query(p, k=min(24, len(samples.points)))[1]
        near = near[samples.normals[near] @ n > 0.5]
        hessian = np.zeros((2, 2))
        frame = _frame(n, axes)
        for _ in range(2 if len(near) >= 8 else 0):
            u, v, w = ((samples.points[near] - p) @ frame).T
            a = np.column_stack([0.5 * u * u, u * v, 0.5 * v * v, u, v, np.ones_like(u)])
            k = np.linalg.lstsq(a, w, rcond=1e-9)[0]
            hessian = -np.array([[k[0], k[1]], [k[1], k[2]]])
            tilted = frame @ np.array([-k[3], -k[4], 1.0])
            tilted /= np.linalg.norm(tilted)
            if tilted @ n < 0.7:
                break
            frame = _frame(tilted, axes)
        values, vectors = np.linalg.eigh(hessian)
        if (values[1] - values[0]) * radius > _ROUND * 0.1:
            y = frame[:, :2] @ vectors[:, 0]
            side = y @ axes
            y *= math.copysign(1.0, side[np.argmax(np.abs(side) > 0.1)])
        else:
            y, values = frame[:, 1], np.diag(hessian)[::-1]
        z = frame[:, 2]
        rotation[i] = np.column_stack([np.cross(y, z), y, z])
        curvature[i] = values[::-1]
    return Fit(rotation, curvature)


def _frame(normal: Array, axes: Array) -> Array:
    """Right-handed axes as columns: z along a normal, y as near to the long axis as can be."""
    long = axes[:, 0] if abs(axes[:, 0] @ normal) < 0.9 else axes[:, 1]
    y = long - (long @ normal) * normal
    y /= np.linalg.norm(y)
    return np.column_stack([np.cross(y, normal), y, normal])


def _areas(mesh: LinkMesh) -> Array:
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return np.asarray(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1))


def _blocked(mesh: LinkMesh, start: Array, direction: Array) -> Bools:
    """Whether rays from points meet a triangle, shape (n,)."""
    x = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    x /= np.linalg.norm(x)
    turn = np.column_stack([x, np.cross(direction, x), direction])
    corners, p = (mesh.vertices @ turn)[mesh.faces], start @ turn
    a, b, c = np.moveaxis(corners, 1, 0)
    cross = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    wide = np.flatnonzero(np.abs(cross) > 1e-14)
    a, b, c, cross = a[wide], b[wide], c[wide], cross[wide]
    low, high = corners[wide].min(axis=1), corners[wide].max(axis=1)
    boxes = shapely.box(low[:, 0], low[:, 1], high[:, 0], high[:, 1])
    which, tri = shapely.STRtree(boxes).query(shapely.points(p[:, :2]))
    r = p[which] - a[tri]
    e, f = (b - a)[tri], (c - a)[tri]
    s = (r[:, 0] * f[:, 1] - r[:, 1] * f[:, 0]) / cross[tri]
    t = (e[:, 0] * r[:, 1] - e[:, 1] * r[:, 0]) / cross[tri]
    hit = (s >= 0) & (t >= 0) & (s + t <= 1) & (s * e[:, 2] + t * f[:, 2] > r[:, 2])
    out = np.zeros(len(p), dtype=bool)
    out[which[hit]] = True
    return out
