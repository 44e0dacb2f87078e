"""Sensors over a WebSocket: depth images or bodies in, readings out.

- :mod:`~capsense.server.binary`: binary messages
- :mod:`~capsense.server.messages`: control messages, JSON
- :mod:`~capsense.server.hands`: hands that a client tracks
- :mod:`~capsense.server.sensor`: one sensor of one client
- :mod:`~capsense.server.connection`: the connection of a client, which bounds what it can do
- :mod:`~capsense.server.session`: one client
- :mod:`~capsense.server.options`: what a server serves, and what its clients may use
- :mod:`~capsense.server.server`: all of them
- :mod:`~capsense.server.client`: the other side, in Python

The protocol is described in ``docs/protocol.md``.
"""

from capsense.server.binary import (
    CONVERSION,
    HEADER,
    MAX_SENSOR,
    MAX_SEQUENCE,
    NO_DETECTOR,
    PROTOCOL,
    DepthMessage,
    Flag,
    Kind,
    ReadingFlag,
    ReadingMessage,
    is_depth,
    pack_depth,
    pack_reading,
    unpack_depth,
    unpack_reading,
)

__all__ = [
    "CONVERSION",
    "HEADER",
    "MAX_SENSOR",
    "MAX_SEQUENCE",
    "NO_DETECTOR",
    "PROTOCOL",
    "DepthMessage",
    "Flag",
    "Kind",
    "ReadingFlag",
    "ReadingMessage",
    "is_depth",
    "pack_depth",
    "pack_reading",
    "unpack_depth",
    "unpack_reading",
]
