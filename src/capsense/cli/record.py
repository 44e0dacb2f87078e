"""``capsense record``: a scenario file in, an MCAP recording out."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from capsense.cli.run import absent_bodies, build_simulator, play_samples, sample_rate
from capsense.errors import RecordingError

if TYPE_CHECKING:
    from capsense.recording.recorder import Recorder
    from capsense.scenario import Scenario

NAME = "record"
HELP = "simulate a scenario file and record every step as MCAP, for ROS 2 and Foxglove"
DESCRIPTION = """\
Simulate a scenario, and record every step in an MCAP file of ROS 2 messages: bodies and their
poses, capacitance matrices, transforms, markers, and the counts of a readout. Foxglove and
'ros2 bag' open it; 'capsense replay' simulates it again and compares; 'capsense export' makes
tables of it.

Every half second all that was computed is put into the file. Whatever ends the process, the
rest can be read.
"""
EXAMPLES = """\
  capsense record examples/hand_approach.toml -o hand.mcap
  capsense record examples/hand_approach.toml -o hand.mcap --readout fdc1004 --force
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("scenario", metavar="SCENARIO.toml", type=Path, help="the scenario file")
    parser.add_argument(
        "-o", "--output", metavar="FILE.mcap", type=Path, required=True, help="the recording"
    )
    parser.add_argument("--force", action="store_true", help="replace a file that is there")
    parser.add_argument(
        "--rate", metavar="HZ", type=sample_rate, help="sample rate, instead of the scenario's"
    )
    parser.add_argument(
        "--readout", metavar="CHIP|FILE.toml",
        help="record what a chip reports, too: its name, or a readout file",
    )  # fmt: skip
    parser.add_argument(
        "--name", default="sensor", help="of the sensor: its frame, and the beginning of its topics"
    )
    parser.add_argument(
        "-q", "--quiet", action="store_true", help="no progress bar, no summary; errors only"
    )


def execute(args: argparse.Namespace) -> int:
    """Record the scenario and return the exit code."""
    from capsense.cli.interrupt import Interrupt
    from capsense.cli.main import INTERRUPTED, OK, say
    from capsense.recording.disk import check_target
    from capsense.recording.messages import require
    from capsense.recording.recorder import Recorder, check_name, make_readout
    from capsense.scenario import load_scenario

    require()
    scenario = load_scenario(args.scenario)
    if args.rate is not None:
        scenario = scenario.resampled(args.rate)
    for name in absent_bodies(scenario):
        say(f'warning: body "{name}" never enters the domain; it has no effect')
    if args.output.suffix != ".mcap":
        raise RecordingError(
            f"--output {args.output}: recordings are MCAP files; give a name that ends in .mcap"
        )
    check_target(args.output, overwrite=args.force)
    check_name(args.name)
    make_readout(args.readout, scenario.design.electrode_names)
    with Interrupt() as interrupt:
        simulator = build_simulator(scenario, quiet=args.quiet)
        recorder = Recorder(
            args.output, simulator, name=args.name, readout=args.readout, scenario=scenario,
            overwrite=args.force,
        )  # fmt: skip
        interrupt.deferring = True
        try:
            with recorder:
                play_samples(
                    scenario, simulator,
                    lambda s: recorder.write(s.time, s.scene, s.reading),
                    interrupt, quiet=args.quiet,
                )  # fmt: skip
        except Exception:
            time = scenario.times[min(recorder.count, scenario.count - 1)]
            say(f"stopped at sample {recorder.count} of {scenario.count} (t = {time:g} s)")
            raise
    if not args.quiet:
        print(_report(scenario, recorder))
    if interrupt.requested and recorder.count < scenario.count:
        say(f"interrupted after {recorder.count} of {scenario.count} samples, which are kept")
        return INTERRUPTED
    return OK


def _report(scenario: Scenario, recorder: Recorder) -> str:
    from capsense.cli.tables import facts

    size = recorder.path.stat().st_size
    return facts(
        [
            ("scenario", scenario.name),
            ("design", f"{scenario.design.name}, {len(scenario.design.electrodes)} electrodes"),
            ("samples", f"{recorder.count} of {scenario.count}, at {scenario.sample_rate:g} Hz"),
            ("recording", f"{recorder.path}, {size / 1e6:.2f} MB"),
        ]
    )
