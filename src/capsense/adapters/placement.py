"""What is wrong with where a sensor sits and what it sees: every finding with its fix."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Set

import numpy as np
from numpy.typing import NDArray

from capsense.adapters.findings import Finding, Findings
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
_PRESSED = 3e-3
"""Simulators let bodies that are pressed together overlap by less than this [m]."""
_FLUSH = 1e-3
"""Electrodes stand out of the surface that collides by no more than this [m], where what is pressed
against it is in contact with them."""
FAR = 1.0
"""Few sensors are farther [m] from the origin of the link that carries them."""
_BACK = 15e-3
"""Bodies behind an electrode that are nearer to it than this [m] are told."""
_FEW = 20
"""About so many points of each electrode are looked at for that,"""
_STEP = 2e-3
"""and how much nearer they come, going back by this [m]."""
BLIND = "blind"
"""Kind of the findings that say that nothing is in view."""
_NOTHING = "nothing is in view, so that every change is exactly 0"


def placement(
    scene: Scene,
    simulator: Simulator,
    near: Set[str] = frozenset(),
    pressed: Mapping[str, float] | None = None,
) -> Findings:
    """What is wrong with the bodies of a scene, given in the sensor frame.

    Args:
        scene: The bodies.
        simulator: The sensor.
        near: Names of those on links next to the one that carries the sensor: where they are is a
            matter of its mounting.
        pressed: Names of those that the robot's simulator has in contact with that link, and how
            far it lets them overlap [m].
    """
    contacts, met = _contacts(scene, simulator, near, pressed or {})
    others = [body for body in scene if str(body.name) not in met]
    behind = [
        text
        for own in (True, False)
        for text in _behind(
            [b for b in others if (b.name in near) == own], simulator.design, mounting=own
        )
    ]
    coarse = [text for body in scene for text in _coarse(body, simulator)]
    return Findings(contacts + behind + coarse)


def buried(link: Scene, design: Design) -> list[Finding]:
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
    text = (
        f"{found.electrodes} {found.verb('lies', 'lie')} up to {1e3 * found.depth:.0f} mm deep "
        f"inside {listed(found.bodies, 4)}, on the link that carries the sensor. That link is not "
        "seen, so readings are as if it did not cover them; a real one would screen them. Move the "
        "sensor's frame out to the link's surface, or, if the link is hollow there, "
        f"{_leave_out(found)}"
    )
    return [Finding(text, "buried", mounting=True, severity=found.depth)]


def _points(design: Design) -> dict[str, Array]:
    """Points on each electrode [m]."""
    return {e.name: points_on(e.surface.triangles) for e in design.electrodes}


def felt(simulator: Simulator, scene: Scene, found: Findings) -> Findings:
    """What the reading of a scene adds to the findings, or puts in their place.

    A box around a body may be in view, and itself not: then nothing is. A large estimated error is
    told as the reading itself would warn of it, but not where findings tell why.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # findings tell of all that
            reading = simulator.solved_batch([scene], threads=1)[0]
    except CapSenseError:  # which a reading will raise, too
        return found
    if not reading.delta.any():
        return Findings([nothing_seen(simulator.design)])
    doubt = None if found else simulator.doubt_about(scene, reading)
    if doubt is not None:
        found.append(Finding(doubt.text, "rough", severity=doubt.share))
    return found


def blind(found: list[Finding]) -> bool:
    """Whether findings say that nothing is in view."""
    return any(text.kind == BLIND for text in found)


def nothing_seen(design: Design) -> Finding:
    """The finding for a sensor whose domain is empty."""
    size = " × ".join(f"{v:g}" for v in design.domain.size)
    text = (
        f"{_NOTHING}: the sensor sees {size} m in front of its electrodes, along the z of its "
        "frame; bring something there, or look for what exclude, groups and exclude_own leave out"
    )
    return Finding(text, BLIND)


def markers(names: list[str], exclude: list[str]) -> list[Finding]:
    """The finding for shapes that look like markers: see-through, and nothing hits them.

    Args:
        names: What they are called.
        exclude: Patterns that leave them out.
    """
    if not names:
        return []
    text = (
        f"{listed(names, 4)} can be seen through and collide with nothing, as markers do, but are "
        f"read as bodies; leave out what is none with exclude={exclude[:6]}"
    )
    return [Finding(text, "markers", mounting=True, severity=len(names))]


def far_off(away: float) -> Finding:
    """The finding for a sensor that sees nothing and stands far from what carries it.

    Args:
        away: Its distance from the origin of the link [m].
    """
    text = (
        f"{_NOTHING}, and the sensor stands {away:.3g} m from the origin of the link that carries "
        "it: give its pose in metres (millimetres × 1e-3) and in the frame of that link, not in "
        "that of the world"
    )
    return Finding(text, BLIND, mounting=True, severity=away)


