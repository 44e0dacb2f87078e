"""What a step is for other programs: transforms, matrices, images and markers as ROS 2 messages.

Standard messages come with ``rosbags``; those of ``capsense_msgs`` lie in a ROS 2 package of that
name beside this module. Stored schemas hold the definition and those of all messages in it, as
ROS 2 wants.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib import resources
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense._style import signal_colours, strength
from capsense.codec import CHANGING, body_fields, shape_fields
from capsense.errors import RecordingError, require_package
from capsense.reading import Reading
from capsense.recording import Session
from capsense.scenario.model import read_channels
from capsense.scene import (
    Body,
    Box,
    Capsule,
    Cylinder,
    DepthFrame,
    Ellipsoid,
    Pose,
    RestSurface,
    Scene,
    Shape,
    Sphere,
    SurfaceMesh,
)

Array = NDArray[np.float64]
Colour = tuple[float, float, float, float]
Topics = list[tuple[str, Any]]
"""Messages in the order in which they are written, each with its topic."""

PACKAGE = "capsense_msgs/msg"
OWN = ("Shape", "Body", "Step", "Counts", "Touch", "Signal", "Signals")
"""Messages of ``capsense_msgs``."""
_LASTING = {"about": 1, "markers": 1, "electrodes": 1, "shapes": 1000, "bodies": 1000}
WORLD = "world"
"""Frame in which the sensor moves."""
METAL: Colour = (0.72, 0.74, 0.78, 1.0)
PLASTIC: Colour = (0.35, 0.6, 0.9, 0.6)
_CUBE, _SPHERE, _CYLINDER, _TRIANGLES, _DELETE_ALL = 1, 2, 3, 11, 3
SHADES = 32
"""Colours of an electrode between no signal and the largest."""


def require() -> None:
    """Refuse to go on without the optional packages.

    Raises:
        MissingDependencyError: One of them is not installed.
    """
    for module in ("mcap.writer", "rosbags.typesys"):
        require_package(module, f"{module}, which recordings need,", "record")


@cache
def _store() -> Any:
    """All types, the standard ones and our own."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    folder = resources.files("capsense.recording") / PACKAGE
    for name in OWN:
        text = (folder / f"{name}.msg").read_text()
        store.register(get_types_from_msg(text, f"{PACKAGE}/{name}"))
    return store


@cache
def _maker(type_name: str) -> Callable[[Any], Any]:
    """A function that makes a message of its fields, given by name or all of them in order."""
    kind = _store().types[type_name]
    fields = {name: _field(*what) for name, what in fields_of(type_name)}
    makers = [of for of, _ in fields.values()]
    plain = all(of is _same for of in makers)

    def make(given: Any) -> Any:
        if isinstance(given, Mapping):
            if not given.keys() <= fields.keys():
                unknown = ", ".join(given.keys() - fields.keys())
                raise TypeError(f"{type_name} has no field {unknown}")
            return kind(*[of(given[n]) if n in given else zero for n, (of, zero) in fields.items()])
        if plain:
            return kind(*given)
        return kind(*[of(value) for of, value in zip(makers, given, strict=True)])

    return make


def _field(node: Any, what: Any) -> tuple[Callable[[Any], Any], Any]:
    """What makes the value of a field, and its value where none is given."""
    from rosbags.interfaces import Nodetype

    if node == Nodetype.BASE:
        return _same, {"string": "", "bool": False}.get(what[0], 0)
    if node == Nodetype.NAME:
        return _maker(what), _maker(what)({})
    (node, what), size = what
    if node == Nodetype.NAME:
        make = _maker(what)
        return lambda values: [make(value) for value in values], []
    return _same, [] if what[0] == "string" else np.zeros(size, what[0])


def _same(value: Any) -> Any:
    return value


def lasting(topic: str) -> int:
    """How many messages of a topic are kept for those who come later; 0 for none.

    These topics are written when something changes, not at every step.
    """
    return _LASTING.get(topic.rpartition("/")[2], 0)


def make(type_name: str, **fields: Any) -> Any:
    """A message; fields that are not given are zero or empty.

    Messages in it are given as dicts of their fields, or as all of their fields in order.
    """
    return _maker(type_name)(fields)


