"""Fit scenario 1 of ``capsense reproduce`` to the measured panels of the paper's Fig. 9.

Prints the figures for ``src/capsense/reproduce/data/scenario1.toml``, how far the table that the
fit interpolates is from the simulation, and, if asked, how well other assumptions fit and how well
one panel is foretold from the other. ``python benchmarks/fit_scenario1.py`` takes a minute, each
option half a minute more, ``--pours`` several, most of them for the fields.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace

import numpy as np

from capsense.reproduce.metrics import cross_correlation, rmse
from capsense.reproduce.scenario1 import ZIGZAG, ZIGZAG_SAMPLES
from capsense.reproduce.scenario1_fit import (
    Fit,
    Grid,
    Table,
    fit,
    fit_without,
    predicted,
    tabulate,
)
from capsense.reproduce.scenario1_setup import PANEL_SAMPLES, Setup, load_panel, load_setup
from capsense.reproduce.scenario1_signal import matrices, mutual, normalised
from capsense.simulator import Simulator

PANELS = ("stripe", "patch")
DRAWS = 200


def report(stage: str, fraction: float) -> None:
    """A line on stderr."""
    print(f"  {stage}", file=sys.stderr)


def simulators(setup: Setup) -> dict[str, Simulator]:
    """Of both boards."""
    return {
        name: Simulator(setup.boards[name].sensor(setup.pour), frequency=setup.frequency)
        for name in PANELS
    }


def tables_of(setup: Setup, grids: dict[str, Grid]) -> dict[str, Table]:
    """Tables of the set-up's pairs."""
    return {name: grid.table(setup.boards[name].pair) for name, grid in grids.items()}


def likeness(setup: Setup, name: str, table: Table) -> tuple[float, float]:
    """Zero-mean correlation and rms error of a board's curve by the table against hardware."""
    measured = load_panel(setup.boards[name].panel).measured
    curve = predicted(setup, name, table)
    return cross_correlation(curve, measured), rmse(curve, measured)


def held_out(setup: Setup, tables: dict[str, Table]) -> dict[str, Setup]:
    """For each board the set-up that is fitted with its panel held out."""
    return {name: fit_without(setup, tables, name) for name in PANELS}


def print_held_out(setup: Setup, tables: dict[str, Table]) -> None:
    """What one panel alone tells, and how it foretells the other."""
    found = held_out(setup, tables)
    for name, other in found.items():
        print(f"\n{name} held out")
        for key in (key for key in setup.uncertainty if "." not in key):
            print(f"{key} = {other.value(key):.4g}    # ± {other.uncertainty[key]:.2g}")
        for board, table in tables.items():
            correlation, error = likeness(other, board, table)
            print(f"{board}: correlation {correlation:.4f}, rms error {error:.4f}")


def all_pairs(
    setup: Setup, grids: dict[str, Grid]
) -> dict[tuple[str, str], tuple[Fit, list[float]]]:
    """The fit of every choice of pairs, and the rms errors of both boards, the best first."""
    found = {}
    choices = {
        name: [(a, b) for k, a in enumerate(grid.names) for b in grid.names[k + 1 :]]
        for name, grid in grids.items()
    }
    for one in choices["stripe"]:
        for other in choices["patch"]:
            tables = {"stripe": grids["stripe"].table(one), "patch": grids["patch"].table(other)}
            result = fit(setup, tables)
            errors = [likeness(result.setup, name, tables[name])[1] for name in PANELS]
            found["-".join(one), "-".join(other)] = result, errors
    return dict(sorted(found.items(), key=lambda item: item[1][0].cost))


def with_teeth(setup: Setup, width: float) -> Setup:
    """The same with the zig-zag's teeth wider by a factor."""
    start, *teeth = setup.trajectories[ZIGZAG]
    wider = (start, *((width * x, z) for x, z in teeth))
    return replace(setup, trajectories={**setup.trajectories, ZIGZAG: wider})


