"""Bodies that are pressed into a cover: the plate formula, forces, relaxation, derivatives."""

from __future__ import annotations

import numpy as np
import pytest
import tiny_field
from approximate import approx
from covered_discs import EPS, covered_discs
from covered_discs import MODULUS as E
from covered_discs import THICKNESS as T

import capsense as cs
from capsense.constants import EPS0
from capsense.cover import Cover, StressStrain, Viscosity
from capsense.field.cache import load_or_build


@pytest.fixture(scope="module")
def made(field_cache):
    """``made(design)``: a simulator on a rough field."""

    def make(chosen: cs.Design) -> cs.Simulator:
        with tiny_field.few_sources():
            field = load_or_build(chosen, tiny_field.SETTINGS, cache_dir=field_cache)
        return cs.Simulator(chosen, background=field)

    return make


@pytest.fixture(scope="module")
def sim(made):
    return made(covered_discs())


def like(sim: cs.Simulator, **keys: object) -> cs.Simulator:
    """One with a cover of other mechanics, which has the same field."""
    return cs.Simulator(covered_discs(**keys), background=sim.background)


def plate(depth: float, **keys: object) -> cs.Scene:
    """A plate that covers both discs, pressed in by a depth [m]."""
    pose = cs.Pose((0.0, 0.0, T + 0.005 - depth))
    return cs.Scene([cs.Body(cs.Box((0.03, 0.02, 0.01)), pose, **keys)])


def ball(depth: float, x: float = -4e-3, radius: float = 0.01, **keys: object) -> cs.Scene:
    return cs.Scene([cs.Body(cs.Sphere(radius), cs.Pose((x, 0.0, T + radius - depth)), **keys)])


def test_plate_formula(sim):
    """Analytic: what compression adds is that of a plate capacitor, and the rest stays."""
    touch, pressed = sim.step(plate(0.0)).delta, sim.step(plate(1e-3)).delta
    wanted = EPS0 * EPS * np.pi * 9e-6 * (1 / 1e-3 - 1 / 2e-3)
    change = pressed - touch
    np.testing.assert_allclose(np.diag(change), wanted, rtol=0.03)
    assert abs(change[0, 1]) < 0.05 * wanted


def test_force_of_a_plate(sim):
    """Analytic: pressure E strain over the plate, and over each disc."""
    touch = sim.step(plate(0.5e-3)).touch
    assert touch.total == approx(E * 0.25 * 6e-4, rel=1e-3)
    np.testing.assert_allclose(touch.force, E * 0.25 * np.pi * 9e-6, rtol=0.03)
    np.testing.assert_allclose(touch.compression, 0.5e-3, rtol=1e-3)


def test_force_of_a_ball(sim):
    """Analytic: E / t times the volume of the cap below the face."""
    touch = sim.step(ball(0.5e-3)).touch
    cap = np.pi * 0.5e-3**2 * (0.01 - 0.5e-3 / 3)
    assert touch.total == approx(E / T * cap, rel=0.03)
    assert touch.force[0] > 0.5 * touch.total
    assert touch.compression[0] == approx(0.5e-3, rel=0.02)


@pytest.mark.parametrize("shape", [plate, ball])
def test_a_force_is_a_depth(sim, shape):
    """Invariant: a body that a force holds reads as one that overlaps as far, from any height."""
    deep = sim.step(shape(0.6e-3))
    for depth in (0.0, -0.01, 1e-3):
        held = sim.step(shape(depth, force=deep.touch.total))
        np.testing.assert_allclose(held.delta, deep.delta, rtol=0.01)
        assert held.touch.total == approx(deep.touch.total, rel=1e-3)


def test_no_force_is_no_overlap(sim):
    """Limits: a force of 0 puts a body onto the face; one in the air stays where it is."""
    held, touching = sim.step(ball(0.4e-3, force=0.0)), sim.step(ball(0.0))
    np.testing.assert_allclose(held.delta, touching.delta, rtol=0.01)
    assert held.touch.total < 1e-6
    np.testing.assert_array_equal(
        sim.step(ball(-3e-3, force=0.0)).delta, sim.step(ball(-3e-3)).delta
    )


