"""The compiled sweeps against matrices written out in full."""

from __future__ import annotations

import numpy as np
import pytest
from field_cases import COARSE
from random_scenes import random_scene

import capsense as cs
from capsense._simd import LANES, aligned_zeros
from capsense.solve.packed import packed_lattice
from capsense.solve.pcg_kernels import Operator, Vectors, backward, finish, forward, start

Array = np.ndarray

RELAX, LOWEST = 0.97, 0.02
WITHIN = 2e-5
"""Single precision, sums of some dozen terms."""


@pytest.fixture(scope="module", params=[0, 1, 2])
def case(request, simulators) -> tuple[Operator, Array, Array]:
    """The operator that a random scene leaves behind, the nodes that are on, their matrix."""
    sim = simulators("three_stripes", settings=COARSE)
    sim.step(random_scene(np.random.default_rng(request.param), 1 + request.param))
    mesh = packed_lattice(sim.background)
    operator = mesh.spare[-1].operator
    on = np.flatnonzero(sim._solver._active.astype(bool) & sim.background.lattice.unknown)
    on = on[sim.background.lattice.home[on] == on]
    return operator, on, matrix(operator, on)


def matrix(operator: Operator, on: Array) -> Array:
    """The operator at the nodes that are on: links of each storey, and from storey to storey."""
    weight = operator.weight.astype(float)
    number = np.full(weight.shape[1], -1)
    number[on] = np.arange(len(on))
    out = np.diag(operator.diagonal[on].astype(float))
    leads = dict(zip(operator.ceiling.tolist(), operator.parent.tolist(), strict=True))
    floors = {parent - 1 for parent in operator.parent.tolist()}
    for first, nx, ny, nz in operator.storeys.tolist():
        for a in range(first, first + nx * ny * nz):
            for axis, stride in enumerate((ny * nz, nz, 1)):
                if a in floors or weight[axis, a] == 0.0:
                    continue
                b = leads.get(a + stride, a + stride)
                i, j = number[a], number[b] if b < len(number) else -1
                if i >= 0 and j >= 0:
                    out[i, j] = out[j, i] = -weight[axis, a]
    return out


def pivots(operator: Operator, on: Array, matrix: Array) -> Array:
    """Pivots of the factorisation that drops all fill-in, a part of it moved to the diagonal.

    Links to nodes that are held make fill-in like others.
    """
    out = np.diag(matrix).copy()
    onward = operator.weight[:, on].astype(float).sum(axis=0)
    for k in range(len(out)):
        out[k] = max(out[k], LOWEST * matrix[k, k])
        later = k + 1 + np.flatnonzero(matrix[k, k + 1 :])
        links = -matrix[k, later]
        out[later] -= links * (links + RELAX * (onward[k] - links)) / out[k]
    return out


def filled(operator: Operator, on: Array, rng: np.random.Generator) -> tuple[Vectors, Array]:
    """Vectors of which u, r and p are random at the nodes that are on; these three."""
    shape = (operator.weight.shape[1], LANES)
    vectors = Vectors(*(aligned_zeros(shape, np.float32) for _ in range(4)))
    values = rng.normal(size=(3, len(on), LANES)).astype(np.float32)
    vectors.u[on], vectors.r[on], vectors.p[on] = values
    return vectors, values.astype(float)


def preconditioned(matrix: Array, d: Array, r: Array) -> Array:
    """M⁻¹ r for M = (D + L) D⁻¹ (D + Lᵀ)."""
    lower = np.tril(matrix, -1) + np.diag(d)
    return np.linalg.solve(lower.T, d[:, None] * np.linalg.solve(lower, r))


def assert_close(got: Array, expected: Array) -> None:
    np.testing.assert_allclose(got, expected, rtol=0, atol=WITHIN * np.abs(expected).max())


def test_pivots_are_those_of_the_slow_factorisation(case):
    """Differential, storeys and bodies included."""
    operator, on, a = case
    assert_close(operator.inverse[on], 1.0 / pivots(operator, on, a))
    off = np.ones(len(operator.inverse), bool)
    off[on] = False
    off[operator.parent - 1] = False  # floors keep what is taken from the node above
    assert not operator.inverse[off].any()


