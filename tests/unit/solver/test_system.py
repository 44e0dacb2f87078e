"""The system of charge functions and its solution, against a slow twin in NumPy."""

from __future__ import annotations

import interpreted
import numpy as np
import pytest
import surface_twin as twin
from approximate import approx
from interpreted import fewer, limit
from solver_scenes import (
    BALL,
    BOX,
    EGG,
    FINGER,
    NAMES,
    NONE,
    SOME,
    TILTED,
    WIDTH,
    Scene,
    apart,
    body,
    exact,
    packed_green,
    prepared_alone,
    scenes,
    shape_of,
)
from surface_twin import Piece

import capsense as cs
from capsense._dense import substitute
from capsense.solver.selection.selection_kernels import ActiveTree
from capsense.solver.system.step import FIELD_ERROR, estimate, potential_change, solve, solve_each
from capsense.solver.system.system_kernels import Reduced, _products, factorise, part_of, reduced
from capsense.solver.tree.dynamic_surface import DynamicBody


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
    clusters = twin.Clusters(found.points, found.softening_length, found.owner)
    out, _ = twin.beyond(clusters, scene.pieces, packed_green().active_bounds)
    phi *= 1.0 - out[:, None]
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


@pytest.mark.parametrize("wanted", [[1, 0, 0], [0, 1, 1], [0, 0, 0]])
def test_system_of_some_bodies(wanted: list[bool]) -> None:
    """Differential: what these bodies change by themselves, with all functions."""
    bodies, some = scenes()["three of all kinds"].packed(), np.array(wanted, bool)
    _, _, functions, system = prepared_alone(bodies, 1e-9)
    part, theirs = part_of(functions, system, some)
    assert part.solved == np.count_nonzero(some[functions.body[: functions.solved]])
    alone = bodies[some]
    alone["group"] = np.arange(len(alone))
    if not some.any():
        assert part.cluster.shape == (0,)
        return
    _, _, own, exactly = prepared_alone(alone, 1e-9)
    found, expected = reduced(part, theirs, False), reduced(own, exactly, False)
    np.testing.assert_array_equal(part.cluster.shape, own.cluster.shape)
    np.testing.assert_allclose(found.delta, expected.delta, atol=2e-6 * expected.delta.max())
    np.testing.assert_allclose(found.left, expected.left, atol=2e-6 * expected.delta.max())


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


@pytest.mark.parametrize("known", [0, 5])
def test_energy_of_charge_along_a_sheet(known: int) -> None:
    """Analytic: 6 / ((eps - 1) t) besides, of each function by itself; none of the net charge.

    Nor of the functions whose impedance is in a table, the first ``known`` ones. All have less as
    their charge is on both faces.
    """
    plain = Scene([body(BOX, (0.01, 0.0, 0.05), TILTED, eps_r=5.0, ground_elastance=20.0)]).packed()
    table = np.zeros((known, known), np.float32)
    plain["n_tabulated"], plain["neumann_to_dirichlet"] = known, table.ctypes.data
    plain["potential_coefficients"] = 0  # this table has as many rows
    less = np.arange(float(plain["n"][0]))
    thin = plain.copy()
    thin["sheet"], thin["faces"] = 2e-3, less.ctypes.data
    before, after = (prepared_alone(b, 0.05)[2:] for b in (plain, thin))
    functions, solved = before[0], before[0].solved
    assert known < solved < len(functions.cluster)
    along = np.where(functions.number < known, 0.0, 6.0 / (4.0 * 2e-3))
    less = less[functions.number] / plain["scale"][0]
    wanted = np.where(functions.net, 0.0, along - less)
    assert np.count_nonzero(wanted[:solved]) == solved - 1
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
