"""Recorded capacitances: what ``capsense run`` writes, as the channels of a readout."""

from __future__ import annotations

import csv
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from capsense._file_kinds import other_kind
from capsense.errors import ReadoutError
from capsense.readout.channels import ChannelBank, Pattern
from capsense.readout.checks import Array

_MOST = 4_000_000_000
"""More than this is not unpacked [bytes]: small files may hold very large arrays."""


@dataclass(frozen=True, eq=False)
class CapacitanceRecord:
    """Capacitances against time, by the columns of ``readings.csv``."""

    path: Path
    """The file read."""
    time: Array
    """[s], shape (n,)."""
    electrodes: tuple[str, ...]
    """Electrode names in matrix order."""
    columns: dict[str, Array]
    """Capacitances [F] by column, each of shape (n,): ``C_E1_E2`` an entry of the Maxwell matrix,
    ``C_E1`` a self capacitance, ``Cm_E1_E2`` a mutual one."""
    empty: dict[str, float]
    """Capacitances with an empty scene [F]; holds nothing where the file does not."""
    shields: bool = False
    """Whether the sensor is known to have driven shields."""

    def channels(self, bank: ChannelBank) -> Array:
        """Channel values of a readout [F], shape (n, K).

        From the whole Maxwell matrix if the recording has it; otherwise each channel must be
        recorded itself, as a self or mutual capacitance with all other electrodes grounded.

        Raises:
            ReadoutError: The recording does not hold what a channel needs.
        """
        return self._values(self.columns, bank)

    def empty_channels(self, bank: ChannelBank) -> Array:
        """Channel values with an empty scene [F], shape (K,); the first sample's if unknown.

        Raises:
            ReadoutError: The recording does not hold what a channel needs.
        """
        if not self.empty:
            return self.channels(bank)[0]
        return self._values(self.empty, bank)

    def _values(self, columns: Mapping[str, ArrayLike], bank: ChannelBank) -> Array:
        names = self.electrodes
        entries = [
            columns.get(f"C_{a}_{b}", columns.get(f"C_{b}_{a}")) for a in names for b in names
        ]
        if any(entry is None for entry in entries):
            return np.stack([self._simple(columns, p) for p in bank.patterns], axis=-1)
        whole = np.stack([np.asarray(e) for e in entries], axis=-1)
        matrix = whole.reshape(*whole.shape[:-1], len(names), len(names))
        alone = [columns.get(f"C_{name}") for name in names]
        coupling = None
        if all(a is not None for a in alone):
            own = np.stack([np.asarray(a) for a in alone], axis=-1)
            coupling = own - np.diagonal(matrix, axis1=-2, axis2=-1)
        elif self.shields and any(p.shield for p in bank.patterns):
            raise ReadoutError(
                f"{self.path} does not hold what the sensor's shields do when they are driven; "
                "read its readings.npz, or set shield = 0 for each channel"
            )
        return bank.values(matrix, coupling)

    def _simple(self, columns: Mapping[str, ArrayLike], pattern: Pattern) -> Array:
        plain = not (pattern.floating or pattern.low or pattern.minus)
        plain = plain and pattern.rest == "grounded" and isinstance(pattern.sense, str)
        if plain and len(pattern.drive) == 1:
            ((driven, weight),) = pattern.drive.items()
            names = [f"C_{pattern.sense}"]
            if driven != pattern.sense:
                names = [f"Cm_{driven}_{pattern.sense}", f"Cm_{pattern.sense}_{driven}"]
            for name in names:
                if name in columns:
                    return weight * np.asarray(columns[name])
        raise ReadoutError(
            f"{self.path} does not hold what channel {pattern.name!r} needs; it has "
            f'{", ".join(list(columns)[:8])}…; record with excitation = "matrix" to have all'
        )


def load_recording(path: str | Path) -> CapacitanceRecord:
    """Load what ``capsense run`` wrote.

    Args:
        path: The output folder, or ``readings.npz`` or ``readings.csv`` in it. Of a folder, the
            arrays are read if they are there.

    Raises:
        ReadoutError: There is no such recording, or it is damaged or empty.
    """
    given = Path(path)
    if given.is_dir():
        files = [given / name for name in ("readings.npz", "readings.csv")]
        present = [f for f in files if f.is_file()]
        if not present:
            raise ReadoutError(
                f"folder {given} holds no readings.npz and no readings.csv; give the output "
                "folder of capsense run"
            )
        given = present[0]
    if not given.is_file():
        raise ReadoutError(f"there is no recording {given}; check the path")
    if given.suffix not in (".npz", ".csv"):
        other = other_kind(given, "readings") or f"{given} is no recording"
        raise ReadoutError(f"{other}; give a .npz, a .csv, or their folder")
    recording = _load_arrays(given) if given.suffix == ".npz" else _load_table(given)
    _check(recording)
    return recording


