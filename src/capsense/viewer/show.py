"""Shows instants as they come, and sensors on robots live: :func:`show`."""

from __future__ import annotations

import queue
import threading
import time
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from capsense.adapters.attached import AttachedSensor, GeometrySensor
from capsense.adapters.world import Solid
from capsense.errors import CapSenseError, SceneError
from capsense.reading import Reading
from capsense.scenario.model import Excitation, channels_of
from capsense.scene import DepthFrame, Pose, Shape
from capsense.viewer.player import FIELD_PERIOD
from capsense.viewer.source import Frame, Simulated, Stream

if TYPE_CHECKING:
    from capsense.viewer.charts import Plane


Array = NDArray[np.float64]

KEPT = 3000
"""At least so many samples are kept, and up to twice as many."""
WAIT = 0.05
"""Longest wait for a sample before potentials are looked after [s]."""
RETRY = 0.5
"""Pause after a failure [s]."""


class Follower:
    """Takes what a stream brings, in a thread of its own. A playback of live data.

    Samples come in and are kept whether time runs or not; what :meth:`pause` stops is the page.

    Args:
        source: Used by the follower's thread alone from now on; closed by :meth:`stop`.
    """

    live = True

    def __init__(self, source: Stream) -> None:
        self.source = source
        self.loop = False
        self.plane: Plane | None = None
        self.with_field: Frame | None = None
        self.failure: CapSenseError | None = None
        self._frames: list[Frame] = []
        self._first = 0
        self._shown: int | None = None
        self._times = np.empty(2 * KEPT)
        self._changes = np.empty((2 * KEPT, len(source.channels)))
        self._levels = np.array([c.read(source.empty) for c in source.channels])
        self._field_taken = -np.inf
        self._lock = threading.Lock()
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="capsense follower", daemon=True)
        self._thread.start()

    @property
    def playing(self) -> bool:
        """Whether the newest sample is shown."""
        return self._shown is None

    @property
    def span(self) -> tuple[int, int]:
        """Numbers of the first and the last sample that are kept."""
        with self._lock:
            return self._first, self._first + max(len(self._frames) - 1, 0)

    @property
    def newest(self) -> Frame | None:
        """What is to be shown; None before there is any."""
        with self._lock:
            if not self._frames:
                return None
            if self._shown is None:
                return self._frames[-1]
            return self._frames[max(self._shown - self._first, 0)]

    def history(self, index: int) -> tuple[Array, Array]:
        """See :class:`~capsense.viewer.player.Playback`."""
        with self._lock:
            stop = max(index - self._first, 0) + 1
            return self._times[:stop].copy(), self._changes[:stop].copy()

    def play(self) -> None:
        """Show the newest, always."""
        self._shown = None

    def pause(self) -> None:
        """Keep showing what is shown."""
        self.go(self._position())

    def go(self, index: int) -> None:
        """Show one sample, or the first or last if there is none of that number."""
        first, last = self.span
        self._shown = min(max(index, first), last)

    def step(self, count: int) -> None:
        """Show the sample ``count`` on, or back."""
        self.go(self._position() + count)

    def set_speed(self, speed: float) -> None:
        """Live data have a speed of their own."""

    def stop(self) -> None:
        """End the thread, and close the source."""
        self._stopped.set()
        self._thread.join()
        self.source.close()

    def _position(self) -> int:
        shown = self._shown
        return self.span[1] if shown is None else shown

    # -- the thread -----------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._stopped.is_set():
            try:
                self._take_potentials()
                frame = self.source.next(WAIT)
                if frame is not None:
                    self._keep(frame)
                self.failure = None
            except CapSenseError as error:
                self.failure = error
                self._stopped.wait(RETRY)

    def _keep(self, frame: Frame) -> None:
        values = [c.read(frame.reading) for c in self.source.channels]
        with self._lock:
            count = len(self._frames)
            if count == 2 * KEPT:
                count = KEPT
                self._first += KEPT
                del self._frames[:KEPT]
                self._times[:KEPT] = self._times[KEPT:]
                self._changes[:KEPT] = self._changes[KEPT:]
            self._times[count] = frame.time
            self._changes[count] = np.array(values) - self._levels
            self._frames.append(frame)

    def _take_potentials(self) -> None:
        """Take those of what is shown, when they are wanted and it is time."""
        frame, plane, now = self.newest, self.plane, time.monotonic()
        if plane is None or frame is None:
            return
        last = self.with_field
        taken = last is not None and (last.index, last.plane) == (frame.index, plane)
        if not taken and now - self._field_taken >= FIELD_PERIOD:
            found = self.source.potentials(frame, plane)
            self.with_field = replace(frame, plane=plane, potentials=found)
            self._field_taken = now


