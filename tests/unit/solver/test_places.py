"""Where clusters stand to a flat design and to the walls: lifted off, faded out, split."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from approximate import approx
from plain_leaves import plain_leaves
from surface_scenes import Placed, green_of, pack, shape_of

import capsense as cs
from capsense.field.face_kernels import barrier, barrier_slope, fading, lift, out_of_reach
from capsense.field.green import LEVELS
from capsense.field.green_kernels import Green, distances, level_share, pack_green
from capsense.solver.gap.body_gap_kernels import facing_of
from capsense.solver.interaction.pair_kernels import bound_images, leaf_pairs, mean_inverse
from capsense.solver.placement.placement_kernels import placed
from capsense.solver.selection.evaluation_kernels import place
from capsense.solver.selection.selection_kernels import chosen

Array = np.ndarray


BOX = np.array([[-0.05, -0.04, -0.001], [0.05, 0.04, 0.0]])


def lifted(points: Array, gap: float) -> Array:
    out = np.array(points, float)
    lift(out, gap, BOX)
    return out


def distance(points: Array) -> Array:
    """From the design and all that is between it and the floor."""
    low = np.array([*BOX[0, :2], -np.inf])
    return np.linalg.norm(points - np.clip(points, low, BOX[1]), axis=1)


def test_places_of_many_terminals() -> None:
    """Unit: potentials of the terminals come first, modes begin at the next multiple of eight."""
    sim = cs.Simulator("six_patch_bare")
    green, rng = sim.background.green, np.random.default_rng(3)
    for terminals in (7, 8, 9, 17):
        phis = [
            rng.uniform(size=(len(getattr(green, f"{name}_phi")), terminals)).astype(np.float32)
            for name in LEVELS
        ]
        named = {f"{name}_phi": phi for name, phi in zip(LEVELS, phis, strict=True)}
        packed = pack_green(replace(green, **named), sim.design)
        phi_columns = 8 * math.ceil(terminals / 8)
        assert (packed.terminals, packed.phi_columns) == (terminals, phi_columns)
        tables = [
            (level.table, phi, getattr(green, f"{name}_modes"))
            for level, phi, name in zip(packed.levels, phis, LEVELS, strict=True)
        ]
        assert packed.grid.values.shape[1] == phi_columns
        assert (packed.grid.values[:, terminals:] == 0.0).all()
        for table, phi, modes in tables:
            np.testing.assert_array_equal(table[: len(phi), :terminals], phi)
            assert (table[:, terminals:phi_columns] == 0.0).all()
            rows, columns = modes.shape
            np.testing.assert_array_equal(table[:rows, phi_columns : phi_columns + columns], modes)


def test_sensors_of_one_design_share_what_is_packed() -> None:
    """Unit: copies hold the same tables; another design, or Green's function, its own."""
    sim = cs.Simulator("six_patch_bare")
    green, design = sim.background.green, sim.design
    assert pack_green(green, design) is pack_green(green, design)
    assert sim.copy()._solver.green is sim._solver.green
    assert pack_green(replace(green), design) is not pack_green(green, design)
    assert pack_green(green, replace(design)) is not pack_green(green, design)


def test_shares_of_levels_add_to_one() -> None:
    """Twin, and invariant: at each distance there are at most two, that add to one."""
    green = cs.Simulator("six_patch_bare").background.green
    high = np.linspace(0.0, 0.03, 301)
    points = green.box.mean(axis=0) * [1, 1, 0] + high[:, None] * [0, 0, 1]
    points[:, 2] += green.box[1, 2]
    found = np.array([[level_share(d, k, green.blends) for d in high] for k in range(3)])
    np.testing.assert_allclose(found.sum(axis=0), 1.0, atol=1e-14)
    assert found.min() == 0.0
    assert (found > 0).sum(axis=0).max() == 2
    np.testing.assert_allclose(found, green.shares(points), atol=1e-6)


def test_far_points_stay() -> None:
    """Invariant: from twice the gap on, nothing moves, to the last bit."""
    points = np.random.default_rng(1).uniform(-0.1, 0.1, (400, 3))
    far = points[distance(points) >= 6e-4]
    np.testing.assert_array_equal(lifted(far, 3e-4), far)


