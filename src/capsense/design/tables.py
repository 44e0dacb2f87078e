"""Tables of a design file: strict reading, relative permittivities of layers, placement.

Permittivities are those that vendors' tables and handbooks give between 100 kHz and 10 MHz; the
middle of the published range where there is one. A design may state ``eps_r`` instead of a name.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely.affinity
from numpy.typing import NDArray
from shapely.geometry import Polygon
from shapely.geometry.polygon import orient

from capsense import _validate
from capsense.design.geometry import Facet, Surface, boundary_segments
from capsense.errors import DesignError


class DesignTable(_validate.Table):
    """One table of a design file; whatever is wrong raises :class:`DesignError`."""

    error_type = DesignError


LAYER_EPS_R: dict[str, float] = {
    "abs": 3.0,
    "acrylic": 3.0,
    "air": 1.0,
    "alumina": 9.8,
    "borosilicate glass": 4.6,
    "fr4": 4.5,
    "pet": 3.2,
    "petg": 3.0,
    "pla": 3.0,
    "polycarbonate": 2.9,
    "polyimide": 3.4,
    "ptfe": 2.1,
    "silicone": 3.2,
    "soda-lime glass": 7.0,
}
"""Relative permittivity by material name (lower case)."""


Array = NDArray[np.float64]

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
