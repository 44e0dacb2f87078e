"""``capsense dataset``: random scenes, their capacitances and labels, as Parquet files."""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path
from time import perf_counter

NAME = "dataset"
HELP = "make a data set of random scenes for learning"
DESCRIPTION = """\
Draw random scenes as a file describes them, and write capacitance matrices, the counts of a
readout and labels as Parquet files with a manifest.

A scene depends on the file, its seed and the scene's number alone, so that any shard can be made
on any machine. A shard appears once it is complete, and what is complete is not made again: after
an interruption, run the same command.
"""
EXAMPLES = """\
  capsense dataset examples/datasets/forearms.toml -o forearms/
  capsense dataset spec.toml -o /shared/set --shard 17/1000
  capsense dataset spec.toml -o /shared/set --scheduler tcp://10.0.0.1:8786
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
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
        "--workers", metavar="N", type=_workers, help="processes; default all processors"
    )
    where.add_argument(
        "--scheduler", metavar="ADDRESS",
        help="Dask scheduler whose workers make the shards; they see DIR and what SPEC names",
    )  # fmt: skip
    parser.add_argument(
        "-q", "--quiet", action="store_true", help="no progress bar, no summary; errors only"
    )


def _part(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d+)/(\d+)", text)
    if found is None or not int(found[1]) < int(found[2]):
        raise argparse.ArgumentTypeError(f"{text}; give K/N with K from 0 to N - 1, like 17/1000")
    return int(found[1]), int(found[2])


def _workers(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text}; give 1 or more")
    return value


def execute(args: argparse.Namespace) -> int:
    """Make the data set and return the exit code."""
    from tqdm import tqdm

    from capsense.cli.main import OK
    from capsense.cli.run import progress_shown
    from capsense.learning.shards import missing, require_pyarrow, run
    from capsense.learning.spec import load_spec

    require_pyarrow()
    spec = load_spec(args.spec)
    todo = sum(len(spec.numbers(k)) for k in missing(spec, args.output, args.shard))
    start = perf_counter()
    with tqdm(
        total=todo, unit=" scenes", file=sys.stderr, disable=not progress_shown(args.quiet)
    ) as bar:
        made = run(
            spec, args.output, part=args.shard, workers=args.workers, scheduler=args.scheduler,
            each=bar.update,
        )  # fmt: skip
    if not args.quiet:
        seconds = perf_counter() - start
        left = sum(len(spec.numbers(k)) for k in missing(spec, args.output))
        state = "complete" if not left else f"{left} of {spec.scenes} scenes are missing"
        print(f"{made} scenes in {seconds:.1f} s, {made / seconds:.0f} a second; {args.output}: "
              f"{state}")  # fmt: skip
    return OK
