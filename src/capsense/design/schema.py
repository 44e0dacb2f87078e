"""Strict reading of design tables."""

from __future__ import annotations

from capsense import _validate
from capsense.errors import DesignError


class DesignTable(_validate.Table):
    """One table of a design file; whatever is wrong raises :class:`DesignError`."""

    error_type = DesignError
