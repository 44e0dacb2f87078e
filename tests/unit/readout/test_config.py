"""Readouts from TOML: what a file can say, and what is refused."""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass, replace

import numpy as np
import pytest
from approximate import approx

from capsense.errors import ReadoutError
from capsense.readout import Readout
from capsense.readout.calibration import LinearSensor, ResponseCurve, calibrate
from capsense.readout.channels import Pattern, differential_patterns, two_terminal_patterns
from capsense.readout.checks import phasors, require
from capsense.readout.config import choose_readout, load_readout, parse_readout
from capsense.readout.converter import ExponentialTracker, SteppingTracker
from capsense.readout.laws import ResonanceLaw, ShuntFrontEnd, ShuntLaw
from capsense.readout.noise import ClimateDrift, Flicker, Mains, RandomWalk, White
from capsense.readout.presets import CHIPS

NAMES = ("E1", "E2", "E3")
FULL = """
chip = "fdc1004"
rate = 400
period = 0.02
latency = 0.003
capdac = 2
seed = 7

[[channel]]
sense = "E1"
rest = "guard"

[[channel]]
name = "difference"
sense = "E3"
drive = { E1 = 1.0, E2 = -1.0 }

[wiring]
trace = [1e-12, 2e-12]
cable = 50e-12
shield_gain = 0.99
coupling = 3e-14
crosstalk = 0.001

[noise]
white = 7e-16
flicker = 2e-16
walk = 1e-18
mains = 1e-15
mains_frequency = 60

[climate]
temperature = [[0, 22.0], [600, 30.0]]
humidity = 40
offset_per_kelvin = 1e-16
gain_per_percent = 2e-5

[detector]
touch = 5000
release = 3000
debounce = 2
samples = 500

[calibration]
gain = [1.02, 0.97]
offset = 2e-13
"""


def parse(text):
    return parse_readout(tomllib.loads(text), NAMES, source="my.toml")


def test_everything_is_taken_over():
    readout = parse(FULL)
    assert readout.channel_names == ("E1", "difference")
    plan = readout.schedule
    assert (plan.conversion, plan.period) == (approx(2.5e-3, rel=1e-12), approx(0.02, rel=1e-12))
    assert plan.latency == 0.003
    assert readout.dac is not None
    assert readout.dac.start == 2
    assert readout.wiring.trace == [1e-12, 2e-12]
    assert readout.wiring.coupling == 3e-14
    sensor, climate, walk, flicker, mains, white = readout.stages
    assert isinstance(sensor, LinearSensor)
    assert (sensor.gain.tolist(), float(sensor.offset), float(sensor.drift)) == (
        [1.02, 0.97],
        2e-13,
        0,
    )
    assert isinstance(climate, ClimateDrift)
    assert climate.temperature.at(np.array([300.0]))[0] == approx(26.0, rel=1e-12)
    assert climate.offset_per_kelvin == 1e-16
    assert climate.gain_per_kelvin == -37.5e-6  # the chip's
    assert climate.gain_per_percent == 2e-5
    assert walk == RandomWalk(1e-18)
    assert flicker == Flicker(2e-16)
    assert mains == Mains(1e-15, 60.0)
    assert white == White(7e-16)
    assert readout.detector is not None
    assert readout.detector.tracker == ExponentialTracker(500)
    patterns = readout.bank.patterns
    assert (patterns[0].rest, patterns[0].shield, patterns[1].shield) == ("guard", 1.0, 0.0)
    assert dict(patterns[1].drive) == {"E1": 1.0, "E2": -1.0}


