"""Sensors in CoppeliaSim: ``cs.coppeliasim.attach(sim, "/Robot/link/pad")``."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from capsense.adapters import DepthSensor, make_simulator
from capsense.adapters.coppeliasim_remote import (
    Remote,
    Seen,
    VisionSensor,
    carrier,
    connect,
    find_vision_sensor,
    is_lost,
    look,
    make_vision_sensor,
    remove_vision_sensor,
    show,
)
from capsense.adapters.rules import (
    DEFAULTS,
    Image,
    ImageOptions,
    Rules,
    SeenOptions,
    split_rules,
)
from capsense.design.model import Design
from capsense.errors import AdapterError, SceneError, warn_experimental
from capsense.readout import Readout
from capsense.readout.config import make_readout
from capsense.scene import Material, Pose
from capsense.scene.depth import CONDUCTOR_CODE, DepthFrame, encode_permittivity
from capsense.scene.materials import Grounding, checked_material
from capsense.scene.pose import checked_pose
from capsense.simulator import DEFAULT_DESIGN, Simulator

__all__ = ["CoppeliaOptions", "CoppeliaSensor", "attach", "connect", "running"]

_TRIES = 10
"""Steps after which a started simulation must be running."""
_REMOVED = 1
"""Option of ``sim.addItemToCollection``."""


@contextmanager
def running(sim: Any) -> Iterator[Callable[[], float]]:
    """Run the simulation step by step: ``with running(sim) as step: step(); sensor.read()``.

    CoppeliaSim waits between steps. A simulation that is stopped is started, and stopped at the
    end; one that runs already goes on afterwards.

    Args:
        sim: What :func:`connect` or ``client.require("sim")`` returned.

    Yields:
        A function that makes one step and returns the simulation time [s].

    Raises:
        AdapterError: CoppeliaSim does not answer, does not start, or was stopped by someone
            else.
    """
    remote = Remote(sim)
    remote.call("setStepping", True)
    ours = remote.is_stopped()
    if ours:
        _start(remote)

    def step() -> float:
        remote.call("step")
        if remote.is_stopped():
            raise AdapterError("the simulation was stopped from elsewhere; run it again")
        return float(remote.call("getSimulationTime"))

    def leave() -> None:
        if ours:
            remote.call("stopSimulation")
        remote.call("setStepping", False)

    try:
        yield step
    except BaseException:
        with suppress(AdapterError):  # what went wrong first is what matters
            leave()
        raise
    leave()


def _start(remote: Remote) -> None:
    remote.call("startSimulation")
    for _ in range(_TRIES):
        if not remote.is_stopped():
            return
        remote.call("step")
    raise AdapterError("the simulation does not start; look for messages in CoppeliaSim")


class CoppeliaOptions(SeenOptions, ImageOptions, total=False):
    """Keywords of :func:`attach`."""


def attach(
    sim: Any,
    object: int | str,
    design: Design | str | Path | Simulator = DEFAULT_DESIGN,
    *,
    pose_in_object: Pose | None = None,
    readout: Readout | str | Path | None = None,
    **options: Unpack[CoppeliaOptions],
) -> CoppeliaSensor:
    """Attach a sensor to an object; call ``read()`` after every step.

    It sees the depth image of an orthographic vision sensor, and by the red channel what that is
    made of; see :func:`~capsense.scene.depth.decode_permittivity`.

    Where the object neither is a vision sensor nor carries one as its child, one is made, in the
    render mode "auxiliary channels", which knows no light, and what materials say is written into
    the auxiliary colours of all shapes in the scene. Name patterns are tried on a shape's name and
    on its path, such as ``/Person/arm``. Permittivities of dielectrics are rounded to whole
    numbers. Shapes added later want :meth:`CoppeliaSensor.refresh`.

    A vision sensor of the scene's own is taken as it is, and so is the red channel of its image;
    ``default_material`` is then that of everything seen, instead of what the red channel says.
    ``default_grounding`` is that of all conductors, which are one body.

    Args:
        sim: What :func:`connect` or ``client.require("sim")`` returned.
        object: The object that carries the sensor, by its path or handle.
        design: A design, a packaged name, a design file, or a ready simulator, whose readout stays
            as it is.
        pose_in_object: The sensor frame in the object's frame, by default that frame itself:
            origin at the centre of the electrode plane, z out of the sensor. A vision sensor of
            the scene's own is itself the sensor frame.
        readout: A readout whose counts readings are to hold, a chip's name, or a file's; see
            :meth:`~capsense.adapters.AttachedSensor.read`. By default a copy of the simulator's, if
            it has one.
        options: What is seen and what it is made of: ``materials``, ``exclude`` and the others of
            :class:`~capsense.adapters.rules.SeenOptions`; ``size``, ``resolution`` and ``back`` of
            :class:`~capsense.adapters.rules.ImageOptions`.

    Raises:
        SceneError: There is no such object, a pattern fits nothing, its vision sensor is in
            perspective or of another resolution, or options do not go with that.
        AdapterError: CoppeliaSim does not answer, or is too old.
        DesignError: The design is wrong.
        ReadoutError: There is no such chip.
    """
    warn_experimental("the adapter of CoppeliaSim", "a stand-in with the same wire format")
    pose = Pose() if pose_in_object is None else checked_pose(pose_in_object, "pose_in_object")
    remote = Remote(sim)
    handle = remote.find(object)
    vision_sensor = find_vision_sensor(remote, handle)
    rules, other = split_rules(options, CoppeliaOptions)
    if vision_sensor is not None:
        _check_own(vision_sensor, {**options, "pose_in_object": pose_in_object})
    simulator = make_simulator(design)
    image = Image.of(other, simulator.design)
    chip = None if readout is None else make_readout(readout, simulator)
    material = checked_material(rules.default_material) if "default_material" in options else None
    paint = None
    if vision_sensor is None:  # all is checked: only now the scene is changed
        paint = Paint(remote, rules, carrier(remote, handle) if rules.exclude_own else None)
        far = float(simulator.design.domain.upper[2])
        vision_sensor = make_vision_sensor(remote, handle, pose, image, far, paint.collection)
        material = None  # the colours say it
    sensor = CoppeliaSensor(
        remote, vision_sensor, simulator, rules.default_grounding, image.back, paint, material
    )
    sensor.use_readout(sensor.readout if readout is None else chip)
    return sensor


def _check_own(vision_sensor: VisionSensor, options: Mapping[str, Any]) -> None:
    """Refuse what does not go with a vision sensor of the scene's own."""
    for name in ("materials", "exclude", "pose_in_object", "size", "exclude_own"):
        usual = DEFAULTS.get(name)
        if options.get(name, usual) not in (usual, None, (), []):
            raise SceneError(
                f"{name} goes with a vision sensor that attach makes, but {vision_sensor.path!r} "
                "is there; leave one of them out"
            )
    (rows, columns), resolution = vision_sensor.resolution, options.get("resolution")
    if resolution is not None and (rows, columns) != (resolution, resolution):
        raise SceneError(
            f"vision sensor {vision_sensor.path!r} has {columns} x {rows} pixels, not "
            f"{resolution} x {resolution}; leave resolution out, or set it there"
        )


