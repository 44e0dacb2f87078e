"""Threads that share tasks."""

from __future__ import annotations

import multiprocessing
import os
import threading
import time

import numpy as np
import pytest

from capsense._thread_pool import ForkSafeRLock, ThreadPool, processors, some_failed
from capsense.errors import SceneError


def test_tasks_run_beside_each_other() -> None:
    """Two tasks that wait for each other finish with two threads."""
    meet = threading.Barrier(2, timeout=20)
    results, failures = ThreadPool(2).run({"a": meet.wait, "b": meet.wait})
    assert set(results.values()) == {0, 1}
    assert not failures


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_results_and_failures_are_in_the_order_of_the_tasks(threads: int) -> None:
    """Every task is done once, whatever fails beside it."""

    def task(k: int) -> int:
        if k % 3 == 0:
            raise SceneError(f"no {k}")
        return k * k

    results, failures = ThreadPool(threads).run({k: lambda k=k: task(k) for k in range(20)})
    assert list(results.items()) == [(k, k * k) for k in range(20) if k % 3]
    assert [(k, str(e)) for k, e in failures.items()] == [(k, f"no {k}") for k in range(0, 20, 3)]


@pytest.mark.parametrize("threads", [1, 2])
def test_what_it_did_not_foresee_is_passed_on(threads: int) -> None:
    """A bug in a task is not taken for a failing sensor."""

    def broken() -> int:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        ThreadPool(threads).run({"a": broken, "b": broken})


def test_after_a_bug_nothing_more_is_begun() -> None:
    """The other thread ends what it is at, and takes nothing new."""
    meet, done = threading.Barrier(2, timeout=20), []

    def first() -> None:
        meet.wait()
        if threading.current_thread() is threading.main_thread():
            raise ZeroDivisionError
        time.sleep(0.5)

    tasks = {k: first for k in range(2)} | {k: lambda k=k: done.append(k) for k in range(2, 40)}
    with pytest.raises(ZeroDivisionError):
        ThreadPool(2).run(tasks)
    assert not done


def test_a_report_names_the_first_failure_and_lists_the_others() -> None:
    """Not all of hundreds."""
    failures = {k: SceneError(f"no {k}") for k in range(3, 40)}
    assert some_failed("scenes", failures, 50) == (
        "37 of 50 scenes failed; 3: no 3 (and so did 4, 5, 6, 7, 8, 9, 10, 11 and 28 more); "
        "the others' readings are in this error's readings"
    )


@pytest.mark.parametrize("threads", [0, -1, 1.5, True, "2"])
def test_refused(threads: object) -> None:
    """Not a positive whole number."""
    with pytest.raises(ValueError, match=r"threads is .*give a whole number from 1"):
        ThreadPool(threads)  # type: ignore[arg-type]


def test_a_number_of_numpy() -> None:
    """As computed from other counts."""
    assert ThreadPool(np.int64(2)).threads == 2


def test_processors_where_a_system_does_not_tell(monkeypatch: pytest.MonkeyPatch) -> None:
    """macOS and Windows have no affinity: all processors count."""
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    assert processors() == os.cpu_count()


def test_a_lock_that_is_held_while_the_process_forks() -> None:
    """Regression: the thread that holds it is not in the child, which would wait for ever."""
    one, held, done = ForkSafeRLock(), threading.Event(), threading.Event()

    def hold() -> None:
        with one:
            held.set()
            done.wait()

    holder = threading.Thread(target=hold)
    holder.start()
    held.wait()
    child = multiprocessing.get_context("fork").Process(target=one.__enter__)
    child.start()
    child.join(20)
    ended = child.exitcode
    child.kill()
    done.set()
    holder.join()
    assert ended == 0
