"""Sensors of one design in many environments."""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense._thread_pool import ForkSafeRLock
from capsense._validate import as_whole, checked_frequency, chosen_rows, shorten
from capsense.design import load_design
from capsense.design.model import Design
from capsense.errors import MissingDependencyError, ReadoutError, SceneError
from capsense.field.background import Terminals
from capsense.field.cache import default_settings, load_or_build
from capsense.field.green_points import narrowest_width
from capsense.fleet.bodies import (
    WORLD,
    BodyTable,
    checked_forces,
    checked_poses,
    host_array,
    on_device,
    require_no_gradient,
)
from capsense.fleet.check import FleetCheck, by_simulator, summary
from capsense.fleet.chips import ChipsOfSensors
from capsense.fleet.cpu import CpuCore
from capsense.reading import FleetReading, FleetTouch, Reading, StepStats
from capsense.readout import Readout
from capsense.readout.config import make_readout
from capsense.readout.randomisation import ReadoutRandomisation
from capsense.readout.side_by_side import SideBySide
from capsense.scene import Body
from capsense.simulator import DEFAULT_PRESET, PresetName, Simulator, checked_preset
from capsense.solver.surface_solver import PRESETS, SurfaceSolver
from capsense.solver.tree.fine_panels import WIDE

if TYPE_CHECKING:
    from capsense.fleet.warp_core import WarpCore

Array = NDArray[np.float64]

_PANELS = 5
"""Panels of a shape for each cluster that a body is cut into on Warp …"""
_WIDTHS = 0.5
"""… and more of them where they would be wider than so much of the narrowest electrode."""


