"""Charges on the bodies: what they read, how smoothly, and what must hold everywhere."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
from approximate import approx
from field_cases import (
    assert_physical,
    ball,
    bar,
    body_of,
    capsule,
    capsule_reference,
    delta_reference,
    off_diagonal,
)
from random_scenes import random_scene
from reference_scenes import MAP, MORE, diagonal_errors, other_errors, reference_scenes

import capsense as cs
from capsense.solver.surface_solver import PRESETS, Preset, SurfaceSolver

Array = np.ndarray


@pytest.fixture
def sim(simulators) -> cs.Simulator:
    return simulators("six_patch_bare")


# -- accuracy ---------------------------------------------------------------------------------


def test_the_map_of_references(sim):
    """Measured against boundary elements: 89 scenes of fingers, limbs, balls, plates and boxes."""
    readings = [(s, sim.step(s.scene)) for s in reference_scenes(MAP)]
    diagonal = np.array([diagonal_errors(r.delta, s.delta) for s, r in readings])
    others = np.concatenate([other_errors(r.delta, s.delta) for s, r in readings])
    assert np.sqrt((diagonal**2).mean()) <= 0.008
    assert np.percentile(np.abs(diagonal), 95) <= 0.02
    assert np.abs(diagonal).max() <= 0.05
    assert np.abs(others).max() <= 0.02
    for _, reading in readings:
        np.testing.assert_array_equal(reading.delta, reading.delta.T)
        assert_physical(reading.capacitance)


def test_more_references(sim):
    """Measured against boundary elements of another make: 120 scenes, also near contact."""
    readings = [(s, sim.step(s.scene)) for s in reference_scenes(MORE)]
    diagonal = np.array([diagonal_errors(r.delta, s.delta) for s, r in readings])
    assert np.sqrt((diagonal**2).mean()) <= 0.02
    assert np.percentile(np.abs(diagonal), 95) <= 0.04


def test_the_solver_error_tells_good_from_bad(sim):
    """Measured: nine of ten scenes of the map have an error below five times the estimate."""
    within = [
        np.abs(r.delta - s.delta).max() <= 5 * r.stats.solver_error + s.error * s.delta.max()
        for s in reference_scenes(MAP)
        for r in [sim.step(s.scene)]
    ]
    assert np.mean(within) >= 0.9


def assert_close(got: Array, expected: Array, diagonal: float, other: float) -> None:
    error = np.diag(got) / np.diag(expected) - 1
    assert np.abs(error).max() <= diagonal, np.round(100 * error, 2)
    least = np.maximum(other * np.abs(off_diagonal(expected)), 0.01 * np.abs(expected).max())
    assert (np.abs(off_diagonal(got - expected)) <= least).all()


@pytest.mark.parametrize(("gap", "most"), [(0.005, 0.045), (0.01, 0.03), (0.02, 0.02)])
def test_thin_plates(sim, gap, most):
    """Differential: many panels. Faces that were told apart at once made it 7.5, 5.8 and 2.1 %."""
    finer = Preset(panels=2800, threshold=1e-3, coarsest=None)
    scene = cs.Scene([cs.Body(cs.Box((0.12, 0.1, 2e-4)), cs.Pose((0.01, 0.005, gap)))])
    truth = SurfaceSolver(sim.background.green, sim.design, preset=finer).solve(scene).matrix
    off = sim.step(scene).delta - truth[:6, :6]
    assert np.abs(off).max() < most * truth.max()


@pytest.mark.parametrize("gap", [5, 10, 20, 50, 100, 200])
@pytest.mark.parametrize("table", ["six_patch_bare", "six_patch"])
def test_bars(simulators, table, gap):
    """Measured against boundary and finite elements."""
    case = f"bar {gap}" if table == "six_patch_bare" else f"bar_{gap}"
    if (table, gap) != ("six_patch", 5):  # there is none
        reading = simulators(table).step(cs.Scene([body_of(case)]))
        assert_close(reading.delta, delta_reference(table, case), 0.03, 0.05)


@pytest.mark.parametrize("gap", [5, 10, 20, 50, 100])
def test_limb_like_capsule(sim, gap):
    """Measured against ``benchmarks/references.py``."""
    reading = sim.step(cs.Scene([capsule(gap / 1e3)]))
    assert_close(reading.delta, capsule_reference(gap), 0.02, 0.03)


@pytest.mark.parametrize("kind", ["grounded 1.0", "floating 1.0", "diel 80.0", "diel 3.0"])
def test_spheres(sim, kind):
    """Measured against boundary elements with exact spheres."""
    case = f"sphere {kind}"
    reading = sim.step(cs.Scene([body_of(case)]))
    assert_close(reading.delta, delta_reference("six_patch_bare", case), 0.02, 0.03)


# -- what must hold ---------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.e2e
def test_random_scenes(sim, seed):
    """Invariant: symmetric matrices with physical signs, anywhere, contact included."""
    rng = np.random.default_rng(seed)
    for _ in range(8):
        scene = random_scene(rng)
        assert_physical(sim.step(scene).capacitance, 2e-3)


def test_thin_rods_through_the_electrodes(sim):
    """Invariant: no positive off-diagonal, whatever lies across the electrodes; one once had."""
    rng = np.random.default_rng(1)
    rods = [cs.Cylinder(10**r, 0.1) for r in (-3.3, -2.8, -2.3)]
    for k in range(24):
        place = *rng.uniform(-0.06, 0.06, 2), rng.uniform(-0.02, 0.05)
        rod = cs.Body(
            rods[k % 3], cs.Pose(place, rng.normal(size=4)), cs.Material("matter", 3242.0),
            grounding=("grounded", "floating")[k % 2],
        )  # fmt: skip
        assert_physical(sim.step(cs.Scene([rod])).capacitance, 0.0)


@pytest.mark.parametrize(
    ("design", "radius", "place", "turn", "grounding"),
    [
        ("six_patch", 1.6e-3, (-0.0378, -0.0105, 0.0215), (0.086, -1.365, 0.215, -0.416),
         "grounded"),
        ("six_patch", 5e-4, (0.0145, -0.0196, -0.0013), (0.699, -0.099, 0.657, 0.138),
         "grounded"),
        ("three_stripes", 5e-3, (0.0406, -0.023, 0.0079), (1.107, 0.293, 0.378, -2.162),
         "floating"),
    ],
)  # fmt: skip
def test_electrodes_couple_no_more_than_in_the_empty_domain(
    simulators, design, radius, place, turn, grounding
):
    """Regression: rods whose approximate energies made an off-diagonal positive."""
    rod = cs.Cylinder(radius, 0.1)
    body = cs.Body(rod, cs.Pose(place, turn), cs.Material("matter", 3242.0), grounding=grounding)
    assert_physical(simulators(design).step(cs.Scene([body])).capacitance, 0.0)


def test_a_reading_does_not_depend_on_those_before_it(sim):
    """Invariant: to the last bit."""
    scenes = [cs.Scene([ball(z)]) for z in (0.08, 0.045, 0.08)]
    first, _, third = (sim.step(s).delta for s in scenes)
    np.testing.assert_array_equal(first, third)


def test_a_reading_does_not_depend_on_other_bodies_before_it(sim):
    """Differential: a sensor at rest, to the last bit. Bodies that change places, a long one that
    slides, and a mesh of parts that come and go."""
    balls = [ball(0.06), ball(0.06, radius=0.02).moved(cs.Pose((0.08, 0.0, 0.05)))]
    rod = cs.Body(cs.Capsule(0.02, 3.0), cs.Pose.from_euler((0, 0, 0.06), (0, np.pi / 2, 0)))
    far, near = (cs.Box((0.3, 0.05, 0.05)).to_trimesh() for _ in range(2))
    vertices = np.concatenate([far.vertices, np.add(near.vertices, (0.6, 0.0, 0.0))])
    mesh = cs.TriMesh(vertices, np.concatenate([far.faces, near.faces + len(far.vertices)]))
    scenes = [cs.Scene(balls), cs.Scene([b.moved(balls[0].pose) for b in balls[::-1]])]
    for body in (rod, cs.Body(mesh, cs.Pose((0.0, 0.0, 0.06)))):
        for x in (0.0, -0.6, 0.3):
            scenes.append(cs.Scene([body.moved(cs.Pose((x, 0.0, 0.06), body.pose.quaternion))]))
    for scene in scenes:
        wanted = sim.copy().step(scene).delta
        np.testing.assert_array_equal(sim.step(scene).delta, wanted)


def test_smooth_on_the_way_towards_the_sensor(sim):
    """Measured: a finger in steps of 0.05 mm."""
    turn = (0.1494, 0.2344, 0.1494, 0.9491)
    heights = np.concatenate([z + 5e-5 * np.arange(40, 0, -1) for z in (0.05, 0.062)])
    read = [
        np.diag(
            sim.step(
                cs.Scene([cs.Body(cs.Capsule(0.008, 0.06), cs.Pose((0.012, 0.007, z), turn))])
            ).delta
        )
        for z in heights
    ]
    for part in np.array_split(np.log(read), [len(heights) // 2]):
        large = part[-1] > np.log(0.03) + part[-1].max()
        assert np.abs(np.diff(part[:, large], 2, axis=0)).max() <= 1e-3
        assert (np.diff(part[:, part[-1] > np.log(0.1) + part[-1].max()], axis=0) > 0).all()


CONTACT = {
    "ball": (cs.Sphere(0.03), 0.03, (0.0, 0.025), (0, 0, 0, 1)),
    "finger": (cs.Capsule(0.008, 0.06), 0.008, (-0.038, -0.025), (0, 0.5**0.5, 0, 0.5**0.5)),
    "box": (cs.Box((0.04, 0.04, 0.02)), 0.01, (0.02, 0.01), (0, 0, 0, 1)),
    "bar": (cs.Box((0.15, 0.15, 0.02)), 0.01, (0.0, 0.0), (0, 0, 0, 1)),
}


@pytest.mark.parametrize("name", CONTACT)
@pytest.mark.parametrize("design", ["six_patch_bare", "six_patch"])
def test_contact_is_finite_and_monotone(simulators, design, name):
    """Measured: from 3 mm to 0.5 mm into the face, large entries grow by small steps; those of
    boxes within the face fall by 1 % a step at most, those of a bar there by 3 % once."""
    shape, half, (x, y), turn = CONTACT[name]
    gaps = np.concatenate([np.arange(3e-3, 1.2e-3, -1e-4), np.arange(1.2e-3, -5.1e-4, -2.5e-5)])
    read = np.array([
        np.diag(simulators(design).step(
            cs.Scene([cs.Body(shape, cs.Pose((x, y, half + g), turn))])
        ).delta)
        for g in gaps
    ])  # fmt: skip
    read = read[:, read[-1] > 0.1 * read[-1].max()]
    change = np.diff(np.log(read), axis=0)
    assert change[gaps[1:] > 0.0].min() > -1e-4
    assert change.min() > {"bar": -0.03, "box": -0.015}.get(name, -3e-3)
    assert change.max() < 0.5  # near contact readings go with 1 / distance
    assert read[-1].max() < 300e-12


def test_deep_in_the_sensor_a_reading_says_that_it_is_rough(sim):
    """Invariant: finite, no larger than in contact by much, and said to be off by ten per cent."""
    touching = np.abs(np.diag(sim.step(cs.Scene([bar(0.0)])).delta)).max()
    reading = sim.step(cs.Scene([bar(-0.001)]))
    largest = np.abs(np.diag(reading.delta)).max()
    assert np.isfinite(reading.delta).all()
    assert 0.5 * touching < largest < 1.5 * touching
    assert reading.stats.solver_error > 0.1 * largest


def test_what_lies_behind_the_sensor_is_screened(sim):
    """Measured: a plate in the gap between sensor and floor reads 0.35 % of C at most."""
    plate = cs.Body(cs.Box((0.1, 0.08, 0.001)), cs.Pose((0, 0, -0.0095)))
    assert np.abs(sim.step(cs.Scene([plate])).delta).max() < 7.5e-15


@pytest.mark.parametrize(("one", "other"), [(999.0, 1001.0), (9_990.0, 10_010.0)])
def test_no_permittivity_is_a_threshold(sim, one, other):
    """Invariant: continuous from insulator to conductor."""
    read = [
        sim.step(cs.Scene([ball(0.06, 0.03, material=cs.Material("matter", eps))])).delta
        for eps in (one, other)
    ]
    np.testing.assert_allclose(*read, rtol=2e-3, atol=1e-3 * read[0].max())


def test_water_conducts_less_and_less(simulators):
    """Invariant: tap water's reading falls smoothly with the frequency, from 250 kHz to 100 MHz."""
    read = []
    for f in np.geomspace(250e3, 100e6, 12):
        sim = simulators("six_patch_bare", excitation_frequency=float(f))
        read.append(sim.step(cs.Scene([ball(0.06, 0.03, material="water")])).delta[1, 1])
    steps = np.diff(np.log(read))
    assert (steps <= 1e-4).all()
    assert np.abs(steps).max() < 0.35


