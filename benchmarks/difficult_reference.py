"""References of ΔC for difficult bodies: thin, long, hollow, filled, or larger than the domain.

``difficult.py --make`` runs it. Boundary elements as in ``near_reference.py``, apart from the
package's own: the sensor's matrix is eliminated, so that no difference of two large numbers is
taken. Bodies may be dielectrics, also of two materials that share a face. With S the sensor's
matrix, R what bodies' charges do to its rows, B the potentials and F the rows of a unit sensor on
the bodies (the flux where a body is a dielectric),

    ΔC = Φᵀ (P − F S⁻¹ R)⁻¹ F S⁻¹ U,   Φ = B S⁻¹ U.

A foil is one sheet of charge at the middle of its thickness. Wires and needles have sides of an
equal cross-section. Bodies that reach through grounded walls end half a millimetre before these.
Units are metres, 4π eps0 = 1 inside.
"""

from __future__ import annotations

import math
import sys
import time
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import scipy.linalg
from bem_reference import Panels, box_panels, face, spread
from near_integrals import fluxes, potentials
from near_reference import Feature, Layout, induced, sensor_panels, stops
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))

from difficult_scenes import SECTIONS, outline

import capsense as cs

Array = NDArray[np.float64]
Row = dict[str, Any]
FEMTO = 1e-15
SCALES, ORDER = (1.5, 1.0), 2.0
"""Panel sizes of the two meshes, and the power of them that errors go with."""
EDGE, GROWTH, SHARE = 0.02, 0.4, 0.35
"""Panels at an electrode's edge over its width; growth with distance; least ones over the gap."""
WALL_GAP = 0.5e-3
"""Where bodies that reach through a grounded wall end before it [m]."""
SIDES = 8
"""Of wires and needles."""
ROUND = 40
"""Sides of wide round bodies."""
CORNER = 0.15
"""Panels at corners of a cup over its wall."""


@dataclass
class Piece:
    """Panels of a body that are one kind."""

    corners: Array
    """(n, 4, 3) [m] in the sensor frame, counter-clockwise from the front."""
    conductor: int = -1
    """Number of the body, or −1 for the face of a dielectric."""
    front: float = 1.0
    """Permittivities on both sides."""
    back: float = 1.0
    shells: dict[str, float] = field(default_factory=dict)
    """Closed surfaces it is part of, the first of them its own; 1 where it faces out, else −1."""


def placed(body: Row, corners: Array) -> Array:
    """Panels of a body's frame in the sensor frame."""
    turn = Rotation.from_quat(body["quaternion"]).as_matrix()
    return corners @ turn.T + np.array(body["position"])


def turned(profile: Array, sides: int) -> Array:
    """Panels of a polyhedron of ``sides`` sides about z from its outline (n, 2), lower pole first.

    Panels at a pole are triangles.
    """
    angle = 2 * math.pi * np.arange(sides + 1) / sides
    nodes = np.stack([profile[:, :1] * np.cos(angle), profile[:, :1] * np.sin(angle),
                      np.repeat(profile[:, 1:], sides + 1, axis=1)], axis=-1)  # fmt: skip
    a, b, c, d = nodes[:-1, :-1], nodes[:-1, 1:], nodes[1:, 1:], nodes[1:, :-1]
    corners = np.stack([a, b, c, d], axis=2)
    top = profile[1:, 0] == 0
    corners[top] = np.stack([a, b, c, c], axis=2)[top]
    bottom = profile[:-1, 0] == 0
    corners[bottom] = np.stack([a, c, d, d], axis=2)[bottom]
    return corners.reshape(-1, 4, 3)


