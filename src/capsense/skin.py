"""Many sensors at once: :class:`Skin` reads them all in one call, on several threads."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from capsense._thread_pool import ForkSafeRLock, ThreadPool, some_failed
from capsense._validate import shorten, suggest
from capsense.design.model import Design
from capsense.errors import SceneError, SkinError
from capsense.reading import Reading
from capsense.scene import DepthFrame, Pose, Scene
from capsense.simulator import Simulator

Array = NDArray[np.float64]
AnyDesign = Design | str | Path | Simulator


class Skin:
    """Sensors in a common world, each with its own frame. Threads may share one: they take turns.

    Args:
        sensors: Name → design (or packaged name, design file, simulator) and the pose of its
            sensor frame in the world. Sensors of one design share its field.
        threads: How many threads read; by default as many as the process may use processors.

    Raises:
        SceneError: There is no sensor, or something is not a pair of a design and a pose.
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
            raise SceneError(
                f'sensors is {shorten(sensors)}; give a dict such as {{"wrist": (design, Pose(…))}}'
            )
        for name, pair in sensors.items():
            if not (isinstance(pair, tuple) and len(pair) == 2 and isinstance(pair[1], Pose)):
                raise SceneError(f"sensor {name!r} is {pair!r}; give a pair (design, Pose(…))")
            designs[name], self.poses[name] = pair
        self._pool, self._one = ThreadPool(threads), ForkSafeRLock()
        self.simulators: dict[str, Simulator] = make_simulators(designs)
        """The sensors themselves."""

    def step(self, scene: Scene, poses: Mapping[str, Pose] | None = None) -> dict[str, Reading]:
        """Read all sensors in a scene.

        Every sensor sees the bodies that reach into its own domain.

        Args:
            scene: Bodies with their poses in the world.
            poses: Where sensors stand now, of those that have moved; it is remembered.

        Returns:
            Name → reading, in the order of the sensors; the same as from the sensors one by one,
            to the last bit.

        Raises:
            SceneError: ``scene`` is not a scene, or there is no sensor of a name in ``poses``.
            SkinError: Some sensors failed; it holds the readings of the others.
        """
        with self._one:  # poses are remembered
            return self.step_views(self.views(scene, poses))

    def views(self, scene: Scene, poses: Mapping[str, Pose] | None = None) -> dict[str, Scene]:
        """What each sensor sees of a scene, in its own frame; arguments as of :meth:`step`."""
        if not isinstance(scene, Scene):
            raise SceneError(f"step takes a Scene, not {type(scene).__name__}; write Scene([...])")
        self._check_names("poses", poses or {})
        self.poses.update(poses or {})
        bounds = scene.pack().bounds
        centre, half = bounds.mean(axis=1), 0.5 * (bounds[:, 1] - bounds[:, 0])
        return {
            name: self._view(scene, centre, half, simulator, self.poses[name])
            for name, simulator in self.simulators.items()
        }

    def step_views(self, views: Mapping[str, Scene | DepthFrame]) -> dict[str, Reading]:
        """Read sensors that each see something of their own.

        Args:
            views: Name → what the sensor sees, in its own frame; sensors may be left out.

        Raises:
            SceneError: There is no sensor of a name in ``views``.
            SkinError: Some sensors failed; it holds the readings of the others.
        """
        self._check_names("views", views)
        tasks = {name: partial(self.simulators[name].step, view) for name, view in views.items()}
        return read_all(self._pool, tasks)

    def reset(self) -> None:
        """Forget the previous step."""
        for simulator in self.simulators.values():
            simulator.reset()

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


def make_simulators(designs: Mapping[str, AnyDesign]) -> dict[str, Simulator]:
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
            simulators[name] = first[key].copy()
            continue
        made = design if isinstance(design, Simulator) else Simulator(design)
        simulators[name] = first[key] = made
    return simulators


def read_all(pool: ThreadPool, tasks: Mapping[str, Callable[[], Reading]]) -> dict[str, Reading]:
    """Read sensors together: name → what reads it.

    Raises:
        SkinError: Some of them failed; it holds the readings of the others.
    """
    readings, failures = pool.run(tasks)
    if failures:
        raise SkinError(some_failed("sensors", failures, len(tasks)), readings, failures)
    return readings
