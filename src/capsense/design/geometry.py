"""Planar facets and sheets made of them: where design files place them, and where they meet."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
import shapely.affinity
from numpy.typing import NDArray
from shapely.geometry import Polygon, box
from shapely.geometry.polygon import orient

from capsense import _validate
from capsense.errors import DesignError

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Facet:
    """A planar polygon, possibly with holes, placed in the sensor frame.

    A point (u, v) of the polygon lies at ``origin + u * axes[0] + v * axes[1]``; ``axes[2]`` is
    the facet's normal. Lengths in metres. Flat horizontal sheets of a loaded design have the sensor
    frame's axes and the origin (0, 0, z), so that (u, v) are sensor coordinates (x, y).
    """

    polygon: Polygon
    """Outline in the facet's own plane, (u, v) [m], counterclockwise; holes run clockwise."""
    origin: Array
    """Origin of the facet's plane [m] in the sensor frame, shape (3,)."""
    axes: Array
    """Orthonormal right-handed axes u, v, n as rows, in the sensor frame, shape (3, 3)."""

    def to_sensor(self, uv: Array) -> Array:
        """Map plane coordinates, shape (..., 2), to the sensor frame, shape (..., 3)."""
        uv = np.asarray(uv, dtype=float)
        return self.origin + uv @ self.axes[:2]

    @property
    def footprint(self) -> Polygon:
        """The outline as seen along z, in the sensor's x and y [m]."""
        return shapely.transform(self.polygon, lambda uv: self.to_sensor(uv)[:, :2])

    def measured_in(self, unit: float) -> Facet:
        """This facet with lengths in a unit [m]."""
        outline = shapely.transform(self.polygon, lambda uv: measured(uv, unit))
        return Facet(outline, measured(self.origin, unit), self.axes)


@dataclass(frozen=True, eq=False)
class Surface:
    """A conducting sheet of zero thickness: an electrode, a pour, a shield or a housing.

    ``rims`` are the line segments along which the charge density is singular: free boundaries
    and sharp creases. The offline field solver grades its panels towards them.
    """

    facets: tuple[Facet, ...]
    rims: Array
    """Singular line segments [m] in the sensor frame, shape (k, 2, 3)."""

    @cached_property
    def triangles(self) -> Array:
        """A triangulation of the sheet [m] in the sensor frame, shape (n, 3, 3)."""
        out: list[Array] = []
        for facet in self.facets:
            for tri in shapely.constrained_delaunay_triangles(facet.polygon).geoms:
                out.append(facet.to_sensor(np.asarray(tri.exterior.coords)[:3]))
        return np.array(out).reshape(-1, 3, 3)

    @cached_property
    def bounds(self) -> Array:
        """Lower and upper corner of the bounding box [m], shape (2, 3)."""
        points = np.concatenate(
            [f.to_sensor(shapely.get_coordinates(f.polygon.exterior)) for f in self.facets]
        )
        return np.array([points.min(axis=0), points.max(axis=0)])

    @cached_property
    def area(self) -> float:
        """Area [m²] of one side of the sheet."""
        return float(sum(f.polygon.area for f in self.facets))

    def measured_in(self, unit: float) -> Surface:
        """This sheet with lengths in a unit [m]."""
        facets = tuple(facet.measured_in(unit) for facet in self.facets)
        return Surface(facets, measured(self.rims, unit))


def measured(values: Array, unit: float) -> Array:
    """Lengths [m] in a unit [m], to 12 decimals, so that those of scaled designs are the same."""
    return np.asarray(np.round(np.asarray(values, float) / unit, 12) + 0.0)


SIDE = 0.03
"""Side of the mean electrode [m] of designs that are solved in metres."""


def length_unit(areas: Sequence[float]) -> float:
    """Length that a design is solved in [m], by the areas of its electrodes [m²].

    It makes their mean area that of a square of 30 mm, so that all lengths in the solver are ratios
    to the electrodes.
    """
    return float(f"{math.sqrt(sum(areas) / len(areas)) / SIDE:.12g}") if any(areas) else 1.0


def level_rectangle(low: Array, high: Array, z: float) -> Surface:
    """A horizontal rectangle between two corners [m], shape (2,) each, at a height [m]."""
    facet = Facet(box(*low, *high), np.array([0.0, 0.0, z]), np.eye(3))
    return Surface((facet,), boundary_segments(facet))


def box_facets(lower: Array, upper: Array) -> tuple[Facet, ...]:
    """The six faces of an upright box, normals outwards."""
    faces = []
    size, center = upper - lower, (lower + upper) / 2
    for axis in range(3):
        for sign in (-1.0, 1.0):
            n = np.zeros(3)
            n[axis] = sign
            u = np.zeros(3)
            u[(axis + 1) % 3] = 1.0
            half_u, half_v = size[(axis + 1) % 3] / 2, size[(axis + 2) % 3] / 2
            outline = box(-half_u, -half_v, half_u, half_v)
            faces.append(
                Facet(outline, center + n * size[axis] / 2, np.array([u, np.cross(n, u), n]))
            )
    return tuple(faces)


