"""Readings as tables and arrays, the same whether from a run or from a recording."""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from pathlib import Path
from secrets import token_hex
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense.readout.counts import Counts
from capsense.scenario.model import Channel

Array = NDArray[np.float64]


def column_meanings(channels: Sequence[Channel]) -> list[tuple[str, str]]:
    """Columns of ``readings.csv``, each with what it is."""
    out = [("time_s", "time since the start, s")]
    out += [(f"{c.column_name}_F", f"{c.meaning}, F") for c in channels]
    out += [
        (f"d{c.column_name}_F", f"{c.meaning}, change from the empty scene, F") for c in channels
    ]
    return out


def csv_row(time: float, values: Array, levels: Array) -> list[str]:
    """A row of ``readings.csv``.

    Args:
        time: [s].
        values: Capacitance of each channel [F], shape (K,).
        levels: The same with an empty scene [F], shape (K,).
    """
    return [f"{time:.12g}", *(f"{v:.10g}" for v in (*values, *(values - levels)))]


def reading_arrays(
    *,
    time: Array,
    capacitance: Array,
    delta: Array,
    baseline: Array,
    self_capacitance: Array,
    self_baseline: Array,
    electrodes: Sequence[str],
    channels: Sequence[Channel],
    values: Array,
    levels: Array,
    bodies: Sequence[str],
    positions: Array,
    quaternions: Array,
    iterations: ArrayLike,
    error_estimate: ArrayLike,
    step_time: ArrayLike,
) -> dict[str, NDArray[Any]]:
    """What ``readings.npz`` holds; see ``docs/cli.md`` for shapes and units."""
    return {
        "time": time,
        "capacitance": capacitance,
        "delta": delta,
        "baseline": baseline,
        "self_capacitance": self_capacitance,
        "self_baseline": self_baseline,
        "electrode_names": np.array(electrodes),
        "channels": values,
        "channel_baseline": levels,
        "channel_names": np.array([c.column_name for c in channels]),
        "body_names": np.array(bodies, dtype=str),
        "body_positions": positions,
        "body_quaternions": quaternions,
        "iterations": np.asarray(iterations).astype(np.int64),
        "error_estimate": np.asarray(error_estimate),
        "step_time": np.asarray(step_time),
    }


def write_counts(path: Path, counts: Counts) -> None:
    """Write a table, one row per conversion."""
    header = ["time_s", "channel", "code", "capacitance_F", "flags"]
    names = counts.channel_names
    columns = [
        [f"{t:.9f}" for t in counts.time],
        [names[c] for c in counts.channel],
        counts.code.tolist(),
        [f"{c:.10g}" for c in counts.capacitance],
        counts.flags.tolist(),
    ]
    if counts.baseline is not None and counts.touched is not None:
        header += ["baseline", "touched"]
        columns += [[f"{b:.10g}" for b in counts.baseline], counts.touched.astype(int).tolist()]
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(header)
        rows.writerows(zip(*columns, strict=True))


class replacing:
    """A temporary path that takes the place of a file once its block ends without error."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.part = path.with_name(f".{path.name}.{token_hex(4)}.part")  # others may write it too

    def __enter__(self) -> Path:
        return self.part

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is None:
            os.replace(self.part, self.path)
        else:
            self.part.unlink(missing_ok=True)
