"""Readings as tables and arrays, the same whether from a run or from a recording."""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from secrets import token_hex
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capsense.design.model import Design
from capsense.reading import Reading
from capsense.readout.counts import Counts
from capsense.scenario.model import Channel
from capsense.scene import Scene

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


@dataclass(frozen=True, eq=False)
class Run:
    """What a sensor read, n times, and the scenes in front of it."""

    title: str
    design: Design
    channels: tuple[Channel, ...]
    """The K numbers of a reading that tables and pictures show."""
    empty: Reading
    """The reading with nothing in front of the sensor."""
    bodies: tuple[str, ...] = ()
    """Names of bodies; those that scenes hold beside these follow in the order of appearance."""
    times: list[float] = field(default_factory=list)
    """[s], n of them, as of the following."""
    readings: list[Reading] = field(default_factory=list)
    scenes: list[Scene] = field(default_factory=list)

    def values_of(self, reading: Reading) -> Array:
        """Capacitance of each channel in a reading [F], shape (K,)."""
        return np.array([c.read(reading) for c in self.channels])

    @cached_property
    def levels(self) -> Array:
        """Capacitance of each channel with an empty scene [F], shape (K,)."""
        return self.values_of(self.empty)

    @property
    def values(self) -> Array:
        """Capacitance of each channel [F], shape (n, K)."""
        shape = len(self.times), len(self.channels)
        return np.reshape([self.values_of(r) for r in self.readings], shape)

    def poses(self) -> tuple[tuple[str, ...], Array, Array]:
        """Names of the B bodies, and their places in the sensor frame.

        Returns:
            Names; positions [m], shape (n, B, 3); quaternions (x, y, z, w), shape (n, B, 4). A
            body that a scene lacks has NaN. One without a name is called ``body`` and its number.
        """
        named = [{b.name or f"body{k}": b.pose for k, b in enumerate(s)} for s in self.scenes]
        names = tuple(dict.fromkeys([*self.bodies, *(n for bodies in named for n in bodies)]))
        places = np.full((len(named), len(names), 7), np.nan)
        for row, bodies in zip(places, named, strict=True):
            for b, name in enumerate(names):
                if name in bodies:
                    row[b] = (*bodies[name].position, *bodies[name].quaternion)
        return names, places[..., :3], places[..., 3:]

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What ``readings.npz`` holds; see ``docs/cli.md`` for shapes and units."""
        n, m = len(self.times), len(self.empty.delta)
        names, positions, quaternions = self.poses()
        stats = [r.stats for r in self.readings]
        return {
            "time": np.array(self.times),
            "capacitance": np.reshape([r.capacitance for r in self.readings], (n, m, m)),
            "delta": np.reshape([r.delta for r in self.readings], (n, m, m)),
            "baseline": self.empty.capacitance,
            "self_capacitance": np.reshape([r.self_capacitance for r in self.readings], (n, m)),
            "self_baseline": self.empty.self_capacitance,
            "electrode_names": np.array(self.design.electrode_names),
            "channels": self.values,
            "channel_baseline": self.levels,
            "channel_names": np.array([c.column_name for c in self.channels]),
            "body_names": np.array(names, dtype=str),
            "body_positions": positions,
            "body_quaternions": quaternions,
            "iterations": np.array([s.iterations for s in stats], dtype=np.int64),
            "error_estimate": np.array([s.solver_error for s in stats]),
            "step_time": np.array([s.wall_time for s in stats]),
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