def ring_vertices(facet: Facet) -> list[Array]:
    """Vertices [m] of a facet's outline and of each hole in the sensor frame, each (k, 3)."""
    rings = (facet.polygon.exterior, *facet.polygon.interiors)
    return [facet.to_sensor(shapely.get_coordinates(ring)[:-1]) for ring in rings]


def boundary_segments(facet: Facet) -> Array:
    """Edges [m] of a facet's outline and holes in the sensor frame, shape (k, 2, 3)."""
    rings = ring_vertices(facet)
    return np.concatenate([np.stack([r, np.roll(r, -1, axis=0)], axis=1) for r in rings])


TOUCH = 1e-6
"""Sheets closer than this [m] touch; a sheet this close to a face lies on it."""


def find_contact(a: Surface, b: Surface) -> Array | None:
    """A point [m] in the sensor frame, shape (3,), where two surfaces meet, or None.

    Two planar facets meet if, and only if, an edge of one meets the other; so every edge is cut
    to the part that lies within :data:`TOUCH` of the other's plane and measured there.
    """
    bounds_a, bounds_b = facet_bounds(a), facet_bounds(b)
    near_a = np.flatnonzero(_overlap(bounds_a, b.bounds[None]))
    near_b = np.flatnonzero(_overlap(bounds_b, a.bounds[None]))
    for i in near_a:
        for j in near_b[_overlap(bounds_b[near_b], bounds_a[i : i + 1])]:
            for one, other in ((a.facets[i], b.facets[j]), (b.facets[j], a.facets[i])):
                point = _edge_contact(boundary_segments(one), other)
                if point is not None:
                    return point
    return None


def facet_bounds(surface: Surface) -> Array:
    """Bounding boxes [m] of the facets, shape (n, 2, 3)."""
    out = []
    for facet in surface.facets:
        points = ring_vertices(facet)[0]
        out.append([points.min(axis=0), points.max(axis=0)])
    return np.array(out)


def _overlap(boxes: Array, other: Array) -> NDArray[np.bool_]:
    low, high = boxes[:, 0] - TOUCH, boxes[:, 1] + TOUCH
    return np.all((low <= other[:, 1]) & (high >= other[:, 0]), axis=1)


def _edge_contact(segments: Array, facet: Facet) -> Array | None:
    local = (segments - facet.origin) @ facet.axes.T
    n0, n1 = local[:, 0, 2], local[:, 1, 2]
    slope = n1 - n0
    flat = np.abs(slope) < 1e-15
    safe = np.where(flat, 1.0, slope)
    ends = np.sort(np.stack([(-TOUCH - n0) / safe, (TOUCH - n0) / safe]), axis=0)
    t0 = np.where(flat, np.where(np.abs(n0) <= TOUCH, 0.0, 2.0), np.maximum(ends[0], 0.0))
    t1 = np.where(flat, 1.0, np.minimum(ends[1], 1.0))
    keep = t0 <= t1
    if not keep.any():
        return None
    start, way = local[keep, 0, :2], local[keep, 1, :2] - local[keep, 0, :2]
    uv = np.stack([start + t0[keep, None] * way, start + t1[keep, None] * way], axis=1)
    lines = shapely.linestrings(uv)
    distance = shapely.distance(lines, facet.polygon)
    best = int(np.argmin(distance))
    if distance[best] > TOUCH:
        return None
    on_facet = shapely.get_coordinates(shapely.shortest_line(lines[best], facet.polygon))[-1]
    return facet.to_sensor(on_facet)


def coplanar_overlap(a: Surface, b: Surface) -> float:
    """Area [m²] over which two surfaces lie on each other."""
    total = 0.0
    for facet in a.facets:
        for other in b.facets:
            outline = in_plane_of(facet, other)
            if outline is not None:
                total += float(facet.polygon.intersection(outline).area)
    return total


def to_plane(other: Facet, facet: Facet) -> Polygon:
    """The outline of ``other`` in the (u, v) of ``facet`` [m], projected onto its plane."""

    def convert(uv: Array) -> Array:
        return ((other.to_sensor(uv) - facet.origin) @ facet.axes.T)[:, :2]

    return shapely.transform(other.polygon, convert)


def in_plane_of(facet: Facet, other: Facet) -> Polygon | None:
    """The outline of ``other`` in the (u, v) of ``facet`` [m], or None if not in its plane."""
    height = (ring_vertices(other)[0] - facet.origin) @ facet.axes[2]
    return None if np.abs(height).max() > TOUCH else to_plane(other, facet)


def enters_box(surface: Surface, lower: Array, upper: Array) -> bool:
    """Whether any part of the surface lies inside a box by more than :data:`TOUCH`."""
    low, high = lower + TOUCH, upper - TOUCH
    bounds = facet_bounds(surface)
    near = np.all((bounds[:, 0] <= high) & (bounds[:, 1] >= low), axis=1)
    return any(_facet_in_box(surface.facets[i], low, high) for i in np.flatnonzero(near))


