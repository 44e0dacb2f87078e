"""Fit scenario 1 of ``capsense reproduce`` to the measured panels of the paper's Fig. 9.

Prints the figures for ``src/capsense/reproduce/data/scenario1.toml``, how far the table that the
fit interpolates is from the simulation, and, with ``--pairs``, the fit of every choice of
electrode pairs. ``python benchmarks/fit_scenario1.py`` takes half a minute, with ``--pairs`` two.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np

from capsense.reproduce.metrics import cross_correlation, rmse
from capsense.reproduce.scenario1_fit import Grid, Table, fit, predicted, tabulate
from capsense.reproduce.scenario1_setup import PANEL_SAMPLES, Setup, load_panel, load_setup
from capsense.reproduce.scenario1_signal import matrices, mutual, normalised
from capsense.simulator import Simulator

PANELS = ("stripe", "patch")


def report(stage: str, fraction: float) -> None:
    """A line on stderr."""
    print(f"  {stage}", file=sys.stderr)


def compare_pairs(setup: Setup, grids: dict[str, Grid]) -> None:
    """The fit of every choice of pairs, the best first."""
    found = []
    choices = {
        name: [(a, b) for k, a in enumerate(grid.names) for b in grid.names[k + 1 :]]
        for name, grid in grids.items()
    }
    for one in choices["stripe"]:
        for other in choices["patch"]:
            tables = {"stripe": grids["stripe"].table(one), "patch": grids["patch"].table(other)}
            result = fit(setup, tables)
            errors = [
                rmse(predicted(result.setup, name, tables[name]), load_panel(
                    setup.boards[name].panel).measured)
                for name in PANELS
            ]  # fmt: skip
            found.append((result.cost, one, other, errors))
    print("\nrms error by pair: stripe, patch")
    for _, one, other, errors in sorted(found):
        print("-".join(one), "-".join(other), *(f"{error:.4f}" for error in errors))


def main() -> None:
    """Tabulate, fit, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", action="store_true", help="try every choice of pairs")
    args = parser.parse_args()
    setup = load_setup()
    sims = {name: Simulator(name, frequency=setup.frequency) for name in PANELS}
    grids = {}
    for name, sim in sims.items():
        report(f"tabulating {name}", 0.0)
        grids[name] = tabulate(sim, setup)
    tables: dict[str, Table] = {n: grids[n].table(setup.boards[n].pair) for n in PANELS}
    result = fit(setup, tables, report=report)
    print(f"cost {result.cost:.6f}, correlation of successive residuals {result.memory:.3f}\n")
    for key, deviation in result.setup.uncertainty.items():
        print(f"{key} = {result.setup.value(key):.5g}    # ± {deviation:.2g}")
    print()
    for name, sim in sims.items():
        board, panel = result.setup.boards[name], load_panel(setup.boards[name].panel)
        times = np.arange(PANEL_SAMPLES) / board.sample_rate
        poses = result.setup.poses("T2", setup.panel_speed, times)
        values = mutual(matrices(sim, setup, poses), sim.electrode_names, board.pair)
        curve = normalised(result.setup, board, values, tables[name].empty, noise=False)
        apart = np.abs(curve - predicted(result.setup, name, tables[name])).max()
        steps = np.diff(panel.measured)
        noise = np.median(np.abs(steps)) / 0.6745 / np.sqrt(2) / board.level
        noise *= tables[name].empty + result.setup.stray
        print(
            f"{name}: correlation {cross_correlation(curve, panel.measured):.4f}, rms error "
            f"{rmse(curve, panel.measured):.4f}; the table is within {apart:.4f} of the "
            f"simulation; noise of the measurement {noise:.2g} F"
        )
    if args.pairs:
        compare_pairs(setup, grids)


if __name__ == "__main__":
    main()
