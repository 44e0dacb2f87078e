"""A lock between processes, and between threads, that a dying process cannot leave behind."""

from __future__ import annotations

import errno
import logging
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

try:
    import fcntl
except ImportError:  # not a POSIX system
    fcntl = None  # type: ignore[assignment]

_log = logging.getLogger(__name__)

_POLL = 0.1
"""Time between two attempts to take a lock [s]."""
_BUSY = (errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES)


@contextmanager
def exclusive(path: Path, waiting: Callable[[], None] = lambda: None) -> Iterator[bool]:
    """Hold the lock ``path``; ``waiting`` is called now and then while somebody else holds it.

    Yields whether it is held: where files cannot be locked or written, work goes on without. The
    file is removed in the end.
    """
    file = _acquire(path, waiting)
    try:
        yield file is not None
    finally:
        if file is not None:
            with suppress(OSError):
                path.unlink()
            with suppress(OSError):
                # a forked child shares the open file; closing it here would not free the lock
                fcntl.flock(file, fcntl.LOCK_UN)
            file.close()


def _acquire(path: Path, waiting: Callable[[], None]) -> IO[bytes] | None:
    if fcntl is None:
        return None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        while True:
            file = open(path, "ab")  # noqa: SIM115
            try:
                _take(file, waiting)
                if _is_at(file, path):
                    return file
            except BaseException:
                file.close()
                raise
            file.close()  # its last holder has removed it; another may be there by now
    except OSError as error:
        _log.info("builds of the same field are not kept apart: %s", error)
        return None


def _take(file: IO[bytes], waiting: Callable[[], None]) -> None:
    while True:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except OSError as error:
            if error.errno not in _BUSY:
                raise
        waiting()
        time.sleep(_POLL)


def _is_at(file: IO[bytes], path: Path) -> bool:
    """Whether an open file is still the one that its path leads to."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False