def test_near_points_keep_a_gap() -> None:
    """Analytic: a distance d below 2 m becomes m + d² / 4 m, in the same direction."""
    random = np.random.default_rng(2)
    on_top = random.uniform([-0.05, -0.04, 0.0], [0.05, 0.04, 6e-4], (200, 3))
    beside = random.uniform([0.05, -0.04, -0.01], [0.0506, 0.04, -0.002], (200, 3))
    corner = random.uniform([0.05, 0.04, 0.0], [0.0503, 0.0403, 3e-4], (200, 3))
    for points in (on_top, beside, corner):
        d = distance(points)
        assert (d < 6e-4).all()
        moved = lifted(points, 3e-4)
        np.testing.assert_allclose(distance(moved), 3e-4 + d**2 / 1.2e-3, rtol=1e-9)
        nearest = np.clip(points, [*BOX[0, :2], -np.inf], BOX[1])
        way, old = moved - nearest, points - nearest
        np.testing.assert_allclose(np.cross(way, old), 0.0, atol=1e-14)


def test_points_within_come_out_at_the_nearest_face() -> None:
    """Analytic: above, or at a side; a point between the design and the floor counts as within."""
    within = [[0.0, 0.0, -0.001], [0.049, 0.0, -0.005], [0.01, -0.039, -0.004]]
    wanted = [[0.0, 0.0, 3e-4], [0.0503, 0.0, -0.005], [0.01, -0.0403, -0.004]]
    np.testing.assert_allclose(lifted(np.array(within), 3e-4), wanted, atol=1e-15)


H0 = 1.3e-3
"""A validity distance [m]."""


def with_validity(green: Green) -> Green:
    return green._replace(
        gap=green.gap._replace(validity=H0), space=green.space._replace(validity=H0)
    )


def faceless(green: Green) -> Green:
    return green._replace(space=green.space._replace(has_face=False))


@pytest.mark.parametrize(
    ("center", "expected"),
    [((0.0, 0.0, 0.1), 0.0), ((0.235, 0.0, 0.1), 0.0), ((0.2375, 0.0, 0.1), 0.5),
     ((0.0, -0.24, 0.1), 1.0), ((0.0, 0.0, 0.48), 1.0), ((0.2, 0.0, -0.01), 0.0),
     ((0.2, 0.0, -0.0125), 0.5), ((0.0, 0.0, -2.2 * H0), 0.0), ((0.0, 0.0, -4.2 * H0), 0.5),
     ((0.0, 0.0, -0.009), 1.0), ((0.2, 0.0, -0.009), 0.0)],
)  # fmt: skip
def test_beyond_the_walls_and_behind_the_sensor(center: tuple, expected: float) -> None:
    """Analytic: smoothsteps over 5 mm, from 15 mm before walls, and from 2.3 to 6.1 h0 behind."""
    green = with_validity(green_of())
    np.testing.assert_allclose(
        green.active_bounds, [[-0.235, -0.235, -0.01], [0.235, 0.235, 0.475]]
    )
    assert green.space.has_face
    x, held = out_of_reach(around(np.array(center)), 0, green.space, np.empty(3))
    assert x == held == approx(expected, abs=1e-9)


@pytest.mark.parametrize(
    ("center", "whole", "held"),
    [((0.0, 0.0, 0.1), 0.0, 0.0), ((0.2, 0.0, 0.1), 0.0, 0.0), ((0.22, 0.0, 0.1), 0.5, 0.0),
     ((0.0, -0.24, 0.1), 1.0, 0.0), ((0.0, 0.0, 0.46), 0.5, 0.0), ((0.0, 0.0, 0.48), 1.0, 0.0),
     ((0.1, 0.0, -0.0125), 0.5, 0.5), ((0.0, 0.0, -4.2 * H0), 0.5, 0.5)],
)  # fmt: skip
def test_conductors_not_at_ground_fade_out_early(center: tuple, whole: float, held: float) -> None:
    """Analytic: over 40 mm up to 10 mm before walls, but not at the floor or behind the face."""
    green = with_validity(green_of())
    found = out_of_reach(around(np.array(center)), 1, green.space, np.empty(3))
    np.testing.assert_allclose(found, (whole, held), rtol=0, atol=1e-9)


