"""Clients that break the rules harm themselves, and nobody else."""

from __future__ import annotations

import json
import random
import select
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress

import numpy as np
import pytest
from raw_websocket import HELLO, OPEN, masked, raw_websocket
from running_server import WAIT, RunningServer, wait_for
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from capsense.errors import ProtocolError, SolveError
from capsense.server import HEADER, pack_depth
from capsense.server.client import Client
from capsense.server.sensor import ServedSensor
from capsense.server.session import ALL_ALLOWANCES, ALLOWANCE, AT_ONCE, MISTAKE


@contextmanager
def raw(server: RunningServer, *first: str) -> Iterator[ClientConnection]:
    """A connection that sends what it likes; every message of ``first`` is answered."""
    with connect(server.url, compression=None, close_timeout=0.2, max_size=None) as connection:
        for message in first:
            connection.send(message)
            connection.recv(WAIT)
        yield connection


def error_of(connection: ClientConnection) -> dict:
    """The next answer, which is an error."""
    answer = json.loads(connection.recv(WAIT))
    assert answer["type"] == "error", answer
    return answer


def closed(connection: ClientConnection) -> tuple[int, str]:
    """Code and reason with which the server closes the connection."""
    while True:
        try:
            connection.recv(WAIT)
        except ConnectionClosed as error:
            return (error.rcvd.code, error.rcvd.reason) if error.rcvd else (1006, "")


@pytest.fixture
def witness(served: RunningServer, dome: np.ndarray) -> Iterator[None]:
    """Another client, whose session must go on as if nothing had happened."""
    with served.client() as client:
        sensor = client.open()
        before = sensor.step(dome)
        yield
        for _ in range(3):
            after = sensor.step(dome)
        assert np.allclose(after.delta, before.delta, rtol=1e-4)
        assert after.dropped == 0
        assert served.get("/health")[0] == 200


@pytest.mark.parametrize(
    ("message", "code"),
    [
        ('{"type": "hello", "protocol": 2}', "version"),
        ('{"type": "hello", "protocol": "1"}', "malformed"),
        ('{"type": "open", "sensor": 0}', "malformed"),
        ("not json", "malformed"),
        (b"CSNS", "malformed"),
    ],
)
def test_wrong_hellos(
    served: RunningServer, witness: None, message: str | bytes, code: str
) -> None:
    """The answer names what is wrong, and the connection is closed."""
    with raw(served) as connection:
        connection.send(message)
        assert error_of(connection)["code"] == code
        assert closed(connection) == (1008, code)


def test_malformed_messages(served: RunningServer, witness: None, dome: np.ndarray) -> None:
    """Each is answered, and the session goes on."""
    good = pack_depth(0, 7, 0.0, dome)
    with raw(served, HELLO, OPEN) as connection:
        for message, code, address in (
            (good[:-1], "malformed", {"sensor": 0, "sequence": 7}),
            (good[:20], "malformed", {}),
            (b"", "malformed", {}),
            (b"XXXX" + good[4:], "malformed", {"sensor": 0, "sequence": 7}),
            (pack_depth(9, 1, 0.0, dome), "sensor", {"sensor": 9, "sequence": 1}),
            (pack_depth(0, 1, 0.0, np.zeros((300, 300))), "limit", {"sensor": 0, "sequence": 1}),
            ("{", "malformed", {}),
            ('{"type": "dance"}', "malformed", {}),
            ('{"type": "hello", "protocol": 1}', "malformed", {}),
            ('{"type": "scene", "sensor": 0, "sequence": 3, "body": [1]}', "scene",
             {"sensor": 0, "sequence": 3}),
            (" " * 70000, "limit", {}),
        ):  # fmt: skip
            connection.send(message)
            answer = error_of(connection)
            found = {k: answer[k] for k in ("sensor", "sequence") if k in answer}
            assert (answer["code"], found) == (code, address), message[:60]
        connection.send(pack_depth(0, 8, 0.0, dome, np.full(dome.shape, 0.5)))
        answer = error_of(connection)
        assert (answer["code"], answer["sequence"]) == ("scene", 8)
        connection.send(pack_depth(0, 9, 0.0, dome))
        assert HEADER.unpack_from(connection.recv(WAIT))[8] == 9


def test_fuzzed_frames(served: RunningServer, witness: None, dome: np.ndarray) -> None:
    """Frames with damaged bytes are answered, by a reading or an error; none stops the session."""
    chance = random.Random(3)
    good = pack_depth(0, 0, 0.0, dome, np.full(dome.shape, 60, np.uint8))
    with raw(served, HELLO, OPEN) as connection:
        for _ in range(60):
            message = bytearray(good)
            for _ in range(chance.randint(1, 6)):
                message[chance.randrange(48)] = chance.randrange(256)
            connection.send(
                bytes(message[: chance.choice((len(good), chance.randrange(len(good))))])
            )
            connection.recv(WAIT)
        connection.send(json.dumps({"type": "reset", "sensor": 0}))
        assert json.loads(connection.recv(WAIT))["type"] == "reset"
        connection.send(good)
        assert HEADER.unpack_from(connection.recv(WAIT))[8] == 0


