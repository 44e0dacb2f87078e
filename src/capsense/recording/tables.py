"""Readings as tables and arrays, whether of a run or a recording; the folder of a run."""

from __future__ import annotations

import contextlib
import csv
import errno
import io
import json
import math
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
from capsense.errors import ScenarioError
from capsense.reading import Reading
from capsense.readout.conversions import Counts
from capsense.recording import versions
from capsense.scenario import Sample, Scenario
from capsense.scenario.model import Channel, read_channels
from capsense.scene import Scene

Array = NDArray[np.float64]


def column_meanings(channels: Sequence[Channel], design: Design) -> list[tuple[str, str]]:
    """Columns of ``readings.csv``, each with what it is; of a cover, also what it carries."""
    change = "change from the empty scene"
    return [
        ("time_s", "time since the start, s"),
        *((f"{c.column_name}_F", f"{c.meaning}, F") for c in channels),
        *((f"d{c.column_name}_F", f"{c.meaning}, {change}, F") for c in channels),
        *touch_meanings(design),
        ("contact", "1 where a body touches an electrode and the sample means nothing, else 0"),
    ]


def touch_meanings(design: Design) -> list[tuple[str, str]]:
    """Columns of what is pressed onto the cover of a design, each with what it is."""
    if design.cover is None:
        return []
    names = design.electrode_names
    return [
        *((f"force_{n}_N", f"force that the cover carries above {n}, N") for n in names),
        *((f"compression_{n}_m", f"largest compression of the cover above {n}, m") for n in names),
        ("force_total_N", "force that the whole cover carries, N"),
    ]


def touch_values(reading: Reading, design: Design) -> list[float]:
    """A row of :func:`touch_meanings`; NaN where a reading does not tell."""
    touch = reading.touch
    if design.cover is None:
        return []
    if touch is None:
        return [math.nan] * (2 * len(design.electrode_names) + 1)
    return [*touch.force.tolist(), *touch.compression.tolist(), touch.total]


def csv_row(
    time: float, values: Array, levels: Array, reading: Reading, design: Design
) -> list[str]:
    """A row of ``readings.csv``.

    Args:
        time: [s].
        values: Capacitance of each channel [F], shape (K,).
        levels: The same with an empty scene [F], shape (K,).
        reading: What they are of.
        design: Of the sensor.
    """
    numbers = (*values, *(values - levels), *touch_values(reading, design))
    return [f"{time:.12g}", *(f"{v:.10g}" for v in numbers), str(int(reading.in_contact))]


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

    @cached_property
    def levels(self) -> Array:
        """Capacitance of each channel with an empty scene [F], shape (K,)."""
        return read_channels(self.channels, self.empty)

    @property
    def values(self) -> Array:
        """Capacitance of each channel [F], shape (n, K)."""
        shape = len(self.times), len(self.channels)
        return np.reshape([read_channels(self.channels, r) for r in self.readings], shape)

    @property
    def contact(self) -> NDArray[np.bool_]:
        """Which samples mean nothing since a body touches an electrode, shape (n,)."""
        return np.array([r.in_contact for r in self.readings], dtype=bool)

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
        out = {
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
            "contact": self.contact,
        }
        if self.design.cover is not None:
            rows = np.reshape([touch_values(r, self.design) for r in self.readings], (n, 2 * m + 1))
            out |= {
                "touch_force": rows[:, :m], "touch_compression": rows[:, m:-1],
                "touch_total": rows[:, -1],
            }  # fmt: skip
        return out


def counts_columns(counts: Counts) -> dict[str, NDArray[Any]]:
    """Columns of a table of counts, one row per conversion."""
    out: dict[str, NDArray[Any]] = {
        "time_s": counts.time, "channel": np.array(counts.channel_names)[counts.channel],
        "code": counts.code, "capacitance_F": counts.capacitance, "flags": counts.flags,
    }  # fmt: skip
    if counts.baseline is not None and counts.touched is not None:
        out.update(baseline=counts.baseline, touched=counts.touched)
    return out


_FORMS = {"time_s": ".9f", "capacitance_F": ".10g", "baseline": ".10g", "touched": "d"}


def write_counts(path: Path, counts: Counts) -> None:
    """Write a table, one row per conversion."""
    columns = counts_columns(counts)
    cells = [
        [format(cell, _FORMS.get(name, "")) for cell in values.tolist()]
        for name, values in columns.items()
    ]
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(columns)
        rows.writerows(zip(*cells, strict=True))


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


FILES = ("readings.csv", "readings.npz", "summary.json", "plot.png")
"""What a run leaves in its output folder."""


