"""A field that several tests look at."""

from __future__ import annotations

import pytest
from tiny_field import SETTINGS, few_sources, tiny_design

from capsense.field.background import BackgroundField, build_background


@pytest.fixture(scope="session")
def built() -> BackgroundField:
    """A rough field of the tiny design as it is built, not as a file holds it."""
    with few_sources():
        return build_background(tiny_design(), SETTINGS)
