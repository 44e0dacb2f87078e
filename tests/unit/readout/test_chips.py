"""The known chips: their models against the figures they state."""

from __future__ import annotations

import math

import numpy as np
import pytest
from approximate import approx

from capsense.errors import ReadoutError
from capsense.readout import Readout
from capsense.readout.channels import Pattern, Wiring, mutual_patterns
from capsense.readout.converter import Range
from capsense.readout.noise import allan_deviation
from capsense.readout.presets import CHIPS, ReadoutOptions, Status, schedule_of
from capsense.readout.readout import build as build_chip

COUNT = 12
NAMES = tuple(f"E{k}" for k in range(COUNT))
LEVEL = 2e-12
RATES = [(chip, rate) for chip in CHIPS.values() for rate in chip.rates]


def still(chip, cycles, **options):
    """A readout of a still scene of 2 pF everywhere: counts of so many cycles."""
    readout = Readout.preset(chip, NAMES, expected=LEVEL, **options)
    k = len(readout.bank)
    end = (cycles + 0.5) * readout.schedule.period
    return readout, readout([0.0, end], np.full((2, k), LEVEL))


@pytest.mark.parametrize("chip", CHIPS.values(), ids=lambda c: c.name)
def test_every_figure_has_a_status_and_a_source(chip):
    assert len(chip.facts) >= 4
    for fact in chip.facts:
        assert fact.quantity
        assert fact.value
        assert fact.source or fact.status is Status.ASSUMED, fact


@pytest.mark.parametrize(("chip", "rate"), RATES, ids=lambda v: getattr(v, "name", ""))
def test_noise_is_as_stated(chip, rate):
    """Statistical: rms of one conversion, white noise and rounding together."""
    readout, counts = still(chip.name, 40, rate=rate.per_second, flicker=0.0)
    step = abs(readout.law.capacitance(np.array(1000)) - readout.law.capacitance(np.array(1001)))
    if chip.name == "mpr121":  # the step of a 1/C law depends on where one is
        code = int(counts.code[0])
        step = readout.law.capacitance(np.array(code)) / code
    if chip.name in ("fdc2214", "sdr"):
        step = 0.0 if chip.name == "fdc2214" else step
    expected = math.sqrt(rate.rms**2 + (chip.relative_noise * LEVEL) ** 2 + step**2 / 12)
    table = counts.table()[1]
    deviation = (table - table.mean(axis=0)).std()  # chips of a sensor differ in their DACs
    assert deviation == approx(expected, rel=5 / math.sqrt(2 * len(counts)) + 0.02)
    assert counts.code.dtype == np.int64


@pytest.mark.parametrize("chip", CHIPS.values(), ids=lambda c: c.name)
def test_allan_deviation_is_as_specified(chip):
    """Statistical: the chain falls as white noise does, to its flicker floor.

    Rounding is not quite noise where the noise is smaller than a code, as in the radio.
    """
    readout, counts = still(chip.name, 5000)
    _, rows = counts.table()
    averages = np.array([1, 4, 16, 64, 256])
    measured = np.sqrt((allan_deviation(rows, averages) ** 2).mean(axis=1))
    code = counts.code[0]
    lsb = readout.law.capacitance(code) - readout.law.capacitance(code + 1)
    variance = chip.rates[0].rms ** 2 + (chip.relative_noise * LEVEL) ** 2 + lsb**2 / 12
    expected = np.hypot(np.sqrt(variance / averages), chip.flicker)
    assert measured == approx(expected, rel=0.1)


def test_noise_off_leaves_rounding():
    for name in CHIPS:
        _, counts = still(name, 5, noise=False)
        assert not counts.saturated.any()
        _, rows = counts.table()
        assert len(rows) >= 3
        assert (rows == rows[0]).all()


def test_confirmed_figures():
    """The figures as their sources state them."""
    fdc = CHIPS["fdc1004"]
    assert fdc.law.level(np.array(1e-12)) == approx(2.0**19, rel=1e-12)
    assert [r.per_second for r in fdc.rates] == [100.0, 200.0, 400.0]
    assert fdc.dac.step * 32 == approx(100e-12, rel=1e-12)
    plan = schedule_of(CHIPS["ad7147"], [None] * 12, 1 / CHIPS["ad7147"].rates[0].per_second)
    assert plan.period == approx(9.216e-3, rel=1e-9)
    ad = CHIPS["ad7746"].law
    assert ad.level(np.array(0.0)) == 0x800000
    assert ad.capacitance(np.array(2**24)) == approx(4.096e-12, rel=1e-12)
    rates = [round(r.per_second) for r in CHIPS["ad7746"].rates]
    assert rates == [91, 84, 50, 26, 16, 13, 11, 9]
    assert CHIPS["teensy"].law.level(np.array(1e-12)) == approx(50.0, rel=1e-12)
    # The FDC1004's inputs in turn, two chips side by side for six electrodes.
    plan = schedule_of(fdc, [None] * 6, 1 / 400)
    assert plan.slots == ((0, 4), (1, 5), (2,), (3,))


