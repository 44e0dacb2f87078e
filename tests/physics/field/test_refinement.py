"""Refinement of panels to a tolerance."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import capsense as cs
from capsense.field import boundary
from capsense.field.background import empty_capacitance
from capsense.field.cache import default_settings
from capsense.field.refinement import refine

PADS = """
name = "pads"
[domain]
size = [0.2, 0.2, 0.2]
backplane = 0.01
[build]
resolution = 0.25
[[electrode]]
name = "A"
shape = "rectangle"
size = [0.02, 0.02]
center = [-0.012, 0.0]
[[electrode]]
name = "B"
shape = "disc"
radius = 0.009
center = [0.012, 0.0]
"""


@pytest.fixture
def pads(tmp_path):
    file = tmp_path / "pads.toml"
    file.write_text(PADS)
    return cs.load_design(file)


def test_true_errors_are_within_the_tolerance(pads):
    """Against panels that are twice as fine as those that were found."""
    told = []
    found = refine(pads, 0.02, told.append)
    assert found.met
    assert found.resolution >= 0.25
    assert found.errors.max() <= 0.02
    assert f"boundary elements: {found.panels} panels" in told

    at = dataclasses.replace(pads, build={"resolution": found.resolution})
    same = empty_capacitance(at, default_settings(at))
    np.testing.assert_array_equal(found.capacitance, same)
    finer = dataclasses.replace(pads, build={"resolution": 2 * found.resolution})
    right = empty_capacitance(finer, default_settings(finer))
    assert np.abs(found.capacitance / right - 1.0).max() < 0.02


def test_smaller_tolerances_take_more_panels(pads):
    loose, tight = refine(pads, 0.1), refine(pads, 0.005)
    assert tight.met
    assert tight.panels > loose.panels
    assert tight.resolution > loose.resolution


def test_what_does_not_fit_is_told(pads, monkeypatch):
    monkeypatch.setattr(boundary, "_MAX_PANELS", refine(pads, 0.5).panels + 10)
    found = refine(pads, 1e-4)
    assert not found.met
    assert 1e-4 < found.errors.max() < 1.0
    monkeypatch.setattr(boundary, "_MAX_PANELS", 10)
    with pytest.raises(cs.FieldError, match="more than the 10 that fit"):
        refine(pads, 1e-4)


@pytest.mark.parametrize("tolerance", [0.0, -0.1, 1.0, float("nan")])
def test_wrong_tolerances(pads, tolerance):
    with pytest.raises(cs.DesignError, match=r"tolerance is .*; give a number above 0 and below 1"):
        refine(pads, tolerance)
