"""``capsense serve``: sensors for Unity, browsers and other programs, over a WebSocket."""

from __future__ import annotations

import argparse
import json
import logging
import signal
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from capsense.server.options import Limits
    from capsense.server.server import Server

NAME = "serve"
HELP = "serve sensors to Unity, browsers and other programs"
DESCRIPTION = """\
Serve sensors over a WebSocket: clients send depth images or bodies, and receive capacitances.

Logs one JSON object a line on stderr. GET /health on the same port answers how it is. Ctrl-C, or a
request to terminate, finishes what is in work, closes all connections and ends with exit code 0; a
second one stops at once.
"""
EXAMPLES = """\
  capsense serve --design six_patch
  capsense serve --design six_patch --design my.toml --readout fdc1004
  capsense serve --design stripe --host 0.0.0.0 --token-file token.txt
  capsense serve --design stripe --origin http://localhost:3000      for a web page
"""
SWITCH_INTERVAL = 5e-4
"""Time [s] after which Python's threads take turns, so that no client waits long for another."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "--design", metavar="NAME|FILE.toml", action="append", required=True,
        help="what may be opened; may be repeated, the first is the default",
    )  # fmt: skip
    parser.add_argument(
        "--readout", metavar="CHIP|FILE.toml", help="also report what a chip would report"
    )
    parser.add_argument("--host", default="127.0.0.1", help="address; default this machine only")
    parser.add_argument("--port", type=int, default=8765, help="default 8765; 0 for any")
    parser.add_argument(
        "--token-file", metavar="FILE", type=Path, help="file with the token clients must send"
    )
    parser.add_argument(
        "--origin", metavar="URL", action="append", default=[],
        help="web page that may connect; may be repeated",
    )  # fmt: skip
    parser.add_argument(
        "--watch", action="store_true", help="let clients watch others' sensors (capsense view)"
    )
    for name, what in _LIMITS.items():
        parser.add_argument(f"--max-{name}", metavar="N", type=int, help=what)
    parser.add_argument("-q", "--quiet", action="store_true", help="log faults only")


_LIMITS = {
    "connections": "clients at once; default 16",
    "sensors": "sensors of one client; default 8",
    "pixels": "pixels of an image; default 65536",
    "bodies": "bodies of a scene; default 64",
}


def execute(args: argparse.Namespace) -> int:
    """Serve until told to stop, and return the exit code."""
    import asyncio

    from capsense.cli.main import OK
    from capsense.cli.progress import BuildProgress
    from capsense.server.options import ServerOptions
    from capsense.server.server import Server

    options = ServerOptions(
        tuple(args.design), args.readout, args.host, args.port, read_token(args.token_file),
        tuple(args.origin), _limits(args), args.watch,
    )  # fmt: skip
    logger = _logger(quiet=args.quiet)
    with BuildProgress(shown=not args.quiet and sys.stderr.isatty()) as progress:
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