def print_zig_zag(result: Fit, tables: dict[str, Table]) -> None:
    """How far the zig-zag's curves move with what is known badly."""
    setup = result.setup
    drawn = result.drawn(DRAWS)
    others = {f"{DRAWS} draws of the fitted figures": drawn} | {
        f"teeth {width:g} times as wide": [with_teeth(setup, width)] for width in (0.5, 2.0)
    }
    print("\nzig-zag: rms change; least zero-mean correlation; rms change of the lowest reading")
    for name, table in tables.items():
        curve = predicted(setup, name, table, ZIGZAG, ZIGZAG_SAMPLES)
        for what, setups in others.items():
            moved = [predicted(other, name, table, ZIGZAG, ZIGZAG_SAMPLES) for other in setups]
            change = np.sqrt(np.mean([rmse(one, curve) ** 2 for one in moved]))
            least = min(cross_correlation(one, curve) for one in moved)
            low = np.sqrt(np.mean([(one.min() - curve.min()) ** 2 for one in moved]))
            print(f"{name}, {what}: {change:.4f}, {least:.2f}, {low:.4f} of {curve.min():.4f}")


def print_fit(setup: Setup, sims: dict[str, Simulator], tables: dict[str, Table]) -> Fit:
    """The figures, and each board's curve by the simulation itself."""
    result = fit(setup, tables, report=report)
    print(f"cost {result.cost:.6f}, correlation of successive residuals {result.memory:.3f}\n")
    for key, deviation in result.setup.uncertainty.items():
        print(f"{key} = {result.setup.value(key):.5g}    # ± {deviation:.2g}")
    print()
    for name, sim in sims.items():
        board, panel = result.setup.boards[name], load_panel(setup.boards[name].panel)
        times = np.arange(PANEL_SAMPLES) / board.sample_rate
        poses = result.setup.poses(name, "T2", setup.panel_speed, times)
        values = mutual(matrices(sim, setup, poses), sim.electrode_names, board.pair)
        curve = normalised(result.setup, board, values, tables[name].empty, noise=False)
        apart = rmse(curve, predicted(result.setup, name, tables[name]))
        steps = np.diff(panel.measured)
        noise = np.median(np.abs(steps)) / 0.6745 / np.sqrt(2) / board.level
        noise *= tables[name].empty + result.setup.stray
        print(
            f"{name}: correlation {cross_correlation(curve, panel.measured):.4f}, rms error "
            f"{rmse(curve, panel.measured):.4f}; coupling {1e15 * tables[name].empty:.2f} fF; the "
            f"table is within {apart:.4f} rms of the simulation; noise of the measurement "
            f"{noise:.2g} F"
        )
    return result


def main() -> None:
    """Tabulate, fit, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--zig-zag", action="store_true", help="how well the zig-zag is known")
    parser.add_argument("--held-out", action="store_true", help="foretell each panel by the other")
    parser.add_argument("--pairs", action="store_true", help="try every choice of pairs")
    parser.add_argument("--pours", action="store_true", help="try all pairs with floating pours")
    args = parser.parse_args()
    setup = load_setup()
    sims = simulators(setup)
    grids = {name: tabulate(sim, setup) for name, sim in sims.items()}
    tables = tables_of(setup, grids)
    result = print_fit(setup, sims, tables)
    if args.zig_zag:
        print_zig_zag(result, tables)
    if args.held_out:
        print_held_out(setup, tables)
    if args.pairs:
        print("\nrms error by pair: stripe, patch")
        for pairs, (_, errors) in all_pairs(setup, grids).items():
            print(*pairs, *(f"{error:.4f}" for error in errors))
    if args.pours:
        other = replace(setup, pour="floating")
        found = {name: tabulate(sim, other) for name, sim in simulators(other).items()}
        print("\nfloating pours, the best pairs: rms error of stripe, patch; stray capacitance")
        for pairs, (result, errors) in list(all_pairs(other, found).items())[:3]:
            print(*pairs, *(f"{error:.4f}" for error in errors), f"{result.setup.stray:.3g} F")


if __name__ == "__main__":
    main()
