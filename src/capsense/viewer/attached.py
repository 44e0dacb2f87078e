"""A page that shows a sensor, on a robot or by itself, as it is read."""

from __future__ import annotations

import queue
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self, cast, overload

import numpy as np
from numpy.typing import NDArray

from capsense.adapters import AttachedSensor, GeometrySensor, WorldSource
from capsense.adapters.skin import AttachedSkin
from capsense.adapters.world import Solid
from capsense.errors import SceneError
from capsense.reading import Reading, StepStats
from capsense.scenario.model import Excitation, channels_of
from capsense.scene import DepthFrame, Pose, Scene, Shape
from capsense.simulator import Simulator
from capsense.skin import Skin
from capsense.viewer.player import Follower
from capsense.viewer.source import Frame, Stream

if TYPE_CHECKING:
    from viser import ViserServer

Array = NDArray[np.float64]


class _Fed(Stream):
    """Instants that are put in.

    Args:
        simulator: Potentials come from it.
    """

    def __init__(self, simulator: Simulator) -> None:
        super().__init__(simulator)
        self.frames: queue.Queue[Frame] = queue.Queue()
        """Where they are put in."""

    def next(self, timeout: float) -> Frame | None:
        try:
            return self.frames.get(timeout=timeout)
        except queue.Empty:
            return None


class SensorStream(_Fed):
    """What a sensor reads, as it is put in.

    Args:
        simulator: Of the sensor; potentials come from a copy.
        where: Says where the sensor is, for the title.
    """

    def __init__(self, simulator: Simulator, where: str) -> None:
        super().__init__(simulator.copy())
        self.title, self.empty = self.design.name + where, simulator.empty
        self.channels = channels_of(Excitation.MATRIX, self.design.electrode_names)


@dataclass(frozen=True, eq=False)
class SkinReading:
    """What charts show of a skin: the largest change of an electrode of each sensor."""

    electrode_names: tuple[str, ...]
    """Names of the sensors."""
    self_capacitance: Array
    """The changes [F], shape (s,)."""
    stats: StepStats
    """Of the worst sensor, and the time of all."""
    touch: None = None

    @property
    def delta(self) -> Array:
        """The changes on the diagonal [F], shape (s, s)."""
        return np.diag(self.self_capacitance)


class SkinStream(_Fed):
    """What a skin reads, as it is put in.

    Args:
        simulators: Name → sensor.
        middles: Where they stand at first [m], shape (s, 3).
    """

    def __init__(self, simulators: Mapping[str, Simulator], middles: Array) -> None:
        self._designs = {name: s.design for name, s in simulators.items()}
        super().__init__(next(iter(simulators.values())))
        self.green, self._middles = None, middles
        self.title = f"skin of {len(simulators)} sensors"
        self.channels = channels_of(Excitation.SELF, list(simulators))
        self.empty = self.reading({name: np.zeros(1) for name in simulators}, StepStats(0.0, 0.0))

    def reading(self, changes: Mapping[str, Array], stats: StepStats) -> Reading:
        """What charts show of changes of electrodes' own capacitances [F]."""
        largest = np.array([np.abs(own).max() for own in changes.values()])
        return cast("Reading", SkinReading(tuple(changes), largest, stats))

    def stage(self, server: ViserServer) -> Any:
        from capsense.viewer.scene_drawing import SkinDrawing

        return SkinDrawing(server, self._designs, self._middles)


class _Page:
    """A page that is served until it is closed.

    Args:
        stream: What it shows.
        host: Address that the page is served at.
        port: Its port.
    """

    def __init__(self, stream: Stream, host: str, port: int) -> None:
        self.player = Follower(stream)
        """Takes in the samples."""
        self._count = 0
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

    def close(self) -> None:
        """Close the page."""
        self._stop.set()
        self._thread.join()
        self.view.stop()
        self.player.stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Solids:
    """All solids of a robot's simulator.

    Args:
        source: Where they come from.
    """

    def __init__(self, source: WorldSource) -> None:
        self._source = source
        self._known: tuple[int, list[Solid]] = (-1, [])

    def now(self, view: Pose) -> tuple[tuple[Shape, Pose], ...]:
        """The solids at present, in the frame that ``view`` takes the world's to."""
        position, quaternion = self._source.links()
        if self._known[0] != self._source.version:
            self._known = self._source.version, self._source.solids(None)
        frames = [
            view @ Pose(tuple(p), tuple(q)) for p, q in zip(position, quaternion, strict=True)
        ]
        return tuple(
            (solid.shape, frames[solid.frame] @ solid.pose)
            for solid in self._known[1]
            if isinstance(solid.shape, Shape)
        )


