"""A stand-in for CoppeliaSim: its ZeroMQ remote API in front of a little scene.

It speaks the wire format of the second version of the protocol (CBOR maps over a REP socket) as
the server script of the simulator does (CoppeliaRobotics/zmqRemoteApi, ``addOns/ZMQ remote API
server.lua``), and draws vision sensors as the simulator's OpenGL renderer does
(CoppeliaRobotics/coppeliaSimLib, ``visionSensor.cpp``): the camera is the sensor's frame turned
half round about y, images are read from the bottom row. It was written from those sources, not
checked against the simulator.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import cbor2
import numpy as np
import trimesh
import zmq

import capsense as cs

SHAPE, DUMMY, VISION, SCRIPT = 0, 4, 9, 14
TIME_STEP = 0.05
UNPAINTED = (0.5, 0.25, 0.0)
CONSTANTS = {
    "colorcomponent_auxiliary": 5, "handle_all": -2, "handle_scene": -12, "handle_single": -4,
    "handle_world": -1, "primitiveshape_cuboid": 3, "sceneobject_shape": SHAPE,
    "scripttype_customization": 6,
    "shapeintparam_static": 3003, "sceneobject_visionsensor": VISION,
    "simulation_stopped": 0, "visionfloatparam_far_clipping": 1001,
    "visionfloatparam_near_clipping": 1000, "visionfloatparam_ortho_size": 1005,
    "visionintparam_entity_to_render": 1008, "visionintparam_perspective_operation": 1018,
    "visionintparam_render_mode": 1017, "visionintparam_resolution_x": 1002,
    "visionintparam_resolution_y": 1003,
}  # fmt: skip
_NAMES = {v: k for k, v in CONSTANTS.items() if k.startswith("vision")}
_CAMERA = np.diag([-1.0, 1.0, -1.0])
"""From a vision sensor's frame to that of OpenGL's camera."""


@dataclass
class Thing:
    """An object in the scene."""

    alias: str
    kind: int
    parent: int = -1
    local: cs.Pose = field(default_factory=cs.Pose)
    mesh: trimesh.Trimesh | None = None
    colour: tuple[float, float, float] = UNPAINTED
    """The auxiliary colour."""
    parameters: dict[str, float] = field(default_factory=dict)
    depth: bytes = b""
    image: bytes = b""
    code: str = ""


class RefusedError(Exception):
    """What the simulator answers with ``err``."""


class StandIn:
    """A CoppeliaSim with a scene of its own, serving in a thread.

    Args:
        without: Names that its ``sim`` lacks, as an older one would.
        protocol: 2, or 1 for answers as older servers give them.
    """

    def __init__(self, without: tuple[str, ...] = (), protocol: int = 2) -> None:
        self.things: dict[int, Thing] = {}
        self.collections: dict[int, set[int]] = {}
        """Handle → what is left out of it."""
        self.running = False
        self.time = 0.0
        self.starts_late = 0
        """Steps that pass until a start takes effect."""
        self.headless = False
        """Whether it draws nothing, as builds without OpenGL."""
        self.stepping = False
        self.script_fails = False
        """Whether functions of scripts cannot be called."""
        self.mirrored = False
        """Whether images come with the top row first, as they should not."""
        self.on_step: Callable[[float], None] = lambda time: None
        self.calls: list[str] = []
        self._without, self._protocol = without, protocol
        self._count = iter(range(15, 10_000))
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.REP)
        self._socket.linger = 0
        self.port = self._socket.bind_to_random_port("tcp://127.0.0.1")
        self._end = False
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Vanish, as a simulator that crashed."""
        if not self._end:
            self._end = True
            self._thread.join()
            self._socket.close()
            self._context.term()

    # -- the scene ---------------------------------------------------------------------------

    def add(self, alias: str, shape: Any = None, local: cs.Pose | None = None, on: int = -1) -> int:
        """Add a shape, or a dummy, and return its handle."""
        handle = next(self._count)
        kind, mesh = (DUMMY, None) if shape is None else (SHAPE, mesh_of(shape))
        self.things[handle] = Thing(alias, kind, on, local or cs.Pose(), mesh)
        return handle

    def add_vision(self, alias: str, on: int = -1, **parameters: float) -> int:
        """Add a vision sensor of the scene's own, 64 x 64 pixels of a 0.1 m wide view."""
        handle = self.createVisionSensor(0, [64, 64, 0, 0], [1e-3, 0.1, 0.1, 0.01] + [0.0] * 7)
        thing = self.things[handle]
        thing.alias, thing.parent = alias, on
        thing.parameters |= parameters
        return handle

    def pose(self, handle: int) -> cs.Pose:
        """Where an object stands in the world."""
        thing = self._thing(handle)
        return thing.local if thing.parent < 0 else self.pose(thing.parent) @ thing.local

    def _thing(self, handle: int) -> Thing:
        if handle not in self.things:
            raise RefusedError("Object does not exist.")
        return self.things[handle]

    def _draw(self, camera: Thing, place: cs.Pose) -> None:
        """Depth from 0 to 1 and colours, from the bottom row, as OpenGL has them."""
        get = camera.parameters
        columns, rows = int(get["resolution_x"]), int(get["resolution_y"])
        near, far = get["near_clipping"], get["far_clipping"]
        pixel = get["ortho_size"] / max(columns, rows)
        hidden = self.collections.get(int(get["entity_to_render"]), set())
        depth, image = np.ones((rows, columns)), np.zeros((rows, columns, 3), np.uint8)
        for handle, thing in self.things.items():
            if thing.mesh is None or handle in hidden:
                continue
            local = place.inverse() @ self.pose(handle)
            seen = local.apply(thing.mesh.vertices) @ _CAMERA
            # depth grows along the camera's -z: mirrored, so faces turn round
            view = cs.render_depth(
                seen * (1, 1, -1), thing.mesh.faces[:, ::-1], (columns * pixel, rows * pixel),
                (rows, columns),
            )  # fmt: skip
            faces = np.concatenate([view.front, view.back])  # from inside, too: nothing is culled
            d = (np.where(faces > near, faces, np.inf).min(axis=0, initial=np.inf) - near) / (
                far - near
            )
            closer = d < depth
            depth[closer] = d[closer]
            if get["render_mode"] == 1:
                image[closer] = np.rint(np.multiply(thing.colour, 255))
            else:  # with light, as seen from the front
                image[closer] = 200
        if self.mirrored:
            depth, image = depth[::-1], image[::-1]
        metres = near + depth.astype(np.float32) * np.float32(far - near)
        camera.depth, camera.image = metres.astype("<f4").tobytes(), image.tobytes()

    # -- the wire ----------------------------------------------------------------------------

    def _serve(self) -> None:
        while not self._end:
            if not self._socket.poll(20):
                continue
            request = cbor2.loads(self._socket.recv())
            self._socket.send(cbor2.dumps(self._answer(request)))

    def _answer(self, request: dict[str, Any]) -> dict[str, Any]:
        name, arguments = request["func"], request["args"]
        assert request["uuid"]
        assert request["argsL"] == len(arguments)
        if self._protocol == 1:
            return {"success": False, "error": f"No such function: {name}"}
        if name == "sim.step":  # the client waits, and asks again until the step is made
            return {"func": "_*wait*_", "args": []}
        if name == "_*executed*_":
            return {"ret": self._step()}
        self.calls.append(name)
        try:
            if name == "zmqRemoteApi.require":
                assert request["ver"] == 2
                return {"ret": []}
            if name == "zmqRemoteApi.info":
                return {"ret": [dict(self._info())]}
            result = getattr(self, name.removeprefix("sim."))(*arguments)
        except RefusedError as refusal:
            return {"err": f"{refusal}_=NL=_(in function '{name}')"}
        if result is None:
            return {"ret": []}
        return {"ret": list(result) if isinstance(result, tuple) else [result]}

    def _info(self) -> Iterator[tuple[str, dict[str, Any]]]:
        for name, value in CONSTANTS.items():
            if name not in self._without:
                yield name, {"const": value}
        functions = [n for n in dir(self) if n != n.lower() and n[0] != "_"]
        for name in [*functions, "step"]:
            if name not in self._without:
                yield name, {"func": {}}

    def _step(self) -> list[Any]:
        if self.starts_late:
            self.starts_late -= 1
            self.running = not self.starts_late
        elif self.running:
            self.time += TIME_STEP
            self.on_step(self.time)
        return []

    # -- functions of sim ----------------------------------------------------------------------

    def setStepping(self, on: bool) -> None:
        self.stepping = on

    def startSimulation(self) -> None:
        self.running = not self.starts_late
        self.time = 0.0

    def stopSimulation(self) -> None:
        self.running, self.stepping = False, False

    def getSimulationState(self) -> int:
        return 17 if self.running else 0

    def getSimulationTime(self) -> float:
        return self.time

    def getObject(self, path: str, options: dict[str, Any] | None = None) -> int:
        for handle in self.things:
            if self.getObjectAlias(handle, 1) == path:
                return handle
        if options and options.get("noError"):
            return -1
        raise RefusedError("Object does not exist.")

    def getObjectAlias(self, handle: int, options: int = 0) -> str:
        thing = self._thing(handle)
        if options == 0:
            return thing.alias
        above = "" if thing.parent < 0 else self.getObjectAlias(thing.parent, 1)
        return f"{above}/{thing.alias}"

    def getObjectsInTree(self, base: int, kind: int = -2, options: int = 0) -> list[int]:
        assert options in (0, 3)
        return [
            h
            for h, t in self.things.items()
            if kind in (t.kind, -2)
            and (
                base == CONSTANTS["handle_scene"] or t.parent == base or (h == base and not options)
            )
        ]

    def getObjectType(self, handle: int) -> int:
        return self._thing(handle).kind

    def getObjectParent(self, handle: int) -> int:
        return self._thing(handle).parent

    def isHandle(self, handle: int) -> bool:
        return handle in self.things

    def removeObjects(self, handles: list[int]) -> None:
        for handle in handles:
            self._thing(handle)
            del self.things[handle]

    def setObjectAlias(self, handle: int, alias: str) -> None:
        self._thing(handle).alias = alias

    def setObjectParent(self, handle: int, parent: int, keep_in_place: bool) -> None:
        assert not keep_in_place
        self._thing(handle).parent = parent

    def setObjectPose(self, handle: int, pose: list[float], relative_to: int) -> None:
        thing = self._thing(handle)
        assert relative_to == thing.parent  # -1 is the world
        thing.local = cs.Pose(pose[:3], pose[3:])

    def getObjectPose(self, handle: int, relative_to: int) -> list[float]:
        assert relative_to == CONSTANTS["handle_world"]
        pose = self.pose(handle)
        return [*pose.position, *pose.quaternion]

    def createCollection(self, options: int) -> int:
        handle = next(self._count)
        self.collections[handle] = set()
        return handle

    def destroyCollection(self, collection: int) -> None:
        if collection not in self.collections:
            raise RefusedError("Collection does not exist.")
        del self.collections[collection]

    def addItemToCollection(self, collection: int, what: int, handle: int, options: int) -> None:
        if what == CONSTANTS["handle_all"]:
            assert (handle, options) == (-1, 0)
        else:
            assert (what, options) == (CONSTANTS["handle_single"], 1)
            self.collections[collection].add(handle)

    def setShapeColor(self, handle: int, name: None, component: int, rgb: list[float]) -> None:
        assert name is None
        assert component == CONSTANTS["colorcomponent_auxiliary"]
        self._thing(handle).colour = tuple(rgb)  # type: ignore[assignment]

    def createDummy(self, size: float) -> int:
        return self.add("Dummy")

    def createPrimitiveShape(self, kind: int, sizes: list[float], options: int) -> int:
        assert (kind, options) == (CONSTANTS["primitiveshape_cuboid"], 0)
        return self.add("Cuboid", cs.Box(tuple(sizes)))

    def createVisionSensor(self, options: int, whole: list[int], real: list[float]) -> int:
        assert (len(whole), len(real)) == (4, 11)
        handle = next(self._count)
        thing = self.things[handle] = Thing("visionSensor", VISION)
        thing.parameters = {
            "resolution_x": whole[0], "resolution_y": whole[1], "near_clipping": real[0],
            "far_clipping": real[1], "ortho_size": real[2], "render_mode": 0,
            "perspective_operation": options >> 1 & 1, "entity_to_render": -1,
        }  # fmt: skip
        return handle

    def createScript(self, kind: int, code: str, options: int, lang: str) -> int:
        assert (kind, options, lang) == (CONSTANTS["scripttype_customization"], 0, "lua")
        handle = next(self._count)
        self.things[handle] = Thing("Script", SCRIPT, code=code)
        return handle

    def initScript(self, script: int) -> None:
        assert self._thing(script).kind == SCRIPT

    def callScriptFunction(self, name: str, script: int, *arguments: Any) -> tuple[Any, ...]:
        """Does what the Lua code of the adapter does."""
        sensor, coloured = arguments
        if self.script_fails:
            raise RefusedError("Failed calling script function.")
        assert f"function {name}(sensor, coloured)" in self._thing(script).code
        if not self.running:
            return 0, 0, "", "", 0, 0
        _, drawn, _ = self.handleVisionSensor(sensor)
        depth, size = self.getVisionSensorDepth(sensor, 1)
        colours = self.getVisionSensorImg(sensor)[0] if coloured else ""
        return 1, len(drawn), depth, colours, *size

    def getObjectInt32Param(self, handle: int, which: int) -> int:
        return int(self.getObjectFloatParam(handle, which))

    def getObjectFloatParam(self, handle: int, which: int) -> float:
        return float(self._thing(handle).parameters[_NAMES[which].partition("param_")[2]])

    def setObjectInt32Param(self, handle: int, which: int, value: int) -> None:
        if which != CONSTANTS["shapeintparam_static"]:
            self._thing(handle).parameters[_NAMES[which].partition("param_")[2]] = value

    def handleVisionSensor(self, handle: int) -> tuple[int, list[float], list[float]]:
        camera = self._thing(handle)
        seen = int(camera.parameters["entity_to_render"])
        if self.headless or (seen >= 0 and seen not in self.collections):
            return 0, [], []  # two packets at least, even if empty
        self._draw(camera, self.pose(handle))
        return 0, [0.0] * 15, []

    def getVisionSensorDepth(self, handle: int, options: int) -> tuple[bytes, list[int]]:
        assert options == 1  # metres
        thing = self._thing(handle)
        return thing.depth, self._size(thing)

    def getVisionSensorImg(self, handle: int) -> tuple[bytes, list[int]]:
        thing = self._thing(handle)
        return thing.image, self._size(thing)

    def _size(self, thing: Thing) -> list[int]:
        return [int(thing.parameters[f"resolution_{k}"]) for k in "xy"]


def mesh_of(shape: Any) -> trimesh.Trimesh:
    """The triangles of a shape, closed."""
    match shape:
        case cs.Box():
            return trimesh.creation.box(shape.size)
        case cs.Sphere():
            return trimesh.creation.icosphere(subdivisions=4, radius=shape.radius)
        case cs.Capsule():
            return trimesh.creation.capsule(shape.length, shape.radius, count=[48, 48])
        case cs.Cylinder():
            return trimesh.creation.cylinder(shape.radius, shape.length, sections=96)
    return trimesh.Trimesh(shape.vertices, shape.faces)
