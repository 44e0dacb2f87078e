"""Writes what a run computes: a table as it goes, and everything else at the end."""

from __future__ import annotations

import csv
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from capsense.errors import ScenarioError
from capsense.recording.session import versions
from capsense.recording.tables import column_meanings, csv_row, reading_arrays, replacing
from capsense.scenario import Channel, Sample, Scenario

if TYPE_CHECKING:
    from capsense.reading import Reading

Array = NDArray[np.float64]

FILES = ("readings.csv", "readings.npz", "summary.json", "plot.png")
"""What a run leaves in its output folder."""


def prepare_folder(folder: Path, *, force: bool) -> None:
    """Make the output folder, and see that it can be written to.

    Parameters
    ----------
    folder
        Where results go; made with its parents if it is not there.
    force
        Take a folder that holds something, and remove earlier results from it.

    Raises
    ------
    ScenarioError
        If it is a file, holds something and ``force`` is not set, or cannot be written to.
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

    Parameters
    ----------
    folder
        An output folder made by :func:`prepare_folder`.
    scenario
        The scenario that is run.
    empty
        The sensor's reading with nothing in front of it.
    """

    def __init__(self, folder: Path, scenario: Scenario, empty: Reading) -> None:
        self.folder = folder
        self.scenario = scenario
        self.baseline = np.asarray(empty.capacitance, dtype=float)
        self.self_baseline = np.asarray(empty.self_capacitance, dtype=float)
        self.levels = np.array([c.read(empty) for c in scenario.channels])
        self.count = 0
        size, electrodes = scenario.count, len(self.baseline)
        bodies = len(scenario.bodies)
        self._capacitance = np.empty((size, electrodes, electrodes))
        self._delta = np.empty((size, electrodes, electrodes))
        self._self = np.empty((size, electrodes))
        self._values = np.empty((size, len(scenario.channels)))
        self._positions = np.empty((size, bodies, 3))
        self._quaternions = np.empty((size, bodies, 4))
        self._stats = np.empty((size, 4))
        self._file = (folder / FILES[0]).open("w", newline="", encoding="utf-8")
        self._rows = csv.writer(self._file, lineterminator="\n")
        self._rows.writerow([name for name, _ in column_meanings(scenario.channels)])
        self._file.flush()

    def add(self, sample: Sample) -> None:
        """Keep one sample, and write its row."""
        k, reading = sample.index, sample.reading
        self._capacitance[k] = reading.capacitance
        self._delta[k] = reading.delta
        self._self[k] = reading.self_capacitance
        self._values[k] = sample.values
        for b, body in enumerate(sample.scene):
            self._positions[k, b] = body.pose.position
            self._quaternions[k, b] = body.pose.quaternion
        stats = reading.stats
        self._stats[k] = (
            stats.iterations,
            stats.solver_error,
            stats.wall_time,
            stats.unknowns,
        )
        self._rows.writerow(csv_row(sample.time, self._values[k], self.levels))
        self._file.flush()
        self.count = k + 1

    @property
    def times(self) -> Array:
        """Times [s] of the samples so far, shape (n,)."""
        return self.scenario.times[: self.count]

    @property
    def values(self) -> Array:
        """Channels [F] of the samples so far, shape (n, K)."""
        return self._values[: self.count]

    @property
    def positions(self) -> Array:
        """Origins of the bodies [m] in the samples so far, shape (n, B, 3)."""
        return self._positions[: self.count]

    @property
    def capacitance(self) -> Array:
        """Maxwell matrices [F] of the samples so far, shape (n, M, M)."""
        return self._capacitance[: self.count]

    def close(self) -> None:
        """Close the table."""
        self._file.close()

    def write_arrays(self) -> None:
        """Write ``readings.npz``."""
        n = self.count
        arrays = reading_arrays(
            time=self.times, capacitance=self._capacitance[:n], delta=self._delta[:n],
            baseline=self.baseline, self_capacitance=self._self[:n],
            self_baseline=self.self_baseline, electrodes=self.scenario.design.electrode_names,
            channels=self.scenario.channels, values=self._values[:n], levels=self.levels,
            bodies=[str(b.body.name) for b in self.scenario.bodies],
            positions=self._positions[:n], quaternions=self._quaternions[:n],
            iterations=self._stats[:n, 0], error_estimate=self._stats[:n, 1],
            step_time=self._stats[:n, 2],
        )  # fmt: skip
        with replacing(self.folder / FILES[1]) as path, path.open("wb") as file:
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]

    def summary(
        self, field: dict[str, Any], *, interrupted: bool, failure: str | None
    ) -> dict[str, Any]:
        """What ``summary.json`` holds."""
        scenario, n = self.scenario, self.count
        stats = self._stats[:n]
        return {
            "scenario": scenario.name,
            "design": scenario.design.name,
            "design_hash": scenario.design.content_hash(),
            "electrodes": list(scenario.design.electrode_names),
            "shields": sum(c.role == "shield" for c in scenario.design.conductors),
            "bodies": [b.body.name for b in scenario.bodies],
            "field": field,
            "method": scenario.method,
            "excitation": scenario.excitation.value,
            "sample_rate_Hz": scenario.sample_rate,
            "samples": n,
            "samples_planned": scenario.count,
            "interrupted": interrupted,
            "failure": failure,
            "step_time_s": _quantiles(stats[:, 2]),
            "unknowns": _quantiles(stats[:, 3]),
            "iterations": _quantiles(stats[:, 0]),
            "largest_error_estimate_F": _largest(stats[:, 1]),
            "channels": [
                self._channel_summary(k, channel) for k, channel in enumerate(scenario.channels)
            ],
            "columns": dict(column_meanings(scenario.channels)),
            "versions": versions(),
        }

    def _channel_summary(self, k: int, channel: Channel) -> dict[str, Any]:
        values = self.values[:, k]
        return {
            "name": channel.column_name,
            "meaning": channel.meaning,
            "baseline_F": float(self.levels[k]),
            "min_F": float(values.min()) if len(values) else None,
            "max_F": float(values.max()) if len(values) else None,
        }

    def write_summary(self, summary: dict[str, Any]) -> None:
        """Write ``summary.json``."""
        with replacing(self.folder / FILES[2]) as path:
            text = json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False)
            path.write_text(text + "\n", encoding="utf-8")


def _quantiles(values: Array) -> dict[str, float] | None:
    if not len(values):
        return None
    return {
        "median": float(np.median(values)),
        "p95": float(np.percentile(values, 95)),
        "max": float(values.max()),
    }


def _largest(values: Array) -> float | None:
    return float(values.max()) if len(values) else None
