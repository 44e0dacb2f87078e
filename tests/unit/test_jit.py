"""How kernels are compiled: the same results as plain Numba's, and only what is needed."""

from __future__ import annotations

import gc
import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest
from numba.core import event
from numba.core.errors import TypingError

import capsense
from capsense import _jit
from capsense._by_reference import by_reference
from capsense.field.face_kernels import smooth


class Pair(NamedTuple):
    first: Any
    second: Any


class Inner(NamedTuple):
    values: Any
    limit: float


@by_reference
class Outer(NamedTuple):
    inner: Inner
    weights: Any
    count: int


def build(compiled: Callable[..., Any], kernel: Callable[..., Any]) -> tuple[Any, Any]:
    """An outer function, and the one in the middle, that work on arrays, tuples, errors."""

    @kernel
    def scale(values: Any, by: Any) -> Any:
        for i in range(values.shape[0]):
            values[i] = max(values[i], by) / 3.0

    @compiled
    def pair(count: Any, by: Any) -> Any:
        if count > 6:
            raise ValueError("more than six")
        table = np.empty((count, 3))
        for i in range(count):
            for j in range(3):
                table[i, j] = np.sqrt(i + 1.0) * (j + by)
        scale(table[:, 1], by)
        return Pair(table, np.zeros(count, np.int64))

    @compiled
    def outer(count: Any, by: Any) -> Any:
        total = 0.0
        for n in range(count):
            made = pair(n, by)
            row = made.first[n // 2 : n]
            for i in range(row.shape[0]):
                total += row[i, 0] * row[i, 1] - min(row[i, 2], 1.0) + made.second[i]
        return total

    return outer, pair


def kept(options: dict[str, Any]) -> Callable[..., Any]:
    """A decorator of plain Numba."""
    return lambda function: numba.njit(error_model="numpy", **options)(function)


@pytest.fixture
def compiled_names() -> Iterator[list[str]]:
    """Names of the kernels of this file that are compiled."""
    names: list[str] = []

    class Listener(event.Listener):
        def on_start(self, event: Any) -> None:
            if event.data["dispatcher"].__module__ == __name__:
                names.append(event.data["dispatcher"].__name__)

        def on_end(self, event: Any) -> None: ...

    listener = Listener()
    event.register("numba:compile", listener)
    yield names
    event.unregister("numba:compile", listener)


@pytest.fixture
def fresh_cache(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))


@pytest.mark.usefixtures("fresh_cache")
@pytest.mark.parametrize("known", [True, False])
def test_bits_of_plain_numba(
    known: bool, monkeypatch: pytest.MonkeyPatch, compiled_names: list[str]
) -> None:
    """Also with a version of Numba that is not known; each is compiled once for its callers."""
    if not known:
        monkeypatch.setattr(_jit, "_PARTS", ((9, 0), (9, 9)))
    _jit._compilers.cache_clear()
    outer, pair = build(_jit.compiled, _jit.kernel)
    plain, plain_pair = build(kept({}), kept({"_nrt": False}))
    assert outer(6, 0.7) == plain(6, 0.7)
    assert compiled_names.count("outer") == 2  # ours and the plain one
    compiled_names.clear()
    assert outer(5, 1.7) == plain(5, 1.7)
    assert outer(6, 0.7) == outer(6, 0.7) != outer(5, 1.7)
    assert compiled_names == []
    made, expected = pair(4, 0.2), plain_pair(4, 0.2)
    assert np.array_equal(made.first, expected.first)
    assert np.array_equal(made.second, expected.second)
    # what Python calls is compiled beside what kernels call, if only parts are made for these
    assert compiled_names == (["pair"] if known else [])
    for function in (outer, pair):
        with pytest.raises(ValueError, match="more than six"):
            function(9, 0.7)
    _jit._compilers.cache_clear()


def test_garbage_is_collected_after_an_error() -> None:
    """Of types as well; a collector that was off stays off."""

    @_jit.compiled
    def wrong(value: Any) -> Any:
        return value.no_such_thing

    for on in (True, False):
        (gc.enable if on else gc.disable)()
        with pytest.raises(TypingError):
            wrong(1.0)
        assert gc.isenabled() == on
    gc.enable()


def test_a_kernel_in_another_process(tmp_path: Path) -> None:
    """Regression: kernels could be pickled, but not be unpickled."""
    (tmp_path / "kernel").write_bytes(pickle.dumps(smooth))
    code = "import pickle, sys; print(pickle.load(open(sys.argv[1], 'rb'))(0.25))"
    run = [sys.executable, "-c", code, str(tmp_path / "kernel")]
    path = os.pathsep.join([str(Path(capsense.__file__).parents[1]), *sys.path])
    done = subprocess.run(
        run, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) == smooth(0.25)


def test_this_version_of_numba_is_known() -> None:
    """Else a first reading takes almost twice as long: try it, and widen ``_jit._PARTS``."""
    assert _jit._PARTS[0] <= numba.version_info.short <= _jit._PARTS[1]


def test_tuples_by_reference() -> None:
    """Differential: compiled code reads and returns what Python sees, and counts references."""

    def weigh(inner: Any, weights: Any) -> Any:
        total = 0.0
        for i in range(weights.shape[0]):
            total += min(inner.values[i], inner.limit) * weights[i]
        return total

    kernel_weigh = _jit.kernel(weigh)

    @_jit.compiled
    def both(given: Any) -> Any:
        return kernel_weigh(given.inner, given.weights), given.inner.values, given.count

    values, weights = np.arange(5.0), np.linspace(1.0, 2.0, 5)
    references = sys.getrefcount(values), sys.getrefcount(weights)
    for count in range(3):
        found = both(Outer(Inner(values, 2.5), weights, count))
        assert found[0] == weigh(Inner(values, 2.5), weights)
        assert found[2] == count
        np.testing.assert_array_equal(found[1], values)
    del found
    assert (sys.getrefcount(values), sys.getrefcount(weights)) == references
    with pytest.raises(TypingError, match="missing"):
        _jit.compiled(lambda given: given.missing)(Outer(Inner(values, 2.5), weights, 0))
