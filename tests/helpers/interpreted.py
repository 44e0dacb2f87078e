"""Kernels run by Python itself: ``NUMBA_DISABLE_JIT=1 python -m pytest ...``.

Mutations of kernels are checked so: nothing is compiled, and indices out of bounds are errors.
Twins of what :mod:`capsense._simd` writes in LLVM stand in for it, and bodies are records with
attributes.
"""

from __future__ import annotations

import ctypes
import functools
import os
from typing import Any

import numpy as np

ON = os.environ.get("NUMBA_DISABLE_JIT") == "1"
Array = np.ndarray


def _flat(x: Array) -> Array:
    assert x.flags.c_contiguous
    return x.reshape(-1)


def at(x: Array, k: int) -> Any:
    assert k >= 0
    return _flat(x)[k]


def span(x: Array, k: int) -> Array:
    out = _flat(x)[k : k + 8].copy()
    assert k >= 0
    assert len(out) == 8
    return out


def wide_span(x: Array, k: int) -> Array:
    return np.concatenate([span(x, k), span(x, k + 8)])


def put_span(x: Array, k: int, value: Array) -> None:
    assert k >= 0
    _flat(x)[k : k + len(value)] = value


def splat(value: Any) -> Array:
    return np.full(8, value)


def wide_splat(value: Any) -> Array:
    return np.full(16, value)


def madd(scalar: Any, value: Array, addend: Array) -> Array:
    return value.dtype.type(scalar) * value + addend


def rsqrt(value: Any) -> Any:
    return (np.float32(1.0) / np.sqrt(value)).astype(np.float32)


def _pointer(kind: Any) -> Any:
    return lambda address: ctypes.cast(int(address), ctypes.POINTER(kind))


TWINS = {
    "at": at, "span": span, "put_span": put_span, "splat": splat, "madd": madd, "rsqrt": rsqrt,
    "wide_span": wide_span, "wide_splat": wide_splat,
    "vadd": lambda u, v: u + v, "vsub": lambda u, v: u - v, "vmul": lambda u, v: u * v,
    "vdiv": lambda u, v: u / v, "vlog": np.log,
    "vmadd": lambda u, v, w: u * v + w,
    "dot": lambda x, y, z, u, v, w, a: x * u + (y * v + (z * w + a)),
    "muladd": lambda a, b, c: a * b + c, "horizontal_sum": lambda v: v.sum(),
    "where_above": lambda u, v, x, y: np.where(u > v, x, y),
    "singles": _pointer(ctypes.c_float), "doubles": _pointer(ctypes.c_double),
    "integers": _pointer(ctypes.c_int64),
}  # fmt: skip


def fewer(panels: int) -> int:
    """How many panels to ask for."""
    return panels // 10 if ON else panels


def limit(fine: float, coarse: float) -> float:
    """What errors are held against: clusters of fewer panels meet less exactly."""
    return coarse if ON else fine


def thinned(green: Any) -> Any:
    """A Green's function of few sources and weak modes: no design's, but good for comparisons."""
    if not ON:
        return green
    import dataclasses

    parts = {
        name: (np.linspace(0, len(getattr(green, f"{name}_sources")) - 1, 40).astype(int), modes)
        for name, modes in (("near", 16), ("middle", 12), ("far", 8))
    }
    tables = {}
    for name, (kept, modes) in parts.items():
        scale = np.float32(len(getattr(green, f"{name}_sources")) / len(kept))
        tables[f"{name}_sources"] = getattr(green, f"{name}_sources")[kept].copy()
        tables[f"{name}_phi"] = scale * getattr(green, f"{name}_phi")[kept]
        tables[f"{name}_modes"] = 2.0 * getattr(green, f"{name}_modes")[kept, :modes]
    return dataclasses.replace(green, **tables)


@functools.wraps(np.empty)
def no_numbers(*args: Any, empty: Any = np.empty, **options: Any) -> Array:
    """``np.empty``, filled with what shows where it is read before it is written."""
    out = empty(*args, **options)
    if out.dtype.kind in "fci":
        out.fill(np.iinfo(out.dtype).min // 2 if out.dtype.kind == "i" else np.nan)
    return out


def start() -> None:
    """Put the twins in place, before any kernel is imported."""
    np.seterr(divide="ignore", invalid="ignore", over="ignore", under="ignore")
    np.empty = no_numbers
    from capsense import _simd

    for name, twin in TWINS.items():
        setattr(_simd, name, twin)
    from capsense.field import grid_kernels
    from capsense.solver.tree import rigid

    grid_kernels.ALONG = 3  # every simulator fills a table

    rigid.BODY = np.dtype((np.record, rigid.BODY))
