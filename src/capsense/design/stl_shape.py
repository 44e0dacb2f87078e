"""Electrodes and conductors from STL files, and from a box with imprinted electrodes."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from shapely.affinity import translate

from capsense._validate import UNITS
from capsense.design.geometry import (
    PLACEMENT_KEYS,
    DesignTable,
    Facet,
    Surface,
    boundary_segments,
    read_placement,
)
from capsense.design.model import Domain, Electrode
from capsense.design.stl import SheetMesh, read_stl, sheet_surface, weld
from capsense.errors import DesignError

Array = NDArray[np.float64]

SMALLEST = 5e-4
"""What is smaller across [m] is taken for a file in another unit."""
SMALL = 2e-3
"""What is smaller than this [m] may be one; a warning asks."""
SIZE_TOLERANCE = 1e-5
"""By how much [m] an imprinted box may differ from the domain."""


def _read_triangles(table: DesignTable, folder: Path) -> Array:
    """Triangles [m] of the item's file, shape (n, 3, 3)."""
    file = table.string("file")
    unit = table.choice("unit", list(UNITS))
    scale = table.number("scale", 1e-3, 1e3, 1.0)
    try:
        triangles = read_stl(folder / file) * (UNITS[unit] * scale)
    except DesignError as error:
        raise table.error(f'file = "{file}": {error}') from None
    extent = float(np.ptp(triangles.reshape(-1, 3), axis=0).max())
    if extent > table.limit * (1 + 1e-6):
        smaller = [f'"{u}"' for u, f in UNITS.items() if f < UNITS[unit]]
        fix = f"did you mean unit = {' or '.join(smaller)}?" if smaller else "give a smaller scale"
        raise table.error(
            f'file = "{file}" is {extent:g} m across with unit = "{unit}", larger than '
            f"{table.limit:g} m; {fix}"
        )
    if extent < SMALLEST:
        larger = [f'"{u}"' for u, f in UNITS.items() if SMALLEST / extent < f / UNITS[unit]]
        fix = f"did you mean unit = {' or '.join(larger)}?" if larger else "give a larger scale"
        raise table.error(
            f'file = "{file}" is {extent * 1e3:g} mm across with unit = "{unit}", smaller than '
            f"{SMALLEST * 1e3:g} mm; {fix}"
        )
    if extent < SMALL and unit != "m":
        warnings.warn(
            f'file = "{file}" is {extent * 1e3:g} mm across with unit = "{unit}"; if it was '
            'exported in metres, write unit = "m"',
            stacklevel=2,
        )
    return triangles


def _weld(table: DesignTable, triangles: Array) -> SheetMesh:
    try:
        return weld(triangles)
    except DesignError as error:
        raise table.error(f'file = "{table.data["file"]}": {error}') from None


def _require_closed(table: DesignTable, mesh: SheetMesh, why: str) -> None:
    if not mesh.closed:
        raise table.error(
            f'file = "{table.data["file"]}" is open: it has {len(mesh.boundary)} boundary edges, '
            f"but {why} needs a closed (watertight) surface; close the gaps in CAD"
        )


def read_stl_surface(table: DesignTable, folder: Path, domain: Domain) -> Surface:
    """Read an item of shape "stl": an open sheet, a closed shell, or one part of an imprinted box.

    Raises:
        DesignError: If the file, its unit or its content is wrong.
    """
    if "part" in table:
        return _read_part(table, folder, domain)
    triangles = _read_triangles(table, folder)
    placement = read_placement(table)
    mesh = _weld(table, placement.apply(triangles))
    if "closed" in table:
        if table.boolean("closed", True):
            _require_closed(table, mesh, "closed = true")
        elif mesh.closed:
            raise table.error(
                f'file = "{table.data["file"]}" is a closed shell, but closed = false asks for an '
                "open sheet; export the sheet alone, or drop closed"
            )
    extents = np.ptp(mesh.vertices, axis=0)
    if mesh.closed and np.allclose(extents, domain.size, atol=SIZE_TOLERANCE):
        raise table.error(
            f'file = "{table.data["file"]}" is a box as large as the domain; if electrodes are '
            "imprinted on its floor, pick one with part = 1, or take all by [[electrodes_from_stl]]"
        )
    return sheet_surface(mesh)


