"""``capsense dataset``, ``sweep``, ``optimise``, ``reproduce`` and others: many steps at once."""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections import ChainMap
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from capsense.cli import (
    EVERY,
    OK,
    QUIET,
    TARGET_MISSED,
    BuildProgress,
    arg,
    check_picture,
    check_target,
    command,
    count_of,
    facts,
    grouped,
    progress_shown,
    say,
    seconds,
    table,
)
from capsense.errors import ScenarioError
from capsense.reproduce import STUDIES, load_study

if TYPE_CHECKING:
    from capsense.learning.optimise import Bound, DesignTask
    from capsense.reproduce.harness import Study
    from capsense.studies import Capacitances, Evaluation, StudyRow
    from capsense.studies.tolerances import Tolerances


def _part(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d+)/(\d+)", text)
    if found is None or not int(found[1]) < int(found[2]):
        raise argparse.ArgumentTypeError(f"{text}; give K/N with K from 0 to N - 1, like 17/1000")
    return int(found[1]), int(found[2])


@command(
    "dataset",
    "make a data set of random scenes or episodes for learning",
    arg("spec SPEC.toml", "what the data set holds", type=Path),
    arg("-o --output DIR", "folder of the data set", type=Path, required=True),
    arg(
        "--shard K/N",
        "make every N-th shard only, from shard K on; K from 0 to N - 1",
        type=_part,
        default=(0, 1),
    ),
    [
        arg("--workers N", "processes; default all processors", type=count_of),
        arg(
            "--scheduler ADDRESS",
            "Dask scheduler whose workers make the shards; they see DIR and what SPEC names",
        ),
    ],
    QUIET,
)
def dataset(args: argparse.Namespace) -> int:
    """Draw random scenes as a file describes them, and write capacitance matrices, the counts of a
    readout and labels as Parquet files with a manifest. A file that names an environment is of
    episodes, which become a LeRobot data set.

    A scene depends on the file, its seed and the scene's number alone, and so does an episode, so
    that any shard can be made on any machine. A shard appears once it is complete, and what is
    complete is not made again: after an interruption, run the same command.

    examples:
      capsense dataset examples/datasets/forearms.toml -o forearms/
      capsense dataset examples/datasets/follow.toml -o follow/
      capsense dataset spec.toml -o /shared/set --shard 17/1000
      capsense dataset spec.toml -o /shared/set --scheduler tcp://10.0.0.1:8786
    """
    from tqdm import tqdm

    from capsense.learning.data_sets import load_data_set
    from capsense.learning.shards import missing, require_pyarrow, run

    require_pyarrow()
    spec = load_data_set(args.spec)
    todo = sum(len(spec.numbers(k)) for k in missing(spec, args.output, args.shard))
    start = perf_counter()
    with tqdm(
        total=todo, unit=f" {spec.unit}", file=sys.stderr, disable=not progress_shown(args.quiet)
    ) as bar:
        made = run(
            spec, args.output, part=args.shard, workers=args.workers, scheduler=args.scheduler,
            each=bar.update,
        )  # fmt: skip
    if not args.quiet:
        seconds = perf_counter() - start
        left = sum(len(spec.numbers(k)) for k in missing(spec, args.output))
        state = "complete" if not left else f"{left} of {spec.count} {spec.unit} are missing"
        rate = f"{made / seconds:.1f}" if made < 10 * seconds else f"{made / seconds:.0f}"
        print(f"{made} {spec.unit} in {seconds:.1f} s, {rate} a second; {args.output}: {state}")
    return OK


def _new_file(text: str) -> Path:
    path = Path(text)
    if not path.parent.is_dir():
        raise argparse.ArgumentTypeError(f"{text}: there is no folder {path.parent}; make it first")
    if path.is_dir():
        raise argparse.ArgumentTypeError(f"{text} is a folder; name a file")
    return path


@command(
    "bench",
    "measure this machine: start, step times, error",
    arg("-o --output FILE", "also write JSON", type=_new_file),
    arg("--steps N", "timed steps of each world", type=count_of, default=300),
)
def bench(args: argparse.Namespace) -> int:
    """Measure import, start, step times and batches on this machine, with the error of a step
    against a converged reference; within a minute.

    Times are by the clock, and other programs that run meanwhile lengthen them: their load is
    stated, and "processor" is what the processor's time alone gives.

    examples:
      capsense bench
      capsense bench -o bench.json
    """
    from capsense.bench import measure

    figures = measure(args.steps)
    print(_bench_report(figures))
    if args.output is not None:
        args.output.write_text(json.dumps(figures, indent=1) + "\n")
    return OK


