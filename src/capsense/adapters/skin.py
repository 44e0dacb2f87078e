"""Many sensors on a simulated robot, read in one call."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

import numpy as np

from capsense._thread_pool import ForkSafeRLock, ThreadPool
from capsense._validate import suggest
from capsense.adapters import GeometrySensor, WorldSource
from capsense.adapters.findings import SkinFindings
from capsense.adapters.placement import BLIND, blind
from capsense.adapters.world import Frames, World
from capsense.design.model import Domain
from capsense.errors import SceneError, listed
from capsense.reading import Reading
from capsense.readout import Readout
from capsense.scene import Pose, Scene
from capsense.simulator import Simulator
from capsense.skin import (
    AnyDesign,
    SkinLayout,
    make_simulators,
    read_all,
    reset_all,
    use_readouts,
)

Progress = Callable[[str, float], None]


class AttachedSkin:
    """Reads sensors that ride on links of a simulated robot; made by an adapter's ``attach_skin``.

    Threads may share one: they take turns.

    Args:
        sensors: Name → sensor; they share one source of their world.
        readout: What :meth:`use_readout` takes; None for what the sensors have already.
        threads: How many threads read; by default as many as the process may use processors.

    Raises:
        ValueError: ``threads`` is not a positive whole number.
        ReadoutError: There is no such chip or file, or the file is wrong.
    """

    def __init__(
        self,
        sensors: Mapping[str, GeometrySensor],
        readout: Readout | str | Path | None,
        threads: int | None,
    ) -> None:
        self.sensors = dict(sensors)
        """The sensors, as ``attach`` makes them."""
        self._source = next(iter(self.sensors.values())).source
        self._pool, self._one = ThreadPool(threads), ForkSafeRLock()
        if readout is None:
            for sensor in self.sensors.values():
                sensor.use_readout(sensor.readout)
        else:
            self.use_readout(readout)

    def views(self) -> dict[str, Scene]:
        """What each sensor sees at the present state, by name, in its own frame.

        Raises:
            SceneError: The simulator has not been stepped yet, or has diverged.
        """
        with self._one:
            links = self._source.links()
            return {name: sensor.scene(links) for name, sensor in self.sensors.items()}

    def read(
        self, time: float | None = None, views: Mapping[str, Scene] | None = None
    ) -> dict[str, Reading]:
        """The readings of the simulator's present state, by name.

        They are those that the sensors would give one by one, to the last bit.

        Args:
            time: Time of the state [s], for readouts; by default the simulator's own, where it
                tells it.
            views: What :meth:`views` has just given, if that was asked already.

        Raises:
            SkinError: Some sensors failed; it holds the readings of the others.
            SceneError: A pattern fits nothing any more, after bodies were added or removed.
        """

        with self._one:
            links = self._source.links() if views is None else None
            for sensor in self.sensors.values():
                sensor.catch_up()
            return read_all(
                self._pool,
                {name: sensor.simulator for name, sensor in self.sensors.items()},
                lambda name: self.sensors[name].scene(links) if views is None else views[name],
                lambda name: self.sensors[name].time_of(time),
                lambda name, reading: self.sensors[name].sampled(reading, time),
            )

    def check(self, progress: Progress | None = None) -> SkinFindings:
        """What is wrong with each sensor; see :meth:`AttachedSensor.check`.

        Args:
            progress: Called with a stage's name and the fraction done.

        Returns:
            Name → findings. ``.mounting`` and ``.scene`` are of all sensors together, a sentence
            for each kind of finding with the worst one; so it is printed.

        Raises:
            SceneError: The simulator has not been stepped yet, or has diverged.
        """
        out = SkinFindings()
        for name, sensor in self.sensors.items():
            if progress is not None:
                progress("shapes that sensors see", len(out) / len(self))
            out[name] = sensor.check()
        if progress is not None:
            progress("shapes that sensors see", 1.0)
        return out

    def warn(self, progress: Progress | None = None) -> None:
        """Warn of what :meth:`check` finds; some sensors of a skin may well see nothing.

        Args:
            progress: As of :meth:`check`.
        """
        try:
            found = self.check(progress)
        except SceneError:  # which the first reading will raise, too
            return
        if not all(blind(texts) for texts in found.values()):
            found = found.without(BLIND)
        if any(found.values()):
            warnings.warn(f"{found}", stacklevel=3)

    @property
    def poses(self) -> dict[str, Pose]:
        """Where the sensor frames stand in the simulator's world, by name.

        Raises:
            SceneError: The simulator has not been stepped yet.
        """
        return {name: sensor.pose for name, sensor in self.sensors.items()}

    def refresh(self) -> None:
        """Take the world's solids over again, after their shapes, sizes or number changed.

        Raises:
            SceneError: A shape is not supported, or a name pattern fits nothing.
        """
        with self._one:
            self._source.refresh()
            for sensor in self.sensors.values():
                sensor.catch_up()

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
            start: Time at which they are switched on [s], by default the robot simulator's, or 0
                where that is not told.
            seed: Of the first sensor's noise, by default its own; those of the others follow at
                steps of 2³², so that noise is not shared.

        Raises:
            ReadoutError: There is no such chip or file, the file is wrong, or the seed is no whole
                number from 0 on.
        """
        with self._one:
            use_readouts(self.sensors, readout, start, seed)

    def reset(self, *, start: float | None = None, seed: int | None = None) -> None:
        """Forget the previous step, as after the simulator was set back; restart the chips.

        Args:
            start: Time at which they are switched on [s], by default the robot simulator's, or 0
                where that is not told.
            seed: Of the first sensor's noise from now on, as of :meth:`use_readout`; by default all
                random numbers repeat.

        Raises:
            ReadoutError: The seed is no whole number from 0 on.
        """
        with self._one:
            reset_all(self.sensors, start, seed)

    def __len__(self) -> int:
        return len(self.sensors)