def test_walls_next_to_a_design_fade_all_bodies_alike() -> None:
    """Invariant: the box in which bodies are whole holds the design, with the fade around it."""
    room = np.array([[-0.02, -0.3, -0.01], [0.3, 0.3, 0.3]])
    box = np.array([[-0.005, -0.1, 0.0], [0.1, 0.29, 0.001]])
    inner, fade = fading(room, box, 0.3)
    np.testing.assert_allclose(fade[0], 3e-3)
    np.testing.assert_array_equal(inner[0], room)
    np.testing.assert_allclose(fade[1], [[3e-3, 0.024, 3e-3], [0.024, 3e-3, 0.024]])
    np.testing.assert_allclose(inner[1], [[-0.02, -0.279, -0.01], [0.279, 0.3, 0.279]])


@pytest.mark.parametrize("held", [None, 0.0])
def test_barrier_rises_by_its_slope(held: float | None) -> None:
    """Differential: central differences; it is 0 within reach, and never falls."""
    x = np.linspace(0.0, 0.99, 34)
    values = np.array([barrier(v, v if held is None else held, 0.03) for v in x])
    assert values[0] == 0.0
    assert (np.diff(values) > 0.0).all()
    step = 1e-6
    for v in x[1:]:
        low, high = (barrier(w, w if held is None else held, 0.03) for w in (v - step, v + step))
        slope = barrier_slope(v, v if held is None else held, 0.03)
        np.testing.assert_allclose((high - low) / (2 * step), slope, rtol=1e-5)
    assert barrier_slope(1.0, 0.0, 0.03) == 0.0


def outside(center: Array, green: Green) -> float:
    """The outside fraction of four points with a centre, of a body at ground."""
    return out_of_reach(around(center), 0, green.space, np.empty(3))[0]


def around(center: Array) -> Array:
    """Four points with a centre."""
    return center + 0.01 * np.array([[1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]])


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("side", [0, 1])
def test_behind_the_face_near_a_side(axis: int, side: int) -> None:
    """Analytic: half as far as it counts, where the side is a quarter of 4.2 h0 away."""
    green = with_validity(green_of())
    center = np.array([0.0, 0.0, float(green.box[1, 2]) - 0.008])
    center[axis] = green.box[side, axis] + (4.2 * H0 / 4) * (1 - 2 * side)
    assert outside(center, green) == approx(0.5, abs=1e-9)


def test_distance_of_clusters_from_the_design() -> None:
    """Analytic: of their centres, from its box, on all sides."""
    green, centers = green_of(), np.random.default_rng(5).uniform(-0.2, 0.2, (200, 3))
    points = np.array([around(c) for c in centers])
    wanted = np.linalg.norm(centers - np.clip(centers, *green.box), axis=1)
    np.testing.assert_allclose(distances(points, green), wanted, atol=1e-15)


def test_designs_without_a_face_lift_nothing() -> None:
    """Invariant: only behind a face the space is known."""
    green = faceless(green_of())
    bodies = pack(Placed(cs.Sphere(0.03), (0.0, 0.0, 0.0299)))
    cut = chosen(bodies, green, 0.015, 2.5, facing_of(bodies[:0]))
    leaves = placed(bodies, cut, green)
    np.testing.assert_array_equal(leaves.points, leaves.true)
    assert outside(np.array((0.0, 0.0, -0.009)), green) == 0.0


@pytest.mark.parametrize("has_face", [True, False])
def test_clusters_are_looked_at_where_they_are_lifted_to(has_face: bool) -> None:
    """Analytic: a distance d below 2 m becomes m + d² / 4 m; without a face it stays d."""
    shape, green = cs.Capsule(0.008, 0.06), green_of()
    green = green if has_face else faceless(green)
    top = float(green.box[1, 2])
    bodies = pack(Placed(shape, (0.0, 0.0, top + 0.0081), (0.0, math.pi / 2, 0.0)))
    tree, raised, point = shape_of(shape).tree, 0, np.zeros((1, 3), np.float32)
    for k in range(bodies[0]["n_panel_clusters"]):
        square, _, _, _ = place(bodies[0], green.space, k, point, 0, np.empty(3))
        wanted = bodies["rotation"][0] @ tree.center[k] + bodies["position"][0]
        d, m = wanted[2] - top, green.gap.validity
        if d < 2 * m and has_face:
            wanted[2], raised = top + m + d * d / (4 * m), raised + 1
        assert square == approx((wanted[2] - top) ** 2, rel=1e-4)
        np.testing.assert_allclose(point[0], wanted, rtol=0, atol=1e-8)
    assert (raised > 0) == has_face


