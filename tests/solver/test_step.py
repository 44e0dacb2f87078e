"""The compiled step of the surface core against a slow twin in NumPy, and what must hold in it."""

from __future__ import annotations

import ctypes
import math
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import interpreted
import numpy as np
import pytest
import surface_twin as twin
from approximate import approx
from interpreted import fewer, limit, thinned
from plain_leaves import plain_leaves
from scipy.integrate import quad
from scipy.spatial.transform import Rotation
from surface_twin import Piece

import capsense as cs
from capsense._dense import (
    add_products,
    cholesky,
    mirror,
    multiply,
    multiply_simd,
    square,
    substitute,
    subtract_product,
    whole_lines,
)
from capsense.constants import UNIT
from capsense.field.green import GreenFunction
from capsense.field.green_kernels import Green, pack_green, point_potentials, source_potentials
from capsense.solver.bodies.blocks import free_block
from capsense.solver.bodies.panels import panels_of
from capsense.solver.gap.body_gap_kernels import facing_of
from capsense.solver.interaction.pair_kernels import _mirror_mean, leaf_pairs, mean_inverse
from capsense.solver.selection.evaluation_kernels import ClusterEvaluation
from capsense.solver.selection.score_kernels import score
from capsense.solver.selection.selection_kernels import ActiveTree, choose
from capsense.solver.surface_solver import Preset, SurfaceSolver
from capsense.solver.system.lossy import solve_lossy
from capsense.solver.system.step import (
    FIELD_ERROR,
    Solution,
    estimate,
    potential_change,
    prepared,
    solve,
    solve_each,
)
from capsense.solver.system.system_kernels import Reduced, _products, factorise, reduced
from capsense.solver.tree import tree_kernels
from capsense.solver.tree.dynamic_surface import DynamicBody
from capsense.solver.tree.matter import CONDUCTING
from capsense.solver.tree.mean_kernels import quadrature4
from capsense.solver.tree.rigid import BODY, Clusters, RigidShape, rigid_shape, split

Array = np.ndarray
BALL, FINGER, BOX = cs.Sphere(0.03), cs.Capsule(0.008, 0.06), cs.Box((0.1, 0.06, 0.02))
CYLINDER, EGG = cs.Cylinder(0.02, 0.05), cs.Ellipsoid((0.04, 0.03, 0.02))
ACROSS, TILTED = (0.1, math.pi / 2, 0.2), (0.1, 0.2, 0.3)
NONE = math.inf
"""The tie of a body that floats."""
WIDTH = 2.5
ALL = 1e-12
"""A threshold below which no charge function falls that counts."""


def prepared_alone(bodies, threshold):
    """The system of bodies that face no other conductor."""
    return prepared(bodies, packed_green(), threshold, WIDTH, facing_of(bodies[:0]), bodies)


@cache
def shape_of(shape: cs.Shape, count: int = 150) -> RigidShape:
    return rigid_shape(panels_of(shape, fewer(count)))


@cache
def simulator() -> cs.Simulator:
    return cs.Simulator("six_patch_bare")


def exact() -> GreenFunction:
    return thinned(simulator().background.green)


def coarse_solver() -> SurfaceSolver:
    return SurfaceSolver(exact(), simulator().design, preset=Preset(panels=150, coarsest=None))


@cache
def packed_green() -> Green:
    return pack_green(exact(), simulator().design)


class Scene(tuple[tuple[Piece, RigidShape], ...]):
    """Bodies as the twin takes them, with their charge functions."""

    @property
    def pieces(self) -> tuple[Piece, ...]:
        return tuple(piece for piece, _ in self)

    @property
    def trees(self) -> list[tuple[Array, Array, Array]]:
        return [(s.tree.children, s.tree.panel, charge_of(s)) for _, s in self]

    def packed(self) -> Array:
        """The same for the kernels."""
        out = np.zeros(len(self), BODY)
        for k, (piece, shape) in enumerate(self):
            out[k] = shape.record
            out["scale"][k], out["position"][k] = piece.scale, piece.position
            out["rotation"][k] = piece.rotation
            out["group"][k] = k if piece.group is None else piece.group
            joined = piece.group is not None
            out["neutral"][k] = piece.neutral and not joined
            if joined:
                out["ground_elastance"][k] = 1e8 if piece.neutral else piece.ground_elastance.real
            elif not piece.neutral:
                out["ground_elastance"][k] = piece.ground_elastance.real
            if np.isfinite(piece.eps_r):
                out["neumann_to_dirichlet"][k] = shape.neumann_to_dirichlet.ctypes.data
                out["inverse_susceptibility"][k] = (1 / (piece.eps_r - 1)).real
                out["polarization_stiffness"][k] = 2.0 * abs(1 / (piece.eps_r - 1))
        return out

    def solved(self, threshold: float = ALL) -> Solution:
        return solve(self.packed(), packed_green(), threshold, WIDTH, False)


def body(shape: cs.Shape, *where: tuple[float, ...], **state: complex) -> tuple[Piece, RigidShape]:
    found = shape_of(shape)
    return Piece(found.panels, *where, **state), found


def charge_of(shape: RigidShape) -> Array:
    """Equilibrium charge of the panels."""
    tree, single = shape.tree, shape.tree.panel >= 0
    out = np.empty(len(shape.panels))
    out[tree.panel[single]] = tree.charge[single]
    return out


def apart(found: Array, wanted: Array) -> float:
    """Largest difference over the largest entry."""
    return float(np.abs(found - wanted).max() / np.abs(wanted).max())


@cache
def scenes() -> dict[str, Scene]:
    return {
        "ball": Scene([body(BALL, (0.01, 0.0, 0.05))]),
        "ball between near and far": Scene([body(BALL, (0.01, 0.0, 0.038))]),
        "ball far off": Scene([body(BALL, (0.01, 0.0, 0.12))]),
        "finger at 5 mm": Scene([body(FINGER, (0.01, -0.02, 0.013), ACROSS)]),
        "box": Scene([body(BOX, (0.01, 0.0, 0.05), TILTED)]),
        "floating, made smaller": Scene(
            [body(BALL, (0.02, 0.01, 0.04), scale=0.7, ground_elastance=NONE)]
        ),
        "floating egg": Scene([body(EGG, (0.02, 0.01, 0.05), TILTED, ground_elastance=NONE)]),
        "ball on a capacitance": Scene([body(BALL, (0.02, 0.01, 0.04), ground_elastance=20.0)]),
        "ball of eps 3": Scene([body(BALL, (0.02, 0.01, 0.04), ground_elastance=NONE, eps_r=3.0)]),
        "box of eps 5": Scene(
            [body(BOX, (0.02, 0.01, 0.05), TILTED, ground_elastance=NONE, eps_r=5.0)]
        ),
        "finger of eps 80, larger": Scene(
            [body(FINGER, (0.0, 0.01, 0.04), ACROSS, scale=1.6, ground_elastance=NONE, eps_r=80.0)]
        ),
        "ball of eps 2000 with a contact": Scene(
            [body(BALL, (0.0, 0.01, 0.045), ground_elastance=0.08, eps_r=2000.0)]
        ),
        "finger and floating finger": Scene(
            [
                body(FINGER, (0.01, -0.02, 0.03), ACROSS),
                body(FINGER, (0.0, 0.01, 0.04), ACROSS, ground_elastance=NONE),
            ]
        ),
        "cylinder of eps 4 before a ball": Scene(
            [
                body(CYLINDER, (0.0, 0.0, 0.035), ACROSS, ground_elastance=NONE, eps_r=4.0),
                body(BALL, (0.01, 0.0, 0.09)),
            ]
        ),
        "three of all kinds": Scene(
            [
                body(FINGER, (0.01, -0.02, 0.03), ACROSS, ground_elastance=30.0),
                body(BALL, (0.0, 0.01, 0.08), ground_elastance=NONE, eps_r=4.0),
                body(BOX, (0.0, 0.05, 0.07), TILTED),
            ]
        ),
        "two joined, floating": Scene(
            [
                body(BALL, (-0.03, 0.0, 0.045), ground_elastance=NONE, group=0),
                body(FINGER, (0.03, 0.0, 0.04), ACROSS, ground_elastance=NONE, group=0),
            ]
        ),
        "two joined on a capacitance, a third alone": Scene(
            [
                body(BALL, (-0.04, 0.0, 0.045), ground_elastance=12.0, group=0),
                body(EGG, (0.0, 0.05, 0.05), ground_elastance=NONE),
                body(FINGER, (0.04, 0.0, 0.04), ACROSS, ground_elastance=12.0, group=0),
            ]
        ),
        "ball and box across a wall": Scene(
            [
                body(BALL, (0.0, -0.02, 0.05), ground_elastance=30.0),
                body(BOX, (0.22, 0.0, 0.05), TILTED),
            ]
        ),
        "floating box across two walls": Scene(
            [body(BOX, (0.19, 0.2, 0.04), TILTED, scale=1.5, ground_elastance=NONE)]
        ),
        "box of eps 5 across a wall": Scene(
            [body(BOX, (-0.2, 0.01, 0.05), TILTED, ground_elastance=NONE, eps_r=5.0)]
        ),
        "two across a wall, a third inside": Scene(
            [
                body(
                    CYLINDER, (0.0, -0.24, 0.04), ACROSS, scale=2.0, ground_elastance=NONE, group=0
                ),
                body(FINGER, (0.0, -0.2, 0.03), ACROSS, ground_elastance=NONE, group=0),
                body(BALL, (0.0, -0.02, 0.05), ground_elastance=30.0),
            ]
        ),
    }


