"""Mesh a design with Gmsh: tetrahedra that conform to its conductors, layers and box."""

from __future__ import annotations

import importlib
import math
import re
import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from capsense.errors import MeshError, MissingDependencyError
from capsense.mesh.tetmesh import GROUND, TetMesh

if TYPE_CHECKING:
    from capsense.design.geometry import Surface
    from capsense.design.model import Design, Layer

Array = NDArray[np.float64]
DimTags = list[tuple[int, int]]
_Points = dict[tuple[float, ...], int]
_Lines = dict[tuple[int, int], int]

INSTALL_GMSH = 'pip install "capsense[mesh]"'
INSTALL_LIBRARIES = (
    "apt-get install -y libglu1-mesa libgl1 libxcursor1 libxft2 libxinerama1 libgomp1"
)
"""What the Gmsh wheel needs on a bare Debian or Ubuntu, with what these packages pull in."""

MAX_FACETS = 10_000
"""Most facets per design: 5,000 take some seconds, and the time grows faster than their number."""

_MM = 1e3
"""Gmsh works in millimetres: its geometric tolerances suit numbers of order one."""
_ON_RIM = 1e-6
"""Distance [m] within which a curve counts as lying on a rim."""

_OPTIONS = {
    "General.Terminal": 0,
    "General.NumThreads": 1,
    "Mesh.Algorithm": 6,
    "Mesh.Algorithm3D": 1,
    "Mesh.ElementOrder": 1,
    "Mesh.MeshSizeFromPoints": 0,
    "Mesh.MeshSizeFromCurvature": 0,
    "Mesh.MeshSizeExtendFromBoundary": 0,
    "Mesh.MeshSizeMin": 0,
    "Mesh.MeshSizeMax": 1e22,
    "Mesh.MeshSizeFactor": 1,
    "Mesh.Optimize": 1,
    "Mesh.OptimizeNetgen": 0,
    "Mesh.RandomSeed": 1,
    "Geometry.OCCBoundsUseStl": 0,
    "Geometry.Tolerance": 1e-8,
    "Geometry.ToleranceBoolean": 0,
}
"""Options set for the run, and put back if Gmsh was in use already."""


def mesh_design(
    design: Design,
    *,
    size_at_edges: float = 2e-3,
    size_far: float = 0.05,
    growth: float = 0.3,
    layers_across: float = 0.25,
) -> TetMesh:
    """Mesh a design's box with tetrahedra that conform to its sheets and layers.

    The element size is `size_at_edges` on the rims of every conductor, where charge is singular,
    and grows by `growth` metres per metre of distance up to `size_far`. Inside a layer it stays
    below the layer's thickness divided by `layers_across`.

    Args:
        design: The sensor. Curved conductors are meshed as the facets they come in.
        size_at_edges: Element size [m] at conductor rims.
        size_far: Largest element size [m].
        growth: Increase of the element size per unit distance from the rims.
        layers_across: Elements wanted across the thickness of a layer; below 1, that much flatter
            elements are accepted.

    Returns:
        Node groups: one for each electrode and conductor under its name, and "ground" for the
        outer box. Cell groups: one for each layer; where layers overlap the last one owns the
        cell. Nodes [m] in the sensor frame.

    Raises:
        MeshError: If a size is not positive, there are more than `MAX_FACETS` facets, an electrode
            touches the box or another conductor, names are used twice, a layer is no upright box,
            or Gmsh fails.
        MissingDependencyError: If Gmsh or a shared library that it needs is not installed.
    """
    sizes = {
        "size_at_edges": size_at_edges, "size_far": size_far, "growth": growth,
        "layers_across": layers_across,
    }  # fmt: skip
    for name, value in sizes.items():
        if not (math.isfinite(value) and value > 0):
            raise MeshError(f"{name} must be positive, not {value}")
    if size_far < size_at_edges:
        raise MeshError(f"size_far ({size_far}) is below size_at_edges ({size_at_edges})")
    if shaped := [layer.name for layer in design.layers if layer.facets]:
        raise MeshError(
            f"layer {shaped[0]!r} has a shape of its own, which this mesher does not know; leave "
            "it out, or make it an upright box with size and z"
        )
    surfaces = _named_surfaces(design)
    n_facets = sum(len(surface.facets) for surface in surfaces.values())
    if n_facets > MAX_FACETS:
        raise MeshError(f"{n_facets} facets; at most {MAX_FACETS} can be meshed: simplify the STL")

    gmsh = import_gmsh()
    with _session(gmsh):
        try:
            volumes, sheets = _build_geometry(gmsh, design, surfaces)
            _set_sizes(gmsh, surfaces, sheets, design.layers, volumes, sizes)
            gmsh.model.mesh.generate(3)
            mesh = _extract(gmsh, design, volumes, sheets)
        except MeshError:
            raise
        except Exception as error:  # Gmsh reports every failure as a bare Exception
            raise MeshError(f"Gmsh could not mesh design {design.name!r}: {error}") from error
    _check_apart(mesh, design)
    return mesh


