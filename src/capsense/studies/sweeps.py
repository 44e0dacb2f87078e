"""Sweeps: capacitances and counts over a grid of parameters."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from pathlib import Path

import numpy as np

from capsense._validate import UNITS
from capsense.errors import ScenarioError
from capsense.studies.capacitances import Capacitances
from capsense.studies.points import Evaluation, StudyRow, fill_table, jobs_within
from capsense.studies.slopes import WithDerivatives
from capsense.studies.template import Point, Value

MAX_POINTS = 100_000
"""A study of more points is refused."""
QUANTITIES = {**UNITS, "pF": 1e-12, "fF": 1e-15}
"""Units of values."""


def sweep(
    design: str | Path,
    vary: Mapping[str, Sequence[Value]],
    output: str | Path,
    *,
    scenario: str | Path | None = None,
    readout: str | Path | None = None,
    derivatives: Mapping[str, float | None] | None = None,
    jobs: int | None = None,
    each: Callable[[int], object] = lambda count: None,
) -> list[StudyRow]:
    """Capacitances and counts of a sensor over a grid of its parameters.

    Rows are appended to a file as they finish. A sweep that was interrupted goes on where it
    stopped if it is started again with the same file.

    Args:
        design: A design's file in which texts such as ``"=side / 2"`` may be expressions, or the
            name of a packaged design.
        vary: Values of each parameter, in SI units; all combinations are computed, the last
            parameter changing fastest. A parameter is a name that expressions in the files use, or
            a dotted key, such as ``electrode.E1.size.x`` or ``body.finger.material``.
        output: The table, CSV or Parquet by its name: parameters, capacitances [F], counts, error,
            key.
        scenario: A scenario's file, whose bodies as they stand at time 0 change the capacitances.
        readout: A readout's file, or the name of a chip, for counts without noise.
        derivatives: Parameters by which derivatives are given too, and the largest step of each, as
            :func:`derivatives` takes it; None for a twentieth of the value.
        jobs: Processes; by default one a processor, fewer where memory is short.
        each: Called with 1 for each result as it is appended.

    Returns:
        A row for each point. A point of which nothing can be made has an error and no results.

    Raises:
        DesignError: The design is wrong, or a parameter is not used.
        ScenarioError: The scenario is wrong, or the file is of another sweep.
        ReadoutError: The readout is wrong.
        CapSenseError: Nothing can be made of any point.
        ValueError: There are no points, or too many.
    """
    points = grid(vary)
    evaluation = Capacitances.load(design, points, scenario, readout)
    jobs = jobs or jobs_within(evaluation.cost(points).memory)
    return fill_table(
        points, with_derivatives(evaluation, derivatives, points), Path(output), jobs=jobs,
        each=each,
    )  # fmt: skip


def with_derivatives(
    evaluation: Evaluation, steps: Mapping[str, float | None] | None, points: Sequence[Point]
) -> Evaluation:
    """An evaluation that gives derivatives as well, if there are steps for some.

    Raises:
        ScenarioError: A step is wrong.
    """
    return WithDerivatives.of(evaluation, steps, points) if steps else evaluation


def grid(vary: Mapping[str, Sequence[Value]]) -> list[dict[str, Value]]:
    """All combinations of values, the last parameter changing fastest.

    Raises:
        ValueError: There are none, or more than :data:`MAX_POINTS`.
    """
    count = math.prod(len(values) for values in vary.values())
    if not vary or not 1 <= count <= MAX_POINTS:
        raise ValueError(f"{count if vary else 0} points; give from 1 to {MAX_POINTS}")
    return [dict(zip(vary, values, strict=True)) for values in product(*vary.values())]


def parse_vary(text: str) -> tuple[str, list[Value]]:
    """``NAME=FROM:TO:COUNT`` or ``NAME=A,B,C``; numbers may have a unit, as in ``5mm``, and texts
    stand for themselves.

    Raises:
        ScenarioError: It is something else.
    """
    name, _, values = text.partition("=")
    if not re.fullmatch(r"[^\W\d]\w*(\.[^.\s]+)*", name) or not values:
        raise ScenarioError(f"--vary {text}: write NAME=FROM:TO:COUNT or NAME=A,B,C")
    if ":" not in values:
        return name, [_value(text, v.strip()) for v in values.split(",")]
    parts = values.split(":")
    if len(parts) != 3 or not re.fullmatch(r"\d{1,6}", parts[2]) or int(parts[2]) < 2:
        raise ScenarioError(f"--vary {text}: write NAME=FROM:TO:COUNT with a COUNT of 2 or more")
    low, high = (quantity(f"--vary {text}", p) for p in parts[:2])
    return name, np.linspace(low, high, int(parts[2])).tolist()


def parse_steps(texts: Sequence[str]) -> dict[str, float | None]:
    """``NAME`` or ``NAME=STEP`` of parameters by which derivatives are taken.

    Raises:
        ScenarioError: One is something else, or a name is given twice.
    """
    out: dict[str, float | None] = {}
    for text in texts:
        name, given, step = text.partition("=")
        if name in out:
            raise ScenarioError(f"--derivatives {text}: {name} is given twice; keep one")
        out[name] = quantity(f"--derivatives {text}", step) if given else None
    return out


def _value(text: str, value: str) -> Value:
    """A number, or a text that cannot be a number that was mistyped."""
    word = re.fullmatch(r"[^\W\d][\w .-]*", value)
    if word and value not in QUANTITIES and value.lower() not in ("nan", "inf", "infinity"):
        return value
    return quantity(f"--vary {text}", value)


def quantity(where: str, value: str) -> float:
    """A number with or without a unit, in SI units.

    Raises:
        ScenarioError: It is something else; the message begins with ``where`` it is.
    """
    found = re.fullmatch(r"\s*([-+.\deE]+?)\s*([a-zA-Z]*)\s*", value)
    unit = found[2] if found else ""
    try:
        number = float(found[1]) if found else math.nan
    except ValueError:
        number = math.nan
    if not math.isfinite(number) or (unit and unit not in QUANTITIES):
        raise ScenarioError(
            f"{where}: {value!r} is no number; write one like 0.005 or 5mm, with a unit of "
            f"{', '.join(QUANTITIES)}"
        )
    return number * QUANTITIES[unit] if unit else number