def test_rates_are_conversions_per_second():
    """Invariant: one chip finishes as many conversions in a second as its rate says."""
    for chip, rate in RATES:
        readout = Readout.preset(chip.name, NAMES[:2], rate=rate.per_second, expected=LEVEL)
        slots = len(readout.schedule.slots)
        assert slots / readout.schedule.period == approx(rate.per_second, rel=1e-9)


SPECIMEN = [0.0, 0.0, -1.3e-13, 1.25e-12]
"""CAPDAC errors of the FDC1004 of TI E2E thread 1178477 [F]."""


def reported(level, code, **options):
    """What an FDC1004 reports of a capacitance at a CAPDAC code [F]."""
    options = {"noise": False, "capdac": code, **options}
    readout = Readout.preset("fdc1004", NAMES[:1], **options)
    return float(readout([0.0, 0.1], np.full((2, 1), level)).capacitance[0])


def test_dac_jump_of_a_specimen():
    """Measured: 18.9 pF read with CAPDAC code 7 and 8 differ by the specimen's 1.38 pF."""
    seven, eight = (reported(18.9e-12, code, capdac_errors=SPECIMEN) for code in (7, 8))
    np.testing.assert_allclose(eight - seven, -1.38e-12, rtol=0.01)
    np.testing.assert_allclose(reported(39e-12, 8, capdac_errors=SPECIMEN), 37.75e-12, atol=1e-16)


def test_specimens_differ():
    """Measured: 39 pF at code 8 reads 38.968 pF on one FDC1004, 37.75 pF on another: specimens lie
    about the nominal value by 2.3 % of the bit of 25 pF; the same seed is the same specimen."""
    found = np.array([reported(39e-12, 8, noise=True, seed=seed) for seed in range(200)])
    assert len(np.unique(found)) == 200
    assert abs(found.mean() - 39e-12) < 4 * found.std() / 200**0.5
    np.testing.assert_allclose(found.std(), 0.023 * 25e-12, rtol=0.2)
    assert found.min() < 37.75e-12 < 38.968e-12 < found.max()
    assert reported(39e-12, 8, noise=True, seed=3) == found[3]
    assert reported(39e-12, 8) == 39e-12  # without noise it is nominal
    one, other = (reported(39e-12, 8, specimen=5, seed=seed) for seed in (1, 2))
    assert one == other != 39e-12


def test_another_seed_is_another_specimen_unless_one_is_chosen():
    """Invariant: with the noise, unless the specimen has a number of its own."""
    for specimen, same in ((None, False), (7, True)):
        options = {"white": 0.0, "flicker": 0.0, "capdac": 8, "specimen": specimen, "seed": 1}
        readout = Readout.preset("fdc1004", NAMES[:1], **options)
        told = []
        for seed in (None, 2, 1):
            readout.reset(seed=seed)
            told.append(readout([0.0, 0.1], np.full((2, 1), 30e-12)).code[0])
        assert told[0] == told[2]
        assert bool(told[0] == told[1]) == same


def test_each_chip_of_a_sensor_is_a_specimen():
    """By hand: an FDC1004 has four inputs, so that six electrodes take two of them."""
    names = [f"E{k}" for k in range(6)]
    readout = Readout.preset("fdc1004", names, noise=False, capdac=8, specimen=0)
    values = readout([0.0, 0.1], np.full((2, 6), 30e-12)).table()[1][0]
    assert (values[:4] == values[0]).all()
    assert (values[4:] == values[4]).all()
    assert values[0] != values[4]


def test_the_array_of_an_ad7746_is_20_percent_uncertain():
    """Data sheet: all bits together, so that what is read goes with the code."""
    dac = CHIPS["ad7746"].dac
    errors = dac.specimens(1, 1, 500) / (dac.step * 2.0 ** np.arange(7))
    np.testing.assert_allclose(errors, errors[:, :1] * np.ones(7), rtol=1e-12)
    assert 0.19 < np.abs(errors).max() <= 0.2
    np.testing.assert_allclose(errors[:, 0].std(), 0.2 / 3**0.5, rtol=0.1)


