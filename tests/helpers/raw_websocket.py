"""A WebSocket client that breaks rules: bytes as they are, on a socket."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from contextlib import contextmanager

CONTINUATION, TEXT, BINARY, CLOSE, PING, PONG = 0, 1, 2, 8, 9, 10
HELLO = json.dumps({"type": "hello", "protocol": 1})
OPEN = json.dumps({"type": "open", "sensor": 0})


def masked(message: str | bytes, opcode: int | None = None, *, last: bool = True) -> bytes:
    """A frame as a client sends it, with a mask of zeros.

    Args:
        message: The payload.
        opcode: Of the frame; by default that of a text or a binary message.
        last: Whether the message ends with it.
    """
    data = message.encode() if isinstance(message, str) else message
    kind = opcode if opcode is not None else TEXT if isinstance(message, str) else BINARY
    size = len(data)
    if size < 126:
        length = bytes([0x80 | size])
    elif size < 65536:
        length = b"\xfe" + size.to_bytes(2, "big")
    else:
        length = b"\xff" + size.to_bytes(8, "big")
    return bytes([(0x80 if last else 0) | kind]) + length + bytes(4) + data


class RawWebSocket:
    """A socket after the handshake.

    Args:
        port: Of the server on this machine.
    """

    def __init__(self, port: int) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=60)
        self.socket.sendall(
            b"GET / HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n"
        )
        self._came = b""
        while b"\r\n\r\n" not in self._came:
            self._more()
        head, _, self._came = self._came.partition(b"\r\n\r\n")
        assert head.startswith(b"HTTP/1.1 101 "), head

    def send(self, *frames: bytes) -> None:
        """Send bytes."""
        self.socket.sendall(b"".join(frames))

    def receive(self) -> tuple[int, bytes]:
        """Opcode and payload of the next frame.

        Raises:
            EOFError: The server closed the connection.
        """
        opcode, length = self._take(1)[0] & 0x0F, self._take(1)[0]
        if length > 125:
            length = int.from_bytes(self._take(2 if length == 126 else 8), "big")
        return opcode, self._take(length)

    def closed(self) -> tuple[int, str]:
        """Code and reason with which the server closes the connection; 1006 without any."""
        try:
            while True:
                opcode, data = self.receive()
                if opcode == CLOSE:
                    return int.from_bytes(data[:2], "big"), data[2:].decode()
        except (EOFError, ConnectionError):
            return 1006, ""

    def _take(self, count: int) -> bytes:
        while len(self._came) < count:
            self._more()
        taken, self._came = self._came[:count], self._came[count:]
        return taken

    def _more(self) -> None:
        data = self.socket.recv(65536)
        if not data:
            raise EOFError
        self._came += data


@contextmanager
def raw_websocket(port: int, *first: str) -> Iterator[RawWebSocket]:
    """A connection that says these, each of which is answered, and is dropped at the end."""
    connection = RawWebSocket(port)
    try:
        for message in first:
            connection.send(masked(message))
            connection.receive()
        yield connection
    finally:
        connection.socket.close()
