"""The ``capsense`` command, and what its subcommands share; ``capsense.__main__`` lists them.

How one is declared, exit codes, signals, progress, tables of text.
"""

from __future__ import annotations

import argparse
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from capsense.errors import CapSenseError

if TYPE_CHECKING:
    from capsense.simulator import Simulator

OK, FAILED, BAD_INPUT, TARGET_MISSED, DIFFERS, INTERRUPTED = 0, 1, 2, 3, 3, 130
"""Exit codes."""
PICTURES = (".png", ".svg", ".pdf")
"""Endings of files that pictures are written to."""
EVERY = 10.0
"""Seconds between lines that tell of progress where there is no terminal."""

Argument = tuple[list[str], dict[str, Any]]
"""Names of an argument, and options of ``ArgumentParser.add_argument``."""


@dataclass(frozen=True)
class Command:
    """A subcommand of ``capsense``; :data:`capsense.__main__.COMMANDS` lists them.

    Its module's top level imports nothing heavy, since every one is imported for
    ``capsense --help``.
    """

    name: str
    """What is typed after ``capsense``."""
    help: str
    """One line for ``capsense --help``."""
    arguments: tuple[Argument | list[Argument], ...]
    """Of those in a list, one at most may be given."""
    execute: Callable[[argparse.Namespace], int]
    """Does it, and returns the exit code. Its docstring is what ``capsense NAME --help`` says: a
    description, and after the line ``examples:`` commands that work."""


def command(
    name: str, help: str, *arguments: Argument | list[Argument]
) -> Callable[[Callable[[argparse.Namespace], int]], Command]:
    """Make a :class:`Command` of the function that follows."""
    return partial(Command, name, help, arguments)


def arg(usage: str, help: str, **options: Any) -> Argument:
    """An argument of a subcommand.

    Args:
        usage: Its names and what stands for its value: ``"-o --output DIR"``, or ``"task FILE"``
            for one that has a place of its own. An option without a value is a switch.
        help: What ``--help`` says of it.
        options: Others of ``ArgumentParser.add_argument``.
    """
    words = usage.split()
    names = [word for word in words if word.startswith("-")] or words[:1]
    if len(words) > len(names):
        options["metavar"] = words[-1]
    elif names[0].startswith("-") and "choices" not in options:
        options["action"] = "store_true"
    return names, {"help": help, **options}


def say(message: str) -> None:
    """One line on stderr."""
    print(f"capsense: {' '.join(message.split())}", file=sys.stderr)


def progress_shown(quiet: bool) -> bool:
    """Whether there is somebody to watch a bar."""
    return not quiet and sys.stderr.isatty()


def sample_rate(text: str) -> float:
    """A sample rate [Hz] from the command line."""
    value = float(text)
    if not 1e-3 <= value <= 1e6:
        raise argparse.ArgumentTypeError(f"{text} Hz; give a number from 0.001 to 1e6")
    return value


QUIET = arg("-q --quiet", "no progress bar, no summary; errors only")
RATE = arg("--rate HZ", "sample rate, instead of the scenario's", type=sample_rate)
"""Arguments of several subcommands."""


