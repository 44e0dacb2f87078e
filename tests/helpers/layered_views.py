"""Orthographic views of exact shapes, and layered images spread over the whole of theirs."""

from __future__ import annotations

import numpy as np

from capsense.scene import Layers, Pose, Shape


def view(shape: Shape, pose: Pose, n: int, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Front and back [m] of a convex solid along z, NaN where missed, shape (n, n)."""
    c = (np.arange(n) + 0.5) / n * size - size / 2
    x, y = np.meshgrid(c, c)
    o = np.column_stack([x.ravel(), y.ravel(), np.zeros(n * n)])
    inverse = pose.inverse()
    t = shape.line_intervals(inverse.apply(o), inverse.rotation @ (0.0, 0.0, 1.0))
    t = np.where(t[:, 1:] > t[:, :1], t, np.nan).reshape(n, n, 2)
    return t[..., 0], t[..., 1]


def fields_around(layers: Layers) -> np.ndarray:
    """Front, back and margin on the whole image and a ring of pixels around it.

    Margins beyond the crop are those that pixels far from the body have.
    """
    rows, columns = layers.resolution
    dx, dy = layers.pixel
    slots, crop_rows, crop_columns = layers.grid.shape
    out = np.zeros((slots, rows + 2, columns + 2, 3))
    out[..., 2] = -2.0
    i = round((layers.grid.origin[0] + 0.5 * layers.size[0]) / dx + 0.5)
    j = round((layers.grid.origin[1] + 0.5 * layers.size[1]) / dy + 0.5)
    out[:, j : j + crop_rows, i : i + crop_columns] = layers.fields
    return out
