"""CoppeliaSim as a sensor needs it: calls to its remote API, and orthographic vision sensors."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from capsense.adapters import refuse_missing
from capsense.adapters.rules import Image
from capsense.errors import AdapterError, SceneError, require_package
from capsense.scene import Pose
from capsense.scene.camera import OrthographicCamera

_FUNCTIONS = (
    "addItemToCollection", "createCollection", "createVisionSensor", "destroyCollection",
    "getObject", "getObjectAlias", "getObjectFloatParam", "getObjectInt32Param",
    "getObjectParent", "getObjectPose", "getObjectType", "getObjectsInTree",
    "getSimulationState", "getSimulationTime", "getVisionSensorDepth", "getVisionSensorImg",
    "handleVisionSensor", "isHandle", "removeObjects", "setObjectAlias", "setObjectInt32Param",
    "setObjectParent", "setObjectPose", "setShapeColor", "setStepping", "startSimulation",
    "step", "stopSimulation",
)  # fmt: skip
_CONSTANTS = (
    "colorcomponent_auxiliary", "handle_all", "handle_scene", "handle_single", "handle_world",
    "sceneobject_shape", "sceneobject_visionsensor", "simulation_stopped",
    "visionfloatparam_far_clipping", "visionfloatparam_near_clipping",
    "visionfloatparam_ortho_size", "visionintparam_entity_to_render",
    "visionintparam_perspective_operation",
    "visionintparam_render_mode", "visionintparam_resolution_x", "visionintparam_resolution_y",
)  # fmt: skip
OLDEST = "4.6"
"""The first CoppeliaSim that speaks the second version of the remote API's protocol."""
_FULL_PATH = 1
"""Option of ``sim.getObjectAlias``."""
NEAR = 1e-4
"""Near clipping plane of the sensors made here [m], the least that CoppeliaSim takes."""
_SLACK = 1e-5
"""What is not this much nearer than the far clipping plane, relative to that, is background: the
depth buffer and single precision round."""
_OPTIONS = 1 + 4 + 64 + 128
"""Of ``sim.createVisionSensor``: handled explicitly, frustum not shown, no fog, own background."""
_AUXILIARY_CHANNELS = 1
"""Render mode that draws the auxiliary colours of shapes as they are, without light."""
_CHILDREN = 1 + 2
"""Options of ``sim.getObjectsInTree``: not the object itself, and its own children alone."""
_ALIAS = "capsense"
"""Name of the vision sensors made here, and of their scripts."""
_LOOK = """sim = require 'sim'
function look(sensor, coloured)
  if sim.getSimulationState() == sim.simulation_stopped then return 0, 0, '', '', 0, 0 end
  local _, drawn = sim.handleVisionSensor(sensor)
  local depth, size = sim.getVisionSensorDepth(sensor, 1)
  local colours = ''
  if coloured then colours = sim.getVisionSensorImg(sensor) end
  return 1, #(drawn or {}), depth, colours, size[1], size[2]
end
"""
"""Script of a vision sensor made here: what :func:`look` asks for, in one remote call."""