NAMES = (
    "ball", "ball between near and far", "ball far off", "finger at 5 mm", "box",
    "floating, made smaller", "floating egg", "ball on a capacitance", "ball of eps 3",
    "box of eps 5", "finger of eps 80, larger", "ball of eps 2000 with a contact",
    "finger and floating finger", "cylinder of eps 4 before a ball", "three of all kinds",
    "two joined, floating", "two joined on a capacitance, a third alone",
    "ball and box across a wall", "floating box across two walls", "box of eps 5 across a wall",
    "two across a wall, a third inside",
)  # fmt: skip
TIED = (
    "ball on a capacitance", "ball of eps 2000 with a contact", "three of all kinds",
    "two joined, floating", "two joined on a capacitance, a third alone",
    "ball and box across a wall", "two across a wall, a third inside",
)  # fmt: skip
"""Where net charge has an energy of its own."""
if interpreted.ON:
    NAMES = (
        "finger at 5 mm", "floating, made smaller", "finger of eps 80, larger",
        "ball of eps 2000 with a contact", "three of all kinds",
        "two joined on a capacitance, a third alone", "ball and box across a wall",
        "floating box across two walls", "box of eps 5 across a wall",
    )  # fmt: skip
SOME = ("ball between near and far", "box of eps 5", "three of all kinds")


# ---- the whole step ----


@pytest.mark.parametrize("name", NAMES)
def test_all_functions_together_are_the_panels(name: str) -> None:
    """Differential: with a vanishing threshold, ΔC of one unknown a panel, single precision."""
    scene = scenes()[name]
    assert fewer(96) <= max(len(p.panels) for p in scene.pieces) <= 200
    found = scene.solved()
    wanted = twin.galerkin(scene.pieces, exact(), packed_green().active_bounds)
    assert apart(found.delta, wanted) < limit(3e-5, 6e-4)
    assert np.abs(found.residual_correction).max() < 1e-6 * np.abs(found.delta).max()


@pytest.mark.parametrize("threshold", [0.015, 0.2])
@pytest.mark.parametrize("name", [n for n in NAMES if "joined" not in n])
def test_chosen_functions_are_solved_and_the_others_estimated(name: str, threshold: float) -> None:
    """Differential: ΔC and the part that is estimated, from explicit functions of the same cut.

    Clusters apart meet by their second moments here, by their points in the twin.
    """
    scene = scenes()[name]
    cut = prepared_alone(scene.packed(), threshold)[0]
    chosen = chosen_of(cut, len(scene))
    delta, left, coarse = twin.reduced(
        scene.pieces, scene.trees, chosen, exact(), packed_green().active_bounds
    )
    found = scene.solved(threshold)
    assert apart(found.delta, delta) < limit(6e-4, 4e-3)
    near = limit(3e-4, 1e-3) * np.abs(delta).max()
    assert np.abs(found.residual_correction - left).max() < near
    assert np.abs(found.discretization_error - coarse).max() < near
    assert np.abs(left).max() > limit(1e-3, 0.0) * np.abs(delta).max()


def chosen_of(cut: ActiveTree, bodies: int) -> list[twin.Chosen]:
    out = []
    split = cut.children[:, 0] >= 0
    entered = np.clip(cut.parent_fade / 0.1, 0, 1)
    whole = np.where(split, 1 - entered**2 * (3 - 2 * entered), 1.0)
    for b in range(bodies):
        leaf, at = (cut.body == b) & (whole > 0), (cut.body == b) & split
        out.append(
            twin.Chosen(
                cut.node[leaf], whole[leaf], cut.node[at], cut.fade[at], cut.parent_fade[at]
            )
        )
    return out


@pytest.mark.parametrize("name", NAMES)
def test_charges_on_the_leaves(name: str) -> None:
    """Invariant: neutral bodies and floating groups have no net charge.

    With all functions solved for, ΔC is what φ⁰ makes of the charges.
    """
    scene = scenes()[name]
    found = scene.solved()
    m = packed_green().terminals
    most = np.abs(found.charge).max()
    groups = np.array([-1 - k if p.group is None else p.group for k, p in enumerate(scene.pieces)])
    for group in set(groups.tolist()):
        first = scene.pieces[int(np.argmax(groups == group))]
        own = found.charge[groups[found.owner] == group, :m]
        net = own.sum(axis=0)
        if first.neutral:
            # those of a group stand apart for an energy of 1e8
            assert np.abs(net).max() < (1e-6 if first.group is None else 1e-5) * most
        else:
            assert np.abs(net).max() > np.abs(own).max()
    phi = twin.four_point_mean(found.points, exact(), "phi0")
    phi *= 1.0 - twin.beyond(found.points, packed_green().active_bounds)[:, None]
    assert apart(phi.T @ found.charge[:, :m], found.delta) < 3e-5


@pytest.mark.parametrize("threshold", [0.2, 0.02])
@pytest.mark.parametrize("name", [n for n in SOME if n in NAMES or not interpreted.ON])
def test_charges_are_what_derivatives_follow_from(name: str, threshold: float) -> None:
    """Analytic: as ΔC = φᵀ M φ, it changes by dφᵀ x + xᵀ dφ, what is estimated included."""
    _, _, functions, system = prepared_alone(scenes()[name].packed(), threshold)
    way = np.random.default_rng(3).normal(size=system.phi.shape)
    way *= 0.1 * np.abs(system.phi).max()

    def at(step: float) -> Reduced:
        return reduced(functions, system._replace(phi=system.phi + step * way), True)

    x = at(0.0).charge
    wanted = way.T @ x + x.T @ way
    assert functions.solved < len(functions.cluster)
    assert apart(0.5 * (at(1.0).delta - at(-1.0).delta), wanted) < 1e-6


def test_delta_is_symmetric_and_of_one_sign() -> None:
    """Invariant: ΔC is the energy of charges, estimated parts included, whatever is left out."""
    for name, threshold in (("box", 0.5), ("three of all kinds", 0.1), ("floating egg", 0.015)):
        delta = scenes()[name].solved(threshold).delta
        assert np.array_equal(delta, delta.T)
        assert np.linalg.eigvalsh(delta).min() > -1e-7 * delta.max()


def test_estimate_of_the_largest_entry() -> None:
    """Analytic: what is left, what panels are too coarse for, and a share of the change itself.

    All of it where A was changed.
    """
    rng = np.random.default_rng(12)
    (delta, left), coarse = rng.normal(size=(2, 5, 5)), rng.uniform(size=5)
    for n in (1, 3, 5):  # electrodes, of five terminals
        doubt = np.abs(left[:n])
        own = FIELD_ERROR * np.abs(np.diag(delta)[:n])
        doubt[:, :n] = np.diag(np.diag(doubt) + coarse[:n] + own)
        told = estimate(delta, left, coarse, 0.0, n)
        assert told == approx(doubt.max(), rel=1e-14)
        assert estimate(delta, left, coarse, 0.03, n) == np.abs(np.diag(delta)[:n]).max()


def test_scenes_one_after_another() -> None:
    """Invariant: the same as one at a time, to the last bit; nothing of an empty scene."""
    bodies = scenes()["three of all kinds"].packed()
    first = np.array([0, 2, 2, 3])
    delta, error, size = solve_each(bodies, first, packed_green(), 0.2, WIDTH)
    for k, some in ((0, bodies[:2]), (2, bodies[2:])):
        wanted = solve(some, packed_green(), 0.2, WIDTH, False)
        np.testing.assert_array_equal(delta[k], wanted.delta)
        assert (error[k], size[k]) == (wanted.error, wanted.size)
        assert error[k] > 0
    assert np.abs(delta[1]).max() == error[1] == size[1] == 0


def test_potentials_that_charges_change() -> None:
    """Differential: 1/r of four points a leaf, bounded, of images, and what the design answers."""
    found, green = scenes()["three of all kinds"].solved(0.05), exact()
    leaves = found.points.reshape(-1, 3)
    image = leaves * [1.0, 1.0, -1.0] + [0.0, 0.0, 2.0 * green.floor]
    charge = np.repeat(0.25 * found.charge[:, : packed_green().terminals], 4, axis=0)
    least = np.repeat(0.3 * found.extent, 4)
    rng = np.random.default_rng(11)
    points = np.concatenate([leaves, rng.uniform([-0.1, -0.1, 3e-3], [0.1, 0.1, 0.15], (2100, 3))])
    direct, mirrored = (
        1 / np.maximum(np.linalg.norm(points[:, None] - q, axis=-1), least) for q in (leaves, image)
    )
    wanted = green.psi(points) @ green.psi(leaves).T @ charge - (direct - mirrored) @ charge
    assert apart(potential_change(green, found, points), wanted) < 1e-6


