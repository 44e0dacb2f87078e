"""The connection of a client, which bounds what it can do, and those of all."""

from __future__ import annotations

import asyncio
import socket
import time
from dataclasses import dataclass, field
from typing import Any, cast

from capsense.errors import MissingDependencyError

try:
    from websockets.asyncio.server import ServerConnection, serve
    from websockets.datastructures import Headers
    from websockets.exceptions import ConnectionClosed
    from websockets.frames import Frame as WebSocketFrame
    from websockets.frames import Opcode
    from websockets.http11 import Request, Response
except ImportError as error:
    raise MissingDependencyError(
        'the server needs websockets; install it with: pip install "capsense[serve]"'
    ) from error

__all__ = ["ConnectionClosed", "Headers", "Request", "Response", "ServerConnection", "serve"]

POLICY, TRY_LATER = 1008, 1013
"""Codes with which connections are closed on errors, and when there are too many."""
FLOOD = "flood"
"""Reason with which a client that talks idly is cut off."""
READ_SIZE = 16384
"""Bytes that are read at a time: then it is the others' turn."""
SEND_BUFFER = 262144
"""What the system may hold for a client that does not receive [bytes]."""
SMALL = 1024
"""Size [bytes] from which on a fragment of a message counts as content."""
ARRIVALS = 100.0
"""Connections that a server takes at once, and again every second; others are closed."""
IDLE_FRAMES = 100.0
"""Pings, pongs and small fragments that a client may send at once, and again every second."""


class Allowance:
    """A token bucket that can be overdrawn.

    Args:
        most: What can be spent at once, after a rest.
        rate: What comes back a second.
        first: What can be spent at the start; by default ``most``.
    """

    def __init__(self, most: float, rate: float, first: float | None = None) -> None:
        self.most, self.rate = most, rate
        self._left = most if first is None else first
        self._counted = time.monotonic()

    def spend(self, cost: float) -> float:
        """Spend some, and return what is left: below zero, more was spent than there was."""
        now = time.monotonic()
        regained = (now - self._counted) * self.rate
        self._counted = now
        self._left = min(self.most, self._left + regained) - cost
        return self._left


@dataclass
class AdmissionControl:
    """Connections of a server, those that still shake hands included."""

    most: int
    """More are closed at once."""
    open: int = 0
    arrivals: Allowance = field(default_factory=lambda: Allowance(ARRIVALS, ARRIVALS))

    def admits(self) -> bool:
        """Whether the connection that was just made may stay."""
        if self.open > self.most:
            return False
        if self.arrivals.spend(1) < 0:
            self.arrivals.spend(-1)  # those that are turned away keep nobody out
            return False
        return True


class RateLimitedConnection(ServerConnection, asyncio.BufferedProtocol):
    """A connection that reads a little at a time, and is cut off when its client talks idly.

    Whole messages are paced by their session. Pings, pongs and fragments of a message that never
    ends do not get that far, yet would keep the event loop busy and fill the memory.
    """

    def __init__(self, *args: Any, admission: AdmissionControl, **options: Any) -> None:
        super().__init__(*args, **options)
        self.flooded = False
        """Whether it was cut off."""
        self._admission = admission
        self._buffer = bytearray(READ_SIZE)
        self._idle_frames = Allowance(IDLE_FRAMES, IDLE_FRAMES)

    # -- called by asyncio ------------------------------------------------------------------------

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._admission.open += 1
        super().connection_made(transport)
        raw = transport.get_extra_info("socket")
        if raw is not None:
            raw.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        if not self._admission.admits():
            cast(asyncio.Transport, transport).abort()

    def connection_lost(self, exc: Exception | None) -> None:
        self._admission.open -= 1
        super().connection_lost(exc)

    def get_buffer(self, sizehint: int) -> bytearray:
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        self.data_received(bytes(memoryview(self._buffer)[:nbytes]))

    # -- called by websockets ---------------------------------------------------------------------

    def process_event(self, event: Any) -> None:
        if self.flooded:
            return
        if isinstance(event, WebSocketFrame) and _idle(event) and self._idle_frames.spend(1) < 0:
            self.flooded = True
            self.protocol.fail(POLICY, FLOOD)
            for data in filter(None, self.protocol.data_to_send()):
                self.transport.write(data)
            self.transport.close()
            return
        super().process_event(event)


def _idle(frame: WebSocketFrame) -> bool:
    """Whether a frame is none that sessions hear of; what ends a message is."""
    return frame.opcode in (Opcode.PING, Opcode.PONG) or (not frame.fin and len(frame.data) < SMALL)
