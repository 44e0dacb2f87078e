"""Fleets on simulators whose worlds step together in arrays of NVIDIA Warp."""

from __future__ import annotations

import warnings
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, no_type_check

import numpy as np
import warp as wp
from numpy.typing import NDArray

from capsense.adapters.rules import AttachOptions, Names, Rules
from capsense.design.model import Design
from capsense.errors import SceneError, listed
from capsense.fleet import Fleet
from capsense.reading import FleetReading
from capsense.scene import Body
from capsense.simulator import PresetName
from capsense.solver.tree.matter import matter_of

Fixed = tuple[NDArray[np.integer], NDArray[np.floating]]
"""Numbers of bodies, -1 for the world itself, and poses on them (x, y, z [m]; quaternion x, y, z,
w), shapes (worlds, n) and (worlds, n, 7)."""
_SHOWN = 6
"""Names that are listed in a message."""


class FleetOptions(AttachOptions, total=False):
    """Keywords of sensors in many worlds."""

    device: str | None
    """As of a :class:`~capsense.fleet.Fleet`; by default that of the simulator's arrays."""
    preset: PresetName
    budget: int
    """Accuracy on the CPU and on Warp, as of a fleet."""


@dataclass(frozen=True, eq=False)
class WorldShape:
    """One shape of a world, in all worlds."""

    names: Names
    """The names it answers to."""
    body: int
    """The simulator's body that carries it, in the first world; -1 for the world itself."""
    tree: int
    """What hangs together by joints has the same number; -1 for what is fixed to the world."""
    owner: str
    """The rule that says what ties it to ground, see :class:`~capsense.adapters.rules.Tie`."""
    bodies: Body | Sequence[Body | None]
    """What it is: one for all worlds, or one for each, None where there is none."""


class ParallelSensors:
    """Sensors on several sites of a robot, in all worlds of a simulator.

    Conductors that hang together by joints and float, or have a capacitance to ground, by one rule
    are one conductor, whether they touch or not. A capacitance is shared out among all of its rule.

    Args:
        parts: Shapes of a world.
        sites: Names of the sites, and the bodies that carry them.
        worlds: How many worlds.
        design: As of a fleet.
        rules: What is seen.
        device: Warp's device of the simulator's arrays.
        options: Those of :class:`FleetOptions` that are none of the rules.

    Raises:
        SceneError: Nothing can be seen, or the rules leave everything out.
    """

    def __init__(
        self,
        parts: Sequence[WorldShape],
        sites: Sequence[tuple[str, int]],
        worlds: int,
        design: Design | str | Path,
        rules: Rules,
        device: Any,
        options: Mapping[str, Any],
    ) -> None:
        rules.check([part.names for part in parts])
        self.chosen = [k for k, part in enumerate(parts) if not rules.excludes(part.names)]
        """Which of the parts are seen."""
        if not self.chosen:
            raise SceneError("there is nothing to see: all shapes are left out")
        seen = [parts[k] for k in self.chosen]
        first = [_some_body(part) for part in seen]
        where = options.get("device") or ("cpu" if device.is_cpu else str(device))
        self.fleet = Fleet(
            design, first, worlds, sensors=len(sites), **{**options, "device": where}
        )
        """The fleet: its places are the shapes, its sensors the sites."""
        self.names = tuple(part.names[-1] for part in seen)
        self.sites = tuple(name for name, _ in sites)
        """Names of the shapes that are seen, and of the sites, in order."""
        shared, groups = _connected(seen, self.fleet.excitation_frequency)
        for place, bodies in enumerate(shared):
            if bodies is not first[place]:
                self.fleet.change(place, bodies)
        for group in groups:
            self.fleet.join(group)
        if rules.exclude_own:
            for sensor, (_, own) in enumerate(sites):
                mine = [k for k, part in enumerate(seen) if part.body == own >= 0]
                self.fleet.hide(sensor, mine)
        self._poses = wp.zeros((worlds, len(seen)), dtype=wp.transform, device=device)
        self._frames = wp.zeros((worlds, len(sites)), dtype=wp.transform, device=device)

    def _fix(self, places: Fixed, sites: Fixed) -> None:
        """Say where the shapes that are seen, and the sites, are on the simulator's bodies."""
        device = self._poses.device
        self._fixed = [
            (as_numbers(number, device), wp.array(local, dtype=wp.transform, device=device), out)
            for (number, local), out in ((places, self._poses), (sites, self._frames))
        ]

    def _follow(self, parents: Any) -> None:
        """Take over the poses of the simulator's bodies, transforms of shape (worlds, bodies)."""
        for number, local, out in self._fixed:
            inputs = [parents, number, local, out]
            wp.launch(compose, dim=out.shape, inputs=inputs, device=out.device)

    def _read(self, time: float | None) -> FleetReading:
        """The reading at the poses that stand in the two arrays."""
        poses, frames = self._poses, self._frames
        if self.fleet.device == "cpu":
            poses, frames = poses.numpy(), frames.numpy()
        return self.fleet.step(poses, frames, time=time)


