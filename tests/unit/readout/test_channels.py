"""Excitation patterns: against a circuit solved the long way."""

from __future__ import annotations

import numpy as np
import pytest
from approximate import approx
from maxwell import random_maxwell

from capsense.errors import ReadoutError
from capsense.readout.channels import ChannelBank, Pattern, mutual_patterns, self_patterns

NAMES = ("A", "B", "C", "D", "E")


def measured(matrix, pattern, names=NAMES):
    """Slow reference: solve for the potentials and charges of all terminals at once.

    Unknowns are potentials v and charges q of every electrode: q = C v, and for each electrode
    either its potential is given or its charge is zero.
    """
    m = len(names)
    system = np.zeros((2 * m, 2 * m))
    right = np.zeros(2 * m)
    system[:m, :m], system[:m, m:] = matrix / 1e-12, -np.eye(m)
    for k, name in enumerate(names):
        driven = name in pattern.drive
        if name in pattern.floating or (
            pattern.rest == "floating" and name != pattern.sense and not driven
        ):
            system[m + k, m + k] = 1.0
            continue
        system[m + k, k] = 1.0
        if driven:
            right[m + k] = pattern.drive[name]
        elif pattern.rest == "guard" and name != pattern.sense:
            right[m + k] = 1.0
    charge = np.linalg.solve(system, right)[m + names.index(pattern.sense)] * 1e-12
    return charge if pattern.sense in pattern.drive else -charge


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
    named = [Pattern(p.sense, p.drive, p.floating, p.rest, p.shield, str(k)) for k, p in
             enumerate(PATTERNS)]  # fmt: skip
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
        (lambda: Pattern("A", {"A": 1.0, "B": 1.0}), "read and driven together"),
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
