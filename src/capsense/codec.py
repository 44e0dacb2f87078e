"""Shapes, bodies, materials and designs as plain data, and back to the last bit.

Scenario files, control messages and recordings name shapes by :data:`SHAPES`. Recordings hold
bodies as the fields of their messages, and a design as JSON: the geometry itself, and not the file
it was read from, which may name STL files that change.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon

from capsense.design.model import Design
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
from capsense.scene.materials import ColeCole, Ties

Fields = dict[str, Any]

SHAPES: dict[str, type[Box | Sphere | Capsule | Cylinder | Ellipsoid]] = {
    "box": Box,
    "sphere": Sphere,
    "capsule": Capsule,
    "cylinder": Cylinder,
    "ellipsoid": Ellipsoid,
}
"""Shapes that are a few lengths, by the names that files and messages have for them."""
CHANGING = Layers | SurfaceMesh
"""Shapes that are new in every step, and large."""
_OLD_LAYERS = 11
"""Numbers in the ``sizes`` of layered images as they were written once."""


@cache
def lengths_of(kind: str) -> dict[str, int]:
    """Names of the lengths that a shape of :data:`SHAPES` has, each with how many it is."""
    hints = get_type_hints(SHAPES[kind])
    return {f.name: len(get_args(hints[f.name])) or 1 for f in fields(SHAPES[kind])}


def shape_fields(shape: Shape | RestSurface, rest: int | None = None) -> Fields:
    """Fields of a ``Shape`` message, without its id.

    Args:
        shape: A shape, or what a deforming surface keeps.
        rest: Id of what a :class:`SurfaceMesh` keeps.

    Raises:
        RecordingError: A kind of shape that messages do not have.
    """
    sizes: Any = ()
    vertices, faces, values = np.empty(0), np.empty(0, np.uint32), np.empty(0, np.float32)
    kind = "rest" if isinstance(shape, RestSurface) else shape.kind.name.lower()
    match shape:
        case TriMesh() | RestSurface():
            sizes = (shape.thickness,) if isinstance(shape, RestSurface) else ()
            vertices, faces = shape.vertices.ravel(), shape.faces.ravel().astype(np.uint32)
        case SurfaceMesh() if rest is not None:
            sizes, vertices = (rest,), shape.vertices.ravel()
        case Layers():
            sizes = (*shape.size, *shape.front.shape)
            values = np.concatenate([shape.front.ravel(), shape.back.ravel()])
        case _ if isinstance(shape, SHAPES.get(kind, ())):
            sizes = np.hstack([getattr(shape, name) for name in lengths_of(kind)])
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
            case kind if kind in SHAPES:
                return SHAPES[kind](*((tuple(s),) if 3 in lengths_of(kind).values() else s))
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
    tied, grounding = isinstance(body.grounding, float), str(body.grounding)
    if isinstance(body.grounding, Ties):
        grounding = f"ties {float(body.grounding.earth)!r} {float(body.grounding.local)!r}"
    return {
        "name": body.name or "",
        "material": matter.name,
        "eps_r": matter.eps_r,
        "sigma": matter.sigma,
        "dispersion": np.array(terms, dtype=float),
        "grounding": "capacitance" if tied else grounding,
        "farads": body.grounding if tied else 0.0,
        "conductor": body.conductor or "",
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
        if not tied and grounding.startswith("ties "):
            grounding = Ties(*map(float, grounding.split()[1:]))
        conductor = getattr(message, "conductor", None) or None  # older files have none
        name = message.name or None
        return Body(shapes[message.shape], Pose(), matter, grounding, name, conductor=conductor)
    except (SceneError, TypeError, ValueError) as error:
        raise RecordingError(f"body {message.id} is damaged: {error}") from None


def design_to_json(design: Design) -> str:
    """Write a design down. Python prints floats so that they are read back exactly."""
    return json.dumps({**_plain(design), "content_hash": design.content_hash()})


def design_from_json(text: str | bytes) -> Design:
    """The design that was written down.

    Raises:
        RecordingError: The text is damaged.
    """
    try:
        data = json.loads(text)
        design: Design = _read(Design, data)
        whole = design.content_hash() == data["content_hash"]
    except (KeyError, TypeError, ValueError, RecursionError, shapely.errors.ShapelyError) as error:
        raise RecordingError(f"the recorded design is damaged: {error!r}") from None
    if not whole:
        raise RecordingError("the recorded design is damaged: its content hash differs")
    return design


def _plain(value: Any) -> Any:
    """Dataclasses, arrays and polygons as JSON has them; a polygon is its ``rings``."""
    if is_dataclass(value):
        named = {f.name: _plain(getattr(value, f.name)) for f in fields(value)}
        return {("rings" if key == "polygon" else key): item for key, item in named.items()}
    if isinstance(value, Polygon):
        rings = (value.exterior, *value.interiors)
        return [shapely.get_coordinates(ring).tolist() for ring in rings]
    if isinstance(value, np.ndarray | Enum):
        return value.tolist() if isinstance(value, np.ndarray) else value.value
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    return value


def _read(kind: Any, data: Any) -> Any:
    """What :func:`_plain` made of an object of a type."""
    if isinstance(kind, type) and is_dataclass(kind):
        types = get_type_hints(kind)
        keys = {name: "rings" if name == "polygon" else name for name in types}
        given = {n: _read(types[n], data[key]) for n, key in keys.items() if key in data}
        return kind(**given)  # what older recordings lack has a default
    if kind is Polygon:
        return Polygon(data[0], data[1:])
    if get_origin(kind) is UnionType:  # of something and None
        return None if data is None else _read(get_args(kind)[0], data)
    if get_origin(kind) is tuple:
        of = get_args(kind)[0]
        return tuple(_read(of, item) for item in data)
    if get_origin(kind) is Mapping:
        of = get_args(kind)[1]
        return {key: _read(of, item) for key, item in data.items()}
    if get_origin(kind) is np.ndarray:
        array = np.array(data)
        return array if array.size else array.reshape(-1, 2, 3)  # a surface without rims
    return kind(data) if isinstance(kind, type) and issubclass(kind, Enum) else data