def _connected(
    parts: Sequence[WorldShape], frequency: float
) -> tuple[list[Body | Sequence[Body | None]], list[list[int]]]:
    """The bodies of parts with their shares of capacitances, and which parts are one conductor."""
    free = [k for k, part in enumerate(parts) if _is_free(_some_body(part), frequency)]
    count = Counter(parts[k].owner for k in free)
    out = [part.bodies for part in parts]
    groups: dict[tuple[int, str], list[int]] = defaultdict(list)
    for k in free:
        tree, owner = parts[k].tree, parts[k].owner
        out[k] = _with_share(out[k], count[owner])
        if tree >= 0:
            groups[tree, owner].append(k)
    return out, [group for group in groups.values() if len(group) > 1]


def _is_free(body: Body, frequency: float) -> bool:
    """Whether a body is a conductor that is not simply grounded."""
    return body.grounding != "grounded" and bool(matter_of([body], frequency).conducting[0])


def _with_share(bodies: Body | Sequence[Body | None], count: int) -> Body | Sequence[Body | None]:
    """Bodies with one of ``count`` equal shares of their capacitance to ground."""
    some = [bodies] if isinstance(bodies, Body) else bodies
    made = {
        id(b): Body(b.shape, b.pose, b.material, b.grounding / count, b.name, b.force)
        for b in some
        if b is not None and not isinstance(b.grounding, str)
    }
    if isinstance(bodies, Body):
        return made.get(id(bodies), bodies)
    return [made.get(id(b), b) for b in bodies]


def _some_body(part: WorldShape) -> Body:
    """A body that stands in a part's place in some world."""
    if isinstance(part.bodies, Body):
        return part.bodies
    return next(body for body in part.bodies if body is not None)


def warn_left_out(names: Sequence[str], why: str) -> None:
    """Say once which shapes of a model are not seen."""
    if names:
        warnings.warn(f"sensor: {listed(names, _SHOWN)} not seen: {why}", stacklevel=4)


def matching(known: Sequence[str], patterns: str | Sequence[str], what: str) -> list[int]:
    """Numbers of the names that fit one of some patterns, in the order of the patterns.

    Raises:
        SceneError: A pattern fits nothing.
    """
    from fnmatch import fnmatchcase

    out: dict[int, None] = {}
    for pattern in [patterns] if isinstance(patterns, str) else patterns:
        found = [k for k, name in enumerate(known) if fnmatchcase(name, pattern)]
        if not found:
            raise SceneError(f"no {what} fits {pattern!r}; there are {list(known)[:20]}")
        out.update(dict.fromkeys(found))
    return list(out)


def as_numbers(values: Any, device: Any) -> Any:
    """Whole numbers as an array of Warp."""
    return wp.array(np.ascontiguousarray(values, np.int32), dtype=wp.int32, device=device)


@no_type_check
@wp.kernel(enable_backward=False)
def compose(
    parents: wp.array2d(dtype=wp.transform), number: wp.array2d(dtype=wp.int32),
    local: wp.array2d(dtype=wp.transform), out: wp.array2d(dtype=wp.transform),
) -> None:  # fmt: skip
    """Poses in the world of what is fixed to some of its bodies, -1 for the world itself."""
    w, k = wp.tid()
    at = local[w, k]
    if number[w, k] >= 0:
        at = wp.transform_multiply(parents[w, number[w, k]], at)
    out[w, k] = at


@no_type_check
@wp.kernel(enable_backward=False)
def from_matrices(
    position: wp.array2d(dtype=wp.vec3), matrix: wp.array2d(dtype=wp.mat33),
    number: wp.array(dtype=wp.int32), out: wp.array2d(dtype=wp.transform),
) -> None:  # fmt: skip
    """Poses of some of what a simulator gives by positions and rotation matrices."""
    w, k = wp.tid()
    n = number[k]
    out[w, k] = wp.transform(position[w, n], wp.quat_from_matrix(matrix[w, n]))
