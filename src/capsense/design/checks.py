"""Checks on a whole design, and the free gap that is cut into a pour around electrodes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon
from shapely.geometry.polygon import orient

from capsense.design.geometry import (
    TOUCH,
    Facet,
    Surface,
    boundary_segments,
    coplanar_overlap,
    enters_box,
    find_contact,
    in_plane_of,
)
from capsense.design.model import Conductor, Design, Domain, Electrode, Layer, Role
from capsense.design.tables import DesignTable
from capsense.errors import DesignError

Array = NDArray[np.float64]


def check_design(design: Design, *, source: str = "design") -> None:
    """Refuse a design that could not be built, or that the field solver could not treat.

    Raises:
        DesignError: If there is no electrode; if a name is used twice; if an electrode touches
            another, or a conductor; if anything leaves the domain; if layers overlap; if a sheet
            crosses a layer's surface. The message names ``source``, the item, the value and the
            fix.
    """
    if not design.electrodes:
        raise DesignError(f"{source}: design has no electrode; add an [[electrode]] table")
    sheets: list[Electrode | Conductor] = [*design.electrodes, *design.conductors]
    _unique_names([_label(s) for s in sheets], [s.name for s in sheets], source)
    _unique_names([_label(k) for k in design.layers], [k.name for k in design.layers], source)
    for sheet in sheets:
        _inside_domain(sheet, design.domain, source)
    for layer in design.layers:
        _layer_inside_domain(layer, design.domain, source)
    for lower, upper in combinations(design.layers, 2):
        _apart(lower, upper, source)
    for one, other in combinations(sheets, 2):
        _no_short(one, other, source)
    for sheet in sheets:
        for layer in design.layers:
            _not_crossing(sheet, layer, source)


def snap_to_layers(surface: Surface, layers: tuple[Layer, ...]) -> Surface:
    """Move a horizontal sheet that lies within a micrometre of a layer's face exactly onto it."""
    levels = [float(z) for layer in layers for z in (layer.lower[2], layer.upper[2])]
    if np.ptp(surface.bounds[:, 2]) > TOUCH:
        return surface
    facets, moved = [], 0.0
    for facet in surface.facets:
        z = float(facet.origin[2])
        off = min((level - z for level in levels), key=abs, default=math.inf)
        if abs(off) <= TOUCH:
            moved = off or moved
            facet = Facet(facet.polygon, facet.origin + np.array([0.0, 0.0, off]), facet.axes)
        facets.append(facet)
    return Surface(tuple(facets), surface.rims + np.array([0.0, 0.0, moved]))


def _label(item: Electrode | Conductor | Layer) -> str:
    return f'{type(item).__name__.lower()} "{item.name}"'


def _unique_names(labels: list[str], names: list[str], source: str) -> None:
    seen: dict[str, str] = {}
    for label, name in zip(labels, names, strict=True):
        if name in seen:
            raise DesignError(
                f"{source}: {label}: the name {name!r} is already that of {seen[name]}; "
                "give each its own name"
            )
        seen[name] = label


def _at(point: Array) -> str:
    return "(" + ", ".join(f"{x:.6g}" for x in np.round(point, 9) + 0.0) + ") m"


def _beyond(bounds: Array, domain: Domain, margin: float) -> Iterator[tuple[str, str]]:
    """What bounds, shape (2, 3), do that are not ``margin`` inside, and where, in words."""
    walls = np.array([domain.lower, domain.upper])
    room = (bounds - walls) * [[1.0], [-1.0]]
    for axis, side in zip(*np.nonzero(margin > room.T), strict=True):
        name, value, wall = "xyz"[axis], bounds[side, axis], walls[side, axis]
        verb = "touches" if abs(value - wall) < TOUCH else "leaves"
        yield verb, f"it reaches {name} = {value:.6g} m and the wall is at {name} = {wall:.6g} m"


def _inside_domain(sheet: Electrode | Conductor, domain: Domain, source: str) -> None:
    for verb, where in _beyond(sheet.surface.bounds, domain, TOUCH):
        raise DesignError(
            f"{source}: {_label(sheet)}: {verb} the grounded box: {where}; move it inside (center, "
            "z, size) or enlarge domain size or backplane; lengths are metres"
        )