def encode(message: Any) -> bytes:
    """The CDR form of a message, little-endian."""
    return bytes(_store().serialize_cdr(message, message.__msgtype__, little_endian=True))


def decode(data: bytes, type_name: str) -> Any:
    """The message of a CDR form.

    Raises:
        RecordingError: It is none of that type.
    """
    from rosbags.serde import SerdeError

    try:
        return _store().deserialize_cdr(data, type_name)
    except (SerdeError, KeyError, AssertionError, IndexError) as error:
        raise RecordingError(f"a message is no {type_name}: {error}") from None


def definition(type_name: str) -> str:
    """Definition of a type and of all types in it, encoding ``ros2msg``."""
    return _store().generate_msgdef(type_name, ros_version=2)[0]


def type_hash(type_name: str) -> str:
    """The hash by which ROS 2 tells types apart (REP 2011)."""
    return _store().hash_rihs01(type_name)


def fields_of(type_name: str) -> list[tuple[str, Any]]:
    """Names of a type's fields, each with its kind as ``rosbags`` describes it."""
    return list(_store().fielddefs[type_name][1])


class Moment(NamedTuple):
    """When a step was taken."""

    stamp: int
    """On the recording's clock [ns]."""
    episode: int
    """How often the simulator had been reset since the recording began."""
    time: float
    """On the clock of the scenario or simulator [s]."""