def _facet_in_box(facet: Facet, low: Array, high: Array) -> bool:
    """Clip the facet's bounding rectangle to the box, then intersect in the facet's plane."""
    corners = shapely.get_coordinates(box(*facet.polygon.bounds))[:-1]
    points = list(facet.to_sensor(corners))
    for axis in range(3):
        for sign, level in ((1.0, low[axis]), (-1.0, high[axis])):
            clipped: list[Array] = []
            for p, q in zip(points, points[1:] + points[:1], strict=True):
                dp, dq = sign * (p[axis] - level), sign * (q[axis] - level)
                if dp >= 0.0:
                    clipped.append(p)
                if (dp < 0.0) != (dq < 0.0):
                    clipped.append(p + (q - p) * (dp / (dp - dq)))
            points = clipped
            if len(points) < 3:
                return False
    part = Polygon((np.array(points) - facet.origin) @ facet.axes[:2].T)
    return bool(part.buffer(0).intersects(facet.polygon))


class DesignTable(_validate.Table):
    """One table of a design file; whatever is wrong raises :class:`DesignError`."""

    error_type = DesignError


PLACEMENT_KEYS = ("center", "z", "rotation", "tilt", "quaternion")
"""Keys of an item that say where its shape sits."""


@dataclass(frozen=True, eq=False)
class Placement:
    """A rigid motion: sensor point = ``rotation @ local point + origin``."""

    origin: Array
    """Position [m] of the local origin in the sensor frame, shape (3,)."""
    rotation: Array
    """Rotation matrix from local to sensor axes, shape (3, 3)."""

    def apply(self, points: Array) -> Array:
        """Map local points [m], shape (..., 3), to the sensor frame."""
        return np.asarray(points, dtype=float) @ self.rotation.T + self.origin


def _cos_sin(degrees: float) -> tuple[float, float]:
    """Cosine and sine, exact at multiples of 90°."""
    quarter, rest = divmod(degrees, 90.0)
    if rest == 0.0:
        return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[int(quarter) % 4]
    return math.cos(math.radians(degrees)), math.sin(math.radians(degrees))


def axis_rotation(axis: int, degrees: float) -> Array:
    """Rotation matrix about coordinate axis 0, 1 or 2, shape (3, 3)."""
    c, s = _cos_sin(degrees)
    out = np.eye(3)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    out[i, i] = out[j, j] = c
    out[i, j], out[j, i] = -s, s
    return out


def read_placement(table: DesignTable) -> Placement:
    """Read ``center``, ``z``, ``rotation``, ``tilt`` and ``quaternion`` of an item.

    ``rotation`` turns about the shape's own z axis; ``tilt`` = [rx, ry, rz] then turns about the
    sensor's x, y and z axes, in that order; both in degrees. ``quaternion`` (x, y, z, w) replaces
    both.

    Raises:
        DesignError: If a number is missing or wrong, or if keys contradict each other.
    """
    center = table.coordinates("center", (2, 3), default=(0.0, 0.0))
    if len(center) == 3 and "z" in table:
        raise table.error(
            f"z = {table.data['z']!r} and a third number in center = {list(center)} both set the "
            "height; keep one of them"
        )
    z = center[2] if len(center) == 3 else table.coordinate("z", 0.0)
    rotation = axis_rotation(2, table.number("rotation", -360, 360, 0.0, "degrees"))
    if "quaternion" in table:
        for key in ("rotation", "tilt"):
            if key in table:
                raise table.error(
                    f"{key} = {table.data[key]!r} and quaternion both turn the shape; "
                    "keep one of them"
                )
        from scipy.spatial.transform import Rotation

        quaternion, *more = table.unit_quaternions("quaternion")
        if more:
            raise table.error(f"quaternion holds {1 + len(more)} orientations; give one")
        rotation = Rotation.from_quat(quaternion).as_matrix()
    elif "tilt" in table:
        angles = table.numbers("tilt", (3,), "[rx, ry, rz] in degrees")
        for angle in angles:
            if abs(angle) > 360:
                raise table.error(f"tilt = {list(angles)} must be within ±360 degrees")
        for axis, angle in enumerate(angles):
            rotation = axis_rotation(axis, angle) @ rotation
    return Placement(np.array([center[0], center[1], z]), rotation)


def place_polygons(polygons: Sequence[Polygon], placement: Placement) -> Surface:
    """A sheet of planar facets from polygons [m] in the local plane z = 0.

    A horizontal sheet gets the axes of the sensor frame and the origin (0, 0, z), so that its
    polygons hold sensor coordinates (x, y); any other keeps its local polygons.
    """
    rotation, origin = placement.rotation, placement.origin
    facets = []
    horizontal = bool(np.all(np.abs(rotation[:2, 2]) < 1e-12))
    for polygon in polygons:
        if horizontal:
            (a, b), (d, e) = rotation[0, :2], rotation[1, :2]
            moved = shapely.affinity.affine_transform(polygon, [a, b, d, e, origin[0], origin[1]])
            facets.append(Facet(orient(moved), np.array([0.0, 0.0, origin[2]]), np.eye(3)))
        else:
            facets.append(Facet(orient(polygon), origin.copy(), rotation.T.copy()))
    rims = np.concatenate([boundary_segments(f) for f in facets])
    return Surface(tuple(facets), rims)