def _check(recording: CapacitanceRecord) -> None:
    path, time = recording.path, recording.time
    if not len(time):
        raise ReadoutError(f"{path} holds no samples; record some")
    if not np.isfinite(time).all() or (np.diff(time) <= 0).any():
        raise ReadoutError(f"{path}: times do not rise; the file is damaged")
    known = set(recording.electrodes)
    for one in known:
        for other in known:
            if f"{one}_{other}" in known:
                raise ReadoutError(
                    f"{path}: column C_{one}_{other} may mean the pair or the electrode of that "
                    "name; rename the electrode"
                )
    for name, values in recording.columns.items():
        if values.shape != time.shape or not np.isfinite(values).all():
            raise ReadoutError(f"{path}: column {name!r} holds no number somewhere; it is damaged")


def _load_arrays(path: Path) -> CapacitanceRecord:
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > _MOST:
            raise ReadoutError(f"{path} would take up {size:,} bytes of memory; it is damaged")
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files}
        names = tuple(str(n) for n in arrays["electrode_names"])
        columns = _columns(names, arrays, "capacitance", "self_capacitance", "channels")
        levels = _columns(names, arrays, "baseline", "self_baseline", "channel_baseline")
        empty = {name: float(level) for name, level in levels.items()}
        return CapacitanceRecord(path, arrays["time"], names, columns, empty)
    except ReadoutError:
        raise
    except KeyError as error:
        raise ReadoutError(
            f"{path} is no readings.npz of this version: it lacks {error}; run it again"
        ) from None
    except Exception as error:  # zip, inflate and numpy's reader each complain differently
        raise ReadoutError(f"{path} is no readings.npz of capsense run: {error}") from None


def _columns(
    names: tuple[str, ...], arrays: dict[str, Array], matrix: str, own: str, channels: str
) -> dict[str, Array]:
    """Arrays of matrices, self capacitances and channels by the names of their columns."""
    out = {
        f"C_{a}_{b}": arrays[matrix][..., i, j]
        for i, a in enumerate(names)
        for j, b in enumerate(names)
    }
    out.update(zip([f"C_{name}" for name in names], arrays[own].T, strict=True))
    out.update(zip(map(str, arrays["channel_names"]), arrays[channels].T, strict=True))
    return out


def _load_table(path: Path) -> CapacitanceRecord:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            header, *rows = list(csv.reader(file))
        # A run that was killed may leave half a line behind.
        whole = [row for row in rows if len(row) == len(header)]
        values = np.array(whole, dtype=float).reshape(len(whole), len(header))
    except (ValueError, OSError, UnicodeDecodeError) as error:
        raise ReadoutError(f"{path} is no readings.csv of capsense run: {error}") from None
    if not header or header[0] != "time_s":
        raise ReadoutError(f"{path} is no readings.csv of capsense run: no column time_s")
    table = {name: values[:, k] for k, name in enumerate(header)}
    columns = {
        name[:-2]: column
        for name, column in table.items()
        if name.startswith(("C_", "Cm_")) and name.endswith("_F")
    }
    empty = {
        name: float(column[0] - table[f"d{name}_F"][0])
        for name, column in columns.items()
        if len(column) and f"d{name}_F" in table
    }
    electrodes, shields = _summary(path)
    names = electrodes or _electrodes(path, list(columns))
    return CapacitanceRecord(path, values[:, 0], names, columns, empty, shields)


def _summary(path: Path) -> tuple[tuple[str, ...], bool]:
    """Electrodes, and whether there are shields, as the summary beside a table says, if any."""
    try:
        summary = json.loads(path.with_name("summary.json").read_text(encoding="utf-8"))
        return tuple(str(n) for n in summary["electrodes"]), bool(summary.get("shields"))
    except (OSError, ValueError, KeyError, TypeError):
        return (), False


def _electrodes(path: Path, columns: list[str]) -> tuple[str, ...]:
    """Electrode names as the columns tell them."""
    found: list[str] = []
    for column in columns:
        rest = column.partition("_")[2]
        half = len(rest) // 2
        if rest[:half] == rest[half + 1 :] and rest[half : half + 1] == "_":
            parts = [rest[:half]]  # C_E1_E1
        else:
            parts = rest.split("_") if column.startswith("Cm_") else [rest]
        if column.startswith("Cm_") and len(parts) != 2:
            raise ReadoutError(
                f"{path}: the electrodes of column {column!r} are not clear; keep summary.json "
                "beside it"
            )
        found += [p for p in parts if p not in found]
    diagonal = [n for n in found if f"C_{n}_{n}" in columns]
    return tuple(diagonal or found)