def test_offset_dac_as_the_host_sets_it():
    """Analytic: codes count from what the DAC subtracts; by default, the nearest step does."""
    level = 5e-12
    for start, offset in ((None, 6.25e-12), (0, 0.0), (1, 3.125e-12)):
        readout = Readout.preset("fdc1004", NAMES[:1], noise=False, capdac=start)
        counts = readout([0.0, 0.1], np.full((2, 1), level))
        assert counts.code[0] == round((level - offset) * 2**19 / 1e-12)
        assert counts.capacitance[0] == approx(level, abs=1e-18)


def test_saturation_reaches_the_flags():
    """Each chip's range, with its CAPDAC where the host left it."""
    for name, limit in (("ad7147", 8e-12), ("ad7746", 4.096e-12), ("ad7747", 8.192e-12)):
        readout = Readout.preset(name, NAMES[:2], noise=False)
        k = len(readout.bank)
        for change, flag in ((0.9, Range.INSIDE), (1.1, Range.ABOVE), (-1.1, Range.BELOW)):
            levels = np.array([[10e-12], [10e-12], [10e-12 + change * limit]]) * np.ones(k)
            counts = readout([0.0, 1.0, 1.0001], levels)
            assert not counts.flags.any()
            readout.reset()
            readout.sample(0.0, levels[0])
            readout.sample(0.9, levels[0])
            readout.sample(0.9001, levels[2])
            assert readout.sample(3.0, levels[2]).flags[-1] == flag


def test_charge_set_up():
    """The MPR121's charge is chosen so that the expected capacitance reads near 90 %."""
    for capacitance in np.geomspace(0.6e-12, 2e-9, 40):
        law = CHIPS["mpr121"].law.set_for(capacitance)
        code = float(law.level(np.array(capacitance)))
        assert law.low <= code <= law.high
        assert 1e-6 <= law.current <= 63e-6  # what the chip's registers hold
        assert 0.5e-6 <= law.time <= 32e-6
        if 10e-12 < capacitance < 800e-12:
            assert code == approx(law.low + 0.9 * (law.high - law.low), rel=0.05)
    with pytest.raises(ReadoutError, match="outside of what an MPR121 can charge"):
        CHIPS["mpr121"].law.set_for(1e-14)


def test_touch_of_a_chip():
    """A hand's 20 % on an MPR121 is a touch; a slow drift of as much is not."""
    readout = Readout.preset("mpr121", NAMES[:1], expected=LEVEL, noise=False)
    times = np.arange(0, 20, 0.05)
    hand = LEVEL * np.where((times > 5) & (times < 10), 1.2, 1.0)
    touched = readout(times, hand[:, None])
    during = (touched.time > 5.2) & (touched.time < 10)
    assert touched.touched is not None
    assert touched.touched[during].all()
    assert not touched.touched[touched.time < 5].any()
    assert not touched.touched[touched.time > 10.3].any()


def test_what_cannot_be_measured_at_once_is_not():
    """A radio takes the receivers of a transmitter at once, unless one is open while another is."""
    plan = {
        "grounded": ((0, 1), (2,)),
        "floating": ((0,), (1,), (2,)),
        "guard": ((0,), (1,), (2,)),
    }
    for rest, slots in plan.items():
        patterns = mutual_patterns(NAMES[:3], rest=rest)
        assert Readout.preset("sdr", NAMES[:3], patterns=patterns).schedule.slots == slots
    open_ = [Pattern("E1", {"E0": 1.0}), Pattern("E2", {"E0": 1.0}, floating=("E1",))]
    assert Readout.preset("sdr", NAMES[:3], patterns=open_).schedule.slots == ((0,), (1,))


def test_leads_load_the_shunt():
    """Analytic: what leads have to ground takes current from the shunt, and the gain falls."""
    wiring = Wiring(trace=20e-12, cable=100e-12, shield_gain=0.9)
    readout = Readout.preset("sdr", NAMES[:2], noise=False, wiring=wiring)
    level = 0.1e-12
    found = readout([0.0, 0.1], np.full((2, 1), level)).capacitance[0]
    expected = level / math.hypot(1, 2 * math.pi * 1e6 * 1e3 * 30e-12)
    assert found == approx(expected, rel=3e-3)


