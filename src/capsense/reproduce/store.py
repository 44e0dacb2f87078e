"""Parts of a study kept on disk, and measures of how alike two curves are.

Schöffmann et al. 2022 compare curves by a normalised cross-correlation, their Eq. 12. Taken of
normalised capacitances as they are, near 1 throughout, it is above 0.999 for almost any two curves,
while their Table I has 0.87 to 0.95: they must have removed a level before. Which one is not said,
so all three are given, here and as :func:`capsense.readout.calibration.cross_correlation`.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import sys
from collections.abc import Callable, Mapping
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

import capsense

Arrays = dict[str, NDArray[Any]]
PARTS = "parts"
"""Subfolder of the output folder that parts lie in."""


class Store:
    """Keeps each unit of work as one ``.npz``, under a hash of what it depends on.

    That is its inputs, the source files of CapSense beneath the studies, the source file of the
    function that computes it, and the versions of the packages that compute: after a change of
    any of them it is computed anew.

    Args:
        folder: The study's output folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder / PARTS
        self.computed = 0
        """Units computed so far."""
        self.reused = 0
        """Units found on disk so far."""

    def told(self) -> str:
        """How much was computed and how much reused, in words."""
        return f"{self.computed} parts computed, {self.reused} reused from {self.folder}"

    def get(
        self, name: str, inputs: Mapping[str, Any], compute: Callable[[], Mapping[str, Any]]
    ) -> Arrays:
        """Return a unit of work, from disk if it is there.

        Args:
            name: Name of the unit, for its file.
            inputs: All that it depends on: numbers, texts, booleans, None, arrays, and lists and
                dicts of these. A design enters as ``design.content_hash()``.
            compute: Does the work; returns arrays (or what becomes one) by name. A function or
                lambda of the study's module, whose file enters the hash.

        Raises:
            TypeError: An input is of another type.
        """
        path = self.folder / f"{name}-{_digest(inputs, compute.__module__)}.npz"
        found = _load(path)
        if found is not None:
            self.reused += 1
            return found
        arrays = {key: np.asarray(value) for key, value in compute().items()}
        self.folder.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            with part.open("wb") as file:
                np.savez_compressed(file, **arrays)  # type: ignore[arg-type]
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)
        self.computed += 1
        return arrays


def _load(path: Path) -> Arrays | None:
    try:
        with np.load(path, allow_pickle=False) as file:
            return {key: file[key] for key in file.files}
    except FileNotFoundError:
        return None
    except Exception:  # damaged, of which zip, inflate and numpy's reader each complain differently
        return None


def _digest(inputs: Mapping[str, Any], module: str) -> str:
    own = Path(sys.modules[module].__file__ or "").read_bytes()
    code = [code_version(), hashlib.sha256(own).hexdigest()]
    text = json.dumps([inputs, code], sort_keys=True, default=_plain)
    return hashlib.sha256(text.encode()).hexdigest()[:20]


def _plain(value: object) -> Any:
    if isinstance(value, np.ndarray):
        data = np.ascontiguousarray(value)
        return [str(data.dtype), list(data.shape), hashlib.sha256(data.tobytes()).hexdigest()]
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a part's input is a {type(value).__name__}; give numbers, texts or arrays")


ABOVE = ("cli", "plotting", "reproduce", "viewer")
"""Packages that a part does not depend on, but for the module that computes it."""


@lru_cache(maxsize=1)
def code_version() -> str:
    """Hash of the source files beneath the studies, and of the versions beneath them."""
    root = Path(capsense.__file__).parent
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        place = path.relative_to(root)
        if place.parts[0] not in ABOVE:
            digest.update(str(place).encode() + b"\0" + path.read_bytes() + b"\0")
    for package in ("numpy", "scipy", "numba", "mujoco", "pybullet"):
        try:
            digest.update(f"{package} {version(package)}\n".encode())
        except PackageNotFoundError:
            digest.update(f"{package} is not installed\n".encode())
    return digest.hexdigest()


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