# ---- trees and charge functions ----


@pytest.mark.parametrize("shape", [BALL, FINGER, BOX, CYLINDER, EGG], ids=repr)
def test_haar_functions(shape: cs.Shape) -> None:
    """Differential: integrals with functions and their energies, by an explicit matrix."""
    found = shape_of(shape)
    tree, n = found.tree, len(found.panels)
    haar = twin.haar(tree.children, tree.panel, charge_of(found))
    np.testing.assert_array_equal(tree.function[tree.children[:, 0] >= 0], np.arange(1, n))
    np.testing.assert_allclose(haar.sum(axis=0), np.eye(n)[0], atol=1e-12)
    assert np.linalg.matrix_rank(haar) == n
    rows, out = np.random.default_rng(1).normal(size=(n, 300)), np.empty((n, 300))
    tree_kernels.to_functions(rows, tree.children, tree.panel, tree.charge, tree.function, out)
    np.testing.assert_allclose(out, haar.T @ rows, rtol=0, atol=1e-12)
    energy = haar.T @ free_block(found.panels) @ haar
    np.testing.assert_allclose(
        found.potential_coefficients, energy, rtol=0, atol=1e-6 * energy.max()
    )
    np.testing.assert_allclose(found.own, np.diag(energy), rtol=1e-6)


@pytest.mark.parametrize("shape", [BALL, FINGER, BOX], ids=repr)
def test_the_first_function_is_at_one_potential(shape: cs.Shape) -> None:
    """Invariant: no other function feels the equilibrium charge, whose energy is 1 / C."""
    found = shape_of(shape)
    assert (
        np.abs(found.potential_coefficients[0, 1:]).max()
        < 1e-5 * found.potential_coefficients[0, 0]
    )
    assert found.potential_coefficients[0, 0] * found.capacitance == approx(1.0, rel=1e-6)


@pytest.mark.parametrize("shape", [BALL, FINGER, BOX, cs.Box((0.3, 0.3, 0.001))], ids=repr)
def test_equilibrium_charge_of_panels_apart(shape: cs.Shape) -> None:
    """Differential: conjugate gradients and a Cholesky factor."""
    panels = panels_of(shape, 300)
    found, wanted = rigid_shape(panels, apart=True), rigid_shape(panels)
    assert found.capacitance == approx(wanted.capacitance, rel=1e-8)
    np.testing.assert_allclose(found.tree.charge, wanted.tree.charge, rtol=1e-4)
    np.testing.assert_array_equal(found.tree.children, wanted.tree.children)


@pytest.mark.parametrize("shape", [BALL, FINGER, BOX, CYLINDER], ids=repr)
def test_clusters_have_the_moments_of_their_panels(shape: cs.Shape) -> None:
    """Differential: charges, centres, extents and points, each from all panels of a cluster."""
    found = shape_of(shape)
    tree, charge = found.tree, charge_of(found)
    size = np.ptp(found.panels.centers, axis=0).max()
    for k, own in enumerate(twin.members(tree.children, tree.panel)):
        center, second = twin.charge_moments(
            found.panels, np.where(np.isin(np.arange(len(charge)), own), charge, 0.0)
        )
        assert tree.charge[k] == approx(charge[own].sum(), rel=1e-12)
        np.testing.assert_allclose(tree.center[k], center, atol=1e-12 * size)
        check_points(tree.points[k], tree.extent[k], tree.softening_length[k], center, second)


def check_points(points: Array, extent: float, soft: float, center: Array, second: Array) -> None:
    """Mean, the two largest second moments; the smallest bounds 1/r beside the extent."""
    size = np.linalg.eigvalsh(second)
    off = points - center
    lost = np.linalg.eigvalsh(second - np.einsum("qi,qj->ij", off, off) / 4)
    np.testing.assert_allclose(off.sum(axis=0), 0.0, atol=1e-9 * math.sqrt(size[2]))
    np.testing.assert_allclose(lost, [0.0, 0.0, size[0]], atol=1e-9 * size[2])
    assert extent == approx(math.sqrt(12 * size[2]), rel=1e-9)
    assert soft**2 == approx((0.15 * extent) ** 2 + 0.82 * max(size[0], 0.0), rel=1e-6)


def check_tree(clusters: Clusters, n: int) -> None:
    children, panel = clusters.children, clusters.panel
    assert children.shape == (2 * n - 1, 2)
    single = children[:, 0] < 0
    np.testing.assert_array_equal(single, panel >= 0)
    np.testing.assert_array_equal(single, clusters.function < 0)
    np.testing.assert_array_equal(np.sort(panel[single]), np.arange(n))
    # breadth first: parts come one after the other, behind the whole, in the order of wholes
    np.testing.assert_array_equal(children[~single].ravel(), np.arange(1, 2 * n - 1))
    assert (children[~single, 0] > np.flatnonzero(~single)).all()
    sizes = [len(m) for m in twin.members(children, panel)]
    assert sizes[0] == n
    for whole, (a, b) in zip(np.flatnonzero(~single), children[~single], strict=True):
        assert sizes[whole] == sizes[a] + sizes[b]
        assert sizes[a] > 0
        assert sizes[b] > 0


@pytest.mark.parametrize("n", [1, 2, 3, 7, 64, 301])
@pytest.mark.parametrize("kind", ["random", "equal", "few values", "on a line"])
def test_split_is_a_tree(n: int, kind: str) -> None:
    """Invariant: every panel in one leaf, parts within wholes, the same tree every time."""
    rng = np.random.default_rng(n)
    features = {
        "random": rng.normal(size=(n, 6)),
        "equal": np.ones((n, 6)),
        "few values": rng.integers(0, 2, (n, 6)).astype(float),
        "on a line": np.outer(np.arange(n), np.eye(6)[1]),
    }[kind]
    charge = rng.uniform(0.1, 1.0, n)
    found = split(features, charge)
    check_tree(found, n)
    again = split(features.copy(), charge.copy())
    for name in ("children", "panel", "function"):
        np.testing.assert_array_equal(getattr(found, name), getattr(again, name))


def test_split_cuts_across_what_varies_most() -> None:
    """Analytic: two heaps along y part first, then two opposite normals within a heap."""
    rng = np.random.default_rng(2)
    features = 0.01 * rng.normal(size=(40, 6))
    features[:20, 1] += 10.0
    features[::2, 5] += 3.0
    found = split(features, np.ones(40))
    parts = twin.members(found.children, found.panel)
    assert {frozenset(parts[1]), frozenset(parts[2])} == {
        frozenset(range(20)), frozenset(range(20, 40)),
    }  # fmt: skip
    for k in (3, 4, 5, 6):
        assert len({int(i) % 2 for i in parts[k]}) == 1


def place_of_cut(values: Array, charges: Array, of_normals: bool, last: bool) -> int:
    """How many of the sorted panels the first part gets: at an edge, or in the middle."""
    gaps, whole = np.diff(values), values[-1] - values[0]
    if of_normals and gaps.max() > 0.3 * whole:
        return int(gaps.argmax()) + 1
    off = np.abs(values[:-1] + values[1:] - values[0] - values[-1])
    if of_normals:
        whole = charges.sum()
        off = np.abs(2 * np.cumsum(charges)[:-1] - whole)
    equal = np.flatnonzero((gaps > 0) & (off <= off[gaps > 0].min(initial=math.inf) + 1e-6 * whole))
    return int(equal[-1 if last else 0]) + 1 if len(equal) else len(values) // 2