class Remote:
    """CoppeliaSim's ``sim``, as far as a sensor needs it.

    Args:
        sim: What ``client.require("sim")`` returned.

    Raises:
        AdapterError: It lacks something that a sensor needs.
    """

    def __init__(self, sim: Any) -> None:
        missing = [n for n in (*_FUNCTIONS, *_CONSTANTS) if not hasattr(sim, n)]
        if "getObject" in missing or "getSimulationTime" in missing:
            raise AdapterError(
                f"sim is {sim!r}; give what capsense.coppeliasim.connect() or "
                'client.require("sim") returned'
            )
        if missing:
            raise AdapterError(
                f"this CoppeliaSim has no sim.{missing[0]}, which the sensor needs; it takes "
                f"CoppeliaSim {OLDEST} or later"
            )
        self.sim = sim

    def call(self, name: str, *arguments: Any) -> Any:
        """Call a function of ``sim``.

        Raises:
            AdapterError: It does not answer, or refuses.
        """
        try:
            return getattr(self.sim, name)(*arguments)
        except Exception as error:  # the client raises nothing finer for what the server refuses
            raise translated(f"sim.{name}", error) from error

    def constant(self, name: str) -> int:
        """A number that ``sim`` knows by name."""
        return int(getattr(self.sim, name))

    def path(self, handle: int) -> str:
        """The path of an object in the scene, such as ``/Robot/link/pad``."""
        return str(self.call("getObjectAlias", handle, _FULL_PATH))

    def find(self, thing: object) -> int:
        """The handle of an object, from its path or the handle itself.

        Raises:
            SceneError: There is no such object.
        """
        if isinstance(thing, str):
            handle = self.call("getObject", thing, {"noError": True})
            if handle < 0:
                every = self.call("getObjectsInTree", self.constant("handle_scene"))
                raise refuse_missing("object", thing, [self.path(h) for h in every])
            return int(handle)
        if isinstance(thing, bool) or not isinstance(thing, int):
            raise SceneError(f"object is {thing!r}; give a path such as '/Robot/link/pad'")
        if not self.call("isHandle", thing):
            raise SceneError(f"there is no object of handle {thing}; give a path or a handle")
        return thing

    def is_stopped(self) -> bool:
        """Whether the simulation is stopped."""
        return bool(self.call("getSimulationState") == self.constant("simulation_stopped"))


def connect(host: str = "localhost", port: int = 23000, timeout: float = 30.0) -> Any:
    """Connect to a running CoppeliaSim.

    Unlike with the client alone, which would wait for ever, every call fails where CoppeliaSim
    does not answer in time.

    Args:
        host: Where CoppeliaSim runs.
        port: Port of its ZeroMQ remote API server.
        timeout: How long a call may take [s], a simulation step included.

    Returns:
        CoppeliaSim's ``sim``.

    Raises:
        MissingDependencyError: The client is not installed.
        AdapterError: Nobody answers there, or in another version of the protocol.
    """
    require_package("coppeliasim_zmqremoteapi_client", "CoppeliaSim's client", "coppelia")
    import zmq
    from coppeliasim_zmqremoteapi_client import RemoteAPIClient

    if not timeout > 0:
        raise AdapterError(f"timeout is {timeout!r}; give seconds above zero")
    client = RemoteAPIClient(host, port)
    client.socket.setsockopt(zmq.LINGER, 0)
    for way in (zmq.SNDTIMEO, zmq.RCVTIMEO):
        client.socket.setsockopt(way, round(1000 * timeout))
    try:
        return client.require("sim")
    except zmq.Again:
        raise AdapterError(
            f"nobody answers at {host}:{port} within {timeout:g} s; start CoppeliaSim with its "
            "ZMQ remote API server, or give its host and port"
        ) from None
    except Exception as error:  # the client raises nothing finer
        raise translated('client.require("sim")', error) from error


def translated(what: str, error: Exception) -> AdapterError:
    """What the client raised at a call, as an error that names the fix."""
    import zmq

    if isinstance(error, zmq.Again):
        return AdapterError(
            f"CoppeliaSim did not answer {what} in time; is it still running? Connect again"
        )
    if isinstance(error, zmq.ZMQError):
        return AdapterError(
            f"the connection to CoppeliaSim is broken since a call failed ({what}: {error}); "
            "connect and attach again"
        )
    if isinstance(error, KeyError):  # the client misses the fields of its own protocol
        return AdapterError(
            f"CoppeliaSim answered {what} in another version of the remote API; it takes "
            f"CoppeliaSim {OLDEST} or later"
        )
    return AdapterError(f"{what}: {str(error).replace('_=NL=_', ' ').replace('_=TB=_', ' ')}")


def is_lost(error: AdapterError) -> bool:
    """Whether an error of a call means that there is no connection any more."""
    import zmq

    return isinstance(error.__cause__, zmq.ZMQError)


@dataclass(frozen=True)
class VisionSensor:
    """A vision sensor. Its frame is the sensor frame: z out of the sensor."""

    handle: int
    path: str
    camera: OrthographicCamera
    resolution: tuple[int, int]
    """Rows and columns."""
    script: int | None = None
    """The script that :func:`look` calls; None for several remote calls."""


