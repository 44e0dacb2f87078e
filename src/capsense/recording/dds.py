"""Topics of ROS 2 over DDS, without a ROS installation: publishing and subscribing.

Topics, types, the CDR form and quality of service follow the conventions of ROS 2 (``rt/…``,
``…::msg::dds_::…_``). CycloneDDS carries the messages; ``rosbags`` encodes and decodes them.
"""

from __future__ import annotations

import types
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from capsense.errors import AdapterError, require_package
from capsense.recording import ros

_SECOND = 10**9
_BLOCK_MS = 1
"""How long a writer waits for a reader that does not keep up [ms]."""
_DEPTH = 10
"""Messages that are kept where nothing else is asked for, as ROS 2 does by default."""
MOST_DOMAIN = 232
"""Largest number of a domain, by the rules for DDS's ports."""


class _Sample:
    """What came in, still encoded; CycloneDDS notes on it what it knows of the message."""

    def __init__(self, encoded: bytes) -> None:
        self.encoded = encoded
        self.sample_info: Any = None


class Subscription:
    """Messages of a topic as they come in; made by :meth:`RosDomain.subscribe`."""

    def __init__(self, reader: Any, type_name: str) -> None:
        self.reader = reader
        """CycloneDDS's."""
        self._type = type_name

    def take(self) -> list[Any]:
        """The messages that have come in since the last call, the oldest first.

        Raises:
            RecordingError: One of them is none of its type.
        """
        out: list[Any] = []
        while samples := self.reader.take(N=256):
            out += [
                ros.decode(bytes(s.encoded), self._type) for s in samples if isinstance(s, _Sample)
            ]
        return out


class RosDomain:
    """A domain of ROS 2 in which messages are published and received.

    Args:
        domain: Its number, ``ROS_DOMAIN_ID`` there.

    Raises:
        MissingDependencyError: CycloneDDS is not installed.
        AdapterError: The number is out of range, or the domain cannot be joined.
    """

    def __init__(self, domain: int) -> None:
        require_package("cyclonedds.domain", "CycloneDDS, which ROS 2 topics need,", "live")
        from cyclonedds.core import DDSException, WaitSet
        from cyclonedds.domain import DomainParticipant

        if not 0 <= domain <= MOST_DOMAIN:
            raise AdapterError(f"ROS domain is {domain!r}; give a number from 0 to {MOST_DOMAIN}")
        try:
            self._participant = DomainParticipant(domain)
        except DDSException as error:
            raise AdapterError(
                f"ROS domain {domain} cannot be joined: {error}; see to the network, or to the "
                "configuration that CYCLONEDDS_URI names"
            ) from None
        self._types: dict[str, Any] = {}
        self._writers: dict[str, Any] = {}
        self._waiting = WaitSet(self._participant)
        self._conditions: list[Any] = []

    def publish(self, topic: str, message: Any) -> None:
        """Publish a message; a reader that does not keep up misses it.

        Raises:
            DDSException: It failed otherwise.
        """
        from cyclonedds.core import DDSException

        name = message.__msgtype__
        writer = self._writers.get(topic)
        if writer is None:
            writer = self._writers[topic] = self._writer(topic, name)
        sample = object.__new__(self._types[name])
        sample.encoded = ros.encode(message)
        try:
            writer.write(sample)
        except DDSException as error:
            if error.code != DDSException.DDS_RETCODE_TIMEOUT:
                raise

    def subscribe(
        self, topic: str, type_name: str, *, depth: int = _DEPTH, lasting: bool = False,
        reliable: bool = True,
    ) -> Subscription:  # fmt: skip
        """Receive the messages of a topic.

        Args:
            topic: As ROS 2 names it, from the root.
            type_name: Such as ``"tf2_msgs/msg/TFMessage"``.
            depth: Messages that are kept until they are taken.
            lasting: Whether messages from before are wanted too (transient local).
            reliable: Whether none may be lost; best effort also hears writers that lose some.
        """
        from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState
        from cyclonedds.sub import DataReader

        topic_of, qos = self._topic(topic, type_name, depth, lasting=lasting, reliable=reliable)
        reader = DataReader(self._participant, topic_of, qos=qos)
        unread = SampleState.NotRead | ViewState.Any | InstanceState.Any
        self._conditions.append(ReadCondition(reader, unread))
        self._waiting.attach(self._conditions[-1])
        return Subscription(reader, type_name)

    def wait(self, seconds: float) -> None:
        """Wait until a message comes in, or so long [s]."""
        self._waiting.wait(max(0, round(seconds * _SECOND)))

    def _writer(self, topic: str, type_name: str) -> Any:
        from cyclonedds.pub import DataWriter

        kept = ros.lasting(topic)
        topic_of, qos = self._topic(topic, type_name, kept or _DEPTH, lasting=kept > 0)
        return DataWriter(self._participant, topic_of, qos=qos)

    def _topic(
        self, topic: str, type_name: str, depth: int, *, lasting: bool, reliable: bool = True
    ) -> tuple[Any, Any]:
        from cyclonedds.core import Policy, Qos
        from cyclonedds.topic import Topic
        from cyclonedds.util import duration

        reliability = (
            Policy.Reliability.Reliable(duration(milliseconds=_BLOCK_MS))
            if reliable
            else Policy.Reliability.BestEffort
        )
        durability = Policy.Durability.TransientLocal if lasting else Policy.Durability.Volatile
        qos = Qos(reliability, Policy.History.KeepLast(depth), durability)
        return Topic(self._participant, f"rt{topic}", self._type(type_name), qos=qos), qos

    def _type(self, name: str) -> Any:
        """The class that tells CycloneDDS of a ROS type; its samples stay encoded."""
        from cyclonedds.idl import IdlStruct

        if name not in self._types:
            package, _, short = name.partition("/msg/")
            fields = {field: self._field(kind) for field, kind in ros.fields_of(name)}

            def fill(namespace: dict[str, Any]) -> None:
                namespace["__annotations__"] = fields
                namespace["serialize"] = lambda sample, **_: sample.encoded
                namespace["deserialize"] = staticmethod(lambda data, **_: _Sample(data))

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


class LiveTopics:
    """Experimental: publishes a recorder's messages of standard types, as they are recorded.

    Others, and those that a slow reader misses, are dropped. If publishing fails, it warns and
    stops; the recording goes on.

    Args:
        domain: The ROS domain, ``ROS_DOMAIN_ID``.

    Raises:
        MissingDependencyError: CycloneDDS is not installed.
        AdapterError: The domain cannot be joined.
    """

    def __init__(self, domain: int) -> None:
        self._domain = RosDomain(domain)
        self._failed = False

    def write(self, stamp: int, messages: Sequence[tuple[str, Any]]) -> None:
        """Publish messages of one stamp [ns], each with its topic, and the clock.

        Warns:
            UserWarning: Publishing has failed, and stops.
        """
        from cyclonedds.core import DDSException

        if self._failed:
            return
        clock = ros.make("rosgraph_msgs/msg/Clock", clock=divmod(stamp, _SECOND))
        try:
            for topic, message in (("/clock", clock), *messages):
                if not message.__msgtype__.startswith(ros.PACKAGE):
                    self._domain.publish(topic, message)
        except DDSException as error:
            self._failed = True
            warnings.warn(f"publishing to ROS has stopped: {error}", stacklevel=4)