def read_stl_solid(table: DesignTable, folder: Path) -> tuple[Facet, ...]:
    """Read a dielectric part of shape "stl": the faces of a closed surface, normals outwards.

    Raises:
        DesignError: If the file, its unit or its content is wrong, or if the surface is open or
            crosses or touches itself.
    """
    from capsense.design.solid import self_crossing, turned_outwards

    triangles = _read_triangles(table, folder)
    mesh = _weld(table, read_placement(table).apply(triangles))
    _require_closed(table, mesh, "a dielectric part")
    place = self_crossing(mesh)
    if place is not None:
        at = ", ".join(f"{x:.6g}" for x in place)
        raise table.error(
            f'file = "{table.data["file"]}" crosses or touches itself, near ({at}) m; unite its '
            "solids in CAD, or give each as a part of its own"
        )
    return turned_outwards(sheet_surface(mesh).facets)


def _read_part(table: DesignTable, folder: Path, domain: Domain) -> Surface:
    for key in ("scale", "closed", *PLACEMENT_KEYS):
        if key in table:
            raise table.error(
                f"{key} = {table.data[key]!r} cannot go with part: an imprinted box is placed so "
                "that it becomes the domain; remove it"
            )
    if table.data["part"] == "all":
        raise table.error(
            'part = "all" would join all electrodes to one; give part = 1, 2, … or use '
            "[[electrodes_from_stl]]"
        )
    parts = imprinted_parts(table, folder, domain)
    return parts[table.integer("part", 1, len(parts)) - 1]


def read_imprint_group(table: DesignTable, folder: Path, domain: Domain) -> list[Electrode]:
    """Read an ``[[electrodes_from_stl]]`` item: every part of an imprinted box.

    Keys are ``file``, ``unit`` and ``name``, in which "{}" becomes the part's number from 1.

    Raises:
        DesignError: If the file, its unit or its content is wrong, or if ``name`` has no "{}".
    """
    table.only(("file", "unit", "name"))
    name = table.string("name", "E{}")
    if name.count("{}") != 1:
        raise table.error(f'name = {name!r} must contain {{}} once, such as "E{{}}"')
    parts = imprinted_parts(table, folder, domain)
    return [Electrode(name.replace("{}", str(k)), p) for k, p in enumerate(parts, start=1)]


def imprinted_parts(table: DesignTable, folder: Path, domain: Domain) -> list[Surface]:
    """Electrodes imprinted on the floor of a box, sorted by centre y, then x.

    The file holds a watertight solid, a box whose floor is pushed in by flat-topped mesas. Every
    mesa's top is one electrode. The side walls are dropped: they meet the grounded floor and
    would short the electrode. The box is moved so that its floor's centre comes to x = y = 0 and
    the floor to z = −backplane; a mesa of height h then is an electrode at z = h − backplane.

    Raises:
        DesignError: If the surface is not closed, differs in size from the domain, or has no mesas.
    """
    file = table.string("file")
    mesh = _weld(table, _read_triangles(table, folder))
    _require_closed(table, mesh, "a box with imprinted electrodes")
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    size = high - low
    if not np.allclose(size, domain.size, atol=SIZE_TOLERANCE):
        text = "[" + ", ".join(f"{s:.6g}" for s in size) + "]"
        raise table.error(
            f'file = "{file}" holds a box of {text} m, but the domain is {list(domain.size)} m; '
            f"set domain size = {text}, or correct unit"
        )
    shift = np.array([-(low[0] + high[0]) / 2, -(low[1] + high[1]) / 2, -low[2] - domain.backplane])
    parts = []
    for facet in sheet_surface(mesh).facets:
        z = float(facet.origin[2])
        level = bool(np.all(facet.axes[:2, 2] == 0.0))
        if level and low[2] + mesh.flatness < z < high[2] - mesh.flatness:
            moved = Facet(
                translate(facet.polygon, *shift[:2]),
                facet.origin + np.array([0.0, 0.0, shift[2]]),
                facet.axes,
            )
            parts.append(Surface((moved,), boundary_segments(moved)))
    if not parts:
        raise table.error(
            f'file = "{file}" has no flat-topped mesas on its floor; give a box with imprinted '
            'electrodes, or use shape = "stl" without part'
        )
    return sorted(parts, key=_row_order)


def _row_order(surface: Surface) -> tuple[float, float]:
    center = surface.bounds.mean(axis=0)
    return round(float(center[1]), 6), round(float(center[0]), 6)
