"""Shapes and bodies as fields of messages, and back to the last bit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from capsense.errors import RecordingError, SceneError
from capsense.scene import (
    Body,
    Box,
    Capsule,
    Cylinder,
    Ellipsoid,
    LayerGrid,
    Layers,
    Material,
    Pose,
    Shape,
    Sphere,
    TriMesh,
)
from capsense.scene.dispersion import ColeCole

Fields = dict[str, Any]


def shape_fields(shape: Shape) -> Fields:
    """Fields of a ``Shape`` message, without its id.

    Raises:
        RecordingError: A kind of shape that messages do not have.
    """
    kind = shape.kind.name.lower()
    sizes: tuple[float, ...] = ()
    vertices, faces, values = np.empty(0), np.empty(0, np.uint32), np.empty(0, np.float32)
    match shape:
        case Box(size):
            sizes = size
        case Sphere(radius):
            sizes = (radius,)
        case Capsule(radius, length) | Cylinder(radius, length):
            sizes = (radius, length)
        case Ellipsoid(radii):
            sizes = radii
        case TriMesh():
            sizes = (shape.cell,)
            vertices, faces = shape.vertices.ravel(), shape.faces.ravel().astype(np.uint32)
        case Layers():
            g = shape.grid
            sizes = (*shape.size, *shape.resolution, *g.origin, g.inverse, *g.shape)
            values = g.values
        case _:
            raise RecordingError(
                f"shape {shape!r} cannot be recorded; use one of capsense, such as TriMesh"
            )
    numbers = np.array(sizes, dtype=float)
    return {"kind": kind, "sizes": numbers, "vertices": vertices, "faces": faces, "values": values}


def read_shape(message: Any) -> Shape:
    """The shape of a ``Shape`` message.

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
            case "mesh":
                faces = message.faces.reshape(-1, 3).astype(np.int64)
                return TriMesh(message.vertices.reshape(-1, 3), faces, cell=s[0])
            case "layers":
                width, height, rows, columns, x, y, z, inverse, *shape = s
                values = np.array(message.values)
                grid = LayerGrid(
                    values, np.array(shape, dtype=np.int64), np.array([x, y, z]), inverse
                )
                return Layers.from_grid(grid, (width, height), (int(rows), int(columns)))
    except (SceneError, TypeError, ValueError, IndexError) as error:
        raise RecordingError(f"shape {message.id} is damaged: {error}") from None
    raise RecordingError(f"shape {message.id} is a {message.kind!r}, which is not known here")


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
