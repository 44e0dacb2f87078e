"""Converters: laws, rounding, saturation, offset DAC."""

from __future__ import annotations

import math

import numpy as np
import pytest
from approximate import approx

from capsense.errors import ReadoutError
from capsense.readout.converter import CapDac, Conversion, Range, quantise
from capsense.readout.laws import LinearLaw, ReciprocalLaw, ResonanceLaw, ShuntFrontEnd, ShuntLaw

LINEAR = LinearLaw(1e-15, -8000, 7999)
RECIPROCAL = ReciprocalLaw(16e-6, 0.5e-6, 3.3)
RESONANCE = ResonanceLaw(18e-6, 33e-12, 40e6)
SHUNT = ShuntLaw(ShuntFrontEnd(1e6, 1e3, 20.0, 1.0), 1.0)
# Each law with a range of capacitances it converts, and one below and one above that.
LAWS = [
    (LINEAR, (-7.9e-12, 7.9e-12), -9e-12, 9e-12),
    (RECIPROCAL, (3.1e-12, 11e-12), 3e-12, 12e-12),
    (RESONANCE, (0.0, 14e-6), -32e-12, 15e-6),  # 10 kHz with 18 µH: 14.07 µF
    (SHUNT, (0.0, 7.5e-12), -9e-12, 9e-12),
]


@pytest.mark.parametrize(("law", "span", "below", "above"), LAWS, ids=lambda v: type(v).__name__)
def test_round_trips(law, span, below, above):
    """Invariant: each code means a capacitance that converts to that code, without exception."""
    codes, flags = quantise(law, np.linspace(*span, 1000))
    assert codes.dtype == np.int64
    assert not flags.any()
    again = law.capacitance(codes)
    if law is SHUNT:  # the recovery formula from magnitudes is not the inverse, see its docstring
        again = again / (1 + law.front_end.omega * law.front_end.shunt * again)
        assert np.abs(quantise(law, again)[0] - codes).max() <= 0.002 * codes.max()
    else:
        assert (quantise(law, again)[0] == codes).all()


@pytest.mark.parametrize(("law", "span", "below", "above"), LAWS, ids=lambda v: type(v).__name__)
def test_saturation(law, span, below, above):
    """Codes stay within their limits, and flags tell the side by capacitance, not by code."""
    code, flags = quantise(law, np.array([below, *span]))
    assert flags.tolist() == [Range.BELOW, Range.INSIDE, Range.INSIDE]
    assert code[0] == (law.low if law.rising else law.high)
    code, flags = quantise(law, np.array([above]))
    assert flags.tolist() == [Range.ABOVE]
    assert code[0] == (law.high if law.rising else law.low)


def test_quantisation_error_is_uniform():
    """Statistical: within half a code, mean zero, variance lsb²/12."""
    c = np.random.default_rng(0).uniform(-5e-12, 5e-12, 200_000)
    error = LINEAR.capacitance(quantise(LINEAR, c)[0]) - c
    assert np.abs(error).max() <= 0.5e-15 * (1 + 1e-9)
    assert error.var() == approx(1e-30 / 12, rel=0.02)
    assert abs(error.mean()) < 5 * 1e-15 / math.sqrt(12 * len(c))


def test_zero_code():
    """Analytic: 0 F is the code ``zero``, and one lsb more is the code after it."""
    law = LinearLaw(1e-15, 0, 2**16 - 1, 2**15)
    assert law.level(np.array([0.0, 1e-15])) == approx([2**15, 2**15 + 1])
    assert law.capacitance(np.array([2**15, 2**15 + 1])) == approx([0.0, 1e-15], abs=1e-27)


def test_full_scale_codes():
    """Analytic: without headroom, and with amplifiers to spare, all codes but the last are used."""
    assert ReciprocalLaw(1e-6, 1e-6, 3.3, headroom=0.0).high == 1023
    law = ReciprocalLaw(1e-6, 1e-6, 3.3, headroom=0.7)
    assert (law.low, law.high) == (218, 806)  # 1024 × 0.7/3.3 and 1024 × 2.6/3.3
    assert ShuntLaw(ShuntFrontEnd(1e6, 1e3, 20.0, 3.0), 2.0).high == 2**15 - 1


def test_shunt_law_by_its_full_scale():
    """Analytic: a code is |V_o| over full scale, whatever the amplitude and the scale."""
    front_end = ShuntFrontEnd(1e6, 1e3, 0.5, 3.0)  # at most 1.5 V of 2 V
    law = ShuntLaw(front_end, 2.0)
    assert law.high == math.ceil(0.75 * 2**15) - 1
    c = np.array([1e-12, -1e-12])
    volts = np.abs(front_end.output(np.abs(c)))
    assert law.level(c) == approx(np.sign(c) * volts / 2.0 * 2**15, rel=1e-12)


def test_largest_nonlinearity_is_taken():
    assert LinearLaw(1e-15, 0, 9, nonlinearity=0.1).nonlinearity == 0.1


