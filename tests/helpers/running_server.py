"""A server in a thread of its own."""

from __future__ import annotations

import asyncio
import json
import logging
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from typing import Any

from capsense.server.client import Client
from capsense.server.options import Limits, ServerOptions
from capsense.server.server import Server

WAIT = 120.0
"""Longest wait for a server to start or stop, and for whatever else must happen [s]."""


def wait_for(condition: Callable[[], object]) -> None:
    """Wait until a condition holds."""
    deadline = time.monotonic() + WAIT
    while not condition():
        assert time.monotonic() < deadline, "it never came about"
        time.sleep(0.005)


class RunningServer:
    """Serves within its ``with`` block.

    Args:
        options: ``port`` is 0, any free one, unless it is given; ``limits`` are those of
            :meth:`patient`.
    """

    def __init__(self, *designs: str, port: int = 0, **options: Any) -> None:
        options.setdefault("limits", self.patient())
        self.events: list[dict[str, Any]] = []
        """What was logged."""
        logger = logging.Logger("test")
        logger.addHandler(_Collector(self.events))
        self.server = Server(
            ServerOptions(designs or ("six_patch",), port=port, **options), logger=logger
        )
        self._ready = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run()), daemon=True)

    def __enter__(self) -> RunningServer:
        self._thread.start()
        assert self._ready.wait(WAIT)
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def url(self) -> str:
        """Its address."""
        return self.server.url

    @property
    def port(self) -> int:
        """Its port."""
        return int(self.url.rpartition(":")[2])

    @staticmethod
    def patient(**limits: Any) -> Limits:
        """Limits with which a busy machine dismisses nobody, but for those that are given."""
        return Limits(**{"hello_timeout": WAIT, "send_timeout": WAIT, **limits})

    def client(self, **options: Any) -> Client:
        """A new client, which waits for answers as long as tests do."""
        return Client(self.url, **{"timeout": WAIT, **options})

    def stop(self) -> None:
        """Stop serving, and wait for the end."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(WAIT)
        assert not self._thread.is_alive()

    def logged(self, event: str) -> list[dict[str, Any]]:
        """The fields of all events of a name."""
        return [e for e in self.events if e["event"] == event]

    def get(self, path: str) -> tuple[int, dict[str, Any]]:
        """Status and content of a plain HTTP request."""
        try:
            with urllib.request.urlopen(f"http{self.url[2:]}{path}", timeout=WAIT) as answer:
                return answer.status, json.loads(answer.read())
        except urllib.error.HTTPError as answer:
            return answer.code, {}

    async def _run(self) -> None:
        self._stop, self._loop = asyncio.Event(), asyncio.get_running_loop()
        serving = asyncio.create_task(self.server.run(self._stop))
        while not self.server.url and not serving.done():
            await asyncio.sleep(0.005)
        self._ready.set()
        await serving


class _Collector(logging.Handler):
    def __init__(self, events: list[dict[str, Any]]) -> None:
        super().__init__()
        self._events = events

    def emit(self, record: logging.LogRecord) -> None:
        fields = getattr(record, "fields", {})
        self._events.append({"event": record.getMessage(), "level": record.levelname, **fields})
