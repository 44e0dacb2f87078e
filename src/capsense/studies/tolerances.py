"""Tolerances: how capacitances and counts scatter with parameters, and how many sensors pass."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest, qmc

from capsense._validate import read_toml, suggest
from capsense.errors import CapSenseError, DesignError, ReadoutError, ScenarioError
from capsense.readout.randomisation import Distribution
from capsense.scenario import ScenarioTable as Table
from capsense.studies.capacitances import (
    Capacitances,
    is_code,
    load_design_template,
    load_readout_template,
    load_scenario_template,
    unit_of_output,
)
from capsense.studies.points import Evaluation, StudyRow, fill_table, jobs_within
from capsense.studies.template import Template

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

TOP_KEYS = (
    "name", "samples", "seed", "parameters", "specifications", "design", "scenario", "readout",
)  # fmt: skip
KINDS = {
    "normal": ("mean", "sigma"),
    "uniform": ("from", "to"),
    "triangular": ("from", "to", "peak"),
}
"""Distributions, and the keys of each."""
POOR_FIT = 0.9
"""Where a linear fit explains less of the variance, a warning is given."""


class Specification(NamedTuple):
    """What an output may be, in F or codes."""

    least: float
    most: float


@dataclass(frozen=True, eq=False)
class ToleranceStudy:
    """What scatters and what must hold; made by :func:`load_study`."""

    parameters: Mapping[str, Distribution]
    specifications: Mapping[str, Specification]
    """Of outputs, by their names."""
    samples: int = 64
    """A power of two."""
    seed: int = 0

    @property
    def points(self) -> list[dict[str, float]]:
        """Scrambled Sobol' points, by the parameters' distributions."""
        sampler = qmc.Sobol(len(self.parameters), rng=np.random.default_rng(self.seed))
        shares = sampler.random_base2(self.samples.bit_length() - 1)
        shares = np.clip(shares, 2.0**-32, 1.0 - 2.0**-32)
        columns = [d.values(shares[:, k]) for k, d in enumerate(self.parameters.values())]
        rows = np.column_stack(columns).tolist()
        return [dict(zip(self.parameters, row, strict=True)) for row in rows]


@dataclass(frozen=True)
class Output:
    """How one output scatters."""

    mean: float
    deviation: float
    """Standard deviation."""
    effects: Mapping[str, float]
    """Change of the output for one standard deviation of each parameter, by a linear fit; the
    parameter of largest effect first."""
    contributions: Mapping[str, float]
    """First-order shares of each parameter in the variance, in the same order."""
    explained: float
    """Share of the variance that the linear fit explains."""


class Yield(NamedTuple):
    """How many samples pass."""

    passed: int
    samples: int
    low: float
    """Lower end of the 95 % interval of the yield, after Wilson."""
    high: float
    """Upper end."""

    @property
    def share(self) -> float:
        """The yield."""
        return self.passed / self.samples


@dataclass(frozen=True)
class Tolerances:
    """What :func:`analyse` finds."""

    outputs: Mapping[str, Output]
    yields: Mapping[str, Yield]
    """For each specification, and for all together under ``all``; empty without specifications.
    Samples without results do not pass."""
    without_results: int
    """Samples of which nothing can be made."""
    rows: tuple[StudyRow, ...] = field(repr=False)
    """The samples."""


def tolerance(
    study: ToleranceStudy,
    evaluation: Evaluation,
    output: str | Path,
    *,
    jobs: int | None = None,
    each: Callable[[int], object] = lambda count: None,
) -> Tolerances:
    """Evaluate the samples of a study into a table, as :func:`~capsense.studies.sweep` does, and
    analyse them.

    Args:
        study: What scatters and what must hold, of :func:`~capsense.studies.load_study`.
        evaluation: What is computed, of the same.
        output: The table, CSV or Parquet by its name.
        jobs: Processes; by default one a processor, fewer where memory is short.
        each: Called with 1 for each result as it is appended.

    Raises:
        CapSenseError: Nothing can be made of any sample.
        ScenarioError: The file is of another study, or too few samples have results.
    """
    points = study.points
    if jobs is None:
        memory = evaluation.cost(points).memory if isinstance(evaluation, Capacitances) else 1.0
        jobs = jobs_within(memory)
    rows = fill_table(points, evaluation, Path(output), jobs=jobs, each=each)
    return analyse(rows, evaluation.outputs, study.specifications)


def analyse(
    rows: Sequence[StudyRow], outputs: Sequence[str], specifications: Mapping[str, Specification]
) -> Tolerances:
    """Scatter, contributions and yield of samples.

    Raises:
        ScenarioError: Too few samples have results for a linear fit.
    """
    x, y = _samples(rows)
    found = {name: _output(list(rows[0].point), x, y[:, k]) for k, name in enumerate(outputs)}
    yields = _yields(y, outputs, specifications, len(rows))
    return Tolerances(found, yields, len(rows) - len(y), tuple(rows))


def narrowed(
    found: Tolerances, specifications: Mapping[str, Specification], factors: Mapping[str, float]
) -> dict[str, Yield]:
    """Yields of the same samples if some parameters scattered less: what a tighter tolerance gives.

    Each output is moved along its linear fit; what the fit does not explain stays.

    Args:
        found: Of the samples as they are.
        specifications: What must hold.
        factors: Of some parameters, the new standard deviation over the present one: 0.5 halves it,
            0 holds the parameter at its mean.
    """
    x, y = _samples(found.rows)
    away = _scaled(x)
    slopes = np.linalg.lstsq(away, y - y.mean(axis=0), rcond=None)[0]
    less = np.array([factors.get(name, 1.0) - 1.0 for name in found.rows[0].point])
    moved = y + (away * less) @ slopes
    return _yields(moved, list(found.outputs), specifications, len(found.rows))


def _samples(rows: Sequence[StudyRow]) -> tuple[Array, Array]:
    """Parameters and results of the samples that have results, (n, parameters), (n, outputs)."""
    good = [row for row in rows if not row.error]
    names = list(rows[0].point)
    if len(good) < len(names) + 2:
        raise ScenarioError(
            f"{len(good)} samples have results, too few for a linear fit of {len(names)} "
            f"parameters; give more than {len(names) + 1}"
        )
    x = np.array([list(row.point.values()) for row in good], dtype=float)
    return x, np.array([row.results for row in good])


def _scaled(x: Array) -> Array:
    """Parameters from their means, in standard deviations."""
    deviations = x.std(axis=0)
    return np.asarray((x - x.mean(axis=0)) / np.where(deviations > 0, deviations, 1.0))


def _yields(
    y: Array, outputs: Sequence[str], specifications: Mapping[str, Specification], count: int
) -> dict[str, Yield]:
    """Yields of results, of ``count`` samples in all, for each specification and for all."""
    passed = {}
    for name, limits in specifications.items():
        values = y[:, list(outputs).index(name)]
        passed[name] = (values >= limits.least) & (values <= limits.most)
    if passed:
        passed["all"] = np.logical_and.reduce(list(passed.values()))
    return {name: _yield(int(p.sum()), count) for name, p in passed.items()}


def _output(names: Sequence[str], x: Array, y: Array) -> Output:
    centred = y - y.mean()
    scaled = _scaled(x)
    effects = np.linalg.lstsq(scaled, centred, rcond=None)[0]
    rest = float(np.mean((centred - scaled @ effects) ** 2))
    total = float(np.sum(effects**2)) + rest
    shares = effects**2 / total if total > 0 else np.zeros(len(effects))
    variance = float(np.mean(centred**2))
    order = np.argsort(-np.abs(effects), kind="stable").tolist()
    return Output(
        mean=float(y.mean()), deviation=float(y.std(ddof=1)),
        effects={names[k]: float(effects[k]) for k in order},
        contributions={names[k]: float(shares[k]) for k in order},
        explained=1.0 - rest / variance if variance > 0 else 1.0,
    )  # fmt: skip


def _yield(passed: int, count: int) -> Yield:
    interval = binomtest(passed, count).proportion_ci(0.95, method="wilson")
    return Yield(passed, count, float(interval.low), float(interval.high))


def load_study(path: str | Path) -> tuple[ToleranceStudy, Capacitances]:
    """Load the file of a study; see ``docs/sweeps.md``.

    Raises:
        ScenarioError: There is no such file, or anything in it is wrong.
        DesignError: The design is wrong.
    """
    file = Path(path)
    top = Table(read_toml(file, "study", ScenarioError), file.name, "study")
    top.only(TOP_KEYS)
    top.needs("name", "parameters")
    top.string("name")
    table = Table(top.raw("parameters", "[parameters], what scatters"), file.name, "parameters")
    if not table.data:
        raise table.error("is empty; add name = { distribution = …, … }")
    parameters = {name: _distribution(table, name) for name in table.data}
    samples = top.integer("samples", 2, 2**16, 64)
    if samples & (samples - 1) or samples < len(parameters) + 2:
        raise top.error(
            f"samples = {samples} must be a power of two above {len(parameters) + 1}, such as 64"
        )
    study = ToleranceStudy(parameters, {}, samples, top.integer("seed", 0, 2**63 - 1, 0))
    parts = {kind: _part(top, file, kind) for kind in ("design", "scenario", "readout")}
    if parts["design"] is None:
        raise top.error("missing key 'design'; add [design], a design's file, or its path")
    evaluation = Capacitances.of(parts["design"], study.points, parts["scenario"], parts["readout"])
    limits = Table(top.data.get("specifications", {}), file.name, "specifications")
    for name in limits.data:
        if name not in evaluation.outputs:
            raise limits.error(f"{name!r} is no output; {suggest(name, evaluation.outputs)}")
    specifications = {name: _limits(limits, name) for name in limits.data}
    return ToleranceStudy(parameters, specifications, samples, study.seed), evaluation


_KINDS_OF_FILES: dict[str, tuple[type[CapSenseError], Callable[[str], Any]]] = {
    "design": (DesignError, load_design_template),
    "scenario": (ScenarioError, load_scenario_template),
    "readout": (ReadoutError, load_readout_template),
}
"""What is raised for anything that is wrong in a file, and what loads it."""


def _part(top: Table, file: Path, kind: str) -> Any:
    """A design, scenario or readout: a table of the study, a path relative to it, or a name."""
    if kind not in top:
        return None
    error, load = _KINDS_OF_FILES[kind]
    folder = file.resolve().parent
    if isinstance(top.data[kind], str):
        path = top.string(kind)
        return load(str(folder / path) if path.endswith(".toml") else path)
    return Template(
        f"{file.name}: {kind}", Table(top.data[kind], file.name, kind).data, folder, error
    )


def _distribution(table: Table, name: str) -> Distribution:
    one = Table(table.data[name], table.source, f"parameter {name!r}")
    if "distribution" not in one:
        raise one.error(
            'has no distribution; write { distribution = "normal", … }, and put dotted keys in '
            f'quotes, such as "{name}.KEY"'
        )
    if not (name.isidentifier() or "." in name):
        raise one.error("is no name for expressions, and no key; use letters, digits and _")
    kind: Any = one.choice("distribution", list(KINDS))
    one.only(("distribution", *KINDS[kind]))
    if kind == "normal":
        mean, sigma = one.number("mean", -1e6, 1e6), one.number("sigma", 0.0, 1e6)
        if not sigma > 0:
            raise one.error("sigma = 0; write the number in the design instead")
        return Distribution(kind, mean, sigma)
    low = one.number("from", -1e6, 1e6)
    high = one.number("to", low, 1e6)
    if not high > low:
        raise one.error(f"from = to = {low:g}; write the number in the design instead")
    peak = one.number("peak", low, high, 0.5 * (low + high)) if kind == "triangular" else 0.0
    return Distribution(kind, low, high, peak)


def _limits(table: Table, name: str) -> Specification:
    one = Table(table.data[name], table.source, f"specification {name!r}")
    one.only(("min", "max"))
    if not one.data:
        raise one.error("has neither min nor max; give one or both, in F or codes")
    bound, unit = (1e12, "codes") if is_code(name) else (1.0, "F")
    least = one.number("min", -bound, bound, -np.inf, unit=unit)
    most = one.number("max", -bound, bound, np.inf, unit=unit)
    if not least <= most:
        raise one.error(f"min = {least:g} is above max = {most:g}; exchange them")
    return Specification(least, most)


def tornado(found: Tolerances, outputs: Sequence[str]) -> Figure:
    """Bars of each parameter's effect on outputs [fF or codes], the largest on top.

    Raises:
        KeyError: There is no such output.
    """
    from matplotlib.figure import Figure

    from capsense._style import COLOURS, dress

    rows = max(len(found.outputs[name].effects) for name in outputs)
    figure = Figure(figsize=(7, len(outputs) * (1.0 + 0.3 * rows)), layout="constrained")
    for axes, name in zip(figure.subplots(len(outputs), squeeze=False)[:, 0], outputs, strict=True):
        effects = found.outputs[name].effects
        factor, unit = unit_of_output(name)
        sizes = [factor * abs(e) for e in effects.values()]
        axes.barh(list(effects), [2 * s for s in sizes], left=[-s for s in sizes], color=COLOURS[0])
        axes.invert_yaxis()
        room = 1.05 * max(sizes) or 1.0
        axes.set_xlim(-room, room)
        dress(axes, x=f"change for ± one standard deviation [{unit}]", title=name)
    return figure