@pytest.mark.parametrize("kind", ["positions", "normals", "edges", "whole numbers", "equal cuts"])
def test_split_takes_the_cut_in_the_middle(kind: str) -> None:
    """Differential: every cluster of a tree against sorted panels; equal cuts take turns."""
    rng = np.random.default_rng(7)
    scale = np.ones(6)
    scale[{"positions": slice(3, 6), "normals": slice(3)}.get(kind, slice(0))] = 0.1
    for n in (2, 5, 23, 60):
        features, charges = rng.uniform(size=(n, 6)), rng.uniform(0.1, 1.0, n)
        features[:2] = [[0.0], [1.0]]  # so that equal cuts are equal in whole grains too
        if kind == "edges":
            features[:, 3:] **= 4
        elif kind == "whole numbers":
            features[n // 2 :] = features[: n - n // 2]
            features = np.round(4.0 * features)
        elif kind == "equal cuts":
            features, charges = np.round(16.0 * features), np.ones(n)
        features *= scale
        clusters = split(features, charges)
        parts = twin.members(clusters.children, clusters.panel)
        for k, (a, _) in enumerate(clusters.children.tolist()):
            if a < 0:
                continue
            own = parts[k]
            axis = int(np.ptp(features[own], axis=0).argmax())
            own = own[np.argsort(features[own, axis], kind="stable")]
            cut = place_of_cut(features[own, axis], charges[own], axis >= 3, k % 2 == 1)
            np.testing.assert_array_equal(parts[a], np.sort(own[:cut]))


def test_split_of_panels_that_do_not_differ_halves_them() -> None:
    """Analytic: equal features make a tree of least depth."""
    found = split(np.ones((64, 6)), np.ones(64))
    depth = np.zeros(127, int)
    for k, parts in enumerate(found.children):
        if parts[0] >= 0:
            depth[parts] = depth[k] + 1
    assert (depth[found.panel >= 0] == 6).all()


@pytest.mark.parametrize("share", [0.02, 0.3, 0.9, 1.0])
def test_prune_keeps_the_clusters_of_what_stays(share: float) -> None:
    """Differential: the clusters are the old ones cut down to the panels that stay."""
    shape = shape_of(BOX)
    tree, n = shape.tree, len(shape.panels)
    wanted = np.random.default_rng(5).uniform(size=n) < share
    wanted[7] = True
    children, panel = np.full((2 * n - 1, 2), -9), np.full(2 * n - 1, -9)
    function = np.full(2 * n - 1, -9)
    m = tree_kernels.prune(
        tree.children,
        tree.panel,
        wanted,
        children,
        panel,
        function,
        np.empty((2, 2 * n - 1), np.int64),
    )
    assert m == wanted.sum()
    children, panel, function = children[: 2 * m - 1], panel[: 2 * m - 1], function[: 2 * m - 1]
    number = np.cumsum(wanted) - 1
    check_tree(Clusters(children, function, np.where(panel >= 0, number[panel], -1)), int(m))
    np.testing.assert_array_equal(function[children[:, 0] >= 0], np.arange(1, m))
    new = {frozenset(c.tolist()) for c in twin.members(children, panel)}
    old = {frozenset(c[wanted[c]].tolist()) for c in twin.members(tree.children, tree.panel)}
    assert new == old - {frozenset()}
    changing = DynamicBody(tree, shape.panels, wanted)
    assert changing.record["n"] == m
    charge = (ctypes.c_double * (2 * m - 1)).from_address(int(changing.record["charge"]))
    for k, own in enumerate(twin.members(children, panel)):
        assert charge[k] == approx(shape.panels.areas[own].sum(), rel=1e-12)


def test_moments_of_random_clusters() -> None:
    """Differential: charge, centre and second moments against sums over all members."""
    rng = np.random.default_rng(8)
    n = 50
    clusters = split(rng.normal(size=(n, 6)), np.ones(n))
    single = clusters.panel >= 0
    q, x = rng.uniform(0.1, 1.0, n), rng.normal(size=(n, 3))
    half = rng.normal(size=(n, 3, 3))
    own = half @ half.transpose(0, 2, 1)
    charge, center, spread = np.empty(99), np.empty((99, 3)), np.empty((99, 3, 3))
    at = clusters.panel[single]
    charge[single], center[single], spread[single] = q[at], x[at], own[at]
    tree_kernels.moments(clusters.children, clusters.panel, charge, center, spread)
    for k, part in enumerate(twin.members(clusters.children, clusters.panel)):
        weight = q[part] / q[part].sum()
        middle = weight @ x[part]
        off = x[part] - middle
        second = np.einsum("n,nij->ij", weight, own[part]) + (off.T * weight) @ off
        assert charge[k] == approx(q[part].sum(), rel=1e-12)
        np.testing.assert_allclose(center[k], middle, atol=1e-12)
        np.testing.assert_allclose(spread[k], second, atol=1e-11)


@pytest.mark.parametrize("rank", [1, 2, 3])
def test_four_points_have_the_largest_moments(rank: int) -> None:
    """Differential: Jacobi's rotations against LAPACK, on random covariances of any rank."""
    rng = np.random.default_rng(rank)
    for size in 10.0 ** rng.uniform(-5, 0, 40):
        half = size * rng.normal(size=(3, rank)) * 10.0 ** rng.uniform(-2, 0, rank)
        points, center = np.empty((4, 3)), size * rng.normal(size=3)
        extent, soft = quadrature4(half @ half.T, center, np.empty((3, 3)), points)
        check_points(points, extent, soft, center, half @ half.T)


def test_four_points_of_even_and_diagonal_moments() -> None:
    """Analytic: equal moments are kept whichever two are taken; none at all gives the centre."""
    for second in (np.eye(3), np.diag([1.0, 4.0, 4.0]), np.diag([9.0, 0.0, 1.0])):
        points = np.empty((4, 3))
        extent, soft = quadrature4(second.copy(), np.zeros(3), np.empty((3, 3)), points)
        found = np.sort(np.linalg.eigvalsh(points.T @ points / 4))
        np.testing.assert_allclose(found[1:], np.sort(np.diag(second))[1:], rtol=1e-12)
        assert extent == approx(math.sqrt(12 * second.max()))
        wanted = 0.0225 * 12 * second.max() + 0.82 * np.diag(second).min()
        assert soft == approx(math.sqrt(wanted))
    points = np.empty((4, 3))
    assert quadrature4(np.zeros((3, 3)), np.ones(3), np.empty((3, 3)), points) == (0.0, 0.0)
    np.testing.assert_array_equal(points, np.ones((4, 3)))


# ---- vector kernels ----


def potentials(points: Array, sources: Array, floor: float, least: float) -> Array:
    """Bounded 1/r of unit charges (3, s) less that of their images in the floor."""
    s = sources.T.astype(float)
    image = s * [1.0, 1.0, -1.0] + [0.0, 0.0, 2.0 * floor]
    direct = np.linalg.norm(points[..., None, :] - s, axis=-1)
    return 1 / np.maximum(direct, least) - 1 / np.linalg.norm(points[..., None, :] - image, axis=-1)


@pytest.mark.parametrize("count", [1, 2, 5, 24, 57])
def test_potentials_of_sources(count: int) -> None:
    """Differential: means over four points, to single precision."""
    points, sources = random_points(count)
    out = np.empty((count, 48), np.float32)
    source_potentials(points, sources, np.float32(-0.01), np.float32(1e-3), out)
    wanted = potentials(points.astype(float), sources, -0.01, 1e-3)
    np.testing.assert_allclose(out, wanted.mean(axis=1), rtol=3e-6, atol=3e-6 * out.max())
    assert out[0, 5] == approx(wanted[0, :, 5].mean(), rel=1e-5)


@pytest.mark.parametrize("columns", [8, 24])
@pytest.mark.parametrize("count", [16, 48])
def test_potentials_at_points(count: int, columns: int) -> None:
    """Differential: of any number of columns of charges, to single precision."""
    points, sources = random_points(count)
    table = np.random.default_rng(columns).normal(size=(48, columns)).astype(np.float32)
    out = np.full((columns, count), np.float32(math.nan))
    limits = np.float32(-0.01), np.float32(1e-3)
    point_potentials(np.ascontiguousarray(points[:, 0].T), sources, table, limits, out)
    wanted = potentials(points[:, 0].astype(float), sources, -0.01, 1e-3) @ table
    np.testing.assert_allclose(out.T, wanted, rtol=0, atol=1e-5 * np.abs(wanted).max())


def random_points(count: int) -> tuple[Array, Array]:
    """Points (k, 4, 3), one of which is within the bound of a source, and sources (3, 48)."""
    rng = np.random.default_rng(count)
    points = rng.uniform([-0.1, -0.1, 0.0], [0.1, 0.1, 0.2], (count, 4, 3)).astype(np.float32)
    sources = rng.uniform([-0.1, -0.1, -5e-3], [0.1, 0.1, 0.0], (48, 3)).T.astype(np.float32)
    points[0, 0] = sources[:, 5] + np.float32(1e-5)
    return points, np.ascontiguousarray(sources)


def test_potential_of_a_source_in_the_floor_is_none() -> None:
    """Analytic: a charge and its image cancel."""
    points = np.random.default_rng(1).uniform(0.02, 0.1, (3, 4, 3)).astype(np.float32)
    sources = np.repeat(np.array([[0.0], [0.0], [-0.01]], np.float32), 16, axis=1)
    out = np.empty((3, 16), np.float32)
    source_potentials(points, sources, np.float32(-0.01), np.float32(1e-3), out)
    np.testing.assert_allclose(out, 0.0, atol=1e-5)


@pytest.mark.parametrize("rows", [1, 2, 3, 4, 5, 7, 8, 61])
@pytest.mark.parametrize("width", [32, 96])
def test_multiply(rows: int, width: int) -> None:
    """Differential: with any number of rows; nothing beside the result is written."""
    rng = np.random.default_rng(rows)
    left = rng.normal(size=(rows, 45)).astype(np.float32)
    table = rng.normal(size=(45, width)).astype(np.float32)
    room = np.full((rows + 2, width), np.float32(7.0))
    multiply(left, table, room[1:-1])
    np.testing.assert_allclose(room[1:-1], left.astype(float) @ table, rtol=0, atol=2e-5)
    assert (room[[0, -1]] == 7.0).all()


@pytest.mark.parametrize("rows", [4, 12])
@pytest.mark.parametrize("width", [8, 24])
def test_multiply_lanes(rows: int, width: int) -> None:
    """Differential: narrow tables."""
    rng = np.random.default_rng(rows)
    left = rng.normal(size=(rows, 45)).astype(np.float32)
    table = rng.normal(size=(45, width)).astype(np.float32)
    room = np.full((rows + 2, width), np.float32(7.0))
    multiply_simd(left, table, room[1:-1])
    np.testing.assert_allclose(room[1:-1], left.astype(float) @ table, rtol=0, atol=2e-5)
    assert (room[[0, -1]] == 7.0).all()


@pytest.mark.parametrize("n", [1, 3, 4, 15, 16, 17, 50])
def test_products_of_rows_and_their_squares(n: int) -> None:
    """Differential: any length of a row for products, multiples of eight for squares."""
    rng = np.random.default_rng(n)
    left, right = rng.normal(size=(5, n)), rng.normal(size=(n, 16))
    before = rng.normal(size=(7, 16))
    out = before.copy()
    for f in range(5):
        subtract_product(left, f, right, out, f + 1)
    np.testing.assert_allclose(out[1:-1], before[1:-1] - left @ right, rtol=0, atol=1e-12 * n)
    np.testing.assert_array_equal(out[[0, -1]], before[[0, -1]])
    rows = rng.normal(size=(3, 8 * n)).astype(np.float32)
    found = [square(rows, f) for f in range(3)]
    np.testing.assert_allclose(found, (rows.astype(float) ** 2).sum(axis=1), rtol=1e-5)


@pytest.mark.parametrize("n", [1, 15, 16, 17, 40])
def test_matrices_are_mirrored(n: int) -> None:
    """Invariant: what is not above the diagonal stays, the rest follows from it."""
    matrix = np.random.default_rng(n).normal(size=(n, n))
    wanted = np.tril(matrix) + np.tril(matrix, -1).T
    mirror(matrix)
    np.testing.assert_array_equal(matrix, wanted)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 8, 9, 31, 66])
