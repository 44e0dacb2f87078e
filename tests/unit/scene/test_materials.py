"""Materials: the table against its sources, the conductor rule, look-up, refusals."""

import numpy as np
import pytest
from approximate import approx

from capsense.constants import EPS0
from capsense.errors import SceneError
from capsense.scene import MATERIALS, Material, material
from capsense.scene.materials import ColeCole, water

# Gabriel 1996, four-term Cole-Cole: eps_inf, sigma_ion [S/m], then step, tau [s], alpha per term.
GABRIEL = {
    "skin": (4, 2e-4, 32, 7.234e-12, 0, 1100, 32.481e-9, 0.2),
    "wet skin": (
        *(4, 4e-4, 39, 7.958e-12, 0.1, 280, 79.577e-9, 0),
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
    "cortical bone": (
        *(2.5, 0.02, 10, 13.263e-12, 0.2, 180, 79.577e-9, 0.2),
        *(5e3, 159.155e-6, 0.2, 1e5, 15.915e-3, 0),
    ),
    "cancellous bone": (
        *(2.5, 0.07, 18, 13.263e-12, 0.22, 300, 79.577e-9, 0.25),
        *(2e4, 159.155e-6, 0.2, 2e7, 15.915e-3, 0),
    ),
}


def cole_cole(name, frequency):
    """The model written out."""
    eps_inf, sigma, *terms = GABRIEL[name]
    omega = 2 * np.pi * frequency
    eps = eps_inf + sigma / (1j * omega * EPS0)
    for step, tau, alpha in zip(terms[0::3], terms[1::3], terms[2::3], strict=True):
        eps += step / (1 + (1j * omega * tau) ** (1 - alpha))
    return eps


@pytest.mark.parametrize("name", GABRIEL)
def test_tissues_follow_the_cole_cole_model(name):
    """Analytic: the stored value is the model's at 250 kHz, to its last digit."""
    eps = cole_cole(name, 250e3)
    omega = 2 * np.pi * 250e3
    found = material(name)
    assert found.eps_r == approx(eps.real, rel=2e-3)
    assert found.sigma == approx(-eps.imag * omega * EPS0, rel=5e-3)


@pytest.mark.parametrize("name", GABRIEL)
@pytest.mark.parametrize("frequency", [1e4, 1e6, 1e8, 1e9])
def test_tissues_at_other_frequencies(name, frequency):
    """Analytic: permittivity and conductivity of the model, together and apart."""
    eps = cole_cole(name, frequency)
    assert material(name).complex_permittivity(frequency) == approx(eps, rel=1e-12)
    there = material(name).at(frequency)
    assert there.eps_r == approx(eps.real, rel=1e-12)
    assert there.sigma == approx(-eps.imag * 2 * np.pi * frequency * EPS0, rel=1e-12)
    assert there.complex_permittivity(frequency) == approx(eps, rel=1e-12)


def test_dispersion_is_causal():
    """Invariant: permittivity falls and conductivity grows with frequency (relaxations only)."""
    frequencies = np.geomspace(10, 1e11, 200)
    for name in GABRIEL:
        eps = np.array([material(name).complex_permittivity(f) for f in frequencies])
        sigma = -eps.imag * 2 * np.pi * frequencies * EPS0
        assert (np.diff(eps.real) < 0).all()
        assert (np.diff(sigma) > 0).all()


def test_matter_without_dispersion_is_the_same_at_any_frequency():
    assert material("glass").at(1e9) is material("glass")
    assert material("steel").complex_permittivity(1e6).imag == approx(
        -6.99e6 / (2 * np.pi * 1e6 * EPS0)
    )


@pytest.mark.parametrize(
    ("kelvin", "eps_r"), [(0, 87.74), (20, 80.10), (25, 78.30), (50, 69.91), (100, 55.72)]
)
def test_water_against_temperature(kelvin, eps_r):
    """Measured: Malmberg and Maryott 1956, good to 0.05; the series to 0.5 %."""
    assert water(kelvin).eps_r == approx(eps_r, rel=5e-3)


@pytest.mark.parametrize("temperature", [-1.0, 101.0, float("nan")])
def test_water_has_a_range(temperature):
    with pytest.raises(SceneError, match="temperature is"):
        water(temperature)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((0.999, ()), "eps_inf is 0.999"),
        ((float("inf"), ()), "eps_inf is inf"),
        ((2.0, ((-1e-9, 1e-9, 0.0),)), "term"),
        ((2.0, ((1.0, 1e-9, -1e-9),)), "term"),
        ((2.0, ((1.0, float("inf"), 0.0),)), "term"),
        ((2.0, ((float("inf"), 1e-9, 0.0),)), "term"),
        ((2.0, ((-1.0, 1e-9, 0.0),)), "term"),
        ((2.0, ((1.0, 0.0, 0.0),)), "term"),
        ((2.0, ((1.0, 1e-9, 1.0),)), "term"),
        ((2.0, (), -1.0), "sigma is -1"),
        (("two", ()), "eps_inf is 'two'"),
        ((2.0, ((1.0, "fast", 0.0),)), "term"),
    ],
)
def test_bad_dispersions_are_refused(arguments, words):
    with pytest.raises(SceneError, match=words):
        ColeCole(*arguments)


@pytest.mark.parametrize(
    "arguments",
    [(1.0, ()), (1.5, (), 0.0), (2.0, ((0.0, 1e-9, 0.0),)), (2.0, ((1.0, 1e-300, 0.999),))],
)
def test_dispersions_at_the_ends_of_their_ranges(arguments):
    """Analytic: they are taken, and give eps_inf where frequencies are high."""
    assert ColeCole(*arguments).permittivity(1e30).real >= arguments[0]


def test_what_conducts():
    conductors = {name for name, m in MATERIALS.items() if m.is_conductor()}
    assert conductors == {
        *("steel", "stainless steel", "copper", "aluminium", "water"),
        *("skin", "wet skin", "muscle", "fat", "blood", "human"),
        *("cortical bone", "cancellous bone"),
    }
    assert material("human").is_conductor(1e6)
    assert not material("fat").is_conductor(1e6)
    assert not material("cortical bone").is_conductor(1e6)


def test_conductor_rule_is_a_magnitude():
    """Analytic: on the threshold, by displacement current and by conduction current."""
    omega_eps = 2 * np.pi * 1e6 * EPS0
    assert Material("a", 1000.0).is_conductor(1e6)
    assert not Material("a", 999.0).is_conductor(1e6)
    assert Material("a", 600.0, 801 * omega_eps).is_conductor(1e6)
    assert not Material("a", 600.0, 799 * omega_eps).is_conductor(1e6)
    assert Material("a", 2.0, omega_eps).complex_permittivity(1e6) == approx(2 - 1j)


def test_every_material_names_its_source():
    assert all(m.source and name == m.name for name, m in MATERIALS.items())


@pytest.mark.parametrize("name", ["FR4", "fr4", "Silicone_Rubber", " steel ", "aluminum"])
def test_lookup_is_lenient_on_spelling(name):
    assert material(name) in MATERIALS.values()


def test_unknown_names_list_the_nearest_first():
    with pytest.raises(SceneError, match=r"did you mean .copper.\? valid are air, "):
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
@pytest.mark.parametrize("name", ["steel", "muscle"])
def test_bad_frequencies_are_refused(name, frequency):
    with pytest.raises(SceneError, match="frequency"):
        material(name).is_conductor(frequency)
    with pytest.raises(SceneError, match="frequency"):
        material(name).at(frequency)
