"""Cloth, cables and soft bodies that are bent and pressed, against boundary elements."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

import capsense as cs

ROOT = Path(__file__).parents[3]
sys.path.append(str(ROOT / "benchmarks"))

import flexible  # noqa: E402

ROWS = json.loads((ROOT / "tests" / "data" / "flexible.json").read_text(encoding="utf-8"))
KNOWN = {
    "5 cloth, wet cloth, dielectric, six_patch": 0.1,
    "12 cable, copper, grounded, six_patch": 0.16,
    "15 cable, polyester, dielectric, six_patch": 0.15,
    "16 soft, foam, dielectric, six_patch": 0.18,
    "18 soft, rubber, dielectric, patch": 0.18,
    "14 cable, copper, grounded, patch": 0.11,
}
"""What is worse, see docs/depth.md. Cables and blocks have the clusters and the interior of their
first form; the reference of 18 is known to 12 %."""


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row["name"])
def test_against_boundary_elements(simulators, row):
    """Reference: channels above 3 % of the largest are right to 9 %, but for those in docs."""
    sim = simulators(flexible.design_of(row["design"]))
    reading = sim.step(cs.Scene([flexible.surface_of(row).body()]))
    channels, entries = flexible.errors(reading.delta, row)
    assert channels < KNOWN.get(row["name"], 0.09)
    assert entries < 0.2
