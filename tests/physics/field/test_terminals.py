"""Floating conductors of a design taken out of Maxwell matrices, against the charge they lack."""

from __future__ import annotations

import numpy as np
import pytest
from field_cases import patches, rectangle, sheet

from capsense.design.model import Conductor, Design, Role
from capsense.field.background import Terminals

Array = np.ndarray
FLOATING, DRIVEN, ELECTRODES, ALL = 2, 4, 3, 6


def design(floating: int = FLOATING) -> Design:
    """Three electrodes, a shield, conductors that float, and one at ground."""
    roles = [Role.SHIELD, *[Role.FLOATING] * floating, Role.GROUND]
    plates = tuple(
        Conductor(f"c{k}", role, sheet(rectangle((0.0, 0.04 + 0.02 * k), (0.02, 0.01))))
        for k, role in enumerate(roles)
    )
    pads = [rectangle((x, 0.0), (0.01, 0.01)) for x in (-0.03, 0.0, 0.03)]
    return patches(*pads, conductors=plates)


def maxwell(rng: np.random.Generator, *shape: int) -> Array:
    """Matrices of random capacitances between terminals, and to ground [F]."""
    between = rng.uniform(0.1, 1.0, (*shape, ALL, ALL)) * 1e-12
    out = -0.5 * (between + between.swapaxes(-1, -2))
    own = -out.sum(axis=-1) + rng.uniform(0.5, 1.0, (*shape, ALL)) * 1e-12
    k = np.arange(ALL)
    out[..., k, k] = own
    return out


def of_driven(matrix: Array, count: int = DRIVEN) -> Array:
    """The matrix of the first terminals where the others have no charge: by potentials."""
    return np.linalg.inv(np.linalg.inv(matrix)[..., :count, :count])


@pytest.mark.parametrize("shape", [(), (1,), (5,), (2, 3)])
@pytest.mark.parametrize("lossy", [False, True])
def test_floating_conductors_have_no_charge(shape: tuple[int, ...], lossy: bool) -> None:
    """Analytic: the matrix of the others is the inverse of their part of the inverse."""
    rng = np.random.default_rng(1)
    rest = maxwell(rng)
    change = 0.3 * maxwell(rng, *shape)
    if lossy:
        change = change - 0.1j * maxwell(rng, *shape)
    found = Terminals(design(), rest)
    np.testing.assert_allclose(found.empty, of_driven(rest), rtol=1e-10)
    expected = of_driven(rest + change) - of_driven(rest)
    assert found.change(change).shape == (*shape, DRIVEN, DRIVEN)
    np.testing.assert_allclose(found.change(change), expected, rtol=1e-7, atol=1e-24)
    assert (found.driven, found.electrodes) == (DRIVEN, ELECTRODES)


def test_the_derivative_is_that_of_the_change() -> None:
    """Differential: against differences, for several scenes of several bodies, six motions each."""
    rng = np.random.default_rng(2)
    terminals = Terminals(design(), maxwell(rng))
    change = 0.3 * maxwell(rng, 2)
    slope = np.moveaxis(maxwell(rng, 2, 3, 6), 2, -1)
    found = terminals.slope(change, slope)
    assert found.shape == (2, 3, ELECTRODES, ELECTRODES, 6)
    step = 1e-5
    for body in range(3):
        for way in range(6):
            part = step * slope[:, body, :, :, way]
            ahead, behind = terminals.change(change + part), terminals.change(change - part)
            rise = (ahead - behind)[:, :ELECTRODES, :ELECTRODES] / (2 * step)
            np.testing.assert_allclose(found[:, body, :, :, way], rise, rtol=1e-5, atol=1e-19)


def test_without_floating_conductors_nothing_is_taken_out() -> None:
    """Invariant: to the last bit; of the derivative the electrodes' part."""
    rng = np.random.default_rng(3)
    plain = design(floating=0)
    rest, change = maxwell(rng)[:DRIVEN, :DRIVEN], maxwell(rng, 2)[:, :DRIVEN, :DRIVEN]
    terminals = Terminals(plain, rest)
    np.testing.assert_array_equal(terminals.empty, rest)
    np.testing.assert_array_equal(terminals.change(change), change)
    slope = rng.normal(size=(2, 3, DRIVEN, DRIVEN, 6))
    np.testing.assert_array_equal(
        terminals.slope(change, slope), slope[:, :, :ELECTRODES, :ELECTRODES]
    )


def test_screened_terminals_do_not_couple() -> None:
    """Analytic: off the diagonal the change goes up to what takes the entry to zero."""
    rng = np.random.default_rng(4)
    rest = maxwell(rng)
    rest[0, 1] = rest[1, 0] = 1e-15  # as on coarse meshes
    found = Terminals(design(), rest).screened(rng.uniform(-1, 1, (3, ALL, ALL)) * 2e-12)
    off = ~np.eye(ALL, dtype=bool)
    whole = rest + found
    assert whole[:, off & (rest < 0)].max() <= 1e-27
    assert found[:, 0, 1].max() <= 0.0
    large = Terminals(design(), rest).screened(np.full((ALL, ALL), 1e-9))
    np.testing.assert_array_equal(np.diag(large), 1e-9)
    np.testing.assert_array_equal(large[off], np.maximum(-rest, 0.0)[off])
    small = np.full((ALL, ALL), -1e-12)
    np.testing.assert_array_equal(Terminals(design(), rest).screened(small), small)


def test_capacitances_to_ground_are_raised_to_zero() -> None:
    """Analytic: diagonals of rows whose sum is negative make up for it, others stay."""
    rng = np.random.default_rng(6)
    rest = maxwell(rng)
    change = np.zeros((ALL, ALL))
    np.fill_diagonal(change, rng.uniform(-2, 1, ALL) * 1e-12)
    found = Terminals(design(), rest).grounded(change)
    sums = (rest + change).sum(axis=1)
    assert (sums < 0).any()
    assert (sums > 0).any()
    np.testing.assert_allclose((rest + found).sum(axis=1), np.maximum(sums, 0.0), atol=1e-26)
    off = ~np.eye(ALL, dtype=bool)
    np.testing.assert_array_equal(found[off], change[off])
