"""A word to whoever waits while kernels are compiled, the first time on a machine."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_log = logging.getLogger("capsense")

WAIT = 2.0
"""It is said after so long [s]."""
_done = False


@contextmanager
def first_use() -> Iterator[None]:
    """Say, if the first use in a process takes long, that kernels are compiled and then kept.

    It is a warning of the logger ``capsense``, which goes to standard error unless told otherwise.
    """
    global _done
    if _done:
        yield
        return
    timer = threading.Timer(
        WAIT, _log.warning,
        ["compiling the solver for this processor; it takes half a minute once, and is then kept"],
    )  # fmt: skip
    timer.daemon = True
    timer.start()
    try:
        yield
        _done = True
    finally:
        timer.cancel()
