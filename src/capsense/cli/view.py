"""``capsense view``: a sensor at work, live in a browser."""

from __future__ import annotations

import argparse
import socket
import threading
from pathlib import Path
from typing import TYPE_CHECKING

from capsense.cli.run import build_simulator, progress_shown, sample_rate
from capsense.cli.serve import read_token

if TYPE_CHECKING:
    from capsense.viewer.player import Playback
    from capsense.viewer.view import LiveView

NAME = "view"
HELP = "show a sensor at work, live in a web browser"
DESCRIPTION = """\
Show a sensor in a web browser: its electrodes coloured by their signals, the bodies, the potential
on a plane, charts of the channels, and the matrix. Time can be paused, stepped and moved about in.

A scenario is simulated as it is shown; --replay shows a recording; --connect watches what clients
of a running 'capsense serve --watch' do.

No display is needed: the page is served, by default to browsers on this machine, and needs nothing
from the internet. Ctrl-C, or a request to terminate, ends it with exit code 0.
"""
EXAMPLES = """\
  capsense view examples/hand_approach.toml
  capsense view --replay hand.mcap --port 9000
  capsense view --connect ws://127.0.0.1:8765
"""
LOOPBACK = ("localhost", "::1")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "scenario", metavar="SCENARIO.toml", type=Path, nargs="?", help="the scenario file"
    )
    parser.add_argument("--replay", metavar="FILE.mcap", type=Path, help="show a recording")
    parser.add_argument("--connect", metavar="URL", help="watch a server, ws://HOST:PORT")
    parser.add_argument(
        "--sensor", metavar="CLIENT:SENSOR", type=_address,
        help="which of the server's, by its log's numbers; default the one opened last",
    )  # fmt: skip
    parser.add_argument(
        "--token-file", metavar="FILE", type=Path, help="file with the token the server asks for"
    )
    parser.add_argument(
        "--rate", metavar="HZ", type=sample_rate, help="sample rate, instead of the scenario's"
    )
    parser.add_argument("--host", default="127.0.0.1", help="address; default this machine only")
    parser.add_argument("--port", type=int, default=8080, help="default 8080; 0 for any")
    parser.add_argument("--paused", action="store_true", help="do not start to play")
    parser.add_argument("-q", "--quiet", action="store_true", help="print the page's address only")


def execute(args: argparse.Namespace) -> int:
    """Show it until told to stop, and return the exit code."""
    from capsense.cli.main import OK
    from capsense.viewer.view import LiveView, check_address

    _check(args)
    check_address(args.host, args.port)
    player = _player(args)
    try:
        view = LiveView(player, host=args.host, port=args.port)
        try:
            _announce(view, args)
            if args.paused:
                player.pause()
            else:
                player.play()
            view.run(threading.Event())
        except KeyboardInterrupt:  # its proper end
            pass
        finally:
            view.stop()
    finally:
        player.stop()
    return OK


def _address(text: str) -> tuple[int, int]:
    """Parse ``--sensor``."""
    client, colon, sensor = text.partition(":")
    if not (colon and client.isdecimal() and sensor.isdecimal()):
        raise argparse.ArgumentTypeError(f"{text!r} is not CLIENT:SENSOR, such as 3:0")
    return int(client), int(sensor)


def _check(args: argparse.Namespace) -> None:
    """Raise for arguments that do not go together."""
    from capsense.errors import ScenarioError

    given = {
        "a scenario": args.scenario is not None,
        "--replay": args.replay is not None,
        "--connect": args.connect is not None,
    }
    if sum(given.values()) != 1:
        found = " and ".join(name for name, there in given.items() if there) or "nothing"
        raise ScenarioError(
            f"{found} is given; give one of a scenario file, --replay FILE.mcap, --connect URL"
        )
    for option, value, only in (
        ("--sensor", args.sensor, "--connect"),
        ("--token-file", args.token_file, "--connect"),
        ("--rate", args.rate, "a scenario"),
    ):
        if value is not None and not given[only]:
            raise ScenarioError(f"{option} goes with {only} only; leave it out")


def _player(args: argparse.Namespace) -> Playback:
    """What is to be shown, ready to play."""
    from capsense.cli.main import say
    from capsense.cli.progress import BuildProgress
    from capsense.viewer.player import Player

    with BuildProgress(shown=progress_shown(args.quiet)) as progress:
        if args.connect is not None:
            from capsense.viewer.follower import Follower
            from capsense.viewer.watched import Watched

            token = read_token(args.token_file) or ""
            return Follower(
                Watched(
                    args.connect, token=token, which=args.sensor, progress=progress,
                    waiting=lambda: say("waiting for a client to open a sensor"),
                )
            )  # fmt: skip
        from capsense.viewer.source import RecordingSource, ScenarioSource

        if args.replay is not None:
            from capsense.recording.reader import open_recording

            return Player(RecordingSource(open_recording(args.replay), progress))
    from capsense.scenario import load_scenario

    scenario = load_scenario(args.scenario)
    if args.rate is not None:
        scenario = scenario.resampled(args.rate)
    return Player(ScenarioSource(scenario, build_simulator(scenario, quiet=args.quiet)))


def _announce(view: LiveView, args: argparse.Namespace) -> None:
    """Say where the page is, and how to get at it."""
    from capsense.cli.main import say

    if args.host.startswith("127.") or args.host in LOOPBACK:
        if not args.quiet:
            port = view.url.rpartition(":")[2]
            say(
                f"from another machine: ssh -L {port}:{view.url.removeprefix('http://')} "
                f"{socket.gethostname()}, then open http://localhost:{port} there; Ctrl-C ends it"
            )
    else:
        say("warning: whoever reaches this address sees the page and can move it about")
    print(view.url, flush=True)  # last: whoever waits for it may stop the view at once
