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


def ground_design(grounding: str | float, floating: int = 1) -> Design:
    """Three electrodes, a shield, a floating conductor, and the local ground, on a capacitance."""
    return design(floating).with_grounding(grounding)


def by_circuit(matrix: Array, tie: float, floating: int) -> Array:
    """Slow reference: all potentials and charges of a circuit at once, in units of 1 pF.

    Terminals: driven ones at 1 V against the local ground in turn, floating ones without charge,
    the local ground last. What goes out comes from the local ground: all that is not floating has
    the charge together that its capacitance to earth takes up.
    """
    count = len(matrix)
    driven = count - floating - 1
    unknown = 2 * count + 1  # potentials, charges, and the potential of the local ground
    system = np.zeros((unknown, unknown), matrix.dtype)
    right = np.zeros((unknown, driven), matrix.dtype)
    system[:count, :count], system[:count, count:-1] = matrix / 1e-12, -np.eye(count)
    for k in range(count):
        if driven <= k < count - 1:
            system[count + k, count + k] = 1.0
            continue
        system[count + k, k], system[count + k, -1] = 1.0, -1.0
        if k < driven:
            right[count + k, k] = 1.0
        system[-1, count + k] = 1.0
    system[-1, -1] = tie / 1e-12
    return np.linalg.solve(system, right)[count : count + driven] * 1e-12


@pytest.mark.parametrize("tie", ["floating", 1e-13, 3e-12])
@pytest.mark.parametrize("floating", [0, 2])
@pytest.mark.parametrize("lossy", [False, True])
def test_a_local_ground_gets_back_what_goes_out(
    tie: str | float, floating: int, lossy: bool
) -> None:
    """Differential: against a circuit solved the long way, on random matrices."""
    rng = np.random.default_rng(7)
    count = 5 + floating  # three electrodes, a shield, floating conductors, the local ground
    rest, change = (m[..., :count, :count] for m in (maxwell_of(rng, 7), maxwell_of(rng, 7, 6)))
    change = 0.3 * change
    if lossy:
        change = change - 0.1j * np.abs(change)
    terminals = Terminals(ground_design(tie, floating), rest)
    assert (terminals.driven, terminals.electrodes) == (4, 3)
    farads = 0.0 if tie == "floating" else float(tie)
    np.testing.assert_allclose(terminals.empty, by_circuit(rest, farads, floating), rtol=1e-9)
    expected = [by_circuit(rest + c, farads, floating) for c in change]
    found = terminals.empty + terminals.change(change)
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-24)


def maxwell_of(rng: np.random.Generator, count: int, *shape: int) -> Array:
    """Matrices of random capacitances between so many terminals, and to earth [F]."""
    between = rng.uniform(0.1, 1.0, (*shape, count, count)) * 1e-12
    out = -0.5 * (between + between.swapaxes(-1, -2))
    own = -out.sum(axis=-1) + rng.uniform(0.5, 1.0, (*shape, count)) * 1e-12
    k = np.arange(count)
    out[..., k, k] = own
    return out


def test_limits_of_a_local_ground() -> None:
    """Invariant: on 1 mF it is earth; floating, driving all along with it costs no charge; the
    more capacitance, the more each electrode has; reciprocal and semidefinite throughout."""
    rng = np.random.default_rng(8)
    for _ in range(20):
        rest = maxwell_of(rng, 5)
        ties = (0.0, *np.logspace(-14, -9, 6), 1e-3)
        found = np.array(
            [Terminals(ground_design(t or "floating", floating=0), rest).empty for t in ties]
        )
        np.testing.assert_allclose(found[-1], rest[:4, :4], rtol=1e-6)
        own = np.diagonal(found, axis1=1, axis2=2)
        assert (np.diff(own, axis=0) > 0).all()
        np.testing.assert_allclose(found, found.swapaxes(1, 2), rtol=0, atol=1e-26)
        assert np.linalg.eigvalsh(found).min() > 0
        # Electrodes, shield and ground hold nothing together: the ground has minus their sum.
        whole = np.block([[np.eye(4)], [np.zeros((1, 4))]]) + np.ones((5, 1)) * (
            -rest.sum(axis=1)[None, :4] / rest.sum()
        )
        np.testing.assert_allclose((rest @ whole).sum(axis=0), 0.0, atol=1e-26)
        np.testing.assert_allclose((rest @ whole)[:4], found[0], rtol=1e-9)


def test_two_terminals_are_one_electrode_against_a_floating_ground() -> None:
    """Analytic: (C11 C22 − C12²)/(C11 + C22 + 2 C12), what an LCR meter reads."""
    rng = np.random.default_rng(9)
    pad, pour = rectangle((0.0, 0.0), (0.01, 0.01)), rectangle((0.0, 0.04), (0.02, 0.01))
    two = patches(pad, conductors=(Conductor("pour", Role.GROUND, sheet(pour)),))
    for _ in range(10):
        c = maxwell_of(rng, 2)
        found = Terminals(two.with_grounding("floating"), c).empty
        expected = (c[0, 0] * c[1, 1] - c[0, 1] ** 2) / (c[0, 0] + c[1, 1] + 2 * c[0, 1])
        np.testing.assert_allclose(found, [[expected]], rtol=1e-12)


def test_the_derivative_with_a_local_ground() -> None:
    """Differential: against differences of the change."""
    rng = np.random.default_rng(10)
    terminals = Terminals(ground_design(2e-13), maxwell_of(rng, 6))
    change = 0.3 * maxwell_of(rng, 6)
    slope = np.moveaxis(maxwell_of(rng, 6, 2, 6), 1, -1)
    found = terminals.slope(change, slope)
    step = 1e-5
    for body in range(2):
        for way in range(6):
            part = step * slope[body, :, :, way]
            rise = (terminals.change(change + part) - terminals.change(change - part)) / (2 * step)
            np.testing.assert_allclose(
                found[body, :, :, way], rise[:ELECTRODES, :ELECTRODES], rtol=1e-5, atol=1e-19
            )


def test_errors_keep_their_share_of_the_change() -> None:
    """By hand: estimates against a free ground are in proportion to what electrodes change by."""
    rng = np.random.default_rng(11)
    rest, change = maxwell_of(rng, 6), 0.3 * maxwell_of(rng, 6, 2)
    error = np.array([1e-15, np.inf])
    earthed = Terminals(design(2), rest)
    np.testing.assert_array_equal(earthed.error(error, change, earthed.change(change)), error)
    free = Terminals(ground_design("floating"), rest)
    reduced = free.change(change)
    found = free.error(error, change, reduced)
    share = np.abs(np.diag(reduced[0])[:3]).max() / np.abs(np.diag(change[0])[:3]).max()
    np.testing.assert_allclose(found[0], 1e-15 * share, rtol=1e-12)
    assert np.isinf(found[1])
    assert free.error(np.array(1e-15), 0 * change[0], 0 * reduced[0]) == 1e-15
