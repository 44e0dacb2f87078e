"""Compiled kernels where no place of Numba's can be written."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import capsense

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
from capsense.scene import layer_kernels
print(os.environ.get("NUMBA_CACHE_DIR"))
"""


@pytest.mark.parametrize("option", [[], ["no temporary folder"]])
def test_a_container_without_a_writable_place(option: list[str]) -> None:
    """Kernels compile in a folder of the process, which goes with it; a warning names the fix."""
    if option and not Path("/dev/shm").is_dir():
        pytest.skip("no file system in memory")
    keep = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    path = os.pathsep.join([str(Path(capsense.__file__).parents[1]), keep.get("PYTHONPATH", "")])
    found = subprocess.run(
        [sys.executable, "-c", PROGRAM, *option],
        env={**keep, "PYTHONPATH": path}, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert found.returncode == 0, found.stderr
    assert "set NUMBA_CACHE_DIR to a folder that can" in found.stderr
    folder = Path(found.stdout.strip())
    assert folder.name.startswith("capsense-kernels-")
    assert not folder.exists()