def prepare_folder(folder: Path, *, force: bool) -> None:
    """Make the output folder, and see that it can be written to.

    Args:
        folder: Where results go; made with its parents if it is not there.
        force: Take a folder that holds something, and remove earlier results from it.

    Raises:
        ScenarioError: If it is a file, holds something and ``force`` is not set, or cannot be
            written to.
    """
    if folder.exists() and not folder.is_dir():
        raise ScenarioError(f"output {folder} is a file; give a folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()) and not force:
            raise ScenarioError(
                f"output folder {folder} is not empty; give another one, or --force to replace "
                "the results in it"
            )
        probe = folder / f".capsense-{os.getpid()}"
        probe.write_bytes(b"capsense")
        probe.unlink()
        for name in FILES:
            (folder / name).unlink(missing_ok=True)
    except OSError as error:
        raise ScenarioError(
            f"output folder {folder} cannot be written to: {error.strerror}; give another one"
        ) from None


class RunWriter:
    """Takes samples, writes ``readings.csv`` row by row, and the other files at the end.

    Args:
        folder: An output folder made by :func:`prepare_folder`.
        scenario: The scenario that is run.
        empty: The sensor's reading with nothing in front of it.
    """

    def __init__(self, folder: Path, scenario: Scenario, empty: Reading) -> None:
        self.folder = folder
        self.scenario = scenario
        names = tuple(str(b.body.name) for b in scenario.bodies)
        self.run = Run(scenario.name, scenario.design, scenario.channels, empty, names)
        self._file = (folder / FILES[0]).open("wb", buffering=0)
        self._write_row([name for name, _ in column_meanings(scenario.channels, scenario.design)])

    def _write_row(self, row: Sequence[object]) -> None:
        """Write a whole row or nothing of it."""
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerow(row)
        start, line = self._file.tell(), text.getvalue().encode()
        try:
            if self._file.write(line) < len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), self._file.name)
        except OSError:
            with contextlib.suppress(OSError):
                self._file.truncate(start)
            raise

    def add(self, sample: Sample) -> None:
        """Write the row of one sample, and keep the sample.

        Raises:
            OSError: The row could not be written; neither it nor the sample is there then.
        """
        run = self.run
        values = np.array(sample.values)
        self._write_row(csv_row(sample.time, values, run.levels, sample.reading, run.design))
        run.times.append(sample.time)
        run.readings.append(sample.reading)
        run.scenes.append(sample.scene)

    @property
    def count(self) -> int:
        """Samples so far."""
        return len(self.run.times)

    def close(self) -> None:
        """Close the table."""
        self._file.close()

    def write_arrays(self) -> None:
        """Write ``readings.npz``."""
        with replacing(self.folder / FILES[1]) as path, path.open("wb") as file:
            np.savez_compressed(file, **self.run.arrays())  # type: ignore[arg-type]

    def summary(
        self, field: dict[str, Any], *, interrupted: bool, failure: str | None
    ) -> dict[str, Any]:
        """What ``summary.json`` holds."""
        scenario, n = self.scenario, self.count
        stats = [r.stats for r in self.run.readings]
        touches = [r.touch for r in self.run.readings if r.touch is not None]
        design, contact = scenario.design, self.run.contact
        columns = self.run.values[~contact if not contact.all() else contact].T
        return {
            "scenario": scenario.name, "design": design.name,
            "design_hash": design.content_hash(), "electrodes": design.electrode_names,
            "shields": sum(c.role == "shield" for c in design.conductors),
            "bodies": self.run.bodies, "field": field, "method": scenario.method,
            "excitation": scenario.excitation, "sample_rate_Hz": scenario.sample_rate,
            "samples": n, "samples_planned": scenario.count,
            "interrupted": interrupted, "failure": failure,
            "step_time_s": _quantiles([s.wall_time for s in stats]),
            "unknowns": _quantiles([s.unknowns for s in stats]),
            "iterations": _quantiles([s.iterations for s in stats]),
            "largest_error_estimate_F": max((s.solver_error for s in stats), default=None),
            "samples_in_contact": int(contact.sum()),
            "channels": [
                {"name": channel.column_name, "meaning": channel.meaning,
                 "baseline_F": float(level), "min_F": float(values.min()) if n else None,
                 "max_F": float(values.max()) if n else None}
                for channel, level, values in zip(
                    scenario.channels, self.run.levels, columns, strict=True
                )
            ],
            "touch": None if not touches else {
                "largest_force_N": np.max([t.force for t in touches], axis=0).tolist(),
                "largest_compression_m": np.max([t.compression for t in touches], axis=0).tolist(),
                "largest_total_N": max(t.total for t in touches),
            },
            "columns": dict(column_meanings(scenario.channels, design)), "versions": versions(),
        }  # fmt: skip

    def write_summary(self, summary: dict[str, Any]) -> None:
        """Write ``summary.json``."""
        with replacing(self.folder / FILES[2]) as path:
            text = json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False)
            path.write_text(text + "\n", encoding="utf-8")


def _quantiles(values: Sequence[float]) -> dict[str, float] | None:
    if not len(values):
        return None
    median, p95, most = np.percentile(values, (50, 95, 100)).tolist()
    return {"median": median, "p95": p95, "max": most}