def count_of(text: str) -> int:
    """A number of things, one or more, from the command line."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text}; give 1 or more")
    return value


def share(text: str) -> float:
    """A part of the whole from the command line, such as 1% or 0.01."""
    value = float(text[:-1]) / 100 if text.endswith("%") else float(text)
    if not 0.0 < value < 1.0:
        raise argparse.ArgumentTypeError(f"{text}; give a part above 0 and below 1, such as 1%")
    return value


def check_picture(option: str, path: Path, error: type[CapSenseError]) -> None:
    """Refuse before any computation what Matplotlib would refuse after it."""
    if path.suffix.lower() not in PICTURES:
        raise error(
            f"{option} {path} is no picture; give a name that ends in {', '.join(PICTURES)}"
        )
    if not path.parent.is_dir():
        raise error(f"{option} {path}: there is no folder {path.parent}; make it first")


def check_target(
    option: str, path: Path, ending: str | tuple[str, ...], error: type[CapSenseError]
) -> None:
    """Refuse before any computation what could not be written after it."""
    if not path.name.lower().endswith(ending) or not path.parent.is_dir():
        known = ending if isinstance(ending, str) else " or ".join(ending)
        raise error(f"{option} {path}: give a name that ends in {known}, in a folder that is there")


class Interrupt:
    """While in its ``with`` block, takes SIGINT and SIGTERM.

    Before :attr:`deferring` is set, a signal raises :class:`KeyboardInterrupt` at once. After,
    the first one only sets :attr:`requested`, which the caller checks between steps; a second
    one raises.
    """

    def __init__(self) -> None:
        self.deferring = False
        self.requested = False
        self._previous: list[tuple[int, Any]] = []

    def __enter__(self) -> Interrupt:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous.append((number, signal.signal(number, self._receive)))
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous:
            signal.signal(number, handler)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if self.deferring and not self.requested:
            self.requested = True
        else:
            raise KeyboardInterrupt


class BuildProgress:
    """A progress callback for :class:`capsense.Simulator`: ``progress(stage, fraction)``.

    A bar on a terminal; else a line at the start and one every :data:`EVERY` seconds. They appear
    at the first call, so that a field from the cache shows none.

    Args:
        quiet: Show nothing.
        prefix: What stands before the stage's name.
    """

    def __init__(self, *, quiet: bool = False, prefix: str = "building the field: ") -> None:
        self._quiet = quiet
        self._prefix = prefix
        self._bar: Any = None
        self._started = self._told = -math.inf

    def __enter__(self) -> BuildProgress:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def __call__(self, stage: str, fraction: float) -> None:
        """Show that ``stage`` is done to ``fraction``, from 0 to 1."""
        if self._quiet:
            return
        if not sys.stderr.isatty():
            self._line(stage, fraction)
            return
        if self._bar is None:
            from tqdm import tqdm

            form = "{desc} {percentage:3.0f}%|{bar}| {elapsed}"
            self._bar = tqdm(total=1.0, file=sys.stderr, bar_format=form, leave=False)
        self._bar.set_description(f"{self._prefix}{stage}", refresh=False)
        self._bar.n = min(max(fraction, 0.0), 1.0)
        self._bar.refresh()

    def _line(self, stage: str, fraction: float) -> None:
        """Say it in a line, unless that was done only just."""
        now = time.monotonic()
        if now - self._told < EVERY:
            return
        first = math.isinf(self._told)
        self._started = now if first else self._started
        self._told = now
        so_far = "" if first else f", {now - self._started:.0f} s so far"
        say(f"{self._prefix}{stage}, {min(max(fraction, 0.0), 1.0):.0%} done{so_far}")


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Align columns: words to the left, numbers to the right."""
    body = [list(r) for r in rows]
    lines = [list(header), *body]
    widths = [max(len(line[k]) for line in lines) for k in range(len(header))]
    right = [bool(body) and all(_numeric(r[k]) for r in body) for k in range(len(header))]
    return "\n".join(
        "  ".join(
            cell.rjust(w) if r else cell.ljust(w)
            for cell, w, r in zip(line, widths, right, strict=True)
        ).rstrip()
        for line in lines
    )


def _numeric(cell: str) -> bool:
    return not cell or cell[0].isdigit() or (cell[0] in "+-−." and cell[1:2] != "")


def facts(pairs: Iterable[tuple[str, str]]) -> str:
    """Lines of a name and what it is, aligned."""
    items = list(pairs)
    width = max((len(name) for name, _ in items), default=0)
    return "\n".join(f"{name.ljust(width)}  {value}".rstrip() for name, value in items)


def seconds(value: float) -> str:
    """A time with a fitting unit."""
    if value < 1e-3:
        return f"{value * 1e6:.0f} µs"
    if value < 1.0:
        return f"{value * 1e3:.3g} ms"
    return f"{value:.3g} s"


def grouped(value: object) -> str:
    """A count with thin groups of three, any other value as it is."""
    if isinstance(value, bool) or not isinstance(value, int):
        return f"{value:.4g}" if isinstance(value, float) else str(value)
    return f"{value:,}".replace(",", " ")


def field_figures(simulator: Simulator) -> dict[str, float | int | str]:
    """The figures of a design's field, without what is printed elsewhere."""
    told = ("design", "electrodes", "method")
    return {key: value for key, value in simulator.describe().items() if key not in told}
