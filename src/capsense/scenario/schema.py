"""Strict reading of scenario tables."""

from __future__ import annotations

from capsense import _validate
from capsense.errors import ScenarioError


class ScenarioTable(_validate.Table):
    """One table of a scenario file; whatever is wrong raises :class:`ScenarioError`."""

    error_type = ScenarioError
