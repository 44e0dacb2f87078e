"""Sizes of a sensor for a task: a search for the best bound of a limb's pose.

A candidate is judged by the Cramér–Rao bound of the pose: what an estimator without bias can reach
at best, given the sensor's slopes and the noise of its channels.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.stats import qmc

from capsense._validate import read_toml, suggest
from capsense.design import Design, parse_design
from capsense.design.geometry import TOUCH
from capsense.errors import DesignError, FieldError, ScenarioError
from capsense.field.background import BuildSettings, build_background
from capsense.learning.servo import Belief, LimbPose, PoseEstimator
from capsense.scenario import ScenarioTable as Table
from capsense.simulator import DEFAULT_PRESET, PresetName, Simulator
from capsense.studies.template import fill

Array = NDArray[np.float64]

TOP_KEYS = (
    "name", "evaluations", "seed", "resolution", "noise", "relative", "matrix", "limb", "poses",
    "one", "parameters", "constraints", "design",
)  # fmt: skip
_DIGITS = 6
"""Parameters and lengths are rounded to so many digits: a micrometre."""
_ROUNDS = 20
"""So many candidates for each evaluation may break constraints before the search ends."""


class Span(NamedTuple):
    """What a parameter may be."""

    low: float
    high: float
    start: float


class Bound(NamedTuple):
    """How well a design tells the pose: root mean squares over the task's poses."""

    cost: float
    """Of all four in the task's units, rms; infinite where the design cannot be made."""
    pose: LimbPose
    """Cramér–Rao bounds as standard deviations [m, m, rad, rad]."""


@dataclass(frozen=True, eq=False)
class Constraints:
    """What a design must keep to, whatever its bound."""

    areas: Mapping[str, tuple[float, float]]
    """Least and largest area [m²] of electrodes by name, and of all together under ``all``."""
    outline: shapely.Polygon | None = None
    """What all electrodes stay within, as seen along z [m]."""

    def violation(self, design: Design) -> str:
        """Which constraint a design breaks, and by how much; empty if it keeps to all."""
        areas = {e.name: e.surface.area for e in design.electrodes}
        areas["all"] = sum(areas.values())
        for name, (least, most) in self.areas.items():
            if not least * (1 - 1e-9) <= areas[name] <= most * (1 + 1e-9):
                side, limit = ("below", least) if areas[name] < least else ("above", most)
                return f"area of {name} is {areas[name]:.4g} m², {side} its limit of {limit:.4g} m²"
        if self.outline is not None:
            within = self.outline.buffer(TOUCH)
            for electrode in design.electrodes:
                for facet in electrode.surface.facets:
                    if not within.covers(facet.footprint):
                        over = 1e6 * facet.footprint.difference(self.outline).area
                        return (
                            f"electrode {electrode.name!r} has {over:.3g} mm² outside the outline"
                        )
        return ""

    def __bool__(self) -> bool:
        return bool(self.areas) or self.outline is not None


@dataclass(frozen=True, eq=False)
class DesignTask:
    """What is to be found; made by :func:`load_task`."""

    name: str
    template: Mapping[str, Any]
    """A design's file, with expressions of the parameters."""
    parameters: Mapping[str, Span]
    poses: tuple[LimbPose, ...]
    """Where the limb will be."""
    belief: Belief
    one: LimbPose
    """Errors of each kind that weigh the same [m, m, rad, rad]."""
    noise: float
    """Standard deviation of a channel [F]."""
    relative: float
    """A further part of it, proportional to the capacitance."""
    matrix: bool
    """Whether whole matrices are measured, not self capacitances only."""
    evaluations: int
    """Candidates that are tried."""
    seed: int
    resolution: float
    """Of the fields during the search; 1 is full accuracy."""
    folder: Path
    """What the design names is relative to this folder."""
    constraints: Constraints

    @property
    def start(self) -> Array:
        """Parameters that the search starts from, shape (n,)."""
        return np.array([p.start for p in self.parameters.values()])

    def content(self, values: Array) -> dict[str, Any]:
        """The design's file for values of the parameters.

        Raises:
            DesignError: An expression is wrong.
        """
        named = dict(zip(self.parameters, np.asarray(values).tolist(), strict=True))
        return fill(self.template, named, _DIGITS)

    def design(self, values: Array) -> Design:
        """The design for values of the parameters.

        Raises:
            DesignError: It cannot be made: electrodes touch, say.
        """
        return parse_design(self.content(values), source=self.name, folder=self.folder)

    def bound(
        self, values: Array, resolution: float | None = None, preset: PresetName = DEFAULT_PRESET
    ) -> Bound:
        """Judge one candidate.

        Args:
            values: Of the parameters, shape (n,).
            resolution: Of its field; by default that of the search.
            preset: How finely the solver resolves the limb.

        Raises:
            DesignError: The design cannot be made.
            FieldError: Its field cannot be built.
        """
        design = self.design(values)
        settings = BuildSettings().refined(resolution or self.resolution)
        field = build_background(design, settings)
        sim = Simulator(design, settings=settings, background=field, preset=preset)
        estimator = PoseEstimator(
            sim, self.belief, noise=self.noise, relative=self.relative, matrix=self.matrix
        )
        squares = np.mean([np.diag(estimator.covariance(p)) for p in self.poses], axis=0)
        cost = math.sqrt(float(np.mean(squares / np.square(self.one))))
        return Bound(cost, LimbPose(*np.sqrt(squares).tolist()))


