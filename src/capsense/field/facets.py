"""Where the facets of a design lie to each other: gaps, bare faces of its matter, and its walls."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import shapely
from numpy.typing import NDArray

from capsense.design.geometry import Facet, box_facets
from capsense.design.model import Design, Layer

Array = NDArray[np.float64]

PLANE_TOL = 1e-6
"""What is nearer to a plane than this [m] lies in it."""
FAR_PLANE = 0.01
"""Parallel sheets farther apart than this [m] need no panels of their distance."""


def smallest_gaps(sheets: list[tuple[Facet, int]]) -> list[float]:
    """Distance of each facet to the nearest other facet [m], from their outlines."""
    outlines = []
    for facet, _ in sheets:
        rings = [facet.polygon.exterior, *facet.polygon.interiors]
        outlines.append(np.concatenate([facet.to_sensor(np.asarray(r.coords)[:-1]) for r in rings]))
    gaps = []
    for k, (facet, owner) in enumerate(sheets):
        gap = math.inf
        for other, (mate, mate_owner) in enumerate(sheets):
            if other == k or (mate_owner == owner and owner >= 0):
                continue
            local = (outlines[other] - facet.origin) @ facet.axes.T
            if np.abs(local[:, 2]).max() < PLANE_TOL:
                flat = _to_plane(mate, facet)
                gap = min(gap, float(facet.polygon.boundary.distance(flat)))
        gaps.append(max(gap, 1e-5))
    return gaps


def plane_spacings(sheets: list[tuple[Facet, int]]) -> list[float]:
    """Distance of each facet to the nearest parallel facet that faces it [m], at most 10 mm."""
    out = []
    for k, (facet, _) in enumerate(sheets):
        spacing = FAR_PLANE
        for other, (mate, _) in enumerate(sheets):
            height = abs((mate.origin - facet.origin) @ facet.axes[2])
            parallel = abs(mate.axes[2] @ facet.axes[2]) > 1 - 1e-6
            if other != k and parallel and PLANE_TOL < height < spacing:
                shadow = _to_plane(mate, facet)
                if facet.polygon.intersects(shadow):
                    spacing = height
        out.append(spacing)
    return out


def _to_plane(facet: Facet, target: Facet) -> shapely.Polygon:
    """Express a coplanar facet's polygon in another facet's plane coordinates."""

    def convert(uv: Array) -> Array:
        return ((facet.to_sensor(uv) - target.origin) @ target.axes.T)[:, :2]

    return shapely.transform(facet.polygon, convert)


def interfaces(design: Design, sheets: list[Facet]) -> list[tuple[Facet, float]]:
    """Faces of dielectrics that no sheet covers, each once, with the thickness of the part [m]."""
    out: list[tuple[Facet, float]] = []
    covers = list(sheets)
    for number, layer in enumerate(design.layers):
        later = [f for other in design.layers[number + 1 :] for f in other.facets]
        thickness = float((layer.upper - layer.lower).min())
        if layer.facets:
            thickness = thickness_of(layer)
        for face in layer.surface.facets:
            if _on_wall(face, design):
                continue
            region = face.polygon
            for cover in _coplanar(face, covers):
                region = region.difference(cover)
            pieces = [region]
            for mate in _coplanar(face, later):
                pieces = [p for r in pieces for p in (r.intersection(mate), r.difference(mate))]
            for piece in shapely.get_parts(pieces):
                if piece.area > 1e-12 and piece.geom_type == "Polygon":
                    out.append((Facet(piece, face.origin, face.axes), thickness))
        covers += layer.surface.facets
    return out


def thickness_of(layer: Layer) -> float:
    """Thickness of a part [m]; that of a box is its height."""
    if layer.facets:
        from capsense.design.solid import thickness

        return thickness(layer.facets)
    return float((layer.upper - layer.lower)[2])


def _coplanar(face: Facet, others: list[Facet]) -> Iterator[shapely.Polygon]:
    """Outlines of the facets that lie in a facet's plane, in that plane."""
    if not others:
        return
    normals, origins = np.array([(f.axes[2], f.origin) for f in others]).swapaxes(0, 1)
    parallel = np.abs(normals @ face.axes[2]) > 1 - 1e-9
    apart = np.abs(((face.origin - origins) * normals).sum(axis=1))
    for k in np.flatnonzero(parallel & (apart < PLANE_TOL)):
        yield _to_plane(others[k], face)


def _on_wall(face: Facet, design: Design) -> bool:
    if design.domain.open or np.abs(face.axes[2]).max() < 1 - 1e-9:
        return False
    corners = np.array([design.domain.lower, design.domain.upper])
    return bool(np.abs((face.origin - corners) @ face.axes[2]).min() < PLANE_TOL)


def walls(design: Design) -> list[Facet]:
    """Ceiling and side walls of the box; the floor is met by images. An open domain has none."""
    if design.domain.open:
        return []
    return [f for f in box_facets(design.domain.lower, design.domain.upper) if f.axes[2, 2] > -0.5]