@pytest.mark.parametrize("grounding", ["floating", 1e-12, "grounded"])
def test_touching_bodies_are_one(sim, grounding):
    """Measured: two halves equal their union."""
    halves = [
        cs.Body(cs.Box((0.03, 0.06, 0.06)), cs.Pose((x, 0, 0.06)), "steel",
                0.5 * grounding if isinstance(grounding, float) else grounding)
        for x in (-0.015, 0.015)
    ]  # fmt: skip
    whole = cs.Body(cs.Box((0.06, 0.06, 0.06)), cs.Pose((0, 0, 0.06)), "steel", grounding)
    got, expected = sim.step(cs.Scene(halves)).delta, sim.step(cs.Scene([whole])).delta
    np.testing.assert_allclose(got, expected, rtol=0, atol=0.01 * expected.max())


def test_impedance_to_ground_is_a_divider(sim):
    """Analytic: ΔC(C_g) = ΔC_float + (ΔC_ground − ΔC_float) C_g / (C_g + C_self)."""

    def read(g):
        return sim.step(cs.Scene([ball(grounding=g)])).delta

    floating, step = read("floating"), read("grounded") - read("floating")
    ties = np.array([1e-12, 3e-12, 10e-12])
    share = np.array([(read(c) - floating)[0, 0] / step[0, 0] for c in ties])
    own = ties * (1 / share - 1)
    np.testing.assert_allclose(own, own.mean(), rtol=1e-2)