def faceted(profile: Array, parts: int) -> Array:
    """As :func:`turned` with :data:`SECTIONS` flat sides, each cut into ``parts``."""
    angle = 2 * math.pi * np.arange(SECTIONS + 1) / SECTIONS
    corner = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    share = np.arange(parts) / parts
    ring = (corner[:-1, None] + share[:, None] * np.diff(corner, axis=0)[:, None]).reshape(-1, 2)
    ring = np.concatenate([ring, ring[:1]])
    unit = turned(profile, len(ring) - 1)
    # same order of panels, corners on the chords instead of the circle
    k = np.rint(np.arctan2(unit[..., 1], unit[..., 0]) / (2 * math.pi) * (len(ring) - 1))
    k = k.astype(int) % (len(ring) - 1)
    radius = np.hypot(unit[..., 0], unit[..., 1])
    unit[..., :2] = radius[..., None] * ring[k]
    return unit


def graded_line(a: Array, b: Array, least: tuple[float, float], most: float) -> Array:
    """Points from a to b (n, 2), small steps at both ends."""
    length = float(np.linalg.norm(b - a))

    def size(x: Array) -> Array:
        ends_ = np.minimum(least[0] + GROWTH * x, least[1] + GROWTH * (length - x))
        return np.minimum(ends_, most)

    cuts = spread(np.array([0.0, length]), size)
    return a + cuts[:, None] / length * (b - a)


def rod_profile(body: Row, scale: float, near: float) -> Array:
    """Outline of a thin capsule or ellipsoid; ``near`` is the largest panel [m]."""
    if body["shape"] == "ellipsoid":
        radius, half = body["size"][0], body["size"][2]
        s = np.linspace(0, 1, round(60 / scale) + 1)
        angle = math.pi * s
        out = np.stack([radius * np.sin(angle), -half * np.cos(angle)], axis=1)
    else:
        radius, length = body["size"][:2]
        half = length / 2
        most = scale * min(near, length / 12)
        least = scale * radius
        bend = np.linspace(0, math.pi / 2, round(4.5 / scale) + 1)
        if body["shape"] == "capsule":
            low = np.stack([radius * np.sin(bend), -half - radius * np.cos(bend)], axis=1)
        else:
            low = np.array([[0, -half], [0.6 * radius, -half], [radius, -half]])
        middle = graded_line(np.array([radius, -half]), np.array([radius, half]), (least, least),
                             most)  # fmt: skip
        out = np.concatenate([low, middle[1:-1], (low * [1, -1])[::-1]])
    out[[0, -1], 0] = 0.0
    return out


def equal_area(sides: int) -> float:
    """Radius of a polygon's corners over that of a circle of its area."""
    return math.sqrt(2 * math.pi / sides / math.sin(2 * math.pi / sides))


def rims(layout: Layout, axis: int) -> Array:
    """Places of the electrodes' edges along an axis."""
    return np.unique([e[0, axis] for _, e, _ in layout.edges() if e[0, axis] == e[1, axis]])


def sheet(layout: Layout, body: Row, half: tuple[float, float], scale: float, z: float,
          free: bool = True) -> Array:  # fmt: skip
    """Panels of a flat sheet at local z; ``free``: charge crowds at its edges."""
    turn = Rotation.from_quat(body["quaternion"]).as_matrix()
    at = np.array(body["position"])
    cuts = []
    for axis in (0, 1):
        slope = float(turn[2, axis])
        lines = rims(layout, axis) - at[axis]

        def size(x: Array, axis: int = axis, slope: float = slope, lines: Array = lines) -> Array:
            height = np.maximum(at[2] + slope * x - abs(float(turn[2, 1 - axis])) * half[1 - axis],
                                1e-3) - layout.top  # fmt: skip
            own = np.full(len(x), 0.18 * half[axis])
            if free:
                own = np.minimum(own, 0.015 * half[axis] + GROWTH * (half[axis] - abs(x)))
            away = np.abs(x[:, None] - lines).min(axis=1)
            return scale * np.minimum(own, SHARE * height + GROWTH * away)

        cuts.append(spread(np.array([-half[axis], 0.0, half[axis]]), size))
    return face(2, 1.0, *cuts)[:, ::-1] + np.array([0, 0, z - 1.0])


