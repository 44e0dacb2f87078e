"""Orthographic views of exact convex solids, and unions of stretches."""

from __future__ import annotations

import numpy as np

from capsense.scene import Pose, Shape


def stretch(shape: Shape, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Entry and exit of lines ``o + t d``, d of length one, of a convex solid; NaN where missed.

    From signed distances alone, which are convex along a line: the least one is found by
    narrowing down, the ends by halving.
    """
    low, high = shape.bounds()
    radius = 0.5 * float(np.linalg.norm(high - low))
    middle = np.einsum("ij,ij->i", 0.5 * (low + high) - o, d)
    off = np.linalg.norm(o + middle[:, None] * d - 0.5 * (low + high), axis=1)
    near = np.flatnonzero(off < radius)
    o, d, middle = o[near], d[near], middle[near]

    def level(t: np.ndarray) -> np.ndarray:
        return shape.signed_distance(o + t[:, None] * d)

    a, b = middle - radius, middle + radius
    for _ in range(48):
        p, q = a + (b - a) / 3, b - (b - a) / 3
        left = level(p) < level(q)
        a, b = np.where(left, a, p), np.where(left, q, b)
    deepest = 0.5 * (a + b)
    out = np.full((2, len(off)), np.nan)
    met = level(deepest) < 0
    for end, sign in enumerate((-1.0, 1.0)):
        inside, outside = deepest, middle + sign * radius
        for _ in range(40):
            half = 0.5 * (inside + outside)
            within = level(half) < 0
            inside, outside = np.where(within, half, inside), np.where(within, outside, half)
        out[end, near[met]] = outside[met]
    return out[0], out[1]


def view(shape: Shape, pose: Pose, n: int, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Front and back [m] of a convex solid along z, NaN where missed, shape (n, n)."""
    c = (np.arange(n) + 0.5) / n * size - size / 2
    x, y = np.meshgrid(c, c)
    o = np.column_stack([x.ravel(), y.ravel(), np.zeros(n * n)])
    inverse = pose.inverse()
    along = np.tile(inverse.rotation @ (0.0, 0.0, 1.0), (n * n, 1))
    front, back = stretch(shape, inverse.apply(o), along)
    return front.reshape(n, n), back.reshape(n, n)


def unite(stretches: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """The union of stretches, ascending and disjoint."""
    out: list[tuple[float, float]] = []
    for a, b in sorted(stretches):
        if out and a <= out[-1][1]:
            out[-1] = (out[-1][0], max(b, out[-1][1]))
        else:
            out.append((a, b))
    return out
