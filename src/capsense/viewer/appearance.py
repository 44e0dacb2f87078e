"""How bodies look: their colours by material, and which of them hide a sensor."""

from __future__ import annotations

import html
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from capsense.scene import Material, Shape

Array = NDArray[np.float64]
Colour = tuple[int, int, int]

COLOURS_OF: dict[str, Colour] = {
    "steel": (120, 134, 150), "stainless steel": (146, 158, 170), "aluminium": (172, 180, 188),
    "copper": (190, 118, 70),
    "human": (219, 164, 134), "skin": (219, 164, 134), "wet skin": (201, 140, 112),
    "muscle": (176, 84, 78), "fat": (236, 208, 138), "blood": (150, 32, 32),
    "cortical bone": (226, 216, 190), "cancellous bone": (214, 200, 168),
    "water": (92, 158, 212), "deionised water": (132, 186, 228),
    "wood": (176, 131, 84), "cotton": (222, 217, 203), "FR4": (96, 148, 92),
    "glass": (168, 210, 206), "borosilicate glass": (168, 210, 206),
    "soda-lime glass": (168, 210, 206), "alumina": (236, 232, 224),
    "silicone": (186, 178, 206), "silicone rubber": (186, 178, 206),
    "polyimide": (206, 148, 62), "PTFE": (228, 230, 232),
}  # fmt: skip
"""Material → red, green and blue."""
CONDUCTIVE: Colour = COLOURS_OF["steel"]
"""Of a conductor that is not among them."""
DIELECTRIC: Colour = (150, 190, 205)
"""Of any other matter that is not among them, such as plastics."""
CHARGE_DECADES = 3.0
"""Charges down to ten to the minus this of the densest are shown."""
SEEN_THROUGH = 0.3
"""Opacity of what hides a sensor."""
DEPTH = 0.01
"""A line of sight that runs so far [m] through a solid is blocked; less is a grazed edge."""
SUNK = 5e-4
"""What is no higher than this above a solid's face [m] is drawn in it, not on it."""


def colour_of(material: Material) -> Colour:
    """Red, green and blue of a material: its own, or that of conductors or of other matter."""
    kind = material.name.partition(" at ")[0]  # water at 25 °C
    return COLOURS_OF.get(kind, CONDUCTIVE if material.is_conductor() else DIELECTRIC)


def matter_legend(materials: Iterable[Material]) -> str:
    """Names of the materials with their colours, each once, as HTML; empty for none."""
    marks = {
        m.name: '<span style="white-space:nowrap"><span style="background:rgb({},{},{});'
        'border-radius:2px">&emsp;</span> {}</span>'.format(*colour_of(m), html.escape(m.name))
        for m in materials
    }
    return " ".join(marks[name] for name in sorted(marks))


def charge_colours(share: Array) -> NDArray[np.uint8]:
    """Red, green and blue of charges, from none, 0, to the densest, 1, shape (n, 3)."""
    from matplotlib import colormaps

    return colormaps["RdPu"](0.15 + 0.85 * share, bytes=True)[:, :3]


def faces_of_hull(shape: Shape) -> Array:
    """The planes n · x + d = 0 that bound a shape's convex hull, n outwards and d [m], (f, 4)."""
    points = shape.to_trimesh().vertices
    try:
        return np.unique(np.round(ConvexHull(points).equations, 9), axis=0)
    except QhullError:  # flat: it has no inside
        return np.array([[1.0, 0.0, 0.0, np.inf]])


def blocks(faces: Array, eye: Array, points: Array) -> bool:
    """Whether a convex body stands between a place and any of some points, or holds one.

    Args:
        faces: As of :func:`faces_of_hull`.
        eye: The place, in the body's frame [m], shape (3,).
        points: The points, in the same frame [m], shape (n, 3).
    """
    ways = points - eye
    # A way eye + t (point - eye) is behind a face for t beyond or before where it crosses it.
    gap, slope = -(faces[:, :3] @ eye + faces[:, 3]), ways @ faces[:, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = gap / slope
    enter = np.where(slope < 0, crossing, np.where((slope == 0) & (gap < 0), np.inf, -np.inf))
    leave = np.where(slope > 0, crossing, np.inf)
    first = np.clip(enter.max(axis=1), 0.0, 1.0)
    last = np.clip(leave.min(axis=1), 0.0, 1.0)
    inside = (last - first) * np.linalg.norm(ways, axis=1)
    sunk = (points @ faces[:, :3].T + faces[:, 3]).max(axis=1) < SUNK
    return bool((sunk | (inside > DEPTH)).any())