class StepMessages:
    """Turns steps into messages; shapes and bodies go ahead of the first step that has them.

    Args:
        session: Whose steps these are.
    """

    def __init__(self, session: Session) -> None:
        self._name, self._design = session.name, session.design
        self._camera = f"{session.name}/depth_camera"
        self._channels = session.channels
        self._levels = read_channels(session.channels, session.empty)
        self._lit: list[float] = []
        self._shapes: dict[Shape | RestSurface, int] = {}
        self._bodies: dict[tuple[Any, ...], int] = {}
        self._ids = 0
        self._drawn: list[tuple[str, int]] | None = None

    def of(
        self, moment: Moment, scene: Scene, reading: Reading, frame: DepthFrame | None,
        pose: Pose | None,
    ) -> Topics:  # fmt: skip
        """Messages of a step; what lacks the last of them, of type ``Step``, is not whole.

        Args:
            moment: When.
            scene: What the simulator was given.
            reading: What it returned.
            frame: The depth frame that the scene was made from, if it was.
            pose: Where the sensor stands in the world, if that is known.

        Raises:
            RecordingError: The scene holds a shape that messages do not have.
        """
        stamp = moment.stamp
        out: Topics = []
        ids = self._introduce(scene, out)
        frames = [] if pose is None else [(WORLD, self._name, pose)]
        solid: list[tuple[str, int, Body]] = []
        for k, (body, number) in enumerate(zip(scene, ids, strict=True)):
            if not isinstance(body.shape, CHANGING):
                solid.append((f"{self._name}/{body.name or f'body{k}'}", number, body))
        frames += [(self._name, child, body.pose) for child, _, body in solid]
        if frame is not None:
            frames.append((self._name, self._camera, frame.camera.pose))
            self._images(stamp, frame, out)
        transforms = [
            (self._header(stamp, parent), child, (pose.position, pose.quaternion))
            for parent, child, pose in frames
        ]
        out.append(("/tf", make("tf2_msgs/msg/TFMessage", transforms=transforms)))
        drawn = [(child, number) for child, number, _ in solid]
        if drawn != self._drawn:
            self._drawn = drawn
            self._draw(stamp, [(child, body) for child, _, body in solid], out)
        header = self._header(stamp)
        counts = reading.counts
        if counts is not None and len(counts):
            self._add(
                out, "counts", f"{PACKAGE}/Counts", header=header,
                channel_names=list(counts.channel_names), time=counts.time,
                channel=counts.channel.astype(np.uint32), code=counts.code.astype(np.int64),
                capacitance=counts.capacitance, flags=counts.flags.astype(np.uint8),
                baseline=np.empty(0) if counts.baseline is None else counts.baseline,
                touched=np.empty(0, bool) if counts.touched is None else counts.touched,
            )  # fmt: skip
        self._touch(header, scene, reading, out)
        self._light_up(stamp, reading, out)
        names = [c.column_name for c in self._channels]
        values = read_channels(self._channels, reading)
        femtofarads = (1e15 * values).tolist(), (1e15 * (values - self._levels)).tolist()
        signals = list(zip(names, *femtofarads, strict=True))
        self._add(out, "signals", f"{PACKAGE}/Signals", header=header, channels=signals)
        for topic, matrix in (("capacitance", reading.capacitance), ("delta", reading.delta)):
            n = len(matrix)
            self._add(
                out, topic, "std_msgs/msg/Float64MultiArray",
                layout=([("row", n, n * n), ("column", n, n)], 0), data=matrix.ravel(),
            )  # fmt: skip
        self._add(
            out, "step", f"{PACKAGE}/Step", header=header, episode=moment.episode,
            time=moment.time, bodies=np.array(ids, np.uint32),
            poses=[(b.pose.position, b.pose.quaternion) for b in scene],
            capacitance=reading.capacitance.ravel(), delta=reading.delta.ravel(),
            shield_coupling=reading.shield_coupling, iterations=reading.stats.iterations,
            error_estimate=reading.stats.solver_error, wall_time=reading.stats.wall_time,
        )  # fmt: skip
        return out

    def _touch(self, header: Any, scene: Scene, reading: Reading, out: Topics) -> None:
        """What is pressed onto a cover, and by which forces, if there is anything to say."""
        touch, forces = reading.touch, [b.force for b in scene]
        if touch is None and all(force is None for force in forces):
            return
        fields: dict[str, Any] = {}
        if touch is not None:
            fields = {"force": touch.force, "compression": touch.compression, "total": touch.total}
        self._add(
            out, "touch", f"{PACKAGE}/Touch", header=header,
            electrodes=list(self._design.electrode_names),
            body_forces=np.array([np.nan if f is None else f for f in forces], float), **fields,
        )  # fmt: skip

    def _header(self, stamp: int, frame: str | None = None) -> tuple[tuple[int, int], str]:
        """A header; ``stamp`` in ns, in the sensor's frame by default."""
        return divmod(stamp, 10**9), frame or self._name

    def _add(self, out: Topics, topic: str, type_name: str, **fields: Any) -> None:
        out.append((f"/{self._name}/{topic}", make(type_name, **fields)))

    def _introduce(self, scene: Scene, out: Topics) -> list[int]:
        """Ids of the bodies; messages of those that are new, and of new shapes, are put out."""
        shapes, bodies = dict[Shape | RestSurface, int](), dict[tuple[Any, ...], int]()
        ids = []

        def known(shape: Shape | RestSurface) -> int:
            number = self._shapes.get(shape, shapes.get(shape))
            if number is None:
                rest = known(shape.rest) if isinstance(shape, SurfaceMesh) else None
                fields = shape_fields(shape, rest)
                number = shapes[shape] = self._new_id()
                self._add(out, "shapes", f"{PACKAGE}/Shape", id=number, **fields)
            return number

        for body in scene:
            key = (body.shape, body.material, body.grounding, body.name, body.conductor)
            number = self._bodies.get(key)
            if number is None:
                shape = known(body.shape)
                number = bodies[key] = self._new_id()
                fields = {"id": number, "shape": shape, **body_fields(body)}
                self._add(out, "bodies", f"{PACKAGE}/Body", **fields)
            ids.append(number)
        self._shapes.update((s, n) for s, n in shapes.items() if not isinstance(s, CHANGING))
        self._bodies.update((k, n) for k, n in bodies.items() if not isinstance(k[0], CHANGING))
        return ids

    def _new_id(self) -> int:
        self._ids += 1
        return self._ids

    def _images(self, stamp: int, frame: DepthFrame, out: Topics) -> None:
        """The first layer of depths [m] and of permittivities, and their camera.

        Rows grow along the camera's y and columns along its x, as in optical frames of ROS. In the
        camera's message ``p`` takes points of its frame to pixels by parallel rays, its last row
        being 0, 0, 0, 1. ``k`` is zero, which tells ROS that there is no pinhole.
        """
        rows, columns = frame.resolution
        size = {"header": self._header(stamp, self._camera), "height": rows, "width": columns}
        camera = frame.camera
        depth = np.where(frame.valid, frame.depth, np.nan)
        for topic, values in (("image", depth), ("permittivity", frame.permittivity)):
            pixels = np.ascontiguousarray(camera.upright(values[0]), dtype="<f4")
            self._add(
                out, f"depth/{topic}", "sensor_msgs/msg/Image", **size, encoding="32FC1",
                step=4 * columns, data=pixels.view(np.uint8).ravel(),
            )  # fmt: skip
        p = [columns / camera.width, 0, 0, 0.5 * columns - 0.5]
        p += [0, rows / camera.height, 0, 0.5 * rows - 0.5, 0, 0, 0, 1]
        self._add(
            out, "depth/camera_info", "sensor_msgs/msg/CameraInfo", **size,
            distortion_model="orthographic", r=np.eye(3).ravel(), p=np.array(p, dtype=float),
        )  # fmt: skip

    def _light_up(self, stamp: int, reading: Reading, out: Topics) -> None:
        """Colour the electrodes by the changes of their own capacitances, where that is seen."""
        shades = np.rint(SHADES * strength(np.nan_to_num(np.diagonal(reading.delta))))
        if shades.tolist() == self._lit:
            return
        self._lit = shades.tolist()
        colours = (signal_colours(shades / SHADES) / 255.0).tolist()
        markers = [
            _marker(self._header(stamp), e.name, k, _triangles(e.surface.triangles), (r, g, b, 1.0))
            for k, (e, (r, g, b)) in enumerate(zip(self._design.electrodes, colours, strict=True))
        ]
        self._add(out, "electrodes", "visualization_msgs/msg/MarkerArray", markers=markers)

    def _draw(self, stamp: int, bodies: Sequence[tuple[str, Body]], out: Topics) -> None:
        """Bodies for drawing; each moves with the frame it is given with."""
        markers = [_marker(self._header(stamp), "", 0, Part(_CUBE), METAL, _DELETE_ALL)]
        for frame, body in bodies:
            colour = METAL if body.material.is_conductor() else PLASTIC
            markers += [
                _marker(self._header(stamp, frame), frame, k, part, colour)
                for k, part in enumerate(_parts(body.shape))
            ]
        self._add(out, "markers", "visualization_msgs/msg/MarkerArray", markers=markers)