@pytest.mark.parametrize(
    ("text", "key", "low", "high"),
    [
        ('chip = "fdc1004"', "seed", 0, 2**63 - 1),
        ('chip = "fdc1004"', "nonlinearity", -0.1, 0.1),
        ('chip = "fdc1004"', "capdac", 0, 10**6),
        ('chip = "fdc1004"', "rate", 1e-3, 1e7),
        ('chip = "fdc1004"', "period", 1e-6, 1e6),
        ('chip = "fdc1004"', "latency", 0.0, 1e3),
        ('chip = "fdc1004"', "expected", 1e-15, 1e-6),
        ('chip = "fdc2214"\n[tank]', "inductance", 1e-9, 1.0),
        ('chip = "fdc2214"\n[tank]', "capacitance", 1e-15, 1e-3),
        ('chip = "fdc2214"\n[tank]', "reference", 1e5, 1e9),
        ('chip = "sdr"\n[front_end]', "frequency", 1.0, 1e10),
        ('chip = "sdr"\n[front_end]', "shunt", 1e-3, 1e12),
        ('chip = "sdr"\n[front_end]', "amplitude", 1e-6, 1e6),
        ('chip = "sdr"\n[front_end]', "bandwidth", 1.0, 1e12),
        ('chip = "sdr"\n[front_end]', "parasitic", 0.0, 1e-6),
        ('chip = "sdr"\n[front_end]', "full_scale", 1e-9, 1e6),
        ('chip = "sdr"\n[front_end]', "gain", 1e-6, 1e9),
        ('chip = "sdr"\n[front_end]', "bits", 2, 32),
        ('chip = "fdc1004"\n[climate]', "temperature", -273.15, 1000.0),
        ('chip = "fdc1004"\n[climate]', "gain_per_kelvin", -1.0, 1.0),
        ('chip = "fdc1004"\n[climate]', "gain_per_percent", -1.0, 1.0),
        ('chip = "fdc1004"\n[climate]', "offset_per_kelvin", -1e-9, 1e-9),
        ('chip = "fdc1004"\n[climate]', "offset_per_percent", -1e-9, 1e-9),
        ('chip = "fdc1004"\n[climate]', "humidity", -273.15, 1000.0),
        ('chip = "fdc1004"\n[[channel]]\nsense = "E1"', "shield", -1e3, 1e3),
        ('chip = "fdc1004"\n[[channel]]\nsense = "E1"\n[channel.drive]', "E2", -1e3, 1e3),
        ('chip = "fdc1004"\n[wiring]', "trace", 0.0, 1e-6),
        ('chip = "fdc1004"\n[wiring]', "shield_gain", 0.0, 1.0),
        ('chip = "fdc1004"\n[wiring]', "crosstalk", -1.0, 1.0),
        ('chip = "fdc1004"\n[noise]', "white", 0.0, 1e-9),
        ('chip = "fdc1004"\n[noise]', "flicker", 0.0, 1e-9),
        ('chip = "fdc1004"\n[noise]', "walk", 0.0, 1e-9),
        ('chip = "fdc1004"\n[noise]', "mains", 0.0, 1e-9),
        ('chip = "fdc1004"\n[noise]', "mains_frequency", 1.0, 1e3),
        ('chip = "fdc1004"\n[detector]', "touch", 1e-9, 1e12),
        ('chip = "fdc1004"\n[detector]\ntouch = 5', "release", 1e-9, 5.0),
        ('chip = "fdc1004"\n[detector]\ntouch = 5', "samples", 1e-3, 1e9),
        ('chip = "fdc1004"\n[detector]\ntouch = 5', "debounce", 1, 10**6),
        ('chip = "fdc1004"\n[calibration]', "gain", -1e6, 1e6),
        ('chip = "fdc1004"\n[calibration]', "offset", -1e-6, 1e-6),
        ('chip = "fdc1004"\n[calibration]', "drift", -1e-6, 1e-6),
        ('chip = "fdc1004"\n[calibration]', "epoch", -1e12, 1e12),
    ],
)
def test_numbers_up_to_their_limits(text, key, low, high):
    """Limits: what lies beyond is refused by its key, the ends are not."""
    beyond = (low - 1, high + 1)
    if isinstance(low, float):
        beyond = math.nextafter(low, -math.inf), math.nextafter(high, math.inf)
    for value in (low, high):
        assert f"{key} = " not in told(f"{text}\n{key} = {value!r}\n")
    for value in beyond:
        assert f"{key} = " in told(f"{text}\n{key} = {value!r}\n")


