"""Excitation patterns: against a circuit solved the long way."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
from approximate import approx
from maxwell import random_maxwell

from capsense.errors import ReadoutError
from capsense.readout.channels import (
    ChannelBank,
    Pattern,
    differential_patterns,
    mutual_patterns,
    self_patterns,
    two_terminal_patterns,
)

NAMES = ("A", "B", "C", "D", "E")


def measured(matrix, pattern, names=NAMES):
    """Slow reference: solve for the potentials and charges of all terminals at once.

    Unknowns are potentials v and charges q of every electrode, and the potential u of the
    transmitter's lower end: q = C v; each electrode's potential is given, against u where the
    transmitter drives it, or its charge is zero; u is 0, or what it drives has no charge together.
    """
    m = len(names)
    system = np.zeros((2 * m + 1, 2 * m + 1))
    right = np.zeros(2 * m + 1)
    system[:m, :m], system[:m, m:-1] = matrix / 1e-12, -np.eye(m)
    held = {**dict.fromkeys((*pattern.weights, *pattern.low), 0.0), **pattern.drive}
    for k, name in enumerate(names):
        if name in pattern.floating or (pattern.rest == "floating" and name not in held):
            system[m + k, m + k] = 1.0
            continue
        system[m + k, k] = 1.0
        right[m + k] = held.get(name, 1.0 if pattern.rest == "guard" else 0.0)
        if name in pattern.drive or name in pattern.low:
            system[m + k, -1] = -1.0
            system[-1, m + k] = 1.0 if pattern.low else 0.0
    if not pattern.low:
        system[-1, -1] = 1.0
    charges = np.linalg.solve(system, right)[m:-1] * 1e-12
    out = sum(weight * charges[names.index(name)] for name, weight in pattern.weights.items())
    out = out if any(pattern.drive.get(name) for name in pattern.weights) else -out
    return out - (measured(matrix, pattern.minus, names) if pattern.minus else 0.0)


PATTERNS = [
    Pattern("A"),
    Pattern("B", rest="guard"),
    Pattern("C", rest="floating"),
    Pattern("D", floating=("A", "E")),
    Pattern("B", {"A": 1.0}),
    Pattern("B", {"A": -1.0}, name="inverted"),
    Pattern("B", {"A": 1.0, "C": -1.0}, name="difference"),
    Pattern("E", {"A": 1.0, "B": 1.0}, floating=("C",)),
    Pattern("E", {"D": 2.0}, rest="floating", name="E, others open"),
    Pattern("E", {"D": 1.0}, rest="guard", name="E, others guarded"),
    Pattern("C", {"C": 1.0, "D": -1.0}, name="out of phase"),
    Pattern("C", {"C": 0.7, "D": -0.3, "A": 0.0}, floating=("E",), name="real weights"),
    Pattern(("A", "C")),
    Pattern(("B", "D", "E"), rest="floating", name="joined, others open"),
    Pattern({"A": 2.0, "B": -0.5}, {"C": 1.0}, name="weighted charges"),
    Pattern({"A": 1.0, "B": -1.0}, name="by charges"),
    Pattern("A", minus="D"),
    Pattern("A", floating=("C",), minus="D", name="difference, C open"),
    Pattern("A", rest="guard", minus=Pattern("B", {"C": 1.0}), name="of two kinds"),
    Pattern("A", low=("B",)),
    Pattern(("A", "E"), low=("B", "D"), name="sets"),
    Pattern("A", low="C", rest="floating", name="LCR, others open"),
    Pattern("A", {"A": 1.0, "B": 0.4}, low=("C",), floating=("D",), name="LCR, weighted"),
    Pattern("D", {"A": 1.0}, low=("C",), name="LCR, another read"),
]


@pytest.mark.parametrize("pattern", PATTERNS, ids=lambda p: f"{p.name}-{p.rest}")
def test_patterns_against_the_whole_circuit(pattern):
    """Differential: every kind of pattern, on random matrices."""
    rng = np.random.default_rng(1)
    matrices = np.array([random_maxwell(rng, 5) for _ in range(20)])
    found = ChannelBank([pattern], NAMES).values(matrices)
    expected = [[measured(c, pattern)] for c in matrices]
    assert found == approx(np.array(expected), rel=1e-12)


def test_batches_and_single_matrices_agree_to_the_bit():
    rng = np.random.default_rng(2)
    matrices = np.array([random_maxwell(rng, 5) for _ in range(30)])
    named = [replace(p, name=str(k)) for k, p in enumerate(PATTERNS)]
    bank = ChannelBank(named, NAMES)
    assert (bank.values(matrices) == [bank.values(c) for c in matrices]).all()


def test_shields_follow_the_transmitter():
    """Analytic: with the shield as a sixth terminal, driven or not, the circuit says the same."""
    rng = np.random.default_rng(3)
    whole = random_maxwell(rng, 6)
    names = (*NAMES, "shield")
    for rest, floating in (("grounded", ()), ("guard", ()), ("grounded", ("B", "C"))):
        pattern = Pattern("A", rest=rest, floating=floating, shield=1.0)
        found = ChannelBank([pattern], NAMES).values(whole[:5, :5], whole[:5, 5])
        # Driving the shield along equals adding its columns to that of the electrode.
        turned = np.eye(6)
        turned[5, 0] = 1.0
        reference = measured(whole @ turned, Pattern("A", rest=rest, floating=(*floating,)), names)
        if rest == "guard":
            reference = measured(whole, Pattern("A", rest="guard"), names)
        assert found[0] == approx(reference, rel=1e-12)


def test_reciprocity():
    """Invariant: transmitter and receiver may be exchanged, whatever the others do."""
    rng = np.random.default_rng(4)
    matrix = random_maxwell(rng, 5)
    for rest in ("grounded", "floating"):
        there = ChannelBank([Pattern("B", {"A": 1.0}, rest=rest)], NAMES).values(matrix)
        back = ChannelBank([Pattern("A", {"B": 1.0}, rest=rest)], NAMES).values(matrix)
        assert there == approx(back, rel=1e-12)


def test_families():
    """Analytic: self capacitances are the diagonal, mutual ones minus the rest; guards add rows."""
    matrix = random_maxwell(np.random.default_rng(5), 5)
    assert (ChannelBank(self_patterns(NAMES), NAMES).values(matrix) == np.diag(matrix)).all()
    guarded = ChannelBank(self_patterns(NAMES, rest="guard"), NAMES).values(matrix)
    alone = matrix.sum(axis=1)
    # A guarded electrode sees ground only: its row's sum.
    assert guarded == approx(alone, rel=1e-12)
    bank = ChannelBank(mutual_patterns(NAMES), NAMES)
    assert (bank.values(matrix) == -matrix[np.triu_indices(5, 1)]).all()
    assert bank.names[:2] == ("A-B", "A-C")
    chosen = mutual_patterns(NAMES, [("C", "A")])
    assert [(p.sense, dict(p.drive)) for p in chosen] == [("A", {"C": 1.0})]


def test_two_terminals():
    """Analytic: an LCR meter that floats reads (C11 C22 − C12²)/(C11 + C22 + 2 C12); the same
    whichever way round, more with further electrodes, and more with them at ground than open."""
    rng = np.random.default_rng(6)
    matrix = np.array([random_maxwell(rng, 5) for _ in range(50)])
    a, b, m = matrix[:, 0, 0], matrix[:, 1, 1], matrix[:, 0, 1]
    bank = ChannelBank(
        [
            *two_terminal_patterns(NAMES, [("A", "B"), ("B", "A")]),
            Pattern("A", low=("B", "C"), name="wide"),
            Pattern("A", low=("B",), rest="floating", name="open"),
        ],
        NAMES,
    )
    assert bank.names[:2] == ("A to B", "B to A")
    there, back, wide, opened = bank.values(matrix).T
    np.testing.assert_allclose(there, (a * b - m**2) / (a + b + 2 * m), rtol=1e-12)
    np.testing.assert_allclose(back, there, rtol=1e-12)
    assert (wide > there).all()
    assert (there > opened).all()
    assert (opened > -m).all()  # what goes straight over is there in any case


def test_a_difference_is_that_of_an_fdc1004():
    """Analytic: CHA − CHB is the difference of the self capacitances, one after the other, or of
    the charges at once with the two in antiphase or in phase: the mutual capacitance cancels."""
    matrix = random_maxwell(np.random.default_rng(7), 5)
    ways = [
        *differential_patterns(NAMES, [("B", "D")], shield=0.0),
        Pattern(("B", "D"), {"B": 1.0, "D": -1.0}, name="antiphase"),
        Pattern({"B": 1.0, "D": -1.0}, name="in phase"),
    ]
    assert ways[0].name == "B minus D"
    found = ChannelBank(ways, NAMES).values(matrix)
    np.testing.assert_allclose(found, matrix[1, 1] - matrix[3, 3], rtol=1e-12)
    coupling = np.array([0.1, 0.2, 0.3, 0.4, 0.5]) * -1e-12
    shielded = ChannelBank(differential_patterns(NAMES, [("B", "D")]), NAMES)
    expected = matrix[1, 1] - matrix[3, 3] + 0.2e-12
    np.testing.assert_allclose(shielded.values(matrix, coupling), expected, rtol=1e-12)
    assert not shielded.patterns[0].sees_ground  # equal leads cancel


def test_out_of_phase():
    """By hand: the neighbour at −1 V adds its mutual capacitance, a shield at −1 V what it has."""
    matrix = random_maxwell(np.random.default_rng(8), 5)
    coupling = np.full(5, -0.3e-12)
    bank = ChannelBank(
        [Pattern("A", {"A": 1, "D": -1}, name="x"), Pattern("A", shield=-1.0, name="y")], NAMES
    )
    found = bank.values(matrix, coupling)
    np.testing.assert_allclose(found, matrix[0, 0] + [-matrix[0, 3], 0.3e-12], rtol=1e-12)


def test_patterns_are_copied_and_pickled():
    for pattern in PATTERNS:
        for twin in (copy.deepcopy(pattern), pickle.loads(pickle.dumps(pattern))):
            assert (twin.name, twin.weights, twin.drive) == (
                pattern.name, pattern.weights, pattern.drive,
            )  # fmt: skip
            assert (twin.low, twin.minus) == (pattern.low, pattern.minus)


def test_what_can_be_measured_at_once():
    """By hand: receivers of one transmitter, unless the rest floats or is driven along."""
    for rest, times in (("grounded", 4), ("guard", 10), ("floating", 10)):
        patterns = mutual_patterns(NAMES, rest=rest)
        assert len({p.excitation for p in patterns}) == times
        assert len({p.excitation for p in self_patterns(NAMES, rest=rest)}) == 5
    base = {"sense": "A", "drive": {"B": 1.0}}
    apart = ({"drive": {"B": 2.0}}, {"drive": {"C": 1.0}}, {"floating": ("C",)}, {"shield": 1.0})
    for change in apart:
        assert Pattern(**{**base, **change}).excitation != Pattern(**base).excitation
    assert Pattern("C", {"B": 1.0}, name="x").excitation == Pattern(**base).excitation


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Pattern("A", {"B": float("nan")}), "the drive of 'B' is nan"),
        (lambda: Pattern("A", {"B": 0.0}), "nothing is driven"),
        (lambda: Pattern("A", rest="open"), "rest = 'open'.*valid are grounded"),
        (lambda: Pattern("A", {"B": 1.0}, floating=("B",)), "'B' is floating, and driven"),
        (lambda: Pattern("A", floating=("A",)), "'A' is floating, and driven"),
        (lambda: Pattern({"A": float("inf")}), "the weight of 'A' is inf"),
        (lambda: Pattern({"A": 0.0}, {"B": 1.0}), "nothing is read"),
        (lambda: Pattern(()), "nothing is driven"),
        (lambda: Pattern("A", floating=("B",), low=("B",)), "'B' is floating, and driven or read"),
        (lambda: Pattern("A", low=("A",)), "'A' is driven and low"),
        (lambda: Pattern("A", low=("B",), rest="guard"), "floats between A and B"),
        (lambda: Pattern("A", low=("B",), shield=1.0), "no guard and no shield"),
        (lambda: Pattern("A", minus="A"), "'A' is read and subtracted"),
        (lambda: Pattern("A", {"B": 1.0}, minus="C"), "goes with a self measurement; give a Pat"),
        (lambda: Pattern("A", minus=Pattern("B", minus="C")), "is a difference itself"),
        (lambda: ChannelBank([Pattern("A", minus="F")], NAMES), "no electrode 'F'"),
        (lambda: ChannelBank([Pattern("A", low=("F",))], NAMES), "no electrode 'F'"),
        (lambda: Pattern("A", {"B": "high"}), "the drive of 'B' is 'high'"),
        (lambda: ChannelBank([], NAMES), "at least one channel"),
        (lambda: ChannelBank(["A"], NAMES), "channel 'A' is no Pattern"),
        (lambda: ChannelBank([Pattern("A")], "A"), "electrodes are 'A'; give a list"),
        (lambda: ChannelBank([Pattern("A"), Pattern("A")], NAMES), "two channels are named 'A'"),
        (lambda: ChannelBank([Pattern("E6")], NAMES), "no electrode 'E6'"),
    ],
)
def test_bad_patterns_are_refused(make, words):
    with pytest.raises(ReadoutError, match=words):
        make()


def test_bad_matrices_are_refused():
    bank = ChannelBank([Pattern("A")], NAMES)
    with pytest.raises(ReadoutError, match=r"shape \(4, 4\); 5 electrodes need"):
        bank.values(np.eye(4))
    broken = np.eye(5)
    broken[0, 0] = np.nan
    with pytest.raises(ReadoutError, match="not finite"):
        bank.values(broken)
    with pytest.raises(ReadoutError, match="open electrodes have no capacitance"):
        ChannelBank([Pattern("A", floating=("B",))], NAMES).values(np.zeros((5, 5)))