def import_gmsh() -> ModuleType:
    """Import the Gmsh module.

    Raises:
        MissingDependencyError: If the package or a shared library is missing; the message gives the
            install command.
    """
    try:
        return importlib.import_module("gmsh")
    except ImportError as error:
        raise MissingDependencyError(
            f"meshing a design needs Gmsh; install it with: {INSTALL_GMSH}"
        ) from error
    except OSError as error:
        found = re.search(r"lib[\w.+-]+\.so[.\d]*", str(error))
        library = found.group() if found else str(error)
        raise MissingDependencyError(
            f"Gmsh is installed, but the shared library {library} is missing; on Debian or "
            f"Ubuntu install it with: {INSTALL_LIBRARIES}"
        ) from error


@contextmanager
def _session(gmsh: ModuleType) -> Iterator[None]:
    """A fresh Gmsh model; afterwards Gmsh is as it was, initialised by the caller or not."""
    ours = not gmsh.isInitialized()
    if ours:
        broken_pipe = signal.getsignal(signal.SIGPIPE)
        gmsh.initialize(readConfigFiles=False, interruptible=False)
        if broken_pipe is not None and threading.current_thread() is threading.main_thread():
            # Gmsh sets it so that a connection that breaks later would end the process
            signal.signal(signal.SIGPIPE, broken_pipe)
    previous = "" if ours else gmsh.model.getCurrent()
    saved = {name: gmsh.option.getNumber(name) for name in _OPTIONS}
    try:
        for name, value in _OPTIONS.items():
            gmsh.option.setNumber(name, value)
        gmsh.model.add("capsense design")
        yield
    finally:
        if ours:
            gmsh.finalize()
        else:
            gmsh.model.remove()
            if previous in gmsh.model.list():
                gmsh.model.setCurrent(previous)
            for name, value in saved.items():
                gmsh.option.setNumber(name, value)


def _named_surfaces(design: Design) -> dict[str, Surface]:
    surfaces: dict[str, Surface] = {}
    for item in design.sheets:
        if item.name in surfaces or item.name == GROUND:
            raise MeshError(f"the name {item.name!r} is used twice; conductors need unique names")
        surfaces[item.name] = item.surface
    return surfaces


def _build_geometry(
    gmsh: ModuleType, design: Design, surfaces: dict[str, Surface]
) -> tuple[dict[str, list[int]], dict[str, list[int]]]:
    """Cut the box by all sheets and layers; volume tags per layer, face tags per conductor."""
    occ = gmsh.model.occ
    lower, upper = design.domain.lower, design.domain.upper
    box = occ.addBox(*(lower * _MM), *((upper - lower) * _MM))
    tools: DimTags = []
    owners: list[tuple[str, bool]] = []
    for layer in design.layers:
        low, high = np.maximum(layer.lower, lower), np.minimum(layer.upper, upper)
        if not (high > low).all():
            raise MeshError(f"layer {layer.name!r} lies outside the domain")
        tools.append((3, occ.addBox(*(low * _MM), *((high - low) * _MM))))
        owners.append((layer.name, True))
    for name, surface in surfaces.items():
        if (surface.bounds[0] < lower - _ON_RIM).any() or (
            surface.bounds[1] > upper + _ON_RIM
        ).any():
            raise MeshError(f"conductor {name!r} reaches outside the domain")
        for face in _add_surface(occ, surface):
            tools.append((2, face))
            owners.append((name, False))
    pieces = occ.fragment([(3, box)], tools)[1][1:] if tools else []
    occ.synchronize()
    volumes: dict[str, list[int]] = {layer.name: [] for layer in design.layers}
    sheets: dict[str, list[int]] = {name: [] for name in surfaces}
    for (name, is_layer), parts in zip(owners, pieces, strict=True):
        target = volumes if is_layer else sheets
        target[name] += [tag for dim, tag in parts if dim == (3 if is_layer else 2)]
    return volumes, sheets


