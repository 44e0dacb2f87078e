"""``capsense export``: a recording as a table, as arrays, or made whole."""

from __future__ import annotations

import argparse
from pathlib import Path

NAME = "export"
HELP = "turn a recording into .csv, .npz or .parquet, or make one whole that was cut short"
DESCRIPTION = """\
Turn a recording into another file. The ending chooses the format:
  .csv, .parquet   the columns of readings.csv of capsense run, and the episode
  .npz             the arrays of readings.npz, the episode, and the counts of a readout;
                   capsense readout takes it
  .mcap            the recording again; one whose recorder was killed gets its index
  .json            a layout in which Foxglove shows the recording
"""
EXAMPLES = """\
  capsense export hand.mcap -o hand.parquet
  capsense export hand.mcap -o counts.csv --counts
  capsense export killed.mcap -o whole.mcap
  capsense export hand.mcap -o layout.json
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("recording", metavar="FILE.mcap", type=Path, help="the recording")
    parser.add_argument(
        "-o", "--output", metavar="FILE", type=Path, required=True, help="what to write"
    )
    parser.add_argument(
        "--counts", action="store_true",
        help="the conversions of the readout in place of the readings (.csv, .parquet)",
    )  # fmt: skip
    parser.add_argument("--force", action="store_true", help="replace a file that is there")


def execute(args: argparse.Namespace) -> int:
    """Export the recording and return the exit code."""
    from capsense.cli.main import OK, say
    from capsense.recording.disk import check_target
    from capsense.recording.export import export
    from capsense.recording.reader import open_recording

    recording = open_recording(args.recording)
    check_target(args.output, overwrite=args.force)
    if not recording.complete:
        say(f"warning: {args.recording} was not closed; what was written until then is exported")
    count = export(recording, args.output, counts=args.counts)
    what = {".mcap": "messages", ".json": "layout"}.get(args.output.suffix.lower(), "rows")
    print(f"{count} {what} in {args.output}")
    return OK
