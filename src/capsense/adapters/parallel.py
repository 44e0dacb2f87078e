"""Fleets on simulators whose worlds step together in arrays of NVIDIA Warp."""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self, TypeVar, no_type_check

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from capsense._style import signal_colours, strength
from capsense._validate import chosen_rows
from capsense.adapters.grounds import Ground, TerrainParts
from capsense.adapters.meshes import Terrain
from capsense.adapters.record import ParallelData, Record
from capsense.adapters.rules import AttachOptions, Names, Rules, Tie, matches
from capsense.design import load_design
from capsense.design.model import Design, Domain
from capsense.errors import SceneError, listed
from capsense.fleet import Fleet
from capsense.fleet.bodies import on_device
from capsense.reading import FleetReading
from capsense.readout import Readout
from capsense.readout.randomisation import ReadoutRandomisation
from capsense.scene import Body, Shape
from capsense.simulator import PresetName

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
    readout: Readout | str | Path | None
    """A readout, a chip's name or a file, of which every sensor has a chip; none by default."""
    randomisation: ReadoutRandomisation | None
    """In what chips differ, drawn anew at a reset; see :meth:`Fleet.use_readout`."""
    seed: int | None
    """Of all random numbers of the chips; by default the readout's own."""
    history_length: int
    """How many readings of each world are kept in ``data.history``; none by default."""


@dataclass(frozen=True, eq=False)
class WorldShape:
    """One shape of a world, in all worlds."""

    names: Names
    """The names it answers to."""
    body: int
    """The simulator's body that carries it, in the first world; -1 for the world itself."""
    tree: int
    """What hangs together by joints has the same number; -1 for what is fixed to the world."""
    tie: Tie
    """What ties it to ground."""
    bodies: Body | Sequence[Body | None] | Ground
    """What it is: one for all worlds, or one for each, None where there is none."""

    @property
    def ground(self) -> Ground | None:
        """The matter that goes on below a face, if it is that."""
        return self.bodies if isinstance(self.bodies, Ground) else None

    def seen(self, domain: Domain) -> WorldShape:
        """The same with a plate for matter that goes on, and with the conductor of each body."""
        ground, conductor = self.ground, self.tie.conductor(self.tree)
        bodies: Any = self.bodies if ground is None else ground.body(domain)
        if conductor is not None:
            some = [bodies] if isinstance(bodies, Body) else bodies
            made = {id(b): b and replace(b, conductor=conductor) for b in some}
            bodies = made[id(bodies)] if isinstance(bodies, Body) else [made[id(b)] for b in some]
        return replace(self, bodies=bodies)


