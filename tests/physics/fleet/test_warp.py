"""Fleets on Warp, against a twin with the same clusters, and boundary elements."""

from __future__ import annotations

import copy
import importlib
import pickle
import re
import warnings

import numpy as np
import pytest
from approximate import approx
from cluster_twin import same_functions, twin_of
from fleet_scenes import BODIES, LONG, frames, long_poses, poses, scene
from reference_scenes import diagonal_errors, fleet_of, reference_scenes

import capsense as cs
from capsense.errors import SceneError
from capsense.fleet import Fleet
from capsense.readout.randomisation import Distribution, ReadoutRandomisation

wp = pytest.importorskip("warp")
PRIMITIVES = cs.Box, cs.Sphere, cs.Capsule, cs.Cylinder, cs.Ellipsoid


@pytest.fixture(scope="module")
def scenes():
    return [s for s in reference_scenes() if all(isinstance(b.shape, PRIMITIVES) for b in s.scene)]


@pytest.fixture(scope="module")
def simulator():
    return cs.Simulator("six_patch_bare", preset="fine")


@pytest.mark.parametrize(
    ("budget", "single", "every", "close"),
    [
        (32, 1.4, 3.2, 57),
        (64, 0.5, 1.2, 80),
        pytest.param(128, 0.35, 0.45, 87, marks=pytest.mark.e2e),
    ],
)
def test_errors_over_the_reference_map(scenes, simulator, budget, single, every, close):
    """Measured: rms of the diagonal [%], of single bodies from 15 mm on, and of all scenes; how
    many of these are within 1 % of ``Simulator.step``, fine; and estimates over the errors."""
    fleet, where = fleet_of(scenes, device="warp:cpu", budget=budget)
    reading = fleet.step(where)
    delta = reading.delta.numpy()[:, 0].astype(float)
    errors = np.array(
        [100 * diagonal_errors(d, s.delta) for d, s in zip(delta, scenes, strict=True)]
    )
    far = [len(s.scene) == 1 and s.gap > 0.0149 for s in scenes]
    assert np.sqrt((errors[far] ** 2).mean()) < single
    assert np.sqrt((errors**2).mean()) < every
    off = np.array(
        [
            np.abs(d - simulator.step(s.scene).delta).max()
            for d, s in zip(delta, scenes, strict=True)
        ]
    )
    assert (off < 0.01 * np.abs(delta).max(axis=(1, 2))).sum() >= close
    estimate = reading.error.numpy()[:, 0]
    bad = off > 0.02 * np.abs(delta).max(axis=(1, 2))
    assert 0.5 < np.median(estimate[bad] / off[bad]) < 5.0 if bad.any() else budget == 128
    np.testing.assert_allclose(delta, delta.transpose(0, 2, 1), rtol=0, atol=1e-18)


def test_twin(scenes):
    """Differential: the same clusters in double precision. Of two that are equally large against
    their distance, as in symmetric bodies, rounding decides: the twin then follows."""
    fleet, where = fleet_of(scenes, device="warp:cpu")
    reading, twin = fleet.step(where), twin_of(fleet)
    delta, error = reading.delta.numpy()[:, 0], reading.error.numpy()[:, 0]
    taken = fleet._warp.cut.number.numpy().reshape(fleet.places, 64, -1)
    with same_functions(64) as favoured:
        for e, (d, s) in enumerate(zip(delta, scenes, strict=True)):
            favoured[:] = taken[: len(s.scene), 1:, e]
            truth = twin.step(s.scene)
            largest = np.abs(truth.delta).max()
            assert np.abs(d - truth.delta).max() < 2e-5 * largest, s.name
            told = truth.stats.solver_error
            assert error[e] == approx(told, rel=1e-3, abs=2e-5 * largest), s.name


def test_wide_bodies_near_contact():
    """Differential: a plate of 150 mm, 0.3 to 2 mm above the electrodes. Its images are bounded."""
    plate = cs.Body(cs.Box((0.15, 0.15, 0.02)), material="steel")
    where = np.zeros((3, 1, 7))
    where[..., 6], where[:, 0, :2] = 1.0, (0.003, 0.026)
    where[:, 0, 2] = [0.0103, 0.011, 0.012]
    fleet = Fleet("six_patch_bare", [plate], 3, device="warp:cpu")
    reading, twin = fleet.step(where), twin_of(fleet)
    taken = fleet._warp.cut.number.numpy().reshape(1, 64, -1)
    with same_functions(64) as favoured:
        for e in range(3):
            favoured[:] = taken[:, 1:, e]
            truth = twin.step(cs.Scene([plate.moved(cs.Pose(where[e, 0, :3]))]))
            largest = np.abs(truth.delta).max()
            assert np.abs(reading.delta.numpy()[e, 0] - truth.delta).max() < 1e-4 * largest
            error = reading.error.numpy()[e, 0]
            assert error == approx(truth.stats.solver_error, rel=1e-3)