class _Spent(Exception):
    """All evaluations are used up."""


def search(
    task: DesignTask, each: Callable[[Array, Bound], None] = lambda values, bound: None
) -> tuple[Array, Bound]:
    """The best parameters found.

    The start, then points of a Latin hypercube, are tried; Nelder–Mead goes on from the best of
    them with two thirds of all evaluations. What cannot be made costs an infinite amount. What
    breaks a constraint does so as well, but is not built, and is no evaluation. The same task gives
    the same result.

    Args:
        task: What is to be found.
        each: Called with every candidate and its bound.

    Raises:
        DesignError: The start cannot be made, or an expression is wrong.
        FieldError: The field of the start cannot be built.
    """
    spans = np.array([(p.low, p.high) for p in task.parameters.values()])
    low, width = spans[:, 0], spans[:, 1] - spans[:, 0]
    tried: list[tuple[Array, Bound]] = []

    def judge(share: Array) -> float:
        values = np.round(low + np.clip(share, 0.0, 1.0) * width, _DIGITS)
        known = [b for v, b in tried if np.array_equal(v, values)]
        if known:
            return known[0].cost
        if tried and broken(values):
            return math.inf
        if len(tried) >= max(1, task.evaluations):
            raise _Spent
        try:
            bound = task.bound(values)
        except (DesignError, FieldError):
            if not tried:
                raise
            bound = Bound(math.inf, LimbPose(*[math.inf] * 4))
        tried.append((values, bound))
        each(values, bound)
        return bound.cost

    def broken(values: Array) -> bool:
        try:
            return bool(task.constraints.violation(task.design(values)))
        except DesignError:
            return False  # it is tried, and counts

    judge((task.start - low) / width)
    sampler = qmc.LatinHypercube(len(low), rng=np.random.default_rng(task.seed))
    first = task.evaluations // 3
    for _ in range(_ROUNDS):
        for share in sampler.random(max(0, first - 1)):
            if len(tried) < first:
                judge(share)
    best = min(tried, key=lambda pair: pair[1].cost)[0]
    left = task.evaluations - len(tried)
    if left > 0:  # of the simplex, one corner is known
        origin = (best - low) / width
        corners = origin + np.where(origin > 0.5, -0.15, 0.15)[:, None] * np.eye(len(low))
        allowed = (left + 1) * (_ROUNDS if task.constraints else 1)
        with suppress(_Spent):
            minimize(
                judge, origin, method="Nelder-Mead", bounds=[(0.0, 1.0)] * len(low),
                options={"maxfev": allowed, "initial_simplex": np.vstack([origin, corners]),
                         "xatol": 1e-3, "fatol": 1e-4},
            )  # fmt: skip
    return min(tried, key=lambda pair: pair[1].cost)


def at_bounds(task: DesignTask, values: Array) -> dict[str, tuple[str, float]]:
    """Parameters that lie within a hundredth of their range of a bound.

    Args:
        task: What was to be found.
        values: Of the parameters, shape (n,).

    Returns:
        Of each such parameter, ``"lower"`` or ``"upper"``, and the bound.
    """
    found = {}
    for (name, span), value in zip(task.parameters.items(), values.tolist(), strict=True):
        share = (value - span.low) / (span.high - span.low)
        if not 0.01 < share < 0.99:
            found[name] = ("lower", span.low) if share < 0.5 else ("upper", span.high)
    return found


