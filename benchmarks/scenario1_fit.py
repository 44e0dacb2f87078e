"""Fits what the paper leaves out of scenario 1 to the measured curves of its panels.

The change of a pair's capacitance is tabulated over the bar's place once per board, and
interpolated while fitting; the final curves come from the simulation itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.optimize import least_squares

from capsense.reproduce.scenario1_setup import (
    Array,
    Scenario1Setup,
    load_curves,
    matrices,
    mutual,
)
from capsense.scene import Pose
from capsense.simulator import Simulator

STEP, REACH = 0.004, 0.252
"""The table's spacing and reach along x [m]."""
NEAREST, FARTHEST, HEIGHTS = 0.005, 0.160, 36
"""Gaps of the table [m], and their number; they grow by a constant factor."""


@dataclass(frozen=True, eq=False)
class ResponseTable:
    """Relative change of a pair's capacitance over the bar's place."""

    empty: float
    """Mutual capacitance without the bar [F]."""
    spline: RectBivariateSpline
    thickness: float
    """Of the bar [m]."""

    def change(self, x: Array, z: Array) -> Array:
        """C/C_empty − 1 with the bar's centre at x, z [m], shapes (n,)."""
        gap = np.maximum(z - 0.5 * self.thickness, NEAREST)
        return self.spline.ev(np.clip(x, -REACH, REACH), np.log(gap))


@dataclass(frozen=True, eq=False)
class Grid:
    """Matrices of a board over the bar's place, from which a pair's table is made."""

    names: tuple[str, ...]
    """Electrodes in matrix order."""
    empty: Array
    """Matrix without the bar [F], shape (M, M)."""
    x: Array
    """[m]"""
    gaps: Array
    """[m]"""
    matrices: Array
    """[F], shape (len(x), len(gaps), M, M)."""
    thickness: float
    """Of the bar [m]."""

    def table(self, pair: tuple[str, str]) -> ResponseTable:
        """The table of a pair."""
        empty = float(mutual(self.empty, self.names, pair))
        change = mutual(self.matrices, self.names, pair) / empty - 1
        return ResponseTable(
            empty, RectBivariateSpline(self.x, np.log(self.gaps), change), self.thickness
        )


def tabulate(sim: Simulator, setup: Scenario1Setup, coarser: float = 1.0) -> Grid:
    """Step the bar through a grid of places.

    Args:
        sim: A simulator of the board.
        setup: The scenario.
        coarser: Factor between grid points; 1 is 127 x 36 steps.
    """
    x = np.linspace(-REACH, REACH, round(2 * REACH / STEP / coarser) + 1)
    gaps = np.geomspace(NEAREST, FARTHEST, round(HEIGHTS / coarser))
    values = [
        matrices(sim, setup, [Pose((a, 0.0, gap + 0.5 * setup.size[2])) for a in x]) for gap in gaps
    ]
    stacked = np.swapaxes(np.array(values), 0, 1)
    return Grid(sim.electrode_names, sim.baseline, x, gaps, stacked, setup.size[2])


def predicted(setup: Scenario1Setup, panel: str, table: ResponseTable) -> Array:
    """A panel's curve by its board's table, without rounding and noise, shape (samples,)."""
    shown = setup.panels[panel]
    poses = setup.poses(shown.board, shown.trajectory, setup.panel_speed, setup.times(shown))
    place = np.array([pose.position for pose in poses])
    share = table.empty / (table.empty + setup.stray)
    return setup.level_of(shown) * (1 + share * table.change(place[:, 0], place[:, 2]))


def changed(setup: Scenario1Setup, values: Mapping[str, float]) -> Scenario1Setup:
    """The same set-up with other figures, by the names of :meth:`Scenario1Setup.value`."""
    out: dict[str, Any] = {
        "zigzag": setup.zigzag, "boards": dict(setup.boards), "panels": dict(setup.panels)
    }  # fmt: skip
    for key, value in values.items():
        name, _, own = key.rpartition(".")
        change: dict[str, Any] = {own: float(value)}
        if not name:
            out |= change
        elif name == "zigzag":
            out[name] = replace(out[name], **change)
        else:
            group = out["boards" if name in setup.boards else "panels"]
            group[name] = replace(group[name], **change)
    return replace(setup, **out)


@dataclass(frozen=True)
class Fit:
    """The outcome of a fit."""

    setup: Scenario1Setup
    """The set-up with the fitted figures and their uncertainties."""
    cost: float
    """Half the sum of squared differences over all panels."""
    memory: float
    """Correlation of successive residuals, the largest of the panels'."""
    keys: tuple[str, ...]
    """The figures that were fitted."""
    covariance: Array
    """Of these figures, in their units, shape (len(keys), len(keys))."""

    def drawn(self, count: int, seed: int = 0) -> list[Scenario1Setup]:
        """Set-ups whose fitted figures are drawn at random from their covariance."""
        random = np.random.default_rng(seed)
        values = [self.setup.value(key) for key in self.keys]
        draws = random.multivariate_normal(values, self.covariance, count, method="cholesky")
        return [changed(self.setup, dict(zip(self.keys, draw, strict=True))) for draw in draws]


