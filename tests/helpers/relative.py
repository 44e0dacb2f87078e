"""Comparison by relative error alone.

``pytest.approx`` also accepts an absolute error of 1e-12 unless told not to, which in farads is
everything.
"""

from __future__ import annotations

from typing import Any

from approximate import approx


def near(expected: Any, rel: float) -> Any:
    """Equal within a relative error."""
    return approx(expected, rel=rel, abs=0.0)