def load_task(path: str | Path) -> DesignTask:
    """Load the file of a task; see ``docs/optimise.md``.

    Raises:
        ScenarioError: There is no such file, or anything in it is wrong.
        DesignError: An expression of the design is wrong, or the start cannot be made or breaks a
            constraint.
    """
    file = Path(path)
    top = Table(read_toml(file, "task", ScenarioError), file.name, "task")
    top.only(TOP_KEYS)
    top.needs("name", "parameters", "design")

    def part(key: str, keys: tuple[str, ...] | None = None) -> Table:
        table = Table(top.data.get(key, {}), file.name, key)
        if keys is not None:
            table.only(keys)
        return table

    limb = part("limb", ("radius", "radius_spread"))
    spread = part("one", LimbPose._fields)
    one = LimbPose(
        spread.length("lateral", 0.01), spread.length("vertical", 0.01),
        *(math.radians(spread.number(k, 1e-3, 180.0, 10.0)) for k in ("pitch", "yaw")),
    )  # fmt: skip
    if "parameters" not in top:
        raise top.error("has no parameters; add [parameters] with name = { from = a, to = b }")
    task = DesignTask(
        name=top.string("name"),
        template=Table(top.raw("design", "[design], a design's file"), file.name, "design").data,
        parameters={k: _span(part("parameters"), k) for k in top.data["parameters"]},
        poses=tuple(_poses(part("poses", LimbPose._fields))),
        belief=Belief(
            spread=LimbPose(0.05, 0.05, 0.5, 0.5), radius=limb.length("radius", 0.042),
            radius_spread=limb.number("radius_spread", 0.0, 2.0, 0.25),
        ),
        one=one, noise=top.number("noise", 1e-21, 1e-9, 0.5e-15, unit="F"),
        relative=top.number("relative", 0.0, 1.0, 0.0), matrix=top.boolean("matrix", False),
        evaluations=top.integer("evaluations", 1, 10**5, 60),
        seed=top.integer("seed", 0, 2**63 - 1, 0),
        resolution=top.number("resolution", 0.25, 4.0, 0.25), folder=file.resolve().parent,
        constraints=Constraints({}),
    )  # fmt: skip
    start = task.design(task.start)
    if "constraints" in top:
        limits = part("constraints", ("area", "outline", "clearance"))
        task = replace(task, constraints=_constraints(limits, start.electrode_names))
    if broken := task.constraints.violation(start):
        raise top.error(f"the start breaks a constraint: {broken}; change start = …, or the limit")
    return task


def _constraints(table: Table, electrodes: Sequence[str]) -> Constraints:
    """Limits of areas, and the outline."""
    areas = {}
    given = Table(table.data.get("area", {}), table.source, "constraints: area")
    names = [*electrodes, "all"]
    for name in given.data:
        if name not in names:
            raise given.error(f"{name!r} is no electrode; {suggest(name, names)}")
        one = Table(given.data[name], table.source, f"constraints: area of {name}")
        one.only(("min", "max"))
        least = one.number("min", 0.0, 1e2, 0.0, unit="m²")
        most = one.number("max", least, 1e2, math.inf, unit="m²")
        areas[name] = (least, most)
    if "outline" not in table:
        if "clearance" in table:
            raise table.error("clearance is kept from an outline, and there is none; add outline")
        return Constraints(areas)
    value = table.raw("outline", "[width, height], or a list of [x, y] points in metres")
    if isinstance(value, list) and value and not isinstance(value[0], list):
        width, height = table.sizes("outline", 2, "[width, height] in metres")
        outline = shapely.box(-width / 2, -height / 2, width / 2, height / 2)
    else:
        outline = shapely.Polygon(table.points("outline", 3))
    if not outline.is_valid:
        raise table.error("outline crosses itself; give its corners in order")
    within = outline.buffer(-table.length("clearance", 0.0, zero=True), join_style="mitre")
    if not isinstance(within, shapely.Polygon) or within.is_empty:
        raise table.error("clearance leaves nothing of the outline in one piece; reduce it")
    return Constraints(areas, within)


def to_toml(data: Mapping[str, Any], path: tuple[str, ...] = ()) -> str:
    """TOML of nested tables, lists of tables, lists, texts, numbers and booleans."""
    tables = {k: v for k, v in data.items() if isinstance(v, Mapping)}
    lists = {k: v for k, v in data.items() if isinstance(v, list) and v and isinstance(v[0], dict)}
    lines = [f"{k} = {_value(v)}" for k, v in data.items() if k not in tables | lists]
    for key, table in tables.items():
        lines += ["", f"[{'.'.join((*path, key))}]", to_toml(table, (*path, key))]
    for key, rows in lists.items():
        for row in rows:
            lines += ["", f"[[{'.'.join((*path, key))}]]", to_toml(row, (*path, key))]
    return "\n".join(lines)


def _value(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(_value(v) for v in value)}]"
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{k} = {_value(v)}' for k, v in value.items())} }}"
    return f"{value:.9g}" if isinstance(value, float) else json.dumps(value, ensure_ascii=False)


def _span(table: Table, name: str) -> Span:
    """The range of a parameter."""
    span = Table(table.data[name], table.source, f"parameter {name!r}")
    span.only(("from", "to", "start"))
    if not name.isidentifier():
        raise span.error("is no name for expressions; use letters, digits and _")
    low = span.number("from", -1e3, 1e3)
    high = span.number("to", low, 1e3)
    if not high > low:
        raise span.error(f"from = to = {low:g}; give a range, or write the number in the design")
    return Span(low, high, span.number("start", low, high, 0.5 * (low + high)))


def _poses(table: Table) -> Iterator[LimbPose]:
    """All combinations of the values that are given."""
    values = []
    for key, default in LimbPose()._asdict().items():
        angle = key in ("pitch", "yaw")
        low, high, unit = (-60.0, 60.0, "degrees") if angle else (-1.0, 1.0, "m")
        found = table.series(key, low, high, unit) if key in table else default
        many = found if isinstance(found, list) else [found]
        values.append([math.radians(v) for v in many] if angle else many)
    for one in product(*values):
        yield LimbPose(*one)
