"""Rigid shapes that are at hand: each is worked out once, whatever its size, and kept.

Those of meshes are also kept as files beside the background fields, and found there by content.
"""

from __future__ import annotations

import hashlib
import logging
import math
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from capsense._dense import mirror
from capsense._thread_pool import ForkSafeRLock
from capsense.errors import FieldError
from capsense.field.cache import default_cache_dir, read_arrays, write_arrays
from capsense.scene import (
    Box,
    Capsule,
    Cylinder,
    Ellipsoid,
    Layers,
    Shape,
    Sphere,
    SurfaceMesh,
    TriMesh,
)
from capsense.scene.shapes import ShapeKind
from capsense.solver.bodies.outline import write_outline
from capsense.solver.bodies.panels import SurfacePanels, panels_of, polygon_panels
from capsense.solver.tree.dynamic_surface import DynamicBody, MeshBody, layer_pieces
from capsense.solver.tree.fine_panels import (
    FACES,
    FinePanelBody,
    FineTree,
    fine_tree_of_mesh,
    wall_squares,
    wide_body,
    wide_pieces,
)
from capsense.solver.tree.inside import table_of
from capsense.solver.tree.rigid import (
    Clusters,
    RigidShape,
    charged_tree,
    rigid_shape,
)
from capsense.solver.tree.subpanels import refined

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

_GRID = 1e-5
"""Vertices are rounded to about this part of the longest extent, so that single precision makes no
difference."""


class PrincipalFrame(NamedTuple):
    """A mesh in its own frame; ``x @ axes.T + middle`` leads back to the frame given."""

    corners: Array
    """Corners of the triangles [m], in an order of their own, shape (m, 3, 3)."""
    axes: Array
    """Unit vectors of the own frame as columns, right-handed, shape (3, 3)."""
    middle: Array
    """Its origin, the centroid of the surface [m], shape (3,)."""


def standing(vertices: Array, faces: NDArray[np.int64]) -> PrincipalFrame:
    """Bring a mesh to the principal axes of its surface, its triangles sorted.

    The frame and the order in which a mesh is given do not matter then, unless it is symmetric:
    axes that its form does not tell apart follow the numbers given.

    Args:
        vertices: Points [m], shape (n, 3).
        faces: Vertex indices, shape (m, 3).
    """
    corners = vertices[faces]
    sides = np.roll(corners, -1, axis=1) - corners
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    area /= area.sum()
    points = np.concatenate([corners.mean(axis=1), *corners.transpose(1, 0, 2)])
    weight = np.concatenate([0.75 * area, *[area / 12] * 3])  # exact to second moments
    middle = weight @ points
    arms = points - middle
    axes = np.linalg.eigh(np.einsum("k,ki,kj->ij", weight, arms, arms))[1]

    skew = weight @ (arms @ axes) ** 3
    axes = axes * np.where(skew < 0, -1.0, 1.0)
    if np.linalg.det(axes) < 0:  # one axis may have ends that look alike
        axes[:, np.argmin(np.abs(skew))] *= -1

    own = (vertices - middle) @ axes
    grid = 2.0 ** math.floor(math.log2(_GRID * float(np.ptp(own, axis=0).max())))
    own = np.round(own / grid)
    order = np.lexsort(own.T)
    place = np.argsort(order)[faces]
    turn = (place.argmin(axis=1)[:, None] + np.arange(3)) % 3
    place = np.take_along_axis(place, turn, axis=1)
    return PrincipalFrame(grid * own[order][place[np.lexsort(place.T[::-1])]], axes, middle)


VERSION = 10
"""Of stored shapes: to be raised when the same mesh would get other panels or functions."""

_log = logging.getLogger(__name__)

_KEPT = 1_000_000_000
"""Shapes that no body has are forgotten, the longest unused first, when all of them take up more
than this [bytes]."""
_FILES = 1_000_000_000
"""Most bytes of files; the oldest are removed first."""
_DIGITS = 9
"""Primitives whose proportions agree to so many digits share their functions."""
_LEAST = 1e-9
"""The least of their lengths, over the largest."""
_EDGED, _MORE = 600, 1.15
"""Shapes with edges have twice as many panels as round ones; those with parts of panels no more
than the first, or the second times as many."""
_TRIANGLES = 1.6
"""So many triangles of a mesh resolve what one panel of a primitive does, mostly rectangles."""
_EACH = 0.2
"""Triangles for each part of a mesh of several parts, over the panels of a primitive."""
_MOST = 2.8
"""No mesh has more triangles than so many times that."""
_WALLS = 2.0
"""Triangles of a dielectric mesh are no wider than so many times its mean thickness, as far as that
many do."""

