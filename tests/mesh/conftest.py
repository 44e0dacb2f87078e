"""Tests of meshes leave the process's signals as they were."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest


@pytest.fixture
def broken_pipes_ignored() -> Iterator[None]:
    """For tests that start Gmsh themselves: it makes a broken pipe end the process."""
    yield
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)
