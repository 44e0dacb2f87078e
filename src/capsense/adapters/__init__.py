"""Sensors attached to robot simulators: MuJoCo, PyBullet, Assistive Gym, CoppeliaSim.

Every adapter hands out an :class:`~capsense.adapters.AttachedSensor`. What they share:

- :mod:`~capsense.adapters.rules`: what things are made of, by the patterns of their names
- :mod:`~capsense.adapters.world`: the solids of a simulator, placed in the sensor frame
- :mod:`~capsense.adapters.meshes`: triangle meshes made into solids
"""

from __future__ import annotations

import copy
import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from capsense._thread_pool import ForkSafeRLock
from capsense._validate import suggest
from capsense.adapters.contacts import Contact
from capsense.adapters.findings import Findings
from capsense.adapters.placement import FAR, blind, buried, far_off, felt, placement, turned_round
from capsense.adapters.rules import Rules
from capsense.adapters.world import Frames, SoftSolid, Solid, World
from capsense.design.model import Design
from capsense.errors import SceneError
from capsense.reading import Reading
from capsense.readout import Readout
from capsense.readout.config import make_readout
from capsense.scene import DepthFrame, Pose, Scene
from capsense.simulator import Simulator

Array = NDArray[np.float64]

_OUT = 1e-3
"""A sensor has its link at its back where the middle of that is so far behind it [m]."""


class AttachedSensor(ABC):
    """Reads a sensor that rides on a link of a simulated robot.

    Made by the ``attach`` of an adapter. Threads may share one: they take turns.
    """

    def __init__(self, simulator: Simulator) -> None:
        self.simulator = simulator
        """The sensor itself."""
        self.readout: Readout | None = copy.deepcopy(simulator.readout)
        """The chip that turns capacitances into counts, if any; at first a copy of the simulator's,
        which stays as it is."""
        self._one = ForkSafeRLock()

    def read(
        self,
        time: float | None = None,
        view: Scene | DepthFrame | None = None,
        *,
        keep_field: bool = False,
    ) -> Reading:
        """The reading of the simulator's present state.

        With a :attr:`readout`, the reading holds the conversions that have finished since the last
        call, with their time stamps, as ``reading.counts``.

        Args:
            time: Time of the state [s], for the readout and for a cover's relaxation and
                hysteresis; by default the simulator's own, where it tells it (MuJoCo does, PyBullet
                does not).
            view: What :meth:`view` has just given, if that was asked already.
            keep_field: As of :meth:`Simulator.step`.

        Raises:
            SceneError: The simulator has not been stepped yet, or has diverged, or a readout
                needs a time.
            SolveError: The solver did not reach its tolerance.
            ReadoutError: Time went back; call :meth:`reset` when the simulator is set back.
        """
        with self._one:
            world = self.view() if view is None else view
            now = self.time_of(time)
            reading = self.simulator.solved(world, time=now, keep_field=keep_field)
            return self.sampled(reading, now)

    def sampled(self, reading: Reading, time: float | None) -> Reading:
        """A reading with what the :attr:`readout` makes of it, if there is one.

        Args:
            reading: Of the simulator's present state.
            time: As of :meth:`read`.

        Raises:
            SceneError: The readout needs a time that the simulator does not tell.
            ReadoutError: Time went back.
        """
        with self._one:
            now = self.time_of(time)
            if self.readout is None or now is None:
                return reading
            return replace(reading, counts=self.readout.sample(now, reading))

    def time_of(self, time: float | None) -> float | None:
        """The time of a reading [s]; None where nothing needs it that the simulator can tell.

        Raises:
            SceneError: A readout needs it, and the simulator does not tell it.
        """
        if time is not None:
            return float(time)
        if self.readout is not None:
            return self._time()
        cover = self._design.cover
        if cover is None or not (cover.relaxation or cover.hysteresis):
            return None
        try:
            return self._time()
        except SceneError:
            return None

    def use_readout(
        self,
        readout: Readout | str | Path | None,
        *,
        start: float | None = None,
        seed: int | None = None,
    ) -> None:
        """Read through a chip from now on. The simulator's own readout stays as it is.

        Args:
            readout: A readout of this sensor alone, the name of a chip with its usual settings,
                the path of a readout file (``.toml``), or None.
            start: Time at which it is switched on [s], by default the robot simulator's, or 0 where
                that is not told.
            seed: Of its noise, by default its own.

        Raises:
            ReadoutError: There is no such chip or file, the file is wrong, or the seed is no whole
                number from 0 on.
        """
        self.readout = None
        if readout is not None:
            chip = make_readout(readout, self.simulator)
            chip.reset(start=self._start(start), seed=seed)
            self.readout = chip

    def _start(self, start: float | None) -> float:
        """When a chip is switched on [s]: as given, or at the simulator's time, or at 0 s."""
        if start is not None:
            return start
        try:
            return self._time()
        except SceneError:
            return 0.0

    @property
    def time(self) -> float:
        """The simulator's time [s].

        Raises:
            SceneError: This simulator does not tell it.
        """
        return self._time()

    def _time(self) -> float:
        """The simulator's time [s]."""
        raise SceneError(
            "this simulator does not tell its time, which readouts and recordings need; "
            "write read(time=…), in seconds"
        )

    def view(self) -> Scene | DepthFrame:
        """What a reading is taken of: :meth:`scene`, or the depth image that it is made from.

        Raises:
            SceneError: The simulator has not been stepped yet, or has diverged.
        """
        return self.scene()

    @abstractmethod
    def scene(self) -> Scene:
        """What the sensor sees at the present state, in the sensor frame.

        Raises:
            SceneError: The simulator has not been stepped yet, or has diverged.
        """

    @property
    @abstractmethod
    def pose(self) -> Pose:
        """Where the sensor frame stands in the simulator's world.

        Raises:
            SceneError: The simulator has not been stepped yet.
        """

    def check(self) -> Findings:
        """What is wrong with where the sensor sits and what it sees at the present state.

        Electrodes inside a body or touching one, or deep inside the link that carries them; a
        sensor that faces the wrong way or sees nothing; meshes and images too coarse; cameras
        that are set wrongly.

        Returns:
            A list of sentences, each with its fix; none where all is well. ``.mounting`` has those
            of where the sensor sits and of what ``attach`` was told, which stay; ``.scene`` those
            of the present state. Printed, they are marked as such.

        Raises:
            SceneError: The simulator has not been stepped yet, or has diverged.
        """
        scene = self.scene()
        return felt(self.simulator, scene, placement(scene, self.simulator))

    def warn(self) -> None:
        """Warn of what :meth:`check` finds, if the simulator's state is known yet."""
        try:
            found = self.check()
        except SceneError:  # which the first reading will raise, too
            return
        if found:
            warnings.warn(f"sensor: {found}", stacklevel=3)

    @property
    def _design(self) -> Design:
        return self.simulator.design

    @property
    def baseline(self) -> Array:
        """Maxwell matrix with nothing in the domain [F], shape (M, M)."""
        return self.simulator.baseline

    @property
    def electrode_names(self) -> tuple[str, ...]:
        """Electrode names in matrix order."""
        return self.simulator.electrode_names

    def reset(self, *, start: float | None = None, seed: int | None = None) -> None:
        """Forget the previous step, as after the simulator was set back; restart the chip.

        Args:
            start: Time at which it is switched on [s], by default the robot simulator's, or 0 where
                that is not told.
            seed: Of its noise from now on; by default its random numbers repeat.

        Raises:
            ReadoutError: The seed is no whole number from 0 on.
        """
        with self._one:
            self.simulator.forget()
            if self.readout is not None:
                self.readout.reset(start=self._start(start), seed=seed)


