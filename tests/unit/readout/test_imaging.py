"""Sensitivity against re-solved fields, and what images must satisfy."""

from __future__ import annotations

import numpy as np
import pytest
from approximate import approx
from scipy.optimize import nnls
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import spsolve

from capsense.constants import EPS0
from capsense.errors import ReadoutError
from capsense.readout.imaging import (
    back_projection,
    electrode_pairs,
    grounded_sensitivity,
    landweber,
    sensitivity,
    tikhonov,
    voxel_centres,
)

AXES = tuple(0.01 * np.cumsum([0, *steps]) for steps in (
    [1.0, 1.5, 1.0, 0.8, 1.2, 1.0], [1.0, 1.0, 0.7, 1.3, 1.0], [0.5, 0.7, 1.0, 1.3, 1.6],
))  # fmt: skip
SHAPE = tuple(len(a) for a in AXES)
CELLS = tuple(n - 1 for n in SHAPE)
PAIRS = electrode_pairs(3, diagonal=True)


def electrode_nodes():
    """Owners of nodes: three electrodes on the floor, the walls at −2, free ones at −1."""
    owner = np.full(SHAPE, -1)
    owner[[0, -1]] = owner[:, [0, -1]] = owner[:, :, [0, -1]] = -2
    owner[1:3, 1:3, 0], owner[4:6, 1:3, 0], owner[2:5, 4, 0] = 0, 1, 2
    return owner


def solve(eps_r, grounded=None):
    """Slow reference: 7-point fields and Maxwell matrix for cell permittivities.

    One more node may be grounded.
    """
    owner = electrode_nodes()
    if grounded is not None:
        owner[grounded] = -2
    owner = owner.ravel()
    index = np.arange(np.prod(SHAPE)).reshape(SHAPE)
    steps = [np.diff(a) for a in AXES]
    rows, columns, weights = [], [], []
    for i, j, k in np.ndindex(*CELLS):
        size = np.array([steps[0][i], steps[1][j], steps[2][k]])
        for axis in range(3):
            weight = EPS0 * eps_r[i, j, k] * size.prod() / size[axis] ** 2 / 4
            others = [a for a in range(3) if a != axis]
            for one in (0, 1):
                for two in (0, 1):
                    low = [i, j, k]
                    low[others[0]] += one
                    low[others[1]] += two
                    high = list(low)
                    high[axis] += 1
                    rows.append(index[tuple(low)])
                    columns.append(index[tuple(high)])
                    weights.append(weight)
    n = index.size
    link = coo_matrix((weights, (rows, columns)), (n, n)).tocsr()
    link = link + link.T
    stiffness = (-link).tolil()
    stiffness.setdiag(np.asarray(link.sum(axis=1)).ravel())
    stiffness = stiffness.tocsr()
    free = owner == -1
    phi = np.zeros((n, 3))
    for electrode in range(3):
        phi[owner == electrode, electrode] = 1.0
    phi[free] = spsolve(stiffness[free][:, free].tocsc(), -(stiffness[free][:, ~free] @ phi[~free]))
    return phi.reshape(*SHAPE, 3), phi.T @ (stiffness @ phi)


@pytest.fixture(scope="module")
def field():
    """Potentials, Maxwell matrix and J of a box with varied permittivity."""
    eps_r = np.random.default_rng(0).uniform(1, 4, CELLS)
    potentials, capacitance = solve(eps_r)
    return eps_r, potentials, capacitance, sensitivity(potentials, AXES, PAIRS)


def test_energy(field):
    """Invariant: weighted with the permittivity, the sensitivities sum to the capacitance."""
    eps_r, _, capacitance, j = field
    assert j @ eps_r.ravel() == approx([capacitance[p] for p in PAIRS], rel=1e-9)


def test_derivative_by_permittivity(field):
    """Differential: against fields solved again with one cell changed a little, every 7th cell."""
    eps_r, _, _, j = field
    for cell in range(0, eps_r.size, 7):
        changed = []
        for sign in (1, -1):
            other = eps_r.copy().ravel()
            other[cell] += sign * 1e-3
            changed.append(solve(other.reshape(CELLS))[1])
        slope = (changed[0] - changed[1]) / 2e-3
        expected = np.array([slope[p] for p in PAIRS])
        assert np.abs(j[:, cell] - expected).max() < 1e-6 * np.abs(j[:, cell]).max() + 1e-20


