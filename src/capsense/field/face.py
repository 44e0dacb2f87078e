"""The face of a design: the flat surface in front of its electrodes, or that of a bent film.

All is in coordinates (x, y, z) of the face: those of the sensor frame in front of a flat design,
and those of the film (:mod:`capsense.design.film`) in front of a bent one.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import box

from capsense.design.film import Strip, strip_plane, strips
from capsense.design.geometry import Facet, Surface
from capsense.design.model import Design
from capsense.design.shapes import STRIP_ERROR
from capsense.field.bem_kernels import Panels
from capsense.field.boundary import BoundarySolution
from capsense.field.green_points import design_box, is_flat
from capsense.field.panels import (
    PLANE_TOL,
    Grading,
    concatenate,
    cut_facet,
    make_panels,
)

Array = NDArray[np.float64]

_OFF = 3.0
"""Panels of the plane beside the sheets, over the size of those above them."""


def has_even_face(design: Design) -> bool:
    """Whether a design ends at one height over all of its electrodes: bare, or under a layer.

    Bodies can dip into recesses of others, such as below the top of a bezel. Shells are no faces
    unless they are bent films.
    """
    if not is_flat(design) and design.film is None:
        return False
    top = top_of(design)
    if design.film is not None:
        film, tol = design.film, 2 * STRIP_ERROR * design.film.radius
        others = [b.surface for b in design.sheets if b.name not in film.sheets]
        others += [layer.surface for layer in design.layers]
        return all(
            e.name in film.sheets and film.sheets[e.name].bounds[1, 2] > top - PLANE_TOL
            for e in design.electrodes
        ) and all(film.coordinates(s.triangles)[..., 2].max() < top + tol for s in others)
    covers = [la for la in design.layers if not la.facets and abs(la.upper[2] - top) < PLANE_TOL]
    return all(
        abs(e.surface.bounds[1, 2] - top) < PLANE_TOL
        or any(
            (e.surface.bounds[0, :2] > la.lower[:2] - PLANE_TOL).all()
            and (e.surface.bounds[1, :2] < la.upper[:2] + PLANE_TOL).all()
            for la in covers
        )
        for e in design.electrodes
    )


def top_of(design: Design) -> float:
    """Height of the face [m]: the highest sheet or layer of a flat design, or sheet of a film."""
    if design.film is not None:
        return max(float(sheet.bounds[1, 2]) for sheet in design.film.sheets.values())
    heights = [float(body.surface.bounds[1, 2]) for body in design.sheets]
    return max([*heights, *(float(layer.upper[2]) for layer in design.layers)])


def cover_of(design: Design) -> float:
    """Thickness of what covers the sheets [m]; infinite for designs without a face."""
    if design.film is not None:
        return 0.0 if has_even_face(design) else math.inf
    if not is_flat(design):
        return math.inf
    heights = np.concatenate([body.surface.bounds[:, 2] for body in design.sheets])
    return top_of(design) - float(heights.max())


def face_box(design: Design) -> Array:
    """Corners of the design in coordinates of its face [m], shape (2, 3)."""
    if design.film is None:
        return design_box(design)
    points = [design.film.coordinates(body.surface.triangles) for body in design.sheets]
    points += [design.film.coordinates(layer.surface.triangles) for layer in design.layers]
    corners = np.concatenate([p.reshape(-1, 3) for p in points])
    out = np.array([corners.min(axis=0), corners.max(axis=0)])
    out[1, 2] = top_of(design)
    return out


def sheet_on_face(design: Design, name: str) -> Surface:
    """An electrode in coordinates of the face."""
    if design.film is not None:
        return design.film.sheets[name]
    return next(e.surface for e in design.electrodes if e.name == name)


class FacePlane(NamedTuple):
    """Panels of a plane in front of a design that can be moved away from it."""

    panels: Panels
    """Those at height 0, in coordinates of the face."""
    strips: tuple[Strip, ...] = ()
    """The strips that they are bent with, if the face is that of a film …"""
    strip: NDArray[np.int64] = np.zeros(0, np.int64)
    """… which of them each is in, shape (m,) …"""
    radius: float = math.inf
    """… and its radius [m]."""

    def at(self, height: float) -> Panels:
        """The panels at a height over the face's zero [m], in the sensor frame."""
        panels = self.panels
        up = np.array([0.0, 0.0, height])
        if not self.strips:
            return panels._replace(
                edges=panels.edges + up, centers=panels.centers + up, quad=panels.quad + up
            )
        planes = [strip_plane(strip, self.radius, height) for strip in self.strips]
        origin, axes = (np.array(each) for each in zip(*planes, strict=True))
        middle = np.array([strip.middle for strip in self.strips])
        wider = (self.radius + height) / self.radius

        def placed(points: Array, strip: NDArray[np.int64]) -> Array:
            many = (slice(None), *(None,) * (points.ndim - 2))
            along = wider * (points[..., 0] - middle[strip][many])
            return np.asarray(
                origin[strip][many]
                + along[..., None] * axes[strip, 0][many]
                + points[..., 1, None] * axes[strip, 1][many]
            )

        edge = np.repeat(self.strip, np.diff(panels.first))
        return panels._replace(
            edges=placed(panels.edges, edge), centers=placed(panels.centers, self.strip),
            quad=placed(panels.quad, self.strip), normals=axes[self.strip, 2],
            weights=wider * panels.weights, diameters=max(wider, 1.0) * panels.diameters,
        )  # fmt: skip