class Fleet:
    """Sensors of one design in many environments, with the same places for bodies in each.

    What stands in a place may differ from environment to environment, and change at a reset: see
    :meth:`change`. Bodies out of a sensor's sight cost nothing on the CPU.

    On the CPU, readings are those of :meth:`Simulator.step` of the same preset; but bodies that
    touch each other are not joined to one conductor. On Warp every body is cut into as many
    clusters as ``budget`` says, in single precision: the fewer, the faster and the less exact, see
    :meth:`check`.

    Args:
        design: A design, its name, or the path of its file.
        bodies: What stands in every environment, one body for each place; their poses are not used.
            Rigid shapes.
        count: How many environments, e.
        sensors: How many sensors of the design each has, s.
        device: ``"cpu"`` for the compiled core on all processors, or a device of Warp:
            ``"cuda:0"``, or ``"warp:cpu"``, which is for tests.
        preset: Accuracy on the CPU, as of :class:`Simulator`.
        budget: Clusters of each body on Warp: 32, 64 or 128.
        excitation_frequency: Excitation frequency [Hz].

    Raises:
        DesignError: The design is wrong.
        SceneError: ``bodies`` is empty, holds something else, or bodies that a fleet cannot have.
        ValueError: There is no such preset, budget or device, the frequency or a count is not
            positive, or the design's ground is not earthed and the device is one of Warp.
        MissingDependencyError: Warp is requested and not installed.
    """

    def __init__(
        self,
        design: Design | str | Path,
        bodies: Sequence[Body],
        count: int,
        *,
        sensors: int = 1,
        device: str = "cpu",
        preset: PresetName = DEFAULT_PRESET,
        budget: int = 64,
        excitation_frequency: float = 250e3,
    ) -> None:
        for what, number in (("count", count), ("sensors", sensors)):
            if (as_whole(number) or 0) < 1:
                raise ValueError(f"{what} is {number!r}; give a whole number from 1")
        count, sensors = int(count), int(sensors)
        self.excitation_frequency = checked_frequency(excitation_frequency)
        given, bodies = bodies, list(bodies) if isinstance(bodies, Iterable) else []
        if not bodies or not all(isinstance(body, Body) for body in bodies):
            raise SceneError(f"bodies is {shorten(given)}; give a list of at least one Body")
        preset = checked_preset(preset)
        if budget not in (32, 64, 128):
            raise ValueError(f"budget is {shorten(budget)}; choose one of 32, 64, 128")
        self.design = design if isinstance(design, Design) else load_design(design)
        self.count, self.sensors, self.places = count, sensors, len(bodies)
        """How many environments, sensors in each, and places for bodies."""
        self.device = device
        if device != "cpu" and self.design.ground_capacitance is not None:
            raise ValueError(
                f"the ground of design {self.design.name!r} is not earthed, which device "
                f'{device!r} does not know; take device="cpu", or design.with_grounding("grounded")'
            )
        field = load_or_build(self.design, default_settings(self.design))
        chosen_preset = PRESETS[preset]
        finer: dict[PresetName, PresetName] = {"fast": "standard", "standard": "fine"}
        self.finer = finer.get(preset) if device == "cpu" else "fine"
        if device != "cpu":
            chosen_preset = replace(
                chosen_preset, panels=_PANELS * budget, coarsest=None, finest=None
            )
        self._solver = SurfaceSolver(
            field.green, self.design, excitation_frequency=self.excitation_frequency,
            preset=chosen_preset,
        )  # fmt: skip
        self._terminals = Terminals(self.design, field.capacitance)
        n = self._terminals.electrodes
        self.baseline: Array = self._terminals.empty[:n, :n].copy()
        """Maxwell matrix of the electrodes in the empty domain [F], shape (n, n)."""
        width = math.inf if device == "cpu" else _WIDTHS * narrowest_width(self.design)
        self.table = BodyTable(self._solver, count, len(bodies), sensors, width)
        self.readouts: tuple[Readout, ...] = ()
        """The readout of which every sensor has a chip, or one for each sensor, if any."""
        self._chips: Any = None
        self._last: FleetReading | None = None
        self._one, self._warned = ForkSafeRLock(), False
        self._cpu = CpuCore(self._solver, self._terminals, self.table, self.electrode_names)
        self._warp = None if device == "cpu" else self._on_warp(budget)
        self.table.conduct(bodies)
        for place, body in enumerate(bodies):
            self.change(place, body)

    def __getstate__(self) -> dict[str, Any]:
        if self._warp is not None:
            raise TypeError(
                f"a fleet on {self.device!r} cannot be pickled or copied: its arrays are those of "
                "one process and device; make another with cs.Fleet(…) where it is needed"
            )
        return vars(self)

    def _on_warp(self, budget: int) -> WarpCore:
        try:
            from capsense.fleet.warp_core import WarpCore, known_device
        except ImportError as error:
            raise MissingDependencyError(
                f"device {self.device!r} needs Warp; install it with: pip install 'capsense[warp]'"
            ) from error
        return WarpCore(
            self._solver, self._terminals, (self.count, self.places, self.sensors), budget,
            known_device(self.device),
        )  # fmt: skip

    @property
    def electrode_names(self) -> tuple[str, ...]:
        """Electrode names in matrix order."""
        return self.design.electrode_names

    def change(
        self,
        place: int,
        bodies: Body | Sequence[Body | None] | None,
        environments: ArrayLike | None = None,
    ) -> None:
        """Change what stands in a place: shape, size, material, grounding, or nothing at all.

        Sizes of one proportion share what is worked out of a shape; a capsule or box of new
        proportions takes some ten milliseconds.

        Args:
            place: Number of the place.
            bodies: A body or None for all, or one for each of the environments.
            environments: Which environments, shape (k,); all by default.

        Raises:
            SceneError: There is no such place or environment, the numbers do not match, or a body
                is of a shape that is not rigid, or no conductor in a place that is joined.
        """
        with self._one:
            self.table.change(place, bodies, environments)
            self._take_over()
        if self._warp is not None and not self._warned:
            self._warn_of_wide(place)

    def _warn_of_wide(self, place: int) -> None:
        for body in {id(b): b for b in self.table.given[:, place] if b is not None}.values():
            middle = float(np.sort(np.ptp(body.shape.bounds(), axis=0))[1])
            if middle > WIDE:
                self._warned = True
                warnings.warn(
                    f"place {place}: {middle:.2g} m is wide for a body on Warp, which is cut into "
                    "few clusters: readings are some per cent off, within 15 mm and of thin "
                    "dielectrics tens of per cent. Compare with fleet.check(poses), or take "
                    'device="cpu". Further warnings are suppressed',
                    stacklevel=3,
                )
                return

    def hide(self, sensor: int, places: Sequence[int]) -> None:
        """Leave places out of what a sensor sees, such as the link that carries it.

        Args:
            sensor: Number of the sensor.
            places: Numbers of the places; the sensor sees all others.

        Raises:
            SceneError: There is no such sensor or place.
        """
        self.table.hide(sensor, places)
        self._take_over()

    def join(self, places: Sequence[int]) -> None:
        """Make the conductors in some places one, in all environments, as if a wire joined them.

        A fleet does not look for contact. Conductors that are joined share their net charge, and
        are tied to ground by the sum of their capacitances; with one that is grounded all are.
        Members out of a sensor's sight, hidden ones too, count for what ties the others to ground.

        Args:
            places: Numbers of the places; what they are joined with already joins in.

        Raises:
            SceneError: There is no such place, or something else than a conductor stands there.
        """
        self.table.join(places)
        self._take_over()

    def _take_over(self) -> None:
        if self._warp is not None:
            shapes = cast("list[Any]", self.table.shapes)
            self._warp.take(self.table.bodies, shapes, self.table.forces)

    @property
    def empty(self) -> Reading:
        """The reading of a sensor in an empty environment, which no chip has seen."""
        total, n = self._terminals.empty, self._terminals.electrodes
        coupling = total[:n, n:].sum(axis=1)
        nothing = np.zeros_like(self.baseline)
        stats = StepStats(0.0, 0.0)
        return Reading(self.baseline.copy(), nothing, stats, self.electrode_names, coupling)

    def use_readout(
        self,
        readout: Readout | str | Path | Sequence[Readout | str | Path] | None,
        *,
        start: ArrayLike | None = None,
        seed: int | None = None,
        randomisation: ReadoutRandomisation | None = None,
    ) -> None:
        """Read every sensor through a chip of its own from now on.

        Each environment's chips have a clock of their own, see :meth:`reset`. Noise differs from
        chip to chip.

        Args:
            readout: A readout for this design's electrodes, which stays as it is, the name of a
                chip with its usual settings, the path of a readout file (``.toml``), or None; or a
                list of such, one for each sensor of an environment, with as many channels.
            start: Time at which they are switched on [s], a number or one for each environment; by
                default 0.
            seed: Of all random numbers, by default the readout's own.
            randomisation: How the chips differ from the readout and from each other, drawn anew
                at each reset; by default not at all.

        Raises:
            ReadoutError: There is no such chip or file, the file is wrong, or the seed is no whole
                number from 0 on; a readout is of other electrodes, or there are as many neither as
                sensors nor as each other's channels; a randomisation does not fit
                the fleet; or the readout has open electrodes or parts of the user's own, and the
                fleet is on Warp.
        """
        self.readouts, self._chips = (), None
        if readout is None:
            return
        listed = isinstance(readout, Sequence) and not isinstance(readout, str)
        chips = self._readouts(list(cast("Any", readout)) if listed else [cast("Any", readout)])
        how: dict[str, Any] = {
            "seed": seed, "start": 0.0 if start is None else start, "randomisation": randomisation
        }  # fmt: skip
        if seed is not None:
            chips[0].reset(seed=seed)
        if len(chips) == 1:
            how["seed"] = chips[0].seed
        with self._one:
            if self._warp is not None:
                self._chips = self._warp.chips(chips, self.baseline, how)
            elif len(chips) == 1:
                self._chips = SideBySide(chips[0], self.count, self.sensors, **how)
            else:
                self._chips = ChipsOfSensors(chips, self._of_one_sensor, **how)
            self.readouts = tuple(chips)

    def _of_one_sensor(self, number: int, readout: Readout, **how: Any) -> SideBySide:
        return SideBySide(readout, self.count, **how)

    def _readouts(self, given: Sequence[Readout | str | Path]) -> list[Readout]:
        """Copies of readouts, of one for all sensors or of one for each."""
        chips = [copy.deepcopy(make_readout(each, self)) for each in given]
        if len(chips) not in (1, self.sensors):
            raise ReadoutError(
                f"there are {len(chips)} readouts and {self.sensors} sensors; give one for all, or "
                "one for each"
            )
        for chip in chips:
            if chip.bank.electrodes != self.electrode_names:
                raise ReadoutError(
                    f"the readout is of electrodes {chip.bank.electrodes}, the fleet of "
                    f"{self.electrode_names}"
                )
            if len(chip.bank) != len(chips[0].bank):
                raise ReadoutError(
                    f"readouts have {len(chips[0].bank)} and {len(chip.bank)} channels; make them "
                    "the same"
                )
        return chips

    @property
    def readout(self) -> Readout | None:
        """The readout of which every sensor, or the first, has a chip; None without chips."""
        return self.readouts[0] if self.readouts else None

    @property
    def drawn(self) -> ReadoutRandomisation | None:
        """What the chips' figures are now, as arrays on the host, (e, s, K); None without chips."""
        return None if self._chips is None else self._chips.drawn

    def reset(
        self,
        environments: ArrayLike | None = None,
        *,
        start: ArrayLike | None = None,
        seed: int | None = None,
    ) -> None:
        """Restart the chips of some environments; a fleet keeps nothing else from step to step.

        Their noise and what is randomised is drawn anew, so that no two episodes have the same;
        with a seed, they repeat. Draws depend on the seed, the environment's number, and how
        often it was reset since it got the seed. Other environments' chips go on as if nothing
        had happened.

        Args:
            environments: Their numbers, or a mask, shape (e,); all by default.
            start: Time at which they are switched on [s], a number or one for each of these
                environments; by default 0.
            seed: Of their random numbers from now on.

        Raises:
            ReadoutError: There is no such environment, the seed is no whole number from 0 on, or a
                time is not finite.
        """
        found = chosen_rows(host_array(environments), self.count, ReadoutError)
        rows, first = np.unique(found, return_index=True)
        if start is not None:
            start = np.asarray(host_array(start))
            start = start[first] if start.shape == found.shape else start
        if self._chips is not None:
            with self._one:
                self._chips.reset(rows, start=start, seed=seed)

    def step(
        self,
        poses: ArrayLike,
        sensors: ArrayLike | None = None,
        *,
        forces: ArrayLike | None = None,
        time: Any = None,
        jacobian: bool = False,
        environments: Any = None,
    ) -> FleetReading:
        """Return the readings of all environments.

        On Warp, arrays of Warp, PyTorch or JAX that are on the device are taken as they are and
        not looked at; nothing waits for the device, so that a step can go into a CUDA graph. On the
        CPU, arrays of others are copied.

        Args:
            poses: Of the bodies in the world's frame: positions [m], then quaternions (x, y, z, w),
                shape (e, b, 7).
            sensors: The same of the sensors' frames, shape (e, s, 7). Without it, every sensor's
                frame is the world's.
            forces: Normal forces that press bodies onto the design's cover [N], NaN for none,
                where their overlap counts, shape (e, b); by default those of the bodies themselves.
                The cover is elastic, without relaxation and hysteresis.
            time: Time of the scenes [s], a number or one for each environment, not before that of
                its last step; a readout needs it. On Warp it may be an array on the device, of
                shape (1,) or (e,) and single or double precision, which is not looked at.
            jacobian: Whether to work out ``reading.jacobian`` as well.
            environments: Which environments are solved, numbers or a mask of shape (e,); all by
                default. The reading holds for each of the others what it held last, and before its
                first what an empty environment gives; their chips and clocks stand still. On Warp
                it may be a mask on the device.

        Raises:
            SceneError: There is no such environment; poses are of a wrong shape, not finite, or
                their quaternions not 1 long; there are forces and no cover, or a Jacobian is asked
                for with forces or of some environments.
            SolveError: Some environments have no solution; the message names the first.
            ReadoutError: A readout is given no time, or time went back.
        """
        if self._chips is not None and time is None:
            raise ReadoutError("a readout needs the time; write step(poses, time=…), in seconds")
        with self._one:
            due = self._due(environments)
            if self._chips is not None:
                time = self._chips.clock(time, due)
            reading = self.solved(
                poses, sensors, forces=forces, jacobian=jacobian, environments=due
            )
            if self._chips is None:
                return reading
            matrix = reading.capacitance if self._warp is None else reading.delta
            held = self._chips.sample(time, matrix, reading.shield_coupling, due)
            return replace(reading, held=held)

    def _due(self, environments: Any) -> Any:
        """Which environments are solved: a mask, None for all; one on the device as it is."""
        if environments is None:
            return None
        if on_device(environments):
            if self._warp is not None:
                return self._warp.mask(environments)
            environments = host_array(environments)
        return np.isin(np.arange(self.count), chosen_rows(environments, self.count, SceneError))

    def _forces(self, forces: ArrayLike | None, jacobian: bool) -> Any:
        """Forces on the bodies [N], shape (e, b); those on a device of Warp are not looked at.

        Raises:
            SceneError: They are wrong, or cannot be taken into account.
        """
        shape, out = (self.count, self.places), forces
        if self._warp is None or forces is None or not on_device(forces):
            out = self.table.forces if forces is None else checked_forces(forces, shape)
            if np.isnan(out).all():
                return out
        else:
            require_no_gradient("forces", forces)
        if self.design.cover is None:
            if forces is None:  # as a simulator does
                return np.full(shape, np.nan)
            raise SceneError(
                f"forces press bodies onto a cover, which design {self.design.name!r} does not "
                "have; add a [[cover]] to it, or leave them out"
            )
        if jacobian:
            raise SceneError(
                "a Jacobian is asked for of bodies that forces hold, which fleets do not have; "
                "leave the forces out, or take a Simulator"
            )
        return out

    def solved(
        self, poses: ArrayLike, sensors: ArrayLike | None = None, *,
        forces: ArrayLike | None = None, jacobian: bool = False, environments: Any = None,
    ) -> FleetReading:  # fmt: skip
        """As :meth:`step`, without chips and their time."""
        if jacobian and environments is not None:
            raise SceneError(
                "a Jacobian is asked for of some environments; leave environments out, or jacobian"
            )
        if jacobian and self.table.lossy:
            raise SceneError(
                "a Jacobian is asked for with bodies of lossy matter, which have none yet; give "
                "them a conductor's or a lossless material"
            )
        shapes = (self.count, self.places, 7), (self.count, self.sensors, 7)
        held = self._forces(forces, jacobian)
        if self._warp is None:
            if sensors is None:
                sensors = np.broadcast_to(WORLD, shapes[1])
            rows = None if environments is None else np.flatnonzero(environments)
            pick = slice(None) if rows is None else rows
            found = self._cpu.step(
                checked_poses("poses", poses, shapes[0])[pick],
                checked_poses("sensors", sensors, shapes[1])[pick],
                held[pick],
                jacobian,
                rows,
            )
            self._last = found if rows is None else _with_rows(self._last_or_empty(), rows, found)
            return self._last
        for name, each in (("poses", poses), ("sensors", sensors)):
            require_no_gradient(name, each)
        where, at = (
            each if each is None or on_device(each) else checked_poses(name, each, shape)
            for name, each, shape in zip(
                ("poses", "sensors"), (poses, sensors), shapes, strict=True
            )
        )
        core = self._warp
        core.solve(where, at, None if forces is None else held, environments)
        return FleetReading(
            core.capacitance, core.delta, self.electrode_names, core.error,
            shield_coupling=core.shields,
            conductance=core.conductance, jacobian=core.differentiate() if jacobian else None,
            touch=core.touch,
        )  # fmt: skip

    def _last_or_empty(self) -> FleetReading:
        """The last reading on the CPU; before the first, that of empty environments."""
        if self._last is not None:
            return self._last
        empty, shape = self.empty, (self.count, self.sensors)

        def everywhere(values: Array) -> Array:
            return np.broadcast_to(values, (*shape, *values.shape)).copy()

        each = np.zeros((*shape, len(self.baseline)))
        touch = None if self.design.cover is None else FleetTouch(each, each, np.zeros(shape))
        return FleetReading(
            everywhere(empty.capacitance), everywhere(empty.delta), self.electrode_names,
            np.zeros(shape), everywhere(empty.shield_coupling), touch=touch,
        )  # fmt: skip

    def check(
        self,
        poses: ArrayLike,
        sensors: ArrayLike | None = None,
        *,
        samples: int = 16,
        seed: int = 0,
    ) -> FleetCheck:
        """Compare some environments with a ``Simulator`` of a finer preset.

        That is ``"fine"``; of a fleet on the CPU with the preset ``"fast"``, ``"standard"``. A
        simulator joins the conductors that touch each other, and no others. If places are joined,
        the comparison is with a finer fleet on the CPU, where the same places are. On Warp, the
        arrays of the last reading are written anew.

        Args:
            poses: As :meth:`step` takes them, on the host.
            sensors: The same of the sensors.
            samples: How many environments, drawn at random; all, where there are no more.
            seed: Of the draw.

        Raises:
            SceneError: As by :meth:`step`.
            ValueError: The fleet has the preset ``"fine"``, and there is no finer one; or
                ``samples`` is not a whole number from 1.
            SolveError: As by :meth:`step`.
        """
        if self.finer is None:
            raise ValueError(
                'the fleet has preset "fine", and there is no finer one to check it against; '
                'make one with preset="standard"'
            )
        whole = as_whole(samples)
        if whole is None or whole < 1:
            raise ValueError(f"samples is {shorten(samples)}; give a whole number from 1")
        e, s = self.count, self.sensors
        where = checked_poses("poses", poses, (e, self.places, 7))
        at = np.broadcast_to(WORLD, (e, s, 7))
        if sensors is not None:
            at = checked_poses("sensors", sensors, (e, s, 7))
        delta = self.solved(where, at).delta
        found = delta if isinstance(delta, np.ndarray) else delta.numpy()
        rows = np.random.default_rng(seed).permutation(e)[:whole]
        group = self.table.bodies.group
        if len(np.unique(group)) < len(group):
            reading = self._finer_fleet(self.finer, rows).solved(where[rows], at[rows])
            truth = reading.delta
            contact = reading.error >= np.abs(reading.capacitance).max(axis=(2, 3))
        else:
            simulator = Simulator(
                self.design, excitation_frequency=self.excitation_frequency, preset=self.finer
            )
            truth, contact = by_simulator(simulator, self.table, rows, where[rows], at[rows])
        return summary(found[rows], truth, contact, rows, self.lifted(where, at, rows))

    def _finer_fleet(self, preset: PresetName, rows: NDArray[np.int64]) -> Fleet:
        """Some environments as a fleet on the CPU, whose places are joined alike."""
        given, known = self.table.given[rows], self.table.bodies
        some: Body = next(body for body in self.table.given.ravel() if body is not None)
        first = [
            next((body for body in column if body is not None), replace(some, conductor=None))
            for column in self.table.given.T
        ]
        finer = Fleet(
            self.design, first, len(rows), sensors=self.sensors, preset=preset,
            excitation_frequency=self.excitation_frequency,
        )  # fmt: skip
        for place in range(self.places):
            finer.change(place, given[:, place].tolist())
        for sensor, hidden in enumerate(known.hidden):
            finer.hide(sensor, np.flatnonzero(hidden).tolist())
        for number in np.unique(known.group):
            places = np.flatnonzero(known.group == number).tolist()
            if len(places) > 1:
                finer.join(places)
        return finer

    def lifted(self, poses: Array, sensors: Array, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which sensors of some environments lack the first millimetres, see :class:`FleetCheck`.

        Args:
            poses: As :meth:`step` takes them, on the host.
            sensors: As ``poses``.
            rows: Numbers of the environments, shape (k,).

        Returns:
            Shape (k, s).
        """
        nodes = None if self._warp is None else self._warp.gap.slots
        return self._cpu.lifted(poses, sensors, rows, nodes)


def _with_rows(reading: FleetReading, rows: NDArray[np.int64], found: FleetReading) -> FleetReading:
    """A reading whose rows are those of another of so many environments, but for its Jacobian."""

    def merged(old: Any, new: Any) -> Any:
        if old is None and new is None:
            return None
        if old is None:
            old = np.zeros((len(reading.delta), *new.shape[1:]))
        out = np.array(old)
        out[rows] = 0.0 if new is None else new
        return out

    names = ("capacitance", "delta", "error", "shield_coupling", "conductance")
    values = {name: merged(getattr(reading, name), getattr(found, name)) for name in names}
    if reading.touch is not None and found.touch is not None:
        parts = (merged(*both) for both in zip(_of(reading.touch), _of(found.touch), strict=True))
        values["touch"] = FleetTouch(*parts)
    return replace(reading, jacobian=None, held=None, **values)


def _of(touch: FleetTouch) -> tuple[Any, Any, Any]:
    return touch.force, touch.compression, touch.total
