"""Pictures of environments without OpenGL: rays of MuJoCo, and sections drawn by NumPy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

HEIGHT, WIDTH = 240, 320
"""Pixels of a picture."""
PAPER, PAD, MARK = (255, 255, 255), (60, 60, 60), (0, 158, 115)
BODIES = {"person": (213, 94, 0), "metal": (86, 130, 180)}
_DEPTH = 0.17
"""Height of the section that is shown, above the electrodes [m]."""
_HALF = 0.0386
"""Half width of the pad [m]."""


def draw_section(gap: float, side: float, size: float, kind: str, target: float) -> Picture:
    """A section across the body: the pad below, the body above, and where its skin should be.

    Args:
        gap: From the pad to the body [m].
        side: How far the body is off to the side [m].
        size: Its radius or half width [m].
        kind: Class of the body: a grounded one has a line to the top.
        target: The right gap [m], a green line.

    Returns:
        Shape (240, 320, 3).
    """
    scale = _DEPTH * 1.1 / HEIGHT
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    z = _DEPTH - rows * scale
    y = (columns - 0.5 * WIDTH) * scale
    out = np.full((HEIGHT, WIDTH, 3), PAPER, np.uint8)
    out[(np.abs(z + 0.004) < 0.004) & (np.abs(y) < _HALF)] = PAD
    what, _, tie = kind.partition(" ")
    u, v = y - side, z - gap - size
    inside = np.hypot(u, v) < size if what == "person" else np.maximum(abs(u), abs(v)) < size
    if tie == "grounded":
        out[(np.abs(u) < 0.002) & (v > 0)] = PAD
    out[inside] = BODIES[what]
    out[np.abs(z - target) < 0.6 * scale] = MARK
    return out
