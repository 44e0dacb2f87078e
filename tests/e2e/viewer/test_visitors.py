"""The view's page: its own user is let in, other pages and broken messages are not."""

from __future__ import annotations

import contextlib
import http.client
import logging
import socket
from collections.abc import Iterator

import pytest

pytest.importorskip("viser", reason='needs viser: pip install "capsense[view]"')

import viser
from ball_scenario import ball_scenario
from view_sources import until
from websockets.exceptions import ConnectionClosedError, InvalidStatus
from websockets.sync.client import connect

import capsense as cs
from capsense.viewer.player import Player
from capsense.viewer.source import ScenarioSource
from capsense.viewer.view import LiveView, welcome


@pytest.fixture(scope="module")
def port(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """A view of a scenario."""
    path = tmp_path_factory.mktemp("view") / "ball.toml"
    path.write_text(ball_scenario())
    scenario = cs.load_scenario(path)
    player = Player(ScenarioSource(scenario, cs.Simulator(scenario.design)))
    view = LiveView(player, port=0)
    yield int(view.url.rpartition(":")[2])
    view.stop()
    player.stop()


@pytest.mark.parametrize(
    ("host", "origin", "let_in"),
    [
        ("127.0.0.1:8080", None, True),
        ("localhost:9000", "http://localhost:9000", True),
        ("[::1]:8080", "http://[::1]:8080", True),
        ("192.168.3.4:8080", "http://192.168.3.4:8080", True),
        ("robot:80", "http://ROBOT:80", True),
        (f"{socket.gethostname()}:80", None, True),
        (f"{socket.gethostname()}.local:80", None, True),
        (f"{socket.gethostname()}.evil.example:80", None, False),
        ("evil.example:8080", None, False),
        ("evil.example:8080", "http://evil.example:8080", False),
        ("127.0.0.1:8080", "http://evil.example", False),
        ("127.0.0.1:8080", "http://127.0.0.1:3000", False),
        ("127.0.0.1:8080", "null", False),
        ("127.0.0.1.evil.example", None, False),
        ("[::1", None, False),
        ("", None, False),
    ],
)
def test_who_is_let_in(host: str, origin: str | None, let_in: bool) -> None:
    """A page of another origin, and a name that was made to point here, are not."""
    assert welcome(host, origin, "robot") is let_in


@pytest.mark.parametrize(
    ("headers", "status"),
    [({}, 200), ({"Host": "evil.example"}, 403), ({"Origin": "http://evil.example"}, 403)],
)
def test_requests(port: int, headers: dict[str, str], status: int) -> None:
    """The page, and the socket behind it."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", "/", headers=headers)
    assert connection.getresponse().status == status
    if "Origin" in headers:
        with pytest.raises(InvalidStatus):
            connect(f"ws://127.0.0.1:{port}", origin=headers["Origin"])  # type: ignore[arg-type]


@pytest.mark.parametrize("message", ["text", bytes(30), b"\x81\xa4type\xa4Nope"])
def test_broken_messages(port: int, message: str | bytes, caplog: pytest.LogCaptureFixture) -> None:
    """One line in the log, and the client is cut off."""
    caplog.set_level(logging.DEBUG)
    with connect(f"ws://127.0.0.1:{port}", subprotocols=[f"viser-v{viser.__version__}"]) as client:  # type: ignore[list-item]
        client.recv(10)
        client.send(message)
        with contextlib.suppress(ConnectionClosedError):
            for _ in client:
                pass  # until it is closed
    until(lambda: "no message of its page" in caplog.text)
    assert not [r for r in caplog.records if r.exc_info]
    with socket.create_connection(("127.0.0.1", port)) as raw:
        raw.sendall(b"garbage\r\n\r\n")
        assert not raw.recv(100).startswith(b"HTTP/1.1 1")
    assert not [r for r in caplog.records if r.exc_info and r.levelno > logging.DEBUG]