def test_readings_rise_until_the_cover_is_full(sim):
    """Monotonicity: from far away to full compression, then constant."""
    depths = [-0.15, -0.05, -0.01, -2e-3, -3e-4, -1e-5, 0.0, 1e-5, 3e-4, 1e-3, 1.5e-3, 1.9e-3]
    own = [sim.step(ball(depth)).delta[0, 0] for depth in depths]
    assert (np.diff(own) > 0.0).all()
    full = [sim.step(ball(depth)).delta[0, 0] for depth in (0.95 * T, 1.2 * T, 2.0 * T)]
    np.testing.assert_allclose(full, full[0], rtol=1e-6)
    assert full[0] > own[-2]


def test_a_rigid_layer_is_not_compressed(made):
    """Limits: the same layer without a modulus reads as in touch, however far a body overlaps."""
    plain = covered_discs()
    rigid = cs.Design(plain.name, plain.domain, plain.electrodes, plain.layers, build=plain.build)
    assert covered_discs(modulus=1e6).content_hash() == plain.content_hash() != rigid.content_hash()
    sim = made(rigid)
    deep = sim.step(ball(1e-3))
    np.testing.assert_allclose(deep.delta, sim.step(ball(0.0)).delta, rtol=1e-3)
    assert deep.touch is None


def test_floating_bodies_couple_the_electrodes(sim):
    """Network: a floating plate pressed onto two equal discs is their series capacitance."""
    touch, deep = (sim.step(plate(d, grounding="floating")).delta for d in (0.0, 1e-3))
    whole = [sim.step(plate(d)).delta[0, 0] for d in (0.0, 1e-3)]
    assert deep[0, 1] < touch[0, 1] < 0.0
    assert deep[0, 0] < whole[1]
    assert -deep[0, 1] < 0.5 * whole[1]


@pytest.mark.parametrize("held", [False, True])
def test_jacobian(sim, held):
    """Differential: central differences of the step, by overlap and by force."""
    force = sim.step(ball(0.5e-3, x=-2e-3)).touch.total if held else None
    scene = ball(0.5e-3, x=-2e-3, force=force)
    slope = sim.step(scene, jacobian=True).jacobian[0]
    for axis in range(3):
        step = np.eye(3)[axis] * 2e-6
        ends = []
        for sign in (1, -1):
            body = scene[0]
            at = cs.Pose(np.array(body.pose.position) + sign * step)
            ends.append(sim.step(cs.Scene([body.moved(at)])).delta)
        found = (ends[0] - ends[1]) / 4e-6
        np.testing.assert_allclose(slope[..., axis], found, atol=0.02 * np.abs(found).max() + 1e-12)
    if held:
        np.testing.assert_array_equal(slope[..., 2], 0.0)


def test_batches_read_the_same(sim):
    """Differential: one by one."""
    scenes = [ball(0.5e-3), plate(1e-3, force=2.0)]
    for one, reading in zip(scenes, sim.step_batch(scenes), strict=True):
        alone = sim.step(one)
        np.testing.assert_array_equal(reading.delta, alone.delta)
        np.testing.assert_array_equal(reading.touch.force, alone.touch.force)


@pytest.fixture(scope="module")
def skin(made):
    return made(covered_discs(top="ground"))


def test_a_grounded_fabric_shows_pressure_alone(skin):
    """Analytic: nothing in front is seen; pressed flat, the cover is a plate capacitor."""
    near = skin.step(plate(-1e-3))
    assert np.abs(near.delta).max() < 1e-3 * near.capacitance[0, 0]
    for material in ("steel", "wood"):
        change = np.diag(skin.step(plate(1e-3, material=material)).delta)
        wanted = EPS0 * EPS * np.pi * 9e-6 * (1 / 1e-3 - 1 / 2e-3)
        np.testing.assert_allclose(change, wanted, rtol=0.02)


def test_a_stiff_fabric_carries_compression_on(skin):
    """Monotonicity: with a bending length, the neighbour is compressed as well."""
    stiff = like(skin, top="ground", bending_length=3e-3)
    plain, wide = (np.diag(s.step(ball(1e-3)).delta) for s in (skin, stiff))
    assert abs(plain[1]) < 0.01 * plain[0]
    assert wide[0] > plain[0]
    assert 0.0 < wide[1] < 0.5 * wide[0]