class CoppeliaSensor(DepthSensor):
    """A sensor on an object in CoppeliaSim; made by :func:`attach`.

    Args:
        remote: The simulator.
        vision_sensor: What it sees with.
        simulator: The sensor itself.
        grounding: Of all conductors.
        back: Where what is seen ends.
        paint: What colours the world's shapes, if it was to be coloured.
        material: What everything is made of; None to tell by the red channel.
    """

    def __init__(
        self,
        remote: Remote,
        vision_sensor: VisionSensor,
        simulator: Simulator,
        grounding: Grounding,
        back: str | float,
        paint: Paint | None,
        material: Material | None,
    ) -> None:
        super().__init__(simulator)
        self.vision_sensor = vision_sensor
        """The vision sensor it sees with."""
        self._remote, self._paint = remote, paint
        self._grounding, self._back, self._material = grounding, back, material

    def _time(self) -> float:
        return float(self._remote.call("getSimulationTime"))

    @property
    def pose(self) -> Pose:
        world = self._remote.constant("handle_world")
        numbers = self._remote.call("getObjectPose", self.vision_sensor.handle, world)
        return Pose(numbers[:3], numbers[3:])

    def frame(self) -> DepthFrame:
        """The depth image of the present state.

        Raises:
            SceneError: The simulation is not running, or the vision sensor was changed.
            AdapterError: CoppeliaSim does not answer, or draws nothing.
        """
        seen = self._look()
        if not seen.running:
            raise SceneError(
                "the simulation is not running; call sim.startSimulation() and sim.step(), or "
                "step in capsense.coppeliasim.running(sim)"
            )
        if self._paint is not None and not seen.drawn:
            self._paint.collect(self.vision_sensor.handle)  # CoppeliaSim drops collections of
            seen = self._look()  # scripts that end
            if not seen.drawn:
                raise AdapterError(
                    f"CoppeliaSim draws nothing for vision sensor {self.vision_sensor.path!r}; "
                    "builds and machines without OpenGL do not, nor does it while vision sensors "
                    "are disabled: start the usual build, on a machine without a display under "
                    "xvfb-run"
                )
        depth = self._image(seen, seen.depth, np.dtype("<f4"), 1)
        matter: Any = self._material
        if matter is None:
            matter = self._image(seen, seen.colours, np.dtype("u1"), 3)
        return DepthFrame(
            depth, matter, self.vision_sensor.camera, grounding=self._grounding, back=self._back
        )

    def _look(self) -> Seen:
        """What the vision sensor sees; by several calls from now on where its script fails."""
        coloured = self._material is None
        if self.vision_sensor.script is not None:
            try:
                return look(self._remote, self.vision_sensor, coloured)
            except AdapterError as error:
                if is_lost(error):
                    raise
                self.vision_sensor = replace(self.vision_sensor, script=None)
        return look(self._remote, self.vision_sensor, coloured)

    def refresh(self) -> None:
        """Colour the world's shapes again, and collect anew which are seen, after some were added.

        Raises:
            SceneError: A name pattern fits nothing.
            AdapterError: CoppeliaSim does not answer.
        """
        if self._paint is not None:
            self._paint.collect(self.vision_sensor.handle)

    def remove(self) -> None:
        """Take the vision sensor that was made for this one out of the scene again.

        Raises:
            AdapterError: CoppeliaSim does not answer, or it is gone already.
        """
        if self._paint is not None:
            remove_vision_sensor(self._remote, self.vision_sensor.handle)

    def _image(
        self, seen: Seen, data: bytes, kind: np.dtype[Any], channels: int
    ) -> NDArray[np.generic]:
        (rows, columns), known = seen.resolution, self.vision_sensor.resolution
        if seen.resolution != known:
            raise SceneError(
                f"vision sensor {self.vision_sensor.path!r} now has {columns} x {rows} pixels, not "
                f"{known[1]} x {known[0]}; attach again"
            )
        if len(data) != rows * columns * channels * kind.itemsize:
            raise AdapterError(
                f"vision sensor {self.vision_sensor.path!r} gave {len(data)} bytes for "
                f"{columns} x {rows} pixels of {channels * kind.itemsize} bytes"
            )
        image = np.frombuffer(data, kind)
        return image.reshape((rows, columns, channels)[: 3 if channels > 1 else 2])


