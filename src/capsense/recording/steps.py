"""The messages of one step, and their publication to ROS 2 nodes as they are recorded."""

from __future__ import annotations

import types
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np

from capsense._style import signal_colours
from capsense.codec import CHANGING, body_fields, shape_fields
from capsense.errors import require_package
from capsense.reading import Reading
from capsense.readout.conversions import Counts
from capsense.recording.ros import PACKAGE, WORLD, Composer, Messages, lasting
from capsense.recording.session import Session, shield_coupling
from capsense.scene import Body, DepthFrame, Pose, RestSurface, Scene, Shape, SurfaceMesh

Topics = list[tuple[str, Any]]
"""Messages in the order in which they are written, each with its topic."""
SHADES = 32
"""Colours of an electrode between no signal and the largest."""
_SMALLEST, _DECADES = 1e-16, 4.0


def strength(changes: Any) -> Any:
    """How strongly electrodes light up, 0 to 1: the logarithm of 1 + change / 0.1 fF, 1 at 1 pF."""
    return np.clip(np.log10(1.0 + np.abs(changes) / _SMALLEST) / _DECADES, 0.0, 1.0)


@dataclass(frozen=True)
class Moment:
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
        messages: Where message types come from.
        session: Whose steps these are.
    """

    def __init__(self, messages: Messages, session: Session) -> None:
        self._make, self._name, self._design = messages.make, session.name, session.design
        self._compose = Composer(messages, session.name)
        self._channels, empty = session.channels, session.empty
        self._levels = np.array([c.read(empty) for c in self._channels])
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
            frames.append((self._name, self._compose.camera, frame.camera.pose))
            out += self._images(stamp, frame)
        out.append(("/tf", self._compose.transforms(stamp, frames)))
        drawn = [(child, number) for child, number, _ in solid]
        if drawn != self._drawn:
            self._drawn = drawn
            bodies = [(child, body) for child, _, body in solid]
            self._add(out, "markers", self._compose.markers(stamp, bodies))
        if reading.counts is not None and len(reading.counts):
            self._add(out, "counts", self._counts(stamp, reading.counts))
        self._light_up(stamp, reading, out)
        values = np.array([c.read(reading) for c in self._channels])
        names = [c.column_name for c in self._channels]
        signals = self._compose.signals(stamp, names, values, values - self._levels)
        self._add(out, "signals", signals)
        self._add(out, "capacitance", self._compose.matrix(reading.capacitance))
        self._add(out, "delta", self._compose.matrix(reading.delta))
        self._add(out, "step", self._step(moment, scene, ids, reading))
        return out

    def _light_up(self, stamp: int, reading: Reading, out: Topics) -> None:
        """Colour the electrodes by the changes of their own capacitances, where that is seen."""
        shades = np.rint(SHADES * strength(np.nan_to_num(np.diagonal(reading.delta))))
        if shades.tolist() == self._lit:
            return
        self._lit = shades.tolist()
        colours = signal_colours(shades / SHADES) / 255.0
        electrodes = self._compose.electrodes(stamp, self._design, colours)
        self._add(out, "electrodes", electrodes)

    def _add(self, out: Topics, topic: str, message: Any) -> None:
        out.append((f"/{self._name}/{topic}", message))

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
                self._add(out, "shapes", self._make(f"{PACKAGE}/Shape", id=number, **fields))
            return number

        for body in scene:
            key = (body.shape, body.material, body.grounding, body.name)
            number = self._bodies.get(key)
            if number is None:
                shape = known(body.shape)
                number = bodies[key] = self._new_id()
                fields = {"id": number, "shape": shape, **body_fields(body)}
                self._add(out, "bodies", self._make(f"{PACKAGE}/Body", **fields))
            ids.append(number)
        self._shapes.update((s, n) for s, n in shapes.items() if not isinstance(s, CHANGING))
        self._bodies.update((k, n) for k, n in bodies.items() if not isinstance(k[0], CHANGING))
        return ids

    def _new_id(self) -> int:
        self._ids += 1
        return self._ids

    def _step(self, moment: Moment, scene: Scene, ids: list[int], reading: Reading) -> Any:
        stats = reading.stats
        return self._make(
            f"{PACKAGE}/Step", header=self._compose.header(moment.stamp), episode=moment.episode,
            time=moment.time, bodies=np.array(ids, np.uint32),
            poses=[self._compose.pose(b.pose) for b in scene],
            capacitance=reading.capacitance.ravel(), delta=reading.delta.ravel(),
            shield_coupling=shield_coupling(reading), iterations=stats.iterations,
            error_estimate=stats.solver_error, tolerance=0.0,
            wall_time=stats.wall_time,
        )  # fmt: skip

    def _counts(self, stamp: int, counts: Counts) -> Any:
        none = np.empty(0)
        return self._make(
            f"{PACKAGE}/Counts", header=self._compose.header(stamp),
            channel_names=list(counts.channel_names), time=counts.time,
            channel=counts.channel.astype(np.uint32), code=counts.code.astype(np.int64),
            capacitance=counts.capacitance, flags=counts.flags.astype(np.uint8),
            baseline=none if counts.baseline is None else counts.baseline,
            touched=none.astype(bool) if counts.touched is None else counts.touched,
        )  # fmt: skip

    def _images(self, stamp: int, frame: DepthFrame) -> Topics:
        out: Topics = []
        depth = np.where(frame.valid, frame.depth, np.nan)
        self._add(out, "depth/image", self._compose.image(stamp, frame, depth))
        image = self._compose.image(stamp, frame, frame.permittivity)
        self._add(out, "depth/permittivity", image)
        self._add(out, "depth/camera_info", self._compose.camera_info(stamp, frame))
        return out


_BLOCK_MS = 1
"""How long a writer waits for a reader that does not keep up [ms]."""


class LiveTopics:
    """Experimental: publishes messages of standard types over DDS, without a ROS installation.

    Others, and those that a slow reader misses, are dropped. Topics, types and the CDR form follow
    the conventions of ROS 2 (``rt/…``, ``…::msg::dds_::…_``).

    If publishing fails, it warns and stops; the recording goes on.

    Args:
        domain: The ROS domain, ``ROS_DOMAIN_ID``.

    Raises:
        MissingDependencyError: CycloneDDS is not installed.
    """

    def __init__(self, domain: int) -> None:
        require_package("cyclonedds.domain", "CycloneDDS, which publishing needs,", "live")
        from cyclonedds.domain import DomainParticipant

        self._messages = Messages()
        self._participant = DomainParticipant(domain)
        self._failed = False
        self._types: dict[str, Any] = {}
        self._writers: dict[str, Any] = {}

    def write(self, stamp: int, messages: Sequence[tuple[str, Any]]) -> None:
        """Publish messages of one stamp [ns], each with its topic, and the clock.

        Warns:
            UserWarning: Publishing has failed, and stops.
        """
        from cyclonedds.core import DDSException

        if self._failed:
            return
        sec, nanosec = divmod(stamp, 10**9)
        time = self._messages.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        clock = self._messages.make("rosgraph_msgs/msg/Clock", clock=time)
        try:
            for topic, message in (("/clock", clock), *messages):
                if not message.__msgtype__.startswith(PACKAGE):
                    self._publish(topic, message)
        except DDSException as error:
            self._failed = True
            warnings.warn(f"publishing to ROS has stopped: {error}", stacklevel=4)

    def _publish(self, topic: str, message: Any) -> None:
        from cyclonedds.core import DDSException

        name = message.__msgtype__
        writer = self._writers.get(topic)
        if writer is None:
            writer = self._writers[topic] = self._writer(topic, name)
        sample = object.__new__(self._types[name])
        sample.encoded = self._messages.encode(message)
        try:
            writer.write(sample)
        except DDSException as error:
            if error.code != DDSException.DDS_RETCODE_TIMEOUT:
                raise

    def _writer(self, topic: str, type_name: str) -> Any:
        from cyclonedds.core import Policy, Qos
        from cyclonedds.pub import DataWriter
        from cyclonedds.topic import Topic
        from cyclonedds.util import duration

        kept = lasting(topic)
        durability = Policy.Durability.TransientLocal if kept else Policy.Durability.Volatile
        qos = Qos(
            Policy.Reliability.Reliable(duration(milliseconds=_BLOCK_MS)),
            Policy.History.KeepLast(kept or 10),
            durability,
        )
        described = Topic(self._participant, f"rt{topic}", self._type(type_name), qos=qos)
        return DataWriter(self._participant, described, qos=qos)

    def _type(self, name: str) -> Any:
        """The class that tells CycloneDDS of a ROS type; its samples are encoded beforehand."""
        from cyclonedds.idl import IdlStruct

        if name not in self._types:
            package, _, short = name.partition("/msg/")
            fields = {field: self._field(kind) for field, kind in self._messages.fields(name)}

            def fill(namespace: dict[str, Any]) -> None:
                namespace["__annotations__"] = fields
                namespace["serialize"] = lambda sample, **_: sample.encoded

            mangled = {"typename": f"{package}::msg::dds_::{short}_"}
            self._types[name] = dataclass(types.new_class(short, (IdlStruct,), mangled, fill))
        return self._types[name]

    def _field(self, kind: tuple[Any, Any]) -> Any:
        """The IDL type of a field of a ROS type."""
        from rosbags.interfaces import Nodetype

        idl: Any = import_module("cyclonedds.idl.types")
        node, what = kind
        if node == Nodetype.NAME:
            return self._type(what)
        if node == Nodetype.BASE:
            base = what[0]
            return {"string": str, "bool": bool}.get(base) or getattr(idl, base)
        inner, size = what
        if node == Nodetype.ARRAY:
            return idl.array[self._field(inner), size]
        return idl.sequence[self._field(inner)]
