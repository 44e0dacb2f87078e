"""Shapes and bodies as fields of messages, and back to the last bit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capsense.errors import RecordingError, SceneError
from capsense.scene import (
    Body,
    Box,
    Capsule,
    Cylinder,
    Ellipsoid,
    Layers,
    Material,
    Pose,
    RestSurface,
    Shape,
    Sphere,
    SurfaceMesh,
    TriMesh,
)
from capsense.scene.materials import ColeCole

Fields = dict[str, Any]

CHANGING = Layers | SurfaceMesh
"""Shapes that are new in every step, and large."""
_OLD_LAYERS = 11
"""Numbers in the ``sizes`` of layered images as they were written once."""


def shape_fields(shape: Shape | RestSurface, rest: int | None = None) -> Fields:
    """Fields of a ``Shape`` message, without its id.

    Args:
        shape: A shape, or what a deforming surface keeps.
        rest: Id of what a :class:`SurfaceMesh` keeps.

    Raises:
        RecordingError: A kind of shape that messages do not have.
    """
    sizes: tuple[float, ...] = ()
    vertices, faces, values = np.empty(0), np.empty(0, np.uint32), np.empty(0, np.float32)
    kind = "rest" if isinstance(shape, RestSurface) else shape.kind.name.lower()
    match shape:
        case Box(size):
            sizes = size
        case Sphere(radius):
            sizes = (radius,)
        case Capsule(radius, length) | Cylinder(radius, length):
            sizes = (radius, length)
        case Ellipsoid(radii):
            sizes = radii
        case TriMesh() | RestSurface():
            sizes = (shape.thickness,) if isinstance(shape, RestSurface) else ()
            vertices, faces = shape.vertices.ravel(), shape.faces.ravel().astype(np.uint32)
        case SurfaceMesh() if rest is not None:
            sizes, vertices = (rest,), shape.vertices.ravel()
        case Layers():
            sizes = (*shape.size, *shape.front.shape)
            values = np.concatenate([shape.front.ravel(), shape.back.ravel()])
        case _:
            raise RecordingError(
                f"shape {shape!r} cannot be recorded; use one of capsense, such as TriMesh"
            )
    numbers = np.array(sizes, dtype=float)
    return {"kind": kind, "sizes": numbers, "vertices": vertices, "faces": faces, "values": values}


def read_shape(message: Any, rests: Mapping[int, RestSurface] | None = None) -> Shape:
    """The shape of a ``Shape`` message that is not of kind "rest".

    Args:
        message: The message.
        rests: What deforming surfaces keep, by the ids of their messages.

    Raises:
        RecordingError: The message makes no shape.
    """
    s = message.sizes.tolist()
    try:
        match message.kind:
            case "box":
                return Box(tuple(s))
            case "sphere":
                return Sphere(*s)
            case "capsule":
                return Capsule(*s)
            case "cylinder":
                return Cylinder(*s)
            case "ellipsoid":
                return Ellipsoid(tuple(s))
            case "mesh":  # once, its size held the spacing of a grid
                return TriMesh(*_triangles(message))
            case "surface":
                return SurfaceMesh(message.vertices.reshape(-1, 3), (rests or {})[int(s[0])])
            case "layers" if len(s) == _OLD_LAYERS:
                return _old_layers(s, message.values)
            case "layers":
                width, height, *shape = s
                front, back = message.values.reshape(2, *(int(n) for n in shape))
                return Layers(front, back, (width, height))
    except (SceneError, TypeError, ValueError, IndexError, KeyError, OverflowError) as error:
        raise RecordingError(f"shape {message.id} is damaged: {error}") from None
    raise RecordingError(f"shape {message.id} is a {message.kind!r}, which is not known here")


def read_rest(message: Any) -> RestSurface:
    """What a deforming surface keeps, from a ``Shape`` message of kind "rest".

    Raises:
        RecordingError: The message makes no surface.
    """
    try:
        return RestSurface(*_triangles(message), *message.sizes.tolist())
    except (SceneError, TypeError, ValueError) as error:
        raise RecordingError(f"shape {message.id} is damaged: {error}") from None


def _triangles(message: Any) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    return message.vertices.reshape(-1, 3), message.faces.reshape(-1, 3).astype(np.int64)


def _old_layers(sizes: list[float], values: NDArray[np.float32]) -> Layers:
    """A layered image as it was written when the online solver was a lattice.

    ``sizes`` are width, height, rows, columns, origin (x, y, z) of a cropped grid, the reciprocal
    of a pixel's width, slots, rows and columns of the grid. ``values`` are two numbers, ten for
    every slot, then front, back and margin of every pixel of the grid; margins above zero tell
    where there is an interval.
    """
    width, height, x, y = sizes[0], sizes[1], sizes[4], sizes[5]
    rows, columns, slots, tall, wide = (int(n) for n in (*sizes[2:4], *sizes[8:]))
    fields = values[2 + 10 * slots :][: 3 * slots * tall * wide].reshape(slots, tall, wide, 3)
    slot, row, column = np.nonzero(fields[..., 2] > 0)
    front, back = fields[slot, row, column, :2].T
    row = row + round((y + 0.5 * height) / height * rows - 0.5)
    column = column + round((x + 0.5 * width) / width * columns - 0.5)
    if len(row) and min(row.min(), column.min()) < 0:
        raise ValueError("a pixel lies outside the image")
    out = np.full((2, slots, rows, columns), np.nan, np.float32)
    out[:, slot, row, column] = front, back
    return Layers(out[0], out[1], (width, height))


def body_fields(body: Body) -> Fields:
    """Fields of a ``Body`` message, without its id and its shape."""
    matter, law = body.material, body.material.dispersion
    terms = () if law is None else (law.eps_inf, law.sigma, *(v for t in law.terms for v in t))
    tied = not isinstance(body.grounding, str)
    return {
        "name": body.name or "",
        "material": matter.name,
        "eps_r": matter.eps_r,
        "sigma": matter.sigma,
        "dispersion": np.array(terms, dtype=float),
        "grounding": "capacitance" if tied else body.grounding,
        "farads": body.grounding if tied else 0.0,
    }


def read_body(message: Any, shapes: Mapping[int, Shape]) -> Body:
    """The body of a ``Body`` message, at the origin.

    Raises:
        RecordingError: The message makes no body, or its shape is not known.
    """
    if message.shape not in shapes:
        raise RecordingError(f"body {message.id} has shape {message.shape}, which is missing")
    try:
        law = None
        if len(message.dispersion):
            eps_inf, sigma, *rest = message.dispersion.tolist()
            terms = [(step, tau, alpha) for step, tau, alpha in np.reshape(rest, (-1, 3)).tolist()]
            law = ColeCole(eps_inf, tuple(terms), sigma)
        matter = Material(message.material, message.eps_r, message.sigma, dispersion=law)
        tied = message.grounding == "capacitance"
        grounding = message.farads if tied else message.grounding
        return Body(shapes[message.shape], Pose(), matter, grounding, message.name or None)
    except (SceneError, TypeError, ValueError) as error:
        raise RecordingError(f"body {message.id} is damaged: {error}") from None