class SensorStream(Simulated):
    """What a sensor reads, as it is put in. A :class:`~capsense.viewer.source.Stream`.

    Args:
        sensor: Potentials come from a copy of its simulator.
    """

    def __init__(self, sensor: AttachedSensor) -> None:
        super().__init__(sensor.simulator.copy())
        self.title, self.empty = f"{self.design.name}, on a robot", sensor.simulator.empty
        self.channels = channels_of(Excitation.MATRIX, self.design.electrode_names)
        self.frames: queue.Queue[Frame] = queue.Queue()

    def next(self, timeout: float) -> Frame | None:
        """See :class:`~capsense.viewer.source.Stream`."""
        try:
            return self.frames.get(timeout=timeout)
        except queue.Empty:
            return None


class Show:
    """Reads an attached sensor and shows it on a page; see :func:`show`."""

    def __init__(self, sensor: AttachedSensor, *, host: str, port: int) -> None:
        self._sensor, self._count = sensor, 0
        self._stream = SensorStream(sensor)
        self.player = Follower(self._stream)
        """Takes in the samples."""
        self._solids: tuple[int, list[Solid]] = (-1, [])
        try:
            from capsense.viewer.view import LiveView

            self.view = LiveView(self.player, host=host, port=port)
            """The page."""
        except BaseException:
            self.player.stop()
            raise
        self.url = self.view.url
        """Address of the page."""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self.view.run, args=(self._stop,), daemon=True)
        self._thread.start()

    def read(self, time: float | None = None) -> Reading:
        """Read the sensor, show what it sees with all of the robot, and return the reading.

        Args:
            time: Of the state [s]; by default the simulator's, or the number of the reading where
                that tells none.

        Raises:
            SceneError, SolveError, ReadoutError: As for the sensor.
        """
        view = self._sensor.view()
        reading = self._sensor.read(time, view)
        if time is None:
            try:
                time = self._sensor.time
            except SceneError:
                time = float(self._count)
        scene = view.scene() if isinstance(view, DepthFrame) else view
        frame = Frame(self._count, time, scene, reading, around=self._around())
        self._stream.frames.put(frame)
        self._count += 1
        return reading

    def _around(self) -> tuple[tuple[Shape, Pose], ...]:
        """All solids of the simulator, the robot's own too, in the sensor frame at present."""
        sensor = self._sensor
        if not isinstance(sensor, GeometrySensor):
            return ()
        position, quaternion = sensor.source.links()
        here = sensor.pose.inverse()
        if self._solids[0] != sensor.source.version:
            self._solids = sensor.source.version, sensor.source.solids(None)
        frames = [
            here @ Pose(tuple(p), tuple(q)) for p, q in zip(position, quaternion, strict=True)
        ]
        return tuple(
            (solid.shape, frames[solid.frame] @ solid.pose)
            for solid in self._solids[1]
            if isinstance(solid.shape, Shape)
        )

    def close(self) -> None:
        """Close the page."""
        self._stop.set()
        self._thread.join()
        self.view.stop()
        self.player.stop()

    def __enter__(self) -> Show:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def show(sensor: AttachedSensor, *, host: str = "127.0.0.1", port: int = 8080) -> Show:
    """Show a sensor on a robot live in a browser: ``page = cs.show(sensor)``, then ``page.read()``.

    Args:
        sensor: Attached in MuJoCo, PyBullet or another simulator.
        host: Address that the page is served at.
        port: Its port; 0 for any free one.

    Raises:
        ServerError: The address or port cannot be had.
        MissingDependencyError: The optional packages are not installed.
    """
    return Show(sensor, host=host, port=port)
