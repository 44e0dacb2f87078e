"""Pictures of robots and people made of rods, drawn without OpenGL."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

Rod = tuple[np.ndarray, np.ndarray, float, str]
"""A capsule to be drawn: its two ends [m] in the world, its radius [m], what it is."""
Cloud = tuple[np.ndarray, str]
"""Corners of a convex thing [m] in the world, shape (n, 3), and what it is."""


def silhouettes(
    rods: Sequence[Rod], right: np.ndarray, up: np.ndarray, clouds: Sequence[Cloud] = ()
) -> list[tuple[np.ndarray, str]]:
    """Outlines in the picture [m] and what they are of, the farthest first.

    Args:
        rods: The rods.
        right: Axis of the picture in the world, shape (3,).
        up: The other axis.
        clouds: What else there is.
    """
    from scipy.spatial import ConvexHull

    turn = np.linspace(0, 2 * np.pi, 30)
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    axes = np.stack([right, up], axis=1)
    parts = [
        (np.concatenate([a @ axes + r * ring, b @ axes + r * ring]), 0.5 * (a + b), what)
        for a, b, r, what in rods
    ]
    parts += [(points @ axes, points.mean(axis=0), what) for points, what in clouds]
    parts.sort(key=lambda part: float(np.cross(right, up) @ part[1]))
    return [(points[ConvexHull(points).vertices], what) for points, _, what in parts]


def frame_of(figure: Any, colours: int = 64) -> Any:
    """A figure as it is now, as one picture of an animation of few colours."""
    from PIL import Image

    figure.canvas.draw()
    picture = Image.fromarray(np.asarray(figure.canvas.buffer_rgba()))
    return picture.convert("RGB").quantize(colours)


def save_animation(frames: Sequence[Any], file: Path, milliseconds: int) -> None:
    """Write frames as an endless animation."""
    frames[0].save(
        file, save_all=True, append_images=frames[1:], duration=milliseconds, loop=0, optimize=True
    )