def test_a_floating_fabric_couples_the_electrodes(made):
    """Network: pressed flat it comes nearer to both, and couples them."""
    sim = made(covered_discs(top="floating"))
    touch, deep = (sim.step(plate(d, grounding="floating")).delta for d in (0.0, 1e-3))
    assert deep[0, 0] > touch[0, 0] + 1e-14
    assert deep[0, 1] < touch[0, 1] - 1e-14


def test_relaxation(sim):
    """Analytic: held at a depth, a share of the force goes; held by a force, the cover creeps."""
    sim = like(sim, relaxation=[[0.3, 0.05]])
    first = sim.step(ball(0.5e-3), time=0.0).touch.total
    half = sim.step(ball(0.5e-3), time=0.05).touch.total
    last = sim.step(ball(0.5e-3), time=2.0).touch.total
    assert half / first == approx(1.0 - 0.3 * (1.0 - np.exp(-1.0)), rel=1e-6)
    assert last / first == approx(0.7, rel=1e-6)
    sim.reset()
    deep = [sim.step(ball(0.0, force=first), time=t) for t in (0.0, 0.05, 2.0)]
    own = [r.delta[0, 0] for r in deep]
    assert own[0] < own[1] < own[2]
    np.testing.assert_allclose([r.touch.total for r in deep], first, rtol=1e-6)


def test_viscosity_is_linear_and_its_inverse_is_one():
    """Differential: small steps of the convolution; elastic() undoes force()."""
    box = np.zeros(3), np.array([0.01, 0.01, T])
    cover = Cover("foam", EPS, *box, StressStrain.linear(E), ((0.2, 0.1), (0.3, 1.0)), 0.25)
    state, twin = Viscosity(cover), Viscosity(cover)
    rng = np.random.default_rng(3)
    time = 0.0
    for force in rng.uniform(0.1, 5.0, 40):
        wanted = state.elastic(force, time)
        assert state.force(wanted, time) == approx(force, rel=1e-9)
        twin.force(wanted, time)
        time += rng.uniform(0.01, 0.5)
    plain = Viscosity(Cover("foam", EPS, *box, StressStrain.linear(E), ((0.4, 0.1),)))
    times = np.arange(4001) * 1e-4
    ramp = [plain.force(t, t) for t in times]  # of unit rate
    wanted = 0.6 * times + 0.4 * 0.1 * (1.0 - np.exp(-times / 0.1))
    np.testing.assert_allclose(ramp, wanted, atol=1e-6)


def test_hysteresis(sim):
    """Monotonicity: under the same force, a cover that is unloaded is compressed more."""
    sim = like(sim, hysteresis=0.4)
    forces = [0.0, 0.1, 0.3, 0.5, 0.3, 0.1, 0.0]
    found = [sim.step(ball(0.0, force=f), time=0.1 * k).delta[0, 0] for k, f in enumerate(forces)]
    assert found[4] > 1.02 * found[2]
    assert found[5] > 1.02 * found[1]
    assert found[6] == approx(found[0], rel=1e-3)


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({"modulus": -1.0}, "modulus"),
        ({"stress_strain": [[0.1, 0.0], [0.5, 5.0]]}, "ascend strictly"),
        ({"relaxation": [[1.2, 0.1]]}, "share between 0 and 1"),
        ({"relaxation": [[0.6, 0.1], [0.5, 1.0]]}, "less than 1"),
        ({"top": "copper"}, "top"),
        ({"bending_length": 1e-3}, "fabric"),
        ({"centre": [0, 0]}, "centre"),
        ({"thickness": 0.3}, "foam"),
    ],
)
def test_wrong_covers_are_refused(keys, says):
    with pytest.raises(cs.DesignError, match=says):
        covered_discs(**keys)


@pytest.mark.parametrize("force", [-1.0, np.nan, np.inf, "hard"])
def test_wrong_forces_are_refused(force):
    with pytest.raises(cs.SceneError, match="force"):
        cs.Body(cs.Sphere(0.01), force=force)