def test_oversized_message(served: RunningServer, witness: None) -> None:
    """More bytes than any frame can have: the connection is closed with the code for that."""
    with raw(served, HELLO, OPEN) as connection:
        connection.send(bytes(600_000))
        assert closed(connection)[0] == 1009


@pytest.mark.parametrize("floods", [1, 5])
def test_floods_of_errors_are_slowed(
    served: RunningServer, witness: None, dome: np.ndarray, floods: int
) -> None:
    """Whoever sends rubbish is read slowly, the slower the more do so; another's frames are not."""
    answers = [0] * floods
    stop = threading.Event()

    def send(connection: ClientConnection) -> None:
        with suppress(ConnectionClosed):
            while not stop.is_set():
                connection.send("rubbish")

    def receive(connection: ClientConnection, number: int) -> None:
        with suppress(ConnectionClosed):
            while not stop.is_set():
                connection.recv(WAIT)
                answers[number] += 1

    with ExitStack() as stack:
        client = stack.enter_context(served.client())
        sensor = client.open()
        hostile = [stack.enter_context(raw(served, HELLO)) for _ in range(floods)]
        start = time.monotonic()
        threads = [threading.Thread(target=send, args=(c,), daemon=True) for c in hostile]
        threads += [
            threading.Thread(target=receive, args=(c, n), daemon=True)
            for n, c in enumerate(hostile)
        ]
        for thread in threads:
            thread.start()
        steps = 0
        while time.monotonic() < start + (1.5 if steps >= 3 else 15.0):
            sensor.step(dome)
            steps += 1
        stop.set()
        rate = min(ALLOWANCE, ALL_ALLOWANCES / (floods + 2))  # two of them behave
        most = 1 + (AT_ONCE + rate * (time.monotonic() - start)) / MISTAKE
        assert max(answers) <= most
        assert steps >= 3
        for connection in hostile:
            connection.socket.shutdown(socket.SHUT_RDWR)
        for thread in threads:
            thread.join(WAIT)


