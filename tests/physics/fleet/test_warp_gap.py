"""The gap law on Warp: bodies in the first millimetres, against twins with the same functions."""

from __future__ import annotations

import numpy as np
import pytest
import tiny_field
from cluster_twin import same_functions, twin_of
from fleet_scenes import frames, scene
from near_scenes import fleet_of, near_scenes
from scipy.spatial.transform import Rotation

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
    for module in ("capsense.fleet.fleet", "capsense.simulator"):
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


def test_overlap_reads_as_touch():
    """Invariant: bodies that overlap the face are pressed out of it, as far as on the CPU."""
    some = Fleet("six_patch", [cs.Body(cs.Sphere(0.01))], 1)
    scenes = near_scenes(some, 12, (-3e-3, -1e-5), "grounded", seed=7)
    fleet = fleet_of("six_patch", scenes, device="warp:cpu")
    assert misses(fleet, scenes.poses, scenes.bodies)[0].max() < 5e-5
    deeper = scenes.poses.copy()
    deeper[..., 2] -= 1e-3
    one, two = (fleet.step(x).delta.numpy().copy() for x in (scenes.poses, deeper))
    scale = np.abs(one).max(axis=(2, 3), keepdims=True)
    assert (np.abs(two - one) / scale).max() < 5e-4  # a body is found to touch to 0.2 um


def several(count):
    """Five bodies side by side on the design, two of them joined, and one above them all."""
    steel = {"material": "steel"}
    bodies = [
        cs.Body(cs.Box((0.02, 0.02, 0.01)), grounding="floating", **steel),
        cs.Body(cs.Sphere(0.008), grounding=5e-12, **steel),
        cs.Body(cs.Cylinder(0.008, 0.02), grounding="grounded", **steel),
        cs.Body(cs.Capsule(0.006, 0.03), grounding="floating", **steel),
        cs.Body(cs.Ellipsoid((0.01, 0.012, 0.008)), grounding="floating", **steel),
        cs.Body(cs.Sphere(0.02), material="human", grounding=100e-12),
    ]
    rng = np.random.default_rng(6)
    poses = np.zeros((count, 6, 7))
    poses[..., 6] = 1.0
    poses[..., :2] = [
        [-0.07, 0.0],
        [-0.035, 0.03],
        [0.0, 0.0],
        [0.04, 0.0],
        [0.08, 0.02],
        [0.0, 0.0],
    ]
    poses[..., 2] = [0.01, 0.0105, 0.012, 0.0225, 0.0095, 0.07]
    poses[..., 2] += rng.uniform(-1e-3, 1e-3, (count, 6))
    poses[..., :2] += rng.uniform(-5e-3, 5e-3, (count, 6, 2))
    poses[..., 3:6] = 0.05 * rng.normal(size=(count, 6, 3))
    poses[..., 3:] /= np.linalg.norm(poses[..., 3:], axis=-1, keepdims=True)
    return bodies, poses.astype(np.float32).astype(float)


def test_several_near_bodies():
    """Differential: nodes of all kinds at once, two sensors of which one does not see a body."""
    bodies, poses = several(3)
    sensors = frames(np.random.default_rng(3), 3, 2)
    sensors[:, 0, :3], sensors[:, 0, 3:] = 0.0, [0.0, 0.0, 0.0, 1.0]
    sensors[:, 1, :3] *= [1.0, 1.0, 0.2]
    sensors = sensors.astype(np.float32).astype(float)
    fleet = Fleet("six_patch", bodies, 3, sensors=2, device="warp:cpu")
    fleet.hide(1, [3])
    found = misses(fleet, poses, bodies, sensors)
    nodes = (fleet._warp.cut.columns.numpy() - 6).reshape(3, 2)
    assert (nodes[:, 0] >= 3).all()
    assert found[0].max() < 1e-4
    fleet.join([0, 4])
    joined = fleet.step(poses, sensors).delta.numpy().copy()
    finer = Fleet("six_patch", bodies, 3, sensors=2, preset="fine")
    finer.hide(1, [3])
    finer.join([0, 4])
    truth = finer.step(poses, sensors).delta
    scale = np.abs(truth).max(axis=(2, 3), keepdims=True)
    assert (np.abs(joined - truth) / scale).max() < 0.02  # as so few functions are


