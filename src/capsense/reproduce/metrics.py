"""How alike two curves are.

Schöffmann et al. 2022 compare by a normalised cross-correlation, their Eq. 12. Taken of normalised
capacitances as they are, near 1 throughout, it is above 0.999 for almost any two curves, while
their Table I has 0.87 to 0.95: they must have removed a level before. Which one is not said, so
all three are given here.
"""

from __future__ import annotations

import json
import math
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from capsense.readout.calibration import cross_correlation

__all__ = ["correlation_of_change", "cross_correlation", "raw_correlation", "rmse"]


def raw_correlation(one: ArrayLike, other: ArrayLike) -> float:
    """``Σ ab / √(Σ a² Σ b²)``: Eq. 12 at lag zero, of values as they are.

    Raises:
        ValueError: The curves differ in shape, or one is zero throughout.
    """
    a, b = _pair(one, other)
    size = math.sqrt(float((a * a).sum() * (b * b).sum()))
    if size == 0:
        raise ValueError("a curve is zero throughout and correlates with nothing")
    return float((a * b).sum()) / size


def correlation_of_change(one: ArrayLike, other: ArrayLike) -> float:
    """Eq. 12 of each curve's change from its own level, the mean of its highest tenth."""
    a, b = _pair(one, other)
    return raw_correlation(a - _level(a), b - _level(b))


def rmse(one: ArrayLike, other: ArrayLike) -> float:
    """Root of the mean squared difference."""
    a, b = _pair(one, other)
    return math.sqrt(float(((a - b) ** 2).mean()))


def _level(curve: np.ndarray) -> float:
    count = max(1, len(curve) // 10)
    return float(np.sort(curve)[-count:].mean())


def _pair(one: ArrayLike, other: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    a, b = np.asarray(one, dtype=float), np.asarray(other, dtype=float)
    if a.shape != b.shape or not a.size:
        raise ValueError(f"curves have shapes {a.shape} and {b.shape}; make them the same")
    return a, b


def correlations(table: int) -> dict[str, Any]:
    """Eq. 12 of the paper's simulation against its hardware.

    Args:
        table: 1, by speed [m/s, as text] and board; or 2, a list over electrodes by participant.
    """
    path = files("capsense.reproduce") / "data" / f"table_{table}.json"
    found: dict[str, Any] = json.loads(path.read_text("utf-8"))["normalised cross-correlation"]
    return found
