"""``capsense serve`` and ``capsense view``: sensors for other programs, and in a browser."""

from __future__ import annotations

import argparse
import json
import logging
import signal
import socket
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

from capsense.cli import OK, RATE, BuildProgress, arg, command, progress_shown, say
from capsense.cli.run import build_simulator, chosen_scenario

if TYPE_CHECKING:
    from capsense.server.options import Limits
    from capsense.server.server import Server
    from capsense.viewer.player import Playback
    from capsense.viewer.view import LiveView


SWITCH_INTERVAL = 5e-4
"""Time [s] after which Python's threads take turns, so that no client waits long for another."""


_LIMITS = {
    "connections": "clients at once; default 16",
    "sensors": "sensors of one client; default 8",
    "pixels": "pixels of an image; default 65536",
    "bodies": "bodies of a scene; default 64",
}


@command(
    "serve",
    "serve sensors to Unity, browsers and other programs",
    arg(
        "--design NAME|FILE.toml",
        "what may be opened; may be repeated, the first is the default",
        action="append",
        required=True,
    ),
    arg("--readout CHIP|FILE.toml", "also report what a chip would report"),
    arg("--host HOST", "address; default this machine only", default="127.0.0.1"),
    arg("--port PORT", "default 8765; 0 for any", type=int, default=8765),
    arg("--token-file FILE", "file with the token clients must send", type=Path),
    arg("--origin URL", "web page that may connect; may be repeated", action="append", default=[]),
    arg("--watch", "let clients watch others' sensors (capsense view)"),
    *(arg(f"--max-{name} N", what, type=int) for name, what in _LIMITS.items()),
    arg("-q --quiet", "log faults only"),
)
def serve(args: argparse.Namespace) -> int:
    """Serve sensors over a WebSocket: clients send depth images or bodies, and receive
    capacitances.

    Logs one JSON object a line on stderr. GET /health on the same port answers how it is. Ctrl-C,
    or a request to terminate, finishes what is in work, closes all connections and ends with exit
    code 0; a second one stops at once.

    examples:
      capsense serve --design six_patch
      capsense serve --design six_patch --design my.toml --readout fdc1004
      capsense serve --design stripe --host 0.0.0.0 --token-file token.txt
      capsense serve --design stripe --origin http://localhost:3000      for a web page
    """
    import asyncio

    from capsense.server.options import ServerOptions
    from capsense.server.server import Server

    options = ServerOptions(
        tuple(args.design), args.readout, args.host, args.port, read_token(args.token_file),
        tuple(args.origin), _limits(args), args.watch,
    )  # fmt: skip
    logger = _logger(quiet=args.quiet)
    with BuildProgress(quiet=not progress_shown(args.quiet)) as progress:  # lines are JSON here
        server = Server(options, progress=progress, logger=logger)
    sys.setswitchinterval(SWITCH_INTERVAL)
    asyncio.run(_run(server))
    return OK


def _limits(args: argparse.Namespace) -> Limits:
    from capsense.server.options import Limits

    values = {name: getattr(args, f"max_{name}") for name in _LIMITS}
    return Limits(**{name: value for name, value in values.items() if value is not None})


def read_token(path: Path | None) -> str | None:
    """The token in a file; None without a file."""
    from capsense.errors import ServerError

    if path is None:
        return None
    try:
        return path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ServerError(f"--token-file {path} cannot be read: {error}") from None


async def _run(server: Server) -> None:
    """Serve until a signal; a second one finds Python's own handlers again."""
    import asyncio

    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    signals = (signal.SIGINT, signal.SIGTERM)

    def on_signal() -> None:
        stop.set()
        for number in signals:
            loop.remove_signal_handler(number)

    for number in signals:
        loop.add_signal_handler(number, on_signal)
    await server.run(stop)


class JsonLines(logging.Formatter):
    """One JSON object a line: time, level, event, and the event's own fields."""

    def format(self, record: logging.LogRecord) -> str:
        entry = {
            "time": time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created))
            + f".{record.msecs:03.0f}Z",
            "level": record.levelname.lower(),
            "event": record.getMessage(),
            **getattr(record, "fields", {}),
        }
        if record.exc_info:
            entry["exception"] = self.formatException(record.exc_info)
        return json.dumps(entry)


def _logger(*, quiet: bool) -> logging.Logger:
    logger = logging.getLogger("capsense.server")
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines())
    logger.handlers[:] = [handler]
    logger.setLevel(logging.ERROR if quiet else logging.INFO)
    logger.propagate = False
    return logger


LOOPBACK = ("localhost", "::1")


def _address(text: str) -> tuple[int, int]:
    """Parse ``--sensor``."""
    client, colon, sensor = text.partition(":")
    if not (colon and client.isdecimal() and sensor.isdecimal()):
        raise argparse.ArgumentTypeError(f"{text!r} is not CLIENT:SENSOR, such as 3:0")
    return int(client), int(sensor)


@command(
    "view",
    "show a sensor at work, live in a web browser",
    arg("scenario SCENARIO.toml", "the scenario file", type=Path, nargs="?"),
    arg("--replay FILE.mcap", "show a recording", type=Path),
    arg("--name SENSOR", "which sensor of a recorded skin"),
    arg("--connect URL", "watch a server, ws://HOST:PORT"),
    arg(
        "--sensor CLIENT:SENSOR",
        "which of the server's, by its log's numbers; default the one opened last",
        type=_address,
    ),
    arg("--token-file FILE", "file with the token the server asks for", type=Path),
    RATE,
    arg("--host HOST", "address; default this machine only", default="127.0.0.1"),
    arg("--port PORT", "default 8080; 0 for any", type=int, default=8080),
    arg("--paused", "do not start to play"),
    arg("-q --quiet", "print the page's address only"),
)
def view(args: argparse.Namespace) -> int:
    """Show a sensor in a web browser: its electrodes coloured by their signals, the bodies, the
    potential on a plane, charts of the channels, and the matrix. Time can be paused, stepped and
    moved about in.

    A scenario is simulated as it is shown; --replay shows a recording; --connect watches what
    clients of a running 'capsense serve --watch' do.

    No display is needed: the page is served, by default to browsers on this machine, and needs
    nothing from the internet. Ctrl-C, or a request to terminate, ends it with exit code 0.

    examples:
      capsense view examples/hand_approach.toml
      capsense view --replay hand.mcap --port 9000
      capsense view --connect ws://127.0.0.1:8765
    """
    from capsense.viewer.view import LiveView, check_address

    _check_view(args)
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


def _check_view(args: argparse.Namespace) -> None:
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
        ("--name", args.name, "--replay"),
        ("--sensor", args.sensor, "--connect"),
        ("--token-file", args.token_file, "--connect"),
        ("--rate", args.rate, "a scenario"),
    ):
        if value is not None and not given[only]:
            raise ScenarioError(f"{option} goes with {only} only; leave it out")


def _player(args: argparse.Namespace) -> Playback:
    """What is to be shown, ready to play."""
    from capsense.viewer.player import Follower, Player

    with BuildProgress(quiet=args.quiet) as progress:
        if args.connect is not None:
            from capsense.viewer.source import Watched

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

            return Player(RecordingSource(open_recording(args.replay, args.name), progress))
    scenario = chosen_scenario(args)
    return Player(ScenarioSource(scenario, build_simulator(scenario, quiet=args.quiet)))


def _announce(view: LiveView, args: argparse.Namespace) -> None:
    """Say where the page is, and how to get at it."""

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