def test_long_bodies_are_cut():
    """Differential: bodies that reach far out of the box, and how matrices change with them.

    The charge on clusters beyond a wall costs so much energy that it hides what is in reach, in
    single precision, unless functions are chosen for it: that made 5e-3.
    """
    fleet, (where, sensors) = Fleet("six_patch", LONG, 3, device="warp:cpu"), long_poses()
    where[:, 1, 2] += 0.01  # near the design, and not pressed out of it
    found, twin = fleet.step(where, sensors, jacobian=True), twin_of(fleet)
    taken = fleet._warp.cut.number.numpy().reshape(3, 64, -1)
    lifted = fleet._warp.cut.lifted.numpy()[: 3 * 64].reshape(3, 64, -1).any(axis=1)
    assert lifted.any()
    with same_functions(64) as favoured:
        for e in range(3):
            favoured[:] = taken[:, 1:, e]
            truth = twin.step(scene(LONG, where[e], sensors[e, 0]), jacobian=True)
            miss = np.abs(found.delta.numpy()[e, 0] - truth.delta).max()
            assert miss < 2e-5 * np.abs(truth.delta).max()
            slope = found.jacobian.numpy()[e, 0]
            largest = np.abs(truth.jacobian).max()
            for b in range(3):
                bound = 0.02 if b == 1 else 1e-3  # the twin's are differences where it is near
                assert np.abs(slope[b] - truth.jacobian[b]).max() < bound * largest


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
    """Differential: of NumPy and Warp; nothing is left of the last step."""
    fleet = Fleet("six_patch", BODIES, 4, device="warp:cpu", budget=32)
    where = poses(np.random.default_rng(12), 4, 3).astype(np.float32)
    truth = fleet.step(where).delta.numpy().copy()
    fleet.step(poses(np.random.default_rng(13), 4, 3))
    found = fleet.step(wp.array(where, device="cpu")).delta
    np.testing.assert_allclose(found.numpy(), truth, rtol=1e-5)


@pytest.mark.e2e  # which takes seconds to import
def test_arrays_of_pytorch():
    """Differential: to and from it."""
    torch = pytest.importorskip("torch")
    fleet = Fleet("six_patch", BODIES, 4, device="warp:cpu", budget=32)
    where = poses(np.random.default_rng(12), 4, 3).astype(np.float32)
    truth = fleet.step(where).delta.numpy().copy()
    fleet.step(poses(np.random.default_rng(13), 4, 3))
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


def test_a_step_allocates_nothing_and_waits_for_nothing(monkeypatch):
    """Invariant: what a CUDA graph needs, counted on the CPU after a first step.

    No memory is taken, nothing is copied to the host, and kernels find all arrays where the last
    step left them, also after bodies were changed and chips attached.
    """
    fleet = Fleet("six_patch", BODIES, 3, sensors=2, device="warp:cpu", budget=32)
    fleet.use_readout("fdc1004")
    where, frame = (
        wp.array(poses(np.random.default_rng(15), 3, k), dtype=wp.float32, device="cpu")
        for k in (3, 2)
    )
    time = wp.zeros(1, dtype=wp.float64, device="cpu")
    counts = {"allocations": 0, "copies": 0}
    seen: list[list[int]] = [[], []]
    run = 0

    def counted(name, function):
        def call(*args, **options):
            counts[name] += 1
            return function(*args, **options)

        return call

    launch = wp.launch

    def launched(kernel, *args, **options):
        arrays = [x.ptr for x in options["inputs"] if isinstance(x, wp.array)]
        seen[run].extend(arrays)
        return launch(kernel, *args, **options)

    fleet.step(where, frame, time=time, jacobian=True)
    monkeypatch.setattr(wp, "launch", launched)
    allocator = wp.get_device("cpu").get_allocator()
    name = "allocate" if hasattr(allocator, "allocate") else "alloc"  # by Warp's version
    monkeypatch.setattr(allocator, name, counted("allocations", getattr(allocator, name)))
    monkeypatch.setattr(wp.array, "numpy", counted("copies", wp.array.numpy))
    for name in ("synchronize", "synchronize_device", "synchronize_stream"):
        monkeypatch.setattr(wp, name, counted("copies", getattr(wp, name)))
    fleet.step(where, frame, time=time, jacobian=True)
    assert counts == {"allocations": 0, "copies": 0}
    wp.zeros(1, device="cpu").numpy()
    assert min(counts.values()) > 0  # it counts
    places = [
        getattr(fleet._warp.places, x).ptr
        for x in ("choice", "scale", "ground_elastance", "inverse_susceptibility")
    ]
    fleet.change(0, BODIES[1], [1])
    assert places == [
        getattr(fleet._warp.places, x).ptr
        for x in ("choice", "scale", "ground_elastance", "inverse_susceptibility")
    ]
    run = 1
    fleet.step(where, frame, time=time, jacobian=True)
    assert seen[0] == seen[1]
    assert len(seen[0]) > 10