def _bench_report(figures: dict[str, Any]) -> str:
    """The figures as text."""

    head = [
        ("machine", f"{figures['machine']}, {figures['cpus']} cores, load {figures['load']:.2f}"),
        ("versions", ", ".join(f"{k} {v}" for k, v in figures["versions"].items())),
        ("design", f"{figures['design']}, preset {figures['preset']}"),
        ("import", seconds(figures["import_s"])),
        ("start", seconds(figures["simulator_s"])),
        (
            "first step",
            f"{seconds(figures['first_step_s'])} (processor, import to here: "
            f"{seconds(figures['processor_s'])})",
        ),
    ]
    times = ("clock_median_ms", "clock_p95_ms", "clock_p99_ms", "median_ms")
    rows = [
        (
            name,
            *(f"{row[key]:.2f}" for key in times),
            f"{row['unknowns']:g}",
            f"{100 * row['error']:.2f}",
        )
        for name, row in figures["worlds"].items()
    ]
    columns = ("world", "median [ms]", "p95 [ms]", "p99 [ms]", "processor [ms]", "unknowns",
               "error [%]")  # fmt: skip
    row = figures["batch"]
    batch = (
        f"batch of {row['scenes']} scenes, {row['threads']} threads: "
        f"{row['clock_per_s']:.0f} scenes a second (processor: {row['per_s']:.0f})"
    )
    return "\n\n".join([facts(head), table(columns, rows), batch])


@command(
    "reproduce",
    "re-run the evaluation of Schöffmann et al. 2022",
    arg("study", "what to re-run", choices=ChainMap({"all": ""}, STUDIES)),
    arg(
        "-o --output DIR",
        "folder for the results (default: reproduced); what it holds already is used",
        type=Path,
        default=Path("reproduced"),
    ),
    arg("--reduced", "fewer cases, less resolution"),
)
def reproduce(args: argparse.Namespace) -> int:
    """Re-run the evaluation of Schöffmann et al. 2022, and what goes beyond it: each study prints a
    table of figures with their targets and verdicts.

    DIR/STUDY receives
      report.md   the figures, with plots and short tables
      rows.json   the figures as data
      *.csv       tables and curves
      *.png       plots
      parts/      what was computed, unit by unit: a run that was interrupted continues there

    Exits with 3 if it ran and a figure missed its target.

    examples:
      capsense reproduce scenario1
      capsense reproduce all -o reproduced/
      capsense reproduce all --reduced         a check in little time; coarser
    """
    names = list(STUDIES) if args.study == "all" else [args.study]
    studies = {name: load_study(name) for name in names}
    folders = {name: _prepared(args.output / name) for name in names}
    missed = 0
    for name, study in studies.items():
        try:
            missed += _carry_out(name, study, folders[name], reduced=args.reduced)
        except KeyboardInterrupt:
            say(f"{name}: what was computed is kept in {folders[name]}; run it again to go on")
            raise
    if missed:
        say(f"{missed} of the figures missed their target")
    return TARGET_MISSED if missed else OK


