"""Compiled kernels where no place of Numba's can be written."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

import capsense
from capsense import _jit, _kernel_cache


def _path() -> str:
    """Where programs find this package."""
    return os.pathsep.join(
        [str(Path(capsense.__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
    )


PROGRAM = """
import os, sys, tempfile
from numba.core import caching

def refuse(self):
    raise PermissionError

for locator in (caching.InTreeCacheLocator, caching.UserWideCacheLocator):
    locator.ensure_cache_path = refuse
os.access = lambda *_: False
if len(sys.argv) > 1:
    make = tempfile.mkdtemp
    tempfile.mkdtemp = lambda dir=None, **n: make(dir=dir, **n) if dir else refuse(0)
import capsense
from capsense.scene import image_kernels
print(os.environ.get("NUMBA_CACHE_DIR"))
"""


@pytest.mark.parametrize("option", [[], ["no temporary folder"]])
def test_a_container_without_a_writable_place(option: list[str]) -> None:
    """Kernels compile in a folder of the process, which goes with it; a warning names the fix."""
    if option and not Path("/dev/shm").is_dir():
        pytest.skip("no file system in memory")
    keep = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    found = subprocess.run(
        [sys.executable, "-c", PROGRAM, *option],
        env={**keep, "PYTHONPATH": _path()}, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert found.returncode == 0, found.stderr
    assert "set NUMBA_CACHE_DIR to a folder that can" in found.stderr
    folder = Path(found.stdout.strip())
    assert folder.name.startswith("capsense-kernels-")
    assert not folder.exists()


@pytest.mark.parametrize("kept", [True, False])
def test_what_is_announced(
    kept: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Compiling that takes long, once in a process; only where kernels can be kept it is once."""
    monkeypatch.setattr(_jit, "_said", False)
    monkeypatch.setattr(_jit, "WAIT", 0.0)
    monkeypatch.setattr(_kernel_cache, "kept", kept)
    for _ in range(2):
        with _jit._announced(), _jit._announced():
            time.sleep(0.1)
    assert len(caplog.messages) == 1
    assert ("once on this machine" in caplog.messages[0]) == kept
    assert ("in each process" in caplog.messages[0]) != kept


