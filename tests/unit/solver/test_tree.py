"""Trees of panels and their charge functions: against explicit matrices and sums over members."""

from __future__ import annotations

import ctypes
import math

import numpy as np
import pytest
import surface_twin as twin
from approximate import approx
from solver_scenes import BALL, BOX, CYLINDER, EGG, FINGER, Array, charge_of, shape_of

import capsense as cs
from capsense.solver.bodies.blocks import free_block
from capsense.solver.bodies.panels import panels_of
from capsense.solver.tree import tree_kernels
from capsense.solver.tree.dynamic_surface import DynamicBody
from capsense.solver.tree.mean_kernels import quadrature4
from capsense.solver.tree.rigid import Clusters, rigid_shape, split


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
