"""Materials: the table against its sources, the conductor rule, look-up, refusals."""

import numpy as np
import pytest

from capsense.constants import EPS0
from capsense.errors import SceneError
from capsense.scene import MATERIALS, Material, material

# Gabriel 1996, four-term Cole-Cole: eps_inf, sigma_ion [S/m], then step, tau [s], alpha per term.
GABRIEL = {
    "skin": (4, 0, 32, 7.234e-12, 0, 1100, 32.481e-9, 0.2),
    "wet skin": (
        *(4, 0, 39, 7.958e-12, 0.1, 280, 79.577e-9, 0),
        *(3e4, 1.592e-6, 0.16, 3e4, 1.592e-3, 0.2),
    ),
    "muscle": (
        *(4, 0.2, 50, 7.234e-12, 0.1, 7000, 353.678e-9, 0.1),
        *(1.2e6, 318.310e-6, 0.1, 2.5e7, 2.274e-3, 0),
    ),
    "fat": (
        *(2.5, 0.035, 9, 7.958e-12, 0.2, 35, 15.915e-9, 0.1),
        *(3.3e4, 159.155e-6, 0.05, 1e7, 15.915e-3, 0.01),
    ),
    "blood": (4, 0.7, 56, 8.377e-12, 0.1, 5200, 132.629e-9, 0.1),
}


@pytest.mark.parametrize("name", GABRIEL)
def test_tissues_follow_the_cole_cole_model(name):
    """Analytic: the stored value is the model's at 250 kHz, to its last digit."""
    eps_inf, sigma, *terms = GABRIEL[name]
    omega = 2 * np.pi * 250e3
    eps = eps_inf + sigma / (1j * omega * EPS0)
    for step, tau, alpha in zip(terms[0::3], terms[1::3], terms[2::3], strict=True):
        eps += step / (1 + (1j * omega * tau) ** (1 - alpha))
    found = material(name)
    assert found.eps_r == pytest.approx(eps.real, rel=2e-3)
    assert found.sigma == pytest.approx(-eps.imag * omega * EPS0, rel=5e-3)


def test_what_conducts():
    conductors = {name for name, m in MATERIALS.items() if m.is_conductor()}
    assert conductors == {
        *("steel", "stainless steel", "copper", "aluminium", "water"),
        *("skin", "wet skin", "muscle", "fat", "blood", "human"),
    }
    assert material("human").is_conductor(1e6)
    assert not material("fat").is_conductor(1e6)


def test_conductor_rule_is_a_magnitude():
    """Analytic: on the threshold, by displacement current and by conduction current."""
    omega_eps = 2 * np.pi * 1e6 * EPS0
    assert Material("a", 1000.0).is_conductor(1e6)
    assert not Material("a", 999.0).is_conductor(1e6)
    assert Material("a", 600.0, 801 * omega_eps).is_conductor(1e6)
    assert not Material("a", 600.0, 799 * omega_eps).is_conductor(1e6)
    assert Material("a", 2.0, omega_eps).complex_permittivity(1e6) == pytest.approx(2 - 1j)


def test_every_material_names_its_source():
    assert all(m.source and name == m.name for name, m in MATERIALS.items())


@pytest.mark.parametrize("name", ["FR4", "fr4", "Silicone_Rubber", " steel ", "aluminum"])
def test_lookup_is_lenient_on_spelling(name):
    assert material(name) in MATERIALS.values()


def test_unknown_names_list_the_nearest_first():
    with pytest.raises(SceneError, match="nearest first: copper, "):
        material("coper")
    with pytest.raises(SceneError, match="muscle"):
        material("xyz")
    with pytest.raises(SceneError, match="give a name"):
        material(3)


def test_the_table_is_read_only():
    with pytest.raises(TypeError):
        MATERIALS["x"] = Material("x", 2.0)


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (("x", 0.5), "eps_r is 0.5"),
        (("x", float("nan")), "eps_r"),
        (("x", float("inf")), "sigma"),
        (("x", None), "eps_r is None"),
        (("x", 2.0, -1.0), "sigma is -1"),
        (("x", 2.0, float("nan")), "sigma"),
        (("", 2.0), "non-empty"),
    ],
)
def test_bad_materials_are_refused(args, words):
    with pytest.raises(SceneError, match=words):
        Material(*args)


@pytest.mark.parametrize("frequency", [0.0, -1.0, float("nan"), float("inf")])
def test_bad_frequencies_are_refused(frequency):
    with pytest.raises(SceneError, match="frequency"):
        material("steel").is_conductor(frequency)
