"""Comparisons of small numbers."""

from __future__ import annotations

from typing import Any

import pytest


def approx(
    expected: Any, rel: float | None = None, abs: float | None = None, **options: Any
) -> Any:
    """``pytest.approx`` without its absolute tolerance of 1e-12.

    That would let any capacitance pass for any other: they are of some 1e-15 F.
    """
    if abs is None:
        rel, abs = 1e-6 if rel is None else rel, 0.0
    return pytest.approx(expected, rel=rel, abs=abs, **options)  # noqa: TID251