def told(text):
    """What a file is refused with, if it is."""
    try:
        parse(text)
    except ReadoutError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(
    ("low", "wanted"),
    [
        (-np.inf, "a finite number$"),
        (0.0, "a number at least 0 F$"),
        (2.0, "a number at least 2 F$"),
    ],
)
def test_what_a_number_must_be_is_told(low, wanted):
    """Errors name the bound, where there is one."""
    with pytest.raises(ReadoutError, match=rf"chip: x is nan; give {wanted}"):
        require("chip", "x", np.nan, low, "F")


def test_complex_numbers_stay_so():
    """Real ones are floats; texts are refused."""
    lossy = np.array([1.0 + 2.0j])
    assert phasors("values", lossy) is lossy
    assert phasors("values", [1, 2]).dtype == float
    with pytest.raises(ReadoutError, match=r"values: .* no real numbers"):
        phasors("values", ["a"])


def test_a_calibration_goes_through_a_file():
    """Round trip: what ``toml`` writes makes the same readout."""
    rng = np.random.default_rng(0)
    true, time = rng.uniform(1e-12, 2e-12, (9, 3)), np.arange(9.0)
    fit = calibrate(true, 1.1 * true + 3e-13 + 1e-16 * time[:, None], time)
    from_file = parse('chip = "fdc1004"\nrandom = false\n' + fit.toml())
    from_code = Readout.preset("fdc1004", NAMES, noise=False, stages=[fit])
    codes = [r(time, true).code.tolist() for r in (from_file, from_code)]
    assert codes[0] == codes[1]
    assert codes[0] != parse('chip = "fdc1004"\nrandom = false')(time, true).code.tolist()


def test_the_least_a_file_can_say(tmp_path):
    path = tmp_path / "chip.toml"
    path.write_text('chip = "ad7746"\n', encoding="utf-8")
    readout = load_readout(path, NAMES)
    assert readout.channel_names == ("E1-E2", "E1-E3", "E2-E3")
    path.write_text('chip = "ad7746"\nmode = "self"\nrandom = false\n', encoding="utf-8")
    readout = load_readout(path, NAMES)
    assert readout.channel_names == NAMES
    assert readout.stages == ()


def test_pairs_and_stepping_baseline():
    readout = parse(
        'chip = "sdr"\npairs = [["E3", "E1"], ["E3", "E2"]]\nrest = "floating"\n'
        '[detector]\ntouch = 10\ntracker = "stepping"\n'
    )
    assert readout.channel_names == ("E3-E1", "E3-E2")
    # E1 is read while E2 is open, and the other way round: not at once.
    assert readout.schedule.slots == ((0,), (1,))
    assert readout.detector is not None
    assert (readout.detector.release, readout.detector.tracker) == (5.0, SteppingTracker())
    plain = parse('chip = "fdc1004"\n[detector]\ntouch = 9\n').detector
    assert plain is not None
    assert plain.tracker == ExponentialTracker(1000)


def test_a_tank_or_front_end_of_ones_own():
    """What a file leaves out stays as the chip has it; the wiring loads the shunt as well."""
    law = parse('chip = "fdc2214"\n[tank]\ninductance = 10e-6\ncapacitance = 20e-12\n').law
    assert law == ResonanceLaw(10e-6, 20e-12, 40e6)
    law = parse(
        'chip = "sdr"\n[front_end]\nfrequency = 5e5\nshunt = 2e3\nbandwidth = 3e6\n'
        "parasitic = 1e-12\nfull_scale = 0.5\nbits = 14\n[wiring]\ntrace = 4e-12\n"
    ).law
    assert isinstance(law, ShuntLaw)
    assert law.front_end.parasitic == approx(5e-12, rel=1e-12)
    rest = replace(law, front_end=replace(law.front_end, parasitic=0.0))
    assert rest == ShuntLaw(ShuntFrontEnd(5e5, 2e3, 20.0, 1.0, 3e6), 0.5, 14)