def cup_line(points: Array, wall: float, scale: float, most: float) -> Array:
    """Outline of a cup through its corners, small steps at these."""
    out = [points[:1]]
    for a, b in pairwise(points):
        least = [scale * CORNER * wall if p[0] > 0 else scale * most for p in (a, b)]
        out.append(graded_line(a, b, (least[0], least[1]), scale * most)[1:])
    return np.concatenate(out)


def pieces(layout: Layout, bodies: list[Row], scale: float) -> tuple[list[Piece], list[Feature]]:
    """Panels of all bodies, and where the sensor's are small."""
    out: list[Piece] = []
    features: list[Feature] = []
    domain = layout.design.domain
    room = domain.upper - WALL_GAP

    def under(points: Array, gap: float) -> None:
        low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
        for axis in (0, 1):
            for at in {float(low[axis]), float(high[axis])}:
                features.append(
                    Feature(
                        axis,
                        round(at, 9),
                        float(low[1 - axis]),
                        float(high[1 - axis]),
                        layout.top,
                        SHARE * gap,
                    )
                )

    water = next((b for b in bodies if b["shape"] == "prism"), None)
    for k, body in enumerate(bodies):
        size, shape = body["size"], body["shape"]
        conducts = body["kind"] != "diel"
        number = k if conducts else -1
        eps = float(body["eps_r"])
        turn = Rotation.from_quat(body["quaternion"]).as_matrix()
        if body.get("solved_as") == "foil":
            corners = placed(body, sheet(layout, body, (size[0] / 2, size[1] / 2), scale, 0.0))
            out.append(Piece(corners, number))
            low = corners.reshape(-1, 3)
            low = low[low[:, 2] < low[:, 2].min() + 1e-9]
            under(low, float(low[0, 2]) - layout.top)
        elif body.get("solved_as") == "wall":
            corners = sheet(layout, {**body, "quaternion": [0, 0, 0, 1],
                                     "position": [0, 0, body["position"][2] - size[2] / 2]},
                            (room[0], room[1]), scale, body["position"][2] - size[2] / 2,
                            free=False)  # fmt: skip
            out.append(Piece(corners, number))
        elif body.get("solved_as") == "cap":
            radius, center = size[0], body["position"]
            flat = {**body, "quaternion": [0, 0, 0, 1],
                    "position": [0, 0, center[2] - radius]}  # fmt: skip
            corners = sheet(layout, flat, (room[0], room[1]), scale, 0.0, free=False)
            off = corners[..., :2] - np.array(center[:2])
            corners[..., 2] = center[2] - np.sqrt(radius**2 - (off**2).sum(axis=-1))
            both = np.concatenate([corners[:, [0, 1, 2, 2]], corners[:, [0, 2, 3, 3]]])
            out.append(Piece(both, number))
        elif body.get("solved_as") == "pipe":
            radius, half = size[0], float(room[0])
            near = 0.4 * (body["position"][2] - radius)
            line = graded_line(np.array([radius, -half]), np.array([radius, half]),
                               (scale * near, scale * near), scale * near)  # fmt: skip
            sides = round(ROUND / scale)
            line[:, 0] *= equal_area(sides)
            out.append(Piece(placed(body, turned(line, sides)), number))
        elif shape == "box":
            lines = [rims(layout, axis) - body["position"][axis] for axis in (0, 1)]
            gap = body["position"][2] - size[2] / 2 - layout.top
            half = np.array(size) / 2
            corners = box_panels(half, lambda x, most=0.36 * half[0]: np.full(len(x), scale * most),
                                 16 / scale, (*lines, scale * SHARE * gap))  # fmt: skip
            out.append(Piece(placed(body, corners), number))
            under(np.array(body["position"]) + np.array([[-1, -1, 0], [1, 1, 0]]) * half, gap)
        elif shape in ("capsule", "cylinder", "ellipsoid", "sphere"):
            if shape == "sphere":
                shape, size = "ellipsoid", [size[0]] * 3
                body = {**body, "shape": shape, "size": size}
            thin = size[0] < 2e-3
            sides = SIDES if thin else 4 * round(6 / scale)
            lowest = body["position"][2] - abs(turn[2, 2]) * (size[1] / 2 if shape != "ellipsoid"
                                                             else size[2])  # fmt: skip
            gap = lowest - size[0] * (shape != "ellipsoid") - layout.top
            near = max(0.4 * (gap + size[0]), 0.5 * size[0])
            line = rod_profile(body, scale, near)
            line[:, 0] *= equal_area(sides)
            corners = placed(body, turned(line, sides))
            out.append(Piece(corners, number))
            if body["shape"] != "sphere" and k == 0:
                low = corners.reshape(-1, 3)
                low = low[low[:, 2] < low[:, 2].min() + max(2.1 * size[0] * thin, 1e-4)]
                under(low, gap)
        elif shape == "cup":
            parts = round(3 / scale)
            at, wall = np.array(body["position"]), size[2]
            points = outline("cup", size)
            most = 0.13 * size[0]
            if conducts or water is None:
                corners = placed(body, faceted(cup_line(points, wall, scale, most), parts))
                out.append(Piece(corners, number, 1.0, eps, {f"cup {k}": 1.0}))
            else:
                level, inner = water["size"][1] + size[3], points[3, 0]
                wet = np.array([inner, level])
                dry = np.concatenate([points[:4], [wet]])
                inside = np.stack([wet, *points[4:]])
                top = np.array([wet, [0.0, level]])
                liquid = float(water["eps_r"])

                def add(
                    points: Array,
                    front: float,
                    back: float,
                    shells: dict[str, float],
                    body: Row = body,
                    wall: float = wall,
                    most: float = most,
                ) -> None:
                    line = cup_line(points, wall, scale, most)
                    panels = placed(body, faceted(line, round(3 / scale)))
                    out.append(Piece(panels, -1, front, back, shells))

                add(dry, 1.0, eps, {"both": 1.0})
                add(inside, liquid, eps, {"liquid": -1.0})
                add(top, 1.0, liquid, {"both": 1.0, "liquid": 1.0})
            foot = size[0] * np.array([[-1, -1, 0], [1, 1, 0]])
            under(at + foot, float(at[2]) - layout.top)
        elif shape != "prism":
            raise ValueError(f"no panels for a {shape}")
    return out, features


