"""How the kernels of the online solver are compiled."""

from __future__ import annotations

from typing import Any

from numba import njit

_BARE: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "_nrt": False}

kernel = njit(**_BARE)
"""Compiled without reference counts, so that nothing can be allocated inside.

Numba counts references to every array that is passed on or sliced, by atomic operations; they took
more than half of the time of a scan. Room that a kernel needs is therefore handed to it.
"""
inlined = njit(inline="always", **_BARE)
"""The same, for what is written into the kernel that calls it."""