@pytest.mark.parametrize("share", [1e-4, -1e-3])
def test_nonlinearity(share):
    """Analytic: none at the ends, all of it in the middle of the range; codes never fall."""
    law, straight = LinearLaw(1e-15, -8000, 8000, nonlinearity=share), LinearLaw(1e-15, -8000, 8000)
    at = np.array([-8e-12, -4e-12, 0.0, 4e-12, 8e-12, 9e-12])
    expected = share * 16000 * np.array([0.0, 0.75, 1.0, 0.75, 0.0, 0.0])
    assert law.level(at) - straight.level(at) == approx(expected, abs=1e-9)
    line = np.linspace(-9e-12, 9e-12, 5000)
    assert (np.diff(law.level(line)) > 0).all()
    assert np.abs(law.level(line) - straight.level(line)).max() == approx(
        abs(share) * 16000, rel=1e-3
    )
    assert (law.capacitance(np.arange(9)) == straight.capacitance(np.arange(9))).all()


def test_reciprocal_law():
    """Analytic: 1024 I T/(C V_dd); the resolution of a code is C/code."""
    c = 5e-12
    code = 16e-6 * 0.5e-6 / (c * 3.3) * 1024
    assert quantise(RECIPROCAL, c)[0] == round(code)
    step = RECIPROCAL.capacitance(np.array(500)) - RECIPROCAL.capacitance(np.array(501))
    assert step == approx(RECIPROCAL.capacitance(np.array(500)) / 501, rel=1e-9)
    assert quantise(RECIPROCAL, np.array([0.0, -1e-12]))[1].tolist() == [Range.BELOW] * 2
    # The maker states 0.45 to 2880 pF at 1.8 V: 1 µA, 0.5 µs at the upper rail; 63 µA, 32 µs.
    small, large = ReciprocalLaw(1e-6, 0.5e-6, 1.8), ReciprocalLaw(63e-6, 32e-6, 1.8)
    assert small.capacitance(np.array(small.high)) == approx(0.45e-12, rel=0.02)
    assert large.capacitance(np.array(large.low)) == approx(2880e-12, rel=0.01)


def test_resonance_law():
    """Analytic: the tank's frequency, and its slope −C/2."""
    code = int(quantise(RESONANCE, 2e-12)[0])
    frequency = code / 2**28 * 40e6
    assert frequency == approx(1 / (2 * math.pi * math.sqrt(18e-6 * 35e-12)), rel=1e-7)
    change = (quantise(RESONANCE, 2.01e-12)[0] - code) / code
    assert change == approx(-0.5 * 0.01 / 35, rel=1e-3)


def test_a_weak_amplifier_ends_the_range():
    """Where it gives less than full scale, a code means a finite capacitance up to the last."""
    law = ShuntLaw(ShuntFrontEnd(1e6, 1e3, 0.5, 1.0), 1.0)
    assert law.high == 2**14 - 1
    code, flags = quantise(law, np.array([1e-9, 1e-3, -1e-3]))
    assert flags.tolist() == [Range.INSIDE, Range.ABOVE, Range.BELOW]
    assert code.tolist()[1:] == [law.high, -law.high]
    reported = law.capacitance(code)
    assert np.isfinite(reported).all()
    assert reported[1] > reported[0] > 0
    assert reported[2] == -reported[1]


def test_dac_moves_the_range():
    """Analytic: a capacitance far out of the law's range is converted, to half a code."""
    dac = CapDac(3e-12, 32)
    c = np.array([2e-12, 40e-12, 92e-12])
    code, reported, flags = Conversion(LINEAR, dac, 3)(np.arange(3), c)
    assert not flags.any()
    assert np.abs(reported - c).max() <= 0.5e-15 * (1 + 1e-9)
    assert np.abs(code).max() <= 1500
    assert (Conversion(LINEAR, None, 3)(np.arange(3), c)[2] == [0, Range.ABOVE, Range.ABOVE]).all()


def test_dac_steps():
    """Analytic: where a bit's capacitor is off, the reported value jumps between codes."""
    errors = (0.0, 0.0, -0.1e-12, 1.3e-12)
    c = np.array([20e-12])
    reported = {}
    for start in range(4, 9):
        dac = CapDac(3.125e-12, 32, errors, start=start, follow=False)
        value, flags = Conversion(LinearLaw(1e-15, -16000, 15999), dac, 1)(np.zeros(1, int), c)[1:]
        assert not flags.any()
        reported[start] = value[0]
    assert reported[7] - reported[4] == approx(0.0, abs=1e-15)
    assert reported[8] - reported[7] == approx(-1.4e-12, abs=2e-15)
    expected = np.array([1.1, 2.0, 3.1, 4.0, 5.1, 6.0, 7.1]) * 1e-12
    actual = CapDac(1e-12, 8).actual(np.array([[0.1e-12, 0.0, 0.0]]))
    assert actual[0, 1:] == approx(expected, rel=1e-12)