def test_what_is_far_costs_no_cell():
    """Invariant: of environments where nothing is near, no cell is looked at."""
    bodies = [cs.Body(cs.Box((0.02, 0.02, 0.02)), material="steel", grounding="floating")]
    fleet = Fleet("six_patch", bodies, 3, device="warp:cpu", budget=32)
    poses = np.zeros((3, 1, 7))
    reach = 2.0 * fleet._solver.length * fleet._solver.green.gap.validity
    poses[..., 6], poses[:, 0, 2] = 1.0, [0.0101 + reach, 0.0099 + reach, 0.05]
    near = fleet._warp.near
    near.part.fill_(7.0)
    near.depth.fill_(7.0)
    fleet.step(poses)
    assert near.count.numpy().tolist() == [0, 1, 0]
    assert (fleet._warp.cut.columns.numpy() - 6).tolist() == [0, 1, 0]
    assert (near.part.numpy()[..., [0, 2]] == 7.0).all()
    assert (near.depth.numpy()[..., [0, 2]] == 7.0).all()


def test_check_tells_where_bodies_are_lifted_only():
    """Unit: dielectrics near the design, and more conductors that float than can be nodes."""
    plastic = cs.Body(cs.Sphere(0.01), material=cs.Material("plastic", eps_r=3.0))
    fleet = Fleet("six_patch", [plastic], 3, device="warp:cpu", budget=32)
    fleet.change(0, cs.Body(cs.Sphere(0.01), material="steel"), [2])
    poses = np.zeros((3, 1, 7))
    poses[..., 6], poses[:, 0, 2] = 1.0, [0.011, 0.05, 0.011]
    assert fleet.check(poses).lifted == ((0, 0),)
    fleet = Fleet("six_patch", [plastic], 1)
    assert fleet.check(poses[:1]).lifted == ()  # the CPU adds what the lift takes away
    ball = cs.Body(cs.Sphere(0.004), material="steel", grounding="floating")
    fleet = Fleet("six_patch", [ball] * 9, 1, device="warp:cpu", budget=32)
    poses = np.zeros((1, 9, 7))
    poses[..., 6], poses[..., 2], poses[..., 0] = 1.0, 0.005, 0.02 * np.arange(-4, 5)
    assert fleet.check(poses).lifted == ((0, 0),)
    assert fleet._warp.near.count.numpy()[0] == 8
    fleet.join([0, 1])
    assert fleet.check(poses).lifted == ()


def differences(fleet, poses, place=0, step=8e-6):
    """Central differences of readings by the pose of a body, (e, n, n, 6); and where all are of the
    same clusters, (e,)."""
    out, cuts = [], []
    for r in range(6):
        ends = []
        for sign in (1, -1):
            moved = poses.copy()
            if r < 3:
                moved[:, place, r] += sign * step
            else:
                turn = Rotation.from_rotvec(np.eye(3)[r - 3] * sign * step / 0.015)
                turned = turn * Rotation.from_quat(poses[:, place, 3:])
                moved[:, place, 3:] = turned.as_quat()
            moved = moved.astype(np.float32)
            ends.append((fleet.step(moved).delta.numpy()[:, 0].astype(float), moved))
            cuts.append(np.sort(fleet._warp.cut.number.numpy(), axis=0))
        length = np.full(len(poses), 2.0 * step / 0.015)
        if r < 3:
            length = (ends[0][1] - ends[1][1])[:, place, r].astype(float)
        out.append((ends[0][0] - ends[1][0]) / length[:, None, None])
    return np.stack(out, axis=-1), np.array([c == cuts[0] for c in cuts]).all(axis=(0, 1))


