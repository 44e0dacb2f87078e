"""``capsense bench``: how fast and how accurate CapSense is on this machine."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

NAME = "bench"
HELP = "measure this machine: start, step times, error"
DESCRIPTION = """\
Measure import, start, step times and batches on this machine, with the error of a step against
a converged reference; within a minute.

Times are by the clock, and other programs that run meanwhile lengthen them: their load is
stated, and "processor" is what the processor's time alone gives.
"""
EXAMPLES = """\
  capsense bench
  capsense bench -o bench.json
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("-o", "--output", metavar="FILE", type=_new_file, help="also write JSON")
    parser.add_argument(
        "--steps", metavar="N", type=_count, default=300, help="timed steps of each world"
    )


def _count(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text}; give 1 or more")
    return value


def _new_file(text: str) -> Path:
    path = Path(text)
    if not path.parent.is_dir():
        raise argparse.ArgumentTypeError(f"{text}: there is no folder {path.parent}; make it first")
    if path.is_dir():
        raise argparse.ArgumentTypeError(f"{text} is a folder; name a file")
    return path


def execute(args: argparse.Namespace) -> int:
    """Measure, print, write, and return the exit code."""
    from capsense.bench import measure
    from capsense.cli.main import OK

    figures = measure(args.steps)
    print(report(figures))
    if args.output is not None:
        args.output.write_text(json.dumps(figures, indent=1) + "\n")
    return OK


def report(figures: dict[str, Any]) -> str:
    """The figures as text."""
    from capsense.cli.tables import facts, seconds, table

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