def turned_round(names: list[str], *, mounting: bool) -> Finding:
    """The finding for a sensor that has everything at its back.

    Args:
        names: What stands there.
        mounting: Whether it is mounted wrongly, or may just face out of its link on the far side.
    """
    text = (
        f"{_NOTHING}, but {listed(names, 4)} would be if the sensor faced the other way: its z "
        "must point out of the sensor; if it should see that, turn its frame half round about x "
        '(quaternion (1, 0, 0, 0), in MJCF euler="180 0 0")'
    )
    return Finding(text, BLIND, mounting=mounting)


def _contacts(
    scene: Scene, simulator: Simulator, near: Set[str], pressed: Mapping[str, float]
) -> tuple[list[Finding], list[str]]:
    """Electrodes within bodies, and that touch some: a finding for each; and these bodies."""
    electrodes, touch = _points(simulator.design), simulator.touch
    parts: dict[str, list[Body]] = {"near": [], "pressed": [], "others": []}
    for body in scene:
        name = str(body.name)
        if name in near:
            part = "near"
        elif name in pressed:
            inside, _ = find_contacts(Scene([body]), electrodes, touch)
            overlap = pressed[name]
            soft = overlap <= _PRESSED and inside.depth <= overlap + _FLUSH
            part = "pressed" if soft else "others"
        else:
            part = "others"
        parts[part].append(body)
    out: list[Finding] = []
    bodies: list[str] = []
    for part, some in parts.items():
        conducting = [b for b in some if b.material.is_conductor(simulator.excitation_frequency)]
        inside, _ = find_contacts(Scene(some), electrodes, touch)
        _, touching = find_contacts(Scene(conducting), electrodes, touch)  # as readings warn of it
        bodies += inside.bodies + touching.bodies
        if part == "pressed":
            out += _in_contact(inside, touching)
            continue
        mounting = part == "near"
        end = "" if mounting else " until they part"
        if inside.met:
            text = (
                f"{inside.electrodes} {inside.verb('lies', 'lie')} inside "
                f"{listed(inside.bodies, 4)}, up to {1e3 * inside.depth:.2g} mm deep, and readings "
                f"mean nothing{end}; {_fix(inside, mounting)}"
            )
            out.append(Finding(text, "inside", mounting=mounting, severity=inside.depth))
        if touching.met:
            text = (
                f"{touching.electrodes} {touching.verb('touches', 'touch')} "
                f"{listed(touching.bodies, 4)}, as a short circuit would{end}; "
                f"{_fix(touching, mounting)}"
            )
            out.append(Finding(text, "touching", mounting=mounting))
    return out, bodies


def _in_contact(inside: Contacts, touching: Contacts) -> list[Finding]:
    """The finding for electrodes that something is pressed onto."""
    found = Contacts(dict(inside.met), max(inside.depth, 0.0))
    for name, bodies in touching.met.items():
        found.met[name] = list(dict.fromkeys([*found.met.get(name, []), *bodies]))
    if not found.met:
        return []
    text = (
        f"{found.electrodes} {found.verb('is', 'are')} in contact with {listed(found.bodies, 4)}, "
        f"which the simulator lets overlap by up to {1e3 * found.depth:.2g} mm, and readings mean "
        "nothing until that ends; a sensor that is to be touched needs a cover in its design, or "
        "electrodes behind the surface that collides"
    )
    return [Finding(text, "contact", severity=found.depth)]


def _behind(bodies: list[Body], design: Design, *, mounting: bool) -> list[Finding]:
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
    fix = f"or {_leave_out(found)}"
    if mounting:
        fix = f"describe them in the design, move the sensor's frame, {fix}"
    text = (
        f"{listed(found.bodies, 4)} {'is' if len(found.bodies) == 1 else 'are'} behind "
        f"{found.electrodes}, from {1e3 * found.depth:.2g} mm on. What is behind them is part of "
        f"the design, and other bodies there are read roughly; {fix}"
    )
    return [Finding(text, "behind", mounting=mounting, severity=-found.depth)]


def _fix(found: Contacts, mounting: bool) -> str:
    out = f"at least {1e3 * max(found.depth, 1e-3):.2g} mm"
    move = f"move the sensor's frame {out} out of it" if mounting else f"move one of them {out}"
    return f"{move}, or {_leave_out(found)}"


def _leave_out(found: Contacts) -> str:
    met = found.bodies
    more = ", …" * (len(met) > 4)
    return f"leave it out with exclude=[{', '.join(map(repr, met[:4]))}{more}]"


def _coarse(body: Body, simulator: Simulator) -> list[Finding]:
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
    text = (
        f"{body.name!r} is a mesh of {area:.2g} m², solved with panels of some {1e3 * width:.0f} "
        "mm; cut it into meshes of 0.4 m or less, or keep only what comes near the sensor"
    )
    return [Finding(text, f"coarse {body.name}", severity=width)]