def test_nonlinearity():
    """As in Python; the data sheet's is among the chip's facts, and off by default."""
    law = parse('chip = "ad7746"\nnonlinearity = 1e-4\n').law
    assert law == Readout.preset("ad7746", NAMES, nonlinearity=1e-4).law
    assert law.nonlinearity == 1e-4
    assert parse('chip = "ad7746"\n').law.nonlinearity == 0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "my.toml: readout: missing key 'chip'"),
        ('chip = "fdc1005"', "chip = 'fdc1005' is not known; did you mean 'fdc1004'"),
        ('chip = "fdc1004"\nratee = 1', "unknown key 'ratee'; did you mean 'rate'"),
        ('chip = "fdc1004"\nrate = "fast"', "rate = 'fast' must be a number"),
        ('chip = "fdc1004"\nrate = 150', "fdc1004 has no rate of 150"),
        ('chip = "fdc1004"\nseed = -1', "seed = -1 must be an integer"),
        ('chip = "fdc1004"\nmode = "both"', "mode = 'both' is not known"),
        ('chip = "fdc1004"\npairs = [["E1", "E2"]]', "pairs is for mode = 'mutual', 'diff"),
        ('chip = "ad7746"\npairs = [["E1"]]', r"pairs\[0\] = \['E1'\] must be"),
        ('chip = "ad7746"\npairs = []', "pairs = .. must be"),
        ('chip = "ad7746"\npairs = [["E1", "E9"]]', "names no electrode 'E9'"),
        ('chip = "ad7746"\npairs = [["E1", "E1"]]', "names one electrode twice"),
        ('chip = "fdc1004"\nmode = "self"\n[[channel]]\nsense = "E1"', "both choose the channels"),
        ('chip = "fdc1004"\n[[channel]]\nsens = "E1"', "channel 1: unknown key 'sens'"),
        ('chip = "fdc1004"\n[[channel]]\nsense = "E9"', "channel 1: sense names no electrode"),
        ('chip = "fdc1004"\n[[channel]]\nsense = "E1"\nfloating = "E2"', "floating = 'E2' must be"),
        ('chip = "fdc1004"\n[[channel]]\nsense = "E1"\nfloating = ["E1"]', "is floating, and"),
        ('chip = "fdc1004"\n[[channel]]\nsense = "E1"\ndrive = { E2 = true }', "E2 = True must be"),
        ('chip = "fdc1004"\n[wiring]\ntrace = -1', "wiring: trace = -1 must be from 0"),
        ('chip = "fdc1004"\n[wiring]\ntrace = [1e-12]', "trace is .*one per channel"),
        ('chip = "fdc1004"\n[calibration]\ngain = [1.0]', "gain is .*one per channel"),
        ('chip = "fdc1004"\n[calibration]\ngain = 0', "my.toml: calibration: .*a gain is 0"),
        ('chip = "fdc1004"\n[climate]\noffset_per_kelvin = 1e-16', "without a temperature"),
        ('chip = "fdc1004"\n[noise]\npink = 1', "noise: unknown key 'pink'"),
        ('chip = "fdc1004"\n[noise]\nwhite = 1', "white = 1 must be from 0 to 1e-09 F"),
        ('chip = "fdc1004"\n[tank]\nreference = 4e7', "has no tank; it goes with chip = fdc2214"),
        ('chip = "fdc2214"\n[front_end]\ngain = 2', "no front_end; it goes with chip = sdr"),
        ('chip = "fdc2214"\n[tank]\nreference = 40', "tank: reference = 40 must be from 100000"),
        (
            'chip = "sdr"\n[front_end]\ngane = 2',
            "front_end: unknown key 'gane'; did you mean 'gain",
        ),
        ('chip = "sdr"\n[front_end]\ngain = 1e-6', "my.toml: front_end: the codes run from 0 to 0"),
        ('chip = "fdc1004"\nperiod = 0.01', "a period of 0.01 s is too short"),
        ('chip = "fdc1004"\ncapdac = 32', "my.toml: .*give a whole number from 0 to 31"),
        ('chip = "fdc1004"\ncapdac_errors = 1e-12', "must be a list, one number a bit"),
        ('chip = "fdc1004"\ncapdac_errors = [0,0,0,0,0,1e-13]', "bit_errors are 6, but 32 codes"),
        ('chip = "fdc1004"\nspecimen = -1', "specimen = -1"),
        ('chip = "fdc2214"\nspecimen = 1', "specimen is 1, but the fdc2214 has no offset DAC"),
        ('chip = "fdc2214"\ncapdac_errors = [1e-13]', "the fdc2214 has no offset DAC"),
        ('chip = "fdc1004"\n[[channel]]\nsense = ["E1", "E9"]', "sense names no electrode 'E9'"),
        ('chip = "fdc1004"\n[[channel]]\nsense = { E9 = 1 }', "sense names no electrode 'E9'"),
        ('chip = "fdc1004"\n[[channel]]\nsense = "E1"\nlow = "E2"', "low = 'E2' must be a list"),
        ('chip = "fdc1004"\n[[channel]]\nsense = "E1"\nlow = ["E1"]', "is driven and low"),
        ('chip = "fdc1004"\n[[channel]]\nsense = "E1"\nminus = "E9"', "minus names no elec"),
        ('chip = "fdc1004"\n[[channel]]\nsense = "E1"\nminus = { sens = "E2" }', "key 'sens'"),
        ('chip = "fdc1004"\n[[channel]]\nsense = 1', "sense = 1 must be"),
        (
            'chip = "fdc1004"\nmode = "differential"\npairs = [["E1", "E1"]]',
            "names one electrode twice",
        ),
        ('chip = "fdc1004"\ncapdac = "auto"', "capdac = 'auto' must be an integer"),
        ('chip = "fdc1004"\nlatency = -1', "latency = -1 must be from 0"),
        ('chip = "ad7746"\nnonlinearity = 1', "nonlinearity = 1 must be from -0.1"),
        ('chip = "mpr121"\nnonlinearity = 1e-4', "the law of the mpr121 is curved by itself"),
        ('chip = "fdc1004"\n[climate]\ntemperature = [[1, 2], [1, 3]]', "times must rise"),
        ('chip = "fdc1004"\n[detector]\ntouch = 5\nrelease = 9', "release = 9 must be from"),
        ('chip = "fdc1004"\n[detector]\nrelease = 9', "detector: missing key 'touch'"),
        (
            'chip = "fdc1004"\n[detector]\ntouch = 9\ntracker = "stepping"\nsamples = 5',
            "samples is",
        ),
    ],
)
def test_wrong_files_are_refused(text, words):
    with pytest.raises(ReadoutError, match=words):
        parse(text)


