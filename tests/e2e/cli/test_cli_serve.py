"""``capsense serve``: starts, logs, serves and stops as documented."""

from __future__ import annotations

import json
import logging
import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("websockets", reason='needs websockets: pip install "capsense[serve]"')

from raw_websocket import HELLO, raw_websocket

from capsense.__main__ import main
from capsense.cli.serve import JsonLines
from capsense.errors import ProtocolError
from capsense.server.client import Client

WAIT = 120.0
"""Longest wait for a process [s]; only a failure takes so long."""
SERVE = [sys.executable, "-m", "capsense", "serve", "--design", "patch", "--port", "0"]


@contextmanager
def serving(*more: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A server in a process of its own, and its address."""
    with subprocess.Popen([*SERVE, *more], stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        try:
            yield process, json.loads(process.stderr.readline())["url"]
        finally:
            process.kill()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_serves_until_a_signal(number: signal.Signals, tmp_path: Path) -> None:
    """A token is asked for; a signal ends connections, the process with 0, the log with a line."""
    token = tmp_path / "token"
    token.write_text("correct horse\n")
    with serving("--token-file", str(token), "--readout", "fdc1004") as (process, url):
        with pytest.raises(ProtocolError, match="token"):
            Client(url)
        with Client(url, token="correct horse") as client:
            sensor = client.open()
            assert sensor.channel_names
            sensor.step(np.full((16, 16), 0.1))
            with urllib.request.urlopen(f"http{url[2:]}/health", timeout=WAIT) as answer:
                assert json.loads(answer.read())["readings"] == 1
            process.send_signal(number)
            assert process.wait(WAIT) == 0
            with pytest.raises(ProtocolError, match="1001"):
                sensor.step(np.full((16, 16), 0.1))
        assert process.stderr is not None
        entries = [json.loads(line) for line in process.stderr]
    assert entries[-1]["event"] == "stopped"
    assert all({"time", "level", "event"} <= set(entry) for entry in entries)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, -15)])
def test_a_second_signal_stops_at_once(number: signal.Signals, code: int) -> None:
    """Without waiting for a client that does not answer."""
    with serving() as (process, url), raw_websocket(int(url.rpartition(":")[2]), HELLO):
        assert process.stderr is not None
        process.send_signal(number)
        while json.loads(process.stderr.readline())["event"] != "stopping":
            pass
        process.send_signal(number)
        assert process.wait(WAIT) == code
        assert '"stopped"' not in process.stderr.read()


def test_whatever_is_logged_is_one_line() -> None:
    """Text from clients cannot forge a line, and a traceback is a field."""
    fields = {"name": 'x"}\n{"event": "forged\u2028'}
    try:
        raise RuntimeError("two\nlines")
    except RuntimeError:
        record = logging.LogRecord(
            "capsense.server", logging.ERROR, __file__, 1, "internal error", (), sys.exc_info()
        )
    record.fields = fields
    text = JsonLines().format(record)
    assert text.isascii()
    assert len(text.splitlines()) == 1
    entry = json.loads(text)
    assert (entry["event"], entry["level"], entry["name"]) == (
        "internal error", "error", fields["name"],
    )  # fmt: skip
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z", entry["time"])
    assert entry["exception"].startswith("Traceback")


def test_quiet() -> None:
    """No line for what goes well."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [*SERVE[:-1], str(port), "--quiet"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            until = time.monotonic() + WAIT
            while time.monotonic() < until:
                try:
                    Client(f"ws://127.0.0.1:{port}", timeout=WAIT).close()
                    break
                except OSError:
                    time.sleep(0.1)
            process.send_signal(signal.SIGTERM)
            _, logged = process.communicate(timeout=WAIT)
        finally:
            process.kill()
    assert (process.returncode, logged) == (0, "")


def test_address_in_use(capsys: pytest.CaptureFixture[str]) -> None:
    """A port that is taken is not the input's fault, and is named."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["serve", "--design", "patch", "--port", str(port), "-q"]) == 1
    assert str(port) in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--design", "pach"], "pach"),
        (["--design", "patch", "--readout", "fdc1005"], "fdc1005"),
        (["--design", "patch", "--design", "patch"], "two designs are named 'patch'"),
        (["--design", "patch", "--host", "0.0.0.0"], "give a token"),
        (["--design", "patch", "--token-file", "nowhere"], "--token-file nowhere cannot be read"),
        (["--design", "patch", "--token-file", os.devnull], "fewer than 8 characters"),
        (["--design", "patch", "--max-pixels", "0"], "pixels is 0"),
        (["--design", "patch", "--max-connections", "-1"], "connections is -1"),
        (["--design", "patch", "--port", "70000"], "port is 70000"),
    ],
)
def test_bad_input(arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    """One line on stderr names what is wrong, and the exit code is 2."""
    assert main(["serve", *arguments]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


def test_without_websockets() -> None:
    """The message names the install that fixes it."""
    code = (
        "import sys; sys.modules['websockets'] = None; from capsense.__main__ import main; "
        "sys.exit(main(['serve', '--design', 'patch']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 2
    assert 'pip install "capsense[serve]"' in done.stderr
