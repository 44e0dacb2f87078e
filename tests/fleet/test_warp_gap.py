"""The gap law on Warp: bodies in the first millimetres, against twins with the same functions."""

from __future__ import annotations

import numpy as np
import pytest
import tiny_field
from cluster_twin import same_functions, twin_of
from near_scenes import fleet_of, near_scenes
from scipy.spatial.transform import Rotation
from test_fleet import frames, scene

import capsense as cs
from capsense.field.cache import load_or_build
from capsense.fleet import Fleet

pytest.importorskip("warp")
GROUNDINGS = "grounded", "floating", 100e-12
COVER = [{"name": "cover", "eps_r": 3.0, "size": [0.07, 0.03], "z": [0.0, 0.0006]}]


@pytest.fixture(scope="module")
def covered(field_cache):
    """Two small pads under a cover, and a field of few sources."""
    design = tiny_field.tiny_design(layer=COVER)
    with tiny_field.few_sources():
        return design, load_or_build(design, tiny_field.SETTINGS, cache_dir=field_cache)


@pytest.fixture(params=["six_patch", "patch", "covered"])  # the second has pours between pads
def design(request, covered, monkeypatch):
    """A design, whose field is at hand."""
    if request.param != "covered":
        return request.param
    found, field = covered
    for module in ("capsense.fleet", "capsense.simulator"):
        monkeypatch.setattr(f"{module}.load_or_build", lambda *a, **b: field)
    return found


def misses(fleet, poses, bodies, sensors=None):
    """Largest differences of readings to a simulator with the same functions, over each one's
    largest entry, (e, s); and of errors."""
    reading = fleet.step(poses, sensors)
    delta, error = reading.delta.numpy().copy(), reading.error.numpy().copy()
    taken = fleet._warp.cut.number.numpy().reshape(fleet.places, 64, -1)
    twin, out = twin_of(fleet), np.zeros((2, *delta.shape[:2]))
    world = np.array([0.0] * 6 + [1.0])
    with same_functions(64) as favoured:
        for e, s in np.ndindex(delta.shape[:2]):
            seen = [b for b in range(fleet.places) if not fleet.table.bodies.hidden[s, b]]
            favoured[:] = [taken[b, 1:, e * fleet.sensors + s] for b in seen]
            there = [fleet.table.given[e, b] for b in seen]
            frame = world if sensors is None else sensors[e, s]
            truth = twin.step(scene(there, poses[e, seen], frame))
            largest = np.abs(truth.delta).max()
            out[0, e, s] = np.abs(delta[e, s] - truth.delta).max() / largest
            out[1, e, s] = abs(error[e, s] - truth.stats.solver_error) / largest
    return out


@pytest.mark.parametrize("grounding", GROUNDINGS)
def test_near_bodies(design, grounding):
    """Differential: primitives and a mesh at 0.05 to 5 mm; measured 3e-6 to 3e-5, and at 5 to 12 mm
    1e-6."""
    some = Fleet(design, [cs.Body(cs.Sphere(0.01))], 1)
    scenes = near_scenes(some, 12, (5e-5, 5e-3), grounding, seed=4)
    fleet = fleet_of(design, scenes, device="warp:cpu")
    found = misses(fleet, scenes.poses, scenes.bodies)
    assert fleet._warp.near.count.numpy().sum() >= 6
    assert found[0].max() < 5e-5, scenes.names[int(found[0].argmax())]
    assert found[1].max() < 1e-4