def test_cholesky_and_substitute(n: int) -> None:
    """Differential: factor and solution; what is below the diagonal counts for nothing."""
    rng = np.random.default_rng(n)
    half = rng.normal(size=(n, n))
    matrix = half @ half.T + 0.1 * np.eye(n)
    work = np.full((n, whole_lines(n)), math.nan)
    work[:, :n] = np.triu(matrix) + np.tril(work[:, :n], -1)
    assert cholesky(work)
    found = np.triu(work[:, :n])
    np.testing.assert_allclose(found.T, np.linalg.cholesky(matrix), rtol=0, atol=1e-11 * n)
    sides = rng.normal(size=(n, 16))
    found = sides.copy()
    substitute(work, found)
    wanted = np.linalg.solve(matrix, sides)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-10 * np.abs(wanted).max())


@pytest.mark.parametrize("n", [1, 3, 4, 6, 17])
def test_cholesky_finds_out_what_is_not_definite(n: int) -> None:
    """Analytic: one eigenvalue below zero, wherever it shows; nothing, and what is no number."""
    rng = np.random.default_rng(n)
    axes = np.linalg.qr(rng.normal(size=(n, n)))[0]
    for k in range(n):
        size = np.ones(n)
        size[k] = -0.01
        work = np.zeros((n, whole_lines(n)))
        work[:, :n] = (axes * size) @ axes.T
        assert not cholesky(work)
        for low in (-1.0, 0.0, math.nan):
            work = np.eye(n, whole_lines(n))
            work[k, k] = low
            assert not cholesky(work)


# ---- pairs of clusters ----

DEEP = -1e5
"""A floor [m] whose images are too far away to count."""


def flat(center: Array, turn: Rotation, sides: tuple[float, float]) -> tuple[Array, float]:
    """Four points and extent of a rectangle."""
    arms = turn.as_matrix()[:, :2] * np.array(sides) / math.sqrt(12)
    signs = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    if sides[0] < sides[1]:
        arms = arms[:, ::-1]
    return center + signs @ arms.T, max(sides)


def spread(center: Array, turn: Rotation, sides: tuple[float, float], n: int) -> tuple:
    """Gauss points of a rectangle, and weights."""
    x, w = np.polynomial.legendre.leggauss(n)
    u, v = np.meshgrid(0.5 * sides[0] * x, 0.5 * sides[1] * x, indexing="ij")
    local = np.stack([u.ravel(), v.ravel(), 0.0 * u.ravel()], axis=1)
    return center + turn.apply(local), np.outer(w, w).ravel() / 4


def pairs(shapes: list, owner: list[int], changing: bool, floor: float = DEEP) -> Array:
    points = np.array([flat(*s)[0] for s in shapes])
    extent = np.array([flat(*s)[1] for s in shapes])
    within = np.full(len(shapes), float(changing))
    none = np.zeros(len(shapes))
    leaves = plain_leaves(points, points, extent, 0.15 * extent, none, np.array(owner), within)
    return leaf_pairs(leaves, floor)


def brute(first: tuple, second: tuple, n: int = 10) -> float:
    """Mean of 1/r between rectangles by Gauss points."""
    (p, w), (q, v) = spread(*first, n), spread(*second, n)
    return float(w @ (1 / np.linalg.norm(p[:, None] - q, axis=-1)) @ v)


@pytest.mark.parametrize(("apart_by", "limit"), [(1.52, 1.5e-3), (3.0, 1e-4), (8.0, 1.2e-5)])
def test_pairs_far_from_each_other(apart_by: float, limit: float) -> None:
    """Differential: by second moments; the error falls with the fourth power of the distance."""
    rng = np.random.default_rng(3)
    for _ in range(60):
        turns, sides = Rotation.random(2, random_state=rng), 10.0 ** rng.uniform(-2.5, -1, (2, 2))
        way = rng.normal(size=3)
        way *= apart_by * sides.max(axis=1).sum() / np.linalg.norm(way)
        one, other = (np.zeros(3), turns[0], sides[0]), (way, turns[1], sides[1])
        found = pairs([one, other], [0, 1], False)
        assert found[0, 1] == found[1, 0]
        assert found[0, 1] == approx(brute(one, other), rel=limit)


def test_images_in_the_floor() -> None:
    """Differential: a cluster of any body meets its own image and those of all others."""
    rng = np.random.default_rng(4)
    turns = Rotation.random(2, random_state=rng)
    down = np.array([1.0, 1.0, -1.0])
    for high in (0.03, 0.3):
        one = (np.array([0.0, 0.0, high]), turns[0], (0.02, 0.01))
        other = (np.array([0.01, 0.0, 1.5 * high]), turns[1], (0.005, 0.02))
        found = pairs([one, other], [0, 0], False, 0.0)
        for i, first in enumerate((one, other)):
            for j, second in enumerate((one, other)):
                (p, w), (q, v) = spread(*first, 10), spread(*second, 10)
                wanted = -w @ (1 / np.linalg.norm(p[:, None] - q * down, axis=-1)) @ v
                assert found[i, j] == approx(wanted, rel=2e-3)


@pytest.mark.parametrize("sides", [(0.01, 0.01), (0.01, 0.03), (0.2, 0.01)])
def test_mean_within_a_rectangle(sides: tuple[float, float]) -> None:
    """Analytic: mean of 1/r within a × b, 2 [a² b asinh(b/a) + a b² asinh(a/b) + …] / (a b)²."""
    a, b = sides
    cubes = (a**3 + b**3 - math.hypot(a, b) ** 3) / 3
    total = 2 * (a * a * b * math.asinh(b / a) + a * b * b * math.asinh(a / b) + cubes)
    found = pairs([(np.zeros(3), Rotation.identity(), sides)], [0], True)
    assert found[0, 0] == approx(total / (a * b) ** 2, rel=1e-5)


def exact_mean(one: tuple, other: tuple) -> float:
    """Mean of 1/r between rectangles: Gauss points on one, the other's potential by quadrature."""
    center, turn, (a, b) = other
    points, weights = spread(*one, 12)
    total = 0.0
    for p, w in zip(turn.inv().apply(points - center), weights, strict=True):
        # along y in closed form
        def strip(x: float, p: Array = p) -> float:
            d = math.hypot(x - p[0], p[2])
            return math.asinh((b / 2 - p[1]) / d) + math.asinh((b / 2 + p[1]) / d)

        stops = [p[0]] if abs(p[0]) < a / 2 else None
        total += w * quad(strip, -a / 2, a / 2, points=stops, epsrel=1e-6)[0]
    return total / (a * b)


@pytest.mark.parametrize(
    ("center", "turned", "sides", "limit"),
    [
        ((0.01, 0.0, 0.0), (0.0, 0.0, 0.0), (0.01, 0.01), 0.02),
        ((0.005, 0.0, 0.005), (0.0, math.pi / 2, 0.0), (0.01, 0.01), 0.004),
        ((0.01, 0.01, 0.0), (0.0, 0.0, 0.0), (0.01, 0.01), 0.003),
        ((0.0, 0.0, 0.002), (0.0, 0.0, 0.0), (0.01, 0.01), 0.005),
        ((0.0075, 0.001, 0.0), (0.0, 0.0, 0.0), (0.005, 0.004), 0.011),
        ((0.006, 0.0, 0.001), (0.0, 0.3, 0.0), (0.002, 0.03), 0.008),
        ((0.012, 0.004, 0.003), (0.5, 0.3, 0.2), (0.01, 0.005), 0.001),
    ],
)
def test_pairs_of_one_surface_near_each_other(center, turned, sides, limit: float) -> None:
    """Measured: rectangles that touch, meet at an edge, lie close above each other."""
    one = (np.zeros(3), Rotation.identity(), (0.01, 0.01))
    other = (np.array(center), Rotation.from_rotvec(turned), sides)
    found = pairs([one, other], [0, 0], True)
    assert found[0, 1] == approx(exact_mean(one, other), rel=limit)
    assert found[0, 1] == found[1, 0]


