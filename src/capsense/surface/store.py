"""Rigid shapes that are at hand: each is worked out once, whatever its size, and kept."""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict

import numpy as np

from capsense.scene import Shape
from capsense.scene.shape import ShapeKind
from capsense.surface.panels import panels_of
from capsense.surface.rigid import RigidShape, rigid_shape

_KEPT = 512_000_000
"""Shapes are forgotten, the longest unused first, when they take up more than this [bytes]."""
_DIGITS = 9
"""Primitives whose proportions agree to so many digits share their functions."""

_LOCK = threading.Lock()
_SHAPES: OrderedDict[tuple[object, ...], RigidShape] = OrderedDict()


def rigid(shape: Shape, count: int) -> tuple[RigidShape, float]:
    """Return the charge functions of a shape of some size, and how many times as large it is.

    Args:
        shape: A primitive or a mesh.
        count: About how many panels cover it.

    Raises:
        SceneError: The shape has no surface that can be covered with panels.
    """
    held = shape.__dict__.get("_rigid")
    if held is not None and held[0] == count:
        return held[1], held[2]
    size, key = _key(shape, count)
    with _LOCK:
        found = _SHAPES.get(key)
        if found is not None:
            _SHAPES.move_to_end(key)
    if found is None:
        panels = panels_of(shape, count)
        found = rigid_shape(panels.scaled(1.0 / size))
        with _LOCK:
            _SHAPES[key] = found
            while len(_SHAPES) > 1 and sum(s.energy.nbytes + s.free.nbytes for s in _SHAPES.values()) > _KEPT:
                _SHAPES.popitem(last=False)
    shape.__dict__["_rigid"] = (count, found, size)
    return found, size


def _key(shape: Shape, count: int) -> tuple[float, tuple[object, ...]]:
    """A shape's size [m], and what tells its form from others."""
    if shape.kind == ShapeKind.MESH:
        digest = hashlib.sha256()
        for name in ("vertices", "faces"):
            digest.update(np.ascontiguousarray(getattr(shape, name)).tobytes())
        return 1.0, (digest.hexdigest(), count)
    size = float(shape.params.max())
    form = tuple(round(x, _DIGITS) for x in (shape.params / size).tolist())
    return size, (int(shape.kind), form, count)
