"""Derivatives of capacitances by all lengths of a scene add up as similarity demands."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from approximate import approx

from capsense.field.background import BuildSettings, build_background, empty_capacitance
from capsense.studies import derivatives
from capsense.studies.capacitances import Capacitances, load_design_template

PADS = """
name = "pads"
domain = { size = ["=room", "=room", "=room"], backplane = "=depth" }
build = { resolution = 0.25 }
electrode = [
  { name = "A", shape = "rectangle", size = ["=side", "=side"], center = ["=-(gap + side)/2", 0] },
  { name = "B", shape = "rectangle", size = ["=side", "=side"], center = ["=(gap + side)/2", 0] },
]
conductor = [
  { name = "S", role = "shield", shape = "rectangle", size = ["=3 * side", "=side"], z = -0.002 },
]
"""
POINT = {"room": 0.3, "depth": 0.01, "side": 0.012, "gap": 0.002, "lift": -0.002}


@pytest.fixture
def pads(tmp_path: Path) -> Path:
    file = tmp_path / "pads.toml"
    file.write_text(PADS.replace("z = -0.002", 'z = "=lift"'))
    return file


def test_capacitances_are_of_first_degree(pads: Path) -> None:
    """Euler: the sum of p dC/dp over all lengths p is C, within the estimated errors, which are
    small."""
    found = derivatives(pads, POINT)
    assert found.outputs == ("C0_A_A", "C0_A_B", "C0_B_B")
    lengths = np.array([POINT[name] for name in found.parameters])
    here = Capacitances.of(load_design_template(pads), [POINT])(POINT)
    sums, errors = found.values @ lengths, np.abs(found.errors @ np.abs(lengths))
    assert (errors < 2e-3 * np.abs(here)).all()
    assert (np.abs(sums - here) < 2 * errors + 1e-6 * np.abs(here)).all()
    assert found.values[0, found.parameters.index("side")] > 0
    assert found.values[1, found.parameters.index("gap")] > 0  # of a negative number


def test_the_empty_domain_alone(pads: Path) -> None:
    """It is the full field's matrix to the last bit, and the readings' at rest, with a shield."""
    evaluation = Capacitances.of(load_design_template(pads), [POINT], None, "fdc1004")
    design = evaluation.made(POINT)
    settings = BuildSettings().refined(0.25)
    field = build_background(design, settings)
    np.testing.assert_array_equal(empty_capacitance(design, settings), field.capacitance)
    assert evaluation(POINT)[0] == field.capacitance[0, 0]
    offset = -(field.capacitance[0, 2])
    assert offset > 1e-15
    reading = evaluation._empty(POINT)
    assert reading.self_capacitance[0] == approx(field.capacitance[0, 0] - offset, rel=1e-12)