class ParallelSensors:
    """Sensors of one design on several sites of a robot, in all worlds of a simulator.

    All that a rule gives a capacitance to ground is one conductor, and so is what hangs together by
    joints and floats by one rule, see :meth:`Tie.conductor`.

    A plane is a half space: the part near each sensor is seen, as a plate. Of a terrain that is
    wider than 0.8 m each sensor has a part of its own, which is looked up at every reading from
    where the sensors are; on a GPU this waits for the device.

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
        ReadoutError: As by :meth:`Fleet.use_readout`.
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
        self.design = design if isinstance(design, Design) else load_design(design)
        kept = [k for k, part in enumerate(parts) if not rules.excludes(part.names)]
        if not kept:
            raise SceneError("there is nothing to see: all shapes are left out")
        length = _whole("history_length", options.get("history_length", 0))
        grounds = [parts[k].ground for k in kept]
        domain = self.design.domain
        seen = [parts[k].seen(domain) for k in kept]
        first = [_some_body(part) for part in seen]
        count = len(sites)
        places = self._places = _numbered(grounds, count)
        """Numbers of the places of each part that is seen; of a terrain one for each sensor."""
        self.chosen = [k for k, mine in zip(kept, places, strict=True) for _ in mine]
        """Which of the parts stands in each place."""
        own_device = "cpu" if device.is_cpu else str(device)
        fleet_options = {k: options[k] for k in ("preset", "budget") if k in options}
        self.fleet = Fleet(
            self.design,
            [body for body, mine in zip(first, places, strict=True) for _ in mine],
            worlds, sensors=count, device=options.get("device") or own_device, **fleet_options,
        )  # fmt: skip
        """The fleet: its places are the shapes, its sensors the sites."""
        self.names = tuple(parts[k].names[-1] for k in self.chosen)
        self.sites = tuple(name for name, _ in sites)
        """Names of the shapes that are seen, and of the sites, in order."""
        self.carriers = self.sites
        """What carries each sensor, by name."""
        for part, whole in enumerate(seen):
            for place in places[part]:
                if _is_terrain(grounds[part]):
                    self.fleet.change(place, None)
                elif not isinstance(whole.bodies, Body | Ground):
                    self.fleet.change(place, whole.bodies)
        for sensor, (_, own) in enumerate(sites):
            hidden = [
                place
                for part, mine in enumerate(places)
                for k, place in enumerate(mine)
                if (rules.exclude_own and seen[part].body == own >= 0)
                or (_is_terrain(grounds[part]) and k != sensor)
            ]
            self.fleet.hide(sensor, hidden)
        self._matter = first
        self.terrains = [
            TerrainParts(ground.shape, self._matter[part], places[part], worlds, domain)
            for part, ground in enumerate(grounds)
            if ground is not None and isinstance(ground.shape, Terrain)
        ]
        """The parts of terrains that sensors are over."""
        self._poses = wp.zeros((worlds, len(self.chosen)), dtype=wp.transform, device=device)
        self._frames = wp.zeros((worlds, count), dtype=wp.transform, device=device)
        drops = [
            0.0 if ground is None else ground.drop(domain)
            for ground, mine in zip(grounds, places, strict=True) for _ in mine
        ]  # fmt: skip
        self._drops = wp.array(drops, dtype=wp.float32, device=device) if any(drops) else None
        self._looked = False
        if options.get("readout") is not None:
            given = {k: options[k] for k in ("seed", "randomisation") if k in options}
            self.fleet.use_readout(options["readout"], **given)
        chip = self.fleet.readout
        self._record = Record(
            self.fleet.empty, (worlds, count), 0 if chip is None else len(chip.bank),
            self.design.cover is not None, length, device,
        )  # fmt: skip
        self._segments: tuple[NDArray[Any], NDArray[Any]] | None = None

    @classmethod
    def by_design(
        cls, *source: Any, designs: Mapping[str, Design | str | Path], **options: Any
    ) -> SensorsByDesign[Self]:
        """Sensors of several designs.

        Args:
            source: What the class takes before the sites: the model, and what goes with it.
            designs: Name pattern of sites → their design.
            options: As of the class.

        Raises:
            SceneError: Two designs have one name; or as by the class.
        """
        make: Any = cls
        return SensorsByDesign({
            name: make(*source, sites, design, **options)
            for name, (design, sites) in patterns_by_design(designs).items()
        })  # fmt: skip

    @property
    def data(self) -> ParallelData:
        """What the sensors read last, as arrays of Warp."""
        return self._record.data

    def reset(self, environments: Any = None, *, seed: int | None = None) -> None:
        """Restart the chips, clear the record, and look for shapes of other sizes.

        Call it when the simulator has set worlds back. The clocks of their chips begin at 0 s.

        Args:
            environments: Numbers of the worlds, or a mask; all by default.
            seed: As of :meth:`Fleet.reset`.

        Raises:
            SceneError: There is no such world.
            ReadoutError: As by :meth:`Fleet.reset`.
        """
        mask = self._mask(environments)
        self._record.clear(mask)
        self._looked = False
        if self.fleet.readout is not None:
            self.fleet.reset(None if mask is None else mask.numpy(), seed=seed)

    def follow_sizes(self) -> None:
        """Look at the next reading whether the simulator has changed the sizes of shapes.

        A reset does so too, and arrays on the CPU are looked at in any case.
        """
        self._looked = False

    def frames(self) -> NDArray[np.float64]:
        """Where the sensors were at the last reading: position [m], then quaternion (x, y, z, w).

        Returns:
            Shape (worlds, sensors, 7).
        """
        return np.asarray(self._frames.numpy(), float)

    def electrode_lines(
        self, environments: ArrayLike | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Outlines of the electrodes, for drawing, where the sensors were at the last reading.

        Args:
            environments: Of which worlds, numbers or a mask; all by default.

        Returns:
            Starts and ends of lines [m] in the worlds' frames, shape (k, 3), world by world; and
            red, green and blue, 0 to 1, by the change of each electrode's own capacitance,
            shape (k, 3).

        Raises:
            SceneError: There is no such world.
        """
        rows = chosen_rows(environments, self.fleet.count, SceneError)
        if self._segments is None:
            rims = [e.surface.rims for e in self.design.electrodes]
            owner = np.repeat(np.arange(len(rims)), [len(r) for r in rims])
            self._segments = np.concatenate(rims), owner
        segments, owner = self._segments
        frames = self.frames()[rows][:, :, None, None]
        axis, w = frames[..., 3:6], frames[..., 6:]
        turn = 2.0 * np.cross(axis, segments)
        ends = frames[..., :3] + segments + w * turn + np.cross(axis, turn)
        change = np.diagonal(self.data.delta.numpy()[rows], axis1=-2, axis2=-1)
        colours = signal_colours(strength(change.reshape(-1))) / 255.0
        colours = colours.reshape(*change.shape, 3)[:, :, owner]
        points = ends.reshape(-1, 2, 3)
        return points[:, 0], points[:, 1], colours.reshape(-1, 3)

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

    def _resized(self) -> Iterable[tuple[int, NDArray[np.integer], Sequence[Body]]]:
        """Places whose shapes have other sizes than before: place, worlds, and new bodies."""
        return ()

    def _like(self, place: int, shape: Shape) -> Body:
        """A body of another shape in a place, of the same matter and rule."""
        part = next(k for k, mine in enumerate(self._places) if place in mine)
        return replace(self._matter[part], shape=shape)

    def _change(self, place: int, rows: NDArray[np.integer], bodies: Sequence[Body]) -> None:
        """Put other bodies, as of :meth:`_like`, in a place of some worlds."""
        self.fleet.change(place, bodies, rows)

    def _mask(self, environments: Any) -> Any:
        """A mask of worlds on the simulator's device, of numbers or a mask; None for all."""
        if environments is None:
            return None
        device = self._poses.device
        if on_device(environments):
            mask = environments
            if not isinstance(mask, wp.array):
                import torch

                given = torch.as_tensor(environments)
                if given.dtype != torch.bool:
                    given = self._mask_of_numbers(given.cpu().numpy())
                mask = wp.from_torch(given) if isinstance(given, torch.Tensor) else given
            if mask.dtype is wp.bool and mask.shape == (self.fleet.count,):
                return mask if mask.device == device else mask.to(device)
            environments = mask.numpy()
        return self._mask_of_numbers(environments)

    def _mask_of_numbers(self, environments: Any) -> Any:
        rows = chosen_rows(environments, self.fleet.count, SceneError)
        chosen = np.isin(np.arange(self.fleet.count), rows)
        return wp.array(chosen, dtype=wp.bool, device=self._poses.device)

    def _read(self, time: Any, environments: Any = None) -> FleetReading:
        """The reading at the poses that stand in the two arrays, of some worlds or all."""
        mask, device = self._mask(environments), self._poses.device
        if self._drops is not None:
            size = self._poses.shape
            wp.launch(lower, dim=size, inputs=[self._drops, self._poses], device=device)
        if device.is_cpu or not self._looked:
            for change in self._resized():
                self._change(*change)
            self._looked = True
        poses, frames, fleet = self._poses, self._frames, self.fleet
        for terrain in self.terrains:
            for place, body, rows in terrain.moved(poses.numpy(), frames.numpy()):
                fleet.change(place, body, rows)
        clock = time
        if on_device(time) and fleet.device == "cpu":
            clock = _host(time)
        if fleet.device == "cpu":
            poses, frames = poses.numpy(), frames.numpy()
        due = mask.numpy() if mask is not None and fleet.device == "cpu" else mask
        reading = fleet.step(poses, frames, time=clock, environments=due)
        self._record.take(reading, self._times(time), mask)
        return reading

    def _times(self, time: Any) -> Any:
        """Times [s] of all worlds, shape (w,), NaN where none is given."""
        if on_device(time):
            values = time if isinstance(time, wp.array) else wp.from_torch(time)
            if values.shape == (self.fleet.count,):
                return values
            time = _host(time)
        given = np.nan if time is None else np.asarray(time, float)
        return np.broadcast_to(given, self.fleet.count)