def test_how_far_it_is_is_told_again_and_again(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """From the first announcement on, with how many kernels there are; not after the last one."""
    monkeypatch.setattr(_jit, "_said", False)
    monkeypatch.setattr(_jit, "WAIT", 0.0)
    monkeypatch.setattr(_jit, "EVERY", 0.2)
    with _jit._announced():
        for _ in range(2):
            with _jit._announced():
                time.sleep(0.3)
    told = [re.fullmatch(r"compiling kernels: (\d+) so far", m) for m in caplog.messages[1:]]
    counts = [int(found[1]) for found in told if found]
    assert len(counts) == len(told) >= 2
    assert counts == sorted(counts)
    assert counts[0] < counts[-1]
    said = len(caplog.messages)
    time.sleep(0.5)
    assert len(caplog.messages) == said


def test_nothing_is_announced_of_kernels_that_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only what has to be compiled is."""
    announced: list[int] = []

    @contextmanager
    def count() -> Iterator[None]:
        announced.append(1)
        yield

    monkeypatch.setattr(_jit, "_announced", count)
    (tmp_path / "kept_kernels.py").write_text(KERNELS)
    counts = []
    for _ in range(2):
        spec = importlib.util.spec_from_file_location("kept_kernels", tmp_path / "kept_kernels.py")
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        module.outer(3.0)
        counts.append(len(announced))
    assert counts == [2, 2]


def test_plain_numba_gives_the_same_bits(tmp_path: Path) -> None:
    """``CAPSENSE_PLAIN_NUMBA=1``: the public interface alone compiles and keeps kernels."""
    (tmp_path / "kept_kernels.py").write_text(KERNELS)
    found = []
    for plain in ("0", "1"):
        folder = tmp_path / plain
        env = {**os.environ, "PYTHONPATH": _path(), "NUMBA_CACHE_DIR": str(folder)}
        env["CAPSENSE_PLAIN_NUMBA"] = plain
        run = [sys.executable, "-c", CODE, str(tmp_path)]
        done = subprocess.run(run, env=env, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        found.append(done.stdout)
        assert len(list(folder.rglob("*.nbc"))) == 2
    assert found[0] == found[1]


CODE = """
import errno, os, sys
sys.path.insert(0, sys.argv[1])
from numba.core import caching

def refuse(*_):
    raise OSError(errno.ENOSPC, "No space left on device")

if len(sys.argv) > 2:
    caching.IndexDataCacheFile.save = refuse
import kept_kernels
print(kept_kernels.outer(3.0).hex())
"""
KERNELS = """
import numpy as np
from capsense._jit import compiled

@compiled
def inner(n):
    x = np.sqrt(np.arange(n * 40.0))
    total = 0.0
    for i in range(x.size):
        total += x[i] / 3.0
    return total

@compiled
def outer(n):
    return inner(n) + inner(n + 1.0)
"""


def test_kernels_that_cannot_be_kept_and_those_that_were(tmp_path: Path) -> None:
    """A full disk loses no result; bits are the same compiled, kept, and read from the files."""
    (tmp_path / "kept_kernels.py").write_text(KERNELS)
    env = {**os.environ, "PYTHONPATH": _path(), "NUMBA_CACHE_DIR": str(tmp_path / "kernels")}
    found = []
    for option in (["full"], [], []):
        run = [sys.executable, "-c", CODE, str(tmp_path), *option]
        done = subprocess.run(run, env=env, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        found.append((done.stdout, len(list((tmp_path / "kernels").rglob("*.nbc")))))
    assert [kept for _, kept in found] == [0, 2, 2]
    assert len({value for value, _ in found}) == 1


def test_kernels_are_compiled_anew_when_those_that_they_call_may_have_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression: kernels hold those of other files; what had been kept gave stale results."""
    file = tmp_path / "kept_kernels.py"
    file.write_text(KERNELS)

    def kept() -> int:
        """How many kernels are read from files in place of being compiled."""
        spec = importlib.util.spec_from_file_location("kept_kernels", file)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        module.outer(3.0)
        return sum(module.outer.stats.cache_hits.values())

    assert [kept(), kept()] == [0, 1]
    monkeypatch.setattr(_jit, "_sources", lambda: "after an edit")
    assert [kept(), kept()] == [0, 1]


def test_the_digest_of_sources_covers_kernels_and_their_constants() -> None:
    """Every module with a kernel is one of those that are looked at."""
    root = Path(_jit.__file__).parent
    looked_at = {file for pattern in _jit.SOURCES for file in root.glob(pattern)}
    kernel = re.compile(r"^@(kernel|compiled)$", re.MULTILINE)
    made = [file for file in root.rglob("*.py") if kernel.search(file.read_text())]
    assert len(made) > 20
    assert set(made) <= looked_at


COUNTED = """
import sys, time
sys.path.insert(0, sys.argv[1])
from numba.core import event
import kept_kernels

class Slow(event.Listener):
    count = 0

    def on_start(self, started):
        self.count += started.data["dispatcher"].__name__ in ("inner", "outer")
        time.sleep(0.5)

    def on_end(self, ended):
        pass

slow = Slow()
event.register("numba:compile", slow)
value = kept_kernels.outer(3.0).hex()
print(value, slow.count)
"""


def test_processes_that_start_together_compile_each_kernel_once(tmp_path: Path) -> None:
    """One compiles, the others wait and read its files; they leave no lock behind."""
    (tmp_path / "kept_kernels.py").write_text(KERNELS)
    folder = tmp_path / "kernels"
    env = {**os.environ, "PYTHONPATH": _path(), "NUMBA_CACHE_DIR": str(folder)}
    command = [sys.executable, "-c", COUNTED, str(tmp_path)]
    running = [
        subprocess.Popen(command, env=env, stdout=subprocess.PIPE, text=True) for _ in range(3)
    ]
    found = [process.communicate(timeout=120)[0].split() for process in running]
    assert [process.returncode for process in running] == [0, 0, 0]
    assert sum(int(count) for _, count in found) == 2
    assert len({value for value, _ in found}) == 1
    assert len(list(folder.rglob("*.nbc"))) == 2
    assert not list(folder.rglob("*.lock"))


OTHER = """
import sys
sys.path.insert(0, sys.argv[1])
from numba.core import event
import kept_kernels
from capsense._jit import compiled

class Compiled(event.Listener):
    names = []

    def on_start(self, started):
        if started.data["dispatcher"].__module__ in ("kept_kernels", "__main__"):
            self.names.append(started.data["dispatcher"].__name__)

    def on_end(self, ended):
        pass

@compiled
def other(n):
    return kept_kernels.inner(n) - kept_kernels.outer(n)

event.register("numba:compile", Compiled())
value = other(3.0)
print(*Compiled.names)
assert abs(value - (kept_kernels.inner(3.0) - kept_kernels.outer(3.0))) == 0.0
"""


def test_what_kernels_call_is_kept_for_new_callers(tmp_path: Path) -> None:
    """It is read from its file; what only Python had called is compiled for the new caller."""
    (tmp_path / "kept_kernels.py").write_text(KERNELS)
    (tmp_path / "other_kernels.py").write_text(OTHER)
    env = {**os.environ, "PYTHONPATH": _path(), "NUMBA_CACHE_DIR": str(tmp_path / "kernels")}
    first = [sys.executable, "-c", CODE, str(tmp_path)]
    subprocess.run(first, env=env, check=True, capture_output=True, timeout=120)
    run = [sys.executable, str(tmp_path / "other_kernels.py"), str(tmp_path)]
    done = subprocess.run(run, env=env, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["other", "outer"]


SOLVED = """
import sys
from numba.core import event
import capsense as cs

class Compiled(event.Listener):
    names = []

    def on_start(self, started):
        self.names.append(started.data["dispatcher"].__name__)

    def on_end(self, ended):
        pass

event.register("numba:compile", Compiled())
sim = cs.Simulator("patch")
for material in ("steel", "human", cs.Material("gel", 5.0, 2e-4)):
    ball = cs.Body(cs.Sphere(0.02), cs.Pose((0, 0, 0.05)), material, grounding=1e-10)
    sim.step(cs.Scene([ball]))
print(*Compiled.names)
"""


def test_nothing_is_compiled_in_a_second_process() -> None:
    """Regression: scenes with losses compiled a part of their step in every process, for 5 s."""
    for _ in range(2):
        run = [sys.executable, "-c", SOLVED]
        env = {**os.environ, "PYTHONPATH": _path()}
        done = subprocess.run(run, env=env, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []
