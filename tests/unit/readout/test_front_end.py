"""Front end: closed forms against circuit analysis and against sampled waveforms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from approximate import approx

from capsense.errors import ReadoutError
from capsense.readout.channels import Wiring
from capsense.readout.laws import ShuntFrontEnd, ShuntLaw, demodulate, demodulated

PAPER = ShuntFrontEnd(1e6, 1e3, 20.0, 2.0)


def random_front_end(rng):
    return ShuntFrontEnd(
        10 ** rng.uniform(4, 7), 10 ** rng.uniform(1, 5), 10 ** rng.uniform(0, 3),
        rng.uniform(0.1, 10), 10 ** rng.uniform(5, 9), rng.uniform(0, 100e-12),
    )  # fmt: skip


def test_output_solves_the_circuit():
    """Differential: nodal analysis of transmitter, capacitor, shunt and parasitic."""
    rng = np.random.default_rng(0)
    for _ in range(100):
        fe = random_front_end(rng)
        c = 10 ** rng.uniform(-15, -10)
        # Unknowns: the source's current and the receiving node's potential.
        j = 1j * fe.omega
        nodes = np.array([[1, j * c], [0, j * c + j * fe.parasitic + 1 / fe.shunt]])
        sources = np.array([j * c * fe.amplitude, j * c * fe.amplitude])
        _, receiver = np.linalg.solve(nodes, sources)
        amplifier = fe.gain * fe.bandwidth / (fe.bandwidth + 1j * fe.excitation_frequency)
        found = fe.output(c)
        assert abs(found - amplifier * receiver) <= 1e-12 * abs(found)


def test_conductance_turns_the_phase():
    """Analytic: C and G in parallel, in series with a shunt too small to matter."""
    front = ShuntFrontEnd(shunt=1e-3)
    pure, lossy = front.output(1e-12), front.output(1e-12 - 1j * 3e-6 / front.omega)
    turn = np.angle(lossy / pure)
    assert turn == approx(-math.atan2(3e-6, front.omega * 1e-12), rel=1e-6)


def test_recovery_is_exact_for_phasors():
    """Round trip over eight decades, far beyond where the shunt's voltage is small."""
    c = np.geomspace(1e-18, 1e-10, 60)
    assert PAPER.recover(PAPER.output(c)) == approx(c, rel=1e-9)
    assert PAPER.recover(0j) == 0.0
    assert PAPER.recover(0.0) == 0.0


def test_recovery_from_magnitudes_is_too_large():
    """Analytic: by the factor 1 + ω R_S C, to first order."""
    c = np.array([1e-15, 1e-13, 1e-12])
    excess = PAPER.recover(np.abs(PAPER.output(c))) / c - 1
    assert excess == approx(PAPER.omega * PAPER.shunt * c, rel=0.01)


@pytest.mark.parametrize(("bits", "codes"), [(4, [1, 7]), (12, [1, 300, 2047]), (16, [1, 30000])])
@pytest.mark.parametrize("sign", [1, -1])
def test_codes_of_a_radio_by_hand(bits, codes, sign):
    """Analytic: a code's voltage v makes v / (ω R_S (A V − v)), whose own output is smaller."""
    law, most = ShuntLaw(PAPER, full_scale=0.5, bits=bits), 20.0 * 2.0
    volts = np.array(codes) * 0.5 / 2.0 ** (bits - 1)
    c = law.capacitance(sign * np.array(codes))
    assert c == approx(sign * volts / (2 * math.pi * 1e6 * 1e3 * (most - volts)), rel=1e-9)
    smaller = most / np.hypot(most - volts, volts)
    assert law.level(c) == approx(sign * smaller * codes, rel=1e-9)
    assert law.capacitance(np.array(0)) == 0.0


def test_parasitics_and_bandwidth_are_gain_errors():
    """Analytic: for small signals |V_o| falls by |1 + jωR_S C_p| and by the amplifier's pole."""
    c = 1e-15
    loaded = ShuntFrontEnd(1e6, 1e3, 20.0, 2.0, parasitic=50e-12)
    turn = loaded.omega * loaded.shunt * loaded.parasitic
    assert loaded.recover(loaded.output(c)) / c == approx(1 / math.hypot(1, turn), rel=1e-4)
    slow = ShuntFrontEnd(1e6, 1e3, 20.0, 2.0, bandwidth=3e6)
    assert slow.recover(slow.output(c)) / c == approx(1 / math.hypot(1, 1 / 3), rel=1e-4)


def test_demodulation_equals_its_closed_form():
    """Differential: sampled waveforms, any window, at and beside the transmitter's frequency."""
    rng = np.random.default_rng(1)
    for _ in range(200):
        rate, count = 10 ** rng.uniform(5, 8), int(rng.integers(3, 3000))
        carrier = rng.uniform(0.01, 0.49) * rate
        signal = carrier if rng.random() < 0.5 else rng.uniform(0, 0.49) * rate
        phasor = rng.normal() + 1j * rng.normal()
        phase = 2 * math.pi * signal * np.arange(count) / rate
        samples = np.real(phasor * np.exp(1j * phase))
        expected = demodulate(samples, carrier, rate)
        found = demodulated(phasor, signal, carrier, rate, count)
        assert abs(found - expected) < 1e-9


def test_whole_periods_give_the_phasor():
    """Analytic: sampled front end, demodulated and recovered, is the capacitance."""
    rng = np.random.default_rng(2)
    for c in (1e-15, 3e-13, 2e-12, 4e-11):
        samples = PAPER.waveform(c, 25e6, 2500)
        phasor = demodulate(samples, PAPER.excitation_frequency, 25e6)
        assert abs(phasor - PAPER.output(c)) < 1e-9 * abs(phasor)
        assert PAPER.recover(phasor) == approx(c, rel=1e-7)
        assert demodulated(PAPER.output(c), 1e6, 1e6, 25e6, 2500) == approx(phasor)
    batch = rng.standard_normal((4, 5, 100))
    assert demodulate(batch, 1e6, 25e6).shape == (4, 5)


def test_noise_of_demodulation():
    """Statistical: white noise of variance σ² leaves 2σ²/N on I and on Q, uncorrelated."""
    noise = 0.3 * np.random.default_rng(3).standard_normal((20_000, 200))
    phasor = demodulate(noise, 1e6, 25e6)
    expected = 2 * 0.3**2 / 200
    for part in (phasor.real, phasor.imag):
        assert part.var() == approx(expected, rel=5 * math.sqrt(2 / 20_000))
    assert abs(np.corrcoef(phasor.real, phasor.imag)[0, 1]) < 5 / math.sqrt(20_000)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"excitation_frequency": 0.0}, "frequency is 0.0"),
        ({"shunt": -1.0}, "shunt is -1.0"),
        ({"gain": math.nan}, "gain is nan"),
        ({"amplitude": math.inf}, "amplitude is inf"),
        ({"bandwidth": 0.0}, "bandwidth is 0.0"),
        ({"parasitic": -1e-12}, "parasitic is -1e-12"),
    ],
)
def test_bad_front_ends_are_refused(settings, words):
    with pytest.raises(ReadoutError, match=words):
        ShuntFrontEnd(**settings)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ShuntFrontEnd("1 MHz"), "frequency is '1 MHz'"),
        (lambda: PAPER.recover([1.0, math.nan]), "an output is not a number"),
        (lambda: PAPER.waveform(1e-12, 0.0, 10), "sample_rate is 0.0"),
        (lambda: demodulate([], 1e6, 1e7), "number of samples is 0"),
        (lambda: demodulate([1.0, math.nan], 1e6, 1e7), "samples: a number is not finite"),
        (lambda: demodulate([1.0, 2.0], 1e6, -1.0), "sample_rate is -1.0"),
        (lambda: demodulated(1.0, 1e6, 1e6, 1e7, 0), "number of samples is 0"),
    ],
)
def test_bad_signals_are_refused(make, words):
    """Nothing becomes NaN in silence."""
    with pytest.raises(ReadoutError, match=words):
        make()


def test_wiring_by_hand():
    """Leads add what they have to ground, short of the driven share, or to each other."""
    wiring = Wiring(trace=[1.0, 2.0], cable=4.0, shield_gain=0.75, crosstalk=0.1, coupling=0.5)
    assert wiring.ground(2) == approx([2.0, 3.0])
    mixing, offset = wiring.start(np.array([True, False]))
    assert mixing == approx(np.array([[1.0, 0.1], [0.1, 1.0]]))
    assert offset == approx([2.0, 0.5])
    given = Wiring(crosstalk=[[0.2, 0.3], [0.4, 0.0]]).start(np.array([True, True]))[0]
    assert given == approx(np.array([[1.2, 0.3], [0.4, 1.0]]))


@pytest.mark.parametrize("gain", [0.0, 1.0])
def test_shield_gain_may_be_none_or_perfect(gain):
    assert Wiring(cable=3.0, shield_gain=gain).ground(1) == approx([3.0 * (1.0 - gain)])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"shield_gain": -0.1}, "shield_gain is -0.1"),
        ({"shield_gain": 1.1}, "shield_gain is 1.1"),
        ({"trace": [1.0, -2.0]}, "trace holds -2 F; give zero or more"),
        ({"crosstalk": [[0.1, 0.2]]}, "crosstalk is"),
    ],
)
def test_wiring_refuses(options, words):
    with pytest.raises(ReadoutError, match=words):
        Wiring(**options).start(np.array([True, False]))


def test_any_infinite_bandwidth_is_a_fast_amplifier():
    assert ShuntFrontEnd(bandwidth=float("inf")).output(1e-12) == ShuntFrontEnd().output(1e-12)


@pytest.mark.parametrize("frequency", [500.0, 1000.0])
def test_closed_form_at_multiples_of_half_the_sample_rate(frequency):
    """The image then folds onto the signal, whole turns away."""
    samples = np.real(0.6 * np.exp(2j * np.pi * frequency * np.arange(8) / 1000.0 + 0.3j))
    found = demodulated(0.6 * np.exp(0.3j), frequency, frequency, 1000.0, 8)
    assert found == approx(complex(demodulate(samples, frequency, 1000.0)), abs=1e-12)