def test_measurement_modes_in_a_file():
    """By hand: what a file says of channels is what patterns in Python say."""
    found = parse(
        """
        chip = "fdc1004"
        specimen = 3
        capdac_errors = [0.0, 0.0, -1.3e-13, 1.25e-12]
        [[channel]]
        sense = "E1"
        drive = { E1 = 1.0, E3 = -1.0 }
        name = "out of phase"
        [[channel]]
        sense = ["E1", "E2"]
        [[channel]]
        sense = { E1 = 0.5, E2 = -2.0 }
        drive = { E3 = 1.0 }
        [[channel]]
        sense = "E1"
        minus = "E2"
        [[channel]]
        sense = "E1"
        minus = { sense = "E2", drive = { E3 = 0.5 } }
        name = "of two kinds"
        [[channel]]
        sense = ["E1", "E3"]
        low = ["E2"]
        [[channel]]
        sense = "E3"
        shield = -1.0
        """
    )
    assert found.bank.patterns == (
        Pattern("E1", {"E1": 1.0, "E3": -1.0}, name="out of phase"),
        Pattern(("E1", "E2"), shield=1.0),
        Pattern({"E1": 0.5, "E2": -2.0}, {"E3": 1.0}),
        Pattern("E1", shield=1.0, minus="E2"),
        Pattern("E1", shield=1.0, minus=Pattern("E2", {"E3": 0.5}), name="of two kinds"),
        Pattern(("E1", "E3"), low=("E2",)),
        Pattern("E3", shield=-1.0),
    )
    assert found.dac is not None
    assert found.dac.specimen == 3
    assert found.dac.bit_errors == (0.0, 0.0, -1.3e-13, 1.25e-12)
    assert found.dac.mismatch == 0.0
    for mode, make in (
        ("differential", differential_patterns), ("two-terminal", two_terminal_patterns),
    ):  # fmt: skip
        head = f'chip = "fdc1004"\nmode = "{mode}"\n'
        chosen = parse(head + 'pairs = [["E1", "E3"]]').bank.patterns
        assert chosen == make(NAMES, [("E1", "E3")])
        assert parse(head).bank.patterns == make(NAMES)


