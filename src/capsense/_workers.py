"""Pools of processes that end with the process that started them."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context, parent_process
from typing import Any


def process_pool(
    workers: int, begin: Callable[..., object] | None = None, *given: Any
) -> ProcessPoolExecutor:
    """A pool of new interpreters, which end as soon as this process does, however it ends.

    A worker waits for its next task on a pipe that the other workers hold as well, so that it
    learns nothing from it of the end of its parent. Each therefore also watches the parent
    itself.

    Args:
        workers: How many processes.
        begin: Called once in each of them, before its first task.
        given: Arguments of ``begin``: what may be passed to a process as it starts.
    """
    return ProcessPoolExecutor(
        workers, mp_context=get_context("spawn"), initializer=_begin, initargs=(begin, given)
    )


def _begin(begin: Callable[..., object] | None, given: tuple[Any, ...]) -> None:
    threading.Thread(target=_end_with_parent, name="end-with-parent", daemon=True).start()
    if begin is not None:
        begin(*given)


def _end_with_parent() -> None:
    """End this process, whatever it is doing, when the one that started it has ended.

    multiprocessing holds a pipe for this, whose other end only the parent has, or on Windows the
    parent's handle: it also tells of a parent that was killed, or had ended before this began.
    """
    parent = parent_process()
    assert parent is not None, "this is no process of multiprocessing"
    parent.join()
    os._exit(1)
