"""The evaluation of Schöffmann et al. 2022, and what goes beyond it, each from one command.

A study is a function ``run(folder, *, reduced, report) -> Outcome`` in a module of its own, listed
in :data:`capsense.reproduce.harness.STUDIES`. :mod:`~capsense.reproduce.harness` says what it
returns; :class:`capsense.reproduce.store.Store` keeps what it has computed.
"""