def test_drift_with_temperature():
    """Analytic: the chip's own figures, or those given; zero is a figure, too."""
    empty = 2e-12
    cases = [
        ("fdc1004", {}, empty * (1 - 10 * 37.5e-6) + 10 * 46e-15 / 165),
        ("fdc1004", {"gain_per_kelvin": 0.0}, empty + 10 * 46e-15 / 165),
        ("ad7147", {"offset_per_kelvin": 3e-15}, empty + 30e-15),
        ("ad7147", {"gain_per_kelvin": 0.0}, empty),
    ]
    for name, options, expected in cases:
        readout = Readout.preset(name, NAMES[:1], noise=False, temperature=35.0, **options)
        found = readout([0.0, 1.0], np.full((2, 1), empty)).capacitance
        assert found == approx(np.full(len(found), expected), abs=0.13e-15)
    damp = {"humidity": 80.0, "offset_per_percent": 1e-16, "gain_per_percent": 1e-4}
    readout = Readout.preset("fdc1004", NAMES[:1], noise=False, **damp)
    found = readout([0.0, 1.0], np.full((2, 1), empty)).capacitance
    assert found == approx(np.full(len(found), empty * 1.003 + 3e-15), abs=1e-18)


def test_pace_and_latency_of_the_host():
    """A chip that is asked every 50 ms, and answers 4 ms later."""
    readout = Readout.preset("fdc1004", NAMES[:2], period=0.05, latency=4e-3)
    counts = readout([0.0, 0.25], np.full((2, 2), LEVEL))
    assert counts.of("E0").time == approx(0.014 + 0.05 * np.arange(5), rel=1e-9)
    assert counts.of("E1").time == approx(0.024 + 0.05 * np.arange(5), rel=1e-9)


def test_noise_of_ones_own():
    """Statistical: white noise given takes the place of the chip's, in every chip."""
    for name in ("ad7746", "mpr121", "teensy"):
        readout, counts = still(name, 40, white=5e-13 if name == "teensy" else 5e-14, flicker=0.0)
        assert counts.capacitance.std() == approx(readout.stages[0].rms, rel=0.1)
        quiet, _ = still(name, 1, white=0.0, flicker=0.0)
        assert quiet.stages == ()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("ad7147", {"temperature": 30.0}), "temperature changes nothing, as no such drift of the"),
        (("fdc1004", {"humidity": 30.0}), "humidity changes nothing.* offset_per_percent or gain"),
        (("fdc1004", {"gain_per_percent": 1e-3}), "does nothing without a humidity"),
        (("fdc1004", {"period": 0.01}), "a period of 0.01 s is too short"),
        (("fdc1004", {"latency": "long"}), "latency is 'long'"),
        (("fdc1004", {"capdac": 32}), "is 32; give a whole number from 0 to 31"),
        (("fdc2214", {"capdac": 0}), "capdac is 0, but the fdc2214 has no offset DAC"),
        (("fdc1004", {"white": -1e-15}), "rms is -1e-15"),
        (("fdc1004", {"rate": "400"}), "no rate of '400' conversions per second"),
        (("fdc1004", {"flicker": "low"}), "floor is 'low'"),
        (("mpr121", {"expected": "10 pF"}), "expected is '10 pF'"),
        (("fdc1004", {"offset_per_kelvin": 1e-15}), "does nothing without a temperature"),
        (("fdc1004", {"offset_per_percent": 1e-15}), "does nothing without a humidity"),
        (("fdc1005", {}), "unknown chip 'fdc1005'; did you mean 'fdc1004'"),
        (("fdc1004", {"rate": 150.0}), "no rate of 150.0 conversions per second; it has 100"),
        (("fdc1004", {"rates": 100.0}), "no option 'rates' of a readout; did you mean 'rate'"),
        (("mpr121", {"expected": -1.0}), "expected is -1.0"),
        (("fdc1004", {"mains": -1.0}), "amplitude is -1.0"),
    ],
)
def test_bad_options_are_refused(arguments, words):
    name, options = arguments
    with pytest.raises(ReadoutError, match=words):
        Readout.preset(name, NAMES, **options)


def test_a_sensor_without_pairs_is_refused():
    with pytest.raises(ReadoutError, match=r"electrodes \['E1'\] make none"):
        Readout.preset("ad7746", ["E1"])


def test_options_and_presets_are_one():
    readout = build_chip("FDC1004", NAMES, ReadoutOptions(rate=400))
    assert readout.schedule.conversion == approx(2.5e-3, rel=1e-12)