def test_grounded_matter(field):
    """Differential: a node at ground adds c φ_i φ_j, c the same for all pairs; J is its mean."""
    eps_r, potentials, capacitance, _ = field
    node = (3, 2, 3)
    change = solve(eps_r, grounded=node)[1] - capacitance
    product = np.array([potentials[node][i] * potentials[node][j] for i, j in PAIRS])
    ratio = np.array([change[p] for p in PAIRS]) / product
    assert ratio == approx(np.full(len(PAIRS), ratio[0]), rel=1e-8)
    assert ratio[0] > 0
    j = grounded_sensitivity(potentials, AXES, PAIRS).reshape(len(PAIRS), *CELLS)
    corners = potentials[2:4, 1:3, 4:6].reshape(8, 3)
    expected = [(corners[:, a] * corners[:, b]).mean() for a, b in PAIRS]
    assert j[:, 2, 1, 4] == approx(expected, rel=1e-12)


def test_uniform_field_is_exact():
    """Analytic: between plates, C = ε A/d in equal parts by volume, on any grid."""
    z = AXES[2]
    phi = np.broadcast_to(1 - z / z[-1], SHAPE)[..., None]
    j = sensitivity(phi, AXES, [(0, 0)])[0]
    volume = np.einsum("i,j,k->ijk", *(np.diff(a) for a in AXES)).ravel()
    assert j == approx(EPS0 * volume / z[-1] ** 2, rel=1e-12)


def test_voxel_centres_are_in_the_order_of_columns(field):
    """The most sensitive voxel of an electrode lies at that electrode."""
    centres = voxel_centres(AXES)
    assert centres.shape == (np.prod(CELLS), 3)
    for number, cell in enumerate(np.ndindex(*CELLS)):
        middle = [(axis[k] + axis[k + 1]) / 2 for axis, k in zip(AXES, cell, strict=True)]
        assert centres[number] == approx(middle, rel=1e-12)
    _, _, _, j = field
    spot = centres[np.argmax(j[PAIRS.index((0, 0))])]
    assert spot[2] == approx(0.0025, rel=1e-9)
    assert 0 < spot[0] < 0.035


@pytest.mark.parametrize("method", [back_projection, tikhonov])
def test_a_voxels_own_signal_is_brightest_in_it(field, method):
    """Theorem: for every voxel, with any regularisation; on a matrix of any scale."""
    _, _, _, j = field
    image_of = method(j)
    assert image_of.shape == (j.shape[1], len(PAIRS))
    images = image_of @ j  # column v: the image of voxel v's signal
    assert (np.diag(images) >= images.max(axis=0) * (1 - 1e-9)).all()
    assert np.isfinite(method(np.hstack([j, np.zeros((len(PAIRS), 1))]))).all()


def test_tikhonov_minimises_what_it_states(field):
    """Differential: the same image from the voxels' own normal equations; standardised, scaled."""
    _, _, _, j = field
    scaled = j / np.abs(j).max()
    d = scaled @ np.random.default_rng(1).uniform(0, 1, j.shape[1])
    strength = 1e-2 * np.linalg.eigvalsh(scaled @ scaled.T)[-1]
    inverse = np.linalg.inv(scaled.T @ scaled + strength * np.eye(j.shape[1]))
    direct = inverse @ scaled.T @ d
    assert tikhonov(scaled, 1e-2, standardised=False) @ d == approx(direct, rel=1e-5)
    own = np.sqrt(np.diag(inverse @ scaled.T @ scaled))
    assert tikhonov(scaled, 1e-2) @ d == approx(direct / own, rel=1e-5)


def test_tikhonov_explains_the_data_as_strength_falls(field):
    _, _, _, j = field
    d = j @ np.random.default_rng(2).uniform(0, 1, j.shape[1])
    misfits = [
        np.linalg.norm(j @ (tikhonov(j, s, standardised=False) @ d) - d)
        for s in (1e-1, 1e-3, 1e-6, 1e-9)
    ]
    assert (np.diff(misfits) < 0).all()
    assert misfits[-1] < 1e-3 * np.linalg.norm(d)