class DepthSensor(AttachedSensor):
    """A sensor that sees a depth image."""

    @abstractmethod
    def frame(self) -> DepthFrame:
        """The depth image of the present state.

        Raises:
            SceneError: The simulator does not give one.
        """

    def view(self) -> DepthFrame:
        return self.frame()

    def scene(self) -> Scene:
        return self.frame().scene()


class WorldSource(ABC):
    """The solids of a simulator's model, taken over once for all sensors that ride in it."""

    def __init__(self, rules: Rules) -> None:
        self.rules = rules
        """What is seen, and what it is made of."""
        self.version = 0
        """Goes up whenever the solids are taken over again."""
        self.refresh()

    def refresh(self) -> None:
        """Take the solids over again, after their shapes, sizes or number changed.

        Raises:
            SceneError: A name pattern fits nothing.
        """
        self.version += 1

    @abstractmethod
    def solids(self, own: int | None) -> list[Solid]:
        """All solids but those of the frame ``own``.

        Raises:
            SceneError: A shape is not supported.
        """

    @abstractmethod
    def soft(self, own: int | None) -> list[SoftSolid]:
        """All deformables but those of the frame ``own``.

        Raises:
            SceneError: One is not supported.
        """

    def contacts(self, frame: int) -> Sequence[Contact]:
        """Contacts of the body that a frame carries, with others, that the simulator knows of."""
        return ()

    @abstractmethod
    def robot(self, frame: int) -> set[int]:
        """The frames of the robot that a frame belongs to."""

    @abstractmethod
    def neighbours(self, frame: int) -> set[int]:
        """The frames that are fixed to a frame, or that one joint of the robot moves against it."""

    @abstractmethod
    def links(self) -> tuple[Array, Array]:
        """Origins [m] (f, 3) and quaternions (f, 4) of the moving frames, as they are now."""


