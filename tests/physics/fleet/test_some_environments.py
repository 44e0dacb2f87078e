"""Steps of some environments: they are solved, and the others hold what they read last."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fleet_scenes import BODIES, frames, poses

import capsense as cs
from capsense.errors import SceneError

FOAM = Path(__file__).parents[2] / "data" / "foam.toml"
"""A design with a cover 2 mm thick."""
FIELDS = ("capacitance", "delta", "error", "shield_coupling")


def host(values):
    return np.array(values if isinstance(values, np.ndarray) else values.numpy())


def numbers(reading):
    """All numbers of a reading, on the host."""
    out = {name: host(getattr(reading, name)) for name in FIELDS}
    if reading.conductance is not None:
        out["conductance"] = host(reading.conductance)
    if reading.touch is not None:
        touch = reading.touch
        out |= {f"touch {k}": host(x) for k, x in enumerate((touch.force, touch.total))}
    return out


@pytest.mark.parametrize("device", ["cpu", "warp:cpu"])
def test_others_hold_their_last_reading(device):
    """Differential: solved ones against a step of all; the others against the step before."""
    if device != "cpu":
        pytest.importorskip("warp")
    rng = np.random.default_rng(4)
    lossy = cs.Material("wet", 5.0, 1e-5)
    bodies = [*BODIES[1:], cs.Body(cs.Sphere(0.01), material=lossy)]
    fleet = cs.Fleet("six_patch", bodies, 4, sensors=2, device=device, budget=32)
    places, at = [poses(rng, 4, 3) for _ in range(2)], frames(rng, 4, 2)
    first, second = (numbers(fleet.step(each, at)) for each in places)
    due = np.array([False, True, False, True])
    fleet.step(places[0], at)
    for given in (due, np.flatnonzero(due)):
        some = numbers(fleet.step(places[1], at, environments=given))
        assert some.keys() == first.keys()
        for name, values in some.items():
            np.testing.assert_array_equal(values[due], second[name][due], err_msg=name)
            np.testing.assert_array_equal(values[~due], first[name][~due], err_msg=name)
    none = numbers(fleet.step(places[0], at, environments=[]))
    np.testing.assert_array_equal(none["delta"], some["delta"])


@pytest.mark.parametrize("device", ["cpu", "warp:cpu"])
def test_before_the_first_reading_they_are_empty(device):
    """Known values: the baseline, no change, no touch."""
    if device != "cpu":
        pytest.importorskip("warp")
    ball = cs.Body(cs.Sphere(0.01))
    fleet = cs.Fleet(FOAM, [ball], 3, device=device)
    where = np.zeros((3, 1, 7))
    where[..., 2], where[..., 6] = 0.0116, 1.0
    reading = fleet.step(where, environments=[1])
    found = numbers(reading)
    assert found["touch 1"][1, 0] > 0.01
    for e in (0, 2):
        np.testing.assert_allclose(found["capacitance"][e, 0], fleet.baseline, rtol=1e-6)
        for name in ("delta", "error", "touch 0", "touch 1"):
            assert not found[name][e].any(), name
    np.testing.assert_allclose(
        reading.self_capacitance[0, 0], fleet.empty.self_capacitance, rtol=1e-6
    )


def test_a_mask_on_the_device():
    """Differential: against the same mask on the host; arrays of Warp and of PyTorch."""
    wp, torch = pytest.importorskip("warp"), pytest.importorskip("torch")
    fleet = cs.Fleet("patch", [cs.Body(cs.Sphere(0.01))], 3, device="warp:cpu", budget=32)
    where = np.zeros((3, 1, 7))
    where[..., 2], where[..., 6] = 0.03, 1.0
    due = np.array([True, False, True])
    truth = host(fleet.step(where, environments=due).delta)
    assert (truth[[0, 2]] != 0).any(axis=(1, 2, 3)).all()
    assert not truth[1].any()
    for mask in (wp.array(due, dtype=wp.bool, device="cpu"), torch.tensor(due)):
        again = cs.Fleet("patch", [cs.Body(cs.Sphere(0.01))], 3, device="warp:cpu", budget=32)
        np.testing.assert_array_equal(host(again.step(where, environments=mask).delta), truth)
    with pytest.raises(SceneError, match="bool of shape"):
        fleet.step(where, environments=torch.tensor([1, 0, 1]))


@pytest.mark.parametrize("device", ["cpu", "warp:cpu"])
def test_chips_of_others_stand_still(device):
    """Differential: of two that are due in turn, each holds what a fleet of its own does."""
    if device != "cpu":
        pytest.importorskip("warp")
    ball = [cs.Body(cs.Sphere(0.01))]

    def fleet(count):
        out = cs.Fleet("patch", ball, count, device=device, budget=32)
        chip = cs.Readout.preset("ad7147", out.electrode_names, noise=False)
        out.use_readout(cs.Readout(chip.bank, chip.schedule, chip.law, wiring=chip.wiring))
        return out

    both, alone = fleet(2), [fleet(1), fleet(1)]
    where = np.zeros((2, 1, 7))
    where[..., 6] = 1.0
    clocks, before = np.zeros(2), None
    for k in range(6):
        e = k % 2 if k < 4 else 1
        where[e, 0, 2] = 0.02 + 0.002 * k
        clocks[e] += 0.05
        due = np.arange(2) == e
        held = both.step(where, time=clocks, environments=due).held
        truth = alone[e].step(where[e : e + 1], time=clocks[e]).held
        np.testing.assert_array_equal(host(held.code)[e], host(truth.code)[0])
        np.testing.assert_allclose(host(held.age)[e], host(truth.age)[0], rtol=1e-9)
        other = host(held.code)[1 - e], host(held.age)[1 - e]
        if before is not None:
            np.testing.assert_array_equal(other, before[1 - e])
        before = list(zip(host(held.code), host(held.age), strict=True))
    assert host(held.code).all()
    both.reset([0])
    held = both.step(where, time=clocks, environments=[1]).held
    assert not host(held.code)[0].any()
    assert np.isinf(host(held.age)[0]).all()


@pytest.mark.parametrize("device", ["cpu", "warp:cpu"])
def test_chips_of_each_sensor_stand_still(device):
    """Differential: two sensors with readouts of their own, against a fleet of each environment."""
    if device != "cpu":
        pytest.importorskip("warp")

    def fleet(count):
        ball = [cs.Body(cs.Sphere(0.01))]
        out = cs.Fleet("patch", ball, count, sensors=2, device=device, budget=32)
        quiet = cs.Readout.preset("ad7147", out.electrode_names, noise=False)
        bank, law = quiet.bank, quiet.law
        slow = replace(quiet.schedule, idle=quiet.schedule.period)
        out.use_readout([
            cs.Readout(bank, schedule, law, wiring=quiet.wiring)
            for schedule in (quiet.schedule, slow)
        ])  # fmt: skip
        return out

    both, alone = fleet(2), [fleet(1), fleet(1)]
    where = np.zeros((2, 1, 7))
    where[..., 6] = 1.0
    at = np.zeros((2, 2, 7))
    at[..., 6], at[:, 1, 0] = 1.0, 0.01
    clocks, before = np.zeros(2), None
    for k in range(6):
        e = k % 2 if k < 4 else 1
        where[e, 0, 2] = 0.02 + 0.002 * k
        clocks[e] += 0.05
        given = np.where(np.arange(2) == e, clocks, 7.0)  # the clocks of others are not looked at
        held = both.step(where, at, time=given, environments=[e]).held
        truth = alone[e].step(where[e : e + 1], at[e : e + 1], time=clocks[e]).held
        np.testing.assert_array_equal(host(held.code)[e], host(truth.code)[0])
        np.testing.assert_allclose(host(held.age)[e], host(truth.age)[0], rtol=1e-9)
        other = host(held.code)[1 - e], host(held.age)[1 - e]
        if before is not None:
            np.testing.assert_array_equal(other, before[1 - e])
        before = list(zip(host(held.code), host(held.age), strict=True))
    assert host(held.code).all()
    assert (host(held.age)[:, 0] != host(held.age)[:, 1]).any()


def test_refused():
    """Errors name the environments there are."""
    fleet = cs.Fleet("patch", [cs.Body(cs.Sphere(0.01))], 3)
    where = np.zeros((3, 1, 7))
    where[..., 6] = 1.0
    for wrong in ([3], [-1], [True, False], [0.5], "all"):
        with pytest.raises(SceneError, match="numbers from 0 to 2, or a mask of 3"):
            fleet.step(where, environments=wrong)
    with pytest.raises(SceneError, match="a Jacobian is asked for of some environments"):
        fleet.step(where, environments=[1], jacobian=True)