@pytest.mark.parametrize("distance", [0.0118, 0.0148, 0.0152])  # to both sides of 0.75 × 20 mm
def test_pairs_of_one_surface_are_the_same_in_any_frame(distance: float) -> None:
    """Invariant: axes change places, and so do rectangles."""
    found = []
    for turns in range(3):
        frame = Rotation.from_rotvec(np.full(3, turns * 2 * math.pi / 3 / math.sqrt(3)))
        for sign in (-1, 1):
            center = frame.apply([sign * 0.8 * distance, 0.6 * distance, 0.0])
            one = (np.zeros(3), frame, (0.01, 0.01))
            found.append(pairs([one, (center, frame, (0.01, 0.01))], [0, 0], True)[0, 1])
    np.testing.assert_allclose(found, found[0], rtol=1e-5)


@pytest.mark.parametrize("side", [1.0, 0.01])
@pytest.mark.parametrize("gap", [1e-4, 1e-3, 1e-2, 3e-2])
def test_pairs_that_all_but_coincide(gap: float, side: float) -> None:
    """Analytic: squares one above the other, and what charge of opposite signs on them costs;
    that is 2π times the gap where it is small, for sides of one."""
    one = (np.zeros(3), Rotation.identity(), (side, side))
    other = (np.array([0.0, 0.0, gap * side]), Rotation.identity(), (side, side))
    found = side * pairs([one, other], [0, 0], True, -1e9)
    own = 4 * math.log(1 + math.sqrt(2)) - 4 * (math.sqrt(2) - 1) / 3
    assert found[0, 0] == approx(own, rel=1e-5)
    assert found[0, 1] == approx(_mirror_mean(gap), rel=3e-3)
    cost = own - found[0, 1]
    assert cost == approx(2 * math.pi * gap, rel=0.15, abs=1e-5)


def test_rigid_bodies_have_no_pairs_of_their_own() -> None:
    """Invariant: clusters of one rigid body meet through the shape's energies alone."""
    one = (np.zeros(3), Rotation.identity(), (0.01, 0.01))
    other = (np.array([0.01, 0.0, 0.0]), Rotation.identity(), (0.01, 0.01))
    np.testing.assert_allclose(pairs([one, other], [0, 0], False), 0.0, atol=1e-4)


def test_pairs_of_bodies_near_each_other() -> None:
    """Differential: the mean over all sixteen pairs of points, for any number of near ones."""
    rng = np.random.default_rng(7)
    count = 37
    points = rng.uniform(-0.02, 0.02, (count, 1, 3)) + rng.uniform(-3e-3, 3e-3, (count, 4, 3))
    extent, owner = rng.uniform(0.04, 0.12, count), np.repeat([0, 1, 2], [5, 20, 12])
    none = np.zeros(count)
    soft = rng.uniform(0.2, 0.4, count) * extent
    found = leaf_pairs(plain_leaves(points, points, extent, soft, none, owner, none), DEEP)
    for i in range(count):
        for j in range(i):
            wanted = 0.0 if owner[i] == owner[j] else mean_inverse(
                points[i], points[j], max(soft[i], soft[j])
            )  # fmt: skip
            assert found[i, j] == approx(wanted, rel=3e-6, abs=1e-4)


def test_bounded_inverse_distance() -> None:
    """Analytic: 1/√√(r⁴ + s⁴), whatever the order."""
    rng = np.random.default_rng(6)
    first, second = rng.normal(size=(4, 3)), rng.normal(size=(4, 3))
    square = ((first[:, None] - second) ** 2).sum(axis=-1)
    for soft in (0.0, 0.15, 4.5):
        wanted = ((square**2 + soft**4) ** -0.25).mean()
        assert mean_inverse(first, second, soft) == approx(wanted, rel=1e-6)
        assert mean_inverse(second, first, soft) == approx(wanted, rel=1e-6)


@pytest.mark.parametrize("threshold", [0.015, 0.004, 1e-3])
@pytest.mark.parametrize("shape", [BALL, FINGER, BOX], ids=repr)
def test_bodies_that_coincide_leave_a_definite_matrix(shape: cs.Shape, threshold: float) -> None:
    """Invariant: before anything is added to its diagonal. Rings of two fingers are off by 8 %
    where there are few of them."""
    twice = Scene([body(shape, (0.0, 0.01, 0.07), TILTED)] * 2)
    matrix = prepared_alone(twice.packed(), threshold)[3].matrix
    assert np.linalg.eigvalsh(matrix).min() > 0
    one = Scene([twice[0]]).solved(threshold)
    both = twice.solved(threshold)
    assert apart(both.delta, one.delta) < (0.08 if (shape, threshold) == (FINGER, 0.015) else 0.05)


# ---- which functions ----


def fill_scores(looks: ClusterEvaluation, row: int, scores: Array) -> None:
    """Fill in what was found from a row on, that of a body's first cluster."""
    rows = [row]
    while rows:
        row = rows.pop()
        scores[looks.node[row]] = looks.score[row]
        if looks.children[row] >= 0:
            rows += [looks.children[row], looks.children[row] + 1]


def cut_of(scene: Scene, threshold: float) -> tuple[ActiveTree, Array, Array]:
    """The cut, the scores with those that are inherited, and each body's first cluster."""
    bodies = scene.packed()
    first = np.concatenate([[0], np.cumsum(2 * bodies["n"] - 1)])
    green = packed_green()
    scores = np.full(first[-1], math.nan)
    looks, rows = score(bodies, green, threshold, np.empty(green.terminals))
    cut = choose(bodies, looks, rows, threshold, WIDTH, facing_of(bodies[:0]))
    for b, row in enumerate(rows[:-1]):
        fill_scores(looks, row, scores[first[b] : first[b + 1]])
    for o, (_, shape) in zip(first, scene, strict=False):
        children = shape.tree.children
        for k in np.flatnonzero(children[:, 0] >= 0):
            for part in children[k]:
                if not scores[o + part] >= 0:
                    scores[o + part] = twin.DECAY * scores[o + k] if children[part, 0] >= 0 else 0.0
    return cut, scores, first


@pytest.mark.parametrize("name", [n for n in NAMES if n != "two joined, floating"])
def test_scores(name: str) -> None:
    """Differential: what each function alone takes up, raised by the scores below it."""
    check_scores(scenes()[name])


@pytest.mark.parametrize("scale", [1.0, 1.7])
def test_scores_of_a_body_on_a_capacitance_across_a_wall(scale: float) -> None:
    """Differential: its net charge costs the energy of the capacitance too."""
    wall = float(packed_green().active_bounds[1, 0])
    check_scores(Scene([body(BOX, (wall - 0.01, 0.0, 0.05), ground_elastance=20.0, scale=scale)]))


@pytest.mark.parametrize(("height", "scale"), [(0.05, 2.5), (0.25, 2.5), (0.25, 4.0)])
def test_scores_of_a_wide_body_without_net_charge_across_a_wall(
    height: float, scale: float
) -> None:
    """Differential: its large clusters are split only where it counts itself."""
    wall = float(packed_green().active_bounds[1, 0])
    wide = body(BOX, (wall - 0.01, 0.0, height), scale=scale, ground_elastance=NONE)
    check_scores(Scene([body(BALL, (0.0, 0.0, 0.05)), wide]))


def check_scores(scene: Scene) -> None:
    for threshold in (0.015, 0.1):
        _, found, first = cut_of(scene, threshold)
        wanted = twin.scores(scene.pieces, scene.trees, exact(), packed_green(), threshold)
        for b, each in enumerate(wanted):
            mine = found[first[b] : first[b + 1]]
            np.testing.assert_allclose(mine, each, rtol=2e-3, atol=2e-6 * found.max())


