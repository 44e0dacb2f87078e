"""Recording: every step of a simulator, as it is taken, into an MCAP file, and to ROS 2 nodes."""

from __future__ import annotations

import atexit
import errno
import logging
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Self, overload

from capsense._thread_pool import ForkSafeRLock
from capsense.adapters import AttachedSensor
from capsense.adapters.skin import AttachedSkin
from capsense.codec import design_to_json
from capsense.errors import ReadoutError, RecordingError
from capsense.reading import Reading
from capsense.readout import Readout
from capsense.recording import (
    DESIGN,
    NAME,
    SESSION,
    check_name,
    describe,
    make_readout,
    ros,
    versions,
)
from capsense.recording.dds import LiveTopics
from capsense.recording.files import McapFile
from capsense.scenario.model import Scenario
from capsense.scene import DepthFrame, Pose, Scene
from capsense.simulator import Simulator
from capsense.skin import Skin

_log = logging.getLogger(__name__)

_SECOND = 10**9


class _Track:
    """The steps of one sensor, as they go into a file.

    Args:
        source: A simulator, or a sensor attached to one.
        name: Of the sensor.
        readout: As of a :class:`Recorder`.
        scenario: As of a :class:`Recorder`.
    """

    _file: McapFile
    _live: LiveTopics | None

    def __init__(
        self,
        source: Simulator | AttachedSensor,
        name: str,
        readout: Readout | str | Path | None = None,
        scenario: Scenario | None = None,
    ) -> None:
        self.count = 0
        """Steps recorded so far."""
        self._sensor = source if isinstance(source, AttachedSensor) else None
        self._simulator = source if isinstance(source, Simulator) else source.simulator
        check_name(name)
        if readout is not None and source.readout is not None:
            raise ReadoutError("the sensor has a readout of its own; leave out readout=")
        self.readout, config = make_readout(
            readout, self._simulator.electrode_names, self._simulator.empty
        )
        """The recorder's own chip, if it was given one."""
        self.reset()
        self.session = describe(self._simulator, name, config, scenario)
        """What the file says once, at its start."""
        self._messages = ros.StepMessages(self.session)
        self._steps = self._episode = self._base = 0
        self._time, self._stamp = -math.inf, -1

    def texts(self, folder: str = "") -> dict[str, str]:
        """The files with what is said once, by name."""
        session = self.session
        return {
            folder + DESIGN: design_to_json(session.design), folder + SESSION: session.to_json(),
        }  # fmt: skip

    def reset(self) -> None:
        """Reset the simulator, or the sensor and its readout. Time may start anew."""
        (self._sensor or self._simulator).reset()
        if self.readout is not None:
            self.readout.reset()

    def put(
        self,
        time: float,
        world: Scene | DepthFrame,
        scene: Scene,
        reading: Reading,
        pose: Pose | None = None,
    ) -> Reading:
        """Write a step; return its reading, with the counts of a readout of one's own.

        Args:
            time: Its time [s].
            world: What was given to the simulator.
            scene: The same as a scene.
            reading: What the simulator returned.
            pose: Where the sensor stands in the world, if that is known.
        """
        steps = self._simulator.steps
        if steps != self._steps + 1:
            if steps != 1:
                raise _stepped_elsewhere(self.count)
            self._episode += 1
            self._time = -math.inf
            if self.readout is not None:
                self.readout.reset()
        stamp = self._stamp_of(time)
        if self.readout is not None:
            reading = replace(reading, counts=self.readout.sample(time, reading))
        moment = ros.Moment(stamp, self._episode, time)
        frame = world if isinstance(world, DepthFrame) else None
        messages = self._messages.of(moment, scene, reading, frame, pose)
        self._file.write(stamp, messages)
        if self._live is not None:
            self._live.write(stamp, messages)
        self._steps, self._time, self._stamp = steps, time, stamp
        self.count += 1
        return reading

    def check(self, time: float) -> None:
        """Refuse a step that could not be recorded, before it is taken."""
        if self._simulator.steps not in (0, self._steps):
            raise _stepped_elsewhere(self.count)
        if self._simulator.steps == self._steps:
            self._stamp_of(time)

    def _stamp_of(self, time: float) -> int:
        """Time on the recording's clock [ns]; it goes on where time starts anew."""
        if not (math.isfinite(time) and 0 <= time < 1e9):
            raise RecordingError(f"time is {time!r} s; give zero or more")
        if time < self._time:
            raise RecordingError(
                f"time is {time:g} s, but the last step was at {self._time:g} s; "
                "call reset() where time starts anew"
            )
        now = round(time * _SECOND)
        if self._base + now < self._stamp:
            self._base = (self._stamp // _SECOND + 2) * _SECOND - now
        return self._base + now


class _Open:
    """A file that is recorded into.

    Args:
        path: The file.
        overwrite: Whether a file that is there may be replaced.
        ros_domain: As of a :class:`Recorder`.
        said: Values that say what the file is, and the files with what is said once.
    """

    def __init__(
        self,
        path: Path,
        overwrite: bool,
        ros_domain: int | None,
        said: tuple[Mapping[str, str], Mapping[str, str]],
    ) -> None:
        self.path = path
        self._told, self._one = False, ForkSafeRLock()
        self._live = None if ros_domain is None else LiveTopics(ros_domain)
        self._file = McapFile(self.path, overwrite=overwrite)
        try:
            self._file.begin(NAME, *said)
        except OSError as error:
            raise self._unwritten(error) from None
        atexit.register(self._close_late)

    def flush(self) -> None:
        """Put everything into the file now.

        Raises:
            OSError: That failed; it can be tried again.
        """
        self._file.flush()

    def close(self) -> None:
        """Put everything and the index into the file, and close it.

        Raises:
            OSError: That failed. What was written before is in the file; closing can be tried
                again.
        """
        try:
            self._file.close()
        except OSError as error:
            raise self._unwritten(error) from None
        atexit.unregister(self._close_late)

    def _close_late(self) -> None:
        """Close when the process ends; a failure that nobody was told of goes to the log."""
        told = self._told
        try:
            self.close()
        except OSError as error:
            if not told:
                _log.warning("a recording could not be closed: %s", error)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _check_file(self) -> None:
        if self._file.failure is not None:
            raise self._unwritten(self._file.failure)

    def _unwritten(self, error: OSError) -> OSError:
        self._told = True
        why = error.strerror or str(error)
        return OSError(
            error.errno or errno.EIO,
            f"{why}; the file holds what was recorded until half a second before",
            str(self.path),
        )


class Recorder(_Track, _Open):
    """Steps a simulator, or reads an attached sensor, and records what it saw and read.

    The simulator is reset first, since a reading depends, in its last digits, on the steps before
    it. Everything is on disk up to half a second ago, so a process that is killed loses that much.
    Close it, or use it in a ``with`` block; that also writes the index that makes the file quick
    to open. Threads may share one: they take turns, and their times must still rise.

    Args:
        path: The file, by custom one that ends in ``.mcap``.
        source: A simulator, or a sensor attached to one.
        name: Of the sensor; its frame and the beginning of its topics.
        readout: A readout whose counts are recorded too: a chip's name, the path of a readout
            file, or a readout. An attached sensor brings its own.
        scenario: What is played, if it is one; tables made from the file take its channels.
        overwrite: Whether a file that is there may be replaced.
        ros_domain: Experimental: publish the topics of standard types, as they are recorded, to the
            ROS 2 nodes of this domain (``ROS_DOMAIN_ID``, 0 by default there).

    Raises:
        TypeError: ``source`` is neither a simulator nor a sensor.
        RecordingError: The file is there already or cannot be made, or ``name`` is no name.
        ReadoutError: The readout is wrong, or there are two.
        MissingDependencyError: The optional packages are not installed.
        OSError: The beginning could not be written.
    """

    def __init__(
        self,
        path: str | Path,
        source: Simulator | AttachedSensor,
        *,
        name: str = "sensor",
        readout: Readout | str | Path | None = None,
        scenario: Scenario | None = None,
        overwrite: bool = False,
        ros_domain: int | None = None,
    ) -> None:
        ros.require()
        if not isinstance(source, Simulator | AttachedSensor):
            raise TypeError(
                f"source is of {type(source).__name__}; give a Simulator, or a sensor that attach "
                "returned"
            )
        _Track.__init__(self, source, name, readout, scenario)
        said = self.session.metadata(), self.texts()
        _Open.__init__(self, Path(path), overwrite, ros_domain, said)

    def step(self, world: Scene | DepthFrame, time: float) -> Reading:
        """Step the simulator, record, and return the reading.

        Args:
            world: As for :meth:`capsense.Simulator.step`.
            time: Its time [s], zero or more, not before that of the last step since a reset.

        Raises:
            RecordingError: Time is wrong, or the simulator was stepped behind the recorder's back.
            OSError: The file could not be written; what was recorded before is in it, and the
                last half second is kept until :meth:`close` tries again.
            SceneError, SolveError: As for the simulator.
        """
        with self._one:
            self._check(time)
            scene = _scene(world)
            return self._write(time, world, scene, self._stepped(scene, time))

    def _stepped(self, scene: Scene, time: float) -> Reading:
        if self._sensor is None:
            return self._simulator.step(scene, time=time)
        return self._simulator.solved(scene, time=time)  # its own chip is not the sensor's

    def read(self, time: float | None = None) -> Reading:
        """Read the attached sensor, record, and return the reading.

        Args:
            time: Time of the state [s]; by default the robot simulator's, where it tells it.

        Raises:
            RecordingError: No sensor is recorded; otherwise as for :meth:`step`.
            OSError: As for :meth:`step`.
            SceneError, SolveError, ReadoutError: As for the sensor.
        """
        if self._sensor is None:
            raise RecordingError("a simulator is recorded, not a sensor; write step(world, time)")
        with self._one:
            now = self._sensor.time if time is None else float(time)
            self._check(now)
            view = self._sensor.view()
            scene = _scene(view)
            return self._write(now, view, scene, self._sensor.read(now, scene))

    def write(self, time: float, world: Scene | DepthFrame, reading: Reading) -> Reading:
        """Record the step that the simulator has just taken; for loops that step it themselves.

        Args:
            time: Its time [s].
            world: What was given to the simulator.
            reading: What it returned.

        Returns:
            The reading, with the counts of a readout that was given to the recorder.

        Raises:
            RecordingError: Time is wrong, or other steps went before that were not recorded.
            OSError: The file could not be written, as for :meth:`step`.
        """
        with self._one:
            self._check_file()
            return self._write(time, world, _scene(world), reading)

    def _write(
        self, time: float, world: Scene | DepthFrame, scene: Scene, reading: Reading
    ) -> Reading:
        pose = None if self._sensor is None else self._sensor.pose
        return self.put(time, world, scene, reading, pose)

    def _check(self, time: float) -> None:
        """Refuse a step that could not be recorded, before it is taken."""
        self._check_file()
        self.check(time)


class SkinRecorder(_Open):
    """Reads a skin, and records all of its sensors into one file; made by :func:`record`.

    Each sensor has a frame and topics of its own, by its name, in which :class:`Recorder` would
    write them.

    Args:
        path: The file, by custom one that ends in ``.mcap``.
        skin: A skin, or one that is attached to a robot.
        overwrite: Whether a file that is there may be replaced.
        ros_domain: As of a :class:`Recorder`.

    Raises:
        RecordingError: The file is there already or cannot be made, or a sensor's name is no name
            of a topic.
        MissingDependencyError: The optional packages are not installed.
        OSError: The beginning could not be written.
    """

    def __init__(
        self,
        path: str | Path,
        skin: Skin | AttachedSkin,
        *,
        overwrite: bool = False,
        ros_domain: int | None = None,
    ) -> None:
        ros.require()
        self._skin = skin
        sensors = skin.simulators if isinstance(skin, Skin) else skin.sensors
        self._tracks = {name: _Track(source, name) for name, source in sensors.items()}
        texts: dict[str, str] = {}
        for name, track in self._tracks.items():
            texts |= track.texts(f"{name}/")
        first = next(iter(self._tracks.values())).session.metadata()
        own = {key: first[key] for key in ("format", *versions())}
        super().__init__(Path(path), overwrite, ros_domain, ({**own, "name": "skin"}, texts))
        for track in self._tracks.values():
            track._file, track._live = self._file, self._live

    @property
    def count(self) -> int:
        """Steps recorded so far."""
        return next(iter(self._tracks.values())).count

    def read(self, time: float | None = None) -> dict[str, Reading]:
        """Read the attached skin, record, and return the readings by name.

        Args:
            time: Time of the state [s]; by default the robot simulator's, where it tells it.

        Raises:
            RecordingError: The skin is not attached to a robot, or time is wrong.
            SkinError: Some sensors failed; it holds the readings of the others, and nothing is
                recorded of them.
            OSError: The file could not be written.
            SceneError, ReadoutError: As for the sensors.
        """
        if isinstance(self._skin, Skin):
            raise RecordingError("this skin is on no robot; write step(scene, poses, time=…)")
        skin = self._skin
        with self._one:
            now = next(iter(skin.sensors.values())).time if time is None else float(time)
            self._check(now)
            views = skin.views()
            return self._write(now, views, skin.read(now, views), skin.poses)

    def step(
        self, scene: Scene, poses: Mapping[str, Pose] | None = None, *, time: float
    ) -> dict[str, Reading]:
        """Read the skin in a scene, record, and return the readings by name.

        Args:
            scene: As of :meth:`Skin.step`.
            poses: As of :meth:`Skin.step`.
            time: Time of the scene [s].

        Raises:
            RecordingError: The skin is attached to a robot, or time is wrong.
            SkinError: As by :meth:`read`.
            OSError: The file could not be written.
            SceneError, ReadoutError: As for the skin.
        """
        if not isinstance(self._skin, Skin):
            raise RecordingError("this skin is attached to a robot; write read()")
        skin = self._skin
        with self._one:
            self._check(time)
            views: dict[str, Scene] = skin.views(scene, poses)
            return self._write(time, views, skin.step_views(views, time=time), skin.poses)

    def reset(self) -> None:
        """Reset the sensors and their readouts. Time may start anew."""
        self._skin.reset()

    def _check(self, time: float) -> None:
        self._check_file()
        for track in self._tracks.values():
            track.check(time)

    def _write(
        self,
        time: float,
        views: Mapping[str, Scene],
        readings: Mapping[str, Reading],
        poses: Mapping[str, Pose],
    ) -> dict[str, Reading]:
        return {
            name: track.put(time, views[name], views[name], readings[name], poses[name])
            for name, track in self._tracks.items()
        }


@overload
def record(path: str | Path, source: Simulator | AttachedSensor, **options: Any) -> Recorder: ...


@overload
def record(path: str | Path, source: Skin | AttachedSkin, **options: Any) -> SkinRecorder: ...


def record(
    path: str | Path, source: Simulator | AttachedSensor | Skin | AttachedSkin, **options: Any
) -> Recorder | SkinRecorder:
    """Record a simulator, a sensor or a skin: ``with cs.record("run.mcap", sensor) as run:``.

    The same as :class:`Recorder`, and for skins as :class:`SkinRecorder`.
    """
    if isinstance(source, Skin | AttachedSkin):
        return SkinRecorder(path, source, **options)
    return Recorder(path, source, **options)


def _scene(world: Scene | DepthFrame) -> Scene:
    return world.scene() if isinstance(world, DepthFrame) else world


def _stepped_elsewhere(count: int) -> RecordingError:
    return RecordingError(
        f"the simulator took a step after number {count} that was not recorded, so a replay could "
        "not repeat what follows; step it through the recorder only, or reset it first"
    )
