"""Fleets on Warp, against a twin with the same clusters, and boundary elements."""

from __future__ import annotations

import numpy as np
import pytest
from cluster_twin import same_functions, twin_of
from reference_scenes import DESIGN, diagonal_errors, reference_scenes
from test_fleet import BODIES, frames, poses

import capsense as cs
from capsense.errors import SceneError
from capsense.fleet import Fleet

wp = pytest.importorskip("warp")
PRIMITIVES = cs.Box, cs.Sphere, cs.Capsule, cs.Cylinder, cs.Ellipsoid


@pytest.fixture(scope="module")
def scenes():
    return [s for s in reference_scenes() if all(isinstance(b.shape, PRIMITIVES) for b in s.scene)]


def fleet_of(scenes, budget):
    """A fleet with a scene in each environment, and its poses."""
    most = max(len(s.scene) for s in scenes)
    fleet = Fleet(DESIGN, BODIES[:1] * most, len(scenes), device="warp:cpu", budget=budget)
    where = np.zeros((len(scenes), most, 7))
    where[..., 6] = 1.0
    for place in range(most):
        fleet.change(place, [s.scene[place] if place < len(s.scene) else None for s in scenes])
        for e, s in enumerate(scenes):
            if place < len(s.scene):
                pose = s.scene[place].pose
                where[e, place] = [*pose.position, *pose.quaternion]
    return fleet, where


@pytest.mark.parametrize(
    ("budget", "single", "every"), [(32, 4.0, 8.0), (64, 1.5, 2.5), (128, 0.7, 1.0)]
)
def test_errors_over_the_reference_map(scenes, budget, single, every):
    """Measured: rms of the diagonal [%], of single bodies from 15 mm on, and of all scenes."""
    fleet, where = fleet_of(scenes, budget)
    delta = fleet.step(where).delta.numpy()[:, 0].astype(float)
    errors = np.array(
        [100 * diagonal_errors(d, s.delta) for d, s in zip(delta, scenes, strict=True)]
    )
    far = [len(s.scene) == 1 and s.gap > 0.0149 for s in scenes]
    assert np.sqrt((errors[far] ** 2).mean()) < single
    assert np.sqrt((errors**2).mean()) < every
    np.testing.assert_allclose(delta, delta.transpose(0, 2, 1), rtol=0, atol=1e-18)


def test_twin(scenes):
    """Differential: the same clusters in double precision; where two are equally large against
    their distance either may be split."""
    fleet, where = fleet_of(scenes, 64)
    delta = fleet.step(where).delta.numpy()[:, 0]
    errors, twin = [], twin_of(fleet)
    with same_functions(64):
        for d, s in zip(delta, scenes, strict=True):
            truth = twin.step(s.scene).delta
            errors.append(np.abs(d - truth).max() / np.abs(truth).max())
    assert np.quantile(errors, 0.98) < 1e-4
    assert max(errors) < 2e-3


def test_several_sensors_places_and_matter():
    """Differential: against the compiled core, at the errors of so many clusters."""
    rng = np.random.default_rng(11)
    where, sensors = poses(rng, 5, 3), frames(rng, 5, 2)
    where[..., :3] = [[-0.09, 0.0, 0.06], [0.0, 0.0, 0.07], [0.08, 0.0, 0.06]]  # apart
    where[..., :3] += rng.uniform(-0.01, 0.01, (5, 3, 3))
    one = Fleet("six_patch", BODIES, 5, sensors=2, preset="standard")
    other = Fleet("six_patch", BODIES, 5, sensors=2, device="warp:cpu", budget=128)
    truth, found = one.step(where, sensors), other.step(where, sensors)
    scale = np.abs(truth.delta).max(axis=(2, 3), keepdims=True) + 1e-18
    assert (np.abs(found.delta.numpy() - truth.delta) / scale).max() < 0.02
    np.testing.assert_allclose(
        found.capacitance.numpy(), one.baseline + found.delta.numpy(), rtol=1e-5, atol=1e-17
    )
    assert other.check(where, sensors, samples=3).worst < 0.02


def test_arrays_of_others():
    """Differential: of NumPy, Warp and PyTorch; nothing is left of the last step."""
    fleet = Fleet("six_patch", BODIES, 4, device="warp:cpu", budget=32)
    where = poses(np.random.default_rng(12), 4, 3).astype(np.float32)
    truth = fleet.step(where).delta.numpy().copy()
    fleet.step(poses(np.random.default_rng(13), 4, 3))
    found = fleet.step(wp.array(where, device="cpu")).delta
    np.testing.assert_allclose(found.numpy(), truth, rtol=1e-5)
    torch = pytest.importorskip("torch")
    found = fleet.step(torch.from_numpy(where)).delta
    np.testing.assert_allclose(torch.from_dlpack(found).numpy(), truth, rtol=1e-5)


def test_refused():
    """Errors name the thing, the value and the fix."""
    fleet = Fleet("six_patch", BODIES, 2, device="warp:cpu", budget=32)
    where = poses(np.random.default_rng(14), 2, 3)
    with pytest.raises(SceneError, match=r"of shape \(2, 2, 7\).*of shape \(2, 3, 7\)"):
        fleet.step(wp.array(where[:, :2], dtype=wp.float32, device="cpu"))
    with pytest.raises(ValueError, match="device is 'cuda:77'"):
        Fleet("six_patch", BODIES, 1, device="cuda:77")
    with pytest.raises(ValueError, match="budget is 50"):
        Fleet("six_patch", BODIES, 1, device="warp:cpu", budget=50)


def test_kernels_compile_for_a_gpu(tmp_path):
    """Compiled ahead for compute capability 9.0, which needs no GPU."""
    from capsense.fleet import warp_kernels

    (file,) = wp.compile_aot_module(warp_kernels, arch=90, module_dir=tmp_path)
    assert file.suffix in (".cubin", ".ptx")
    assert file.stat().st_size > 10_000
