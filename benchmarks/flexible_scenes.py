"""Scenes of cloth, cables and soft bodies that are bent, folded or pressed, from a seed.

A cloth is bent about one axis: its profile keeps its length, as cloth does. A cable follows a
curve. A soft body is a ball or a block that is squeezed, sheared and flattened from below.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Row = dict[str, Any]


@dataclass(frozen=True)
class Cloth:
    """A strip bent about one axis, ``points`` (u, v) -> middle and normal, both from 0 to 1."""

    row: Row

    def points(self, u: Array, v: Array, off: float = 0.0) -> Array:
        """Points (..., 3) [m] a distance ``off`` from the middle, along the normal."""
        row, fine = self.row, np.linspace(0.0, 1.0, 2001)
        turn = sum(a * np.sin(2 * math.pi * (k + 1) * fine + p)
                   for k, (a, p) in enumerate(row["waves"]))  # fmt: skip
        turn = turn + row["fold"] / (1 + np.exp(-(fine - 0.5) * row["length"] / row["bend"]))
        step = row["length"] * (fine[1] - fine[0])
        way = np.stack([np.cos(turn), np.sin(turn)])
        line = np.cumsum(0.5 * (way[:, 1:] + way[:, :-1]), axis=1) * step
        line = np.concatenate([np.zeros((2, 1)), line], axis=1)
        line -= line.mean(axis=1, keepdims=True)
        x, z, angle = (np.interp(u, fine, a) for a in (*line, turn))
        out = np.stack([x - off * np.sin(angle), row["width"] * (v - 0.5), z + off * np.cos(angle)],
                       axis=-1)  # fmt: skip
        c, s = math.cos(row["yaw"]), math.sin(row["yaw"])
        out = out @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
        lowest = float(line[1].min())
        return out + np.array([*row["at"], row["gap"] + row["thickness"] / 2 - lowest])

    def grid(self, n: int, m: int, off: float = 0.0) -> Array:
        """Points of a grid, (n + 1, m + 1, 3)."""
        u, v = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, m + 1), indexing="ij")
        return self.points(u, v, off)

    def mesh(self, n: int = 19) -> tuple[Array, NDArray[np.int64]]:
        """Vertices and triangles, of (n + 1)² vertices."""
        return self.grid(n, n).reshape(-1, 3), grid_faces(n, n)

    def flat(self, n: int = 19) -> Array:
        """The vertices before it was bent."""
        u, v = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1), indexing="ij")
        size = self.row["length"], self.row["width"]
        out = np.stack([size[0] * (u - 0.5), size[1] * (v - 0.5), 0 * u], axis=-1)
        return out.reshape(-1, 3) + np.array([0, 0, 0.2])


def grid_faces(n: int, m: int) -> NDArray[np.int64]:
    """Triangles of a grid of (n + 1) × (m + 1) vertices."""
    a = np.arange((n + 1) * (m + 1)).reshape(n + 1, m + 1)
    low = np.stack([a[:-1, :-1], a[1:, :-1], a[1:, 1:]], axis=-1).reshape(-1, 3)
    high = np.stack([a[:-1, :-1], a[1:, 1:], a[:-1, 1:]], axis=-1).reshape(-1, 3)
    return np.concatenate([low, high])


def cable_points(row: Row, n: int) -> Array:
    """Points of a cable's middle [m], (n + 1, 3): half an ellipse that sags, and a wave."""
    s = np.linspace(-0.5, 0.5, n + 1)
    out = np.stack([row["length"] * s, row["wave"] * np.sin(2 * math.pi * s * row["turns"]),
                    row["sag"] * (2 * s) ** 2], axis=-1)  # fmt: skip
    c, t = math.cos(row["yaw"]), math.sin(row["yaw"])
    out = out @ np.array([[c, t, 0], [-t, c, 0], [0, 0, 1.0]])
    return out + np.array([*row["at"], row["gap"] + row["radius"]])


