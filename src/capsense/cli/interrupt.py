"""Ctrl-C and termination requests: stop between two steps, not in the middle of one."""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Any


class Interrupt:
    """While in its ``with`` block, takes SIGINT and SIGTERM.

    Before :attr:`deferring` is set, a signal raises :class:`KeyboardInterrupt` at once. After,
    the first one only sets :attr:`requested`, which the caller checks between steps; a second
    one raises.
    """

    def __init__(self) -> None:
        self.deferring = False
        self.requested = False
        self._previous: list[tuple[int, Any]] = []

    def __enter__(self) -> Interrupt:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous.append((number, signal.signal(number, self._receive)))
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous:
            signal.signal(number, handler)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if self.deferring and not self.requested:
            self.requested = True
        else:
            raise KeyboardInterrupt