class Part(NamedTuple):
    """A marker: its kind, sizes [m], place along z [m], or the corners of triangles [m], (n, 3)."""

    kind: int
    size: Sequence[float] = (1.0, 1.0, 1.0)
    height: float = 0.0
    points: Array = np.empty((0, 3))


def _marker(
    header: Any, group: str, number: int, part: Part, colour: Colour, action: int = 0
) -> dict[str, Any]:
    """The fields of a marker that are not zero or empty."""
    return {
        "header": header, "ns": group, "id": number, "type": part.kind, "action": action,
        "pose": ((0.0, 0.0, part.height), (0.0, 0.0, 0.0, 1.0)), "scale": part.size,
        "color": colour, "frame_locked": True, "points": part.points.tolist(),
    }  # fmt: skip


def _triangles(corners: Array) -> Part:
    return Part(_TRIANGLES, points=corners.reshape(-1, 3))


def _parts(shape: Shape) -> list[Part]:
    """What a shape is drawn as."""
    match shape:
        case Box(size):
            return [Part(_CUBE, size)]
        case Sphere(radius):
            return [Part(_SPHERE, (2 * radius,) * 3)]
        case Ellipsoid(radii):
            return [Part(_SPHERE, tuple(2 * r for r in radii))]
        case Cylinder(radius, length):
            return [Part(_CYLINDER, (2 * radius, 2 * radius, length))]
        case Capsule(radius, length):
            ends = [Part(_SPHERE, (2 * radius,) * 3, s * 0.5 * length) for s in (-1.0, 1.0)]
            return [Part(_CYLINDER, (2 * radius, 2 * radius, length)), *ends]
        case _:
            mesh = shape.to_trimesh()
            return [_triangles(mesh.vertices[mesh.faces])]
