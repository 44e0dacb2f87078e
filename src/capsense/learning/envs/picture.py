"""Pictures of environments without OpenGL: rays of MuJoCo, and sections drawn by NumPy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capsense._style import LOUD, QUIET

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
_LINK = (150, 156, 162)
_CUTOFF = 20.0
"""Rays end here [m]."""
_THROUGH = 0.02
"""Electrodes are seen through so much of what carries them [m]."""
_INSIDE = np.array([[a, b, 8 - a - b] for a in range(9) for b in range(9 - a)], float) / 8.0
"""Points of a triangle that are drawn, as weights of its corners."""


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


@dataclass(frozen=True)
class Camera:
    """Where a picture is taken from."""

    place: tuple[float, float, float]
    """[m], in the world."""
    to: tuple[float, float, float]
    """The point in the middle of the picture [m]."""
    view: float = 40.0
    """Height of the picture [°]."""

    def axes(self) -> Array:
        """Right, down and ahead as columns, shape (3, 3)."""
        ahead = np.subtract(self.to, self.place)
        ahead = ahead / np.linalg.norm(ahead)
        right = np.cross(ahead, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        return np.column_stack([right, np.cross(ahead, right), ahead])


def draw_world(
    model: Any, data: Any, camera: Camera, electrodes: Sequence[tuple[Any, Array, float]]
) -> Picture:
    """The geoms of a world of MuJoCo, by rays, and electrodes on top of them.

    Args:
        model: The model.
        data: Its state.
        camera: Where the picture is taken from.
        electrodes: The site of each, its triangles in the site's frame [m], shape (t, 3, 3), and
            how loud it is, from 0 to 1.

    Returns:
        Shape (240, 320, 3).
    """
    import mujoco

    axes, focus = camera.axes(), 0.5 * HEIGHT / np.tan(np.radians(0.5 * camera.view))
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    inward = np.full(rows.shape, focus)
    rays = np.stack([columns + 0.5 - 0.5 * WIDTH, rows + 0.5 - 0.5 * HEIGHT, inward], -1)
    rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).reshape(-1, 3) @ axes.T
    count = len(rays)
    hit, far = np.zeros(count, np.int32), np.zeros(count)
    normal, place = np.zeros(3 * count), np.array(camera.place)
    mujoco.mj_multiRay(
        model, data, place, rays.ravel(), None, 1, -1, hit, far, normal, count, _CUTOFF
    )
    light = 0.35 + 0.65 * np.abs((normal.reshape(-1, 3) * rays).sum(axis=1))
    person = model.geom_bodyid == model.body("limb").id
    colours = np.where(person[:, None], BODIES["person"], _LINK)
    lit = np.where((hit >= 0)[:, None], colours[hit] * light[:, None], PAPER)
    out = lit.astype(np.uint8).reshape(HEIGHT, WIDTH, 3)
    depth = np.where(hit >= 0, far, np.inf).reshape(HEIGHT, WIDTH)
    for site, triangles, strength in electrodes:
        points = (_INSIDE @ triangles).reshape(-1, 3)
        seen = (points @ site.xmat.reshape(3, 3).T + site.xpos - place) @ axes
        pixel = focus * seen[:, :2] / seen[:, 2:] + (0.5 * WIDTH, 0.5 * HEIGHT)
        column, row = pixel.astype(int).T
        inside = (row >= 0) & (row < HEIGHT) & (column >= 0) & (column < WIDTH) & (seen[:, 2] > 0)
        row, column, distance = row[inside], column[inside], np.linalg.norm(seen[inside], axis=1)
        front = distance < depth[row, column] + _THROUGH
        shade = (1.0 - strength) * np.array(QUIET) + strength * np.array(LOUD)
        out[row[front], column[front]] = shade.astype(np.uint8)
    return out