def test_captured_steps():
    """Differential: a graph that is captured once gives what steps give, to the last bit, after
    poses, time and bodies have changed; nothing of a step is left out of it."""
    if not hasattr(wp, "capture_save"):
        pytest.skip("this version of Warp captures on GPUs only")
    rng = np.random.default_rng(16)
    where = wp.array(poses(rng, 3, 3), dtype=wp.float32, device="cpu")
    frame = wp.array(frames(rng, 3, 2), dtype=wp.float32, device="cpu")
    time = wp.zeros(3, dtype=wp.float64, device="cpu")
    scatter = ReadoutRandomisation(gain=Distribution("normal", 1.0, 0.1), jitter=0.01)
    fleet, other = (
        Fleet("six_patch", BODIES, 3, sensors=2, device="warp:cpu", budget=32) for _ in range(2)
    )
    for each in (fleet, other):
        each.use_readout("fdc1004", seed=3, randomisation=scatter)
        each.step(where, frame, time=0.0, jacobian=True)
    with wp.ScopedCapture("cpu") as capture:
        found = fleet.step(where, frame, time=time, jacobian=True)
    for k in (1, 2):
        where.assign(poses(rng, 3, 3).astype(np.float32))
        frame.assign(frames(rng, 3, 2).astype(np.float32))
        clocks = 0.1 * k + np.array([0.0, 0.05, 0.1])
        time.assign(clocks)
        wp.capture_launch(capture.graph)
        truth = other.step(where, frame, time=clocks, jacobian=True)
        assert truth.delta.numpy().any()
        for name in ("capacitance", "delta", "error", "conductance", "shield_coupling", "jacobian"):
            np.testing.assert_array_equal(getattr(found, name), getattr(truth, name))
        for name in ("code", "capacitance", "age"):
            np.testing.assert_array_equal(getattr(found.held, name), getattr(truth.held, name))
        for each in (fleet, other):
            each.change(0, BODIES[1], [1])
            each.reset([2], start=0.1)


@pytest.mark.parametrize("lossy", [False, True])
def test_functions_that_add_nothing_are_left_out(lossy):
    """Analytic: of two functions that are the same, the second one changes nothing."""
    from capsense.fleet import warp_solve
    from capsense.fleet.warp_cut import WarpActiveTree

    whole = np.array([[1.0, 1.0, 0.5], [1.0, 1.0, 0.5], [0.5, 0.5, 2.0]]) + 0j
    whole += lossy * 1j * np.array([[0.4, 0.4, 0.1], [0.4, 0.4, 0.1], [0.1, 0.1, 0.3]])
    phi = np.array([0.7, 0.7, -0.2])
    packed = np.tril(whole.real) + np.triu(whole.imag, 1)
    cut = WarpActiveTree()
    cut.number = wp.zeros((3, 1), dtype=wp.int32, device="cpu")
    cut.lossy = wp.array([int(lossy)], dtype=wp.int32, device="cpu")
    cut.columns = wp.ones(1, dtype=wp.int32, device="cpu")
    matrix, loss, rows, quadrature = (
        wp.array(x, dtype=wp.float32, device="cpu")
        for x in (
            packed[..., None], np.diag(whole.imag)[:, None].copy(), phi[:, None, None],
            np.zeros((3, 1, 1)),
        )
    )  # fmt: skip
    dropped = wp.zeros(1, dtype=wp.int32, device="cpu")
    for kernel, dim, inputs in (
        (warp_solve.factorise, 1, [cut, matrix, dropped]),
        (warp_solve.factorise_lossy, 1, [cut, matrix, loss, dropped]),
        (warp_solve.forward, (1, 1), [cut, 1, rows, matrix, loss, rows, quadrature]),
    ):
        wp.launch(kernel, dim=dim, inputs=inputs, device="cpu")
    assert dropped.numpy()[0] == 1
    found = ((rows.numpy() + 1j * quadrature.numpy()) ** 2).sum()
    some = [0, 2]
    truth = phi[some] @ np.linalg.solve(whole[np.ix_(some, some)], phi[some])
    assert found == approx(truth, rel=1e-5)


