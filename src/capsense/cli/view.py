"""``capsense view``: a sensor at work, live in a browser."""

from __future__ import annotations

import argparse
import threading
from pathlib import Path
from typing import TYPE_CHECKING

from capsense.cli.run import build_simulator, progress_shown, sample_rate
from capsense.cli.serve import read_token

if TYPE_CHECKING:
    from capsense.viewer.source import Seekable

NAME = "view"
HELP = "show a sensor at work, live in a web browser"
DESCRIPTION = """\
Show a scenario in a web browser while it is simulated: the sensor, its electrodes coloured by their
signals, the bodies, the potential on a plane, charts of the channels and the matrix. Time can be
paused, stepped and moved about in.

With --connect a running 'capsense serve' simulates the scenario; --replay shows a recording.

No display is needed: the page is served, by default to browsers on this machine. From another one:
ssh -L 8080:localhost:8080 MACHINE, and open http://localhost:8080 there. Ctrl-C ends it.
"""
EXAMPLES = """\
  capsense view examples/hand_approach.toml
  capsense view examples/hand_approach.toml --connect ws://127.0.0.1:8765
  capsense view --replay hand.mcap --port 9000
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "scenario", metavar="SCENARIO.toml", type=Path, nargs="?", help="the scenario file"
    )
    parser.add_argument("--connect", metavar="URL", help="a server that simulates the scenario")
    parser.add_argument(
        "--token-file", metavar="FILE", type=Path, help="file with the token the server asks for"
    )
    parser.add_argument(
        "--replay", metavar="FILE.mcap", type=Path, help="show a recording in place of a scenario"
    )
    parser.add_argument(
        "--rate", metavar="HZ", type=sample_rate, help="sample rate, instead of the scenario's"
    )
    parser.add_argument("--host", default="127.0.0.1", help="address; default this machine only")
    parser.add_argument("--port", type=int, default=8080, help="default 8080; 0 for any")
    parser.add_argument("--paused", action="store_true", help="do not start to play")
    parser.add_argument("-q", "--quiet", action="store_true", help="no progress bar; errors only")


def execute(args: argparse.Namespace) -> int:
    """Show it until told to stop, and return the exit code."""
    from capsense.cli.interrupt import Interrupt
    from capsense.cli.main import OK, say
    from capsense.viewer.player import Player
    from capsense.viewer.view import View, check_address

    _check(args)
    check_address(args.host, args.port)
    with Interrupt():
        player = Player(_source(args))
        try:
            view = View(player, host=args.host, port=args.port)
            if not args.host.startswith("127.") and args.host not in ("localhost", "::1"):
                say("warning: whoever reaches this address sees the page and can move it about")
            print(view.url, flush=True)
            if not args.paused:
                player.play()
            try:
                view.run(threading.Event())
            except KeyboardInterrupt:  # its proper end
                pass
            finally:
                view.stop()
        finally:
            player.stop()
    return OK


def _check(args: argparse.Namespace) -> None:
    """Raise for arguments that do not go together."""
    from capsense.errors import ScenarioError

    if args.replay is not None:
        if args.scenario is not None or args.connect is not None or args.rate is not None:
            raise ScenarioError("--replay stands alone; leave out the scenario, --connect, --rate")
    elif args.scenario is None:
        raise ScenarioError("there is nothing to show; give a scenario file, or --replay FILE.mcap")


def _source(args: argparse.Namespace) -> Seekable:
    from capsense.cli.progress import BuildProgress
    from capsense.viewer import source

    if args.replay is not None:
        from capsense.recording.reader import open_recording

        with BuildProgress(shown=progress_shown(args.quiet)) as progress:
            return source.RecordingSource(open_recording(args.replay), progress)
    from capsense.scenario import load_scenario

    scenario = load_scenario(args.scenario)
    if args.rate is not None:
        scenario = scenario.resampled(args.rate)
    if args.connect is None:
        return source.ScenarioSource(scenario, build_simulator(scenario, quiet=args.quiet))
    import tomllib

    from capsense.server.client import Client

    client = Client(args.connect, token=read_token(args.token_file) or "", name="capsense view")
    try:
        tables = tomllib.loads(args.scenario.read_text(encoding="utf-8")).get("body", [])
        return source.ServerSource(client, scenario, tables)
    except BaseException:
        client.close()
        raise