class Seen(NamedTuple):
    """What a vision sensor sees."""

    running: bool
    """Whether the simulation runs; else there is nothing more."""
    drawn: bool = False
    """Whether anything was drawn, be it the background alone. A vision sensor that drew returns
    figures of its image; one that could not, for want of OpenGL or of its collection, none."""
    depth: bytes = b""
    """Depths [m], single precision, from the bottom row."""
    colours: bytes = b""
    """Red, green and blue, if they were asked for."""
    resolution: tuple[int, int] = (0, 0)
    """Rows and columns."""


def look(remote: Remote, vision_sensor: VisionSensor, coloured: bool) -> Seen:
    """Let a vision sensor look, in one remote call where it has a script."""
    handle = vision_sensor.handle
    if vision_sensor.script is not None:
        found = remote.call("callScriptFunction", "look", vision_sensor.script, handle, coloured)
        running, drawn, depth, colours, columns, rows = found
        resolution = int(rows), int(columns)
        return Seen(bool(running), drawn > 0, _binary(depth), _binary(colours), resolution)
    if remote.is_stopped():
        return Seen(False)
    figures = remote.call("handleVisionSensor", handle)
    drawn = not isinstance(figures, list | tuple) or len(figures) < 2 or len(figures[1]) > 0
    depth, (columns, rows) = remote.call("getVisionSensorDepth", handle, 1)
    colours = remote.call("getVisionSensorImg", handle)[0] if coloured else b""
    return Seen(True, drawn, depth, colours, (rows, columns))


def _binary(data: bytes | str) -> bytes:
    """Bytes of a Lua string, which arrives as text where it happens to be some."""
    return data.encode() if isinstance(data, str) else data


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
            remove_vision_sensor(remote, old)
    sizes = [NEAR, far, image.size, 0.01] + [0.0] * 7
    pixels = [image.resolution, image.resolution, 0, 0]
    vision_sensor = int(remote.call("createVisionSensor", _OPTIONS, pixels, sizes))
    remote.call("setObjectAlias", vision_sensor, _ALIAS)
    remote.call("setObjectParent", vision_sensor, handle, False)
    remote.call("setObjectPose", vision_sensor, [*pose.position, *pose.quaternion], handle)
    mode = remote.constant("visionintparam_render_mode")
    remote.call("setObjectInt32Param", vision_sensor, mode, _AUXILIARY_CHANNELS)
    show(remote, vision_sensor, seen)
    return replace(
        _read_vision_sensor(remote, vision_sensor), script=_script(remote, vision_sensor)
    )


def _script(remote: Remote, vision_sensor: int) -> int | None:
    """The script that :func:`look` calls; None where CoppeliaSim, before 4.7, makes none."""
    if not hasattr(remote.sim, "createScript"):
        return None
    try:
        kind = remote.constant("scripttype_customization")
        script = int(remote.call("createScript", kind, _LOOK, 0, "lua"))
        remote.call("setObjectAlias", script, _ALIAS)
        remote.call("setObjectParent", script, vision_sensor, False)
        remote.call("initScript", script)
    except (AdapterError, AttributeError):
        return None
    return script


def show(remote: Remote, vision_sensor: int, collection: int) -> None:
    """Let a vision sensor see what is in a collection."""
    entity = remote.constant("visionintparam_entity_to_render")
    remote.call("setObjectInt32Param", vision_sensor, entity, collection)


def carrier(remote: Remote, handle: int) -> int | None:
    """The shape that an object is or stands on, if any."""
    shape = remote.constant("sceneobject_shape")
    while handle >= 0 and remote.call("getObjectType", handle) != shape:
        handle = int(remote.call("getObjectParent", handle))
    return handle if handle >= 0 else None


def remove_vision_sensor(remote: Remote, vision_sensor: int) -> None:
    """Remove a vision sensor made here, and the collection of what it sees."""
    entity = remote.constant("visionintparam_entity_to_render")
    with suppress(AdapterError):  # CoppeliaSim drops collections of scripts that end
        remote.call("destroyCollection", remote.call("getObjectInt32Param", vision_sensor, entity))
    remote.call("removeObjects", remote.call("getObjectsInTree", vision_sensor))


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