MODULES = [
    "warp_cut", "warp_network", "warp_solve", "warp_chip_kernels",
    *(
        pytest.param(f"warp_{m}", marks=pytest.mark.e2e)
        for m in ("near", "gap", "touch", "fabric", "slope", "pairs", "charges")
    ),
]  # fmt: skip


@pytest.mark.parametrize("name", MODULES)
def test_kernels_compile_for_a_gpu(name, tmp_path):
    """Compiled ahead for compute capability 9.0, which needs no GPU; no kernel asks for more
    shared memory than the 48 kB that every launch may have, nor for arguments of more than 4 kB,
    which older drivers take."""
    module = importlib.import_module(f"capsense.fleet.{name}")
    wp.compile_aot_module(module, arch=90, module_dir=tmp_path, use_ptx=True)
    (file,) = tmp_path.glob("*.ptx")
    text = file.read_text(encoding="utf-8")
    assert ".target sm_90" in text
    sizes = [
        int(count) * int(bits) // 8
        for bits, count in re.findall(r"\.shared [^;]*\.b(\d+) \S+\[(\d+)\]", text)
    ]
    assert sum(sizes) <= 48 * 1024
    entries = text.split(".entry")[1:]
    assert len(entries) >= (1 if name == "warp_gap" else 2)
    for entry in entries:
        sizes = re.findall(r"\.param [^,)]*\.b8 \w+\[(\d+)\]", entry.split("{")[0])
        assert 0 < sum(map(int, sizes)) <= 4096 - 64


@pytest.mark.parametrize("place", [(0, 2), (0, 4), (1, 0)], ids=["height", "turn", "other"])
def test_poses_on_the_device_that_are_not_finite(place: tuple[int, int]) -> None:
    """Unit: the reading of their environment is not finite, nor its error; others are as before."""
    bodies = [cs.Body(cs.Capsule(0.01, 0.05)), cs.Body(cs.Sphere(0.02))]
    fleet = cs.Fleet("six_patch", bodies, 3, device="warp:cpu", budget=32)
    where = np.zeros((3, 2, 7), np.float32)
    where[..., 6] = 1.0
    where[:, 0, 2], where[:, 1, :3] = 0.06, (0.05, 0.0, 0.1)
    good = fleet.step(wp.array(where, dtype=wp.float32)).delta.numpy().copy()
    where[(1, *place)] = np.nan
    reading = fleet.step(wp.array(where, dtype=wp.float32))
    for values in (reading.delta, reading.capacitance, reading.error):
        found = np.isfinite(values.numpy()).reshape(3, -1)
        assert found.all(axis=1).tolist() == [True, False, True]
        assert not found[1].any()
    np.testing.assert_array_equal(reading.delta.numpy()[[0, 2]], good[[0, 2]])


def test_quaternions_on_the_device_of_other_lengths() -> None:
    """Invariant: only their direction counts; one of length 0 has none, and its reading is NaN."""
    bodies = [cs.Body(cs.Capsule(0.01, 0.05))]
    fleet = cs.Fleet("six_patch", bodies, 4, device="warp:cpu", budget=32)
    where = poses(np.random.default_rng(17), 4, 1).astype(np.float32)
    at = frames(np.random.default_rng(18), 4, 1).astype(np.float32)
    truth = fleet.step(wp.array(where), wp.array(at)).delta.numpy().copy()
    where[..., 3:] *= np.array([0.3, 1.002, 20.0, 0.0], np.float32)[:, None, None]
    at[..., 3:] *= np.array([5.0, 0.998, 0.1, 1.0], np.float32)[:, None, None]
    found = fleet.step(wp.array(where), wp.array(at)).delta.numpy()
    np.testing.assert_allclose(found[:3], truth[:3], rtol=0, atol=3e-5 * np.abs(truth).max())
    assert np.isnan(found[3]).all()


