"""How the kernels of the online solver are compiled, and a word to whoever waits for that.

None may reorder sums (``fastmath``): Numba puts a kernel that others call into each of them, and
which of its versions runs depends on what was loaded first. With sums reordered they differ in the
last bits, and a recording would not replay. What is worth doing eight at a time is written so, with
:mod:`capsense._simd`.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from numba import njit
from numba.core.caching import FunctionCache

_log = logging.getLogger("capsense")

WAIT = 2.0
"""A first use that takes longer than this [s] is explained."""
_done = False


class _Cache(FunctionCache):
    """Numba's, but that a kernel which cannot be kept, on a full disk say, is used all the same."""

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _log.info("a compiled kernel cannot be kept: %s", error)


def _jit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    options["no_cfunc_wrapper"] = True  # nothing calls kernels by address

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = njit(nogil=True, error_model="numpy", **options)(function)
        dispatcher._cache = _Cache(function)
        return dispatcher

    return decorate


compiled = _jit()
"""Compiled, without Python's lock, and kept; division by zero gives infinity."""
kernel = _jit(_nrt=False)
"""The same without reference counts, so that nothing can be allocated inside.

Numba counts references to every array that is passed on or sliced, by atomic operations; they took
more than half of the time of a scan. Room that a kernel needs is therefore handed to it.
"""
inlined = _jit(_nrt=False, inline="always")
"""The same, for what is written into the kernel that calls it."""
pasted = njit(inline="always")
"""What is written into the kernel that calls it, and may allocate."""


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
