"""A page that shows a sensor, on a robot or by itself, as it is read."""

from __future__ import annotations

import queue
import threading
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self, cast, overload

import numpy as np
from numpy.typing import NDArray

from capsense.adapters import AttachedSensor, GeometrySensor
from capsense.adapters.skin import AttachedSkin
from capsense.adapters.world import Solid
from capsense.errors import SceneError
from capsense.reading import Reading, StepStats, Touch
from capsense.scenario.model import Excitation, channels_of
from capsense.scene import DepthFrame, Pose, Scene, Shape
from capsense.simulator import Simulator
from capsense.skin import Skin
from capsense.viewer.frame import SkinPart, SolidView
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
        robot: Corners of the box around the robot that carries it, in the sensor frame [m], shape
            (2, 3); None where there is none.
    """

    def __init__(self, simulator: Simulator, where: str, robot: Array | None) -> None:
        super().__init__(simulator.copy())
        self._robot = robot
        self.title, self.empty = self.design.name + where, simulator.empty
        self.channels = channels_of(Excitation.MATRIX, self.design.electrode_names)

    def stage(self, server: ViserServer) -> Any:
        from capsense.viewer.scene_drawing import SceneDrawing

        return SceneDrawing(server, self.design, robot=self._robot)


@dataclass(frozen=True, eq=False)
class SkinReading:
    """What charts show of a skin: the largest change of an electrode of each sensor."""

    electrode_names: tuple[str, ...]
    """Names of the sensors."""
    self_capacitance: Array
    """The changes [F], shape (s,)."""
    stats: StepStats
    """Of the worst sensor, and the time of all."""
    touch: Touch | None
    """For each sensor the force on its cover, and the largest compression."""

    @property
    def delta(self) -> Array:
        """The changes on the diagonal [F], shape (s, s)."""
        return np.diag(self.self_capacitance)


class SkinStream(_Fed):
    """What a skin reads, as it is put in.

    Args:
        simulators: Name → sensor.
        middles: Where they stand at first [m], shape (s, 3).
        robot: As of :class:`SensorStream`, in the frame of the world.
    """

    def __init__(
        self, simulators: Mapping[str, Simulator], middles: Array, robot: Array | None
    ) -> None:
        self._designs = {name: s.design for name, s in simulators.items()}
        super().__init__(next(iter(simulators.values())))
        self.green, self._middles, self._robot = None, middles, robot
        covers = [design.cover for design in self._designs.values() if design.cover is not None]
        self.cover = max(covers, key=lambda cover: cover.limit, default=None)
        self.title = f"skin of {len(simulators)} sensors"
        self.channels = channels_of(Excitation.SELF, list(simulators))
        nothing = {name: SkinPart(Pose(), np.zeros(1), None) for name in simulators}
        self.empty = self.reading(nothing, StepStats(0.0, 0.0))

    def reading(self, parts: Mapping[str, SkinPart], stats: StepStats) -> Reading:
        """What charts and tables show of the sensors."""
        largest = np.array([np.abs(part.changes).max() for part in parts.values()])
        touch = None
        if self.cover is not None:
            touched = [part.touch for part in parts.values()]
            force = np.array([0.0 if t is None else t.total for t in touched])
            depth = np.array([0.0 if t is None else t.compression.max() for t in touched])
            touch = Touch(force, depth, float(force.sum()))
        return cast("Reading", SkinReading(tuple(parts), largest, stats, touch))

    def stage(self, server: ViserServer) -> Any:
        from capsense.viewer.scene_drawing import SkinDrawing

        return SkinDrawing(server, self._designs, self._middles, self._robot)


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
        sensors: Those on the robot; they share one source of their world.
    """

    def __init__(self, sensors: Collection[GeometrySensor]) -> None:
        self._carriers = {sensor._carrier for sensor in sensors}
        self._source = next(iter(sensors)).source
        self._known: tuple[int, list[Solid]] = (-1, [])

    def now(self, view: Pose) -> tuple[SolidView, ...]:
        """The solids at present, in the frame that ``view`` takes the world's to."""
        return tuple(solid for _, solid in self._placed(view))

    def robot(self, view: Pose) -> Array | None:
        """Corners of the box around the robot [m], shape (2, 3); None where it has no solids."""
        own = set().union(*(self._source.robot(frame) for frame in self._carriers))
        ends = []
        for frame, (shape, pose, _) in self._placed(view):
            if frame in own:
                ends.append(pose.apply(shape.to_trimesh().vertices))
        points = np.concatenate(ends) if ends else None
        return None if points is None else np.stack([points.min(axis=0), points.max(axis=0)])

    def _placed(self, view: Pose) -> list[tuple[int, SolidView]]:
        """The frame that carries each solid, and the solid."""
        position, quaternion = self._source.links()
        if self._known[0] != self._source.version:
            self._known = self._source.version, self._source.solids(None)
        frames = [
            view @ Pose(tuple(p), tuple(q)) for p, q in zip(position, quaternion, strict=True)
        ]
        return [
            (solid.frame, SolidView(solid.shape, frames[solid.frame] @ solid.pose, solid.material))
            for solid in self._known[1]
            if isinstance(solid.shape, Shape)
        ]


class Show(_Page):
    """Reads a sensor and shows it on a page; see :func:`show`."""

    def __init__(self, sensor: AttachedSensor | Simulator, *, host: str, port: int) -> None:
        if not isinstance(sensor, AttachedSensor | Simulator):
            raise TypeError(
                f"sensor is of {type(sensor).__name__}; give a Simulator, or a sensor or skin that "
                "attach returned, or watch a scenario or a recording with capsense view"
            )
        self._sensor = sensor
        self._solids = _Solids([sensor]) if isinstance(sensor, GeometrySensor) else None
        if isinstance(sensor, Simulator):
            self._stream = SensorStream(sensor, "", None)
        else:
            self._stream = SensorStream(sensor.simulator, ", on a robot", self._robot(sensor))
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

    def _robot(self, sensor: AttachedSensor) -> Array | None:
        """Corners of the box around the robot in the sensor frame [m], where it is known."""
        try:
            return None if self._solids is None else self._solids.robot(sensor.pose.inverse())
        except SceneError:  # the first reading will raise it, too
            return None

    def _around(self) -> tuple[SolidView, ...]:
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
            self._solids = _Solids(skin.sensors.values())
        try:
            places = [pose.position for pose in skin.poses.values()]
            robot = None if self._solids is None else self._solids.robot(Pose())
        except SceneError:  # the first reading will raise it, too
            places, robot = [(0.0, 0.0, 0.0)], None
        self._stream = SkinStream(simulators, np.array(places), robot)
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
        around = tuple(SolidView(body.shape, body.pose, body.material) for body in scene)
        self._show(now, readings, around)
        return readings

    def _show(
        self, time: float, readings: Mapping[str, Reading], around: tuple[SolidView, ...]
    ) -> None:
        poses = self._skin.poses
        parts = {
            name: SkinPart(poses[name], np.abs(np.diag(r.delta)), r.touch)
            for name, r in readings.items()
        }
        stats = StepStats(
            max(r.stats.solver_error for r in readings.values()),
            sum(r.stats.wall_time for r in readings.values()),
        )
        reading = self._stream.reading(parts, stats)
        frame = Frame(self._count, time, Scene(), reading, around=around, skin=parts)
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