def _add_surface(occ: Any, surface: Surface) -> list[int]:
    """Add a sheet's facets as plane faces; those without holes share points and lines.

    Holes are cut out: whether Gmsh subtracts or adds an inner loop depends on its direction.
    """
    shared: tuple[_Points, _Lines] = {}, {}
    faces = []
    for facet in surface.facets:
        polygon = facet.polygon
        plates = []
        for ring in (polygon.exterior, *polygon.interiors):
            points, lines = ({}, {}) if polygon.interiors else shared
            corners = facet.to_sensor(np.asarray(ring.coords)[:, :2])
            plates.append((2, occ.addPlaneSurface([_add_loop(occ, corners, points, lines)])))
        parts = occ.cut(plates[:1], plates[1:])[0] if polygon.interiors else plates
        area = sum(occ.getMass(*part) for part in parts)
        if not math.isclose(area, polygon.area * _MM**2, rel_tol=1e-4):
            raise MeshError(f"Gmsh cannot make a face of {polygon.wkt[:200]}")
        faces += [tag for _, tag in parts]
    return faces


def _add_loop(occ: Any, corners: Array, points: _Points, lines: _Lines) -> int:
    """A closed loop of lines through corners [m], shape (c, 3), made or found again."""
    tags: list[int] = []
    for corner in corners * _MM:
        key = tuple(np.round(corner, 6) + 0.0)
        if key not in points:
            points[key] = occ.addPoint(*key)
        if not tags or tags[-1] != points[key]:
            tags.append(points[key])
    if tags[0] != tags[-1]:
        tags.append(tags[0])
    found = []
    for a, b in pairwise(tags):
        if (b, a) in lines:
            found.append(-lines[b, a])
            continue
        if (a, b) not in lines:
            lines[a, b] = occ.addLine(a, b)
        found.append(lines[a, b])
    return occ.addCurveLoop(found)


def _set_sizes(
    gmsh: ModuleType,
    surfaces: dict[str, Surface],
    sheets: dict[str, list[int]],
    layers: Sequence[Layer],
    volumes: dict[str, list[int]],
    sizes: dict[str, float],
) -> None:
    at_edges, far = sizes["size_at_edges"] * _MM, sizes["size_far"] * _MM
    field = gmsh.model.mesh.field
    fields = []
    curves: dict[int, list[int]] = {}
    for name, surface in surfaces.items():
        for tag, length in _rim_curves(gmsh, surface, sheets[name]):
            # Sampled at least every half element, in a few classes of equal sample count.
            samples = 2 ** math.ceil(math.log2(max(2.0 * length / at_edges, 4.0)))
            curves.setdefault(min(samples, 4096), []).append(tag)
    for samples, tags in curves.items():
        distance = field.add("Distance")
        field.setNumbers(distance, "CurvesList", sorted(set(tags)))
        field.setNumber(distance, "Sampling", samples)
        graded = field.add("Threshold")
        field.setNumber(graded, "InField", distance)
        field.setNumber(graded, "SizeMin", at_edges)
        field.setNumber(graded, "SizeMax", far)
        field.setNumber(graded, "DistMin", 0.0)
        field.setNumber(graded, "DistMax", max((far - at_edges) / sizes["growth"], 1e-6))
        fields.append(graded)
    for layer in layers:
        thickness = float((layer.upper - layer.lower).min()) * _MM
        size = min(max(thickness / sizes["layers_across"], at_edges), far)
        inside = field.add("Constant")
        field.setNumbers(inside, "VolumesList", volumes[layer.name])
        field.setNumber(inside, "IncludeBoundary", 1)
        field.setNumber(inside, "VIn", size)
        field.setNumber(inside, "VOut", far)
        fields.append(inside)
    everywhere = field.add("MathEval")
    field.setString(everywhere, "F", f"{far:.17g}")
    smallest = field.add("Min")
    field.setNumbers(smallest, "FieldsList", [*fields, everywhere])
    field.setAsBackgroundMesh(smallest)


