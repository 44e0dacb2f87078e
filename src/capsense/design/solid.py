"""Closed surfaces of dielectric parts: what is inside of them, and what overlaps them."""

from __future__ import annotations

import math

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.polygon import orient

from capsense._jit import kernel
from capsense._thread_pool import filled
from capsense.design.geometry import TOUCH, Facet, Surface
from capsense.design.stl import SheetMesh

Array = NDArray[np.float64]

_RAYS = np.array(
    [[0.3713907, 0.5570860, 0.7427814], [-0.6401844, 0.7682213, 0.0], [0.0, -0.6, 0.8]]
)
_RAYS += [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0171], [0.0131, 0.0, 0.0]]  # along no edge of anything


@kernel
def hit(point: Array, ray: Array, triangle: Array) -> float:
    """Signed distance along a ray to a triangle, shape (3, 3), infinite where it is missed.

    In units of the ray's length; after T. Möller and B. Trumbore (1997).
    """
    a0, a1, a2 = triangle[0, 0], triangle[0, 1], triangle[0, 2]
    ux, uy, uz = triangle[1, 0] - a0, triangle[1, 1] - a1, triangle[1, 2] - a2
    vx, vy, vz = triangle[2, 0] - a0, triangle[2, 1] - a1, triangle[2, 2] - a2
    px, py, pz = ray[1] * vz - ray[2] * vy, ray[2] * vx - ray[0] * vz, ray[0] * vy - ray[1] * vx
    det = ux * px + uy * py + uz * pz
    if det == 0.0:
        return math.inf
    sx, sy, sz = point[0] - a0, point[1] - a1, point[2] - a2
    b = (sx * px + sy * py + sz * pz) / det
    if b < 0.0 or b > 1.0:
        return math.inf
    qx, qy, qz = sy * uz - sz * uy, sz * ux - sx * uz, sx * uy - sy * ux
    c = (ray[0] * qx + ray[1] * qy + ray[2] * qz) / det
    if c < 0.0 or b + c > 1.0:
        return math.inf
    return (vx * qx + vy * qy + vz * qz) / det


def paths(points: Array, rays: Array, triangles: Array) -> Array:
    """Distance along rays to the first triangle, (n, 3), (n, 3) -> (n,); infinite without one."""
    points, rays = np.ascontiguousarray(points), np.ascontiguousarray(rays)
    return filled(_fill_paths, np.empty(len(points)), points, rays, triangles)


@kernel
def _fill_paths(
    start: int, stop: int, points: Array, rays: Array, triangles: Array, out: Array
) -> None:
    for i in range(start, stop):
        out[i] = first_hit(points[i], rays[i], triangles, True)


@kernel
def first_hit(point: Array, ray: Array, triangles: Array, nearest: bool) -> float:
    """Distance to the nearest, or just any, triangle farther than a micrometre along a ray."""
    found = math.inf
    for t in range(len(triangles)):
        distance = hit(point, ray, triangles[t])
        if 1e-6 < distance < found:
            found = distance
            if not nearest:
                break
    return found


def inside(points: Array, triangles: Array) -> NDArray[np.bool_]:
    """Whether points lie in a closed surface, by how often rays from them meet it.

    The senses of its triangles do not count, and what is in a cavity is outside.

    Args:
        points: Shape (n, 3) [m].
        triangles: Shape (m, 3, 3) [m].
    """
    out = np.zeros(len(points), dtype=np.bool_)
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    near = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
    votes = np.empty(len(near))
    out[near] = filled(_fill_votes, votes, points[near], _RAYS, triangles) >= 2
    return out


@kernel
def _fill_votes(
    start: int, stop: int, points: Array, rays: Array, triangles: Array, out: Array
) -> None:
    for i in range(start, stop):
        out[i] = 0.0
        for r in range(len(rays)):
            odd = 0.0
            for t in range(len(triangles)):
                if 0.0 < hit(points[i], rays[r], triangles[t]) < math.inf:
                    odd = 1.0 - odd
            out[i] += odd


def depths(points: Array, triangles: Array) -> Array:
    """How deep points lie in a closed surface [m], negative outside, (n, 3) -> (n,)."""
    points = np.ascontiguousarray(points)
    out = filled(_fill_distances, np.empty(len(points)), points, triangles)
    return np.where(inside(points, triangles), out, -out)


@kernel
def _fill_distances(start: int, stop: int, points: Array, triangles: Array, out: Array) -> None:
    for i in range(start, stop):
        least = math.inf
        for t in range(len(triangles)):
            least = min(least, _square_distance(points[i], triangles[t]))
        out[i] = math.sqrt(least)


