"""Experimental: recorded messages, published to ROS 2 nodes over DDS, without a ROS installation.

Topics, types and the CDR form follow the conventions of ROS 2 (``rt/…``, ``…::msg::dds_::…_``).
"""

from __future__ import annotations

import types
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from capsense.errors import MissingDependencyError
from capsense.recording.ros import PACKAGE, Messages, lasting

_BLOCK_MS = 1
"""How long a writer waits for a reader that does not keep up [ms]."""


class LiveTopics:
    """Publishes messages of standard types; others, and those a slow reader misses, are dropped.

    If publishing fails, it warns and stops; the recording goes on.

    Args:
        domain: The ROS domain, ``ROS_DOMAIN_ID``.

    Raises:
        MissingDependencyError: CycloneDDS is not installed.
    """

    def __init__(self, domain: int) -> None:
        try:
            from cyclonedds.domain import DomainParticipant
        except ImportError:
            raise MissingDependencyError(
                "publishing needs CycloneDDS; pip install 'capsense[live]'"
            ) from None
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
