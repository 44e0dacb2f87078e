"""What is wrong with where a sensor sits and what it sees: every finding with its fix."""

from __future__ import annotations

import math
import warnings

import numpy as np
from numpy.typing import NDArray

from capsense.design.model import Design
from capsense.errors import CapSenseError, listed
from capsense.scene import Body, Scene, TriMesh
from capsense.scene.contact import Contacts, distances, find_contacts, points_on
from capsense.scene.shapes import ShapeKind
from capsense.simulator import Simulator
from capsense.solver.surface_solver import PRESETS
from capsense.solver.tree.fine_panels import wide_pieces

Array = NDArray[np.float64]

_COARSE = 0.05
"""Panels of a body wider than this [m] say little of a sensor."""
_DEEP = 5e-3
"""Deeper than this [m] in the link that carries it, an electrode is not on the link's surface; a
cover, or a collision shape that is rounder than the real link, is thinner."""
FAR = 1.0
"""Few sensors are farther [m] from the origin of the link that carries them."""
_BACK = 15e-3
"""Bodies behind an electrode that are nearer to it than this [m] are told."""
_FEW = 20
"""About so many points of each electrode are looked at for that,"""
_STEP = 2e-3
"""and how much nearer they come, going back by this [m]."""
_ROUGH = 0.5
"""A reading with an expected error of this part of its largest change is told."""
_ROUGH_TEXT = "the reading is rough"
_NOTHING = "nothing is in view, so that every change is exactly 0"


def placement(scene: Scene, simulator: Simulator) -> list[str]:
    """What is wrong with the bodies of a scene, given in the sensor frame."""
    contacts, met = _contacts(scene, _points(simulator.design))
    others = [body for body in scene if str(body.name) not in met]
    behind = _behind(others, simulator.design)
    return contacts + behind + [text for body in scene for text in _coarse(body, simulator)]


def buried(link: Scene, design: Design) -> list[str]:
    """The finding for electrodes deep within the link that carries them, which is left out.

    Args:
        link: The bodies of that link, in the sensor frame.
        design: The sensor.
    """
    found = Contacts()
    for name, points in _points(design).items():
        for body in link:
            least = -float(distances(body, points).max())
            if least > _DEEP and body.material.is_conductor():
                found.met.setdefault(name, []).append(str(body.name))
                found.depth = max(found.depth, least)
    if not found.met:
        return []
    return [
        f"{found.electrodes} {found.verb('lies', 'lie')} up to {1e3 * found.depth:.0f} mm deep "
        f"inside {listed(found.bodies, 4)}, on the link that carries the sensor. That link is not "
        "seen, so readings are as if it did not cover them; a real one would screen them. Move the "
        "sensor's frame out to the link's surface, or, if the link is hollow there, "
        f"{_leave_out(found)}"
    ]


def _points(design: Design) -> dict[str, Array]:
    """Points on each electrode [m]."""
    return {e.name: points_on(e.surface.triangles) for e in design.electrodes}


