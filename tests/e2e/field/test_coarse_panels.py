"""Panels that are too coarse for a board's baseline are told by its signs."""

from __future__ import annotations

import tomllib
import warnings
from pathlib import Path

import pytest

from capsense.design import parse_design
from capsense.field.background import empty_capacitance, warn_of_signs
from capsense.field.cache import default_settings

BOARD = Path(__file__).parents[3] / "examples" / "experiment" / "board.toml"


@pytest.mark.parametrize(("resolution", "told"), [(0.4, True), (0.5, False)])
def test_a_board_with_a_mutual_capacitance_of_the_wrong_sign(resolution: float, told: bool) -> None:
    """Regression: pads T and R of the laboratory experiment, by 0.3 pF."""
    data = tomllib.loads(BOARD.read_text())
    design = parse_design({**data, "build": {"resolution": resolution}})
    capacitance = empty_capacitance(design, default_settings(design))
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        warn_of_signs(design, capacitance)
    assert len(found) == told
    if told:
        text = str(found[0].message)
        assert "of T and R has the wrong sign" in text
        assert f"above {resolution:g}" in text
