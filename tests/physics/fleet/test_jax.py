"""Arrays of JAX in and out of fleets, by DLPack; JAX is not installed with the tests."""

from __future__ import annotations

import numpy as np
import pytest
from fleet_scenes import BODIES, frames, poses

from capsense.errors import ReadoutError, SceneError
from capsense.fleet import Fleet

jax = pytest.importorskip("jax")
NAMES = "capacitance", "delta", "shield_coupling", "jacobian"


@pytest.fixture
def doubles():
    """Lets JAX hold numbers of double precision."""
    before = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", before)


def stepped(device):
    """A fleet, poses and frames, and what they give."""
    if device != "cpu":
        pytest.importorskip("warp")
    rng = np.random.default_rng(1)
    fleet = Fleet("six_patch", BODIES, 4, sensors=2, device=device, budget=32)
    given = poses(rng, 4, 3).astype(np.float32), frames(rng, 4, 2).astype(np.float32)
    reading = fleet.step(*given, jacobian=True)
    truth = {name: np.array(jax.numpy.from_dlpack(getattr(reading, name))) for name in NAMES}
    fleet.step(poses(rng, 4, 3))
    return fleet, given, truth


@pytest.mark.parametrize("device", ["cpu", "warp:cpu"])
def test_arrays_of_jax(doubles, device):
    """Differential: to those of NumPy; also what a compiled function of JAX makes of poses."""
    fleet, given, truth = stepped(device)
    moved = jax.jit(lambda values: values + 0.0)
    reading = fleet.step(*(moved(jax.numpy.asarray(each)) for each in given), jacobian=True)
    for name in NAMES:
        found = jax.numpy.from_dlpack(getattr(reading, name))
        assert isinstance(found, jax.Array)
        np.testing.assert_allclose(
            found, truth[name], rtol=1e-5, atol=1e-6 * np.abs(truth[name]).max()
        )


@pytest.mark.parametrize("device", ["cpu", "warp:cpu"])
def test_chips(doubles, device):
    """Differential: the time as an array of JAX, on Warp."""
    fleet, given, _ = stepped(device)
    codes = []
    for kind in (np.asarray, jax.numpy.asarray):
        fleet.use_readout("fdc1004", seed=2)
        fleet.step(*given, time=0.0)
        time = 0.1 if device == "cpu" else kind([0.1])
        held = fleet.step(*map(kind, given), time=0.1 if kind is np.asarray else time).held
        codes.append(np.array(jax.numpy.from_dlpack(held.code)))
    np.testing.assert_array_equal(*codes)
    assert codes[0].any()


def test_memory_is_shared():
    """Invariant: without a copy in or out on Warp; the next step writes over what JAX has."""
    fleet, given, truth = stepped("warp:cpu")
    seen = jax.numpy.from_dlpack(fleet.step(*map(jax.numpy.asarray, given)).delta)
    kept = jax.numpy.array(seen, copy=True)
    assert seen.unsafe_buffer_pointer() == fleet._warp.delta.ptr
    fleet.step(poses(np.random.default_rng(2), 4, 3))
    np.testing.assert_allclose(kept, truth["delta"], rtol=1e-5, atol=1e-18)


def test_refused(doubles):
    """Errors name the thing and the fix."""
    fleet, given, _ = stepped("warp:cpu")
    with pytest.raises(SceneError, match=r"poses are float64 of shape .*give contiguous float32"):
        fleet.step(jax.numpy.asarray(given[0], float))
    fleet.use_readout("fdc1004")
    with pytest.raises(ReadoutError, match=r"time is float32 of shape \(1,\); give float64"):
        fleet.step(given[0], time=jax.numpy.asarray([0.1], "float32"))