def test_start_takes_the_residual_and_preconditions_it(case):
    """Differential: r − A u, the first direction M⁻¹ r, its image, and what both come to."""
    operator, on, a = case
    vectors, (u, r, _) = filled(operator, on, np.random.default_rng(5))
    rz, pap = aligned_zeros((1, LANES), np.float64), aligned_zeros((1, LANES), np.float64)
    start(operator, vectors, rz, False)
    residual = r - a @ u
    assert_close(vectors.r[on], residual)
    z = preconditioned(a, pivots(operator, on, a), residual)
    assert_close(rz[0], (residual * z).sum(axis=0))
    vectors.p[on] = np.nan  # whatever was left there
    backward(operator, vectors, *steps(), True, pap)
    assert_close(vectors.p[on], z)
    assert_close(vectors.z[on], a @ z)
    assert_close(pap[0], (z * (a @ z)).sum(axis=0))
    assert_close(vectors.u[on], u)


def test_a_fresh_start_takes_the_solution_for_zero(case):
    """Differential: the same as with a solution of zeros."""
    operator, on, _ = case
    vectors, (_, r, _) = filled(operator, on, np.random.default_rng(7))
    rz, same = aligned_zeros((1, LANES), np.float64), aligned_zeros((1, LANES), np.float64)
    start(operator, vectors, rz, True)
    assert_close(vectors.r[on], r)
    fresh = vectors.z.copy()
    vectors.u[:] = 0.0
    start(operator, vectors, same, False)
    np.testing.assert_array_equal(vectors.z, fresh)
    np.testing.assert_array_equal(rz, same)


def test_an_iteration_goes_on_along_its_direction(case):
    """Differential: r − α A p and its M⁻¹; u + α p, z + β p and its image; u and r at the end."""
    operator, on, a = case
    vectors, (u, r, p) = filled(operator, on, np.random.default_rng(6))
    alpha, beta = steps()
    image = np.random.default_rng(9).normal(size=p.shape).astype(np.float32)
    vectors.z[on] = image  # A p, as far as the sweep knows
    rz, pap = aligned_zeros((1, LANES), np.float64), aligned_zeros((1, LANES), np.float64)
    forward(operator, vectors, alpha, rz)
    residual = r - alpha[0] * image
    assert_close(vectors.r[on], residual)
    z = preconditioned(a, pivots(operator, on, a), residual)
    assert_close(rz[0], (residual * z).sum(axis=0))
    backward(operator, vectors, alpha, beta, False, pap)
    direction = z + beta[0] * p
    assert_close(vectors.u[on], u + alpha[0] * p)
    assert_close(vectors.p[on], direction)
    assert_close(vectors.z[on], a @ direction)
    assert_close(pap[0], (direction * (a @ direction)).sum(axis=0))
    out = np.ones((LANES, LANES))
    finish(operator, vectors, alpha, out)
    last, left = u + alpha[0] * (p + direction), residual - alpha[0] * (a @ direction)
    assert_close(vectors.u[on], last)
    assert_close(vectors.r[on], left)
    assert_close(out, 1 + last.T @ left)


def steps() -> tuple[Array, Array]:
    """α and −α, and β, different in every lane."""
    alpha = np.linspace(0.1, 0.8, LANES, dtype=np.float32)
    return np.stack([alpha, -alpha]), np.linspace(-1, 2, LANES, dtype=np.float32)[None]


def test_sensors_of_a_design_hand_their_working_space_on(simulators):
    """Invariant: one after the other they need one, and read what a sensor alone reads."""
    first = simulators("three_stripes", settings=COARSE)
    second = first.sibling()
    rng = np.random.default_rng(8)
    scenes = [random_scene(rng, 1 + k % 4) for k in range(6)]
    alone = [first.step(s).delta for s in scenes]
    first.reset()
    spare = packed_lattice(first.background).spare
    before = len(spare)
    for scene, other, expected in zip(scenes, reversed(scenes), alone, strict=True):
        np.testing.assert_array_equal(first.step(scene).delta, expected)
        second.step(other)
    assert packed_lattice(second.background).spare is spare
    assert len(spare) == before


@pytest.mark.parametrize("stage", ["_solve_blocks", "_trace"])
def test_a_step_that_is_cut_off_leaves_nothing_behind(simulators, monkeypatch, stage):
    """Its working space is not used again, and the next step starts from rest."""
    sim = simulators("three_stripes", settings=COARSE)
    ball = cs.Body(cs.Sphere(0.02))
    here, there = (cs.Scene([ball.moved(cs.Pose((0, y, 0.05)))]) for y in (-0.02, 0.02))
    expected = sim.step(here).delta
    sim.reset()
    sim.step(here)
    spare = packed_lattice(sim.background).spare
    before = len(spare)
    work = getattr(sim._solver, stage)

    def cut_off(*arguments: object) -> None:
        work(*arguments)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(sim._solver, stage, cut_off)
        with pytest.raises(KeyboardInterrupt):
            sim.step(there)
    assert len(spare) == before - 1
    np.testing.assert_array_equal(sim.step(here).delta, expected)