def test_client_that_does_not_receive(dome: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is cut off once the system's buffers are full; another's session goes on meanwhile."""
    solve = ServedSensor.solve

    def bulky(self: ServedSensor, frame: object) -> bytes:
        return bytes(2**24) if self.options.sensor == 9 else solve(self, frame)  # type: ignore[arg-type]

    monkeypatch.setattr(ServedSensor, "solve", bulky)
    limits = RunningServer.patient(send_timeout=0.5)
    with RunningServer(limits=limits) as server, server.client() as client:
        sensor = client.open()
        with raw_websocket(server.port) as deaf:
            for message in (HELLO, '{"type": "open", "sensor": 9}', pack_depth(9, 0, 0.0, dome)):
                deaf.send(masked(message))
            deadline = time.monotonic() + WAIT
            while not server.logged("too slow") and time.monotonic() < deadline:
                sensor.step(dome)
        assert [e["client"] for e in server.logged("too slow")] == [2]
        assert sensor.step(dome).dropped == 0


def test_connections_are_limited(dome: np.ndarray) -> None:
    """The last one is told so and closed; those before stay, and a place that is left is free."""
    with RunningServer(limits=RunningServer.patient(connections=2)) as server:
        first, second = server.client(), server.client()
        with pytest.raises(ProtocolError, match=r"2 clients are connected|1013 full") as caught:
            server.client()
        assert caught.value.code == "full"
        assert first.open().step(dome).sequence == 0
        second.close()
        with server.client() as third:
            assert third.open().step(dome).sequence == 0
        first.close()


def test_half_open_connections(dome: np.ndarray) -> None:
    """Sockets that never shake hands, or never say hello, are closed in time."""
    limits = RunningServer.patient(connections=2, hello_timeout=2.0)
    with RunningServer(limits=limits) as server:
        silent = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(15)]
        with raw(server) as mute:
            assert error_of(mute)["code"] == "timeout"
            assert closed(mute) == (1008, "timeout")
        for one in silent:
            one.settimeout(WAIT)
            with suppress(ConnectionResetError):
                assert one.recv(1) == b""
            one.close()
        with server.client() as client:
            assert client.open().step(dome).sequence == 0


def test_too_many_sockets(dome: np.ndarray) -> None:
    """Beyond twice the connections and 16, sockets are closed at once, before any handshake."""
    with RunningServer(limits=RunningServer.patient(connections=2)) as server:
        sockets = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(30)]
        wait_for(lambda: len(select.select(sockets, [], [], 0.05)[0]) >= 10)
        assert len(select.select(sockets, [], [], 0.05)[0]) == 10
        for one in sockets:
            one.close()
        with server.client() as client:
            assert client.open().step(dome).sequence == 0


def test_client_that_vanishes(served: RunningServer, witness: None, dome: np.ndarray) -> None:
    """A connection that breaks off amid its frames leaves nothing behind."""
    before = served.get("/health")[1]["clients"]
    for _ in range(5):
        client = served.client()
        client.open()
        for _ in range(10):
            client.sensors[0].send(dome)
        client.connection.socket.shutdown(socket.SHUT_RDWR)
    wait_for(lambda: served.get("/health")[1]["clients"] <= before)


def test_others_sensors_are_out_of_reach(served: RunningServer, dome: np.ndarray) -> None:
    """Whatever a client says of a number is said of its own sensors."""
    ball = {"name": "ball", "shape": "sphere", "radius": 0.03, "material": "water"}
    with served.client() as owner, served.client() as other:
        sensor = owner.open(7)
        before = sensor.step_scene([{**ball, "pose": {"position": [0, 0, 0.06]}}])
        address = {"sensor": 7, "sequence": 99}
        for message in (
            {"type": "reset", "sensor": 7}, {"type": "close", "sensor": 7},
            {"type": "scene", **address, "body": []},
            {"type": "poses", **address, "poses": {"ball": {"position": [0, 0, 0.03]}}},
        ):  # fmt: skip
            with pytest.raises(ProtocolError, match="there is no sensor 7; open are none"):
                other.ask("answer", **message)
        other.send(pack_depth(7, 99, 0.0, dome))
        answer = other.receive()
        assert isinstance(answer, dict)
        assert (answer["code"], answer["sensor"], answer["sequence"]) == ("sensor", 7, 99)
        own = other.open(7)
        with pytest.raises(ProtocolError, match="no body 'ball'; it has none"):
            own.step_poses({"ball": {"position": [0, 0, 0.03]}})
        own.step(dome)
        assert own.close() == {"frames": 1, "readings": 1, "dropped": 0}
        after = sensor.step_poses({"ball": {"position": [0, 0, 0.06]}})
        assert after.sequence == 1
        assert np.allclose(after.delta, before.delta, rtol=1e-4)
        assert sensor.close() == {"frames": 2, "readings": 2, "dropped": 0}


@pytest.mark.parametrize(
    ("error", "code", "level"),
    [
        (SolveError("no convergence"), "solve", "INFO"),
        (RuntimeError("a secret of the server"), "internal", "ERROR"),
        (MemoryError("lots"), "internal", "ERROR"),
    ],
)
def test_steps_that_fail(
    dome: np.ndarray, monkeypatch: pytest.MonkeyPatch, error: Exception, code: str, level: str
) -> None:
    """The frame is answered by an error that gives nothing away; the next one is solved."""
    solve = ServedSensor.solve

    def fail(self: ServedSensor, frame: object) -> bytes:
        if frame.sequence == 1:  # type: ignore[attr-defined]
            raise error
        return solve(self, frame)  # type: ignore[arg-type]

    monkeypatch.setattr(ServedSensor, "solve", fail)
    with RunningServer() as server, server.client() as client:
        sensor = client.open()
        sensor.step(dome)
        with pytest.raises(ProtocolError) as caught:
            sensor.step(dome)
        assert caught.value.code == code
        assert "secret" not in str(caught.value)
        assert sensor.step(dome).sequence == 2
    (entry,) = server.logged("internal error") or server.logged("refused")
    assert entry["level"] == level


def test_faults_outside_of_steps(dome: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    """They end one session, and are logged in full."""

    def fail(table: object) -> object:
        raise RuntimeError("a secret of the server")

    with RunningServer() as server, server.client() as client:
        sensor = client.open()
        with monkeypatch.context() as patch:
            patch.setattr("capsense.server.messages.read_hello", fail)
            with pytest.raises(ProtocolError, match="1011") as caught:
                server.client()
        assert "secret" not in str(caught.value)
        assert sensor.step(dome).sequence == 0
        (entry,) = server.logged("internal error")
        assert (entry["level"], entry["client"]) == ("ERROR", 2)


def test_client_waits_no_longer_than_told(served: RunningServer) -> None:
    """A reading that never comes is an error after the timeout."""
    with served.client() as client:
        client.open()
        client.timeout = 0.2
        with pytest.raises(ProtocolError, match=r"no answer within 0\.2 s"):
            client.reading(0, 5)


def test_what_is_no_server(served: RunningServer) -> None:
    """An address where something else answers is an error that names it."""
    with pytest.raises(ProtocolError, match=r"/health is no server for this client: .* 200"):
        Client(served.url + "/health")
