"""Many sensors at once: :class:`Skin` reads them all in one call, on several threads."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable, Hashable, Mapping, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from capsense._thread_pool import ForkSafeRLock, ThreadPool, some_failed
from capsense._validate import shorten, suggest
from capsense.design.model import Design
from capsense.errors import CapSenseError, SceneError, SkinError
from capsense.reading import Reading
from capsense.readout import SEED_STRIDE, Readout
from capsense.scene import DepthFrame, Pose, Scene
from capsense.simulator import ONCE, Doubt, Simulator, check_view, read_together

Array = NDArray[np.float64]
AnyDesign = Design | str | Path | Simulator


class Skin:
    """Sensors in a common world, each with its own frame. Threads may share one: they take turns.

    Args:
        sensors: Name → design (or packaged name, design file, simulator) and the pose of its
            sensor frame in the world. Sensors of one design share its field. A simulator is used
            itself, with its readout; where it is given again, a copy with a chip of its own.
        threads: How many threads read; by default as many as the process may use processors.

    Raises:
        TypeError: ``sensors`` is no dict, or something in it is not a pair of a design and a pose.
        ValueError: ``threads`` is not a positive whole number.
        SceneError: There is no sensor.
        DesignError: A design is wrong.
        FieldError: A background field could not be built.
    """

    def __init__(
        self, sensors: Mapping[str, tuple[AnyDesign, Pose]], *, threads: int | None = None
    ) -> None:
        designs: dict[str, AnyDesign] = {}
        self.poses: dict[str, Pose] = {}
        """Where the sensor frames stand in the world."""
        if not isinstance(sensors, Mapping):
            raise TypeError(
                f'sensors is {shorten(sensors)}; give a dict such as {{"wrist": (design, Pose(…))}}'
            )
        for name, pair in sensors.items():
            if not (isinstance(pair, tuple) and len(pair) == 2 and isinstance(pair[1], Pose)):
                raise TypeError(f"sensor {name!r} is {pair!r}; give a pair (design, Pose(…))")
            designs[name], self.poses[name] = pair
        self._pool, self._one = ThreadPool(threads), ForkSafeRLock()
        self.simulators: dict[str, Simulator] = make_simulators(designs)
        """The sensors themselves."""

    def step(
        self,
        scene: Scene,
        poses: Mapping[str, Pose] | None = None,
        *,
        time: float | None = None,
    ) -> dict[str, Reading]:
        """Read all sensors in a scene.

        Every sensor sees the bodies that reach into its own domain.

        Args:
            scene: Bodies with their poses in the world.
            poses: Where sensors stand now, of those that have moved; it is remembered.
            time: Time of the scene [s], as of :meth:`Simulator.step`; readouts need it.

        Returns:
            Name → reading, in the order of the sensors; the same as from the sensors one by one,
            to the last bit.

        Raises:
            TypeError: ``scene`` is not a scene.
            SceneError: There is no sensor of a name in ``poses``.
            SkinError: Some sensors failed; it holds the readings of the others.
        """
        with self._one:  # poses are remembered
            return self.step_views(self.views(scene, poses), time=time)

    def views(self, scene: Scene, poses: Mapping[str, Pose] | None = None) -> dict[str, Scene]:
        """What each sensor sees of a scene, in its own frame; arguments as of :meth:`step`."""
        if not isinstance(scene, Scene):
            raise TypeError(f"step takes a Scene, not {type(scene).__name__}; write Scene([...])")
        self._check_names("poses", poses or {})
        self.poses.update(poses or {})
        bounds = scene.pack().bounds
        centre, half = bounds.mean(axis=1), 0.5 * (bounds[:, 1] - bounds[:, 0])
        return {
            name: self._view(scene, centre, half, simulator, self.poses[name])
            for name, simulator in self.simulators.items()
        }

    def step_views(
        self, views: Mapping[str, Scene | DepthFrame], *, time: float | None = None
    ) -> dict[str, Reading]:
        """Read sensors that each see something of their own.

        Args:
            views: Name → what the sensor sees, in its own frame; sensors may be left out.
            time: Time of the views [s]; readouts need it.

        Raises:
            TypeError: A view is neither a scene nor a depth frame.
            SceneError: There is no sensor of a name in ``views``.
            SkinError: Some sensors failed; it holds the readings of the others.
        """
        self._check_names("views", views)
        for name, view in views.items():
            check_view(f"views[{name!r}]: step takes", view)
        return read_all(
            self._pool, {name: self.simulators[name] for name in views}, views.__getitem__,
            lambda _: time, lambda name, reading: self.simulators[name].sampled(reading, time),
        )  # fmt: skip

    def use_readout(
        self,
        readout: Readout | str | Path | None,
        *,
        start: float | None = None,
        seed: int | None = None,
    ) -> None:
        """Read every sensor through a chip of its own from now on.

        Args:
            readout: A readout, which stays as it is, the name of a chip with its usual settings,
                the path of a readout file (``.toml``), or None.
            start: Time at which they are switched on [s], by default 0.
            seed: Of the first sensor's noise, by default its own; those of the others follow at
                steps of 2³², so that noise is not shared.

        Raises:
            ReadoutError: There is no such chip or file, the file is wrong, or the seed is no whole
                number from 0 on.
        """
        with self._one:
            use_readouts(self.simulators, readout, start, seed)

    def reset(self, *, start: float | None = None, seed: int | None = None) -> None:
        """Forget the previous step; restart the chips.

        Args:
            start: Time at which they are switched on [s], by default 0.
            seed: Of the first sensor's noise from now on, as of :meth:`use_readout`; by default all
                random numbers repeat.

        Raises:
            ReadoutError: The seed is no whole number from 0 on.
        """
        with self._one:
            reset_all(self.simulators, start, seed)

    def __len__(self) -> int:
        return len(self.simulators)

    def _check_names(self, what: str, names: Mapping[str, object]) -> None:
        for name in names:
            if name not in self.simulators:
                raise SceneError(
                    f"{what}: no sensor is named {name!r}; {suggest(name, self.simulators)}"
                )

    @staticmethod
    def _view(scene: Scene, centre: Array, half: Array, simulator: Simulator, pose: Pose) -> Scene:
        """The bodies whose boxes reach into a sensor's domain, in its frame."""
        domain, rotation = simulator.design.domain, pose.rotation
        middle = (centre - pose.position) @ rotation
        reach = half @ np.abs(rotation)
        lower, upper = domain.sight
        seen = ((middle - reach < upper) & (middle + reach > lower)).all(axis=1)
        inverse = pose.inverse()
        bodies = [scene.bodies[i] for i in np.flatnonzero(seen).tolist()]
        return Scene([body.moved(inverse @ body.pose) for body in bodies])