def test_a_limb_that_leaves_the_domain_keeps_its_tie_to_ground(sim):
    """Invariant: the wall does not ground what passes through it."""
    arm = [
        cs.Body(cs.Capsule(0.04, 0.6), cs.Pose((0, 0, 0.08), (0, 0.7071, 0, 0.7071)), "steel", g)
        for g in ("floating", 1e-10, "grounded")
    ]
    floating, tied, grounded = (sim.step(cs.Scene([a])).delta[1, 1] for a in arm)
    assert floating < 0.9 * grounded
    assert 0.95 * grounded < tied < grounded


def test_what_stands_outside_changes_nothing(sim):
    """Invariant: to the last bit."""
    alone = sim.step(cs.Scene([bar(0.02)])).delta
    outside = cs.Body(cs.Sphere(0.05), cs.Pose((0, 0, 0.7)))
    np.testing.assert_array_equal(sim.step(cs.Scene([bar(0.02), outside])).delta, alone)
    np.testing.assert_array_equal(sim.step(cs.Scene([outside])).delta, 0.0)


LONG = {
    "table": (cs.Box((3.0, 2.0, 0.02)), (0.0, 0.0, 0.05), (0, 0, 0, 1), cs.Box((0.85, 0.85, 0.02))),
    "pole": (cs.Capsule(0.03, 4.0), (0.0, 0.01, 0.07), (0, 0.5**0.5, 0, 0.5**0.5),
             cs.Capsule(0.03, 0.85)),
    "pipe": (cs.Cylinder(0.03, 4.0), (0.0, 0.01, 0.07), (0, 0.5**0.5, 0, 0.5**0.5),
             cs.Cylinder(0.03, 0.85)),
}  # fmt: skip