@pytest.mark.parametrize("grounding", ["grounded", "floating"])
def test_gradients_near_contact(grounding):
    """Differential: central differences of readings, at 0.05 to 3 mm; measured 5e-4 (median).

    Where the nearest point of a cell comes to another face or edge, its length steps, which no
    gradient tells: meshes have many of these.
    """
    some = Fleet("six_patch", [cs.Body(cs.Sphere(0.01))], 1)
    scenes = near_scenes(some, 18, (5e-5, 3e-3), grounding, seed=5)
    fleet = fleet_of("six_patch", scenes, device="warp:cpu")
    slope = fleet.step(scenes.poses, jacobian=True).jacobian.numpy()[:, 0, 0].astype(float)
    # a reading that floats is a difference of large numbers, in single precision
    truth, alike = differences(
        fleet, scenes.poses, step=8e-6 if grounding == "grounded" else 1.6e-5
    )
    kinds = np.array([name.split()[0] for name in scenes.names])
    for half, smooth in (
        (slice(3), ["sphere", "capsule", "ellipsoid"]), (slice(3, 6), ["capsule", "ellipsoid"]),
    ):  # fmt: skip
        miss = np.abs(slope - truth)[..., half].max(axis=(1, 2, 3))
        miss /= np.abs(truth)[..., half].max(axis=(1, 2, 3))
        some = alike & np.isin(kinds, smooth)
        assert some.sum() > 3
        assert miss[some].max() < 0.03
        assert np.median(miss[np.isin(kinds, ["box", "cylinder"])]) < 0.045


def test_gradient_of_a_body_that_is_pressed_out():
    """Analytic: pressing a ball deeper changes nothing; else it is as one that touches."""
    ball = cs.Body(cs.Sphere(0.01), material="steel")
    fleet = Fleet("six_patch", [ball], 2, device="warp:cpu")
    poses = np.zeros((2, 1, 7))
    poses[..., 6], poses[:, 0, :3] = 1.0, [[0.004, 0.026, 0.01], [0.004, 0.026, 0.009]]
    slope = fleet.step(poses, jacobian=True).jacobian.numpy()[:, 0, 0].astype(float)
    scale = np.abs(slope[0, ..., :2]).max()
    assert np.abs(slope[1, ..., 2]).max() < 1e-3 * scale
    np.testing.assert_allclose(slope[1, ..., :2], slope[0, ..., :2], rtol=0, atol=2e-2 * scale)


@pytest.mark.parametrize("grounding", ["grounded", "floating"])
def test_bodies_are_pressed_into_a_cover(foam_field, grounding):
    """Differential: overlaps up to past full compression; measured 6e-4, median 1e-6."""
    some = Fleet(foam_field, [cs.Body(cs.Sphere(0.01))], 1)
    scenes = near_scenes(some, 12, (-3e-3, 1e-3), grounding, seed=7)
    fleet = fleet_of(foam_field, scenes, device="warp:cpu")
    found = misses(fleet, scenes.poses, scenes.bodies)
    assert found[0].max() < 1e-3, scenes.names[int(found[0].argmax())]
    assert np.median(found[0]) < 1e-5


@pytest.mark.parametrize("grounding", ["grounded", "floating"])
def test_gradients_in_a_cover(foam_field, grounding):
    """Differential: central differences of readings, up to past full compression; measured 1e-3
    (median) along axes, and 5e-3 about them.

    Of each scene the better of two widths counts: rounding makes the short one wrong, edges that
    come into contact the long one.
    """
    some = Fleet(foam_field, [cs.Body(cs.Sphere(0.01))], 1)
    scenes = near_scenes(some, 18, (-2.5e-3, 0.5e-3), grounding, seed=5)
    fleet = fleet_of(foam_field, scenes, device="warp:cpu")
    slope = fleet.step(scenes.poses, jacobian=True).jacobian.numpy()[:, 0, 0].astype(float)
    tried = [differences(fleet, scenes.poses, step=step) for step in (5e-6, 1e-5)]
    turns = np.array([not name.startswith("sphere") for name in scenes.names])
    for half, which, most in ((slice(3), True, 0.04), (slice(3, 6), turns, 0.3)):
        each = []
        for truth, alike in tried:
            miss = np.abs(slope - truth)[..., half].max(axis=(1, 2, 3))
            miss /= np.abs(truth)[..., half].max(axis=(1, 2, 3))
            each.append(np.where(alike & which, miss, np.inf))
        miss = np.min(each, axis=0)
        miss = miss[np.isfinite(miss)]
        assert len(miss) > 8
        assert miss.max() < most
        assert np.median(miss) < 2e-2
