"""Writes what a run computes: a table as it goes, and everything else at the end."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from capsense.errors import ScenarioError
from capsense.recording.session import versions
from capsense.recording.tables import Run, column_meanings, csv_row, replacing
from capsense.scenario import Sample, Scenario

if TYPE_CHECKING:
    from capsense.reading import Reading


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
        self._file = (folder / FILES[0]).open("w", newline="", encoding="utf-8")
        self._rows = csv.writer(self._file, lineterminator="\n")
        self._rows.writerow([name for name, _ in column_meanings(scenario.channels)])
        self._file.flush()

    def add(self, sample: Sample) -> None:
        """Keep one sample, and write its row."""
        run = self.run
        run.times.append(sample.time)
        run.readings.append(sample.reading)
        run.scenes.append(sample.scene)
        self._rows.writerow(csv_row(sample.time, np.array(sample.values), run.levels))
        self._file.flush()

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
        return {
            "scenario": scenario.name,
            "design": scenario.design.name,
            "design_hash": scenario.design.content_hash(),
            "electrodes": list(scenario.design.electrode_names),
            "shields": sum(c.role == "shield" for c in scenario.design.conductors),
            "bodies": list(self.run.bodies),
            "field": field,
            "method": scenario.method,
            "excitation": scenario.excitation.value,
            "sample_rate_Hz": scenario.sample_rate,
            "samples": n,
            "samples_planned": scenario.count,
            "interrupted": interrupted,
            "failure": failure,
            "step_time_s": _quantiles([s.wall_time for s in stats]),
            "unknowns": _quantiles([s.unknowns for s in stats]),
            "iterations": _quantiles([s.iterations for s in stats]),
            "largest_error_estimate_F": max((s.solver_error for s in stats), default=None),
            "channels": [
                {
                    "name": channel.column_name,
                    "meaning": channel.meaning,
                    "baseline_F": float(level),
                    "min_F": float(values.min()) if n else None,
                    "max_F": float(values.max()) if n else None,
                }
                for channel, level, values in zip(
                    scenario.channels, self.run.levels, self.run.values.T, strict=True
                )
            ],
            "columns": dict(column_meanings(scenario.channels)),
            "versions": versions(),
        }

    def write_summary(self, summary: dict[str, Any]) -> None:
        """Write ``summary.json``."""
        with replacing(self.folder / FILES[2]) as path:
            text = json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False)
            path.write_text(text + "\n", encoding="utf-8")


def _quantiles(values: Sequence[float]) -> dict[str, float] | None:
    if not len(values):
        return None
    return {
        "median": float(np.median(values)),
        "p95": float(np.percentile(values, 95)),
        "max": float(max(values)),
    }