def solve(design: cs.Design, bodies: list[Row], scale: float) -> tuple[Array, int, int]:
    """ΔC [F] of some bodies, and panels of the sensor and of these."""
    layout = Layout(design)
    parts, features = pieces(layout, bodies, scale)
    for z, ends_, width in layout.edges():
        axis = int(abs(ends_[1, 0] - ends_[0, 0]) > 1e-9)
        reach = np.sort(ends_[:, 1 - axis])
        features.append(
            Feature(axis, float(ends_[0, axis]), *reach.tolist(), z, EDGE * width)
        )  # fmt: skip
    for layer in design.layers:
        for axis in (0, 1):
            for at in (layer.lower[axis], layer.upper[axis]):
                low, high = float(layer.lower[1 - axis]), float(layer.upper[1 - axis])
                features.append(Feature(axis, float(at), low, high, float(layer.upper[2]),
                                        0.6 * float(layer.upper[2] - layer.lower[2])))  # fmt: skip
    corners, owner, eps = sensor_panels(layout, features, stops(layout, None), scale)
    floor = np.array([0, 0, design.domain.floor])
    sensor = Panels(corners - floor)
    body = Panels(np.concatenate([p.corners for p in parts]) - floor)
    whose = np.repeat(np.arange(len(parts)), [len(p.corners) for p in parts])
    free = [k for k, b in enumerate(bodies) if b["kind"] == "floating"]
    return change(sensor, owner, eps, body, whose, parts, free), len(sensor), len(body)


def filled(rows: Panels, given: NDArray[np.bool_], columns: Panels) -> Array:
    """Potentials of the columns' panels in rows that are ``given``, their fluxes in the others."""
    out = np.empty((len(rows), len(columns)))
    if given.any():
        out[given] = potentials(Panels(rows.corners[given]), columns)
    if not given.all():
        out[~given] = fluxes(Panels(rows.corners[~given]), columns)
    return out


