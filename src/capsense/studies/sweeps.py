"""Sweeps: capacitances of a design over a grid of its parameters."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from capsense._validate import UNITS, read_toml, suggest
from capsense.design import Design, parse_design
from capsense.errors import DesignError, ScenarioError
from capsense.field.background import build_background
from capsense.field.boundary import Accuracy, build_cost, build_model
from capsense.field.cache import cache_key, default_settings
from capsense.scenario import load_scenario
from capsense.scenario.model import Excitation, channels_of, read_channels
from capsense.simulator import Simulator
from capsense.studies.points import Evaluation, Point, StudyRow, fill_table
from capsense.studies.template import fill, names_in

MAX_POINTS = 100_000
"""A study of more points is refused."""


@dataclass(frozen=True)
class Capacitances:
    """Maxwell matrices of a design for values of its parameters; an :class:`Evaluation`.

    The outputs are the upper triangle of the matrix in the empty domain (``C0_E1_E2``) [F] and,
    with a scenario, its change by the bodies as they stand at time 0 (``dC_E1_E2``) [F].
    """

    name: str
    """Name of the design's file, for messages."""
    template: Mapping[str, Any]
    """A design's file, with expressions of the parameters."""
    folder: Path
    """What the design names is relative to this folder."""
    electrodes: tuple[str, ...]
    """Names of the electrodes in matrix order."""
    scenario: Path | None = None
    """Where the bodies are from; its design and its motion are not used."""

    @classmethod
    def of(
        cls,
        name: str,
        template: Mapping[str, Any],
        folder: Path,
        points: Sequence[Point],
        scenario: Path | None = None,
    ) -> Capacitances:
        """Check a template and take the electrodes from the first point that has a design.

        Raises:
            DesignError: No point has a design, or a parameter is not used.
            ScenarioError: The scenario is wrong.
        """
        used = names_in(template)
        for parameter in points[0]:
            if parameter not in used:
                known = suggest(parameter, sorted(used)) if used else "the design has no expression"
                raise DesignError(
                    f'{name}: no expression uses {parameter!r}; {known}; write "={parameter}" in '
                    "place of the number that is to vary"
                )
        if scenario is not None:
            load_scenario(scenario)
        first: DesignError | None = None
        for point in points:
            try:
                design = cls(name, template, folder, ()).design(point)
            except DesignError as error:
                first = first or error
            else:
                return cls(name, template, folder, design.electrode_names, scenario)
        assert first is not None
        raise first

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the results."""
        names = [c.column_name[1:] for c in channels_of(Excitation.MATRIX, self.electrodes)]
        kinds = ("C0",) if self.scenario is None else ("C0", "dC")
        return tuple(kind + name for kind in kinds for name in names)

    def design(self, point: Point) -> Design:
        """The design for values of the parameters.

        Raises:
            DesignError: It cannot be made: electrodes touch, say.
        """
        return parse_design(fill(self.template, point), source=self.name, folder=self.folder)

    def key(self, point: Point) -> str:
        """Digest of the design and of the scenario's file."""
        design = self.design(point)
        scenario = b"" if self.scenario is None else self.scenario.read_bytes()
        text = cache_key(design, default_settings(design)).encode() + scenario
        return hashlib.sha256(text).hexdigest()[:16]

    def panels(self, point: Point) -> int:
        """Size of the boundary-element system, which the time to build a field depends on."""
        design = self.design(point)
        accuracy = Accuracy(default_settings(design).panel_scale)
        return build_model(design.in_units, accuracy).panels.size

    def __call__(self, point: Point) -> tuple[float, ...]:
        """Build the field, and solve the scene if there is one."""
        design = self.design(point)
        settings = default_settings(design)
        field = build_background(design, settings)
        sim = Simulator(design, settings=settings, background=field)
        channels = channels_of(Excitation.MATRIX, self.electrodes)
        empty = read_channels(channels, sim.empty)
        if self.scenario is None:
            return tuple(empty.tolist())
        reading = sim.step(load_scenario(self.scenario).scene_at(0.0))
        return (*empty.tolist(), *(read_channels(channels, reading) - empty).tolist())


