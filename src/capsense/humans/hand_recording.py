"""Recorded joints of one hand, in files of three formats."""

from __future__ import annotations

import csv
import json
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from capsense._frozen import read_only
from capsense._validate import suggest
from capsense.errors import SceneError
from capsense.humans.limb import Side
from capsense.humans.tracking import convention

Array = NDArray[np.float64]

_KEYS = ("time", "joints", "confidence", "side", "convention")


@dataclass(frozen=True, eq=False)
class HandRecording:
    """What a tracker has reported of one hand.

    Iterating gives time [s], joints and confidence of each frame.

    Raises:
        SceneError: Shapes do not fit, time goes back, or side or convention are unknown.
    """

    time: Array
    """Times of the frames [s], increasing, shape (n,)."""
    joints: Array
    """Positions in the convention's order and unit, shape (n, k, 3); NaN where a joint was not
    seen."""
    confidence: Array
    """From 0 to 1, shape (n,)."""
    side: Side
    """``"left"`` or ``"right"``."""
    convention: str
    """As of :class:`~capsense.humans.TrackedHand`."""

    def __post_init__(self) -> None:
        count = convention(self.convention).count
        if self.side not in get_args(Side):
            raise SceneError(f'side is {self.side!r}; choose "left" or "right"')
        n = len(self.time)
        for name, shape in (("time", (n,)), ("joints", (n, count, 3)), ("confidence", (n,))):
            value = np.array(getattr(self, name), dtype=float)
            if value.shape != shape:
                raise SceneError(
                    f"{name} has shape {value.shape}; {n} frames of {self.convention} need {shape}"
                )
            object.__setattr__(self, name, read_only(value))
        if not (np.isfinite(self.time).all() and (np.diff(self.time) > 0).all()):
            raise SceneError("time does not increase from frame to frame; sort the frames")

    def __len__(self) -> int:
        return len(self.time)

    def __iter__(self) -> Iterator[tuple[float, Array, float]]:
        return zip(self.time.tolist(), self.joints, self.confidence.tolist(), strict=True)

    @classmethod
    def load(
        cls, path: str | Path, *, side: Side | None = None, convention: str | None = None
    ) -> HandRecording:
        """Load a file.

        - ``.npz``: arrays ``time`` and ``joints``, and optionally ``confidence``, ``side``,
          ``convention``.
        - ``.json``: an object with the same keys; a joint, or all joints of a frame, may be null.
        - ``.csv``: a row per frame, below a header: ``time``, optionally ``confidence``, then
          ``x0, y0, z0, x1, …``; an empty cell is a joint that was not seen.

        Args:
            path: The file.
            side: Where the file does not say it.
            convention: Where the file does not say it.

        Raises:
            SceneError: The file is missing, of another format, or something in it is wrong.
        """
        file = Path(path)
        readers = {".npz": _read_npz, ".json": _read_json, ".csv": _read_csv}
        if file.suffix not in readers:
            raise SceneError(f"{file} is of no known format; {suggest(file.suffix, readers)}")
        try:
            data = dict(readers[file.suffix](file))
            for key, value in (("side", side), ("convention", convention)):
                if value is not None:
                    data.setdefault(key, value)
                if key not in data:
                    raise SceneError(f"the file does not say {key}; give {key}=…")
            for key in ("time", "joints"):
                if key not in data:
                    raise SceneError(f"{key!r} is missing; the file holds {', '.join(data)}")
            data.setdefault("confidence", np.ones(len(data["time"])))
            for key in data:
                if key not in _KEYS:
                    raise SceneError(f"unknown key {key!r}; {suggest(key, _KEYS)}")
            return cls(
                data["time"], data["joints"], data["confidence"], data["side"], data["convention"]
            )
        except FileNotFoundError:
            raise SceneError(f"there is no file {file}; check the path") from None
        except (OSError, ValueError, TypeError, KeyError, zipfile.BadZipFile) as error:
            raise SceneError(f"{file} cannot be read: {error}") from None
        except SceneError as error:
            raise SceneError(f"{file}: {error}") from None

    def save(self, path: str | Path) -> None:
        """Save as ``.npz``; positions in single precision.

        Raises:
            SceneError: The path ends otherwise.
        """
        file = Path(path)
        if file.suffix != ".npz":
            raise SceneError(f"path is {file}; give one that ends in .npz")
        np.savez_compressed(
            file, time=self.time, joints=self.joints.astype(np.float32),
            confidence=self.confidence.astype(np.float32), side=self.side,
            convention=self.convention,
        )  # fmt: skip


def _read_npz(file: Path) -> Mapping[str, Any]:
    with np.load(file, allow_pickle=False) as data:
        return {k: str(data[k]) if k in ("side", "convention") else data[k] for k in data.files}


def _read_json(file: Path) -> Mapping[str, Any]:
    data = json.loads(file.read_text(encoding="utf-8"))
    if not isinstance(data, dict):
        raise SceneError('give an object, {"time": […], "joints": […]}')
    if not isinstance(data.get("joints"), list):
        return data
    nowhere = [np.nan] * 3
    count = max((len(f) for f in data["joints"] if isinstance(f, list)), default=0)
    data["joints"] = [
        [nowhere] * count if frame is None else [nowhere if p is None else p for p in frame]
        for frame in data["joints"]
    ]
    return data


def _read_csv(file: Path) -> Mapping[str, Any]:
    with file.open(newline="", encoding="utf-8") as lines:
        rows = csv.reader(lines)
        header = [name.strip() for name in next(rows, [])]
        table = [[float(cell) if cell.strip() else np.nan for cell in row] for row in rows if row]
    first = 2 if header[1:2] == ["confidence"] else 1
    count = (len(header) - first) // 3
    wanted = [f"{axis}{k}" for k in range(count) for axis in "xyz"]
    if header[:1] != ["time"] or not count or header[first:] != wanted:
        raise SceneError("the header must be time, optionally confidence, then x0, y0, z0, x1, …")
    for k, row in enumerate(table, 2):
        if len(row) != len(header):
            raise SceneError(f"line {k} has {len(row)} cells; the header has {len(header)}")
    numbers = np.array(table).reshape(-1, len(header))
    found = {"time": numbers[:, 0], "joints": numbers[:, first:].reshape(-1, count, 3)}
    return found if first == 1 else {**found, "confidence": numbers[:, 1]}
