"""The ``capsense`` command: its subcommands are listed in :mod:`capsense.cli.main`."""