@pytest.mark.parametrize("height", [60.0, 0.02])
def test_a_scene_in_millimetres_is_told(sim, height):
    """One that is far off, and one that holds the sensor; a wide floor out of view is none."""
    hand = cs.Body(cs.Ellipsoid((90.0, 45.0, 18.0)), cs.Pose((0, 0, height)), name="hand")
    floor = cs.Body(cs.Box((300.0, 300.0, 3.0)), cs.Pose((0, 0, -5.0)), name="floor")
    with pytest.warns(UserWarning, match=r"hand is 180 × 90 × 36 m, .* multiply millimetres"):
        reading = sim.step(cs.Scene([hand]))
    assert not reading.delta.any()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for bodies in ([], [floor], [hand, floor]):
            sim.step(cs.Scene(bodies))


@pytest.mark.parametrize(
    ("place", "told"), [((0, 0, 60), True), ((40, 0, 30), True), ((0, 0, 20), False)]
)
def test_places_in_millimetres_are_told(sim, place, told):
    """Of a ball whose radius is in metres; one that is near enough is none."""
    ball, near = (cs.Body(cs.Sphere(0.03), cs.Pose(at)) for at in (place, (0, 0, 0.1)))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        sim.step(cs.Scene([ball]))
        assert [
            f"at ({place[0]:g}, 0, {place[2]:g}) m" in str(w.message) for w in caught
        ] == told * [True]
        sim.step(cs.Scene([ball, near]))
        assert len(caught) == told


