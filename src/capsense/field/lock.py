"""A lock between processes, and between threads, that a dying process cannot leave behind."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

_log = logging.getLogger(__name__)

_POLL = 0.1
"""Time between two attempts to take a lock [s]."""


@contextmanager
def exclusive(path: Path, waiting: Callable[[], None] = lambda: None) -> Iterator[bool]:
    """Hold the lock ``path``; ``waiting`` is called now and then while somebody else holds it.

    Yields whether it is held: where files cannot be locked or written, work goes on without. The
    file is removed in the end.
    """
    lock = FileLock(path)
    held = _acquire(lock, path, waiting)
    try:
        yield held
    finally:
        if held:
            with suppress(OSError):
                path.unlink()  # before others can have it; those who wait see that it is gone
            with suppress(OSError):
                lock.release()


def _acquire(lock: FileLock, path: Path, waiting: Callable[[], None]) -> bool:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        while True:
            try:
                lock.acquire(timeout=_POLL, poll_interval=_POLL)
                return True
            except Timeout:
                waiting()
    except OSError as error:
        _log.info("builds of the same field are not kept apart: %s", error)
        return False
