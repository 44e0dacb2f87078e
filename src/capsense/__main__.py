"""The ``capsense`` command, also ``python -m capsense``: runs a subcommand.

Arguments are parsed here; errors become messages and exit codes.
"""

from __future__ import annotations

import argparse
import os
import sys
import traceback
import warnings
from collections.abc import Sequence
from inspect import cleandoc
from typing import Any

from capsense.cli import (
    BAD_INPUT,
    FAILED,
    INTERRUPTED,
    OK,
    Interrupt,
    design,
    layout,
    recordings,
    ros,
    run,
    say,
    serve,
    studies,
    warmup,
)
from capsense.errors import CapSenseError, FieldError, SolveError

COMMANDS = (
    run.run, run.record, recordings.replay, recordings.export, design.design, layout.layout,
    recordings.readout, ros.ros,
    studies.dataset, studies.sweep, studies.tolerance, studies.optimise, studies.bench,
    studies.reproduce, serve.serve, serve.view, warmup.warmup,
)  # fmt: skip
"""The subcommands, in the order of ``--help``. A new one is a function that
:func:`~capsense.cli.command` decorates, listed here."""

ALIASES = {"optimise": ["optimize"]}
"""Other spellings of subcommands."""

EXIT_CODES = """\
exit codes:
  0    done
  1    failed for a reason that is not your input: a step that was not solved, a full
       disk, a bug (what was computed until then is kept)
  2    bad usage or input; the message names what is wrong and how to fix it
  3    reproduce: it ran, and a figure missed its target; replay: a reading differs;
       design: the tolerance is not met
  130  interrupted by Ctrl-C or a request to terminate (what was computed is kept)
"""


class _Version(argparse.Action):
    """``--version``, looked up only when asked for."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(nargs=0, default=argparse.SUPPRESS, **settings)

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        import capsense

        print(f"capsense {capsense.__version__}")
        parser.exit()


def build_parser() -> argparse.ArgumentParser:
    """The parser of the whole command line."""
    parser = argparse.ArgumentParser(
        prog="capsense",
        description="Simulate capacitive proximity sensors: from electrodes and bodies in front of "
        "them to the capacitances that a readout would see.",
        epilog=EXIT_CODES + "\n'capsense COMMAND --help' explains a command, with examples.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("--version", action=_Version, help="print the version and exit")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for command in COMMANDS:
        description, _, examples = cleandoc(command.execute.__doc__ or "").partition("examples:\n")
        sub = commands.add_parser(
            command.name,
            aliases=ALIASES.get(command.name, []),
            help=command.help,
            description=description,
            epilog=f"examples:\n{examples}\n\nexit codes: see 'capsense --help'",
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        for given in command.arguments:
            into = sub.add_mutually_exclusive_group() if isinstance(given, list) else sub
            for names, options in given if isinstance(given, list) else [given]:
                into.add_argument(*names, **options)
        sub.set_defaults(execute=command.execute)
    return parser


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    say(f"warning: {message}")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: Arguments after the program's name; those of the process by default.

    Returns:
        The exit code, see :data:`EXIT_CODES`.
    """
    args = build_parser().parse_args(argv)
    with warnings.catch_warnings(), Interrupt():
        warnings.showwarning = _show_warning
        try:
            return args.execute(args)
        except (SolveError, FieldError) as error:
            say(f"error: {error}")
            return FAILED
        except CapSenseError as error:
            say(f"error: {error}")
            return BAD_INPUT
        except KeyboardInterrupt:
            say("interrupted")
            return INTERRUPTED
        except BrokenPipeError:  # the reader of our output went away, as in `| head`
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return OK
        except OSError as error:
            where = f"{error.filename}: " if error.filename else ""
            say(f"error: {where}{error.strerror or error}")
            return FAILED
        except Exception as error:
            traceback.print_exc()
            say(f"internal error: {error}; this is a bug, please report it with the lines above")
            return FAILED


if __name__ == "__main__":
    sys.exit(main())