Sensors = TypeVar("Sensors", bound=ParallelSensors)


class SensorsByDesign(Mapping[str, Sensors]):
    """Sensors of several designs on one robot, by the names of the designs."""

    def __init__(self, parts: Mapping[str, Sensors]) -> None:
        self._parts = dict(parts)

    @classmethod
    def on_carriers(
        cls, make: Callable[[list[int], Design], Sensors], carriers: Sequence[str], design: Any
    ) -> SensorsByDesign[Sensors]:
        """Sensors on the bodies of some names.

        Args:
            make: Makes those of one design, of the numbers of their carriers.
            carriers: Names of the bodies, one for each sensor.
            design: A design for all; or a dict of name patterns and designs, of which the first
                that fits a body is that of its sensor.

        Raises:
            SceneError: No pattern fits a body, a pattern fits none, or two designs have one name.
        """
        given = design if isinstance(design, Mapping) else {"*": design}
        groups = patterns_by_design(given)
        owner = {pattern: name for name, (_, mine) in groups.items() for pattern in mine}
        numbers: dict[str, list[int]] = defaultdict(list)
        for k, carrier in enumerate(carriers):
            name = next((owner[p] for p in given if matches(p, (carrier,))), None)
            if name is None:
                raise SceneError(f"no design is given for {carrier!r}; add a pattern that fits it")
            numbers[name].append(k)
        for pattern in given:
            if not any(matches(pattern, (carrier,)) for carrier in carriers):
                raise SceneError(f"design: no body fits {pattern!r}; there are {list(carriers)}")
        out = cls({name: make(mine, groups[name][0]) for name, mine in numbers.items()})
        for name, sensors in out.items():
            sensors.carriers = tuple(carriers[k] for k in numbers[name])
        return out

    def __getitem__(self, name: str) -> Sensors:
        return self._parts[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._parts)

    def __len__(self) -> int:
        return len(self._parts)

    @property
    def data(self) -> dict[str, ParallelData]:
        """What the sensors read last, by design."""
        return {name: sensors.data for name, sensors in self.items()}

    def read(self, *state: Any, **options: Any) -> dict[str, Any]:
        """The readings of all designs; arguments are those of the sensors' own ``read``."""
        return {name: each.read(*state, **options) for name, each in self.items()}  # type: ignore[attr-defined]

    def reset(self, environments: Any = None, *, seed: int | None = None) -> None:
        """See :meth:`ParallelSensors.reset`."""
        for sensors in self.values():
            sensors.reset(environments, seed=seed)