@pytest.mark.parametrize("name", NAMES)
def test_scores_and_fades_fall_downwards(name: str) -> None:
    """Invariant: a whole scores no less than its parts; wholes of what is used are used."""
    scene = scenes()[name]
    cut, scores, first = cut_of(scene, 0.05)
    for b, (_, shape) in enumerate(scene):
        children = shape.tree.children
        for k in np.flatnonzero(children[:, 0] >= 0):
            assert scores[first[b] + k] >= scores[first[b] + children[k]].max()
    assert ((cut.fade >= 0) & (cut.fade <= cut.parent_fade) & (cut.parent_fade <= 1)).all()
    places = {(b, k): a for a, (b, k) in enumerate(zip(cut.body, cut.node, strict=True))}
    for a, parts in enumerate(cut.children):
        if parts[0] < 0:
            assert cut.fade[a] == 0
            continue
        assert (parts > a).all()
        tree = scene[cut.body[a]][1].tree
        assert [places[cut.body[a], k] for k in tree.children[cut.node[a]]] == parts.tolist()
        assert (cut.parent_fade[parts] == cut.fade[a]).all()
        assert cut.charge_fraction[a] == approx(
            tree.charge[tree.children[cut.node[a], 0]] / tree.charge[cut.node[a]]
        )
        if cut.fade[a] == 0:  # split for the estimate only
            assert (cut.children[parts] < 0).all()
    x = np.log(scores[first[cut.body] + cut.node] / 0.05 + 1e-300) / math.log(WIDTH)
    x = np.clip(x, 0, 1)
    parted = cut.children[:, 0] >= 0
    wanted = np.minimum(x * x * (3 - 2 * x), cut.parent_fade)
    np.testing.assert_allclose(cut.fade[parted], wanted[parted], atol=1e-12)
    entered = np.clip(cut.parent_fade / 0.1, 0, 1)
    wanted = np.where(parted, 1 - entered * entered * (3 - 2 * entered), 1.0)
    np.testing.assert_allclose(cut.self_weight, wanted, atol=1e-12)
    np.testing.assert_array_equal(cut.active, np.flatnonzero(cut.self_weight > 0))
    np.testing.assert_array_equal(cut.active_index[cut.active], np.arange(len(cut.active)))


@pytest.mark.parametrize("name", NAMES)
def test_nothing_steps_where_a_function_enters(name: str) -> None:
    """Invariant: ΔC does not step at thresholds at which a function is about to enter."""
    scene = scenes()[name]
    _, scores, _ = cut_of(scene, 0.1)
    for value in np.unique(scores)[::-1][1:20]:
        before, after = (scene.solved(value * (1 + t)).delta for t in (1e-7, -1e-7))
        assert apart(before, after) < 2e-5


@pytest.mark.parametrize("name", SOME)
def test_lower_thresholds_use_more(name: str) -> None:
    """Invariant: no function is given up as the threshold falls."""
    before: set[tuple[int, int]] = set()
    for threshold in np.geomspace(3.0, 1e-5, 25):
        cut, _, _ = cut_of(scenes()[name], threshold)
        used = {
            (int(b), int(k)) for b, k, t in zip(cut.body, cut.node, cut.fade, strict=True) if t > 0
        }
        assert before <= used
        before = used
    assert len(before) > 100


@pytest.mark.parametrize("name", NAMES)
def test_converges_as_the_threshold_falls(name: str) -> None:
    """Measured: errors and what is estimated both shrink with the threshold."""
    wanted = scenes()[name].solved().delta
    scale = wanted.max()
    errors, left = [], []
    for threshold in (0.5, 0.05, 5e-3, 5e-4):
        found = scenes()[name].solved(threshold)
        errors.append(np.abs(found.delta - wanted).max() / scale)
        left.append(np.abs(found.residual_correction).max() / scale)
    assert left == sorted(left, reverse=True)
    at_wall = "across" in name
    assert errors[1] < (0.65 if at_wall else 0.45) * errors[0]
    assert errors[2] < (0.75 if at_wall else 0.55) * errors[1]
    assert errors[3] < 8e-4
    assert left[3] < 1e-3


# ---- surfaces that change ----


@pytest.mark.parametrize("shape", [BALL, FINGER, BOX, EGG], ids=repr)
@pytest.mark.parametrize("neutral", [False, True])
def test_changing_and_rigid_bodies_agree(shape: cs.Shape, neutral: bool) -> None:
    """Measured: the same panels, with energies of their own and with rectangles' means."""
    rigid = shape_of(shape, 400)
    piece = Piece(
        rigid.panels, (0.01, 0.0, 0.055), (0.1, 0.2, 0.3), ground_elastance=NONE if neutral else 0.0
    )
    records = Scene([(piece, rigid)]).packed()
    changing = DynamicBody(rigid.tree, rigid.panels)
    other = records.copy()
    for name in ("children", "function", "charge", "center", "spread", "own", "extent"):
        other[name] = changing.record[name]
    other["potential_coefficients"] = other["points"] = 0
    for threshold in (0.015, 1e-4):
        wanted = solve(records, packed_green(), threshold, WIDTH, False)
        found = solve(other, packed_green(), threshold, WIDTH, False)
        assert found.size > 0
        assert apart(found.delta, wanted.delta) < limit(0.022, 0.1)


# ---- losses ----


def lossily(scene: Scene, threshold: float) -> Solution:
    """Solve with complex energies."""
    ties = np.array([complex(p.ground_elastance) for p in scene.pieces])
    soft = np.array([1 / (p.eps_r - 1) if np.isfinite(p.eps_r) else 0.0 for p in scene.pieces])
    return solve_lossy(scene.packed(), ties, soft.astype(complex), packed_green(), threshold, WIDTH)


@pytest.mark.parametrize(
    ("name", "threshold"),
    [(n, t) for n in NAMES for t in (0.2, 0.015, ALL) if t == ALL or n not in TIED],
)
def test_lossy_without_losses(name: str, threshold: float) -> None:
    """Differential: the same scene by both; scores know nothing of ties where there are losses."""
    scene = scenes()[name]
    found, wanted = lossily(scene, threshold), scene.solved(threshold)
    assert apart(found.delta, wanted.delta) < 1e-6
    left = np.abs(found.residual_correction - wanted.residual_correction).max()
    assert left < 1e-6 * np.abs(wanted.delta).max()
    assert apart(found.charge, wanted.charge[:, : found.charge.shape[1]]) < 1e-5


@pytest.mark.parametrize("height", [0.002, -0.008])
def test_lossy_energies_that_are_not_definite_are_raised_too(height: float) -> None:
    """Differential: a box that reaches into the sensor, where both raise the diagonal alike."""
    scene = Scene([body(BOX, (0.02, 0.0, height))])
    found, wanted = lossily(scene, 0.015), scene.solved(0.015)
    assert found.shift == wanted.shift >= 0.0
    assert apart(found.delta, wanted.delta) < 1e-9


@pytest.mark.parametrize("shape", [BALL, BOX, FINGER], ids=repr)
@pytest.mark.parametrize("eps", [3 - 2j, 60 - 300j, 1 - 40j])
@pytest.mark.e2e
def test_lossy_functions_together_are_the_panels(shape: cs.Shape, eps: complex) -> None:
    """Differential: complex energies, one unknown a panel, with and without a tie."""
    for tie in (NONE, 8.0 - 20.0j):
        scene = Scene(
            [body(shape, (0.01, 0.0, 0.05), TILTED, ground_elastance=tie, eps_r=eps),
             body(FINGER, (0.0, 0.08, 0.05))]
        )  # fmt: skip
        wanted = twin.galerkin(scene.pieces, exact(), packed_green().active_bounds)
        assert apart(lossily(scene, ALL).delta, wanted) < 3e-5


def reading(*bodies: cs.Body) -> Array:
    """ΔC [F] of a scene, by the solver."""
    solver = coarse_solver()
    _, solution = solver.solution(solver.look(cs.Scene(list(bodies))))
    assert solution is not None
    return UNIT * solution.delta.real


def ball(material: cs.Material, grounding: str | float = "grounded") -> cs.Body:
    return cs.Body(cs.Sphere(0.03), cs.Pose((0.01, 0.0, 0.05)), material, grounding)


@pytest.mark.parametrize("sigma", [0.0, 1e-9])
def test_nothing_comes_of_matter_like_air(sigma: float) -> None:
    """Analytic: ΔC falls in proportion to eps - 1 and vanishes with it."""

    def of(eps: float) -> float:
        return float(reading(ball(cs.Material("m", eps, sigma), "floating")).max())

    metal = float(reading(ball(cs.Material("metal", 1.0, 1e6), "floating")).max())
    assert of(1.0) < 1e-4 * metal
    assert of(1.02) / of(1.01) == approx(2.0, rel=0.02)
    assert of(1.1) < 0.1 * metal


@pytest.mark.parametrize("grounding", ["grounded", "floating"])
@pytest.mark.parametrize("lossy", [False, True])
def test_conductors_are_the_limit_of_large_eps(grounding: str, lossy: bool) -> None:
    """Measured: across the permittivity from which the inside is left out."""
    unit = 2 * math.pi * 250e3 * cs.constants.EPS0

    def of(size: float) -> Array:
        if lossy:
            return reading(ball(cs.Material("m", 2.0, size * unit), grounding))
        return reading(ball(cs.Material("m", size), grounding))

    below, above = of(0.999 * CONDUCTING), of(1.001 * CONDUCTING)
    assert apart(below, above) < 1e-3
    assert not np.array_equal(below, above)


# ---- matter ----


def packed(*bodies: cs.Body) -> Array:
    """Records of a scene, by the solver."""
    solver = coarse_solver()
    return solver.pack(solver.look(cs.Scene(list(bodies)))).records


def cube(x: float, grounding: str | float, material: str | cs.Material = "steel") -> cs.Body:
    """20 mm wide, at x widths."""
    return cs.Body(cs.Box((0.02, 0.03, 0.03)), cs.Pose((0.02 * x, 0.0, 0.045)), material, grounding)


