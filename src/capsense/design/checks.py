"""Checks on a whole design."""

from __future__ import annotations

from capsense.design.model import Design
from capsense.errors import DesignError


def check_design(design: Design, *, source: str = "design") -> None:
    """Refuse a design without electrodes."""
    if not design.electrodes:
        raise DesignError(f"{source}: design has no electrode; add an [[electrode]] table")
