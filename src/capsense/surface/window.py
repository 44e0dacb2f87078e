"""Long bodies, cut to the part around the domain: their panels would be too large for it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from capsense.scene import Box, Capsule, Cylinder
from capsense.scene.shapes import Shape

Array = NDArray[np.float64]


def windowed(shape: Shape, middle: Array, reach: float) -> tuple[Shape, Array]:
    """Cut a box, cylinder or capsule to a length that reaches through the domain.

    The part keeps its size while the body moves, so that its charge functions are made once.

    Args:
        shape: Any shape.
        middle: Centre of the domain in the shape's frame [m], shape (3,).
        reach: Diagonal of the domain [m]. What is no longer along any axis stays whole.

    Returns:
        The part, and its centre in the shape's frame [m], shape (3,).
    """
    if isinstance(shape, Box):
        size = np.array(shape.size)
    elif isinstance(shape, Cylinder | Capsule):
        size = np.array([0.0, 0.0, shape.length])
    else:
        return shape, np.zeros(3)
    if size.max() <= reach:
        return shape, np.zeros(3)
    part = np.minimum(size, reach)
    at = np.clip(middle, 0.5 * (part - size), 0.5 * (size - part))
    if isinstance(shape, Box):
        return Box(tuple(part.tolist())), at
    return type(shape)(shape.radius, float(part[2])), at