def test_a_captured_step_reads_nan_after_a_new_shape() -> None:
    """Regression: it used memory that was freed. Captured again, it reads what a step reads."""
    if not hasattr(wp, "capture_save"):
        pytest.skip("this version of Warp captures on GPUs only")
    fleet = cs.Fleet("six_patch", [cs.Body(cs.Sphere(0.02))], 2, device="warp:cpu", budget=32)
    where = wp.array(poses(np.random.default_rng(19), 2, 1), dtype=wp.float32, device="cpu")

    def captured():
        fleet.step(where)
        with wp.ScopedCapture("cpu") as capture:
            reading = fleet.step(where)
        return capture.graph, reading

    graph, reading = captured()
    wp.capture_launch(graph)
    assert np.isfinite(reading.delta.numpy()).all()
    fleet.change(0, cs.Body(cs.Capsule(0.01, 0.043)), [1])
    wp.capture_launch(graph)
    assert np.isnan(reading.delta.numpy()).all()
    truth = fleet.step(where).delta.numpy().copy()
    assert np.isfinite(truth).all()
    again, reading = captured()
    wp.capture_launch(again)
    np.testing.assert_array_equal(reading.delta.numpy(), truth)


def test_wide_bodies_are_near_the_fine_preset() -> None:
    """Differential: a plate, a trunk and a table face on, at 30 and 60 mm; 5 % of the largest."""
    shapes = [cs.Box((0.5, 0.5, 0.02)), cs.Cylinder(0.15, 0.5), cs.Box((0.9, 0.6, 0.03))]
    gaps = (0.03, 0.06)
    bodies = [cs.Body(shape) for shape in shapes for _ in gaps]
    where = np.zeros((len(bodies), 1, 7))
    where[..., 6] = 1.0
    where[:, 0, 2] = [np.ptp(s.bounds(), axis=0)[2] / 2 + gap for s in shapes for gap in gaps]
    found = []
    for options in ({"device": "warp:cpu", "budget": 128}, {"preset": "fine"}):
        fleet = cs.Fleet("six_patch", bodies[:1], len(bodies), **options)
        fleet.change(0, bodies)
        delta = fleet.step(where).delta
        found.append((delta if isinstance(delta, np.ndarray) else delta.numpy()).astype(float))
    off = np.abs(found[0] - found[1]).max(axis=(1, 2, 3)) / np.abs(found[1]).max(axis=(1, 2, 3))
    assert off.max() < 0.05


def test_a_wall_beyond_the_box_leaves_a_definite_matrix() -> None:
    """Differential: clusters at a wall of the box meet images more than themselves. Measured 0.05;
    1e6 without ``bound_walls``."""
    body = cs.Body(cs.Box((2.223, 2.701, 0.099)))
    turn = np.array([-0.0154, -0.9926, 0.1201, -0.0075])
    where = np.array([[[0.7565, -0.975, 0.3928, *turn / np.linalg.norm(turn)]]])
    fleet = cs.Fleet("six_patch_bare", [body], 1, device="warp:cpu")
    truth = cs.Fleet("six_patch_bare", [body], 1, preset="fine").step(where).delta
    off = np.abs(fleet.step(where).delta.numpy() - truth).max()
    assert off < 0.1 * np.abs(truth).max()


def test_panels_of_wide_bodies_are_more() -> None:
    """Unit: a table has four times as many as a small box, and energies of all of them."""
    table, block = cs.Body(cs.Box((0.5, 0.4, 0.02))), cs.Body(cs.Box((0.12, 0.1, 0.02)))
    usual, wide = (
        cs.Fleet("six_patch", [body], 1, device="warp:cpu", budget=32).table.shapes[0]
        for body in (block, table)
    )
    assert 3 * len(usual.panels) < len(wide.panels) < 5 * len(usual.panels)
    assert wide.potential_coefficients.shape == (len(wide.panels),) * 2


def test_wide_bodies_are_warned_of_once() -> None:
    """A warning names the place and the fix; on the CPU, which knows wide bodies, there is none."""
    table = cs.Body(cs.Box((0.5, 0.4, 0.02)))
    with pytest.warns(UserWarning, match=r'place 1: 0.4 m is wide .*take device="cpu"') as told:
        fleet = cs.Fleet("six_patch", [BODIES[0], table], 1, device="warp:cpu", budget=32)
    assert len(told) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fleet.change(0, table)
        cs.Fleet("six_patch", [table], 1)
        cs.Fleet("six_patch", [cs.Body(cs.Capsule(0.04, 0.4))], 1, device="warp:cpu", budget=32)


@pytest.mark.parametrize("make", [copy.deepcopy, pickle.dumps])
def test_a_fleet_on_warp_is_not_copied(make) -> None:
    """Refused by name: pointers of one process mean nothing in another."""
    fleet = cs.Fleet("six_patch", [cs.Body(cs.Sphere(0.02))], 1, device="warp:cpu", budget=32)
    with pytest.raises(TypeError, match=r"a fleet on 'warp:cpu' cannot be pickled or copied"):
        make(fleet)
