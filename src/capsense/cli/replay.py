"""``capsense replay``: simulate a recording again, and compare."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from capsense.cli.run import progress_shown

if TYPE_CHECKING:
    from capsense.recording.replay import Replay

NAME = "replay"
HELP = "simulate a recording again and verify that every reading is the same"
DESCRIPTION = """\
Simulate a recording again, from the design, settings and bodies in it, and compare every reading
bit for bit; and the counts of a readout given by a chip's name or a file. The first difference
is printed.

Exit code 0: all the same. 3: something differs. 2: the file is no recording, or damaged.

Another processor, or another version of numba or NumPy, may change the last digits;
--tolerance allows for that. A recording that was cut short is compared as far as it goes.
"""
EXAMPLES = """\
  capsense replay hand.mcap
  capsense replay hand.mcap --tolerance 1e-19    differences up to 0.1 aF are allowed
  capsense replay old.mcap --method surface      recorded by a version with other methods
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("recording", metavar="FILE.mcap", type=Path, help="the recording")
    parser.add_argument(
        "--tolerance", metavar="F", type=float, default=0.0,
        help="difference of a capacitance that is allowed, in farads; default 0",
    )  # fmt: skip
    parser.add_argument(
        "--method",
        choices=("surface", "fem_masked"),
        help="simulate with this method instead of the recorded one",
    )
    parser.add_argument(
        "-q", "--quiet", action="store_true", help="no progress bar, no summary; errors only"
    )


def execute(args: argparse.Namespace) -> int:
    """Replay the recording and return the exit code."""
    from tqdm import tqdm

    from capsense.cli.main import DIFFERS, OK, say
    from capsense.cli.progress import BuildProgress
    from capsense.recording.reader import open_recording
    from capsense.recording.replay import replay

    recording = open_recording(args.recording)
    if not recording.complete:
        say(f"warning: {args.recording} was not closed; what was written until then is compared")
    shown = progress_shown(args.quiet)
    with (
        tqdm(unit=" steps", file=sys.stderr, disable=not shown) as bar,
        BuildProgress(shown=shown) as progress,
    ):
        found = replay(
            recording,
            method=args.method,
            tolerance=args.tolerance,
            progress=progress,
            each=lambda _: bar.update(),
        )
    if not args.quiet:
        print(_report(found))
    if found.same:
        return OK
    say(f"the readings differ; first, {found.first}")
    for key, (then, now) in found.changed.items():
        say(f"recorded with {key} {then}, replayed with {now}")
    return DIFFERS


def _report(found: Replay) -> str:
    from capsense.cli.tables import facts, grouped

    lines = [("steps", grouped(found.steps))]
    if found.counts is not None:
        lines.append(("conversions", grouped(found.counts)))
    verdict = "same to the last bit"
    if found.largest > 0 or not found.same:
        verdict = f"{found.differing} steps differ; " if not found.same else ""
        verdict += f"capacitances by at most {found.largest:.3g} F"
    lines.append(("readings", verdict))
    return facts(lines)