def make_simulators(
    designs: Mapping[str, AnyDesign], progress: Callable[[str, float], None] | None = None
) -> dict[str, Simulator]:
    """Simulators by name; where the same design comes again, one that shares its field.

    A simulator that is given is used once, and copies of it after that.

    Raises:
        SceneError: There is none.
        DesignError: A design is wrong.
        FieldError: A background field could not be built.
    """
    if not designs:
        raise SceneError("there is no sensor; give at least one")
    first: dict[object, Simulator] = {}
    simulators = {}
    for name, design in designs.items():
        key = design if isinstance(design, str | Path) else id(design)
        if key in first:
            simulators[name] = made = first[key].copy()
            chip = first[key].readout
            if chip is not None:
                seed = chip.seed + (len(simulators) - 1) * SEED_STRIDE
                made.use_readout(copy.deepcopy(chip), seed=seed)
            continue
        made = design if isinstance(design, Simulator) else Simulator(design, progress=progress)
        simulators[name] = first[key] = made
    return simulators


class _WithChip(Protocol):
    """A sensor of a skin, which may have a chip."""

    readout: Readout | None

    def use_readout(
        self, readout: Readout | str | Path | None, *, start: float | None, seed: int | None
    ) -> None: ...

    def reset(self, *, start: float | None, seed: int | None) -> None: ...


