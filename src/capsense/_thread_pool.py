"""Threads that do the same kind of work for many sensors or scenes."""

from __future__ import annotations

import itertools
import os
import threading
import weakref
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from capsense._validate import as_whole
from capsense.errors import CapSenseError, listed

Array = NDArray[np.float64]

Key = TypeVar("Key", bound=Hashable)
Result = TypeVar("Result")


_TURNS = 6
"""Calls for tasks that share them, for each thread, at least: no thread then waits long for
another."""
_PARTS = 8
"""Parts of a piece of work, for each thread: no thread then waits long for another."""


def processors() -> int:
    """How many processors this process may use; all of them where a system does not tell."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def in_parts(kernel: Callable[..., None], count: int, *args: Any) -> None:
    """Call ``kernel(start, stop, *args)`` for parts of 0 to ``count``, on all processors.

    Threads of Python that end with the call, not Numba's own: after those have run, a process that
    is forked off ends when it runs some too.
    """
    threads = processors()
    bounds = np.linspace(0, count, min(count, _PARTS * threads) + 1).astype(int).tolist()
    with ThreadPoolExecutor(threads, thread_name_prefix="capsense") as pool:
        parts = [pool.submit(kernel, a, b, *args) for a, b in itertools.pairwise(bounds)]
        try:
            for part in parts:
                part.result()
        finally:
            for part in parts:  # after an interrupt, those that have not begun
                part.cancel()


def filled(kernel: Callable[..., None], out: Array, *args: Any) -> Array:
    """Fill the rows of ``out`` by ``kernel(start, stop, *args, out)``, as :func:`in_parts`."""
    in_parts(kernel, len(out), *args, out)
    return out


_LOCKS: weakref.WeakSet[ForkSafeRLock] = weakref.WeakSet()


def _renew() -> None:
    for one in list(_LOCKS):
        one._lock = threading.RLock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew)


class ForkSafeRLock:
    """A lock for what one thread may use at a time; a copy, or a pickled one, is a new lock.

    So is that of a forked process: a thread that held it has not come along.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()
        _LOCKS.add(self)

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def __reduce__(self) -> tuple[type[ForkSafeRLock], tuple[()]]:
        return ForkSafeRLock, ()


class ThreadPool:
    """Threads that share the work of reading, the calling thread among them.

    The solver's kernels run beside each other; Python between them does not. No two tasks may
    share anything that changes; results then do not depend on the number of threads.

    Args:
        threads: How many; by default as many as the process may use processors.

    Raises:
        ValueError: ``threads`` is not a positive whole number.
    """

    def __init__(self, threads: int | None = None) -> None:
        if threads is None:
            threads = processors()
        whole = as_whole(threads)
        if whole is None or whole < 1:
            raise ValueError(f"threads is {threads!r}; give a whole number from 1")
        self.threads = whole
        """How many threads read, the calling one included."""
        self._pool: ThreadPoolExecutor | None = None
        self._process = 0

    def __reduce__(self) -> tuple[type[ThreadPool], tuple[int]]:
        """A copy has threads of its own."""
        return ThreadPool, (self.threads,)

    def _helpers(self) -> ThreadPoolExecutor:
        """The other threads; a forked process inherits none, so that it starts its own."""
        if self._pool is None or self._process != os.getpid():
            self._pool = ThreadPoolExecutor(self.threads - 1, thread_name_prefix="capsense")
            self._process = os.getpid()
        return self._pool

    def run(
        self, tasks: Mapping[Key, Callable[[], Result]]
    ) -> tuple[dict[Key, Result], dict[Key, CapSenseError]]:
        """Do all tasks; return what they gave and the errors of those that failed, by key.

        Both are in the order of the tasks.
        """
        queue = deque(tasks.items())
        results: dict[Key, Result] = {}
        failures: dict[Key, CapSenseError] = {}

        def work() -> None:
            while True:
                try:
                    key, task = queue.popleft()
                except IndexError:
                    return
                try:
                    results[key] = task()
                except CapSenseError as error:
                    failures[key] = error

        helpers = min(self.threads, len(tasks)) - 1
        futures = [self._helpers().submit(work) for _ in range(helpers)]
        try:
            work()
        finally:
            queue.clear()  # after an error that nobody foresaw
            for future in futures:
                future.result()
        return (
            {key: results[key] for key in tasks if key in results},
            {key: failures[key] for key in tasks if key in failures},
        )

    def run_together(
        self,
        groups: Iterable[Sequence[Key]],
        most: int,
        work: Callable[[Sequence[Key]], Sequence[Result | CapSenseError]],
    ) -> tuple[dict[Key, Result], dict[Key, CapSenseError]]:
        """As :meth:`run`, for tasks of which several are done in one call; in the groups' order.

        Args:
            groups: Keys of tasks that may share a call, group by group.
            most: So many share one at most; fewer where threads would have few calls each.
            work: Does some tasks of a group: what each gave, or its error.
        """
        lists = list(groups)
        size = -(-sum(map(len, lists)) // (_TURNS * self.threads))
        size = max(1, min(most, size))
        parts = [keys[k : k + size] for keys in lists for k in range(0, len(keys), size)]
        done, lost = self.run({n: partial(work, keys) for n, keys in enumerate(parts)})
        results: dict[Key, Result] = {}
        failures: dict[Key, CapSenseError] = {}
        for n, keys in enumerate(parts):
            for key, found in zip(keys, done.get(n) or len(keys) * [lost[n]], strict=True):
                if isinstance(found, CapSenseError):
                    failures[key] = found
                else:
                    results[key] = found
        return results, failures


def some_failed(what: str, failures: Mapping[Key, CapSenseError], count: int) -> str:
    """The message for some of ``count`` readings that failed."""
    first, error = next(iter(failures.items()))
    others = list(failures)[1:]
    rest = f" (and so did {listed(others, 8)})" if others else ""
    return (
        f"{len(failures)} of {count} {what} failed; {first!r}: {error}{rest}; "
        "the others' readings are in this error's readings"
    )
