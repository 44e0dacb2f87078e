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
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock
from numba import njit
from numba.core.caching import FunctionCache
from numba.core.compiler_lock import global_compiler_lock

from capsense import _kernel_cache

_log = logging.getLogger("capsense")

WAIT = 2.0
"""A first use that takes longer than this [s] is explained."""
_done = False


class _Cache(FunctionCache):
    """Numba's, for processes that start together and for full disks."""

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compiled kernel; where that cannot be done, it is used all the same."""
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _log.info("a compiled kernel cannot be kept: %s", error)

    @contextmanager
    def alone(self, sig: Any, context: Any) -> Iterator[None]:
        """Keep other processes from compiling the kernel, if its code is not kept yet.

        They wait, and find it kept. Numba itself lets all compile it, and may lose or mix up what
        they keep of one kernel for different types.
        """
        if self._index_key(sig, context.codegen()) in self._cache_file._load_index():
            yield
            return
        path = Path(self.cache_path, f"{self._impl.filename_base}.lock")
        lock = FileLock(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            lock.acquire(poll_interval=0.02)
        except (OSError, NotImplementedError) as error:
            _log.info("processes may compile the same kernel: %s", error)
        try:
            yield
        finally:
            if lock.is_locked:
                with suppress(OSError):
                    path.unlink()  # before others can have it; those who wait see that it is gone
                lock.release()


def _jit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    options["no_cfunc_wrapper"] = True  # nothing calls kernels by address

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = njit(nogil=True, error_model="numpy", **options)(function)
        if dispatcher is function:  # NUMBA_DISABLE_JIT=1
            return function
        dispatcher._cache = cache = _Cache(function)
        compile_any = dispatcher.compile

        def compile_once(sig: Any) -> Any:
            # Numba's lock comes first: a thread must not wait for it with a file locked
            with global_compiler_lock, cache.alone(sig, dispatcher.targetctx):
                return compile_any(sig)

        dispatcher.compile = compile_once
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
    """Say, if the first use in a process takes long, that kernels are compiled.

    It is a warning of the logger ``capsense``, which goes to standard error unless told otherwise.
    """
    global _done
    if _done:
        yield
        return
    often = "once, and is then kept" if _kernel_cache.kept else "in each process"
    told = f"compiling the solver for this processor; it takes half a minute {often}"
    timer = threading.Timer(WAIT, _log.warning, [told])
    timer.daemon = True
    timer.start()
    try:
        yield
        _done = True
    finally:
        timer.cancel()