_LOCK = ForkSafeRLock()
_SHAPES: OrderedDict[Hashable, RigidShape | DynamicBody] = OrderedDict()
_IN_USE: WeakValueDictionary[Hashable, RigidShape | DynamicBody] = WeakValueDictionary()
"""All that are at hand: those above, and others that bodies hold."""

T = TypeVar("T", bound=RigidShape | DynamicBody)


def functions_of(
    shape: Shape,
    count: int,
    *,
    conducting: bool,
    largest: float | None = None,
    finest: float | None = None,
) -> tuple[RigidShape | DynamicBody, float]:
    """Charge functions of any shape from about ``count`` panels, and its size [m].

    Args:
        shape: The shape.
        count: Panels of a round one; others have more.
        conducting: Whether it holds no field inside.
        largest: Shapes of so much surface or more [m²], or that are wide, get panels of a few
            millimetres instead; None for none of them.
        finest: Panels of other conductors are cut into parts where they are longer than this [m];
            None for none of them.
    """
    if isinstance(shape, Layers):
        return DynamicBody(*layer_pieces(shape)), 1.0
    if isinstance(shape, SurfaceMesh):
        return _surface(shape, conducting), 1.0
    if largest is not None and (pieces := wide_pieces(shape, conducting, largest, finest)):
        return in_pieces(shape, pieces, conducting)
    if not conducting:
        finest = None
        if isinstance(shape, TriMesh):  # a wall is polarised by the difference of its two faces
            needed = round(wall_squares(shape) / (_WALLS**2 * _TRIANGLES))
            count = max(count, min(needed, round(_MOST / _TRIANGLES * count)))
    if shape.kind in (ShapeKind.BOX, ShapeKind.CYLINDER):
        edged = 2 * count if finest is None else max(_EDGED, round(_MORE * count))
        count = min(2 * count, edged)
    found, size = rigid(shape, count, conducting=conducting)
    if finest is None:
        return found, size
    power = math.floor(2.0 * math.log2(finest / size))  # to 0.7 times that: sizes can share parts
    side = 2.0 ** (power / 2.0)
    return _kept(
        shape, count, f"_parts {power}", lambda whole, *_: refined(found, side, whole)
    )  # fmt: skip


def _surface(shape: SurfaceMesh, conducting: bool) -> DynamicBody:
    """A surface that deforms; of dielectrics with what is known of their inside."""
    out = MeshBody(shape, conducting)
    if not conducting:
        out.table = table_of(shape.rest)
    return out


def rigid(shape: Shape, count: int, *, conducting: bool = False) -> tuple[RigidShape, float]:
    """Return the charge functions of a shape of some size, and how many times as large it is.

    Args:
        shape: A primitive or a mesh.
        count: About how many panels cover a primitive; meshes get more.
        conducting: Whether it holds no field inside. On a thin conductor, charge on one face does
            nearly what it does on the other: faces are separated in small clusters only, as the
            estimate of the step takes functions for independent.

    Raises:
        SceneError: The shape has no surface that can be covered with panels.
    """
    if isinstance(shape, TriMesh) or not conducting:
        return _kept(shape, count, "_rigid", _rigid_of)
    return _kept(shape, count, "_conductor", _conductor_of)


def _conductor_of(whole: Shape, count: int, _: str) -> RigidShape:
    panels = panels_of(whole, count)
    return rigid_shape(panels, apart=True, most=FACES * panels.thickness)


def in_pieces(shape: Shape, count: int, conducting: bool) -> tuple[DynamicBody, float]:
    """A wide shape of so many panels, without potential coefficients of its own."""

    def make(whole: Shape, count: int, name: str) -> FinePanelBody:
        known = _fine_tree(whole, count, f"{name}-wide") if isinstance(whole, TriMesh) else None
        made = wide_body(whole, count, conducting, known)
        made.keep = lambda block: _inside_of(f"{name}-inside", block)
        return made

    return _kept(shape, count, "_wide" if conducting else "_filled", make)


