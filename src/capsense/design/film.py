"""Films that are bent onto a cylinder.

The axis of the cylinder runs along y, its radius R under the electrode plane. What lies at
(x, y, z) in the flat film comes to the radius R + z; along x it keeps the angle that x / R is.
(x, y, z) are the *coordinates of the film* of that place.

Bent sheets are made of flat strips. A strip is as wide as the arc that it stands for, so that areas
are exact; its edges lie a little outside the round surface, and its middle a little inside.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon, box
from shapely.geometry.polygon import orient

from capsense.design.geometry import DesignTable, Facet, Surface, measured
from capsense.design.shapes import STRIP_ERROR, circle_segments
from capsense.errors import DesignError

Array = NDArray[np.float64]

_LEVEL = 3e-5
"""Level sheets rise by no more than this part of their extent."""


@dataclass(frozen=True, eq=False)
class Film:
    """What ``[bend]`` rolled onto a cylinder, as it was before."""

    radius: float
    """Radius of the cylinder [m], which is that of the electrode plane."""
    sheets: Mapping[str, Surface]
    """The flat sheets by their names."""

    def measured_in(self, unit: float) -> Film:
        """This film with lengths in a unit [m]."""
        radius = float(measured(np.array([self.radius]), unit)[0])
        return Film(radius, {name: s.measured_in(unit) for name, s in self.sheets.items()})

    def coordinates(self, points: Array) -> Array:
        """Coordinates of the film [m] of points of the sensor frame [m], shapes (..., 3)."""
        x, y, z = np.moveaxis(points, -1, 0)
        up = z + self.radius
        angle = np.arctan2(x, up)
        return np.stack([self.radius * angle, y, np.hypot(x, up) - self.radius], axis=-1)

    def placed(self, points: Array) -> Array:
        """Points of the sensor frame [m] of coordinates of the film [m], shapes (..., 3)."""
        x, y, z = np.moveaxis(points, -1, 0)
        angle, far = x / self.radius, z + self.radius
        return np.stack([far * np.sin(angle), y, far * np.cos(angle) - self.radius], axis=-1)


class Strip(NamedTuple):
    """A part of a film that is bent as one flat strip."""

    start: float
    """Where it begins along x in the film …"""
    end: float
    """… and ends [m]."""

    @property
    def middle(self) -> float:
        """Its middle along x in the film [m]."""
        return 0.5 * (self.start + self.end)


def strips(start: float, end: float, radius: float) -> Iterator[Strip]:
    """Strips of equal widths that a film is cut into from one x to another [m]."""
    count = math.ceil((end - start) / radius * circle_segments(1.0, STRIP_ERROR) / (2 * math.pi))
    for a, b in pairwise(np.linspace(start, end, max(1, count) + 1).tolist()):
        yield Strip(a, b)


def strip_plane(strip: Strip, radius: float, height: float) -> tuple[Array, Array]:
    """Origin [m] and axes (rows) of the strip of what is at a height [m] in a film.

    The origin is the middle of the strip at y = 0. Along the first axis it is wider than in the
    film by (radius + height) / radius, along the second as long.
    """
    half, own = (strip.end - strip.start) / (2 * radius), radius + height
    c, s = math.cos(strip.middle / radius), math.sin(strip.middle / radius)
    axes = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    return np.array([0.0, 0.0, -radius]) + own * half / math.tan(half) * axes[2], axes


def read_bend(table: DesignTable) -> float:
    """The radius [m] of a ``[bend]`` table."""
    table.only(("radius",))
    return table.length("radius")


def is_level(surface: Surface) -> bool:
    """Whether a sheet is flat and parallel to the electrode plane."""
    across = np.ptp(surface.bounds, axis=0)
    return bool(across[2] <= _LEVEL * across.max())


def bend_sheet(item: str, surface: Surface, radius: float) -> Surface:
    """Roll a level sheet onto a cylinder, as one bends a film that was made flat.

    Raises:
        DesignError: If the sheet would lie on the axis or reach all the way round; ``item`` names
            it.
    """
    low, high = surface.bounds
    if radius + float(low[2]) <= 0.0:
        raise DesignError(
            f"{item}: at z = {low[2]:.6g} m it lies at or below the axis of [bend] radius = "
            f"{radius:g}; raise it or enlarge the radius"
        )
    limit = math.pi * radius
    if max(-low[0], high[0]) > limit:
        raise DesignError(
            f"{item}: reaches from x = {low[0]:.6g} to {high[0]:.6g} m, more than the way round "
            f"a [bend] radius = {radius:g}; stay within ±{math.pi * radius:.4g} m"
        )
    facets: list[Facet] = []
    rims: list[Array] = []
    for facet in surface.facets:
        parts, edges = _bend_polygon(facet.footprint, radius, float(low[2]))
        facets += parts
        rims += edges
    return Surface(tuple(facets), np.concatenate(rims))


def _bend_polygon(
    polygon: Polygon, radius: float, height: float
) -> tuple[list[Facet], list[Array]]:
    """Strips of a polygon [m] in the film's x and y, and the parts of its outline."""
    x0, y0, x1, y1 = polygon.bounds
    facets: list[Facet] = []
    rims: list[Array] = []
    for strip in strips(x0, x1, radius):
        origin, axes = strip_plane(strip, radius, height)
        window = box(strip.start, y0 - 1.0, strip.end, y1 + 1.0)

        def unroll(xy: Array, middle: float = strip.middle) -> Array:
            return np.column_stack([(xy[:, 0] - middle) * (radius + height) / radius, xy[:, 1]])

        for piece in shapely.get_parts(polygon.intersection(window)):
            if isinstance(piece, Polygon):
                facets.append(Facet(orient(shapely.transform(piece, unroll)), origin, axes))
        for line in _lines(polygon.boundary.intersection(window)):
            points = origin + unroll(shapely.get_coordinates(line)) @ axes[:2]
            rims.append(np.stack([points[:-1], points[1:]], axis=1))
    return facets, rims


def _lines(geometry: shapely.Geometry) -> Sequence[shapely.Geometry]:
    """The lines of a geometry; points where an outline only touches a window are dropped."""
    merged = shapely.line_merge(geometry)
    return [g for g in shapely.get_parts(merged) if g.geom_type == "LineString"]
