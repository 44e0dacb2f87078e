"""Orthographic vision sensors of CoppeliaSim: found, made, and read."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capsense.adapters.attached import DepthSensor, Image
from capsense.adapters.coppeliasim_calls import Remote
from capsense.adapters.rules import Rules
from capsense.errors import AdapterError, SceneError
from capsense.scene import Material, Pose
from capsense.scene.body import Grounding
from capsense.scene.camera import OrthographicCamera
from capsense.scene.depth import CONDUCTOR_CODE, DepthFrame, encode_permittivity
from capsense.simulator import Simulator

NEAR = 1e-4
"""Near clipping plane of the sensors made here [m], the least that CoppeliaSim takes."""
_SLACK = 1e-5
"""What is not this much nearer than the far clipping plane, relative to that, is background: the
depth buffer and single precision round."""
_OPTIONS = 1 + 4 + 64 + 128
"""Of ``sim.createVisionSensor``: handled explicitly, frustum not shown, no fog, own background."""
_AUXILIARY_CHANNELS = 1
"""Render mode that draws the auxiliary colours of shapes as they are, without light."""
_REMOVED = 1
"""Option of ``sim.addItemToCollection``."""
_CHILDREN = 1 + 2
"""Options of ``sim.getObjectsInTree``: not the object itself, and its own children alone."""
_ALIAS = "capsense"
"""Name of the vision sensors made here."""


@dataclass(frozen=True)
class VisionSensor:
    """A vision sensor. Its frame is the sensor frame: z out of the sensor."""

    handle: int
    path: str
    camera: OrthographicCamera
    resolution: tuple[int, int]
    """Rows and columns."""


class CoppeliaSensor(DepthSensor):
    """A sensor on an object in CoppeliaSim; made by :func:`capsense.adapters.coppeliasim.attach`.

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
        remote, handle = self._remote, self.vision_sensor.handle
        if remote.is_stopped():
            raise SceneError(
                "the simulation is not running; call sim.startSimulation() and sim.step(), or "
                "step in capsense.coppeliasim.running(sim)"
            )
        if self._paint is None:
            remote.call("handleVisionSensor", handle)
        elif not _draws(remote, handle):
            self._paint.collect(handle)  # CoppeliaSim drops collections of scripts that end
            if not _draws(remote, handle):
                raise AdapterError(
                    f"CoppeliaSim draws nothing for vision sensor {self.vision_sensor.path!r}; "
                    "builds and machines without OpenGL do not, nor does it while vision sensors "
                    "are disabled: start the usual build, on a machine without a display under "
                    "xvfb-run"
                )
        depth = self._image("getVisionSensorDepth", np.dtype("<f4"), 1, 1)
        seen: Any = self._material
        if seen is None:
            seen = self._image("getVisionSensorImg", np.dtype("u1"), 3)
        return DepthFrame(
            depth, seen, self.vision_sensor.camera, grounding=self._grounding, back=self._back
        )

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
            _remove_vision_sensor(self._remote, self.vision_sensor.handle)

    def _image(
        self, name: str, kind: np.dtype[Any], channels: int, *options: int
    ) -> NDArray[np.generic]:
        data, (columns, rows) = self._remote.call(name, self.vision_sensor.handle, *options)
        known = self.vision_sensor.resolution
        if (rows, columns) != known:
            raise SceneError(
                f"vision sensor {self.vision_sensor.path!r} now has {columns} x {rows} pixels, not "
                f"{known[1]} x {known[0]}; attach again"
            )
        if len(data) != rows * columns * channels * kind.itemsize:
            raise AdapterError(
                f"sim.{name} gave {len(data)} bytes for {columns} x {rows} pixels of "
                f"{channels * kind.itemsize} bytes"
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


def find_vision_sensor(remote: Remote, handle: int) -> VisionSensor | None:
    """The vision sensor that an object is, or carries; None where it has none.

    Those that :func:`make_vision_sensor` made for it earlier do not count.

    Raises:
        SceneError: It has several, or the one is in perspective.
    """
    if remote.call("getObjectType", handle) == remote.constant("sceneobject_visionsensor"):
        return _read_vision_sensor(remote, handle)
    found = [
        vision_sensor for vision_sensor, name in _children(remote, handle).items() if name != _ALIAS
    ]
    if len(found) > 1:
        paths = ", ".join(repr(remote.path(h)) for h in found)
        raise SceneError(
            f"{remote.path(handle)!r} carries {len(found)} vision sensors ({paths}); name one"
        )
    return _read_vision_sensor(remote, found[0]) if found else None


def make_vision_sensor(
    remote: Remote, handle: int, pose: Pose, image: Image, far: float, seen: int
) -> VisionSensor:
    """An orthographic vision sensor on an object, in the place of one made there earlier.

    Args:
        remote: The simulator.
        handle: The object.
        pose: The sensor frame in the object's frame.
        image: Size and pixels of its image.
        far: Depth up to which it sees [m].
        seen: Handle of the collection of what it sees.
    """
    for old, name in _children(remote, handle).items():
        if name == _ALIAS:
            _remove_vision_sensor(remote, old)
    sizes = [NEAR, far, image.size, 0.01] + [0.0] * 7
    pixels = [image.resolution, image.resolution, 0, 0]
    vision_sensor = int(remote.call("createVisionSensor", _OPTIONS, pixels, sizes))
    remote.call("setObjectAlias", vision_sensor, _ALIAS)
    remote.call("setObjectParent", vision_sensor, handle, False)
    remote.call("setObjectPose", vision_sensor, [*pose.position, *pose.quaternion], handle)
    mode = remote.constant("visionintparam_render_mode")
    remote.call("setObjectInt32Param", vision_sensor, mode, _AUXILIARY_CHANNELS)
    show(remote, vision_sensor, seen)
    return _read_vision_sensor(remote, vision_sensor)


def show(remote: Remote, vision_sensor: int, collection: int) -> None:
    """Let a vision sensor see what is in a collection."""
    entity = remote.constant("visionintparam_entity_to_render")
    remote.call("setObjectInt32Param", vision_sensor, entity, collection)


def _draws(remote: Remote, vision_sensor: int) -> bool:
    """Let a vision sensor look; whether anything was drawn, be it the background alone.

    A vision sensor that drew returns figures of its image, fifteen numbers; one that could not,
    for want of OpenGL or of its collection, returns none.
    """
    found = remote.call("handleVisionSensor", vision_sensor)
    return not isinstance(found, list | tuple) or len(found) < 2 or len(found[1]) > 0


def carrier(remote: Remote, handle: int) -> int | None:
    """The shape that an object is or stands on, if any."""
    shape = remote.constant("sceneobject_shape")
    while handle >= 0 and remote.call("getObjectType", handle) != shape:
        handle = int(remote.call("getObjectParent", handle))
    return handle if handle >= 0 else None


def _remove_vision_sensor(remote: Remote, vision_sensor: int) -> None:
    """Remove a vision sensor made here, and the collection of what it sees."""
    entity = remote.constant("visionintparam_entity_to_render")
    with suppress(AdapterError):  # CoppeliaSim drops collections of scripts that end
        remote.call("destroyCollection", remote.call("getObjectInt32Param", vision_sensor, entity))
    remote.call("removeObjects", [vision_sensor])


def _children(remote: Remote, handle: int) -> dict[int, str]:
    """The vision sensors that an object carries, and their names."""
    kind = remote.constant("sceneobject_visionsensor")
    found = remote.call("getObjectsInTree", handle, kind, _CHILDREN)
    return {
        int(vision_sensor): str(remote.call("getObjectAlias", vision_sensor))
        for vision_sensor in found
    }


def _read_vision_sensor(remote: Remote, handle: int) -> VisionSensor:
    def number(name: str) -> float:
        get = "getObjectInt32Param" if name.startswith("visionint") else "getObjectFloatParam"
        return float(remote.call(get, handle, remote.constant(name)))

    path = remote.path(handle)
    if number("visionintparam_perspective_operation"):
        raise SceneError(
            f"vision sensor {path!r} is in perspective; depth must come from parallel rays, so "
            "clear its perspective mode"
        )
    columns = int(number("visionintparam_resolution_x"))
    rows = int(number("visionintparam_resolution_y"))
    pixel = number("visionfloatparam_ortho_size") / max(columns, rows)
    # CoppeliaSim's camera looks along its frame's z, with y up and x to the left: its view matrix
    # is the frame's inverse turned half round about y. Rows are read from the bottom.
    camera = OrthographicCamera(
        columns * pixel, rows * pixel, Pose(),
        near=number("visionfloatparam_near_clipping"),
        far=number("visionfloatparam_far_clipping") * (1 - _SLACK),
        rows="+y", columns="-x",
    )  # fmt: skip
    return VisionSensor(handle, path, camera, (rows, columns))