class Show(_Page):
    """Reads a sensor and shows it on a page; see :func:`show`."""

    def __init__(self, sensor: AttachedSensor | Simulator, *, host: str, port: int) -> None:
        if not isinstance(sensor, AttachedSensor | Simulator):
            raise TypeError(
                f"sensor is of {type(sensor).__name__}; give a Simulator, or a sensor or skin that "
                "attach returned, or watch a scenario or a recording with capsense view"
            )
        self._sensor = sensor
        self._stream = (
            SensorStream(sensor, "")
            if isinstance(sensor, Simulator)
            else SensorStream(sensor.simulator, ", on a robot")
        )
        self._solids = _Solids(sensor.source) if isinstance(sensor, GeometrySensor) else None
        super().__init__(self._stream, host, port)

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
        if self._solids is None or isinstance(self._sensor, Simulator):
            return ()
        return self._solids.now(self._sensor.pose.inverse())


class SkinShow(_Page):
    """Reads a skin and shows all of it on a page; see :func:`show`."""

    def __init__(self, skin: Skin | AttachedSkin, *, host: str, port: int) -> None:
        self._skin = skin
        if isinstance(skin, Skin):
            simulators, self._solids = skin.simulators, None
        else:
            simulators = {name: sensor.simulator for name, sensor in skin.sensors.items()}
            self._solids = _Solids(next(iter(skin.sensors.values())).source)
        try:
            places = [pose.position for pose in skin.poses.values()]
        except SceneError:  # the first reading will raise it, too
            places = [(0.0, 0.0, 0.0)]
        self._stream = SkinStream(simulators, np.array(places))
        super().__init__(self._stream, host, port)

    def read(self, time: float | None = None) -> dict[str, Reading]:
        """Read the attached skin, show it with all of the robot, and return the readings.

        Args:
            time: Of the state [s]; by default the simulator's, or the number of the reading where
                that tells none.

        Raises:
            TypeError: The skin is on no robot.
            SceneError, SkinError: As for the skin.
        """
        skin = self._skin
        if isinstance(skin, Skin) or self._solids is None:
            raise TypeError("this skin is on no robot; write step(scene, poses)")
        readings = skin.read(time)
        if time is None:
            try:
                time = next(iter(skin.sensors.values())).time
            except SceneError:
                time = float(self._count)
        self._show(time, readings, self._solids.now(Pose()))
        return readings

    def step(
        self,
        scene: Scene,
        poses: Mapping[str, Pose] | None = None,
        *,
        time: float | None = None,
    ) -> dict[str, Reading]:
        """Read a skin on no robot, show it with the scene, and return the readings.

        Args:
            scene: As of :meth:`Skin.step`.
            poses: As of :meth:`Skin.step`.
            time: Of the scene [s]; by default the number of the reading.

        Raises:
            TypeError: The skin is on a robot, or ``scene`` is none.
            SceneError, SkinError: As for the skin.
        """
        skin = self._skin
        if not isinstance(skin, Skin):
            raise TypeError("this skin is attached to a robot; write read()")
        readings = skin.step(scene, poses, time=time)
        now = float(self._count) if time is None else time
        self._show(now, readings, tuple((body.shape, body.pose) for body in scene))
        return readings

    def _show(
        self,
        time: float,
        readings: Mapping[str, Reading],
        around: tuple[tuple[Shape, Pose], ...],
    ) -> None:
        own = {name: np.abs(np.diag(r.delta)) for name, r in readings.items()}
        stats = StepStats(
            max(r.stats.solver_error for r in readings.values()),
            sum(r.stats.wall_time for r in readings.values()),
        )
        poses = self._skin.poses
        frame = Frame(
            self._count, time, Scene(), self._stream.reading(own, stats), around=around,
            skin={name: (poses[name], own[name]) for name in own},
        )  # fmt: skip
        self._stream.frames.put(frame)
        self._count += 1


@overload
def show(sensor: AttachedSensor | Simulator, *, host: str = ..., port: int = ...) -> Show: ...


@overload
def show(sensor: Skin | AttachedSkin, *, host: str = ..., port: int = ...) -> SkinShow: ...


def show(
    sensor: AttachedSensor | Simulator | Skin | AttachedSkin,
    *,
    host: str = "127.0.0.1",
    port: int = 8080,
) -> Show | SkinShow:
    """Show a sensor live in a browser: ``page = cs.show(sensor)``, then ``page.read()``.

    Args:
        sensor: Attached in MuJoCo, PyBullet or another simulator; or a skin, of which all sensors
            are shown with the robot. A simulator by itself, and a skin on no robot, are shown by
            ``page.step(scene, time=…)``.
        host: Address that the page is served at.
        port: Its port; 0 for any free one.

    Raises:
        TypeError: ``sensor`` is none of these.
        ServerError: The address or port cannot be had.
        MissingDependencyError: The optional packages are not installed.
    """
    if isinstance(sensor, Skin | AttachedSkin):
        return SkinShow(sensor, host=host, port=port)
    return Show(sensor, host=host, port=port)