def fit(
    setup: Scenario1Setup,
    tables: Mapping[str, ResponseTable],
    *,
    panels: Sequence[str] | None = None,
    keys: Sequence[str] | None = None,
    starts: tuple[float, ...] = (0.6, 1.0, 1.6),
    report: Callable[[str, float], None] = lambda stage, fraction: None,
) -> Fit:
    """Least squares over panels.

    Residuals are not white: what is left is mostly the model's, and lasts several samples. So
    the covariance s²(JᵀJ)⁻¹ is widened by (1 + ρ)/(1 − ρ), where ρ is the correlation of
    successive residuals, as for a first-order process.

    Args:
        setup: Where to begin.
        tables: By board, of :meth:`Grid.table`.
        panels: Their names, by default of all whose curves are given.
        keys: The figures to be fitted, by default all that have an uncertainty.
        starts: Factors on the gap, if it is fitted; the fit begins from each, and the best counts.
        report: Told of each start.
    """
    keys = list(setup.uncertainty if keys is None else keys)
    names = list(_recorded(setup) if panels is None else panels)
    measured = [load_curves(setup.panels[name]).measured for name in names]
    start = np.array([setup.value(key) for key in keys])
    scale = np.where(start == 0, 1.0, np.abs(start))

    def residuals(vector: Array) -> Array:
        trial = changed(setup, dict(zip(keys, vector * scale, strict=True)))
        return np.concatenate(_curves(trial, tables, names)) - np.concatenate(measured)

    best = None
    for number, factor in enumerate(starts if "gap" in keys else (1.0,)):
        report(f"start {number + 1} of {len(starts)}", number / len(starts))
        begin = start / scale
        begin *= [factor if key == "gap" else 1.0 for key in keys]
        found = least_squares(residuals, begin, x_scale=0.1, max_nfev=60)
        if best is None or found.cost < best.cost:
            best = found
    assert best is not None
    parts = np.split(best.fun, np.cumsum([len(curve) for curve in measured])[:-1])
    memory = max(float(np.corrcoef(part[1:], part[:-1])[0, 1]) for part in parts)
    variance = 2 * best.cost / (len(best.fun) - len(keys)) * (1 + memory) / (1 - memory)
    covariance = np.linalg.inv(best.jac.T @ best.jac) * variance * np.outer(scale, scale)
    deviation = np.sqrt(np.diag(covariance))
    values = dict(zip(keys, best.x * scale, strict=True))
    uncertainty = dict(setup.uncertainty) | dict(zip(keys, deviation.tolist(), strict=True))
    fitted = replace(changed(setup, values), uncertainty=uncertainty)
    return Fit(fitted, float(best.cost), memory, tuple(keys), covariance)


def own_figures(
    setup: Scenario1Setup, tables: Mapping[str, ResponseTable], panel: str
) -> list[str]:
    """The fitted figures on which the curve of no other recorded panel depends."""
    others = [name for name in _recorded(setup) if name != panel]
    before = np.concatenate(_curves(setup, tables, others))
    moved = {
        key: np.concatenate(
            _curves(changed(setup, {key: setup.value(key) + deviation}), tables, others)
        )
        for key, deviation in setup.uncertainty.items()
    }
    return [key for key, after in moved.items() if np.array_equal(before, after)]


def fit_without(
    setup: Scenario1Setup, tables: Mapping[str, ResponseTable], panel: str
) -> Scenario1Setup:
    """Fit with a panel held out, but for what belongs to that panel alone.

    All that other panels depend on is fitted to them; then the held-out panel's own figures, see
    :func:`own_figures`, to it.

    Args:
        setup: Where to begin.
        tables: By board.
        panel: The one that is held out.
    """
    own = own_figures(setup, tables, panel)
    shared = [key for key in setup.uncertainty if key not in own]
    others = [name for name in _recorded(setup) if name != panel]
    found = fit(setup, tables, panels=others, keys=shared).setup
    return fit(found, tables, panels=[panel], keys=own).setup


def _recorded(setup: Scenario1Setup) -> list[str]:
    return [name for name, panel in setup.panels.items() if panel.file]


def _curves(
    setup: Scenario1Setup, tables: Mapping[str, ResponseTable], panels: Sequence[str]
) -> list[Array]:
    return [predicted(setup, name, tables[setup.panels[name].board]) for name in panels]