def soft_map(row: Row) -> Callable[[Array], Array]:
    """Where the points of a unit ball or block go [m]."""

    def place(x: Array) -> Array:
        size = np.array(row["size"])
        p = x * size
        z = p[..., 2:] / size[2]
        p = p * np.concatenate([1 + row["bulge"] * (1 - z**2)] * 2 + [np.ones_like(z)], axis=-1)
        p[..., :2] += np.array(row["shear"]) * size[2] * z**2
        # flattened from below: smooth, and no point goes past another
        low, soft = -size[2] * (1 - row["pressed"]), 0.15 * size[2]
        height = low + soft * np.logaddexp(0.0, (p[..., 2] - low) / soft)
        p[..., 2] = height
        return p + np.array([*row["at"], row["gap"] - float(row["lowest"])])

    return place


def ball(parts: int) -> tuple[Array, NDArray[np.int64]]:
    """A unit ball of 20 parts² triangles."""
    g = (1 + 5**0.5) / 2
    v = np.array([(-1, g, 0), (1, g, 0), (-1, -g, 0), (1, -g, 0), (0, -1, g), (0, 1, g),
                  (0, -1, -g), (0, 1, -g), (g, 0, -1), (g, 0, 1), (-g, 0, -1),
                  (-g, 0, 1)])  # fmt: skip
    f = np.array([(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4),
                  (11, 10, 2), (10, 7, 6), (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8),
                  (3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)])  # fmt: skip
    v, f = divided(v / np.linalg.norm(v, axis=1)[:, None], f, parts)
    return v / np.linalg.norm(v, axis=1)[:, None], f


def block(parts: int) -> tuple[Array, NDArray[np.int64]]:
    """The block of half edges 1, 12 parts² triangles."""
    v = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    f = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    return divided(v, f, parts)


def divided(v: Array, f: NDArray[np.int64], parts: int) -> tuple[Array, NDArray[np.int64]]:
    """Triangles whose edges are cut into so many parts."""
    steps = [(i, j) for i in range(parts + 1) for j in range(parts + 1 - i)]
    at = {step: k for k, step in enumerate(steps)}
    share = np.array([(parts - i - j, i, j) for i, j in steps]) / parts
    points = np.einsum("sk,fkx->fsx", share, v[f])
    small = [(at[i, j], at[i + 1, j], at[i, j + 1]) for i, j in steps if i + j < parts]
    small += [(at[i + 1, j], at[i + 1, j + 1], at[i, j + 1]) for i, j in steps if i + j < parts - 1]
    faces = (len(steps) * np.arange(len(f))[:, None, None] + np.array(small)).reshape(-1, 3)
    points = points.reshape(-1, 3)
    _, first, place = np.unique(np.round(points, 9), axis=0, return_index=True, return_inverse=True)
    return points[first], place.reshape(-1)[faces]


COVERED, COVER = "covered", 2e-3
"""A design with a cover of so much [m], above whose face gaps count."""
MATTER = {
    "cotton": 1.8, "polyester": 3.0, "damp cloth": 12.0, "wet cloth": 60.0, "foam": 1.5,
    "silicone": 2.8, "gel": 9.0, "tissue": 45.0, "rubber": 5.0,
}  # fmt: skip