def simulators_of(
    names: Iterable[str],
    design: AnyDesign | Mapping[str, AnyDesign],
    progress: Progress | None = None,
) -> dict[str, Simulator]:
    """Simulators for the sensors of a skin: all of one design, or each of its own.

    Args:
        names: Of the sensors.
        design: A design, or name → design.
        progress: As of a :class:`Simulator`.

    Raises:
        SceneError: Names repeat, or those of ``design`` are others.
        DesignError: A design is wrong.
        FieldError: A background field could not be built.
    """
    names = list(names)
    for name in names:
        if names.count(name) > 1:
            raise SceneError(f"{name!r} is given {names.count(name)} times; once is enough")
    if not isinstance(design, Mapping):
        return make_simulators(dict.fromkeys(names, design), progress)
    for name in design:
        if name not in names:
            raise SceneError(f"design: no sensor is named {name!r}; {suggest(name, names)}")
    for name in names:
        if name not in design:
            raise SceneError(f"design: nothing is given for {name!r}; give a design for each")
    return make_simulators({name: design[name] for name in names}, progress)


def clear_of_neighbours(
    layout: SkinLayout, source: WorldSource, frame: int, link_in_frame: Pose
) -> SkinLayout:
    """The patches of a layout that lie inside no other link; a warning names the others.

    Args:
        layout: Patches on a link.
        source: The world in the state in which links are compared.
        frame: The frame that carries the link.
        link_in_frame: Pose of the link in that frame.

    Raises:
        TypeError: ``layout`` is no layout.
        SceneError: All patches lie inside other links.
    """
    if not isinstance(layout, SkinLayout):
        raise TypeError(
            f"layout is a {type(layout).__name__}; give what cs.skin.from_mesh, from_taxels or "
            "paint returns"
        )
    position, quaternion = source.links()
    link = Pose(position[frame], quaternion[frame]) @ link_in_frame
    frames = Frames(position, quaternion, np.array(link.position), np.array(link.quaternion))
    everywhere = Domain((20.0, 20.0, 20.0), 10.0)
    clear = layout.clear_of(World(source.solids(frame), everywhere).scene(frames))
    gone = [name for name in layout if name not in clear]
    if gone:
        warnings.warn(
            f"{len(gone)} of {len(layout)} patches are left out, since they lie inside other "
            f"links: {listed([f'{name}: {clear.left_out[name]}' for name in gone], 3)}",
            stacklevel=3,
        )
    return clear
