"""Fit scenario 1 of ``capsense reproduce`` to the measured panels of the paper's Fig. 9.

Prints the figures for ``src/capsense/reproduce/data/scenario1.toml``, how far the table that the
fit interpolates is from the simulation, and, if asked, how well each panel is foretold from the
others, how well the predicted panel is known, and how well other pairs and pours fit. ``python
benchmarks/fit_scenario1.py`` takes seconds once the fields are built, ``--pairs`` a minute.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from itertools import combinations, product

import numpy as np
from scenario1_fit import (
    Fit,
    Grid,
    ResponseTable,
    changed,
    fit,
    fit_without,
    own_figures,
    predicted,
    tabulate,
)

from capsense.readout.calibration import cross_correlation
from capsense.reproduce.harness import rmse
from capsense.reproduce.scenario1_setup import (
    Array,
    Scenario1Setup,
    load_curves,
    load_setup,
    matrices,
    mutual,
    normalised,
)
from capsense.simulator import Simulator

BOARDS = ("stripe", "patch")
PREDICTED = "patch_T4"
DRAWS = 200


def report(stage: str, fraction: float) -> None:
    """A line on stderr."""
    print(f"  {stage}", file=sys.stderr)


def simulators(setup: Scenario1Setup) -> dict[str, Simulator]:
    """Of both boards."""
    return {
        name: Simulator(
            setup.boards[name].sensor(setup.pour), excitation_frequency=setup.excitation_frequency
        )
        for name in BOARDS
    }


def tables_of(setup: Scenario1Setup, grids: dict[str, Grid]) -> dict[str, ResponseTable]:
    """Tables of the set-up's pairs."""
    return {name: grid.table(setup.boards[name].pair) for name, grid in grids.items()}


def recorded(setup: Scenario1Setup) -> list[str]:
    """Names of the panels whose curves are given."""
    return [name for name, panel in setup.panels.items() if panel.file]


def curve_of(setup: Scenario1Setup, tables: dict[str, ResponseTable], panel: str) -> Array:
    """A panel's curve by the table of its board."""
    return predicted(setup, panel, tables[setup.panels[panel].board])


def likeness(
    setup: Scenario1Setup, tables: dict[str, ResponseTable], panel: str
) -> tuple[float, float]:
    """Zero-mean correlation and rms error of a panel's curve by the table against hardware."""
    measured = load_curves(setup.panels[panel]).measured
    curve = curve_of(setup, tables, panel)
    return cross_correlation(curve, measured), rmse(curve, measured)


def level_boards(setup: Scenario1Setup) -> Scenario1Setup:
    """The same with both boards at one height, which is no longer fitted."""
    kept = {key: u for key, u in setup.uncertainty.items() if key != "patch.height"}
    return replace(changed(setup, {"patch.height": 0.0}), uncertainty=kept)


def held_out(setup: Scenario1Setup, tables: dict[str, ResponseTable]) -> dict[str, Scenario1Setup]:
    """For each recorded panel the set-up that is fitted with it held out."""
    return {name: fit_without(setup, tables, name) for name in recorded(setup)}


def print_held_out(setup: Scenario1Setup, tables: dict[str, ResponseTable]) -> None:
    """How each panel is foretold by the others, and what becomes of the predicted one."""
    best = curve_of(setup, tables, PREDICTED)
    for title, begin in (("", setup), (", boards at one height", level_boards(setup))):
        for name, other in held_out(begin, tables).items():
            correlation, error = likeness(other, tables, name)
            moved = curve_of(other, tables, PREDICTED)
            print(
                f"\n{name} held out{title}: correlation {correlation:.4f}, rms error {error:.4f}; "
                f"fitted to it {own_figures(begin, tables, name)}; the predicted panel moves by "
                f"{rmse(moved, best):.4f} rms"
            )
            for key in ("gap", "stray", "sample_rate", "rest", "tilt"):
                print(f"  {key} = {other.value(key):.4g}    # ± {other.uncertainty[key]:.2g}")


