"""The page on the server: its snippets, and the client for browsers, run against one."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from running_server import WAIT, RunningServer

from capsense.server.options import Limits

PAGE = (Path(__file__).parents[3] / "docs" / "server.md").read_text(encoding="utf-8")
SCRIPT = Path(__file__).parents[3] / "examples" / "browser_client.js"
URL = "ws://127.0.0.1:8765"


def at(server: RunningServer, code: str) -> str:
    """Code for this server."""
    assert code.count(URL) == 1
    return code.replace(URL, server.url)


def snippet(server: RunningServer, number: int = 0) -> str:
    """A piece of the page's Python, for this server."""
    codes: list[str] = re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL)
    return at(server, codes[number])


def test_python(served: RunningServer) -> None:
    """It runs, and the last reading is that of a ball to the right."""
    scope: dict = {}
    exec(snippet(served), scope)
    own = scope["reading"].delta.diagonal()
    assert (own > 0).all()
    assert np.argmax(own) in (2, 5)


def test_hands(served: RunningServer) -> None:
    """The hand of the page is over the sensor."""
    scope: dict = {}
    exec(snippet(served, 1), scope)
    assert scope["reading"].delta.diagonal().min() > 5e-15


def test_javascript(served: RunningServer, tmp_path: Path) -> None:
    """It runs, and every electrode's signal rises as the ball comes down."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("needs node, version 20 or later")
    program = tmp_path / "page.js"
    program.write_text(at(served, SCRIPT.read_text(encoding="utf-8")), encoding="utf-8")
    command = [node, "--experimental-websocket", str(program)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=WAIT)
    if "WebSocket is not defined" in done.stderr or "bad option" in done.stderr:
        pytest.skip("needs node, version 20 or later")
    rows = np.array([[float(v) for v in line.split()] for line in done.stdout.splitlines()])
    assert rows.shape == (20, 6), done.stderr
    assert (np.diff(rows[1:], axis=0) > 0).all()


def test_defaults_of_the_table() -> None:
    """The limits are those of the code."""
    documented = dict(re.findall(r"^\| `--max-(\w+)` \| (\d+) \|", PAGE, flags=re.MULTILINE))
    assert {name: str(getattr(Limits(), name)) for name in documented} == documented
    assert len(documented) == 4
