"""Clients that break the rules of WebSockets, or keep them and send nothing but idle frames."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import suppress

import numpy as np
import pytest
from raw_websocket import (
    BINARY,
    CONTINUATION,
    HELLO,
    OPEN,
    PING,
    PONG,
    TEXT,
    RawWebSocket,
    masked,
    raw_websocket,
)
from running_server import WAIT, RunningServer, wait_for
from stopped_clock import StoppedClock

from capsense.errors import ProtocolError
from capsense.server import HEADER, connection, pack_depth
from capsense.server.connection import AdmissionControl, RateLimitedConnection


@pytest.fixture(autouse=True)
def witness(served: RunningServer, dome: np.ndarray) -> Iterator[None]:
    """Another client, whose session must go on as if nothing had happened."""
    with served.client() as client:
        sensor = client.open()
        before = sensor.step(dome)
        yield
        after = sensor.step(dome)
        assert np.allclose(after.delta, before.delta, rtol=1e-4)
        assert sensor.close() == {"frames": 2, "readings": 2, "dropped": 0}


@pytest.mark.parametrize(
    ("frames", "code"),
    [
        (b"\x81\x02{}", 1002),  # without a mask
        (b"\xf1" + masked("{}")[1:], 1002),  # reserved bits
        (masked(b"", 3), 1002),
        (masked(b"", 11), 1002),
        (masked(bytes(126), PING), 1002),
        (masked(b"", PING, last=False), 1002),
        (masked(b"x", CONTINUATION), 1002),
        (masked(b"x", TEXT, last=False) + masked(b"y", TEXT), 1002),
        (masked(b"\xff\xfe", TEXT), 1007),
        (b"\x82\xff" + (2**62).to_bytes(8, "big") + bytes(4), 1009),
        (b"\x82\xff" + (2**63).to_bytes(8, "big") + bytes(4), 1009),
        (8 * masked(bytes(100_000), CONTINUATION, last=False), 1002),
        (masked(b"x", BINARY, last=False) + 8 * masked(bytes(100_000), 0, last=False), 1009),
    ],
)
def test_broken_frames(served: RunningServer, frames: bytes, code: int) -> None:
    """The connection is closed with the code that WebSockets have for it."""
    with raw_websocket(served.port, HELLO, OPEN) as connection:
        with suppress(ConnectionError):
            connection.send(frames)
        assert connection.closed()[0] == code


FLOODS = {
    "pings": masked(b"", PING),
    "pongs": masked(b"", PONG),
    "large pings": masked(bytes(125), PING),
    "empty fragments": masked(b"", CONTINUATION, last=False),
    "small fragments": masked(bytes(50), CONTINUATION, last=False),
}


@pytest.mark.parametrize("kind", FLOODS)
@pytest.mark.parametrize("first", [(), (HELLO, OPEN)], ids=["stranger", "client"])
def test_floods_are_cut_off(served: RunningServer, kind: str, first: tuple[str, ...]) -> None:
    """Frames that no session hears of are few, or the connection is closed."""
    known = len(served.logged("dismissed"))
    with raw_websocket(served.port, *first) as connection:
        connection.send(masked(b"x", BINARY, last=False) if "fragments" in kind else b"")
        with pytest.raises(ConnectionError):
            flood(connection, FLOODS[kind])
        # The news may be lost where the server had much left to read.
        assert connection.closed() in ((1008, "flood"), (1006, ""))
    wait_for(lambda: len(served.logged("dismissed")) > known)
    assert served.logged("dismissed")[-1]["code"] == "flood"


def flood(connection: RawWebSocket, frame: bytes) -> None:
    """Send a million frames, or until the connection breaks."""
    for _ in range(100):
        connection.send(frame * 10_000)


def test_the_reason_of_the_cut(served: RunningServer) -> None:
    """A client that stops to listen is told."""
    with raw_websocket(served.port, HELLO) as connection:
        connection.send(150 * masked(b"", PONG))
        assert connection.closed() == (1008, "flood")


def test_what_is_no_flood(served: RunningServer, dome: np.ndarray) -> None:
    """Some pings are answered; frames in large fragments with a small last one are read."""
    with raw_websocket(served.port, HELLO, OPEN) as connection:
        for k in range(50):
            connection.send(masked(bytes([k]), PING))
            assert connection.receive() == (PONG, bytes([k]))
        for k in range(120):
            message = pack_depth(0, k, 0.0, dome)
            pieces = [message[at : at + 4095] for at in range(0, len(message), 4095)]
            assert len(pieces[-1]) < 50
            last = len(pieces) - 1
            connection.send(
                *(masked(piece, CONTINUATION if n else BINARY, last=n == last)
                  for n, piece in enumerate(pieces))
            )  # fmt: skip
            opcode, reading = connection.receive()
            assert (opcode, HEADER.unpack_from(reading)[8]) == (BINARY, k)


def test_only_one_address(served: RunningServer) -> None:
    """By default the server listens on 127.0.0.1 alone, and on none of the machine's others."""
    assert served.url.startswith("ws://127.0.0.1:")
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.2", served.port), timeout=WAIT)


def test_newcomers_are_let_in_slowly(
    clock: StoppedClock, dome: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beyond so many in a second, they are closed; those before stay, later ones come in."""
    monkeypatch.setattr(connection, "ARRIVALS", 3)
    with RunningServer() as server, server.client() as client:
        sensor = client.open()
        server.client().close()
        server.client().close()
        for _ in range(5):
            with pytest.raises((OSError, ProtocolError)):
                server.client()
        assert sensor.step(dome).sequence == 0
        clock.now += 0.4
        server.client().close()


def test_who_is_turned_away_keeps_nobody_out(clock: StoppedClock) -> None:
    """However many come meanwhile, every hundredth of a second one more is let in."""
    admission = AdmissionControl(10**6)
    assert [admission.admits() for _ in range(1000)] == [True] * 100 + [False] * 900
    clock.now += 0.0101
    assert [admission.admits() for _ in range(1000)] == [True] + [False] * 999
    admission.open = admission.most + 1
    clock.now += 100
    assert not admission.admits()


def test_reads_a_little_at_a_time(
    served: RunningServer, dome: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A large frame comes in pieces, between which it is the others' turn."""
    sizes: list[int] = []
    update = RateLimitedConnection.buffer_updated

    def watch(self: RateLimitedConnection, nbytes: int) -> None:
        sizes.append(nbytes)
        update(self, nbytes)

    monkeypatch.setattr(RateLimitedConnection, "buffer_updated", watch)
    with served.client() as client:
        large = np.kron(dome, np.ones((8, 8), np.float32))
        assert client.open().step(large).sequence == 0
    assert sum(sizes) > large.nbytes
    assert max(sizes) <= 16384