def print_pairs(setup: Scenario1Setup, grids: dict[str, Grid], count: int | None = None) -> None:
    """The fit of every choice of pairs, and the panel that it predicts, the best first."""
    best = curve_of(setup, tables_of(setup, grids), PREDICTED)
    found = []
    pairs = list(combinations(grids["stripe"].names, 2))
    for one, other in product(pairs, pairs):
        tables = {"stripe": grids["stripe"].table(one), "patch": grids["patch"].table(other)}
        result = fit(setup, tables)
        errors = [likeness(result.setup, tables, name)[1] for name in recorded(setup)]
        moved = curve_of(result.setup, tables, PREDICTED)
        stray, height = (result.setup.value(key) for key in ("stray", "patch.height"))
        ratio = (tables["stripe"].empty + stray) / (tables["patch"].empty + stray)
        text = (
            f"{'-'.join(one)} {'-'.join(other)}: {' '.join(f'{e:.4f}' for e in errors)}; "
            f"{1e15 * stray:.1f} fF, {1e3 * height:.1f} mm, {ratio:.2f}; {rmse(moved, best):.4f}, "
            f"{cross_correlation(moved, best):.4f}, {moved.min():.3f}"
        )
        found.append((result.cost, text))
    print(
        "\npairs, stripe and patch: rms error of the panels; stray capacitance, height of the "
        "patch board, capacitance read on stripes over that on patches; the predicted panel: rms "
        f"difference from the shipped one, correlation with it, lowest (shipped {best.min():.3f})"
    )
    for _, text in sorted(found)[:count]:
        print(text)


def print_prediction(result: Fit, tables: dict[str, ResponseTable]) -> None:
    """How far the predicted panel moves with the fitted figures' uncertainties."""
    curve = curve_of(result.setup, tables, PREDICTED)
    moved = [curve_of(one, tables, PREDICTED) for one in result.drawn(DRAWS)]
    change = np.sqrt(np.mean([rmse(one, curve) ** 2 for one in moved]))
    low = np.std([one.min() for one in moved])
    least = min(cross_correlation(one, curve) for one in moved)
    print(
        f"\n{PREDICTED}, {DRAWS} draws of the fitted figures: rms change {change:.4f}, least "
        f"zero-mean correlation {least:.4f}, lowest reading {curve.min():.4f} ± {low:.4f}"
    )


def print_fit(
    setup: Scenario1Setup, sims: dict[str, Simulator], tables: dict[str, ResponseTable]
) -> Fit:
    """The figures, and each recorded panel's curve by the simulation itself."""
    result = fit(setup, tables, report=report)
    print(f"cost {result.cost:.6f}, correlation of successive residuals {result.memory:.3f}\n")
    for key, deviation in result.setup.uncertainty.items():
        print(f"{key} = {result.setup.value(key):.5g}    # ± {deviation:.2g}")
    print()
    for name in recorded(setup):
        panel = result.setup.panels[name]
        board, sim, table = setup.boards[panel.board], sims[panel.board], tables[panel.board]
        times = result.setup.times(panel)
        poses = result.setup.poses(panel.board, panel.trajectory, setup.panel_speed, times)
        values = mutual(matrices(sim, setup, poses), sim.electrode_names, board.pair)
        level = result.setup.level_of(panel)
        curve = level * normalised(result.setup, board, values, table.empty, noise=False)
        measured = load_curves(panel).measured
        noise = np.median(np.abs(np.diff(measured, 2))) / 0.6745 / np.sqrt(6)
        print(
            f"{name}: correlation {cross_correlation(curve, measured):.4f}, rms error "
            f"{rmse(curve, measured):.4f}; coupling {1e15 * table.empty:.2f} fF; the table is "
            f"within {rmse(curve, curve_of(result.setup, tables, name)):.4f} rms of the "
            f"simulation; noise of the measurement {noise:.4f}, "
            f"{noise / level * (table.empty + result.setup.stray):.2g} F"
        )
    return result


def main() -> None:
    """Tabulate, fit, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--prediction", action="store_true", help="how well the panel is known")
    parser.add_argument("--held-out", action="store_true", help="foretell each panel by the others")
    parser.add_argument("--pairs", action="store_true", help="try every choice of pairs")
    parser.add_argument("--pours", action="store_true", help="try all pairs with floating pours")
    args = parser.parse_args()
    setup = load_setup()
    sims = simulators(setup)
    grids = {name: tabulate(sim, setup) for name, sim in sims.items()}
    tables = tables_of(setup, grids)
    result = print_fit(setup, sims, tables)
    if args.prediction:
        print_prediction(result, tables)
    if args.held_out:
        print_held_out(result.setup, tables)
    if args.pairs:
        print_pairs(result.setup, grids)
    if args.pours:
        other = replace(result.setup, pour="floating")
        print("\nfloating pours")
        print_pairs(other, {n: tabulate(sim, other) for n, sim in simulators(other).items()}, 3)


if __name__ == "__main__":
    main()