@dataclass
class Reading:
    """As a simulator gives it."""

    capacitance: np.ndarray
    self_capacitance: np.ndarray
    electrode_names: tuple[str, ...] = NAMES


def test_choosing_by_name_or_file(tmp_path):
    """A named chip that adapts to its electrodes is set up for them: nothing is out of range."""
    matrix = np.diag([1.8e-12, 0.9e-12, 0.67e-12])
    empty = Reading(matrix, np.diag(matrix))
    readout = choose_readout("mpr121", NAMES, empty)
    assert not readout([0.0, 1.0], np.stack([matrix, matrix])).flags.any()
    least = Reading(1e-15 * np.eye(3), np.full(3, 1e-15))  # less than any setting charges
    assert choose_readout("MPR121", NAMES, least).law == CHIPS["mpr121"].law.set_for(0.2e-12)
    path = tmp_path / "mine.toml"
    path.write_text('chip = "fdc1004"\nrate = 400\n', encoding="utf-8")
    assert choose_readout(path, NAMES, empty).schedule.conversion == approx(2.5e-3, rel=1e-12)
    with pytest.raises(ReadoutError, match="unknown chip 'mpr122'; did you mean 'mpr121'"):
        choose_readout("mpr122", NAMES, empty)


def test_a_file_with_options(tmp_path):
    """Options go before what the file says; its curve and its calibration stay, in that order."""
    path = tmp_path / "mine.toml"
    curve = ResponseCurve(np.array([0.0, 1e-12, 2e-12]), 1e-12 * np.arange(9.0).reshape(3, 3))
    fit = LinearSensor(np.array([1.0, 2.0, 3.0]), np.zeros(3), np.zeros(3), 0.0)
    head = 'chip = "fdc1004"\nrate = 200\nrandom = false\n'
    path.write_text(head + fit.toml() + curve.toml(), encoding="utf-8")
    gain = LinearSensor(np.array(1.1), np.array(0.0), np.array(0.0), 0.0)
    readout = load_readout(path, NAMES, rate=400, stages=[gain])
    assert readout.schedule.conversion == approx(2.5e-3, rel=1e-12)
    first, second, third = readout.stages
    assert first is gain
    np.testing.assert_array_equal(second.measured, curve.measured)
    np.testing.assert_array_equal(second.true, curve.true)
    np.testing.assert_array_equal(third.gain, fit.gain)
    assert load_readout(str(path), NAMES).schedule.conversion == approx(5e-3, rel=1e-12)
    with pytest.raises(ReadoutError, match="no option 'speed'"):
        load_readout(str(path), NAMES, speed=3)
    with pytest.raises(
        ReadoutError, match=r"load_readout\('.*mine.toml', electrodes, …\) takes it"
    ):
        Readout.preset(str(path), NAMES)
    for content, words in (
        ("[curve]\ntrue = [0.0, 1e-12]\n", r"mine.toml.*curve.*missing key 'measured'"),
        ('[curve]\ntrue = ["a", "b"]\nmeasured = [0.0, 1.0]\n', "mine.toml.*no real numbers"),
        ("[curve]\ntrue = [[0.0, 1e-12], [0.0]]\nmeasured = [0.0, 1.0]\n", "rows differ"),
        ("[curve]\ntrue = [1e-12, 0.0]\nmeasured = [0.0, 1.0]\n", "true values do not rise"),
        ("[curve]\ntrue = [[0.0, 1.0], [0.0, 1.0]]\nmeasured = [0.0, 1.0]\n", "a list of 3"),
    ):
        path.write_text(head + content, encoding="utf-8")
        with pytest.raises(ReadoutError, match=words):
            load_readout(path, NAMES)


def test_missing_files_are_refused(tmp_path):
    with pytest.raises(ReadoutError, match="there is no readout file"):
        load_readout(tmp_path / "none.toml", NAMES)
    with pytest.raises(ReadoutError, match="there is no readout file fdc1004"):
        load_readout("fdc1004", NAMES)