def test_what_crosses_a_wall_is_split_there() -> None:
    """Invariant: no long cluster stays in one piece across the wall, none far outside is split."""
    bodies = pack(Placed(cs.Capsule(0.03, 0.4), (0.15, 0.0, 0.08), (0.0, np.pi / 2, 0.0)))
    green = green_of()
    cut = chosen(bodies, green, 0.015, 2.5, facing_of(bodies[:0]))
    leaves = placed(bodies, cut, green)
    middle, half = leaves.points.mean(axis=1)[:, 0], 0.5 * leaves.extent
    across = np.abs(middle - 0.235) < 0.4 * half
    assert leaves.extent[across].max(initial=0.0) < 0.061
    assert (leaves.outside_fraction[middle > 0.24] == 1.0).all()
    assert (leaves.outside_fraction[middle < 0.235] == 0.0).all()


def test_lifted_clusters_of_a_body_meet_where_they_are() -> None:
    """Differential: a rigid body's pairs change by the means of 1/r after less those before."""
    random = np.random.default_rng(3)
    true = random.uniform(-0.01, 0.01, (5, 4, 3))
    points = true.copy()
    points[1:3, :, 2] += 2e-3
    size, owner, none = np.full(5, 4e-3), np.array([0, 0, 0, 0, 1]), np.zeros(5)
    before, after = (
        leaf_pairs(plain_leaves(points, t, size, size, none, owner, none), -1e5)
        for t in (points, true)
    )
    wanted = np.zeros((5, 5))
    for i in range(4):
        for j in range(4):
            if i != j and ({i, j} & {1, 2}):
                wanted[i, j] = mean_inverse(points[i], points[j], 4e-3)
                wanted[i, j] -= mean_inverse(true[i], true[j], 4e-3)
    np.testing.assert_allclose(after - before, wanted, atol=1e-4 * np.abs(wanted).max())


def test_charge_out_of_reach_has_a_large_energy() -> None:
    """Analytic: 1e5 per metre times the third power of how far it is beyond."""
    points = np.random.default_rng(4).uniform(-0.01, 0.01, (3, 4, 3))
    none, owner, size = np.zeros(3), np.zeros(3, int), np.full(3, 4e-3)
    energy = np.array([barrier(x, x, 4e-3) for x in (0.0, 0.5, 1.0)])
    np.testing.assert_allclose(energy, [0.0, 12500.0, 1e5])
    leaves = plain_leaves(points, points, size, size, none, owner, none)
    first, second = (leaf_pairs(leaves._replace(barrier=e), -1e5) for e in (none, energy))
    np.testing.assert_allclose(second - first, np.diag(energy), rtol=1e-6, atol=0.01)


@pytest.mark.parametrize("height", [3e-4, 1e-3, 3e-3, 8e-3])
@pytest.mark.parametrize("stretch", [1.0, 1.4])
def test_no_image_attracts_more_than_a_mirror(height: float, stretch: float) -> None:
    """Differential: wide squares meet themselves in a flat face as by the mean over all of them.

    Oblongs do as squares of the same area.
    """
    side, green = 0.02, green_of()
    arm = side / math.sqrt(12.0)
    points = np.array([[[x, y, height] for x in (arm, -arm) for y in (arm, -arm)]])
    points[..., :2] *= [stretch, 1.0 / stretch]
    points[..., 2] += green.box[1, 2]
    one, none = np.ones(1), np.zeros(1)
    leaves = plain_leaves(points, points, side * one, one, none, np.zeros(1, int), none)
    rows = np.zeros((1, green.phi_columns + 8), np.float32)
    rows[0, green.phi_columns] = 30.0  # the square of it is what the design answers [1/m]
    pairs = np.zeros((1, 1), np.float32)
    bound_images(leaves, rows, pairs, green)
    off = (np.arange(2000) + 0.5) / 2000  # of two points of the square, over its side
    square = (1.0 - off)[:, None] * (1.0 - off)
    distance = np.sqrt(off[:, None] ** 2 + off**2 + (2.0 * height / side) ** 2)
    mirror = 4.0 * (square / distance).mean() / side
    floor = mean_inverse(points[0], points[0] * [1, 1, -1] + [0, 0, 2 * green.floor], 0.0)
    wanted = 900.0 + floor - mirror if height < 5e-3 else 0.0
    assert pairs[0, 0] == approx(wanted, rel=1e-4)