class GeometrySensor(AttachedSensor):
    """A sensor that sees the shapes of the simulator's model themselves.

    The world's solids are taken over once; every reading takes only their poses.
    """

    world: World
    """Everything it may see."""
    contact_forces = True
    """Whether the forces of the simulator's contacts press bodies onto the design's cover; of
    bodies without contact the overlap with the cover counts."""
    _carrier: int
    """The frame that carries it."""

    def __init__(self, simulator: Simulator, source: WorldSource) -> None:
        super().__init__(simulator)
        self.source = source
        """Where its world comes from; the sensors of a skin share it."""
        self._take_over()

    def scene(self, links: tuple[Array, Array] | None = None) -> Scene:
        """The bodies within the sensor's domain, in the sensor frame, at the present state.

        Args:
            links: What ``source.links()`` has just given, if that was asked already.

        Raises:
            SceneError: The simulator has not been stepped yet, or has diverged.
        """
        with self._one:
            frames = self._now(links)  # may take over another world
            cover = self._design.cover
            if cover is None or not self.contact_forces:
                return self.world.scene(frames)
            return self.world.scene(frames, self.source.contacts(self._carrier), cover)

    @property
    def pose(self) -> Pose:
        frames = self._now(None)
        return Pose(frames.sensor_position, frames.sensor_quaternion)

    def check(self) -> Findings:
        frames = self._now(None)
        scene, simulator, carrier = self.scene(), self.simulator, self._carrier
        near = {str(name) for name in self.world.names(self.source.neighbours(carrier))}
        pressed: dict[str, float] = {}
        for contact in self.source.contacts(carrier):
            for name in map(str, self.world.names({contact.frame})):
                pressed[name] = max(pressed.get(name, 0.0), -contact.gap)
        found = felt(simulator, scene, placement(scene, simulator, near, pressed))
        link = self._link(frames)
        hidden = buried(link, self._design)
        if not blind(found):
            return Findings(found + hidden)
        turn = Pose((0, 0, 0), frames.sensor_quaternion) @ Pose((0, 0, 0), (1, 0, 0, 0))
        behind = self.world.scene(frames._replace(sensor_quaternion=np.array(turn.quaternion)))
        own = self.world.names(self.source.robot(self._carrier))
        others = [str(b.name) for b in behind if b.name not in own]
        middles = [b.pose.apply(b.shape.bounds().mean(axis=0))[2] for b in link]
        outwards = bool(middles) and float(np.mean(middles)) < -_OUT
        if others:
            return Findings([turned_round(others, mounting=not outwards), *hidden])
        own_frame = self._own_frame()
        away = 0.0
        if own_frame is not None:
            away = math.dist(frames.position[own_frame], frames.sensor_position)
        return Findings([*([far_off(away)] if away > FAR else found), *hidden])

    def _link(self, frames: Frames) -> Scene:
        """The bodies of the link that carries the sensor, where these are not seen."""
        own = self._own_frame()
        if own is None:
            return Scene()
        try:
            with warnings.catch_warnings():  # readings do without these bodies
                warnings.simplefilter("ignore")
                solids = [s for s in self.source.solids(None) if s.frame == own]
        except SceneError:
            return Scene()
        return World(solids, self._design.domain).scene(frames)

    def refresh(self) -> None:
        """Take the world's solids over again, after their shapes, sizes or number changed.

        Raises:
            SceneError: A shape is not supported, or a name pattern fits nothing.
        """
        self.source.refresh()
        self._take_over()

    def catch_up(self) -> None:
        """Take over the world again if its source has changed.

        Raises:
            SceneError: A shape is not supported.
        """
        if self._version != self.source.version:
            self._take_over()

    def _now(self, links: tuple[Array, Array] | None) -> Frames:
        links = self.source.links() if links is None else links
        self.catch_up()
        return self._frames(*links)

    def _take_over(self) -> None:
        own, domain = self._own_frame(), self.simulator.design.domain
        self.world = World(self.source.solids(own), domain, self.source.soft(own))
        self._version = self.source.version

    @abstractmethod
    def _own_frame(self) -> int | None:
        """The frame whose solids the sensor does not see; None where it sees them all."""

    @abstractmethod
    def _frames(self, position: Array, quaternion: Array) -> Frames:
        """Where everything is now, from the moving frames."""


def make_simulator(design: Design | str | Path | Simulator) -> Simulator:
    """The simulator of a design, or the one given.

    Raises:
        DesignError: The design is wrong.
        FieldError: The background field could not be built.
    """
    return design if isinstance(design, Simulator) else Simulator(design)


def refuse_missing(what: str, name: str, known: Sequence[str], adds: str = "") -> SceneError:
    """The error for a name that a model does not have; ``adds`` is the call that adds one."""
    if not known:
        fix = f"; {adds} adds one" if adds else ""
        return SceneError(f"there is no {what} named {name!r}; the model has none at all{fix}")
    return SceneError(f"there is no {what} named {name!r}; {suggest(name, known)}")
