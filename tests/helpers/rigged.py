"""Rigged meshes like those of SMPL-X and MANO: one connected skin each, made from a formula.

Capsules are blended into one solid. Its surface is meshed on a grid that is finer at the hands, and
follows the bones by linear-blend skinning.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from capsense.field.face_kernels import Space

Array = NDArray[np.float64]
BLEND = 0.012
"""Length over which capsules run into each other [m]."""
PERSON, HAND = (0.0200, 0.0056), (0.0086, 0.0086)
"""Pitch of the grid away from the hands and at them [m]: for some 10,000 and 800 vertices."""
WRIST = 0.66
"""Where hands begin along x [m]."""


class Bone(NamedTuple):
    """A capsule that turns about its start."""

    name: str
    parent: str
    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float


class Rig(NamedTuple):
    """A mesh and the bones it follows."""

    vertices: Array
    """At rest [m], shape (n, 3)."""
    faces: NDArray[np.int64]
    """Shape (m, 3), normals out."""
    weights: Array
    """Of each bone, rows add to 1, shape (n, bones)."""
    bones: tuple[Bone, ...]

    def posed(self, turns: dict[str, tuple[float, float, float]]) -> Array:
        """Vertices with some bones turned, by rotation vectors in degrees, shape (n, 3)."""
        placed: dict[str, tuple[Array, Array]] = {"": (np.eye(3), np.zeros(3))}
        out = np.zeros_like(self.vertices)
        for bone, share in zip(self.bones, self.weights.T, strict=True):
            turn, shift = placed[bone.parent]
            own = Rotation.from_rotvec(turns.get(bone.name, (0, 0, 0)), degrees=True).as_matrix()
            joint = np.array(bone.start)
            placed[bone.name] = turn @ own, turn @ (joint - own @ joint) + shift
            moved = self.vertices @ placed[bone.name][0].T + placed[bone.name][1]
            out += share[:, None] * moved
        return out


def _hand(side: str, sign: int, parent: str) -> list[Bone]:
    """A hand along x, its palm down."""
    x, z = sign * WRIST, 1.40
    name = f"{side}_hand"
    out = [Bone(name, parent, (x, 0.0, z), (x + sign * 0.075, 0.005, z), 0.020)]
    for y, end in ((0.026, 0.078), (0.009, 0.085), (-0.010, 0.080), (-0.026, 0.070)):
        out.append(Bone(f"{name}_{y}", name, (x + sign * 0.02, 0.6 * y, z),
                        (x + sign * end, y, z), 0.015))  # fmt: skip
    for finger, y, root, lengths, radius in (
        ("index", 0.028, 0.085, (0.042, 0.024, 0.018), 0.0085),
        ("middle", 0.009, 0.090, (0.046, 0.028, 0.018), 0.0088),
        ("ring", -0.011, 0.085, (0.042, 0.026, 0.018), 0.0083),
        ("little", -0.030, 0.076, (0.033, 0.019, 0.016), 0.0073),
    ):
        at, above = x + sign * root, name
        for k, length in enumerate(lengths):
            bone = Bone(f"{side}_{finger}_{k}", above, (at, y, z),
                        (at + sign * length, y, z), radius - 0.0004 * k)  # fmt: skip
            out.append(bone)
            at, above = at + sign * length, bone.name
    start = np.array([x + sign * 0.018, 0.030, z - 0.006])
    for k, (length, radius) in enumerate(((0.042, 0.013), (0.032, 0.0098), (0.022, 0.009))):
        stop = start + length * np.array([sign * 0.66, 0.72, -0.21])
        above = name if k == 0 else f"{side}_thumb_{k - 1}"
        out.append(Bone(f"{side}_thumb_{k}", above, tuple(start), tuple(stop), radius))
        start = stop
    return out


def bones(hand_only: bool) -> tuple[Bone, ...]:
    """The bones of a person, arms out, standing on z = 0; or of the right hand and wrist."""
    if hand_only:
        wrist = Bone("wrist", "", (-WRIST + 0.05, 0.0, 1.40), (-WRIST, 0.0, 1.40), 0.026)
        return wrist, *_hand("right", -1, "wrist")
    out = [
        Bone("pelvis", "", (0.0, 0.0, 0.92), (0.0, 0.0, 1.0), 0.13),
        Bone("belly", "pelvis", (0.0, 0.0, 1.04), (0.0, 0.0, 1.10), 0.13),
        Bone("chest", "belly", (0.0, 0.0, 1.16), (0.0, 0.0, 1.30), 0.135),
        Bone("neck", "chest", (0.0, 0.0, 1.40), (0.0, 0.0, 1.52), 0.055),
        Bone("head", "neck", (0.0, 0.01, 1.58), (0.0, 0.01, 1.64), 0.09),
    ]
    for side, s in (("left", 1), ("right", -1)):
        out += [
            Bone(f"{side}_hip", "pelvis", (s * 0.05, 0, 0.92), (s * 0.09, 0, 0.90), 0.10),
            Bone(f"{side}_thigh", f"{side}_hip", (s * 0.09, 0, 0.90), (s * 0.10, 0, 0.50), 0.07),
            Bone(f"{side}_shank", f"{side}_thigh", (s * 0.10, 0, 0.50), (s * 0.10, 0, 0.09), 0.048),
            Bone(
                f"{side}_foot",
                f"{side}_shank",
                (s * 0.10, 0.0, 0.06),
                (s * 0.11, 0.16, 0.04),
                0.038,
            ),
            Bone(f"{side}_collar", "chest", (s * 0.04, 0, 1.38), (s * 0.17, 0, 1.40), 0.06),
            Bone(f"{side}_arm", f"{side}_collar", (s * 0.17, 0, 1.40), (s * 0.43, 0, 1.40), 0.046),
            Bone(
                f"{side}_forearm", f"{side}_arm", (s * 0.43, 0, 1.40), (s * WRIST, 0, 1.40), 0.036
            ),
            *_hand(side, s, f"{side}_forearm"),
        ]
    return tuple(out)


def _from_bones(points: Array, some: tuple[Bone, ...]) -> Array:
    """Distances of points (n, 3) from the surface of each bone [m], shape (n, bones)."""
    out = np.empty((len(points), len(some)))
    for k, bone in enumerate(some):
        start = np.array(bone.start)
        way = np.array(bone.end) - start
        at = np.clip((points - start) @ way / (way @ way), 0.0, 1.0)
        out[:, k] = np.linalg.norm(points - start - at[:, None] * way, axis=1) - bone.radius
    return out


def _solid(points: Array, some: tuple[Bone, ...]) -> Array:
    """Below zero inside; fingers do not run into each other."""
    far = _from_bones(points, some)
    fingers = np.array([any(f in b.name for f in ("index", "middle", "ring", "little", "thumb"))
                        for b in some])  # fmt: skip
    soft = BLEND / 3
    low = far[:, ~fingers].min(axis=1)
    trunk = low - soft * np.log(np.exp(-(far[:, ~fingers] - low[:, None]) / soft).sum(axis=1))
    if not fingers.any():
        return trunk
    least = far[:, fingers].min(axis=1)
    soft /= 2
    low = np.minimum(trunk, least)
    return low - soft * np.log(np.exp(-(trunk - low) / soft) + np.exp(-(least - low) / soft))


def _grid(some: tuple[Bone, ...], pitch: tuple[float, float]) -> Array:
    """Grid points of :func:`_surface_net`, all of one cross-section as close as at its x."""
    ends = np.array([[b.start, b.end] for b in some])
    low, high = ends.min(axis=(0, 1)) - 0.16, ends.max(axis=(0, 1)) + 0.16
    steps = [low[0]]
    while steps[-1] < high[0]:
        share = np.clip((abs(steps[-1]) - WRIST + 0.14) / 0.10, 0.0, 1.0)
        steps.append(steps[-1] + pitch[0] * (pitch[1] / pitch[0]) ** share)
    x = np.array(steps)
    scale = (pitch[1] / pitch[0]) ** np.clip((np.abs(x) - WRIST + 0.14) / 0.10, 0.0, 1.0)
    y = np.arange(-0.25, 0.40, pitch[0])
    z = np.arange(low[2], high[2], pitch[0])
    grid = np.empty((len(x), len(y), len(z), 3))
    grid[..., 0] = x[:, None, None]
    grid[..., 1] = scale[:, None, None] * (y[:, None] + 0.0037)
    grid[..., 2] = 1.40 + scale[:, None, None] * (z - 1.4041)
    return grid


def _surface_net(grid: Array, value: Array) -> tuple[Array, NDArray[np.int64]]:
    """A vertex in each cell that the surface crosses, two triangles about each edge it crosses."""
    inside = value < 0
    corner = [(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]

    def at(a: Array, o: tuple[int, int, int]) -> Array:
        return a[tuple(slice(i, n - 1 + i) for i, n in zip(o, a.shape, strict=False))]

    count, total = np.zeros(tuple(n - 1 for n in value.shape)), 0.0
    for p in corner:
        for axis in range(3):
            if p[axis]:
                continue
            q = tuple(x + (i == axis) for i, x in enumerate(p))
            a, b = at(value, p), at(value, q)
            crossed = at(inside, p) != at(inside, q)
            t = np.where(crossed, a / np.where(crossed, a - b, 1.0), 0.0)[..., None]
            place = at(grid, p) + t * (at(grid, q) - at(grid, p))
            total = total + np.where(crossed[..., None], place, 0.0)
            count += crossed
    there = count > 0
    number = np.cumsum(there).reshape(there.shape) - 1
    vertices = total[there] / count[there][:, None]
    faces = []
    for axis in range(3):
        first = [slice(1, n - 1) for n in value.shape]
        first[axis] = slice(0, value.shape[axis] - 1)
        after = list(first)
        after[axis] = slice(1, value.shape[axis])
        a, b = inside[tuple(first)], inside[tuple(after)]
        where = np.argwhere(a != b)
        way = a[tuple(where.T)]
        where += [0 if i == axis else 1 for i in range(3)]
        u, v = ((axis + 1) % 3, (axis + 2) % 3)
        ring = []
        for du, dv in ((0, 0), (-1, 0), (-1, -1), (0, -1)):
            cell = where.copy()
            cell[:, u] += du
            cell[:, v] += dv
            ring.append(number[tuple(cell.T)])
        quad = np.stack(ring, axis=1)
        quad[~way] = quad[~way][:, ::-1]
        faces.append(quad[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3))
    return vertices, np.concatenate(faces)


@cache
def rig(hand_only: bool = False, pitch: tuple[float, float] | None = None) -> Rig:
    """A person of some 10,000 vertices, closed; or a right hand of some 800, open at the wrist."""
    some = bones(hand_only)
    grid = _grid(some, pitch or (HAND if hand_only else PERSON))
    value = np.empty(grid.shape[:3])
    for layer, points in zip(value, grid, strict=True):
        layer[:] = _solid(points.reshape(-1, 3), some).reshape(layer.shape)
    vertices, faces = _surface_net(grid, value)
    slope = 1e-5 * np.eye(3)
    edges = np.concatenate([faces, np.roll(faces, -1, axis=1)]).reshape(2, -1).T
    edges = np.concatenate([edges, edges[:, ::-1]])
    count = np.bincount(edges[:, 0])[:, None]
    for _ in range(3):  # even, and onto the surface
        total = np.stack([np.bincount(edges[:, 0], x[edges[:, 1]]) for x in vertices.T], axis=1)
        vertices = 0.5 * (vertices + total / count)
        f = _solid(vertices, some)
        n = np.stack([_solid(vertices + e, some) - f for e in slope], axis=1) / 1e-5
        vertices = vertices - 0.7 * f[:, None] * n / np.maximum((n**2).sum(axis=1), 0.3)[:, None]
    if hand_only:
        kept = vertices[faces, 0].max(axis=1) < -WRIST + 0.045
        used, number = np.unique(faces[kept], return_inverse=True)
        vertices, faces = vertices[used], number.reshape(-1, 3)
    near = np.maximum(_from_bones(vertices, some), -0.01)
    soft = 0.008 if hand_only else 0.012
    weights = np.exp(-(near - near.min(axis=1, keepdims=True)) / soft)
    weights[weights < 0.02] = 0.0
    return Rig(vertices, faces, weights / weights.sum(axis=1, keepdims=True), some)


def over_square() -> Space:
    """Surroundings of a square design of 0.1 m that faces up, its walls far away."""
    face = np.array([[-0.05, -0.05, -1e-3], [0.05, 0.05, 0.0]])
    wide = np.array([[-1.0] * 3, [1.0] * 3])
    both = np.stack([wide, wide])
    return Space(True, face, 0.0, wide, 1.0, both, np.abs(both), 1e-3, 0.0)
