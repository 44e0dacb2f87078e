"""``capsense ros``: sensors among the frames of ROS 2."""

from __future__ import annotations

import argparse
import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from capsense.cli import INTERRUPTED, OK, Interrupt, arg, command, say
from capsense.cli.run import SCENARIO, build_simulator, chosen_scenario

if TYPE_CHECKING:
    from collections.abc import Sequence

    from capsense.recording.node import RosSensors
    from capsense.scenario import Scenario

DOMAIN = "ROS_DOMAIN_ID"
"""What names the domain in the environment of ROS 2."""


def _pair(text: str) -> tuple[str, str]:
    """Parse NAME=FRAME."""
    name, equals, frame = text.partition("=")
    if not (name and equals and frame):
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=FRAME, such as hand=hand_link")
    return name, frame


def _seconds(text: str) -> float:
    value = float(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text} s; give a positive number")
    return value


@command(
    "ros",
    "read sensors at the poses of /tf, and publish readings to ROS 2 or write them to a bag",
    *SCENARIO,
    arg(
        "--sensor NAME=FRAME",
        "a sensor: the beginning of its topics, and its frame; may be repeated; "
        "default sensor=sensor",
        type=_pair,
        action="append",
        default=[],
    ),
    arg(
        "--frame BODY=FRAME",
        "frame of a body, where it is not called as the body is; may be repeated",
        type=_pair,
        action="append",
        default=[],
    ),
    arg("--readout CHIP|FILE.toml", "also report what a chip would report"),
    arg("--seed N", "of the chips; default 0", type=int, default=0),
    arg(
        "--timeout S",
        "age from which a transform is too old; default 0.5",
        type=_seconds,
        default=0.5,
    ),
    arg("--leave-out", "read without bodies whose transform is missing or too old"),
    arg("--sim-time", "take the time from /clock"),
    arg("--domain N", f"ROS domain; default ${DOMAIN}, or 0", type=int),
    arg("--duration S", "end after this time; default never", type=_seconds),
    arg("--bag BAG", "read a bag instead: .mcap, a folder of rosbag2, a .bag", type=Path),
    arg("-o --output FILE.mcap", "with --bag: what to write", type=Path),
    arg("--force", "replace a file that is there"),
)
def ros(args: argparse.Namespace) -> int:
    """Put sensors at frames of ROS 2: their poses and those of the bodies in front of them come
    from /tf and /tf_static, and capacitances, what the registers of a chip hold, and touch are
    published over DDS as messages that every ROS 2 installation knows. No ROS is needed here.

    The scenario file says what the sensor and the bodies are. Where the bodies are in it does not
    matter. A sensor reads at --rate, by default the file's sample rate.

    While the transform of a body is missing, or older than --timeout, the sensor publishes
    nothing, and says so here and on /diagnostics. With --leave-out it reads without that body.

    With --bag the transforms are those of a recording, and the readings go to an MCAP file.
    Ctrl-C, or a request to terminate, ends it: with exit code 0, or 130 within a bag.

    examples:
      capsense ros examples/hand_approach.toml --sensor wrist=wrist_pad --frame arm=forearm
      capsense ros examples/hand_approach.toml --readout fdc1004 --rate 100 --domain 7
      capsense ros examples/hand_approach.toml --bag drive.mcap -o felt.mcap --frame arm=forearm
    """
    _check(args)
    scenario = chosen_scenario(args)
    sensors = _sensors(args, scenario)
    if args.bag is not None:
        return _convert(args, scenario, sensors)
    from capsense.errors import warn_experimental
    from capsense.recording.dds import RosDomain
    from capsense.recording.node import follow

    warn_experimental("publishing to ROS 2", "a peer of CycloneDDS that has its types")
    domain = RosDomain(_domain(args.domain))
    until = math.inf if args.duration is None else time.monotonic() + args.duration
    with Interrupt() as interrupt:
        interrupt.deferring = True
        if not args.quiet:
            say(f"reads {scenario.sample_rate:g} times a second; Ctrl-C ends it")
        follow(
            sensors, domain, scenario.sample_rate,
            lambda: interrupt.requested or time.monotonic() > until, sim_time=args.sim_time,
        )  # fmt: skip
    if not args.quiet:
        say(f"{sensors.count} readings; {sensors.problems}")
    return OK


def _check(args: argparse.Namespace) -> None:
    """Raise for arguments that do not go together."""
    from capsense.errors import RecordingError

    def require(given: object, option: str, only: str) -> None:
        if given:
            raise RecordingError(f"{option} goes with {only} only; leave it out")

    if args.bag is None:
        for given, option in ((args.output, "--output"), (args.force, "--force")):
            require(given, option, "--bag")
        return
    for given, option in (
        (args.domain is not None, "--domain"), (args.duration is not None, "--duration"),
    ):  # fmt: skip
        require(given, option, "live topics")
    if args.output is None or args.output.suffix != ".mcap":
        raise RecordingError(
            f"--output {args.output}: readings of a bag go to an MCAP file; give a name that ends "
            "in .mcap"
        )


def _unique(option: str, pairs: Sequence[tuple[str, str]]) -> dict[str, str]:
    from capsense.errors import RecordingError

    out = dict(pairs)
    if len(out) < len(pairs):
        names = [name for name, _ in pairs]
        raise RecordingError(f"{option} names one twice: {', '.join(names)}; keep one of each")
    return out


def _sensors(args: argparse.Namespace, scenario: Scenario) -> RosSensors:
    from capsense.recording import ros as messages
    from capsense.recording.files import check_target
    from capsense.recording.node import RosSensors

    messages.require()
    if args.output is not None:
        check_target(args.output, overwrite=args.force)
    sensors = RosSensors(
        scenario, _unique("--sensor", args.sensor) or {"sensor": "sensor"},
        _unique("--frame", args.frame), readout=args.readout, seed=args.seed,
        timeout=args.timeout, leave_out=args.leave_out,
        simulator=lambda: build_simulator(scenario, quiet=args.quiet),
    )  # fmt: skip
    sensors.warn = say
    return sensors


def _domain(given: int | None) -> int:
    """The domain of the arguments, else of the environment."""
    from capsense.errors import AdapterError

    if given is not None:
        return given
    text = os.environ.get(DOMAIN, "").strip() or "0"
    if not text.isdecimal():
        raise AdapterError(f"{DOMAIN} is {text!r}; set it to a number from 0 on, or give --domain")
    return int(text)


def _convert(args: argparse.Namespace, scenario: Scenario, sensors: RosSensors) -> int:
    from capsense.recording.node import convert

    with Interrupt() as interrupt:
        interrupt.deferring = True
        requested: Callable[[], bool] = lambda: interrupt.requested  # noqa: E731
        count = convert(
            sensors, args.bag, args.output, scenario.sample_rate, sim_time=args.sim_time,
            overwrite=args.force, stopped=requested,
        )  # fmt: skip
        if not args.quiet:
            print(f"{count} readings in {args.output}")
        return INTERRUPTED if interrupt.requested else OK