def _fine_tree(mesh: TriMesh, count: int, key: str) -> FineTree:
    """The many panels of a wide mesh in clusters, from a file if there is one."""

    def packed() -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        made = fine_tree_of_mesh(mesh, count)
        arrays = _packed_panels(made.panels, made.clusters) | {"charge": made.weights}
        return arrays, {"kind": "shape", "key": key, "closed": made.panels.closed}

    arrays, meta = _stored(key, packed)
    return FineTree(*_unpacked_panels(arrays, meta), arrays["charge"])


def _inside_of(key: str, make: Callable[[], Array32]) -> Array32:
    """The impedance of a wide body, from a file if there is one."""

    def packed() -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        block = make()
        lower = {"block": block[np.tri(len(block), dtype=np.bool_)]}
        return lower, {"kind": "shape", "key": key, "size": len(block)}

    arrays, meta = _stored(key, packed)
    return _from_lower(arrays["block"], int(meta["size"]))


def _rigid_of(whole: Shape, count: int, name: str) -> RigidShape:
    if isinstance(whole, TriMesh):
        return _mesh_shape(whole, count, name)
    return rigid_shape(panels_of(whole, count), apart=True)


def _kept(
    shape: Shape, count: int, slot: str, make: Callable[[Shape, int, str], T]
) -> tuple[T, float]:
    """What is made of a shape's form, once, and how many times as large the shape is."""
    held = shape.__dict__.get(f"{slot} {count}")
    if held is not None:
        return held
    size, form, whole = _form(shape, count)
    key: Hashable = (slot, *form)
    with _LOCK:
        found = _IN_USE.get(key)
        if found is not None:
            _SHAPES[key] = found
            _SHAPES.move_to_end(key)
    if found is None:
        digest = hashlib.sha256(repr((VERSION, form)).encode())
        made = make(whole, count, digest.hexdigest()[:32])
        write_outline(made.record, whole)
        made.__dict__["_outline"] = whole  # which the record points to
        with _LOCK:
            found = _SHAPES[key] = _IN_USE.setdefault(key, made)
            _forget(made.nbytes)
    shape.__dict__[f"{slot} {count}"] = cast(T, found), size
    return cast(T, found), size


_added = 0
"""Room of the shapes that came since all were last counted [bytes]."""


def _forget(more: int) -> None:
    """Let the longest unused shapes go where all take up too much room.

    They are counted when new ones have taken up a hundredth of it: impedances come later.

    Args:
        more: Room that a new one takes [bytes].
    """
    global _added
    _added += more
    if _added < _KEPT // 100:
        return
    _added, total = 0, sum(s.nbytes for s in _SHAPES.values())
    while len(_SHAPES) > 1 and total > _KEPT:
        total -= _SHAPES.popitem(last=False)[1].nbytes


def _form(shape: Shape, count: int) -> tuple[float, tuple[Hashable, ...], Shape]:
    """A shape's size [m], what identifies its form, and its form, of size 1."""
    if isinstance(shape, TriMesh):
        digest = hashlib.sha256(repr((count, shape.vertices.shape)).encode())
        for values in (shape.vertices, shape.faces):
            digest.update(np.ascontiguousarray(values).tobytes())
        return 1.0, (digest.hexdigest(),), shape
    size = float(shape.params.max())
    first, second, third = (max(round(x, _DIGITS), _LEAST) for x in (shape.params / size).tolist())
    # made from the rounded form, so that bits do not hang on which of its sizes was met first
    whole: Shape
    match shape.kind:
        case ShapeKind.BOX:
            whole = Box((2 * first, 2 * second, 2 * third))
        case ShapeKind.SPHERE:
            whole = Sphere(first)
        case ShapeKind.CAPSULE:
            whole = Capsule(first, 2 * second)
        case ShapeKind.CYLINDER:
            whole = Cylinder(first, 2 * second)
        case ShapeKind.ELLIPSOID:
            whole = Ellipsoid((first, second, third))
        case _:
            whole = shape  # has no panels, and is refused as that
    return size, (int(shape.kind), first, second, third, count), whole


# -- meshes ---------------------------------------------------------------------------------------