def test_ties_of_conductors() -> None:
    """Analytic: none at ground, no net charge if floating, 4π eps0 / C on a capacitance."""
    found = packed(cube(-2, "grounded"), cube(0, "floating"), cube(2, 5e-12))
    assert found["neutral"].tolist() == [0, 1, 0]
    np.testing.assert_allclose(found["ground_elastance"], [0.0, 0.0, UNIT / 5e-12])
    assert found["group"].tolist() == [0, 1, 2]
    assert (found["inverse_susceptibility"] == 0).all()


def test_matter_of_dielectrics() -> None:
    """Analytic: 1 / (eps - 1); net charge only where displacement current brings it."""
    found = packed(
        *(cube(3 * k, "grounded", cs.Material(f"m{k}", eps)) for k, eps in ((-1, 3), (0, 200))),
        cube(3, "floating", cs.Material("m", 5000)),
    )
    assert found["neutral"].tolist() == [1, 1, 1]
    np.testing.assert_allclose(found["inverse_susceptibility"], [1 / 2, 1 / 199, 1 / 4999])
    assert (found["neumann_to_dirichlet"] != 0).all()
    tied = packed(cube(0, "grounded", cs.Material("m", 5000)))
    size = shape_of(cs.Box((0.02, 0.03, 0.03)), 300).capacitance
    assert tied["neutral"][0] == 0
    assert tied["ground_elastance"][0] == approx(5.0 / (5000 * size), rel=1e-6)


@pytest.mark.parametrize("order", [(0, 1, 2), (0, 2, 1), (2, 1, 0), (1, 0, 2)])
def test_three_in_a_row_are_one_conductor(order: tuple[int, ...]) -> None:
    """Invariant: whatever the order, on the sum of the capacitances; apart, each by itself."""
    states = ("floating", 2e-12, 3e-12)
    found = packed(*(cube(k - 1, states[k]) for k in order))
    assert found["group"].tolist() == [0, 0, 0]
    assert found["neutral"].tolist() == [0, 0, 0]
    np.testing.assert_allclose(found["ground_elastance"], UNIT / 5e-12)
    found = packed(*(cube(1.1 * (k - 1), states[k]) for k in order))
    assert found["group"].tolist() == [0, 1, 2]
    assert sorted(found["neutral"].tolist()) == [0, 0, 1]


def test_one_grounded_conductor_grounds_all_that_touch() -> None:
    """Invariant: the first of three in a row is at ground, and so is the last."""
    found = packed(cube(-1, "grounded"), cube(0, "floating"), cube(1, 1e-12))
    assert found["neutral"].tolist() == [0, 0, 0]
    assert (found["ground_elastance"] == 0).all()
    mixed = reading(cube(-1, "grounded"), cube(0, "floating"), cube(1, 1e-12))
    assert apart(mixed, reading(*(cube(k, "grounded") for k in (-1, 0, 1)))) < 1e-9


def test_dielectrics_join_nothing() -> None:
    """Invariant: matter between two conductors keeps them apart."""
    plastic = cs.Material("plastic", 3.0)
    found = packed(cube(-1, "floating"), cube(0, "floating", plastic), cube(1, "floating"))
    assert found["group"].tolist() == [0, 1, 2]
    assert found["neutral"].tolist() == [1, 1, 1]


@pytest.mark.parametrize("grounding", ["grounded", "floating", 1e-12])
def test_pieces_in_a_row_read_as_the_whole(grounding: str | float) -> None:
    """Measured: three boxes that touch and one three times as long."""
    whole = cs.Body(cs.Box((0.06, 0.03, 0.03)), cs.Pose((0.0, 0.0, 0.045)), "steel", grounding)
    share = grounding / 3 if isinstance(grounding, float) else grounding
    pieces = reading(*(cube(k, share) for k in (-1, 0, 1)))
    assert apart(pieces, reading(whole)) < 0.012


@pytest.mark.parametrize("grounding", ["grounded", "floating", 1e-12])
def test_losses_elsewhere_leave_joined_conductors_alone(grounding: str | float) -> None:
    """Measured: a lossy speck far off changes a little which functions are chosen."""
    row = [cube(-0.5, grounding), cube(0.5, grounding)]
    speck = cs.Body(cs.Sphere(0.002), cs.Pose((0.0, 0.1, 0.25)), cs.Material("wet", 5.0, 1e-5))
    assert apart(reading(*row, speck), reading(*row)) < 9e-3


def test_threads_that_meet_a_shape_share_its_arrays() -> None:
    """Invariant: records hold addresses, so no thread may replace what another points to."""
    shape = rigid_shape(panels_of(cs.Box((0.02, 0.03, 0.04)), 100), apart=True)
    start = threading.Barrier(4)

    def met(_: int) -> tuple[int, int]:
        start.wait()
        return shape.neumann_to_dirichlet.ctypes.data, shape.own.ctypes.data

    with ThreadPoolExecutor(4) as pool:
        assert len(set(pool.map(met, range(4)))) == 1


@pytest.mark.parametrize("sigma", [1e-6, 1e-4, 1e-2])
def test_conductance_of_a_lossy_ball(sigma: float) -> None:
    """Analytic: a ball far off answers as its polarisability, (ε* − 1) / (ε* + 2)."""
    sim = simulator()
    omega = 2 * math.pi * sim.excitation_frequency

    def answer(material: cs.Material) -> cs.Reading:
        ball = cs.Body(cs.Sphere(0.02), cs.Pose((0.0, 0.0, 0.15)), material, "floating")
        return sim.step(cs.Scene([ball]))

    eps = 5.0 - 1j * sigma / (omega * cs.constants.EPS0)
    reading, metal = answer(cs.Material("wet", 5.0, sigma)), answer(cs.Material("metal", 1.0, 1e6))
    assert metal.conductance is None
    wanted = (eps - 1) / (eps + 2)
    found = reading.delta - 1j * reading.conductance / omega
    assert abs(found.trace() / metal.delta.trace() - wanted) < 0.01 * abs(wanted)
    loss = np.linalg.eigvalsh(reading.conductance)
    assert loss.min() > -1e-3 * loss.max()  # it takes up power


@pytest.mark.parametrize("m", [8, 16, 24])
def test_products_of_wide_matrices(m: int) -> None:
    """Differential: designs of more than eight terminals, eight columns at a time."""
    left, right = np.random.default_rng(m).normal(size=(2, 5, m))
    out = np.ones((m, m))
    add_products(left, right, out)
    np.testing.assert_allclose(out, 1.0 + left.T @ right, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize(
    ("between", "raised"), [(0.9, 0.0), (1.0005, 0.12), (1.05, 0.24), (1.1, 0.48)]
)
def test_energies_that_are_not_definite_are_raised(between: float, raised: float) -> None:
    """Analytic: by four times the first of 0.03, 0.06, 0.12, … of itself that makes it so."""
    root, own = np.array([0.8, 0.5]), np.array([-2.0, 2.0])
    matrix = np.array([[2.0, 5.0 * between], [5.0 * between, 2.0]])
    factor, right = np.empty((2, 16)), np.random.default_rng(2).normal(size=(2, 8))
    assert factorise(matrix, root, own, factor) == approx(raised)
    x = right.copy()
    substitute(factor, x)
    wanted = np.array([[2.0 + 2.0 * raised, 2.0 * between], [2.0 * between, 2.0 + 2.0 * raised]])
    np.testing.assert_allclose(wanted @ x, right, rtol=0, atol=1e-11)


def test_energies_that_cannot_be_raised_are_refused() -> None:
    """Limits: nothing to raise by; and no function at all, which is no failure."""
    matrix, factor = np.array([[1.0, 2.0], [2.0, 1.0]]), np.empty((2, 16))
    assert factorise(matrix, np.ones(2), np.zeros(2), factor) == -1.0
    assert factorise(np.empty((0, 0)), np.empty(0), np.empty(0), np.empty((0, 0))) == 0.0


def test_energy_of_charge_along_a_sheet() -> None:
    """Analytic: 6 / ((eps - 1) t) besides, of each function by itself; none of the net charge."""
    plain = Scene([body(BOX, (0.01, 0.0, 0.05), TILTED, eps_r=5.0, ground_elastance=20.0)]).packed()
    thin = plain.copy()
    thin["sheet"] = 2e-3
    before, after = (prepared_alone(b, 0.05)[2:] for b in (plain, thin))
    functions, solved = before[0], before[0].solved
    assert 1 < solved < len(functions.cluster)
    wanted = np.where(functions.cluster < 0, 0.0, 6.0 / (4.0 * 2e-3))
    np.testing.assert_allclose(after[1].diagonal - before[1].diagonal, wanted, atol=1e-9)
    more = after[1].matrix - before[1].matrix
    np.testing.assert_allclose(more, np.diag(wanted[:solved]), atol=1e-9)


def test_products_of_modes_of_either_sign() -> None:
    """Differential: the last modes count where they are all negative, too."""
    psi = -np.random.default_rng(4).uniform(0.5, 1.0, (11, 40)).astype(np.float32)
    psi[:, 33:] = 0.0
    found, wanted = _products(psi, 6), psi @ psi[:6].T
    for f in range(11):
        np.testing.assert_allclose(found[f, : min(f + 1, 6)], wanted[f, : f + 1], rtol=1e-5)