@pytest.mark.parametrize("name", LONG)
def test_long_bodies_read_as_their_part_in_the_domain(sim, name):
    """Measured: as a body that ends just outside; it may be pushed along without a change."""
    shape, place, turn, part = LONG[name]
    whole, shifted, short = (
        sim.step(cs.Scene([cs.Body(s, cs.Pose(np.add(place, (x, 0, 0)), turn))])).delta
        for s, x in ((shape, 0.0), (shape, 0.7), (part, 0.0))
    )
    np.testing.assert_allclose(shifted, whole, rtol=0, atol=1e-6 * whole.max())
    np.testing.assert_allclose(short, whole, rtol=0, atol=0.025 * whole.max())


def test_jacobian_of_a_long_body_is_about_its_own_origin(sim):
    """Measured: a table turned about its far edge, against central differences."""
    turn = np.array([0.0, 1.0, 0.0])

    def read(angle):
        pose = cs.Pose((0.9, 0.0, 0.06), (*(np.sin(angle / 2) * turn), np.cos(angle / 2)))
        return sim.step(cs.Scene([cs.Body(cs.Box((3.0, 2.0, 0.02)), pose)]), jacobian=True)

    slope, step = read(0.0).jacobian[0, 1, 1, 4], 2e-4
    difference = (read(step).delta - read(-step).delta)[1, 1] / (2 * step)
    assert slope == approx(difference, rel=0.03)


# -- other views ------------------------------------------------------------------------------


def test_a_depth_frame_reads_as_what_it_shows(sim):
    """Measured: a forearm, seen by 64 × 64 pixels and as a capsule."""
    t = (np.arange(64) + 0.5) / 64 * 0.5 - 0.25
    _, y = np.meshgrid(t, t)
    depth = np.where(np.abs(y) < 0.04, 0.06 - np.sqrt(np.maximum(0.04**2 - y**2, 0)), np.nan)
    seen = sim.step(cs.DepthFrame(depth, "human"))
    assert seen.stats.unknowns > 0
    pose = cs.Pose((0, 0, 0.06), (0, 0.7071068, 0, 0.7071068))
    arm = sim.step(cs.Scene([cs.Body(cs.Capsule(0.04, 0.6), pose)])).delta
    np.testing.assert_allclose(np.diag(seen.delta), np.diag(arm), rtol=0.03)


@pytest.mark.parametrize("eps", [2.0, 20.0])
def test_a_dielectric_depth_image_reads_nearly_as_what_it_shows(sim, eps):
    """Measured: a limb of plastic, whose inside a depth image does not give; 13 % at most."""
    t = (np.arange(64) + 0.5) / 64 * 0.5 - 0.25
    _, y = np.meshgrid(t, t)
    depth = np.where(np.abs(y) < 0.045, 0.065 - np.sqrt(np.maximum(0.045**2 - y**2, 0)), np.nan)
    seen = sim.step(cs.DepthFrame(depth, cs.Material("plastic", eps))).delta
    pose = cs.Pose((0, 0, 0.065), (0, 0.7071068, 0, 0.7071068))
    limb = cs.Body(cs.Capsule(0.045, 0.7), pose, cs.Material("plastic", eps))
    np.testing.assert_allclose(np.diag(seen), np.diag(sim.step(cs.Scene([limb])).delta), rtol=0.14)


def test_an_open_dielectric_mesh_reads_nearly_as_a_closed_one(sim):
    """Measured: a ball of eps 5 without its cap on the far side."""
    mesh = cs.Sphere(0.03).to_trimesh()
    open_ = mesh.faces[mesh.triangles_center[:, 2] < 0.02]
    plastic, pose = cs.Material("plastic", 5.0), cs.Pose((0.01, 0, 0.06))
    got, whole = (
        sim.step(cs.Scene([cs.Body(shape, pose, plastic)])).delta
        for shape in (cs.TriMesh(mesh.vertices, open_), cs.Sphere(0.03))
    )
    np.testing.assert_allclose(np.diag(got), np.diag(whole), rtol=0.08)


