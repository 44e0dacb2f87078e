"""What a sensor is: electrodes, dielectric layers and other conductors in a grounded box.

This module reads design files, and checks them.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.geometry import Polygon
from shapely.geometry.polygon import orient

from capsense._validate import nearest, read_toml, suggest
from capsense.design.cover import read_cover
from capsense.design.film import Film, bend_sheet, is_level, read_bend
from capsense.design.geometry import (
    PLACEMENT_KEYS,
    TOUCH,
    DesignTable,
    Facet,
    Placement,
    Surface,
    boundary_segments,
    in_plane_of,
    length_unit,
    read_placement,
)
from capsense.design.model import (
    RESOLUTIONS,
    Conductor,
    Design,
    Domain,
    Electrode,
    Layer,
    Role,
    check_design,
)
from capsense.design.shapes import (
    SHAPES,
    box_surface,
    cylinder_surface,
    planar_surface,
    polygon,
    polygons_surface,
    prism_facets,
)
from capsense.errors import DesignError

LAYER_EPS_R: dict[str, float] = {
    name.lower(): table["eps_r"]
    for name, table in read_toml(
        Path(__file__).parents[1] / "materials.toml", "material", DesignError
    )["materials"].items()
    if "sigma" not in table
}
"""Relative permittivity of the insulators among the materials by name (lower case)."""

LAYER_KEYS = ("name", "material", "eps_r")
SOLIDS: dict[str, tuple[tuple[str, ...], Callable[[DesignTable, Placement], Surface]]] = {
    "box": (("size",), box_surface),
    "cylinder": (("radius", "length"), cylinder_surface),
}
"""Closed surfaces by name: the keys that they read, and what makes them."""
STL_KEYS = ("file", "unit", "scale", "part", "closed")
TOP_KEYS = (
    "name",
    "description",
    "grounding",
    "domain",
    "electrode",
    "electrodes_from_stl",
    "layer",
    "cover",
    "conductor",
    "bend",
    "build",
)


def available_designs() -> tuple[str, ...]:
    """Names of the designs that come with the package, sorted."""
    folder = resources.files("capsense.design") / "library"
    return tuple(
        sorted(p.name.removesuffix(".toml") for p in folder.iterdir() if p.name.endswith(".toml"))
    )


def load_design(name_or_path: str | Path) -> Design:
    """Load a sensor design.

    Args:
        name_or_path: Name of a packaged design, see :func:`available_designs`, or path to a design
            ``.toml``.

    Returns:
        The checked design; lengths in metres, in the sensor frame (origin at the centre of the
        electrode plane, z out of the sensor).

    Raises:
        DesignError: If there is no such design, or if anything in its file is wrong; the message
            names the file, the item, the value and the fix.
    """
    if not isinstance(name_or_path, str | os.PathLike):
        own = ", such as its design" if hasattr(name_or_path, "design") else ""
        raise DesignError(
            f"the design is of {type(name_or_path).__name__}; give a packaged name, the path of a "
            f".toml file, or a Design{own}"
        )
    text = str(name_or_path)
    if isinstance(name_or_path, str) and not text.endswith(".toml") and not set("/\\") & set(text):
        names = available_designs()
        if text not in names:
            close = nearest(text, names)
            hint = f"did you mean {close!r}? " if close else ""
            raise DesignError(
                f"no packaged design is named {text!r}; {hint}valid names are {', '.join(names)}; "
                "a design of your own is loaded by the path of its .toml file"
            )
        with resources.as_file(resources.files("capsense.design") / "library") as folder:
            return _load_file(folder / f"{text}.toml")
    return _load_file(Path(name_or_path))


def _load_file(path: Path) -> Design:
    packaged = f", or give one of the packaged names {', '.join(available_designs())}"
    data = read_toml(path, "design", DesignError, hint=packaged)
    return parse_design(data, source=path.name, folder=path.parent)


def parse_design(
    data: Mapping[str, Any], *, source: str = "design", folder: Path | None = None
) -> Design:
    """Build a checked design from the content of a design file, given as nested dicts.

    Args:
        data: What ``tomllib`` makes of a design file.
        source: Name of the file, for messages.
        folder: Folder that STL files are relative to; the current one by default.

    Raises:
        DesignError: If anything is wrong; the message names the item, the value and the fix.
    """
    top = DesignTable(data, source, "design")
    top.only(TOP_KEYS)
    top.needs("name", "domain")
    name = top.string("name")
    description = top.text("description")
    domain = _read_domain(DesignTable(top.raw("domain", "a [domain] table"), source, "domain"))
    limit = max(domain.size)
    where = folder if folder is not None else Path()

    def items(key: str) -> list[DesignTable]:
        out = []
        for number, raw in enumerate(top.tables(key), start=1):
            label = raw.get("name") if isinstance(raw, Mapping) else None
            tag = f'{key} "{label}"' if isinstance(label, str) and label else f"{key} {number}"
            out.append(DesignTable(raw, source, tag, limit))
        return out

    electrodes = [_read_electrode(t, where, domain) for t in items("electrode")]
    for table in items("electrodes_from_stl"):
        from capsense.design.stl_shape import read_imprint_group

        electrodes += read_imprint_group(table, where, domain)
    layers = [_read_layer(t, where) for t in items("layer")]
    stack = tuple(layers)
    unit = length_unit([e.surface.area for e in electrodes]) if electrodes else 1.0
    electrodes = [Electrode(e.name, snap_to_layers(e.surface, stack, unit)) for e in electrodes]
    conductors = [_read_conductor(t, where, domain, electrodes) for t in items("conductor")]
    conductors = [
        Conductor(c.name, c.role, snap_to_layers(c.surface, stack, unit)) for c in conductors
    ]
    cover = None
    covers = items("cover")
    for table in covers:
        if len(covers) > 1 or "bend" in data:
            fix = "describe those below it as [[layer]]" if len(covers) > 1 else "remove [bend]"
            raise table.error(f"a flat design can have one cover; {fix}")
        cover, layer, fabric = read_cover(
            table, _read_material(table), domain, [*electrodes, *conductors], layers
        )
        layers.append(layer)
        conductors += [fabric] if fabric is not None else []
    film = None
    if "bend" in data:
        radius = read_bend(DesignTable(data["bend"], source, "bend", limit))
        if slabs := [layer.name for layer in layers if not layer.facets]:
            raise DesignError(
                f'{source}: layer "{slabs[0]}": flat layers cannot be bent; remove them or [bend], '
                'or give a shape = "cylinder" or "stl", which keeps its place'
            )
        sheets = {e.name: e.surface for e in electrodes} | {c.name: c.surface for c in conductors}
        film = Film(radius, {name: s for name, s in sheets.items() if is_level(s)})
        electrodes = [Electrode(e.name, _bent(e, radius, source)) for e in electrodes]
        conductors = [Conductor(c.name, c.role, _bent(c, radius, source)) for c in conductors]
    build = _read_build(DesignTable(data.get("build", {}), source, "build"))
    design = Design(
        name=name,
        domain=domain,
        electrodes=tuple(electrodes),
        layers=tuple(layers),
        conductors=tuple(conductors),
        description=description,
        build=build,
        cover=cover,
        film=film,
    )
    check_design(design, source=source)
    if "grounding" not in data:
        return design
    try:
        return design.with_grounding(data["grounding"])
    except DesignError as error:
        raise top.error(str(error)) from None


def _read_domain(table: DesignTable) -> Domain:
    table.only(("size", "backplane", "open"))
    table.needs("size", "backplane")
    sx, sy, sz = table.sizes("size", 3, "[x, y, z] in metres")
    backplane = table.length("backplane")
    if backplane >= sz:
        raise table.error(
            f"backplane = {backplane:g} must be smaller than the box's height, {sz:g}; it is the "
            "distance from the electrode plane z = 0 down to the box's floor"
        )
    return Domain((sx, sy, sz), backplane, table.boolean("open", False))


def _read_electrode(table: DesignTable, folder: Path, domain: Domain) -> Electrode:
    table.needs("name", "shape")
    return Electrode(table.string("name"), _read_surface(table, folder, domain, ()))


def _read_build(table: DesignTable) -> dict[str, float]:
    table.only(("resolution",))
    return {"resolution": table.number("resolution", *RESOLUTIONS, 1.0)}


def _read_surface(
    table: DesignTable, folder: Path, domain: Domain, extra: tuple[str, ...]
) -> Surface:
    """Read ``shape``, where it sits, and its own keys; ``extra`` are keys of the item itself."""
    shape = table.choice("shape", [*SHAPES, "polygons", *SOLIDS, "stl"])
    common = ("name", "shape", *extra, *PLACEMENT_KEYS)
    if shape == "stl":
        from capsense.design.stl_shape import read_stl_surface

        table.only((*common, *STL_KEYS))
        return read_stl_surface(table, folder, domain)
    if shape in SOLIDS:
        return _read_solid(table, shape, common)
    if shape == "polygons":
        table.only((*common, "polygons"))
        return polygons_surface(table, read_placement(table))
    table.only((*common, *SHAPES[shape].keys, "leads"))
    return planar_surface(table, shape, read_placement(table))


def _read_solid(table: DesignTable, shape: str, common: tuple[str, ...]) -> Surface:
    keys, make = SOLIDS[shape]
    table.only((*common, *keys))
    return make(table, read_placement(table))


def _bent(sheet: Electrode | Conductor, radius: float, source: str) -> Surface:
    """A sheet as ``[bend]`` leaves it; what is not flat and level keeps its place."""
    if not is_level(sheet.surface):
        return sheet.surface
    item = f'{source}: {type(sheet).__name__.lower()} "{sheet.name}"'
    return bend_sheet(item, sheet.surface, radius)


def _read_conductor(
    table: DesignTable, folder: Path, domain: Domain, electrodes: list[Electrode]
) -> Conductor:
    table.needs("name", "shape", "role")
    name = table.string("name")
    surface = _read_surface(table, folder, domain, ("role", "clearance"))
    role = Role(table.choice("role", [r.value for r in Role]))
    if "clearance" in table:
        surface = cut_clearance(table, surface, electrodes)
    return Conductor(name, role, surface)


def _read_layer(table: DesignTable, folder: Path) -> Layer:
    name = table.string("name")
    material, eps_r = _read_material(table)
    if "shape" in table:
        facets = _read_part(table, folder)
        lower, upper = Surface(facets, np.empty((0, 2, 3))).bounds
        return Layer(name, material, eps_r, lower, upper, facets)
    table.only((*LAYER_KEYS, "size", "center", "z"))
    table.needs("size", "z")
    sx, sy = table.sizes("size", 2, "[x, y] in metres")
    cx, cy = table.coordinates("center", (2,), (0.0, 0.0))
    z0, z1 = table.interval("z")
    lower = np.array([cx - sx / 2, cy - sy / 2, z0])
    upper = np.array([cx + sx / 2, cy + sy / 2, z1])
    return Layer(name, material, eps_r, lower, upper)


def _read_part(table: DesignTable, folder: Path) -> tuple[Facet, ...]:
    """The faces of a dielectric part with a ``shape``, normals outwards."""
    common = (*LAYER_KEYS, "shape", *PLACEMENT_KEYS)
    shape = table.choice("shape", (*SOLIDS, "polygon", "stl"))
    if shape == "polygon":
        table.only((*LAYER_KEYS, "shape", "points", "holes", "z"))
        (outline,) = polygon(table)
        return prism_facets(outline, *table.interval("z"))
    if shape == "stl":
        from capsense.design.stl_shape import read_stl_solid

        table.only((*common, "file", "unit", "scale"))
        return read_stl_solid(table, folder)
    return _read_solid(table, shape, common).facets


def _read_material(table: DesignTable) -> tuple[str, float]:
    if "material" in table and "eps_r" in table:
        raise table.error(
            f"material = {table.data['material']!r} and eps_r = {table.data['eps_r']!r} both set "
            "the permittivity; keep one of them"
        )
    if "material" in table:
        material = table.string("material")
        if material.lower() not in LAYER_EPS_R:
            raise table.error(
                f"material = {material!r} is not known; {suggest(material, LAYER_EPS_R)}; "
                "or give eps_r = a number instead"
            )
        return material, LAYER_EPS_R[material.lower()]
    if "eps_r" in table:
        return "custom", table.number("eps_r", 1.0, 1000.0)
    raise table.error('missing key: give material = "…" or eps_r = a number')


def snap_to_layers(surface: Surface, layers: tuple[Layer, ...], unit: float = 1.0) -> Surface:
    """Move a horizontal sheet that all but lies on a layer's face exactly onto it.

    It is nearer to it than ``TOUCH``, a micrometre in designs whose length unit [m] is one.
    """
    touch = TOUCH * unit
    levels = [float(z) for layer in layers for z in (layer.lower[2], layer.upper[2])]
    if np.ptp(surface.bounds[:, 2]) > touch:
        return surface
    facets, moved = [], 0.0
    for facet in surface.facets:
        z = float(facet.origin[2])
        off = min((level - z for level in levels), key=abs, default=math.inf)
        if abs(off) <= touch:
            moved = off or moved
            facet = Facet(facet.polygon, facet.origin + np.array([0.0, 0.0, off]), facet.axes)
        facets.append(facet)
    return Surface(tuple(facets), surface.rims + np.array([0.0, 0.0, moved]))


SLIVER = 1e-5
"""Remainders narrower than this, over the length unit, are dropped: none would be etched."""
GRID = 1e-9
"""Coordinates of cut outlines are snapped to this grid, over the length unit."""


def cut_clearance(table: DesignTable, surface: Surface, electrodes: Sequence[Electrode]) -> Surface:
    """Cut ``clearance`` [m] around every electrode that lies in a facet's plane.

    The gap's outline is the electrode's, offset with mitred corners. What remains may be several
    pieces with holes; they stay one conductor, as a pour stitched by vias is. A pour in another
    plane than the electrodes' keeps its outline.

    Raises:
        DesignError: If ``clearance`` is no positive length, if the conductor is not flat, or if
            nothing of it remains.
    """
    clearance = table.length("clearance")
    areas = [electrode.surface.area for electrode in electrodes]
    grid, sliver = (length_unit(areas) * x if areas else x for x in (GRID, SLIVER))
    facets: list[Facet] = []
    cut = False
    for facet in surface.facets:
        gaps = []
        for electrode in electrodes:
            for other in electrode.surface.facets:
                outline = in_plane_of(facet, other)
                if outline is not None:
                    gaps.append(outline.buffer(clearance, join_style="mitre", mitre_limit=2.0))
        if not gaps:
            facets.append(facet)
            continue
        cut = True
        rest = shapely.difference(
            facet.polygon, shapely.union_all(gaps, grid_size=grid), grid_size=grid
        )
        for piece in shapely.get_parts(rest):
            if isinstance(piece, Polygon) and not piece.buffer(-sliver / 2).is_empty:
                facets.append(Facet(orient(piece), facet.origin, facet.axes))
    if not cut:
        return surface
    if any(in_plane_of(surface.facets[0], f) is None for f in surface.facets):
        raise table.error(
            f"clearance = {clearance:g} needs a flat conductor; give the pour as a planar shape of "
            "its own"
        )
    if not facets:
        raise table.error(
            f"clearance = {clearance:g} leaves nothing of it; make it larger or reduce clearance"
        )
    return Surface(tuple(facets), np.concatenate([boundary_segments(f) for f in facets]))