def scenes(seed: int = 11) -> list[Row]:
    """All scenes; each has the name of a packaged design."""
    rng = np.random.default_rng(seed)
    out: list[Row] = []

    def between(low: float, high: float) -> float:
        return float(f"{rng.uniform(low, high):.4g}")

    def log(low: float, high: float) -> float:
        return float(f"{math.exp(rng.uniform(math.log(low), math.log(high))):.4g}")

    def cloth(design: str, kind: str, matter: str, gap: tuple[float, float], fold: bool) -> None:
        size = 0.7 if design == "patch" else 1.0
        out.append({
            "what": "cloth", "design": design, "kind": kind, "matter": matter,
            "thickness": log(4e-4, 2e-3) if kind == "dielectric" else 3e-4,
            "length": size * between(0.1, 0.18), "width": size * between(0.08, 0.14),
            "waves": [(between(0.0, 0.5), between(0, 6)), (between(0.0, 0.35), between(0, 6))],
            "fold": between(2.2, 3.0) if fold else 0.0, "bend": between(0.008, 0.014),
            "yaw": between(0, 6.28), "gap": log(*gap),
            "at": [between(-0.02, 0.02), between(-0.02, 0.02)],
        })  # fmt: skip

    for design, matter, gap, fold in (
        ("six_patch", "cotton", (3e-3, 6e-3), False),
        ("six_patch", "cotton", (8e-3, 2e-2), True),
        ("six_patch", "polyester", (2e-2, 6e-2), False),
        ("six_patch", "damp cloth", (4e-3, 1e-2), False),
        ("six_patch", "wet cloth", (5e-3, 2e-2), True),
        ("six_patch", "wet cloth", (4e-2, 1e-1), False),
        ("patch", "polyester", (5e-3, 1e-2), False),
        ("patch", "wet cloth", (4e-3, 1e-2), False),
    ):
        cloth(design, "dielectric", matter, gap, fold)
    for design, kind, gap, fold in (
        ("six_patch", "grounded", (3e-3, 1e-2), False),
        ("six_patch", "floating", (5e-3, 2e-2), False),
        ("patch", "grounded", (5e-3, 2e-2), True),
    ):
        cloth(design, kind, "textile", gap, fold)
    for design, kind, gap in (
        ("six_patch", "grounded", (2e-3, 6e-3)),
        ("six_patch", "floating", (3e-3, 1e-2)),
        ("patch", "grounded", (5e-3, 2e-2)),
        ("six_patch", "dielectric", (3e-3, 8e-3)),
    ):
        out.append({
            "what": "cable", "design": design, "kind": kind,
            "matter": "polyester" if kind == "dielectric" else "copper",
            "radius": log(1.5e-3, 6e-3), "length": between(0.12, 0.25), "wave": between(0, 0.03),
            "turns": between(0.5, 1.5), "sag": between(0, 0.05), "yaw": between(0, 6.28),
            "gap": log(*gap), "at": [between(-0.02, 0.02), between(-0.02, 0.02)],
        })  # fmt: skip
    for design, kind, matter, gap, shape in (
        ("six_patch", "dielectric", "foam", (3e-3, 8e-3), "block"),
        ("six_patch", "dielectric", "tissue", (4e-3, 1e-2), "ball"),
        ("patch", "dielectric", "rubber", (3e-3, 8e-3), "block"),
        ("six_patch", "dielectric", "gel", (2e-2, 6e-2), "block"),
        (COVERED, "dielectric", "silicone", (4e-4, 2e-3), "ball"),
        (COVERED, "dielectric", "tissue", (1e-3, 3e-3), "ball"),
        (COVERED, "dielectric", "rubber", (5e-4, 2e-3), "block"),
    ):
        row = {
            "what": "soft", "design": design, "kind": kind, "matter": matter, "shape": shape,
            "size": [between(0.02, 0.045), between(0.02, 0.045), between(0.012, 0.03)],
            "bulge": between(0.0, 0.3), "shear": [between(-0.3, 0.3), between(-0.3, 0.3)],
            "pressed": between(0.0, 0.35), "gap": log(*gap),
            "at": [between(-0.02, 0.02), between(-0.02, 0.02)], "lowest": 0.0,
        }  # fmt: skip
        v = (ball if shape == "ball" else block)(32)[0]
        row["gap"] += COVER if design == COVERED else 0.0
        row["lowest"] = float(f"{(soft_map(row)(v)[:, 2] - row['gap']).min():.6g}")
        out.append(row)
    for k, row in enumerate(out):
        row["name"] = f"{k + 1} {row['what']}, {row['matter']}, {row['kind']}, {row['design']}"
    return out