def felt(simulator: Simulator, scene: Scene, found: list[str]) -> list[str]:
    """What the reading of a scene adds to the findings, or puts in their place.

    A box around a body may be in view, and itself not: then nothing is.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # findings tell of contacts
            reading = simulator.solved_batch([scene], threads=1)[0]
    except CapSenseError:  # which a reading will raise, too
        return found
    change, error = float(np.abs(reading.delta).max()), reading.stats.solver_error
    if change == 0.0:
        return [nothing_seen(simulator.design)]
    if found or error < _ROUGH * change:
        return found
    return [
        f"{_ROUGH_TEXT}: it changes by {1e15 * change:.2g} fF, and the solver itself "
        f"expects an error of {1e15 * error:.2g} fF, as where bodies lie within one another; leave "
        "one of them out with exclude, or give those that overlap as one mesh"
    ]


def blind(found: list[str]) -> bool:
    """Whether findings say that nothing is in view."""
    return any(text.startswith(_NOTHING) for text in found)


def is_rough(text: str) -> bool:
    """Whether a finding says that the estimated error of a reading is large."""
    return text.startswith(_ROUGH_TEXT)


def nothing_seen(design: Design) -> str:
    """The finding for a sensor whose domain is empty."""
    size = " × ".join(f"{v:g}" for v in design.domain.size)
    return (
        f"{_NOTHING}: the sensor sees {size} m in front of its electrodes, along the z of its "
        "frame; bring something there, or look for what exclude, groups and exclude_own leave out"
    )


def far_off(away: float) -> str:
    """The finding for a sensor that sees nothing and stands far from what carries it.

    Args:
        away: Its distance from the origin of the link [m].
    """
    return (
        f"{_NOTHING}, and the sensor stands {away:.3g} m from the origin of the link that carries "
        "it: give its pose in metres (millimetres × 1e-3) and in the frame of that link, not in "
        "that of the world"
    )


def turned_round(names: list[str]) -> str:
    """The finding for a sensor that has everything at its back."""
    listed = ", ".join(map(repr, names[:4])) + (", …" if len(names) > 4 else "")
    return (
        f"{_NOTHING}, but {listed} would be if the sensor faced the other way: its z must point "
        "out of the sensor; if it should see that, turn its frame half round about x (quaternion "
        '(1, 0, 0, 0), in MJCF euler="180 0 0")'
    )


def _contacts(scene: Scene, electrodes: dict[str, Array]) -> tuple[list[str], list[str]]:
    """Electrodes within bodies, and that touch some: a finding for each; and these bodies."""
    inside, touching = find_contacts(scene, electrodes)
    out = []
    if inside.met:
        out.append(
            f"{inside.electrodes} {inside.verb('lies', 'lie')} inside {listed(inside.bodies, 4)}, "
            f"up to {1e3 * inside.depth:.2g} mm deep, and readings mean nothing; {_fix(inside)}"
        )
    if touching.met:
        out.append(
            f"{touching.electrodes} {touching.verb('touches', 'touch')} "
            f"{listed(touching.bodies, 4)}, as a short circuit would; {_fix(touching)}"
        )
    return out, inside.bodies + touching.bodies


def _behind(bodies: list[Body], design: Design) -> list[str]:
    """Bodies that are nearest to a flat electrode from behind, where the design has its back."""
    found = Contacts(depth=math.inf)
    for electrode in design.electrodes:
        points = points_on(electrode.surface.triangles, _FEW)
        if np.ptp(points[:, 2]) > 1e-3:
            continue
        for body in bodies:
            if body.shape.kind == ShapeKind.LAYERS:
                continue
            off = distances(body, points)
            k = int(off.argmin())
            if off[k] > _BACK:
                continue
            nearer = off[k] - distances(body, points[[k]] - (0.0, 0.0, _STEP))[0]
            if nearer > 0.5 * _STEP:
                found.met.setdefault(electrode.name, []).append(str(body.name))
                found.depth = min(found.depth, float(off[k]))
    if not found.met:
        return []
    return [
        f"{listed(found.bodies, 4)} {'is' if len(found.bodies) == 1 else 'are'} behind "
        f"{found.electrodes}, from {1e3 * found.depth:.2g} mm on. What is behind them is part of "
        "the design, and other bodies there are read roughly; describe them in the design, move "
        f"the sensor's frame, or {_leave_out(found)}"
    ]


def _fix(found: Contacts) -> str:
    move = f"move the sensor's frame at least {1e3 * max(found.depth, 1e-3):.2g} mm out of it"
    return f"{move}, or {_leave_out(found)}"


def _leave_out(found: Contacts) -> str:
    met = found.bodies
    more = ", …" * (len(met) > 4)
    return f"leave it out with exclude=[{', '.join(map(repr, met[:4]))}{more}]"


def _coarse(body: Body, simulator: Simulator) -> list[str]:
    """A large mesh, whose panels are shared out over all of it."""
    if not isinstance(body.shape, TriMesh):
        return []
    corners = body.shape.vertices[body.shape.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * float(np.linalg.norm(normals, axis=1).sum())
    conducting = body.material.is_conductor(simulator.excitation_frequency)
    pieces = wide_pieces(body.shape, conducting, 0.1 * area)
    width = math.sqrt(area / (pieces or PRESETS[simulator.preset].panels))
    if width < _COARSE or body.shape.parts > 1:
        return []
    return [
        f"{body.name!r} is a mesh of {area:.2g} m², solved with panels of some {1e3 * width:.0f} "
        "mm; cut it into meshes of 0.4 m or less, or keep only what comes near the sensor"
    ]