@pytest.mark.parametrize("material", ["steel", cs.Material("plastic", 4.0)])
def test_walls_are_crossed_smoothly(sim, material):
    """Invariant: a bar that leaves through a side wall changes by small steps, and to nothing."""
    read = np.array([
        sim.step(cs.Scene([bar(0.02, x, material=material)])).delta[1, 1]
        for x in np.arange(0.15, 0.34, 1e-3)
    ])  # fmt: skip
    assert np.abs(np.diff(read)).max() < 2e-3 * sim.step(cs.Scene([bar(0.02)])).delta[1, 1]
    assert read[-1] == 0.0


def test_a_wall_is_crossed_smoothly_by_parts_of_a_person(simulators):
    """Invariant: a long part on a potential of its own attracts nothing from behind the wall."""
    turn = (0.5696, -0.3989, -0.5887, 0.4122)

    def read(x):
        parts = [
            cs.Body(cs.Capsule(radius, length), cs.Pose((x + dx, y, z), turn), grounding=1.4e-11)
            for radius, length, (dx, y, z) in (
                (0.0246, 0.2378, (0.0, 0.0, 0.064)), (0.0132, 0.1627, (0.2, -0.0243, 0.0486)),
            )
        ]  # fmt: skip
        return simulators("six_patch").step(cs.Scene(parts)).delta[0, 0]

    values = np.array([read(x) for x in np.arange(-0.312, -0.297, 5e-4)])
    assert np.abs(np.diff(values, 2)).max() < 1e-3 * values.min()


def test_parts_come_within_reach_without_a_step(simulators):
    """Invariant: of an upright arm beside the sensor that rises, in ever finer steps."""

    def read(rise):
        parts = [
            cs.Body(cs.Capsule(radius, length), cs.Pose((-0.12, 0.0, z + rise)), grounding=1e-11)
            for radius, length, z in ((0.0486, 0.1817, -0.0987), (0.042, 0.3029, -0.0836))
        ]
        return simulators("six_patch").step(cs.Scene(parts)).delta[0, 0]

    rises = np.arange(-0.0115, -0.0045, 2.5e-4)
    values = [read(rise) for rise in rises]
    for k in range(len(rises) - 1):
        (low, high), (first, last) = rises[k : k + 2], values[k : k + 2]
        for _ in range(12):
            middle = 0.5 * (low + high)
            value = read(middle)
            if abs(value - first) > abs(last - value):
                high, last = middle, value
            else:
                low, first = middle, value
        assert abs(last - first) < 2e-4 * abs(last), f"a step between {low} and {high} m"


# -- Jacobian, potentials ---------------------------------------------------------------------


@pytest.mark.parametrize("grounding", ["grounded", "floating"])
def test_jacobian_is_the_derivative(sim, grounding):
    """Measured against central differences."""
    shape, turn = cs.Capsule(0.03, 0.1), (0.1, 0.6, 0.2, 0.7)

    def read(offset):
        pose = cs.Pose(np.add((0.01, 0.0, 0.09), offset), turn)
        return sim.step(cs.Scene([cs.Body(shape, pose, "steel", grounding)]), jacobian=True)

    slope = read((0, 0, 0)).jacobian
    assert slope.shape == (1, 6, 6, 6)
    np.testing.assert_allclose(slope, slope.swapaxes(1, 2), atol=1e-9 * np.abs(slope).max())
    step = 2e-4
    for k, e in enumerate(step * np.eye(3)):
        difference = (read(e).delta - read(-e).delta) / (2 * step)
        worst = np.abs(slope[0, :, :, k] - difference).max()
        assert worst <= 0.015 * np.abs(slope[0, :, :, :3]).max()


def test_jacobian_of_the_other_method_is_refused(simulators):
    with pytest.raises(ValueError, match='use "surface"'):
        simulators("six_patch_bare", method="fem_masked").step(cs.Scene(), jacobian=True)


@pytest.mark.parametrize(("name", "value"), [("method", "lattice"), ("preset", "rapid")])
def test_unknown_options(name, value):
    with pytest.raises(ValueError, match=f"{name} is '{value}'; choose one of"):
        cs.Simulator("six_patch_bare", **{name: value})