def plane_panels(solution: BoundarySolution, reach: float) -> FacePlane:
    """Panels of a plane that follow the outlines of the sheets behind it.

    Above the electrodes they are the electrodes' own, so that no panel lies across a rim.
    ``reach`` is how far it goes beyond the electrodes [m].
    """
    design = solution.design
    film = design.film
    corners = np.array([sheet_on_face(design, e.name).bounds for e in design.electrodes])
    low, high = corners[:, 0].min(axis=0) - reach, corners[:, 1].max(axis=0) + reach
    inner = 1e-3 * (design.domain.upper - design.domain.lower)
    walls = np.array([design.domain.lower + inner, design.domain.upper - inner])
    if film is not None:  # not as far as all the way round
        walls[:, 0] = np.array([-1.0, 1.0]) * (1 - 1e-3) * math.pi * film.radius
    low, high = np.maximum(low, walls[0]), np.minimum(high, walls[1])
    rest = box(low[0], low[1], high[0], high[1])
    sheets = _sheets_of(solution)
    rims = np.concatenate(
        [s.rims for s in (film.sheets.values() if film else [b.surface for b in design.sheets])]
    ) * [1.0, 1.0, 0.0]
    parts: list[Panels] = []
    bent: list[Strip] = []
    counts: list[int] = []

    def cut(piece: shapely.Geometry, grading: Grading, strip: Strip | None) -> None:
        if piece.geom_type != "Polygon" or piece.area <= 1e-6 * reach**2:
            return
        facet = Facet(piece, np.zeros(3), np.eye(3))
        pieces = cut_facet(facet, rims, grading)
        if pieces:
            parts.append(make_panels(facet, pieces))
            counts.append(parts[-1].size)
            if strip is not None:
                bent.append(strip)

    def add(region: shapely.Geometry, grading: Grading, bounds: tuple[float, ...]) -> None:
        for piece in shapely.get_parts(region):
            if film is None:
                cut(piece, grading, None)
                continue
            for strip in strips(bounds[0], bounds[2], film.radius):
                window = box(strip.start, bounds[1] - reach, strip.end, bounds[3] + reach)
                for part in shapely.get_parts(piece.intersection(window)):
                    cut(part, grading, strip)

    for facet, grading in sheets:
        outline = facet.footprint
        if not rest.intersects(outline):
            continue
        add(rest.intersection(outline), grading, outline.bounds)
        rest = rest.difference(outline)
    grading = sheets[-1][1]
    off = replace(
        grading, edge=_OFF * grading.edge, smallest=_OFF * grading.smallest,
        largest=_OFF * grading.largest,
    )  # fmt: skip
    add(rest, off, rest.bounds)
    panels = concatenate(parts)
    if film is None:
        return FacePlane(panels)
    return FacePlane(panels, tuple(bent), np.repeat(np.arange(len(bent)), counts), film.radius)


def _sheets_of(solution: BoundarySolution) -> list[tuple[Facet, Grading]]:
    """Facets of the sheets on the face, the highest first, and how finely they are cut."""
    design, sheets = solution.design, solution.model.sheets
    if design.film is None:
        flat = sorted(sheets, key=lambda sheet: -sheet[0][0].origin[2])
        return [(facet, grading) for (facet, _), grading in flat]
    out: list[tuple[Facet, Grading]] = []
    start = 0
    for body in design.sheets:
        grading = sheets[start][1]  # that of its first strip
        start += len(body.surface.facets)
        if body.name in design.film.sheets:
            out += [(facet, grading) for facet in design.film.sheets[body.name].facets]
    return sorted(out, key=lambda sheet: -float(sheet[0].origin[2]))