def load_template(path: str | Path) -> tuple[dict[str, Any], Path]:
    """A design's file with expressions, and its folder.

    Raises:
        DesignError: There is no such file, or it is not TOML.
    """
    file = Path(path)
    return read_toml(file, "design", DesignError), file.resolve().parent


def sweep(
    design: str | Path,
    vary: Mapping[str, Sequence[float]],
    output: str | Path,
    *,
    scenario: str | Path | None = None,
    jobs: int = 1,
    each: Callable[[int], object] = lambda count: None,
    evaluation: Evaluation | None = None,
) -> list[StudyRow]:
    """Capacitances of a design over a grid of its parameters.

    Rows are appended to a CSV file as they finish. A sweep that was interrupted goes on where it
    stopped if it is started again with the same file.

    Args:
        design: A design's file in which texts such as ``"=side / 2"`` are expressions.
        vary: Values of each parameter, in SI units; all combinations are computed, the last
            parameter changing fastest.
        output: The CSV file: parameters, capacitances [F], error, key.
        scenario: A scenario's file, whose bodies as they stand at time 0 change the capacitances.
        jobs: Processes.
        each: Called with 1 for each result as it is appended.
        evaluation: What to compute in place of capacitances; ``design`` is then not read.

    Returns:
        A row for each point. A point whose design cannot be made has an error and no results.

    Raises:
        DesignError: No point has a design, or a parameter is not used.
        ScenarioError: The scenario is wrong, or the file is of another sweep.
        ValueError: There are no points, or too many.
    """
    points = grid(vary)
    if evaluation is None:
        template, folder = load_template(design)
        bodies = None if scenario is None else Path(scenario)
        evaluation = Capacitances.of(Path(design).name, template, folder, points, bodies)
    return fill_table(points, evaluation, Path(output), jobs=jobs, each=each)


def grid(vary: Mapping[str, Sequence[float]]) -> list[dict[str, float]]:
    """All combinations of values, the last parameter changing fastest.

    Raises:
        ValueError: There are none, or more than :data:`MAX_POINTS`.
    """
    count = math.prod(len(values) for values in vary.values())
    if not vary or not 1 <= count <= MAX_POINTS:
        raise ValueError(f"{count if vary else 0} points; give from 1 to {MAX_POINTS}")
    return [dict(zip(vary, values, strict=True)) for values in product(*vary.values())]


def parse_vary(text: str) -> tuple[str, list[float]]:
    """``NAME=FROM:TO:COUNT`` or ``NAME=A,B,C``; numbers may have a unit, as in ``5mm``.

    Raises:
        ScenarioError: It is something else.
    """
    name, _, values = text.partition("=")
    if not name.isidentifier() or not values:
        raise ScenarioError(f"--vary {text}: write NAME=FROM:TO:COUNT or NAME=A,B,C")
    if ":" not in values:
        return name, [_quantity(text, v) for v in values.split(",")]
    parts = values.split(":")
    if len(parts) != 3 or not re.fullmatch(r"\d{1,6}", parts[2]) or int(parts[2]) < 2:
        raise ScenarioError(f"--vary {text}: write NAME=FROM:TO:COUNT with a COUNT of 2 or more")
    low, high = (_quantity(text, p) for p in parts[:2])
    return name, np.linspace(low, high, int(parts[2])).tolist()


def _quantity(text: str, value: str) -> float:
    found = re.fullmatch(r"\s*([-+.\deE]+?)\s*([a-zA-Z]*)\s*", value)
    unit = found[2] if found else ""
    try:
        number = float(found[1]) if found else math.nan
    except ValueError:
        number = math.nan
    if not math.isfinite(number) or (unit and unit not in UNITS):
        raise ScenarioError(
            f"--vary {text}: {value!r} is no number; write one like 0.005 or 5mm, with a unit of "
            f"{', '.join(UNITS)}"
        )
    return number * UNITS[unit] if unit else number


def cost_of(evaluation: Capacitances, points: Sequence[Point]) -> tuple[int, float]:
    """Panels [count] and estimated processor time [s] of a field, the mean of the first and last
    point that have designs."""
    counts = []
    for order in (points, points[::-1]):
        for point in order:
            try:
                counts.append(evaluation.panels(point))
                break
            except DesignError:
                continue
    panels = round(sum(counts) / len(counts))
    return panels, build_cost(panels)[0]