def patterns_by_design(
    designs: Mapping[str, Design | str | Path],
) -> dict[str, tuple[Design, list[str]]]:
    """Name of each design → the design, and the name patterns of the sites that have it.

    Raises:
        SceneError: No design is given, or two have one name.
        DesignError: A design is wrong.
    """
    if not designs:
        raise SceneError("designs is empty; give a dict of site patterns and designs")
    out: dict[str, tuple[Design, list[str]]] = {}
    made: dict[str | Path, Design] = {}
    for pattern, given in designs.items():
        design = given
        if not isinstance(design, Design):
            design = made[design] = made[design] if design in made else load_design(design)
        known, patterns = out.setdefault(design.name, (design, []))
        if known is not design:
            raise SceneError(
                f"two designs are named {design.name!r}; give one of them another name"
            )
        patterns.append(pattern)
    return out


def _whole(what: str, value: object) -> int:
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < 0:
        raise SceneError(f"{what} is {value!r}; give a whole number from 0")
    return int(value)


def _is_terrain(ground: Ground | None) -> bool:
    return ground is not None and ground.is_terrain


def _numbered(grounds: Sequence[Ground | None], sensors: int) -> list[list[int]]:
    """Numbers of the places of each part: one, or of a terrain one for each sensor."""
    out: list[list[int]] = []
    first = 0
    for ground in grounds:
        count = sensors if _is_terrain(ground) else 1
        out.append(list(range(first, first + count)))
        first += count
    return out


def _host(values: Any) -> Any:
    """An array on a device as one of NumPy."""
    return values.numpy() if isinstance(values, wp.array) else values.numpy(force=True)


def _some_body(part: WorldShape) -> Body:
    """A body that stands in a part's place in some world."""
    bodies: Any = part.bodies
    if isinstance(bodies, Body):
        return bodies
    return next(body for body in bodies if body is not None)


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


@no_type_check
@wp.kernel(enable_backward=False)
def lower(drops: wp.array(dtype=wp.float32), poses: wp.array2d(dtype=wp.transform)) -> None:
    """Move poses down along their own z axes by some lengths [m]."""
    w, k = wp.tid()
    at = wp.transform(wp.vec3(0.0, 0.0, -drops[k]), wp.quat_identity())
    poses[w, k] = wp.transform_multiply(poses[w, k], at)