def _layer_inside_domain(layer: Layer, domain: Domain, source: str) -> None:
    for _, where in _beyond(np.array([layer.lower, layer.upper]), domain, -TOUCH):
        raise DesignError(
            f"{source}: {_label(layer)}: leaves the domain: {where}; reduce its size or z, or "
            "enlarge domain size or backplane; lengths are metres"
        )


def _apart(one: Layer, other: Layer, source: str) -> None:
    low, high = np.maximum(one.lower, other.lower), np.minimum(one.upper, other.upper)
    if not np.all(high - low > TOUCH):
        return
    if one.facets or other.facets:
        from capsense.design.solid import overlap

        point = overlap(one.surface, other.surface)
        if point is not None:
            raise DesignError(
                f"{source}: {_label(other)}: overlaps {_label(one)} at {_at(point)}; move one of "
                "them or cut it back in CAD, so that they share no more than flat faces"
            )
    else:
        raise DesignError(
            f"{source}: {_label(other)}: overlaps {_label(one)} over {_at(high - low)} at "
            f"{_at((low + high) / 2)}; change z, size or center so that they only share a face"
        )


def _no_short(one: Electrode | Conductor, other: Electrode | Conductor, source: str) -> None:
    alike = (
        isinstance(one, Conductor)
        and isinstance(other, Conductor)
        and one.role == other.role
        and one.role is not Role.FLOATING
    )
    point = find_contact(one.surface, other.surface)
    if point is None:
        return
    if alike:
        area = coplanar_overlap(one.surface, other.surface)
        if area > TOUCH**2:
            raise DesignError(
                f"{source}: {_label(other)}: lies on {_label(one)} over {area * 1e6:.6g} mm² "
                f"at {_at(point)}; cut one of them back, they may only share edges"
            )
        return
    fix = "move them apart (center, z) or reduce their size"
    if isinstance(one, Electrode) and isinstance(other, Conductor):
        fix = f"set clearance = 0.0005 on {_label(other)} or move it to another z"
    raise DesignError(
        f"{source}: {_label(one)}: touches or overlaps {_label(other)} at {_at(point)}, a short "
        f"circuit; {fix}"
    )


def _not_crossing(sheet: Electrode | Conductor, layer: Layer, source: str) -> None:
    low, high = sheet.surface.bounds
    if layer.facets:
        _not_through(sheet, layer, source)
        return
    within = np.all(low >= layer.lower - TOUCH) and np.all(high <= layer.upper + TOUCH)
    if within or not enters_box(sheet.surface, layer.lower, layer.upper):
        return
    raise DesignError(
        f"{source}: {_label(sheet)}: crosses the surface of {_label(layer)}: it spans {_at(low)} "
        f"to {_at(high)}, the layer {_at(layer.lower)} to {_at(layer.upper)}; put it on a face of "
        f"the layer (such as z = {layer.upper[2]:g}), or wholly inside or outside"
    )


def _not_through(sheet: Electrode | Conductor, part: Layer, source: str) -> None:
    from capsense.design.solid import crossing

    low, high = sheet.surface.bounds
    if np.any(low > part.upper) or np.any(high < part.lower):
        return
    point = crossing(sheet.surface.triangles, part.surface.triangles)
    if point is not None:
        raise DesignError(
            f"{source}: {_label(sheet)}: is partly inside of {_label(part)}, at {_at(point)}, and "
            "partly outside; put it wholly inside or outside, or flat on a flat face; where both "
            "are curved leave a gap of 0.2 mm, for they are made of flat pieces"
        )


SLIVER = 1e-5
"""Remainders narrower than this [m] are dropped: no board house would etch them."""
GRID = 1e-9
"""Coordinates of cut outlines are snapped to this grid [m]."""


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
            facet.polygon, shapely.union_all(gaps, grid_size=GRID), grid_size=GRID
        )
        for piece in shapely.get_parts(rest):
            if isinstance(piece, Polygon) and not piece.buffer(-SLIVER / 2).is_empty:
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
