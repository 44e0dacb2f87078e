"""A page that shows a sensor, on a robot or by itself, as it is read."""

from __future__ import annotations

import queue
import threading

from capsense.adapters import AttachedSensor, GeometrySensor
from capsense.adapters.world import Solid
from capsense.errors import SceneError
from capsense.reading import Reading
from capsense.scenario.model import Excitation, channels_of
from capsense.scene import DepthFrame, Pose, Scene, Shape
from capsense.simulator import Simulator
from capsense.viewer.player import Follower
from capsense.viewer.source import Frame, Stream


class SensorStream(Stream):
    """What a sensor reads, as it is put in.

    Args:
        simulator: Of the sensor; potentials come from a copy.
        where: Says where the sensor is, for the title.
    """

    def __init__(self, simulator: Simulator, where: str) -> None:
        super().__init__(simulator.copy())
        self.title, self.empty = self.design.name + where, simulator.empty
        self.channels = channels_of(Excitation.MATRIX, self.design.electrode_names)
        self.frames: queue.Queue[Frame] = queue.Queue()

    def next(self, timeout: float) -> Frame | None:
        try:
            return self.frames.get(timeout=timeout)
        except queue.Empty:
            return None


class Show:
    """Reads a sensor and shows it on a page; see :func:`show`."""

    def __init__(self, sensor: AttachedSensor | Simulator, *, host: str, port: int) -> None:
        if not isinstance(sensor, AttachedSensor | Simulator):
            raise TypeError(
                f"sensor is of {type(sensor).__name__}; give a Simulator or a sensor that attach "
                "returned, or watch a scenario or a recording with capsense view"
            )
        self._sensor, self._count = sensor, 0
        self._stream = (
            SensorStream(sensor, "")
            if isinstance(sensor, Simulator)
            else SensorStream(sensor.simulator, ", on a robot")
        )
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

    def step(self, scene: Scene | DepthFrame, *, time: float | None = None) -> Reading:
        """Step the simulator that is shown, show the scene, and return the reading.

        Args:
            scene: What stands around the sensor.
            time: Of the scene [s]; shown as the number of the step where it is not given.

        Raises:
            TypeError: A sensor on a robot is shown; use :meth:`read`.
            SceneError, SolveError, ReadoutError: As for the simulator.
        """
        if not isinstance(self._sensor, Simulator):
            raise TypeError("this page shows a sensor on a robot; call read() in place of step()")
        reading = self._sensor.step(scene, time=time)
        shown = scene.scene() if isinstance(scene, DepthFrame) else scene
        self._put(float(self._count) if time is None else time, shown, reading)
        return reading

    def read(self, time: float | None = None) -> Reading:
        """Read the sensor, show what it sees with all of the robot, and return the reading.

        Args:
            time: Of the state [s]; by default the simulator's, or the number of the reading where
                that tells none.

        Raises:
            TypeError: A simulator by itself is shown; use :meth:`step`.
            SceneError, SolveError, ReadoutError: As for the sensor.
        """
        if isinstance(self._sensor, Simulator):
            raise TypeError("this page shows a simulator; call step(scene) in place of read()")
        view = self._sensor.view()
        reading = self._sensor.read(time, view)
        if time is None:
            try:
                time = self._sensor.time
            except SceneError:
                time = float(self._count)
        scene = view.scene() if isinstance(view, DepthFrame) else view
        self._put(time, scene, reading)
        return reading

    def _put(self, time: float, scene: Scene, reading: Reading) -> None:
        frame = Frame(self._count, time, scene, reading, around=self._around())
        self._stream.frames.put(frame)
        self._count += 1

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


def show(sensor: AttachedSensor | Simulator, *, host: str = "127.0.0.1", port: int = 8080) -> Show:
    """Show a sensor live in a browser: ``page = cs.show(sensor)``, then ``page.read()``.

    Args:
        sensor: Attached in MuJoCo, PyBullet or another simulator; or a simulator by itself, then
            ``page.step(scene, time=…)``.
        host: Address that the page is served at.
        port: Its port; 0 for any free one.

    Raises:
        TypeError: ``sensor`` is neither.
        ServerError: The address or port cannot be had.
        MissingDependencyError: The optional packages are not installed.
    """
    return Show(sensor, host=host, port=port)