@kernel
def _square_distance(p: Array, t: Array) -> float:
    """Squared distance of a point from a triangle: from its plane over it, else from its edges."""
    ux, uy, uz = t[1, 0] - t[0, 0], t[1, 1] - t[0, 1], t[1, 2] - t[0, 2]
    vx, vy, vz = t[2, 0] - t[0, 0], t[2, 1] - t[0, 1], t[2, 2] - t[0, 2]
    wx, wy, wz = p[0] - t[0, 0], p[1] - t[0, 1], p[2] - t[0, 2]
    uu, uv, vv = (
        ux * ux + uy * uy + uz * uz,
        ux * vx + uy * vy + uz * vz,
        vx * vx + vy * vy + vz * vz,
    )
    wu, wv = wx * ux + wy * uy + wz * uz, wx * vx + wy * vy + wz * vz
    det = uu * vv - uv * uv
    b, c = vv * wu - uv * wv, uu * wv - uv * wu
    if det > 0.0 and b >= 0.0 and c >= 0.0 and b + c <= det:
        b, c = b / det, c / det
        dx, dy, dz = wx - b * ux - c * vx, wy - b * uy - c * vy, wz - b * uz - c * vz
        return dx * dx + dy * dy + dz * dz
    least = math.inf
    for k in range(3):
        m = (k + 1) % 3
        ex, ey, ez = t[m, 0] - t[k, 0], t[m, 1] - t[k, 1], t[m, 2] - t[k, 2]
        dx, dy, dz = p[0] - t[k, 0], p[1] - t[k, 1], p[2] - t[k, 2]
        s = (dx * ex + dy * ey + dz * ez) / (ex * ex + ey * ey + ez * ez)
        s = min(max(s, 0.0), 1.0)
        dx, dy, dz = dx - s * ex, dy - s * ey, dz - s * ez
        least = min(least, dx * dx + dy * dy + dz * dz)
    return least


def turned_outwards(facets: tuple[Facet, ...]) -> tuple[Facet, ...]:
    """The facets of a closed surface, each with its normal out of it."""
    triangles = Surface(facets, np.empty((0, 2, 3))).triangles
    normals = np.array([f.axes[2] for f in facets])
    wrong = inside(_middles(facets) + 1e-7 * normals, triangles)
    return tuple(_mirrored(f) if w else f for f, w in zip(facets, wrong, strict=True))


def _middles(facets: tuple[Facet, ...]) -> Array:
    """A point of each facet [m], shape (n, 3)."""
    return np.array(
        [f.to_sensor(shapely.get_coordinates(f.polygon.representative_point())[0]) for f in facets]
    )


def _mirrored(facet: Facet) -> Facet:
    flipped = shapely.transform(facet.polygon, lambda uv: uv * [-1.0, 1.0])
    outline = orient(flipped)
    return Facet(outline, facet.origin, facet.axes * [[-1.0], [1.0], [-1.0]])


def thickness(facets: tuple[Facet, ...]) -> float:
    """How thick a part is [m]: a tenth of its surface has less matter behind it.

    Rays are a little aslant, so that they run through no edge between two triangles.
    """
    triangles = Surface(facets, np.empty((0, 2, 3))).triangles
    inward = np.array([[0.0131, 0.0171, -1.0] @ f.axes for f in facets])
    behind = paths(_middles(facets), inward, triangles)
    order = np.argsort(behind)
    share = np.cumsum(np.array([f.polygon.area for f in facets])[order])
    return float(behind[order][np.searchsorted(share, 0.1 * share[-1])])


def crossing(sheet: Array, solid: Array) -> Array | None:
    """A point inside of a closed surface, shape (3,), of a sheet that is outside of it as well.

    Both are triangles [m], shape (n, 3, 3). None where the sheet is on one side, or on the surface.
    """
    points = _samples(sheet, solid)
    depth = depths(points, solid)
    return points[np.argmax(depth)] if depth.max() > TOUCH and depth.min() < -TOUCH else None


def overlap(one: Surface, other: Surface) -> Array | None:
    """A point [m] that two closed surfaces have both inside, shape (3,), or None."""
    for a, b in ((one, other), (other, one)):
        normals = np.array([f.axes[2] for f in a.facets])
        within = _middles(a.facets) - 5 * TOUCH * normals
        points = np.concatenate([_samples(a.triangles, b.triangles), within])
        depth = depths(points, b.triangles)
        if depth.max() > TOUCH:
            return points[np.argmax(depth)]
    return None


