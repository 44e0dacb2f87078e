"""ROS 2 messages: their definitions, and their CDR form.

Standard messages come with ``rosbags``; those of ``capsense_msgs`` lie in a ROS 2 package of that
name beside this module. Stored schemas hold the definition and those of all messages in it, as
ROS 2 wants.
"""

from __future__ import annotations

from functools import cache
from importlib import resources
from typing import Any

from capsense.errors import MissingDependencyError, RecordingError

PACKAGE = "capsense_msgs/msg"
OWN = ("Shape", "Body", "Step", "Counts", "Signal", "Signals")
"""Messages of ``capsense_msgs``."""
_LASTING = {"markers": 1, "electrodes": 1, "shapes": 1000, "bodies": 1000}


def require() -> None:
    """Refuse to go on without the optional packages.

    Raises:
        MissingDependencyError: One of them is not installed.
    """
    try:
        import mcap.writer  # noqa: F401
        import rosbags.typesys  # noqa: F401
    except ImportError as error:
        raise MissingDependencyError(
            f"recordings need {error.name}; pip install 'capsense[record]'"
        ) from None


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
