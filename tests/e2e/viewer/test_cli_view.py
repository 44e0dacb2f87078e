"""``capsense view``: arguments, addresses, beginning and end."""

from __future__ import annotations

import json
import re
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

pytest.importorskip("viser", reason='needs viser: pip install "capsense[view]"')

from ball_scenario import ball_scenario

from capsense.__main__ import main

WAIT = 120.0
"""Longest wait for a process [s]; only a failure takes so long."""
VIEW = [sys.executable, "-m", "capsense", "view", "--port", "0"]


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    path = tmp_path / "ball.toml"
    path.write_text(ball_scenario())
    return path


@contextmanager
def viewing(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A view in a process of its own, and its page's address."""
    command = [*VIEW, *arguments]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True) as process:
        assert process.stdout is not None
        try:
            yield process, process.stdout.readline().strip()
        finally:
            process.kill()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_shows_until_a_signal(number: signal.Signals, scenario: Path) -> None:
    """The address is printed, and how to reach it; the page is there; a signal ends it with 0."""
    with viewing(str(scenario)) as (process, url):
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+", url)
        with urllib.request.urlopen(url, timeout=WAIT) as answer:
            assert b"<html" in answer.read()
        process.send_signal(number)
        out, errors = process.communicate(timeout=WAIT)
    assert process.returncode == 0
    assert out == ""
    assert errors.count("\n") == 1
    port = url.rpartition(":")[2]
    assert f"ssh -L {port}:127.0.0.1:{port} {socket.gethostname()}" in errors


def test_quiet(scenario: Path) -> None:
    """Nothing but the address."""
    with viewing(str(scenario), "--quiet", "--paused") as (process, url):
        assert url.startswith("http://127.0.0.1:")
        process.send_signal(signal.SIGINT)
        assert process.communicate(timeout=WAIT) == ("", "")
    assert process.returncode == 0


def test_open_to_others_is_warned_of(scenario: Path) -> None:
    """A page that others can reach is said to be."""
    with viewing(str(scenario), "--host", "0.0.0.0") as (process, _):
        process.send_signal(signal.SIGINT)
        assert "whoever reaches this address" in process.communicate(timeout=WAIT)[1]


def test_watches_a_server() -> None:
    """It waits for a client, and shows its sensor."""
    pytest.importorskip("websockets", reason='needs websockets: pip install "capsense[serve]"')
    from capsense.server.client import Client

    serve = [sys.executable, "-m", "capsense", "serve", "--design", "patch", "--port", "0"]
    with subprocess.Popen([*serve, "--watch"], stderr=subprocess.PIPE, text=True) as server:
        try:
            assert server.stderr is not None
            address = json.loads(server.stderr.readline())["url"]
            with Client(address) as client:
                client.open()
                with viewing("--connect", address, "-q") as (process, url):
                    assert url.startswith("http://127.0.0.1:")
                    process.send_signal(signal.SIGINT)
                    assert process.communicate(timeout=WAIT) == ("", "")
                assert process.returncode == 0
        finally:
            server.terminate()
        events = [json.loads(line)["event"] for line in server.stderr]
    assert "watches" in events


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "nothing is given; give one of a scenario file"),
        (["a.toml", "--connect", "ws://127.0.0.1:9"], "a scenario and --connect is given"),
        (["a.toml", "--replay", "a.mcap"], "a scenario and --replay is given"),
        (["nowhere.toml"], "nowhere.toml"),
        (["--replay", "nowhere.mcap"], "nowhere.mcap"),
        (["--replay", "a.mcap", "--rate", "5"], "--rate goes with a scenario only"),
        (["nowhere.toml", "--sensor", "1:0"], "--sensor goes with --connect only"),
        (["nowhere.toml", "--token-file", "t"], "--token-file goes with --connect only"),
        (["--connect", "ws://127.0.0.1:9"], "no server to watch at ws://127.0.0.1:9"),
        (["--connect", "ws://127.0.0.1:9", "--token-file", "nowhere"], "nowhere cannot be read"),
        (["nowhere.toml", "--port", "99999"], "port 99999"),
    ],
)
def test_bad_input(arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    """One line on stderr names what is wrong, before anything starts; the exit code is 2."""
    assert main(["view", "--port", "0", *arguments]) == 2
    out, error = capsys.readouterr()
    assert words in error
    assert (error.count("\n"), out) == (1, "")


@pytest.mark.parametrize("text", ["3", "a:b", ":", "-1:0"])
def test_sensor_that_is_none(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Neither client nor sensor."""
    with pytest.raises(SystemExit, match="2"):
        main(["view", "--connect", "ws://127.0.0.1:9", f"--sensor={text}"])
    assert "is not CLIENT:SENSOR" in capsys.readouterr().err


def test_port_that_is_taken(scenario: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It is named, and another is suggested."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["view", str(scenario), "--port", str(port)]) == 2
    assert f"port {port}" in capsys.readouterr().err


def test_without_viser(scenario: Path) -> None:
    """The message names the install that fixes it."""
    code = (
        "import sys; sys.modules['viser'] = None; from capsense.__main__ import main; "
        f"sys.exit(main(['view', {str(scenario)!r}]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 2
    assert 'pip install "capsense[view]"' in done.stderr
