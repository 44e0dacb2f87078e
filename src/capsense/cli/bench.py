"""``capsense bench``: how fast and how accurate CapSense is on this machine."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from capsense.errors import SceneError

NAME = "bench"
HELP = "measure this machine: start, step times, error"
DESCRIPTION = """\
Measure import, start and step times on this machine, with the error of a step against a
converged reference. Other programs that run meanwhile slow it down; their load is stated.
"""
EXAMPLES = """\
  capsense bench
  capsense bench -o bench.json
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("-o", "--output", metavar="FILE", type=Path, help="also write JSON")
    parser.add_argument("--steps", type=int, default=300, help="timed steps of each world")


def execute(args: argparse.Namespace) -> int:
    """Measure, print, write, and return the exit code."""
    from capsense.cli.main import OK

    if args.steps < 1:
        raise SceneError(f"--steps {args.steps}: give 1 or more")
    if args.output is not None and not args.output.parent.is_dir():
        raise SceneError(f"--output {args.output}: there is no folder {args.output.parent}")
    from capsense.bench import measure

    figures = measure(args.steps)
    print(report(figures))
    if args.output is not None:
        args.output.write_text(json.dumps(figures, indent=1) + "\n")
    return OK


def report(figures: dict[str, Any]) -> str:
    """The figures as text."""
    from capsense.cli.tables import facts, grouped, table

    head = [
        ("machine", f"{figures['machine']}, {figures['cpus']} cores, load {figures['load']:.2f}"),
        ("versions", ", ".join(f"{k} {v}" for k, v in figures["versions"].items())),
        ("tetrahedra", grouped(figures["tetrahedra"])),
        ("import", f"{figures['import_s']:.2f} s"),
        ("start and first step", f"{figures['start_s']:.2f} s"),
    ]
    rows = [
        (
            name,
            *(f"{row[key]:.2f}" for key in ("median_ms", "p95_ms", "p99_ms")),
            f"{row['iterations']:g}",
            "" if row["error"] is None else f"{100 * row['error']:.2f}",
        )
        for name, row in figures["worlds"].items()
    ]
    columns = ("world", "median [ms]", "p95 [ms]", "p99 [ms]", "iterations", "error [%]")
    return f"{facts(head)}\n\n{table(columns, rows)}"
