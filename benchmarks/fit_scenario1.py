"""Fit scenario 1 of ``capsense reproduce`` to the measured panels of the paper's Fig. 9.

Prints the figures for ``src/capsense/reproduce/data/scenario1.toml``, how far the table that the
fit interpolates is from the simulation, and, if asked, how well each panel is foretold from the
others, how well the predicted panel is known, what limits its correlation with a recording, and
how well other pairs and pours fit. ``python benchmarks/fit_scenario1.py`` takes seconds once the
fields are built, ``--pairs`` a minute, ``--explain`` three.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Mapping
from dataclasses import replace
from itertools import combinations, product
from pathlib import Path

import numpy as np
from scenario1_explain import (
    Eased,
    ceilings,
    expected,
    lasting,
    noise_ceiling,
    sample_noise,
    tolerance,
)
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
RECORDINGS = 1000
"""Drawn to explain the predicted panel's correlation."""
AIM = 0.985
"""Zero-mean correlation that the predicted panel should have with hardware."""


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
        noise = sample_noise(measured)
        print(
            f"{name}: correlation {cross_correlation(curve, measured):.4f}, rms error "
            f"{rmse(curve, measured):.4f}; coupling {1e15 * table.empty:.2f} fF; the table is "
            f"within {rmse(curve, curve_of(result.setup, tables, name)):.4f} rms of the "
            f"simulation; noise of the measurement {noise:.4f}, "
            f"{noise / level * (table.empty + result.setup.stray):.2g} F"
        )
    return result


def finer(setup: Scenario1Setup, sim: Simulator, panel: str) -> Array:
    """What the fine preset changes of a panel's curve."""
    shown = setup.panels[panel]
    board = setup.boards[shown.board]
    poses = setup.poses(shown.board, shown.trajectory, setup.panel_speed, setup.times(shown))
    fine = Simulator(
        board.sensor(setup.pour), excitation_frequency=setup.excitation_frequency, preset="fine"
    )
    new, old = (
        mutual(matrices(one, setup, poses), one.electrode_names, board.pair) for one in (fine, sim)
    )
    empty = float(mutual(sim.baseline, sim.electrode_names, board.pair))
    return setup.level_of(shown) * (new - old) / (empty + setup.stray)


def print_explained(result: Fit, sims: dict[str, Simulator], grids: dict[str, Grid]) -> None:
    """What limits the correlation that the predicted panel may have with a recording of it."""
    setup, tables = result.setup, tables_of(result.setup, grids)
    curve = curve_of(setup, tables, PREDICTED)
    shown = setup.panels[PREDICTED]
    (same_board,) = (n for n in recorded(setup) if setup.panels[n].board == shown.board)
    (same_way,) = (n for n in recorded(setup) if setup.panels[n].trajectory == shown.trajectory)
    noise = sample_noise(load_curves(setup.panels[same_board]).measured)
    recording = load_curves(setup.panels[same_way]).measured
    left = recording - curve_of(setup, tables, same_way)
    solver = finer(setup, sims[shown.board], PREDICTED)

    def other(values: Mapping[str, float]) -> Array:
        return curve_of(changed(setup, values), tables, PREDICTED)

    def starts(random: np.random.Generator) -> Array:
        moved = random.uniform(-0.5, 0.5) / setup.sample_rate
        return other({"rest": setup.rest + moved}) - curve

    drawn = iter(result.drawn(RECORDINGS))
    found = expected(
        curve,
        {
            f"noise of {noise:.4f}, that of {same_board}": lambda random: random.normal(
                scale=noise, size=len(curve)
            ),
            f"what the fit leaves of {same_way} beyond noise": lasting(
                left, sample_noise(recording)
            ),
            "start of the recording, known to a sample": starts,
            "uncertainty of the fitted figures": lambda _: (
                curve_of(next(drawn), tables, PREDICTED) - curve
            ),
            "solver: preset fine": lambda _: solver,
        },
        draws=RECORDINGS,
    )
    total = found.total
    print(
        f"\n{PREDICTED} and {RECORDINGS} drawn recordings: zero-mean correlation "
        f"{total.median:.4f}, 90 % within {total.low:.4f} to {total.high:.4f}; median "
        "with a source alone; with it removed"
    )
    for name, alone in found.alone.items():
        print(f"  {name}: {alone.median:.5f}; {found.removed[name].median:.4f}")
    for pair in combinations(grids[shown.board].names, 2):
        if pair != setup.boards[shown.board].pair:
            tried = {**tables, shown.board: grids[shown.board].table(pair)}
            moved = curve_of(fit(setup, tried, starts=(1.0,)).setup, tried, PREDICTED)
            print(f"  were the pair {'-'.join(pair)}: {cross_correlation(moved, curve):.4f} alone")
    length, width, height = setup.size
    wider = replace(setup, size=(1.04 * length, width, height))
    tried = tables_of(setup, {name: tabulate(sim, wider) for name, sim in sims.items()})
    moved = curve_of(fit(setup, tried, starts=(1.0,)).setup, tried, PREDICTED)
    print(f"  were the bar 4 % longer along x: {cross_correlation(moved, curve):.4f} alone")
    print(f"\nchanges that alone lower it to {AIM}")
    for key in (f"{PREDICTED}.pace", *setup.uncertainty):
        value = setup.value(key)

        def scaled(part: float, key: str = key, value: float = value) -> Array:
            return other({key: value * (1 + part)})

        size = tolerance(scaled, AIM, largest=0.5)
        text = f"{100 * size:.2g} %, {size * value:.2g}" if size else "none up to 50 %"
        print(f"  {key}: {text}")
    print_eased(result, tables)
    print_ceilings(setup, tables, same_way, recording)


