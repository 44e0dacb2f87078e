"""Difficult bodies over a packaged design, against ``tests/data/difficult.json``."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from difficult_scenes import difficult, scene_of

CASES = {c["name"]: c for c in difficult()[0] if c["design"] == "six_patch_bare"}
FEMTO = 1e-15


def errors(sim, name: str) -> tuple[np.ndarray, float]:
    """Relative errors of the diagonal's entries above a tenth of the largest, and the estimate."""
    case = CASES[name]
    truth = FEMTO * np.array(case["delta_fF"])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reading = sim.step(scene_of(case))
    own = np.diag(truth)
    counts = own > 0.1 * own.max()
    off = (np.diag(reading.delta) - own)[counts] / own[counts]
    return off, reading.stats.solver_error / own.max()


@pytest.mark.parametrize(
    ("name", "most"),
    [
        ("wire grounded 5 mm", 0.02),
        ("wire floating 2 mm", 0.05),
        ("wire tilted 2 mm", 0.02),
        ("needle upright 0.5 mm", 0.03),
        ("needle ellipsoid 2 mm", 0.03),
        ("needle tilted floating 1 mm", 0.04),
        ("foil grounded 5 mm", 0.03),
        ("foil floating 5 mm", 0.03),
        ("foil grounded 2 mm", 0.05),
        ("plate 0.1 mm, 10 mm", 0.05),
        ("plate 1 mm, 3 mm", 0.05),
        ("large block 30 mm", 0.05),
        ("large ball 20 mm", 0.05),
        ("large pipe 20 mm", 0.05),
        ("cup floating", 0.04),
        ("cup of plastic", 0.05),
        ("cup of plastic, no finger", 0.05),
        ("cup of plastic, finger low", 0.05),
    ],
)
def test_difficult_bodies(simulators, name, most):
    """Reference: boundary elements of bodies and sensor; they are good to 0.3 to 2 %."""
    off, _ = errors(simulators("six_patch_bare"), name)
    assert np.abs(off).max() < most


def test_a_foil_with_the_finest_functions(simulators):
    """Regression: the faces of a foil of 10 µm were taken for two, and left nothing definite."""
    off, _ = errors(simulators("six_patch_bare", preset="fine"), "foil grounded 2 mm")
    assert np.abs(off).max() < 0.05


@pytest.mark.parametrize("name", ["wire grounded 1 mm", "water 30 % full", "water 80 % full"])
def test_what_is_read_wrongly_says_so(simulators, name):
    """The gap law takes a wire for a plane; faces that two dielectrics share are not resolved."""
    off, estimate = errors(simulators("six_patch_bare"), name)
    assert 0.1 < np.abs(off).max() < 0.4
    assert np.abs(off).max() < 1.5 * estimate
