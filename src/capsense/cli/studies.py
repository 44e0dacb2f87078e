"""``capsense dataset``, ``bench`` and ``reproduce``: many steps at once, and what came of them."""

from __future__ import annotations

import argparse
import json
import re
import sys
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from capsense.cli.console import (
    OK,
    TARGET_MISSED,
    BuildProgress,
    Command,
    add_quiet,
    count_of,
    facts,
    progress_shown,
    say,
    seconds,
    table,
)
from capsense.errors import ScenarioError

if TYPE_CHECKING:
    from capsense.reproduce.harness import Study


def _dataset_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("spec", metavar="SPEC.toml", type=Path, help="what the data set holds")
    parser.add_argument(
        "-o", "--output", metavar="DIR", type=Path, required=True, help="folder of the data set"
    )
    parser.add_argument(
        "--shard", metavar="K/N", type=_part, default=(0, 1),
        help="make every N-th shard only, from shard K on; K from 0 to N - 1",
    )  # fmt: skip
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--workers", metavar="N", type=count_of, help="processes; default all processors"
    )
    where.add_argument(
        "--scheduler", metavar="ADDRESS",
        help="Dask scheduler whose workers make the shards; they see DIR and what SPEC names",
    )  # fmt: skip
    add_quiet(parser)


def _part(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d+)/(\d+)", text)
    if found is None or not int(found[1]) < int(found[2]):
        raise argparse.ArgumentTypeError(f"{text}; give K/N with K from 0 to N - 1, like 17/1000")
    return int(found[1]), int(found[2])


def _dataset(args: argparse.Namespace) -> int:
    """Make the data set and return the exit code."""
    from tqdm import tqdm

    from capsense.learning.shards import load_data_set, missing, require_pyarrow, run

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


DATASET = Command(
    "dataset",
    "make a data set of random scenes or episodes for learning",
    """\
Draw random scenes as a file describes them, and write capacitance matrices, the counts of a
readout and labels as Parquet files with a manifest. A file that names an environment is of
episodes, which become a LeRobot data set.

A scene depends on the file, its seed and the scene's number alone, and so does an episode, so that
any shard can be made on any machine. A shard appears once it is complete, and what is complete is
not made again: after an interruption, run the same command.
""",
    """\
  capsense dataset examples/datasets/forearms.toml -o forearms/
  capsense dataset examples/datasets/follow.toml -o follow/
  capsense dataset spec.toml -o /shared/set --shard 17/1000
  capsense dataset spec.toml -o /shared/set --scheduler tcp://10.0.0.1:8786
""",
    _dataset_arguments,
    _dataset,
)


def _bench_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("-o", "--output", metavar="FILE", type=_new_file, help="also write JSON")
    parser.add_argument(
        "--steps", metavar="N", type=count_of, default=300, help="timed steps of each world"
    )


def _new_file(text: str) -> Path:
    path = Path(text)
    if not path.parent.is_dir():
        raise argparse.ArgumentTypeError(f"{text}: there is no folder {path.parent}; make it first")
    if path.is_dir():
        raise argparse.ArgumentTypeError(f"{text} is a folder; name a file")
    return path


def _bench(args: argparse.Namespace) -> int:
    """Measure, print, write, and return the exit code."""
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


BENCH = Command(
    "bench",
    "measure this machine: start, step times, error",
    """\
Measure import, start, step times and batches on this machine, with the error of a step against
a converged reference; within a minute.

Times are by the clock, and other programs that run meanwhile lengthen them: their load is
stated, and "processor" is what the processor's time alone gives.
""",
    """\
  capsense bench
  capsense bench -o bench.json
""",
    _bench_arguments,
    _bench,
)


def _reproduce_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    from capsense.reproduce.harness import STUDIES

    parser.add_argument("study", choices=[*STUDIES, "all"], help="what to re-run")
    parser.add_argument(
        "-o", "--output", metavar="DIR", type=Path, default=Path("reproduced"),
        help="folder for the results (default: reproduced); what it holds already is used",
    )  # fmt: skip
    parser.add_argument("--reduced", action="store_true", help="fewer cases, less resolution")


def _reproduce(args: argparse.Namespace) -> int:
    """Run the studies, write each as it is done, and return the exit code."""
    from capsense.reproduce.harness import STUDIES, load_study

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

    with BuildProgress(shown=sys.stderr.isatty(), prefix=f"{name}: ") as progress:
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


REPRODUCE = Command(
    "reproduce",
    "re-run the evaluation of Schöffmann et al. 2022",
    """\
Re-run the evaluation of Schöffmann et al. 2022, and what goes beyond it: each study prints a
table of figures with their targets and verdicts.

DIR/STUDY receives
  report.md   the figures, with plots and short tables
  rows.json   the figures as data
  *.csv       tables and curves
  *.png       plots
  parts/      what was computed, unit by unit: a run that was interrupted continues there

Exits with 3 if it ran and a figure missed its target.
""",
    """\
  capsense reproduce scenario1
  capsense reproduce all -o reproduced/
  capsense reproduce all --reduced         a check in little time; coarser
""",
    _reproduce_arguments,
    _reproduce,
)
