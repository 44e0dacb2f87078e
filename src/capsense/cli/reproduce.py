"""``capsense reproduce``: the paper's evaluation, and more, from one command each."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from capsense.errors import ScenarioError

if TYPE_CHECKING:
    from capsense.reproduce.study import Study

NAME = "reproduce"
HELP = "re-run the evaluation of Schöffmann et al. 2022"
DESCRIPTION = """\
Re-run the evaluation of Schöffmann et al. 2022, and what goes beyond it: each study prints a
table of figures with their targets and verdicts.

DIR/STUDY receives
  report.md   the figures, with plots and short tables
  rows.json   the figures as data
  *.csv       tables and curves
  *.png       plots
  parts/      what was computed, unit by unit: a run that was interrupted continues there

Exits with 3 if it ran and a figure missed its target.
"""
EXAMPLES = """\
  capsense reproduce scenario1
  capsense reproduce all -o reproduced/
  capsense reproduce all --reduced         a check in little time; coarser
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    from capsense.reproduce.registry import STUDIES

    parser.add_argument("study", choices=[*STUDIES, "all"], help="what to re-run")
    parser.add_argument(
        "-o", "--output", metavar="DIR", type=Path, default=Path("reproduced"),
        help="folder for the results (default: reproduced); what it holds already is used",
    )  # fmt: skip
    parser.add_argument("--reduced", action="store_true", help="fewer cases, less resolution")


def execute(args: argparse.Namespace) -> int:
    """Run the studies, write each as it is done, and return the exit code."""
    from capsense.cli.main import OK, TARGET_MISSED, say
    from capsense.reproduce.registry import STUDIES, load_study

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
    from capsense.cli.progress import BuildProgress
    from capsense.cli.tables import table
    from capsense.reproduce.write import ROW_HEADER, row_cells, write_outcome

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