def test_what_crosses_a_wall_out_of_sight_costs_little(sim):
    """Invariant: a ball is near, a long bar leaves the domain far from the electrodes."""
    ball = cs.Body(cs.Sphere(0.03), cs.Pose((0, 0, 0.05)))
    far = cs.Body(cs.Box((0.6, 0.3, 0.05)), cs.Pose((0.25, 0.1, 0.4)))
    near, both = (sim.step(cs.Scene(bodies)) for bodies in ([ball], [ball, far]))
    assert both.stats.unknowns < near.stats.unknowns + 45
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PRESETS, sim.preset, replace(PRESETS[sim.preset], threshold=1e-4))
        exact = sim.copy().step(cs.Scene([ball, far])).delta
    np.testing.assert_allclose(both.delta, exact, rtol=0, atol=0.01 * exact.max())


@pytest.mark.parametrize(
    ("grounding", "material"),
    [("grounded", "steel"), ("floating", "steel"), (2e-11, "steel"), ("grounded", "wood")],
)
def test_a_large_mesh_of_several_parts_reads_as_they_do(sim, grounding, material):
    """Measured: two crossing capsules and far balls, as one mesh and as bodies in touch."""
    near = [
        cs.Body(cs.Capsule(0.015, 0.12), cs.Pose((0.0, 0.01, 0.04), (0, 0.5**0.5, 0, 0.5**0.5))),
        cs.Body(cs.Capsule(0.02, 0.12), cs.Pose((0.06, 0.0, 0.1))),
    ]
    far = [cs.Body(cs.Sphere(0.05), cs.Pose((2.0 + k, 0.0, 0.5))) for k in range(3)]
    meshes = [(b, b.shape.to_trimesh()) for b in near + far]
    vertices = np.concatenate([b.pose.apply(m.vertices) for b, m in meshes])
    first = np.cumsum([0, *(len(m.vertices) for _, m in meshes)])
    faces = np.concatenate([m.faces + f for (_, m), f in zip(meshes, first, strict=False)])
    mesh = cs.TriMesh(vertices, faces)
    assert len(mesh.pieces) == 5
    share = grounding / 2 if isinstance(grounding, float) else grounding
    bodies = [cs.Body(b.shape, b.pose, material, share) for b in near]
    expected = sim.step(cs.Scene(bodies)).delta
    got = sim.step(cs.Scene([cs.Body(mesh, material=material, grounding=grounding)]), jacobian=True)
    np.testing.assert_allclose(got.delta, expected, rtol=0, atol=0.02 * expected.max())
    assert got.jacobian.shape == (1, 6, 6, 6)
    step = 2e-4
    higher, lower = (
        sim.step(cs.Scene([cs.Body(mesh, cs.Pose((0, 0, z)), material, grounding)])).delta
        for z in (step, -step)
    )
    slope = (higher - lower) / (2 * step)
    np.testing.assert_allclose(
        got.jacobian[0, :, :, 2], slope, rtol=0, atol=0.05 * np.abs(slope).max()
    )


@pytest.mark.parametrize("grounding", ["grounded", "floating", 1e-11])
def test_a_large_mesh_round_the_domain_changes_nothing(sim, grounding):
    """Invariant: its bounding box holds the domain, none of its parts reaches into it."""
    ball = cs.Sphere(0.05).to_trimesh()
    vertices = np.concatenate([cs.Pose((x, 0.0, 0.2)).apply(ball.vertices) for x in (2.0, -2.0)])
    faces = np.concatenate([ball.faces, ball.faces + len(ball.vertices)])
    body = cs.Body(cs.TriMesh(vertices, faces), grounding=grounding)
    reading = sim.step(cs.Scene([body]), jacobian=True)
    assert not reading.delta.any()
    assert reading.jacobian.shape == (1, 6, 6, 6)
    assert not reading.jacobian.any()


@pytest.mark.parametrize("material", ["wood", cs.Material("damp", 4.0, 1e-5), "steel"])
def test_a_body_that_does_not_count_reads_nothing(sim, material):
    """Invariant: all of its surface is beyond the walls; hardly a charge function is left."""
    around = cs.Body(cs.Box((3.0, 3.0, 3.0)), cs.Pose(), material, "floating")
    reading = sim.step(cs.Scene([around]), jacobian=material == "wood")
    assert np.abs(reading.delta).max() < 1e-21
