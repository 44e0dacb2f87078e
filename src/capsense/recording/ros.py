"""What other programs look at: transforms, matrices, images and markers as ROS 2 messages.

Standard messages come with ``rosbags``; those of ``capsense_msgs`` lie in a ROS 2 package of that
name beside this module. Stored schemas hold the definition and those of all messages in it, as
ROS 2 wants.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from importlib import resources
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense.design.model import Design
from capsense.errors import RecordingError, require_package
from capsense.scene import Box, Capsule, Cylinder, DepthFrame, Ellipsoid, Pose, Shape, Sphere
from capsense.scene.scene import Body

PACKAGE = "capsense_msgs/msg"
OWN = ("Shape", "Body", "Step", "Counts", "Signal", "Signals")
"""Messages of ``capsense_msgs``."""
_LASTING = {"markers": 1, "electrodes": 1, "shapes": 1000, "bodies": 1000}


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


def lasting(topic: str) -> int:
    """How many messages of a topic are kept for those who come later; 0 for none.

    These topics are written when something changes, not at every step.
    """
    return _LASTING.get(topic.rpartition("/")[2], 0)


def offered_qos(topic: str) -> str:
    """Quality of service of a lasting topic, as rosbag2 writes it down.

    Policies are numbers, which all versions of rosbag2 read. Other topics have none, which it takes
    for its defaults.
    """
    if not lasting(topic):
        return ""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability
    from rosbags.interfaces import QosTime as Time
    from rosbags.rosbag2.metadata import dump_qos_v8

    ever = Time(9223372036, 854775807)
    profile = Qos(
        QosHistory.KEEP_LAST, lasting(topic), QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL, ever, ever, QosLiveliness.AUTOMATIC, ever, False,
    )  # fmt: skip
    return dump_qos_v8([profile])


class Messages:
    """Makes, encodes and decodes messages by the names of their types."""

    def __init__(self) -> None:
        self._store = _store()
        self._types: dict[str, Any] = self._store.types

    def make(self, type_name: str, **fields: Any) -> Any:
        """A message; every field must be given."""
        return self._types[type_name](**fields)

    def encode(self, message: Any) -> bytes:
        """The CDR form of a message, little-endian."""
        return bytes(self._store.serialize_cdr(message, message.__msgtype__, little_endian=True))

    def decode(self, data: bytes, type_name: str) -> Any:
        """The message of a CDR form.

        Raises:
            RecordingError: It is none of that type.
        """
        from rosbags.serde import SerdeError

        try:
            return self._store.deserialize_cdr(data, type_name)
        except (SerdeError, KeyError, AssertionError, IndexError) as error:
            raise RecordingError(f"a message is no {type_name}: {error}") from None

    def definition(self, type_name: str) -> str:
        """Definition of a type and of all types in it, encoding ``ros2msg``."""
        return self._store.generate_msgdef(type_name, ros_version=2)[0]

    def type_hash(self, type_name: str) -> str:
        """The hash by which ROS 2 tells types apart (REP 2011)."""
        return self._store.hash_rihs01(type_name)

    def fields(self, type_name: str) -> list[tuple[str, Any]]:
        """Names of a type's fields, each with its kind as ``rosbags`` describes it."""
        return list(self._store.fielddefs[type_name][1])


Array = NDArray[np.float64]
Colour = tuple[float, float, float, float]

WORLD = "world"
"""Frame in which the sensor moves."""
METAL: Colour = (0.72, 0.74, 0.78, 1.0)
PLASTIC: Colour = (0.35, 0.6, 0.9, 0.6)
_CUBE, _SPHERE, _CYLINDER, _TRIANGLES, _DELETE_ALL = 1, 2, 3, 11, 3


