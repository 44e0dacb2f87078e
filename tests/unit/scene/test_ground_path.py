"""Paths to ground: impedances against circuit theory."""

import math

import pytest
from approximate import approx

from capsense.errors import SceneError
from capsense.scene.materials import GROUND_PATHS, GroundPath


@pytest.mark.parametrize("frequency", [50.0, 250e3, 1e7])
def test_impedance_of_the_circuit(frequency):
    """Analytic: a series branch beside a leakage."""
    path = GroundPath(120e-12, 800.0, 2e6)
    branch = 800.0 - 1j / (2 * math.pi * frequency * 120e-12)
    assert path.impedance(frequency) == approx(branch * 2e6 / (branch + 2e6), rel=1e-12)


def test_equivalent_capacitance():
    """Analytic: a bare capacitor is its own equivalent; a series resistance lowers it."""
    assert GroundPath(100e-12).equivalent_capacitance(1e6) == approx(100e-12, rel=1e-12)
    path = GROUND_PATHS["human-body model"]
    turn = 2 * math.pi * 250e3 * 1.5e3 * 100e-12
    expected = 100e-12 / math.hypot(1.0, turn)
    assert path.equivalent_capacitance(250e3) == approx(expected, rel=1e-12)


def test_every_path_names_its_source():
    assert all(p.source for p in GROUND_PATHS.values())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((0.0,), "capacitance is 0.0"),
        ((math.inf,), "capacitance"),
        (("100 pF",), "capacitance is '100 pF'"),
        ((1e-10, 0.0, None), "leakage is None"),
        ((1e-10, -1.0), "series is -1"),
        ((1e-10, 0.0, 0.0), "leakage is 0"),
        ((1e-10, 0.0, math.nan), "leakage"),
    ],
)
def test_bad_paths_are_refused(arguments, words):
    with pytest.raises(SceneError, match=words):
        GroundPath(*arguments)


@pytest.mark.parametrize("frequency", [0.0, math.nan, "1 MHz"])
def test_bad_frequencies_are_refused(frequency):
    with pytest.raises(SceneError, match="frequency"):
        GroundPath(1e-10).impedance(frequency)