def print_eased(result: Fit, tables: dict[str, ResponseTable]) -> None:
    """The fit and the panels held out if the robot stops at corners, its acceleration limited."""
    setup = result.setup
    own = {"settle": 0.04, "uncertainty": {**setup.uncertainty, "settle": 0.01}}
    begin = Eased(**{**vars(setup), **own})
    found = fit(begin, tables, starts=(1.0,))
    moved = curve_of(found.setup, tables, PREDICTED)
    print(
        f"\nlimited acceleration: full speed after {found.setup.value('settle'):.3f} s, cost "
        f"{found.cost:.6f} instead of {result.cost:.6f}; correlation of the predicted panel with "
        f"the one without {cross_correlation(moved, curve_of(setup, tables, PREDICTED)):.4f}"
    )
    for title, one in (("constant speed", setup), ("limited acceleration", found.setup)):
        for name, held in held_out(one, tables).items():
            correlation, error = likeness(held, tables, name)
            print(f"  {name} held out, {title}: {correlation:.4f}, rms error {error:.4f}")


def load_recording(path: Path, samples: int) -> Array:
    """A recording in the format of the packaged panels, at samples 1 to n.

    Raises:
        SystemExit: The file cannot be read, or is not such a recording.
    """
    wanted = "give columns sample and norm_capacitance, and series if there are several"
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        points = [
            (float(row["sample"]), float(row["norm_capacitance"]))
            for row in csv.DictReader(line for line in lines if not line.startswith("#"))
            if row.get("series", "measured") == "measured"
        ]
    except OSError as error:
        raise SystemExit(f"{path} cannot be read: {error.strerror}") from None
    except KeyError as missing:
        raise SystemExit(f"{path} has no column {missing}; {wanted}") from None
    except (TypeError, ValueError) as error:
        raise SystemExit(f"{path} has a row that is no numbers: {error}; {wanted}") from None
    sample, value = np.array(points).reshape(-1, 2).T
    if not (len(sample) and sample[0] < 2 and sample[-1] > samples - 1):
        raise SystemExit(f"{path} does not measure samples 1 to {samples} of the panel; {wanted}")
    if not (np.all(np.isfinite(points)) and np.all(np.diff(sample) > 0)):
        raise SystemExit(f"samples of {path} are not finite and in order; sort them, drop the rest")
    return np.interp(np.arange(1, samples + 1), sample, value)


def print_ceilings(
    setup: Scenario1Setup, tables: dict[str, ResponseTable], name: str, measured: Array
) -> None:
    """What becomes of a zig-zag's correlation once figures are fitted to its recording."""
    panel = setup.panels[name]
    groups = {
        "time: start and pace": {
            "rest": (setup.rest, 0.02),
            f"{name}.pace": (panel.pace, 0.001),
        },
        "place: distance and tilt": {"gap": (setup.gap, 0.001), "tilt": (setup.tilt, 0.2)},
        "gain: level and stray capacitance": {
            f"{name}.level": (setup.level_of(panel), 0.002),
            "stray": (setup.stray, 1e-15),
        },
        "way: dimensions of the zig-zag": {
            key: (setup.value(key), 0.001) for key in setup.uncertainty if "zigzag" in key
        },
        "drift: linear and square": {"slope": (0.0, 0.001), "bow": (0.0, 0.001)},
    }
    time = np.linspace(-1, 1, panel.samples)

    def curve(values: Mapping[str, float]) -> Array:
        rest = {key: value for key, value in values.items() if key not in ("slope", "bow")}
        drift = values.get("slope", 0.0) * time + values.get("bow", 0.0) * time**2
        return curve_of(changed(setup, rest), tables, name) + drift

    print(
        f"\n{name} against its recording, and with figures fitted to it, which shows the most that "
        f"they could explain; a curve without error would have {noise_ceiling(measured):.4f}"
    )
    for group, found in ceilings(curve, measured, groups).items():
        values = ", ".join(f"{key} {value:.4g}" for key, value in found.values.items())
        print(f"  {group}: {found.correlation:.4f}, rms error {found.error:.4f}  {values}")


def main() -> None:
    """Tabulate, fit, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--prediction", action="store_true", help="how well the panel is known")
    parser.add_argument("--held-out", action="store_true", help="foretell each panel by the others")
    parser.add_argument("--pairs", action="store_true", help="try every choice of pairs")
    parser.add_argument("--pours", action="store_true", help="try all pairs with floating pours")
    parser.add_argument(
        "--explain", action="store_true", help="what limits the predicted panel's correlation"
    )
    parser.add_argument(
        "--recording", type=Path, metavar="CSV", help="of the predicted panel, to be explained"
    )
    args = parser.parse_args()
    setup = load_setup()
    kept = args.recording and load_recording(args.recording, setup.panels[PREDICTED].samples)
    sims = simulators(setup)
    grids = {name: tabulate(sim, setup) for name, sim in sims.items()}
    tables = tables_of(setup, grids)
    result = print_fit(setup, sims, tables)
    if args.prediction:
        print_prediction(result, tables)
    if args.held_out:
        print_held_out(result.setup, tables)
    if args.explain:
        print_explained(result, sims, grids)
    if kept is not None:
        print_ceilings(result.setup, tables, PREDICTED, kept)
    if args.pairs:
        print_pairs(result.setup, grids)
    if args.pours:
        other = replace(result.setup, pour="floating")
        print("\nfloating pours")
        print_pairs(other, {n: tabulate(sim, other) for n, sim in simulators(other).items()}, 3)


if __name__ == "__main__":
    main()
