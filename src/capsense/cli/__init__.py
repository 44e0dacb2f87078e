"""The ``capsense`` command: one module per subcommand, listed in :mod:`capsense.cli.registry`."""