def change(sensor: Panels, owner: Array, eps: Array, body: Panels, whose: Array,
           parts: list[Piece], free: list[int]) -> Array:  # fmt: skip
    """ΔC [F]; see the head of this file."""
    held = owner > -2
    matrix = square(sensor, held)
    front, back = eps.T
    at = np.flatnonzero(~held)
    matrix[at, at] += 2 * math.pi * ((front + back)[at] / (front - back)[at]) * sensor.area[at]
    number = np.array([p.conductor for p in parts])[whose]
    conducts = number >= 0
    own = square(body, conducts)
    faces = np.flatnonzero(~conducts)
    front, back = (np.array([getattr(p, k) for p in parts])[whose] for k in ("front", "back"))
    mend(own, body, whose, parts)
    inside = 2 * math.pi * (front + back)[faces] / (front - back)[faces]
    own[faces, faces] += inside * body.area[faces]
    unit = np.zeros((len(sensor), int(owner.max()) + 1))
    driven = np.flatnonzero(owner >= 0)
    unit[driven, owner[driven]] = sensor.area[driven]
    factor = scipy.linalg.lu_factor(matrix, overwrite_a=True, check_finite=False)
    right = filled(sensor, held, body)
    answer = scipy.linalg.lu_solve(factor, np.hstack([right, unit]), check_finite=False)
    n = len(body)
    rows = filled(body, conducts, sensor)
    phi = rows @ answer[:, n:]
    potential = phi.copy()
    if len(faces):
        potential[faces] = potentials(Panels(body.corners[faces]), sensor) @ answer[:, n:]
    areas = [body.area * (number == k) for k in free]
    return induced(own - rows @ answer[:, :n], phi, potential, areas)


def square(panels: Panels, given: NDArray[np.bool_]) -> Array:
    """As :func:`filled`, of a set with itself; no panel sends a flux through itself."""
    out = np.empty((len(panels), len(panels)))
    one, two = np.flatnonzero(given), np.flatnonzero(~given)
    if len(one):
        held = Panels(panels.corners[one])
        out[np.ix_(one, one)] = potentials(held, held)
    if len(two):
        faces = Panels(panels.corners[two])
        out[np.ix_(two, two)] = fluxes(faces, faces)
        if len(one):
            out[np.ix_(one, two)] = potentials(held, faces)
            out[np.ix_(two, one)] = fluxes(faces, held)
    return out


def mend(own: Array, body: Panels, whose: Array, parts: list[Piece]) -> None:
    """Half of a panel's flux leaves a closed surface through its other panels: make it so."""
    for shell in {s for p in parts if p.conductor < 0 for s in p.shells}:
        members = [k for k, p in enumerate(parts) if shell in p.shells]
        sign = np.zeros(len(body))
        for k in members:
            sign[whose == k] = parts[k].shells[shell]
        for k in members:
            if next(iter(parts[k].shells)) != shell:
                continue
            mine = np.flatnonzero(whose == k)
            lost = 2 * math.pi * body.area[mine] - sign @ own[:, mine]
            if np.abs(lost / body.area[mine]).max() > 0.6:
                raise ValueError(f"the surface {shell!r} is not closed")
            own[mine, mine] += sign[mine] * lost


def referenced(design: cs.Design, case: Row) -> Row:
    """The case with ΔC [fF], extrapolated from two meshes, and what that adds as its error."""
    started = time.perf_counter()
    coarse, *_ = solve(design, case["bodies"], SCALES[0])
    fine, *panels = solve(design, case["bodies"], SCALES[1])
    best = fine + (fine - coarse) / ((SCALES[0] / SCALES[1]) ** ORDER - 1)
    largest = np.abs(best).max()
    return {
        **case, "delta_fF": [[float(f"{v:.5g}") for v in row] for row in best / FEMTO],
        "error": round(float(np.abs(best - fine).max() / largest), 4), "panels": panels,
        "seconds": round(time.perf_counter() - started, 1),
    }  # fmt: skip
