"""The subcommands of ``capsense``.

A subcommand is a module that satisfies :class:`Command`. To add one, write the module and list
it in :data:`COMMANDS`. Its top level imports nothing heavy, since every module is imported for
``capsense --help``.
"""

from __future__ import annotations

import argparse
from importlib import import_module
from typing import Protocol, cast

COMMANDS = (
    "capsense.cli.run",
    "capsense.cli.record",
    "capsense.cli.replay",
    "capsense.cli.export",
    "capsense.cli.design",
    "capsense.cli.readout",
    "capsense.cli.dataset",
    "capsense.cli.optimise",
    "capsense.cli.bench",
    "capsense.cli.reproduce",
    "capsense.cli.serve",
    "capsense.cli.view",
)
"""Modules of the subcommands, in the order of ``--help``."""


class Command(Protocol):
    """What a subcommand's module offers."""

    NAME: str
    """What is typed after ``capsense``."""
    HELP: str
    """One line for ``capsense --help``."""
    DESCRIPTION: str
    """Opening of ``capsense NAME --help``."""
    EXAMPLES: str
    """Its end: commands that work."""

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Declare the arguments."""

    def execute(self, args: argparse.Namespace) -> int:
        """Do it, and return the exit code."""


def load_commands() -> list[Command]:
    """Import the subcommands' modules."""
    return [cast(Command, import_module(name)) for name in COMMANDS]
