"""Small designs for the mesh tests, built from the data model alone."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import ArrayLike

from capsense.design.geometry import Facet, Surface
from capsense.design.model import Conductor, Design, Domain, Electrode, Layer, Role


def sheet(polygon: shapely.Polygon, z: float = 0.0) -> Surface:
    """A flat sheet at height z [m] whose outlines are its rims."""
    rims = []
    for ring in (polygon.exterior, *polygon.interiors):
        corners = np.asarray(ring.coords)[:, :2]
        rims += [((*a, z), (*b, z)) for a, b in pairwise(corners)]
    facet = Facet(polygon, np.array([0.0, 0.0, z]), np.eye(3))
    return Surface((facet,), np.array(rims, dtype=float))


def rectangle(center: ArrayLike, size: ArrayLike, z: float = 0.0) -> Surface:
    """A rectangle [m] centred at (x, y); one number stands for both."""
    (x, y), (w, h) = np.broadcast_to(center, 2), np.broadcast_to(size, 2)
    return sheet(shapely.box(x - w / 2, y - h / 2, x + w / 2, y + h / 2), z)


def roof() -> Surface:
    """Two squares of 20 mm that share a ridge, one of them tilted by 30 degrees."""
    square = shapely.box(0.0, 0.0, 0.02, 0.02)
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    tilted = np.array([[-c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, -c]])
    origin = np.zeros(3)
    facets = (Facet(square, origin, np.eye(3)), Facet(square, origin, tilted))
    rims = np.array([[(0.0, 0.0, 0.0), (0.0, 0.02, 0.0)]])
    return Surface(facets, rims)


def two_patches(**changes: object) -> Design:
    """Two patches on a plate, with a pour that has a hole for each, over a grounded floor."""
    patches = [rectangle((x, 0.0), (0.02, 0.02)) for x in (-0.015, 0.015)]
    hull = shapely.box(-0.035, -0.02, 0.035, 0.02)
    for patch in patches:
        hull = hull.difference(patch.facets[0].polygon.buffer(0.002, join_style="mitre"))
    parts: dict[str, object] = {
        "name": "two_patches",
        "domain": Domain((0.2, 0.2, 0.2), 0.02),
        "electrodes": tuple(Electrode(f"E{i}", p) for i, p in enumerate(patches, start=1)),
        "layers": (
            Layer(
                "plate", "glass", 5.0, np.array([-0.04, -0.03, -0.002]), np.array([0.04, 0.03, 0.0])
            ),
        ),
        "conductors": (Conductor("pour", Role.GROUND, sheet(hull)),),
    }
    return Design(**{**parts, **changes})  # type: ignore[arg-type]