def _prepared(folder: Path) -> Path:
    """Make an output folder.

    Raises:
        ScenarioError: It cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ScenarioError(
            f"output folder {folder} cannot be made: {error.strerror}; give another one"
        ) from None
    return folder


def _carry_out(name: str, study: Study, folder: Path, *, reduced: bool) -> int:
    """Run a study, write and print what it found; return how many rows missed their target."""
    from capsense.reproduce.harness import ROW_HEADER, row_cells, write_outcome

    with BuildProgress(prefix=f"{name}: ") as progress:
        outcome = study(folder, reduced=reduced, report=progress)
    written = write_outcome(outcome, folder, reduced=reduced)
    title = outcome.title + (", reduced" if reduced else "")
    print(f"{title}\n\n{table(ROW_HEADER, [row_cells(row) for row in outcome.rows])}\n")
    print(f"wrote {_listed(written)} to {folder}", outcome.parts, sep="\n", end="\n\n", flush=True)
    return len(outcome.missed)


def _listed(names: list[str]) -> str:
    """File names; of many, the first ones and how many more there are."""
    shown = 6
    if len(names) <= shown:
        return ", ".join(names)
    return f"{', '.join(names[:shown])} and {len(names) - shown} more files"


_TABLES = (".csv", ".parquet")
_JOBS = arg(
    "--jobs N", "processes (default: all processors, fewer where memory is short)", type=count_of
)


@command(
    "sweep",
    "capacitances and counts over a grid of any numbers of a sensor",
    arg("design DESIGN", "a design's file, or the name of a packaged one"),
    arg(
        "--vary NAME=VALUES",
        "a parameter or a key, electrode.E1.size.x: FROM:TO:COUNT or A,B,C; once for each one",
        action="append",
        required=True,
    ),
    arg(
        "-o --output TABLE",
        ".csv or .parquet; rows are kept as they finish",
        type=Path,
        required=True,
    ),
    arg("--scenario FILE.toml", "bodies, as they stand at time 0", type=Path),
    arg("--readout CHIP", "counts of a chip, by its name or a readout file; without noise"),
    arg(
        "--derivatives NAME[=STEP]",
        "also derivatives by this parameter, with errors; once for each one",
        action="append",
        default=[],
    ),
    arg("--plot FILE", "plot over one or two parameters: .png, .svg or .pdf", type=Path),
    arg("--outputs NAMES", "what to plot, such as C0_E1_E1,C0_E1_E2 or dC", default=""),
    _JOBS,
    QUIET,
)
def sweep(args: argparse.Namespace) -> int:
    """Compute the capacitances of the empty domain for all combinations of values, with a scenario
    what its bodies change, and with a chip the counts. NAME is a dotted key of the design, the
    scenario or the readout, such as body.finger.pose.position.z, or a parameter that a text such as
    "=side / 2" in any of the files uses. VALUES have units (mm, cm, m, in, pF, fF) or are in SI
    units; a key may also be given texts, such as materials. What it will cost is said first. A
    point of which nothing can be made has an error in the table.

    After an interruption, run the same command: what TABLE holds is not computed again, and the
    table is the same in the end. More values may be added in the same way.

    examples:
      capsense sweep six_patch --vary electrode.E1.size.x=20mm:30mm:5 -o patch.csv
      capsense sweep pad.toml --vary side=10mm,20mm --vary gap=1mm:3mm:3 -o pad.csv --plot pad.png
      capsense sweep pad.toml --vary side=0.01 -o pad.csv --derivatives side
      capsense sweep patch --scenario a.toml --readout fdc1004 --vary wiring.trace=0,5pF -o t.csv
    """
    from capsense.studies import Capacitances
    from capsense.studies.plots import check_plot, plot_sweep
    from capsense.studies.sweeps import grid, parse_steps, parse_vary, with_derivatives

    _check_files(args)
    vary: dict[str, list[Any]] = {}
    for text in args.vary:
        name, values = parse_vary(text)
        if name in vary:
            raise ScenarioError(f"--vary {text}: {name} is given twice; list its values in one")
        vary[name] = values
    try:
        points = grid(vary)
    except ValueError as error:
        raise ScenarioError(f"--vary: {error}") from None
    capacitances = Capacitances.load(args.design, points, args.scenario, args.readout)
    steps = parse_steps(args.derivatives)
    evaluation = with_derivatives(capacitances, steps, points)
    chosen = [name for name in args.outputs.split(",") if name]
    if args.plot is not None:
        check_plot(points, evaluation.outputs, chosen)
    elif chosen:
        raise ScenarioError("--outputs chooses what --plot shows; give --plot FILE as well")
    more = 6 * len(steps.keys() & capacitances.design.parameters)
    rows = _fill(args, points, evaluation, capacitances, more)
    if args.plot is not None:
        plot_sweep(rows, evaluation.outputs, chosen).savefig(args.plot, dpi=150)
    if not args.quiet:
        print(f"{len(rows)} rows in {args.output}{_without_results(rows)}")
    return OK


def _check_files(args: argparse.Namespace) -> None:
    """Refuse tables and plots that could not be written."""
    check_target("--output", args.output, _TABLES, ScenarioError)
    if args.plot is not None:
        check_picture("--plot", args.plot, ScenarioError)


@command(
    "tolerance",
    "how capacitances and counts scatter with parameters, and the yield",
    arg("study STUDY.toml", "a sensor, what scatters, and specifications", type=Path),
    arg(
        "-o --output TABLE",
        ".csv or .parquet; samples are kept as they finish",
        type=Path,
        required=True,
    ),
    arg("--plot FILE", "tornado plot: .png, .svg or .pdf", type=Path),
    _JOBS,
    QUIET,
)
def tolerance(args: argparse.Namespace) -> int:
    """Draw quasi-random samples of the parameters of a design, of bodies and of a chip, compute
    capacitances and counts, and print for each output its mean and standard deviation, the
    parameters in the order of their effects with their first-order contributions to the variance,
    and the yield with its 95 % interval.

    After an interruption, run the same command: what TABLE holds is not computed again.

    examples:
      capsense tolerance study.toml -o samples.csv
      capsense tolerance study.toml -o samples.parquet --plot tornado.png --jobs 2
    """
    from capsense.studies.tolerances import analyse, load_study, narrowed, tornado

    _check_files(args)
    study, evaluation = load_study(args.study)
    rows = _fill(args, study.points, evaluation, evaluation)
    found = analyse(rows, evaluation.outputs, study.specifications)
    if args.plot is not None:
        shown = list(study.specifications) or evaluation.outputs
        tornado(found, shown).savefig(args.plot, dpi=150)
    if not args.quiet:
        print(_tolerance_report(found))
        if found.yields:
            held = {
                name: narrowed(found, study.specifications, {name: 0.0})["all"]
                for name in study.parameters
            }
            lines = [
                (name, f"{100 * y.share:.1f}", f"{100 * y.low:.1f} to {100 * y.high:.1f}")
                for name, y in sorted(held.items(), key=lambda item: -item[1].share)
            ]
            print(f"\n{table(('without the scatter of', 'yield [%]', '95 % interval'), lines)}")
        print(f"\n{len(rows)} samples in {args.output}{_without_results(rows)}")
    return OK


def _tolerance_report(found: Tolerances) -> str:
    """Scatter, ranking and yield as text; warns where the linear fit is poor."""
    from capsense.studies.capacitances import unit_of_output
    from capsense.studies.tolerances import POOR_FIT

    lines = []
    for name, output in found.outputs.items():
        factor, unit = unit_of_output(name)
        for number, (parameter, effect) in enumerate(output.effects.items()):
            own = (name, f"{factor * output.mean:.4g}", f"{factor * output.deviation:.3g}", unit)
            share = 100 * output.contributions[parameter]
            lines.append([
                *(own if number == 0 else ("",) * 4), parameter, f"{factor * effect:+.3g}",
                f"{share:.1f}",
            ])  # fmt: skip
        if output.explained < POOR_FIT:
            say(f"warning: {name}: a linear fit explains {100 * output.explained:.0f} % of the "
                "variance only, so that contributions are incomplete; see the samples")  # fmt: skip
    header = ("output", "mean", "deviation", "unit", "parameter", "effect", "share [%]")
    parts = [table(header, lines)]
    if found.yields:
        rows = [
            (name, f"{100 * y.share:.1f}", f"{100 * y.low:.1f} to {100 * y.high:.1f}",
             f"{y.passed} of {y.samples}")
            for name, y in found.yields.items()
        ]  # fmt: skip
        parts.append(table(("specification", "yield [%]", "95 % interval", "passed"), rows))
    return "\n\n".join(parts)


def _without_results(rows: list[StudyRow]) -> str:
    """How many rows have an error."""
    wrong = sum(bool(row.error) for row in rows)
    return f"; {wrong} without results, see column error" if wrong else ""


def _fill(
    args: argparse.Namespace, points: list[Any], evaluation: Evaluation, made: Capacitances,
    more: int = 0,
) -> list[StudyRow]:  # fmt: skip
    """Evaluate points into the table ``args.output``: the cost first, then progress.

    Args:
        args: Of the command.
        points: Values of the parameters.
        evaluation: What is computed.
        made: What it is computed with, for its cost.
        more: Further designs of each point, for derivatives.
    """
    from capsense.studies.points import fill_table, jobs_within, journal_of, missing

    todo = missing(points, evaluation, args.output)
    jobs = args.jobs or 1
    if todo:
        cost = made.cost(todo)
        jobs = args.jobs or jobs_within(cost.memory)
        done = len(points) - len(todo)
        kept = f", {done} more are kept or cannot be made" if done else ""
        if not args.quiet:
            time = _duration(cost.time * (1 + more))
            field = f": about {time} of a processor's time" if cost.time else ", its field is there"
            say(f"{len(todo)} points{kept}; {cost.designs} designs of about "
                f"{grouped(cost.panels)} panels{field}")  # fmt: skip
    try:
        with Progress(len(todo), "points", quiet=args.quiet) as progress:
            return fill_table(points, evaluation, args.output, jobs=jobs, each=progress)
    except KeyboardInterrupt:
        say(f"what was computed is kept in {journal_of(args.output)}; run it again to go on")
        raise


def _duration(value: float) -> str:
    return f"{value:.0f} s" if value < 100 else (
        f"{value / 60:.0f} min" if value < 6000 else f"{value / 3600:.1f} h"
    )  # fmt: skip


class Progress:
    """Counts what is done: a bar on a terminal, else a line every :data:`EVERY` seconds."""

    def __init__(self, total: int, unit: str, *, quiet: bool) -> None:
        from tqdm import tqdm

        self._total, self._unit, self._quiet = total, unit, quiet
        self._count, self._told = 0, perf_counter()
        self._bar = tqdm(
            total=total, unit=f" {unit}", file=sys.stderr, disable=not progress_shown(quiet)
        )

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def __call__(self, count: int) -> None:
        """So many more are done."""
        self._count += count
        self._bar.update(count)
        if self._quiet or not self._bar.disable or perf_counter() - self._told < EVERY:
            return
        self._told = perf_counter()
        say(f"{self._count} of {self._total} {self._unit}")


@command(
    "optimise",
    "choose sizes and gaps of electrodes for a task",
    arg("task TASK.toml", "what is to be found", type=Path),
    arg("-o --output DESIGN.toml", "the design that was found", type=Path, required=True),
    arg("--evaluations N", "candidates to try, instead of the task's", type=int),
    arg("--no-check", "leave out the check at full accuracy"),
    QUIET,
)
def optimise(args: argparse.Namespace) -> int:
    """Choose sizes and gaps of electrodes so that they tell the pose of a limb best. TASK.toml
    holds a design whose lengths are expressions of parameters, the parameters' ranges, where
    the limb will be, and the noise of a channel. A candidate is judged by the Cramér-Rao bound
    of lateral and vertical position, pitch and yaw: the least errors that this sensor and this
    noise allow. Each candidate takes some seconds, for its field is built anew, coarsely; what
    is found is checked at full accuracy, beside the start, and written as a design file.

    examples:
      capsense optimise examples/designs/forearm_pads.toml -o pads.toml
      capsense optimise task.toml -o pads.toml --evaluations 200
      capsense optimise task.toml -o pads.toml --evaluations 20 --no-check
    """
    from dataclasses import replace

    from capsense.learning.optimise import at_bounds, load_task, search, to_toml

    check_target("--output", args.output, ".toml", ScenarioError)
    task = load_task(args.task)
    if args.evaluations is not None:
        if args.evaluations < 1:
            raise ScenarioError(f"--evaluations {args.evaluations}: give 1 or more")
        task = replace(task, evaluations=args.evaluations)
    count = 0

    def each(values: Any, bound: Bound) -> None:
        nonlocal count
        count += 1
        if not args.quiet:
            print(f"{count:4d}  {_parameters(task, values)}  cost {bound.cost:.4f}",
                  file=sys.stderr, flush=True)  # fmt: skip

    values, coarse = search(task, each)
    found = task.content(values)
    head = f"# {task.name}: found by `capsense optimise {args.task.name}`, {count} candidates.\n"
    args.output.write_text(head + to_toml(found) + "\n", encoding="utf-8")
    for name, (side, limit) in at_bounds(task, values).items():
        say(f"warning: {name} ended at its {side} bound, {limit:g}; a better value may lie beyond: "
            f"widen its range in {args.task}")  # fmt: skip
    if not args.quiet:
        rows = {"found": (values, coarse)}
        if not args.no_check:
            rows = {
                "start": (task.start, task.bound(task.start, 1.0, "fine")),
                "found": (values, task.bound(values, 1.0, "fine")),
            }
        _print(task, rows, "the search" if args.no_check else "full accuracy")
        print(f"\nthe search had {coarse.cost:.4f}; written to {args.output}")
    return OK


def _parameters(task: DesignTask, values: Any) -> str:
    return "  ".join(
        f"{name} {1e3 * value:.2f}" for name, value in zip(task.parameters, values, strict=True)
    )


def _print(task: DesignTask, rows: dict[str, tuple[Any, Bound]], accuracy: str) -> None:
    """What was found beside the start."""
    import numpy as np

    lines = []
    for name, (values, bound) in rows.items():
        lateral, vertical, pitch, yaw = bound.pose
        numbers = (1e3 * lateral, 1e3 * vertical, np.degrees(pitch), np.degrees(yaw))
        told = [*(f"{1e3 * v:.2f}" for v in values), *(f"{v:.2f}" for v in numbers)]
        lines.append([name, *told, f"{bound.cost:.4f}"])
    header = [
        f"least errors, {accuracy}", *(f"{n} [mm]" for n in task.parameters), "lateral [mm]",
        "vertical [mm]", "pitch [°]", "yaw [°]", "cost",
    ]  # fmt: skip
    print(table(header, lines))