def self_crossing(mesh: SheetMesh) -> Array | None:
    """A point [m], shape (3,), near which a closed mesh crosses or touches itself, or None.

    There an edge runs through a triangle, or what is outside of one triangle is inside of its
    neighbour.
    """
    triangles = mesh.vertices[mesh.faces]
    points, stops = np.ascontiguousarray(np.moveaxis(mesh.vertices[mesh.pair_edges], 1, 0))
    pierces = filled(
        _fill_piercing, np.empty(len(points)), mesh.pair_edges, points, stops - points, mesh.faces,
        triangles,
    )  # fmt: skip
    within = inside(triangles.mean(axis=1) + 1e-7 * mesh.normals, triangles)[mesh.pairs]
    turns = (within[:, 0] == within[:, 1]) != mesh.opposed
    found = np.flatnonzero((pierces > 0.0) | turns)
    return points[found[0]] if len(found) else None


@kernel
def _fill_piercing(
    start: int, stop: int, edges: Array, points: Array, rays: Array, faces: Array,
    triangles: Array, out: Array,
) -> None:  # fmt: skip
    """Whether edges run through triangles that have no corner in common with them."""
    for i in range(start, stop):
        out[i] = 0.0
        for t in range(len(triangles)):
            if _apart(points[i], rays[i], triangles[t]):
                continue
            if edges[i, 0] not in faces[t] and edges[i, 1] not in faces[t]:
                out[i] += 0.0 < hit(points[i], rays[i], triangles[t]) < 1.0


@kernel
def _apart(point: Array, ray: Array, triangle: Array) -> bool:
    """Whether the bounding boxes of a line and a triangle are apart."""
    for k in range(3):
        a, b, c = triangle[0, k], triangle[1, k], triangle[2, k]
        if max(point[k], point[k] + ray[k]) < min(a, b, c):
            return True
        if min(point[k], point[k] + ray[k]) > max(a, b, c):
            return True
    return False


def _samples(one: Array, other: Array) -> Array:
    """Points between all places where edges of one surface meet another, shape (n, 3).

    Edges of the other that pierce a triangle of the one are joined with each other and with the
    triangle's corners, and these lines are cut as well.
    """
    lines = [_edges(one)]
    low, high = _bounds(one)
    pierced: dict[int, list[Array]] = {}
    for a, b in _edges(other):
        near = (low <= np.maximum(a, b) + TOUCH) & (high >= np.minimum(a, b) - TOUCH)
        for t in np.flatnonzero(near.all(axis=1)).tolist():
            at = hit(a, b - a, one[t])
            if 0.0 < at < 1.0:
                pierced.setdefault(t, []).append(a + at * (b - a))
    for t, points in pierced.items():
        ends = np.array([*points, *one[t]])
        first, second = np.triu_indices(len(ends), 1)
        lines.append(np.stack([ends[first], ends[second]], axis=1)[:400])
    return cut_lines(np.concatenate(lines), other)


def cut_lines(lines: Array, triangles: Array) -> Array:
    """Ends of lines and the middles of the pieces that triangles' planes cut them to, (n, 3)."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    low, high = _bounds(triangles)
    out = [lines.reshape(-1, 3)]
    for a, b in lines:
        over, under = ((p - triangles[:, 0]) * normals for p in (a, b))
        first, second = over.sum(axis=1), under.sum(axis=1)
        across = np.flatnonzero(first * second < 0.0)
        at = first[across] / (first[across] - second[across])
        points = a + at[:, None] * (b - a)
        met = (points >= low[across] - TOUCH) & (points <= high[across] + TOUCH)
        stops = np.concatenate([[0.0], np.sort(at[met.all(axis=1)]), [1.0]])
        out.append(a + (0.5 * (stops[1:] + stops[:-1]))[:, None] * (b - a))
    return np.concatenate(out)


def _edges(triangles: Array) -> Array:
    """The edges of triangles, each once, shape (k, 2, 3)."""
    ends = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2, 3)
    key = np.rint(ends / TOUCH).astype(np.int64)
    swap = np.array([tuple(p) > tuple(q) for p, q in key.tolist()])
    key[swap] = key[swap][:, ::-1]
    return ends[np.unique(key.reshape(-1, 6), axis=0, return_index=True)[1]]


def _bounds(triangles: Array) -> tuple[Array, Array]:
    return triangles.min(axis=1), triangles.max(axis=1)