class Paint:
    """Writes into the auxiliary colours of all shapes what they are made of.

    The red channel holds :func:`~capsense.scene.depth.encode_permittivity`.

    Raises:
        SceneError: A name pattern fits nothing, or there is no code for a permittivity.

    Args:
        remote: The simulator.
        rules: What shapes are made of, and which are not seen; patterns are tried on a shape's
            name and on its path.
        own: A shape that is not seen, if any.
    """

    def __init__(self, remote: Remote, rules: Rules, own: int | None) -> None:
        self._remote, self._rules = remote, rules
        self._own = own
        self.collection = self._paint(self._shapes())
        """Handle of the collection of what is seen."""

    def collect(self, vision_sensor: int) -> None:
        """Colour the shapes that there are now, and show them to a vision sensor.

        Raises:
            SceneError: A name pattern fits nothing.
        """
        shapes = self._shapes()  # refuses wrong patterns before the scene is changed
        with suppress(AdapterError):  # it may be gone already
            self._remote.call("destroyCollection", self.collection)
        self.collection = self._paint(shapes)
        show(self._remote, vision_sensor, self.collection)

    def _shapes(self) -> dict[int, tuple[tuple[str, str], float]]:
        """Names and code, from 0 to 1, of every shape in the scene.

        Raises:
            SceneError: A name pattern fits nothing, or there is no code for a permittivity.
        """
        remote, rules = self._remote, self._rules
        scene, kind = remote.constant("handle_scene"), remote.constant("sceneobject_shape")
        shapes = remote.call("getObjectsInTree", scene, kind)
        called = {int(h): (str(remote.call("getObjectAlias", h)), remote.path(h)) for h in shapes}
        rules.check(list(called.values()))
        out = {}
        for handle, names in called.items():
            matter = rules.material_of(names)
            code = encode_permittivity(np.inf if matter.is_conductor() else matter.eps_r)
            out[handle] = names, int(code) / CONDUCTOR_CODE
        return out

    def _paint(self, shapes: dict[int, tuple[tuple[str, str], float]]) -> int:
        """Colour shapes; returns a new collection of those that are seen."""
        remote = self._remote
        component = remote.constant("colorcomponent_auxiliary")
        single, every = remote.constant("handle_single"), remote.constant("handle_all")
        collection = int(remote.call("createCollection", 0))
        remote.call("addItemToCollection", collection, every, -1, 0)
        for handle, (names, red) in shapes.items():
            if handle == self._own or self._rules.excludes(names):
                remote.call("addItemToCollection", collection, single, handle, _REMOVED)
            remote.call("setShapeColor", handle, None, component, [red, 0.0, 0.0])
        return collection