class Composer:
    """Makes the messages of one sensor.

    Args:
        messages: Where message types come from.
        name: The sensor's frame.
    """

    def __init__(self, messages: Messages, name: str) -> None:
        self._make = messages.make
        self.name = name

    def header(self, stamp: int, frame: str | None = None) -> Any:
        """A header; ``stamp`` in ns, in the sensor's frame by default."""
        sec, nanosec = divmod(stamp, 10**9)
        time = self._make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        return self._make(
            "std_msgs/msg/Header", stamp=time, frame_id=self.name if frame is None else frame
        )

    def pose(self, pose: Pose) -> Any:
        """A ``geometry_msgs/Pose``."""
        return self._make(
            "geometry_msgs/msg/Pose",
            position=self._vector("Point", pose.position),
            orientation=self._quaternion(pose),
        )

    def matrix(self, values: Array) -> Any:
        """A square matrix as ``std_msgs/Float64MultiArray``, row by row."""
        n = len(values)
        dims = [
            self._make("std_msgs/msg/MultiArrayDimension", label=label, size=n, stride=stride)
            for label, stride in (("row", n * n), ("column", n))
        ]
        layout = self._make("std_msgs/msg/MultiArrayLayout", dim=dims, data_offset=0)
        data = np.ascontiguousarray(values).ravel()
        return self._make("std_msgs/msg/Float64MultiArray", layout=layout, data=data)

    def transforms(self, stamp: int, frames: Sequence[tuple[str, str, Pose]]) -> Any:
        """Poses of frames: (parent, child, pose)."""
        return self._make(
            "tf2_msgs/msg/TFMessage",
            transforms=[
                self._make(
                    "geometry_msgs/msg/TransformStamped",
                    header=self.header(stamp, parent),
                    child_frame_id=child,
                    transform=self._make(
                        "geometry_msgs/msg/Transform",
                        translation=self._vector("Vector3", pose.position),
                        rotation=self._quaternion(pose),
                    ),
                )
                for parent, child, pose in frames
            ],
        )

    def image(self, stamp: int, frame: DepthFrame, values: Array) -> Any:
        """The first layer of a depth frame's ``values``, as 32-bit floats.

        Rows grow along the camera's y and columns along its x, as in optical frames of ROS.
        """
        pixels = np.ascontiguousarray(frame.camera.upright(values[0]), dtype="<f4")
        rows, columns = pixels.shape
        return self._make(
            "sensor_msgs/msg/Image", header=self.header(stamp, self.camera), height=rows,
            width=columns, encoding="32FC1", is_bigendian=0, step=4 * columns,
            data=pixels.view(np.uint8).ravel(),
        )  # fmt: skip

    def camera_info(self, stamp: int, frame: DepthFrame) -> Any:
        """The camera of a depth frame.

        ``p`` takes points of the camera's frame to pixels by parallel rays, its last row being
        0, 0, 0, 1. ``k`` is zero, which tells ROS that there is no pinhole.
        """
        rows, columns = frame.resolution
        c = frame.camera
        p = [columns / c.width, 0, 0, 0.5 * columns - 0.5]
        p += [0, rows / c.height, 0, 0.5 * rows - 0.5, 0, 0, 0, 1]
        roi = self._make(
            "sensor_msgs/msg/RegionOfInterest",
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False,
        )  # fmt: skip
        return self._make(
            "sensor_msgs/msg/CameraInfo", header=self.header(stamp, self.camera), height=rows,
            width=columns, distortion_model="orthographic", d=np.empty(0), k=np.zeros(9),
            r=np.eye(3).ravel(), p=np.array(p, dtype=float), binning_x=0, binning_y=0, roi=roi,
        )  # fmt: skip

    @property
    def camera(self) -> str:
        """The camera's frame."""
        return f"{self.name}/depth_camera"

    def electrodes(self, stamp: int, design: Design, colours: Array) -> Any:
        """Electrodes for drawing, in colours from 0 to 1, shape (M, 3)."""
        markers = []
        for k, (electrode, (r, g, b)) in enumerate(
            zip(design.electrodes, colours.tolist(), strict=True)
        ):
            part = Part(_TRIANGLES, points=electrode.surface.triangles.reshape(-1, 3))
            header = self.header(stamp)
            markers.append(self._marker(header, electrode.name, k, part, (r, g, b, 1.0)))
        return self._make("visualization_msgs/msg/MarkerArray", markers=markers)

    def signals(self, stamp: int, names: Sequence[str], values: Array, changes: Array) -> Any:
        """Channels by their names, with their capacitances and changes [F]."""
        channels = [
            self._make(f"{PACKAGE}/Signal", name=name, capacitance=value, change=change)
            for name, value, change in zip(
                names, (1e15 * values).tolist(), (1e15 * changes).tolist(), strict=True
            )
        ]
        return self._make(f"{PACKAGE}/Signals", header=self.header(stamp), channels=channels)

    def markers(self, stamp: int, bodies: Sequence[tuple[str, Body]]) -> Any:
        """Bodies for drawing; each moves with the frame it is given with."""
        out = [self._marker(self.header(stamp), "", 0, Part(_CUBE), METAL, _DELETE_ALL)]
        for frame, body in bodies:
            colour = METAL if body.material.is_conductor() else PLASTIC
            out += [
                self._marker(self.header(stamp, frame), frame, k, part, colour)
                for k, part in enumerate(_parts(body.shape))
            ]
        return self._make("visualization_msgs/msg/MarkerArray", markers=out)

    def _marker(
        self, header: Any, group: str, number: int, part: Part, colour: Colour, action: int = 0
    ) -> Any:
        make, v = self._make, self._vector
        zero = make("builtin_interfaces/msg/Duration", sec=0, nanosec=0)
        texture = make(
            "sensor_msgs/msg/CompressedImage",
            header=self.header(0, ""), format="", data=np.empty(0, np.uint8),
        )  # fmt: skip
        r, g, b, a = colour
        return make(
            "visualization_msgs/msg/Marker", header=header, ns=group, id=number,
            type=part.kind, action=action, pose=self.pose(Pose((0.0, 0.0, part.height))),
            scale=v("Vector3", part.size), color=make("std_msgs/msg/ColorRGBA", r=r, g=g, b=b, a=a),
            lifetime=zero, frame_locked=True,
            points=[v("Point", p) for p in part.points.tolist()], colors=[],
            texture_resource="", texture=texture, uv_coordinates=[], text="", mesh_resource="",
            mesh_file=make(
                "visualization_msgs/msg/MeshFile", filename="", data=np.empty(0, np.uint8)
            ),
            mesh_use_embedded_materials=False,
        )  # fmt: skip

    def _vector(self, kind: str, values: Sequence[float]) -> Any:
        x, y, z = values
        return self._make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)

    def _quaternion(self, pose: Pose) -> Any:
        x, y, z, w = pose.quaternion
        return self._make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


class Part(NamedTuple):
    """A marker: its kind, sizes [m], place along z [m], or the corners of triangles [m], (n, 3)."""

    kind: int
    size: Sequence[float] = (1.0, 1.0, 1.0)
    height: float = 0.0
    points: Array = np.empty((0, 3))


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
            return [Part(_TRIANGLES, points=mesh.vertices[mesh.faces].reshape(-1, 3))]
