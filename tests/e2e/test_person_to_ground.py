"""The table of capacitances to ground, against the boundary elements that it was made with."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

from capsense.humans.ground import STRAY

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.mark.parametrize("posture", list(STRAY))
def test_stray_capacitances(posture: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Coarser triangles than those of the table, and Saito's 70 pF of a standing person."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    module = importlib.import_module("person_to_ground")
    whole, rest = module.stray(posture, 0.5 if posture == "lying" else 0.025, 0.1)
    assert abs(rest - STRAY[posture]) < 4e-12
    assert whole >= rest > 60e-12
