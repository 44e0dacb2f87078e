"""A field that several tests look at."""

from __future__ import annotations

import pytest
from tiny_field import SETTINGS, tiny_design

from capsense.field.background import BackgroundField, build_background


@pytest.fixture(scope="session")
def built() -> BackgroundField:
    """The field of the tiny design as it is built, not as a file holds it."""
    return build_background(tiny_design(), SETTINGS)
