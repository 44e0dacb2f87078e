"""What bodies and designs may be made of on Warp and on the CPU, against ``Simulator.step``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from approximate import approx
from cluster_twin import same_functions, twin_of
from fleet_scenes import frames, poses, scene

import capsense as cs
from capsense.constants import UNIT
from capsense.design import Role, load_design
from capsense.design.model import Conductor
from capsense.errors import SceneError
from capsense.field.cache import default_settings, load_or_build
from capsense.fleet import Fleet

pytest.importorskip("warp")
COUNT = 4
LOSSY = [
    cs.Body(cs.Sphere(0.02), material="water", grounding="floating"),
    cs.Body(cs.Capsule(0.01, 0.05), material="fat"),
    cs.Body(cs.Box((0.05, 0.03, 0.02)), material="steel", grounding=10e-12),
]


def as_numpy(values):
    return values.copy() if isinstance(values, np.ndarray) else values.numpy().copy()


def apart(rng, count=COUNT):
    """Poses of three bodies that do not meet."""
    where = poses(rng, count, 3)
    where[..., :3] = [[-0.09, 0.0, 0.06], [0.0, 0.0, 0.07], [0.08, 0.0, 0.06]]
    where[..., :3] += rng.uniform(-0.01, 0.01, (count, 3, 3))
    return where


def against_twin(fleet, bodies, where, sensors):
    """Largest differences of delta, conductance and error to a simulator with the same functions.

    Each is over the largest of its kind. Errors are compared where nothing is out of reach: where
    something is, functions on Warp share charge otherwise, see ``warp_cut.weigh``.
    """
    reading = fleet.step(where, sensors)
    worst = np.zeros(3)
    twin = twin_of(fleet)
    with same_functions(64):
        for e, s in np.ndindex(sensors.shape[:2]):
            truth = twin.step(scene(bodies, where[e], sensors[e, s]))
            loss = np.zeros((1, 1)) if truth.conductance is None else truth.conductance
            walled = fleet._warp.cut.walled.numpy()[e * sensors.shape[1] + s]
            for k, (found, wanted) in enumerate(
                (
                    (reading.delta, truth.delta), (reading.conductance, loss),
                    (reading.error, truth.stats.solver_error),
                )
            ):  # fmt: skip
                largest = max(np.abs(wanted).max(), 1e-30)
                miss = np.abs(found.numpy()[e, s] - wanted).max() / largest
                if k == 2 and walled:
                    continue
                worst[k] = max(worst[k], miss)
    return worst


def test_lossy_matter_on_warp():
    """Differential: water, fat and a conductor on a capacitance, in phase and in quadrature."""
    rng = np.random.default_rng(1)
    where, sensors = apart(rng), frames(rng, COUNT, 2)
    fleet = Fleet("six_patch", LOSSY, COUNT, sensors=2, device="warp:cpu", budget=64)
    assert (against_twin(fleet, LOSSY, where, sensors) < [1e-4, 1e-4, 1e-3]).all()


def test_lossy_matter_on_the_cpu():
    """Differential: against simulators, where some environments have losses and some have not."""
    rng = np.random.default_rng(2)
    where, sensors = apart(rng), frames(rng, COUNT, 2)
    fleet = Fleet("six_patch", LOSSY, COUNT, sensors=2)
    lossless = [cs.Body(b.shape, material="steel") for b in LOSSY]
    for place, body in enumerate(lossless):
        fleet.change(place, body, [1])
    reading = fleet.step(where, sensors)
    simulator = cs.Simulator("six_patch")
    for e, s in np.ndindex(COUNT, 2):
        bodies = lossless if e == 1 else LOSSY
        truth = simulator.step(scene(bodies, where[e], sensors[e, s]))
        wanted = np.zeros((6, 6)) if truth.conductance is None else truth.conductance
        np.testing.assert_allclose(
            reading.delta[e, s], truth.delta, rtol=0, atol=1e-5 * np.abs(truth.delta).max()
        )
        np.testing.assert_allclose(
            reading.conductance[e, s], wanted, rtol=0, atol=1e-5 * np.abs(wanted).max()
        )
        assert reading.error[e, s] == approx(truth.stats.solver_error, rel=1e-3)
    with pytest.raises(SceneError, match="lossy matter"):
        fleet.step(where, sensors, jacobian=True)


def test_floating_conductors_of_the_design(monkeypatch):
    """Differential: the last electrode of a design is cut off and floats, a field beside it."""
    whole = load_design("six_patch")
    field = load_or_build(whole, default_settings(whole))
    for module in ("capsense.fleet.fleet", "capsense.simulator"):
        monkeypatch.setattr(f"{module}.load_or_build", lambda *a, **b: field)
    *kept, loose = whole.electrodes
    conductor = Conductor(loose.name, Role.FLOATING, loose.surface)
    # floating conductors come last, as the electrode did, and shields before them
    assert all(c.role == Role.GROUND for c in whole.conductors)
    design = replace(whole, electrodes=tuple(kept), conductors=(*whole.conductors, conductor))
    rng = np.random.default_rng(5)
    where, sensors = apart(rng), frames(rng, COUNT, 2)
    fleet = Fleet(design, LOSSY, COUNT, sensors=2, device="warp:cpu", budget=64)
    assert (against_twin(fleet, LOSSY, where, sensors) < [1e-4, 1e-4, 1e-3]).all()
    assert fleet.step(where, sensors).delta.shape == (COUNT, 2, 5, 5)


TIES = {"floating": ("floating",) * 3, "tied": ("floating", 10e-12, 20e-12),
        "grounded": ("floating", "grounded", 20e-12)}  # fmt: skip


@pytest.mark.parametrize("kind", TIES)
@pytest.mark.parametrize("device", ["cpu", "warp:cpu"])
def test_joined_conductors(device, kind):
    """Differential: two balls that a rod touches, which a simulator finds by itself."""
    shapes = cs.Sphere(0.02), cs.Sphere(0.02), cs.Capsule(0.01, 0.06)
    bodies = [
        cs.Body(shape, material="steel", grounding=tie)
        for shape, tie in zip(shapes, TIES[kind], strict=True)
    ]
    where = np.zeros((COUNT, 3, 7))
    where[..., 6] = 1.0
    where[:, 2, 3:] = [0, 0.5**0.5, 0, 0.5**0.5]
    where[:, :2, 0] = [-0.055, 0.055]
    where[..., 2] = np.linspace(0.045, 0.1, COUNT)[:, None]
    sensors = frames(np.random.default_rng(3), COUNT, 1)
    fleet = Fleet("six_patch", bodies, COUNT, device=device)
    alone = as_numpy(fleet.step(where, sensors).delta)
    fleet.join([0, 2])
    fleet.join([1, 2])
    if device == "cpu":
        found = fleet.step(where, sensors).delta
        simulator = cs.Simulator("six_patch")
        for e in range(COUNT):
            truth = simulator.step(scene(bodies, where[e], sensors[e, 0])).delta
            assert np.abs(found[e, 0] - truth).max() < 1e-5 * np.abs(truth).max()
    else:
        found = fleet.step(where, sensors).delta.numpy()
        worst = against_twin(fleet, bodies, where, sensors)
        assert worst[0] < 1e-4
        assert worst[2] < 1e-3
    assert (np.abs(found - alone) / np.abs(found)).max() > 0.02


def test_joined_places_that_are_out_of_sight_tie_the_rest():
    """Analytic: of three balls on one wire two are far away; they tie the third by 4 pi eps0 R."""
    bodies = [cs.Body(cs.Sphere(0.02), material="steel", grounding="floating")] * 3
    where = np.zeros((1, 3, 7))
    where[..., 6] = 1.0
    where[0, :, 2] = [50.0, 0.06, 60.0]
    for device in ("cpu", "warp:cpu"):
        fleet = Fleet("six_patch", bodies, 1, device=device)
        alone = as_numpy(fleet.step(where).delta)
        fleet.join([0, 1, 2])
        joined = as_numpy(fleet.step(where).delta)
        tied = cs.Body(bodies[0].shape, material="steel", grounding=2 * UNIT * 0.02)
        one = Fleet("six_patch", [tied], 1, device=device)
        wanted = as_numpy(one.step(where[:, 1:2]).delta)
        np.testing.assert_allclose(joined, wanted, rtol=3e-3, atol=0)
        assert np.abs(joined - alone).max() > 0.1 * np.abs(alone).max()


def test_only_conductors_are_joined():
    """Errors name the thing."""
    fleet = Fleet("six_patch", LOSSY, 1)
    with pytest.raises(SceneError, match="'water' stands in a place that is joined"):
        fleet.join([0, 2])
    with pytest.raises(SceneError, match="3 is none of the places 0 to 2"):
        fleet.join([2, 3])
    fleet.change(0, cs.Body(cs.Sphere(0.02)))
    fleet.join([0, 2])
    with pytest.raises(SceneError, match="'fat' stands in a place that is joined"):
        fleet.change(0, LOSSY[1])
