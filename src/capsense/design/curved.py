"""Round things: sheets bent onto a cylinder, and closed cylinders.

Both are made of flat strips. A strip is as wide as the arc that it stands for, so that areas are
exact; its edges lie a little outside the round surface, and its middle a little inside.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon, box
from shapely.geometry.polygon import orient

from capsense.design.contact import TOUCH
from capsense.design.geometry import Facet, Surface, boundary_segments
from capsense.design.placement import Placement
from capsense.design.schema import DesignTable
from capsense.design.shapes import circle_segments
from capsense.errors import DesignError

Array = NDArray[np.float64]

STRIP_ERROR = 1e-4
"""A strip leaves the round surface by about this much [m], unless that takes too many strips."""


def read_bend(table: DesignTable) -> float:
    """The radius [m] of a ``[bend]`` table."""
    table.only(("radius",))
    return table.length("radius")


def is_level(surface: Surface) -> bool:
    """Whether a sheet is flat and parallel to the electrode plane."""
    return bool(np.ptp(surface.bounds[:, 2]) <= TOUCH)


def bend_sheet(item: str, surface: Surface, radius: float) -> Surface:
    """Roll a level sheet onto a cylinder, as one bends a film that was made flat.

    The cylinder's axis runs along y, ``radius`` [m] under the electrode plane. A sheet at height z
    comes to the radius ``radius + z``; along x it keeps the angle that x / ``radius`` is.

    Raises:
        DesignError: If the sheet would lie on the axis or reach all the way round; ``item`` names
            it.
    """
    low, high = surface.bounds
    own = radius + float(low[2])
    if own <= TOUCH:
        raise DesignError(
            f"{item}: at z = {low[2]:.6g} m it lies at or below the axis of [bend] radius = "
            f"{radius:g}; raise it or enlarge the radius"
        )
    limit = math.pi * radius - TOUCH
    if max(-low[0], high[0]) > limit:
        raise DesignError(
            f"{item}: reaches from x = {low[0]:.6g} to {high[0]:.6g} m, more than the way round "
            f"a [bend] radius = {radius:g}; stay within ±{math.pi * radius:.4g} m"
        )
    facets: list[Facet] = []
    rims: list[Array] = []
    for facet in surface.facets:
        flat = shapely.transform(facet.polygon, lambda uv, f=facet: f.to_sensor(uv)[:, :2])
        parts, edges = _bend_polygon(flat, radius, own)
        facets += parts
        rims += edges
    return Surface(tuple(facets), np.concatenate(rims))


def _bend_polygon(polygon: Polygon, radius: float, own: float) -> tuple[list[Facet], list[Array]]:
    """Strips of a polygon [m] in the sensor's x and y, and the parts of its outline."""
    x0, y0, x1, y1 = polygon.bounds
    count = math.ceil((x1 - x0) / radius * circle_segments(own, STRIP_ERROR) / (2 * math.pi))
    stops = np.linspace(x0, x1, max(1, count) + 1)
    half = (stops[1] - stops[0]) / (2 * radius)
    distance = own * half / math.tan(half)  # of the strip's middle from the axis
    facets: list[Facet] = []
    rims: list[Array] = []
    for a, b in pairwise(stops):
        middle = (a + b) / 2
        axes = _strip_axes(middle / radius)
        origin = np.array([0.0, 0.0, -radius]) + distance * axes[2]
        window = box(a, y0 - 1.0, b, y1 + 1.0)

        def unroll(xy: Array, middle: float = middle) -> Array:
            return np.column_stack([(xy[:, 0] - middle) * own / radius, xy[:, 1]])

        for piece in shapely.get_parts(polygon.intersection(window)):
            if isinstance(piece, Polygon):
                facets.append(Facet(orient(shapely.transform(piece, unroll)), origin, axes))
        for line in _lines(polygon.boundary.intersection(window)):
            points = origin + unroll(shapely.get_coordinates(line)) @ axes[:2]
            rims.append(np.stack([points[:-1], points[1:]], axis=1))
    return facets, rims


def _strip_axes(angle: float) -> Array:
    """Axes of a strip, at an angle [rad] from the sensor's z towards its x, about y."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])


def _lines(geometry: shapely.Geometry) -> Sequence[shapely.Geometry]:
    """The lines of a geometry; points where an outline only touches a window are dropped."""
    merged = shapely.line_merge(geometry)
    return [g for g in shapely.get_parts(merged) if g.geom_type == "LineString"]


def cylinder_surface(table: DesignTable, placement: Placement) -> Surface:
    """The closed surface of a cylinder: ``radius`` and ``length`` [m], about its own z axis."""
    radius, length = table.length("radius"), table.length("length")
    count = circle_segments(radius, STRIP_ERROR)
    half = math.pi / count
    width, distance = 2 * radius * half, radius * half / math.tan(half)
    facets: list[Facet] = []
    outline = box(-width / 2, -length / 2, width / 2, length / 2)
    for k in range(count):
        c, s = math.cos(2 * half * k), math.sin(2 * half * k)
        local = np.array([[-s, c, 0.0], [0.0, 0.0, 1.0], [c, s, 0.0]])
        facets.append(
            Facet(outline, placement.apply(distance * local[2]), local @ placement.rotation.T)
        )
    angle = 2 * half * (np.arange(count) + 0.5)
    ring = distance / math.cos(half) * np.column_stack([np.cos(angle), np.sin(angle)])
    rims = []
    for sign in (1.0, -1.0):
        local = np.diag([1.0, sign, sign])
        cap = Facet(
            orient(Polygon(ring * [1.0, sign])),
            placement.apply(np.array([0.0, 0.0, sign * length / 2])),
            local @ placement.rotation.T,
        )
        facets.append(cap)
        rims.append(boundary_segments(cap))
    return Surface(tuple(facets), np.concatenate(rims))