def test_landweber_tends_to_the_constrained_least_squares(field):
    """Differential: its misfit comes down to that of non-negative least squares; bounds hold."""
    _, _, _, j = field
    scaled = np.abs(j) / np.abs(j).max(axis=1, keepdims=True)
    d = scaled @ np.random.default_rng(3).uniform(0, 1, j.shape[1])
    d[0] = -1.0  # which no image of positive voxels explains
    _, best = nnls(scaled, d)
    assert best > 0.5
    misfits = []
    for iterations in (10, 100, 1000, 20_000):
        image = landweber(scaled, iterations)(d)
        assert (image >= 0).all()
        misfits.append(np.linalg.norm(scaled @ image - d))
    assert (np.diff(misfits) <= 0).all()
    assert misfits[-1] == approx(best, rel=0.02)
    assert landweber(scaled, 50, low=-0.1, high=0.2)(d).max() <= 0.2


def test_landweber_by_the_signal_of_voxels(field):
    """Differential: the same as with every column divided by its length."""
    _, _, _, j = field
    d = j @ np.random.default_rng(5).uniform(0, 1, j.shape[1])
    found = landweber(j, 30, unit_voxels=True)(d)
    expected = landweber(j / np.linalg.norm(j, axis=0), 30)(d)
    assert found == approx(expected, rel=1e-9)
    assert np.abs(landweber(j, 30)(d) - found).max() > 0


def test_landweber_takes_many_frames(field):
    _, _, _, j = field
    d = np.random.default_rng(4).normal(0, 1e-15, (7, len(PAIRS)))
    images = landweber(j, 20)(d)
    assert images.shape == (7, j.shape[1])
    assert images[3] == approx(landweber(j, 20)(d[3]), abs=1e-9 * np.abs(images).max())


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: sensitivity(np.zeros((2, 2, 2, 1)), AXES, [(0, 0)]), "potentials have shape"),
        (lambda: sensitivity(np.zeros((*SHAPE, 2)), AXES, [(0, 2)]), r"pair \(0, 2\)"),
        (lambda: sensitivity(np.full((*SHAPE, 1), np.nan), AXES, [(0, 0)]), "not finite"),
        (lambda: sensitivity(np.zeros(8), (AXES[0][::-1], *AXES[1:]), []), "axis x must hold"),
        (
            lambda: sensitivity(np.zeros((1, *SHAPE[1:], 1)), (AXES[0][:1], *AXES[1:]), []),
            "at least",
        ),
        (
            lambda: sensitivity(np.zeros((*SHAPE, 1)), (AXES[0], AXES[1][:, None], AXES[2]), []),
            "axis y must hold",
        ),
        (lambda: sensitivity(np.zeros((*SHAPE, 1)), AXES[:2], []), "2 axes are given"),
        (lambda: sensitivity(np.zeros((*SHAPE, 1)), AXES, [(0, 0.5)]), "an electrode is 0.5"),
        (lambda: sensitivity(np.zeros((*SHAPE, 1)), AXES, [(0, 0, 0)]), "names 3 electrodes"),
        (lambda: tikhonov(np.ones((2, 3)), "weak"), "strength is 'weak'"),
        (lambda: landweber(np.ones((2, 3)), 2.5), "iterations is 2.5"),
        (lambda: tikhonov(np.ones((2, 3)), 0.0), "strength is 0.0"),
        (lambda: tikhonov(np.zeros((2, 3))), "matrix is zero"),
        (lambda: landweber(np.zeros((2, 3))), "matrix is zero"),
        (lambda: landweber(np.ones((2, 3)))([1, 2, 3]), "give 2 numbers an image"),
        (lambda: landweber(np.ones((2, 3)), 0), "iterations is 0"),
        (lambda: landweber(np.ones((2, 3)), low=1, high=0), "low below high"),
        (lambda: back_projection([1.0]), "J has shape"),
    ],
)
def test_bad_input_is_refused(make, words):
    with pytest.raises(ReadoutError, match=words):
        make()