def _stored(
    key: str, make: Callable[[], tuple[dict[str, NDArray[Any]], dict[str, Any]]]
) -> tuple[Mapping[str, NDArray[Any]], Mapping[str, Any]]:
    """Arrays and what is said of them, from a file if there is one; else they are made and kept."""
    file = default_cache_dir() / "shapes" / f"{key}.npz"
    try:
        return read_arrays(file, kind="shape", key=key)
    except FileNotFoundError:
        pass
    except FieldError as error:
        _log.warning("a stored shape is not used, it is made again: %s", error)
    arrays, meta = make()
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        write_arrays(file, arrays, meta)
        _make_room(file.parent)
    except OSError as error:
        _log.info("a shape cannot be kept in %s: %s", file.parent, error)
    return arrays, meta


def _mesh_shape(shape: TriMesh, count: int, key: str) -> RigidShape:
    def made() -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        wanted = count * min(_MOST, max(_TRIANGLES, _EACH * shape.parts))
        own = standing(shape.vertices, shape.faces)
        form = rigid_shape(panels_of(own.corners, round(wanted)))
        return _packed(_turned(form, own.axes, own.middle), key)

    # as processes that read the file have it, to the last bit
    return _unpacked(*_stored(key, made))


def _turned(shape: RigidShape, axes: Array, middle: Array) -> RigidShape:
    """A shape taken to another frame, ``x @ axes.T + middle``: energies stay what they are."""
    old = shape.panels
    panels = polygon_panels(old.corners @ axes.T + middle, old.parts, old.closed)
    tree = charged_tree(panels, shape.tree, _charges(shape))
    return RigidShape(panels, tree, shape.potential_coefficients, shape.capacitance)


def _charges(shape: RigidShape) -> Array:
    """Share of each panel in the equilibrium charge, shape (n,)."""
    single = shape.tree.panel >= 0
    charge = np.empty(len(shape.panels))
    charge[shape.tree.panel[single]] = shape.tree.charge[single]
    return charge


def _packed(shape: RigidShape, key: str) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """What a file holds of a shape of triangles."""
    panels = shape.panels
    arrays = _packed_panels(panels, shape.tree)
    arrays["charge"] = _charges(shape)
    arrays["energy"] = shape.potential_coefficients[np.tri(len(panels), dtype=np.bool_)]
    return arrays, {
        "kind": "shape",
        "key": key,
        "closed": panels.closed,
        "capacitance": shape.capacitance,
    }


def _packed_panels(panels: SurfacePanels, tree: Clusters) -> dict[str, NDArray[Any]]:
    """What a file holds of triangles in clusters."""
    return {
        "corners": panels.corners[:, :3],
        "parts": panels.parts.astype(np.int32),
        "kids": tree.children.astype(np.int32),
        "function": tree.function.astype(np.int32),
        "panel": tree.panel.astype(np.int32),
    }


def _unpacked_panels(
    arrays: Mapping[str, NDArray[Any]], meta: Mapping[str, Any]
) -> tuple[SurfacePanels, Clusters]:
    """Triangles in clusters, from what a file holds of them."""
    corners = arrays["corners"][:, [0, 1, 2, 2]]
    panels = polygon_panels(corners, arrays["parts"].astype(np.int64), bool(meta["closed"]))
    return panels, Clusters(*(arrays[k].astype(np.int64) for k in ("kids", "function", "panel")))


def _from_lower(values: Array32, n: int) -> Array32:
    """A symmetric matrix from its lower triangle, row by row, (n, n)."""
    out = np.zeros((n, n), np.float32)
    out[np.tri(n, dtype=np.bool_)] = values
    mirror(out)
    return out


def _unpacked(arrays: Mapping[str, NDArray[Any]], meta: Mapping[str, Any]) -> RigidShape:
    panels, clusters = _unpacked_panels(arrays, meta)
    energy = _from_lower(arrays["energy"], len(panels))
    return RigidShape(
        panels, charged_tree(panels, clusters, arrays["charge"]), energy,
        float(meta["capacitance"]),
    )  # fmt: skip


def _make_room(folder: Path) -> None:
    """Remove the oldest files where there are too many."""
    known = [(f.stat().st_mtime, f.stat().st_size, f) for f in folder.glob("*.npz")]
    room = _FILES - sum(size for _, size, _ in known)
    for _, size, file in sorted(known):
        if room >= 0:
            break
        file.unlink(missing_ok=True)
        room += size
