"""How the kernels of the online solver are compiled, and a notice while that takes long.

None may reorder sums (``fastmath``): Numba puts a kernel that others call into each of them, and
which of its versions runs depends on what was loaded first. With sums reordered they differ in the
last bits, and a recording would not replay. What is worth doing eight at a time is written so, with
:mod:`capsense._simd`.
"""

from __future__ import annotations

import gc
import hashlib
import logging
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import numba
from filelock import FileLock
from numba import config, types, version_info
from numba.core.caching import FunctionCache
from numba.core.compiler import Compiler
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher

from capsense import _kernel_cache

_log = logging.getLogger("capsense")
_progress = logging.getLogger("capsense.kernels")

WAIT = 2.0
"""Compiling that takes longer than this [s] is announced."""
EVERY = 10.0
"""Seconds between messages that tell how many kernels are compiled."""
_PLAIN = os.environ.get("CAPSENSE_PLAIN_NUMBA", "0") not in ("", "0")
"""``CAPSENSE_PLAIN_NUMBA=1``: ``numba.njit(cache=True)`` alone compiles kernels. It uses public
interfaces of Numba only, takes longer, and notices changed sources of a kernel's own file only."""


_PARTS_WITH_KERNELS = "design", "scene", "field", "solver", "fleet", "adapters"
SOURCES = "*.py", *(f"{part}/**/*.py" for part in _PARTS_WITH_KERNELS)
"""Modules of the package that kernels, and the constants in them, are in."""


@lru_cache(maxsize=1)
def _sources() -> str:
    """A digest of all modules whose kernels or constants may end up in a compiled kernel."""
    digest, root = hashlib.sha256(), Path(__file__).parent
    for pattern in SOURCES:
        for file in sorted(root.glob(pattern)):
            digest.update(file.read_bytes())
    return digest.hexdigest()


class _Cache(FunctionCache):
    """Numba's, for processes that start together, for full disks, and for changed sources.

    Numba compiles a kernel anew when its own file changes. Kernels hold those that they call.
    """

    def __init__(self, py_func: Any) -> None:
        super().__init__(py_func)
        self._cache_file._source_stamp = self._cache_file._source_stamp, _sources()

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
        with _announced(), self._locked():
            yield

    @contextmanager
    def _locked(self) -> Iterator[None]:
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


_depth, _said, _count = 0, False, 0
"""How many kernels are being compiled, one for another; whether it was announced; how many were
compiled in this process."""


@contextmanager
def _announced() -> Iterator[None]:
    """Log that kernels are compiled, once in a process, where that takes longer than ``WAIT``.

    While it goes on, how many there are follows every ten seconds. These are warnings of the
    loggers ``capsense`` and ``capsense.kernels``, which go to standard error unless told otherwise.
    """
    global _depth, _count
    done = threading.Event()
    if _depth == 0:
        threading.Thread(target=_tell, args=(done,), daemon=True).start()
    _depth += 1
    try:
        yield
    finally:
        _depth -= 1
        _count += 1
        done.set()


def _tell(done: threading.Event) -> None:
    """Announce what goes on until an event, and how far it is."""
    global _said
    if not _said:
        if done.wait(WAIT):
            return
        _said = True
        often = "once on this machine" if _kernel_cache.kept else "in each process"
        _log.warning(
            "compiling kernels for this processor; it takes about a minute %s; "
            "capsense warmup does it ahead of time", often,
        )  # fmt: skip
    while not done.wait(EVERY):
        _progress.warning("compiling kernels: %d so far", _count)


class _PartCache(_Cache):
    """For what only kernels call, beside what Python calls of the same name."""

    def _index_key(self, sig: Any, codegen: Any) -> Any:
        return super()._index_key(sig, codegen), "part"


class _Part(CPUDispatcher):
    """Compiles a function for the kernels that call it; Python cannot call it."""

    _kept: type[_Cache] = _PartCache

    def __init__(self, py_func: Any, targetoptions: Any, compiler: Any) -> None:
        super().__init__(py_func, targetoptions=targetoptions, pipeline_class=compiler)
        self._cache = self._kept(py_func)

    def compile(self, sig: Any) -> Any:
        """Compile for types, unless another process has, or does."""
        # Numba's lock comes first: a thread must not wait for it with a file locked
        with (
            global_compiler_lock,
            self._cache.alone(sig, self.targetctx),
            _nothing_collected(),
            _optimized(),
        ):
            return super().compile(sig)


class _Kernel(_Part):
    """Compiles a function for Python; kernels that call it find its :class:`_Part`."""

    _kept = _Cache

    def __init__(self, py_func: Any, locals: Any, targetoptions: Any) -> None:
        # Numba makes it anew in this way when it is unpickled
        whole, part = _compilers()
        super().__init__(py_func, targetoptions, whole)
        options = {**targetoptions, "no_cpython_wrapper": True}
        self._part = _Part(py_func, options, part) if part else self

    @property
    def _numba_type_(self) -> Any:
        return types.Dispatcher(self._part)


_PARTS = (0, 64), (0, 68)
"""Versions of Numba that :mod:`capsense._parts` was tried with, the first and the last."""


@lru_cache(maxsize=1)
def _compilers() -> tuple[Any, Any]:
    """What compiles what Python calls, and what kernels call, None for the same.

    With a version that is not known it is all Numba's own, and a first reading takes longer.
    """
    if not _PARTS[0] <= version_info.short <= _PARTS[1]:
        return Compiler, None
    from capsense import _parts

    return _parts.KernelCompiler, _parts.PartCompiler


@contextmanager
def _nothing_collected() -> Iterator[None]:
    """Without garbage collection: it takes a sixth of a compiler's time, and finds little."""
    was = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()


_LEVEL = int(os.environ.get("NUMBA_OPT", "1").replace("max", "3"))
"""LLVM's level of optimisation. At 3 compiling takes a tenth longer, and steps take as long."""


@contextmanager
def _optimized() -> Iterator[None]:
    """With that level, in place of the one that Numba takes for everybody's functions."""
    was = config.OPT  # type: ignore[attr-defined]
    config.OPT = type(was)(_LEVEL)  # type: ignore[attr-defined]
    try:
        yield
    finally:
        config.OPT = was  # type: ignore[attr-defined]


_OFF = bool(config.DISABLE_JIT)  # type: ignore[attr-defined]
"""``NUMBA_DISABLE_JIT=1``: Python runs kernels itself."""


def _jit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """A decorator for functions that Python calls, or other kernels, or both."""
    options |= {"nopython": True, "nogil": True, "error_model": "numpy"}
    if _PLAIN:
        return numba.njit(cache=True, **options)
    options["no_cfunc_wrapper"] = True  # nothing calls kernels by address

    def decorate(function: Callable[..., Any]) -> Any:
        return function if _OFF else _Kernel(function, None, options)

    return decorate


compiled = _jit()
"""Compiled, without Python's lock, and kept; division by zero gives infinity."""
kernel = _jit(_nrt=False)
"""Compiled without reference counts, so that nothing can be allocated inside.

Numba counts references to every array that is passed on or sliced, by atomic operations; they took
more than half of the time of a scan, and a fifth of a step. Room that a kernel needs is therefore
handed to it. It returns no arrays, not even parts of those that it was given.
"""