def _rim_curves(gmsh: ModuleType, surface: Surface, faces: list[int]) -> list[tuple[int, float]]:
    """Curves of a sheet that lie on its rims, or all of them without rims, and lengths [mm]."""
    bounding = gmsh.model.getBoundary([(2, tag) for tag in faces], combined=False, oriented=False)
    tags = sorted({tag for dim, tag in bounding if dim == 1})
    ends = _line_ends(gmsh, tags)
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    if len(surface.rims) == 0:
        return list(zip(tags, lengths.tolist(), strict=True))
    middle = ends.mean(axis=1) / _MM
    near = np.zeros(len(tags), dtype=bool)
    for start, end in surface.rims:
        along = end - start
        t = np.clip((middle - start) @ along / max(float(along @ along), 1e-300), 0.0, 1.0)
        near |= np.linalg.norm(middle - start - t[:, None] * along, axis=1) < _ON_RIM
    return [(tags[i], float(lengths[i])) for i in np.flatnonzero(near)]


def _line_ends(gmsh: ModuleType, tags: list[int]) -> Array:
    """End points [mm] of straight curves, shape (c, 2, 3)."""
    ends = np.empty((len(tags), 2, 3))
    for row, tag in enumerate(tags):
        low, high = gmsh.model.getParametrizationBounds(1, tag)
        ends[row] = np.reshape(gmsh.model.getValue(1, tag, [low[0], high[0]]), (2, 3))
    return ends


def _extract(
    gmsh: ModuleType, design: Design, volumes: dict[str, list[int]], sheets: dict[str, list[int]]
) -> TetMesh:
    mesher = gmsh.model.mesh
    tags, coordinates, _ = mesher.getNodes()
    points = np.asarray(coordinates, dtype=float).reshape(-1, 3) / _MM
    cell_tags, corner_tags = mesher.getElementsByType(4)
    if len(cell_tags) == 0:
        raise MeshError(f"Gmsh made no tetrahedra for design {design.name!r}")
    cell_number = np.zeros(int(cell_tags.max()) + 1, dtype=np.int32)
    cell_number[cell_tags] = np.arange(len(cell_tags), dtype=np.int32)
    corners, used = np.unique(corner_tags, return_inverse=True)
    node_number = np.full(int(tags.max()) + 1, -1, dtype=np.int32)
    node_number[corners] = np.arange(len(corners), dtype=np.int32)
    position = np.empty((int(tags.max()) + 1, 3))
    position[tags] = points
    points = position[corners]

    lower, upper = design.domain.lower, design.domain.upper
    tolerance = 1e-9 * float((upper - lower).max())
    outer = (np.abs(points - lower) < tolerance) | (np.abs(points - upper) < tolerance)
    node_groups = {GROUND: np.flatnonzero(outer.any(axis=1)).astype(np.int32)}
    for name, faces in sheets.items():
        found = [mesher.getNodes(2, face, includeBoundary=True)[0] for face in faces]
        members = node_number[np.concatenate([np.empty(0, np.uint64), *found]).astype(np.int64)]
        node_groups[name] = members[members >= 0]
    owner = np.full(len(cell_tags), -1, dtype=np.int32)
    for number, regions in enumerate(volumes.values()):
        for region in regions:
            owner[cell_number[mesher.getElementsByType(4, region)[0]]] = number
    return TetMesh(
        points,
        used.reshape(-1, 4).astype(np.int32),
        node_groups,
        {
            name: np.flatnonzero(owner == number).astype(np.int32)
            for number, name in enumerate(volumes)
        },
    )


def _check_apart(mesh: TetMesh, design: Design) -> None:
    """Refuse electrodes that are shorted to the box or to another conductor."""
    owner: dict[int, str] = {int(node): GROUND for node in mesh.node_groups[GROUND]}
    for conductor in design.conductors:
        owner.update({int(node): conductor.name for node in mesh.node_groups[conductor.name]})
    for name in design.electrode_names:
        if len(mesh.node_groups[name]) == 0:
            raise MeshError(f"electrode {name!r} has no nodes: its sheet was lost in the mesh")
        for node in mesh.node_groups[name].tolist():
            if node in owner:
                raise MeshError(f"electrode {name!r} touches {owner[node]!r}: they are shorted")
            owner[node] = name