def use_readouts(
    sensors: Mapping[str, _WithChip],
    readout: Readout | str | Path | None,
    start: float | None,
    seed: int | None,
) -> None:
    """Give every sensor a chip of its own, see :meth:`Skin.use_readout`."""
    for number, sensor in enumerate(sensors.values()):
        sensor.use_readout(copy.deepcopy(readout), start=start, seed=None)
        if sensor.readout is not None:
            first = sensor.readout.seed if seed is None else seed
            sensor.use_readout(sensor.readout, start=start, seed=first + number * SEED_STRIDE)


def reset_all(sensors: Mapping[str, _WithChip], start: float | None, seed: int | None) -> None:
    """Reset every sensor, see :meth:`Skin.reset`."""
    for number, sensor in enumerate(sensors.values()):
        own = None if seed is None else seed + number * SEED_STRIDE
        sensor.reset(start=start, seed=own)


def read_all(
    pool: ThreadPool,
    simulators: Mapping[str, Simulator],
    view: Callable[[str], Scene | DepthFrame],
    time: Callable[[str], float | None],
    sampled: Callable[[str, Reading], Reading],
) -> dict[str, Reading]:
    """Read sensors together. Those of one kind are solved in one call for some of them at a time.

    One warning tells of all sensors of which the estimated error is large for the first time.

    Args:
        pool: The threads.
        simulators: Name → simulator, each once.
        view: What a sensor sees, in its frame.
        time: When it does [s].
        sampled: Adds what its chip makes of a reading.

    Raises:
        SkinError: Some of them failed; it holds the readings of the others.
    """
    kinds: dict[Hashable, list[str]] = {}
    for name, simulator in simulators.items():
        kinds.setdefault(simulator.kind, []).append(name)

    def read(names: Sequence[str]) -> list[Reading | CapSenseError]:
        out: dict[str, Reading | CapSenseError] = {}
        seen: dict[str, Scene | DepthFrame] = {}
        for name in names:
            try:
                seen[name] = view(name)
                if len(names) == 1:
                    out[name] = simulators[name].solved(seen[name], time=time(name))
            except CapSenseError as error:
                out[name] = error
        if len(names) > 1 and seen:
            out |= zip(seen, read_together([simulators[n] for n in seen], list(seen.values())),
                       strict=True)  # fmt: skip
            for name in seen:
                simulators[name].steps += 1
        for name, reading in out.items():
            if isinstance(reading, Reading):
                try:
                    out[name] = sampled(name, reading)
                except CapSenseError as error:
                    out[name] = error
        return [out[name] for name in names]

    most = max(simulator.together for simulator in simulators.values()) if simulators else 1
    sure = {name: s for name, s in simulators.items() if s.doubt is None}
    for simulator in sure.values():
        simulator.in_skin = True
    try:
        found, failed = pool.run_together(kinds.values(), most, read)
    finally:
        for simulator in sure.values():
            simulator.in_skin = False
    _warn_of_doubts({n: s.doubt for n, s in sure.items() if s.doubt is not None}, len(simulators))
    readings = {name: found[name] for name in simulators if name in found}
    if failed:
        failures = {name: failed[name] for name in simulators if name in failed}
        raise SkinError(some_failed("sensors", failures, len(simulators)), readings, failures)
    return readings


def _warn_of_doubts(doubts: Mapping[str, Doubt], count: int) -> None:
    """Warn once of the sensors, of so many, that have just got large estimated errors."""
    if not doubts:
        return
    worst = max(doubts, key=lambda name: doubts[name].share)
    warnings.warn(
        f"{len(doubts)} of {count} sensors have large estimated errors; the worst is {worst!r}: "
        f"{doubts[worst].text}. {ONCE}",
        stacklevel=4,
    )