def test_a_difference_is_converted_without_a_dac():
    """Data sheet: an FDC1004 has no CAPDAC for CHA − CHB; such channels keep code 0."""
    dac, without = CapDac(3e-12, 32, follow=True), np.array([False, True])
    conversion = Conversion(LINEAR, dac, 2, without=without)
    for _ in range(2):
        flags = conversion(np.arange(2), np.array([14e-12, 14e-12]))[2]
        assert flags.tolist() == [Range.INSIDE, Range.ABOVE]
        assert conversion.dac_codes.tolist() == [5, 0]


def test_dac_follows_only_if_it_may():
    """A saturated channel gets a new code for its next sample; the others keep theirs."""
    for follow in (True, False):
        conversion = Conversion(LINEAR, CapDac(3e-12, 32, follow=follow), 2)
        channel = np.arange(2)
        conversion(channel, np.array([2e-12, 2e-12]))
        far = np.array([2e-12, 14e-12])
        assert conversion(channel, far)[2].tolist() == [Range.INSIDE, Range.ABOVE]
        assert conversion.dac_codes.tolist() == [1, 4 if follow else 1]
        after = conversion(channel, far)
        assert after[2].tolist() == [0, 0 if follow else Range.ABOVE]
        assert after[1][0] == approx(2e-12, abs=1e-15)
        if follow:
            assert after[1][1] == approx(14e-12, abs=1e-15)


@pytest.mark.parametrize("first", [0.0, 9e-12])
def test_each_channel_sets_its_dac_at_its_first_sample(first):
    """Also where another channel was converted before, on code 0 or above it."""
    conversion = Conversion(LINEAR, CapDac(3e-12, 32), 2)
    conversion(np.array([0]), np.array([first]))
    reported = conversion(np.array([1]), np.array([92e-12]))[1]
    assert conversion.dac_codes.tolist() == [round(first / 3e-12), 31]
    assert reported == approx([92e-12], abs=1e-15)


def test_dac_follows_both_ways_to_its_ends():
    """Half a converter's range at a time: up, down, and no further than the DAC goes."""
    assert CapDac(3e-12, 12).nearest(np.array([-9e-12, 40e-12])).tolist() == [0, 11]
    for start, value, codes in (
        (0, 40e-12, [3, 6, 9, 11, 11]),
        (11, -20e-12, [8, 5, 2, 0, 0]),
        (5, 9e-12, [5, 5, 5, 5, 5]),
    ):
        conversion = Conversion(LINEAR, CapDac(3e-12, 12, start=start), 1)
        followed = []
        for _ in codes:
            conversion(np.zeros(1, dtype=int), np.array([value]))
            followed.append(int(conversion.dac_codes[0]))
        assert followed == codes


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: LinearLaw(1e-15, 0, 9, nonlinearity=0.2), "nonlinearity is 0.2; give a share"),
        (lambda: LinearLaw(0.0, 0, 1), "lsb is 0.0"),
        (lambda: LinearLaw(1e-15, 5, 5), "codes run from 5 to 5"),
        (lambda: ReciprocalLaw(-1e-6, 1e-6, 3.3), "current is -1e-06"),
        (lambda: ReciprocalLaw(1e-6, 0.0, 3.3), "time is 0.0"),
        (lambda: ReciprocalLaw(1e-6, 1e-6, 1.2), "codes run from 598 to 426"),
        (lambda: ResonanceLaw(0.0, 1e-12, 4e7), "inductance is 0.0"),
        (lambda: ResonanceLaw(1e-6, 1e-12, 4e4), "codes run from 67108864 to 67108864"),
        (lambda: ShuntLaw(ShuntFrontEnd(), math.nan), "full_scale is nan"),
        (lambda: ShuntLaw(ShuntFrontEnd(), 0.0), "full_scale is 0.0"),
        (lambda: ShuntLaw(ShuntFrontEnd(gain=1e-9), 1.0), "codes run from 0 to 0"),
        (lambda: ShuntLaw(ShuntFrontEnd(), 1.0, 1), "bits is 1"),
        (lambda: LinearLaw("fine", 0, 1), "lsb is 'fine'"),
        (lambda: CapDac(1e-12, 8, start="low"), "is 'low'; give a whole number"),
        (lambda: CapDac(0.0, 32), "step is 0.0"),
        (lambda: CapDac(1e-12, 0), "codes is 0"),
        (lambda: CapDac(1e-12, 8, start=8), "is 8; give a whole number from 0 to 7"),
        (lambda: CapDac(1e-12, 8, (math.nan,)), "bit_errors is nan"),
        (lambda: CapDac(1e-12, 8, (0.0,) * 4), "bit_errors are 4, but 8 codes have 3 bits"),
        (lambda: CapDac(1e-12, 8, mismatch=-0.1), "mismatch is -0.1"),
        (lambda: CapDac(1e-12, 8, specimen=-1), "specimen is -1"),
    ],
)
def test_bad_converters_are_refused(make, words):
    with pytest.raises(ReadoutError, match=words):
        make()
