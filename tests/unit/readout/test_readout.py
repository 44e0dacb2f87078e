"""The readout as a whole: instants, time stamps, interpolation, determinism."""

from __future__ import annotations

import copy
import pickle
from dataclasses import dataclass, replace

import numpy as np
import pytest
from approximate import approx
from maxwell import random_maxwell

from capsense.errors import ReadoutError
from capsense.readout import Readout
from capsense.readout.calibration import LinearSensor
from capsense.readout.channels import ChannelBank, Pattern, Wiring, self_patterns
from capsense.readout.conversions import Counts, Schedule, join
from capsense.readout.converter import CapDac, Detector, ExponentialTracker, SteppingTracker
from capsense.readout.laws import LinearLaw, ShuntFrontEnd, ShuntLaw
from capsense.readout.noise import ClimateDrift, Flicker, Mains, Profile, RandomWalk, White
from capsense.readout.presets import CHIPS

NAMES = ("A", "B", "C")
FINE = LinearLaw(1e-21, -(10**12), 10**12)


def plain(schedule=None, **options):
    """Three self channels through a converter of very fine codes."""
    plan = schedule or Schedule.sequential(3, 2e-3, gap=1e-4)
    return Readout(ChannelBank(self_patterns(NAMES, shield=0.0), NAMES), plan, FINE, **options)


def full(seed=0):
    """Everything that has a state."""
    return plain(
        Schedule(((0,), (1,), (2,)), 2e-3, 1e-4, latency=7e-3),
        dac=CapDac(1e-12, 8, follow=True),
        wiring=Wiring(trace=[1e-13, 2e-13, 0.0], cable=1e-12, shield_gain=0.9, crosstalk=0.01),
        stages=(Flicker(1e-15), Mains(1e-15), White(1e-15, 1e-3)),
        detector=Detector(1e5, 1e4, ExponentialTracker(50)), seed=seed,
    )  # fmt: skip


def moving(times, rng):
    """Matrices along a smooth way between two random ones, shape (n, 3, 3)."""
    one, two = random_maxwell(rng, 3), random_maxwell(rng, 3)
    share = 0.5 + 0.5 * np.sin(7 * np.asarray(times))[:, None, None]
    return one + share * (two - one)


def same(one, other):
    """Equal to the last bit."""
    columns = ("time", "channel", "code", "capacitance", "flags", "baseline", "touched")
    pairs = [(getattr(one, c), getattr(other, c)) for c in columns]
    return all((a is None and b is None) or np.array_equal(a, b) for a, b in pairs)


def test_channels_are_read_at_their_own_instants():
    """Analytic: asked at the instants that are due, each value is that of its instant."""
    readout = plain()
    rng = np.random.default_rng(0)
    one, two = random_maxwell(rng, 3), random_maxwell(rng, 3)

    def world(t):
        return one + np.sin(40 * t) * (two - one)

    parts = [readout.sample(t, world(t)) for t in readout.due(0.2)]
    counts = join([*parts, readout.sample(0.2, world(0.2))])
    assert len(counts) == readout.schedule.samples_until(0.2 - 1e-3)
    instants = counts.time - 1e-3
    assert instants[:4] == approx([1.1e-3, 3.2e-3, 5.3e-3, 7.4e-3], rel=1e-12)
    assert counts.channel[:4].tolist() == [0, 1, 2, 0]
    expected = [world(t)[c, c] for t, c in zip(instants, counts.channel, strict=True)]
    assert np.abs(counts.capacitance - expected).max() < 1e-20


def test_linear_motion_needs_no_more():
    """Analytic: between steps, values are interpolated linearly in time."""
    readout = plain()
    rng = np.random.default_rng(1)
    one, two = random_maxwell(rng, 3), random_maxwell(rng, 3)
    times = np.sort(np.concatenate([[0.0, 1.0], rng.uniform(0, 1, 30)]))
    counts = readout(times, one + times[:, None, None] * two)
    instants = counts.time - 1e-3
    expected = [(one + t * two)[c, c] for t, c in zip(instants, counts.channel, strict=True)]
    assert np.abs(counts.capacitance - expected).max() < 2e-21


def test_interpolation_error_is_second_order():
    """Rate: halving the steps quarters the error of a curved motion."""
    errors = []
    for count in (41, 81, 161):
        times = np.linspace(0, 1, count)
        matrices = moving(times, np.random.default_rng(2))
        counts = plain()(times, matrices)
        exact = moving(counts.time - 1e-3, np.random.default_rng(2))
        truth = exact[np.arange(len(counts)), counts.channel, counts.channel]
        errors.append(np.abs(counts.capacitance - truth).max())
    assert np.array(errors[:-1]) / errors[1:] == approx(4.0, rel=0.15)


def test_results_are_late():
    """Invariant: nothing is reported before its conversion is finished, and nothing is lost."""
    readout = plain()
    matrix = random_maxwell(np.random.default_rng(3), 3)
    total = 0
    for step in range(1000):
        now = 0.0007 * step
        counts = readout.sample(now, matrix)
        assert (counts.time <= now + 1e-9).all()
        assert (counts.time > now - 0.0007 - 1e-9).all()
        total += len(counts)
    assert total == readout.schedule.samples_until(0.0007 * 999 - 1e-3)


@pytest.mark.parametrize("seed", range(5))
def test_step_by_step_is_the_whole_recording(seed):
    """Differential: random steps, tiny and long ones, against one call; to the last bit."""
    rng = np.random.default_rng(seed)
    times = np.cumsum(10 ** rng.uniform(-5, -1, 300))
    matrices = moving(times, rng)
    whole = full(seed)(times, matrices)
    readout = full(seed)
    readout.reset(start=float(times[0]))
    parts = join([readout.sample(t, c) for t, c in zip(times, matrices, strict=True)])
    assert len(whole) > 300
    assert same(whole, parts)


@pytest.mark.parametrize("chip", CHIPS)
def test_every_chip_step_by_step(chip):
    """Differential and deterministic: presets too, and the seed decides everything."""
    rng = np.random.default_rng(0)
    times = np.arange(100) * 0.01
    matrices = moving(times, rng)
    readout = Readout.preset(
        chip, NAMES, seed=5, expected=4e-12, mains=1e-15, temperature=[(0, 25), (1, 30)],
        offset_per_kelvin=1e-16,
        wiring=Wiring(crosstalk=0.02),
    )  # fmt: skip
    whole = readout(times, matrices)
    assert same(readout(times, matrices), whole)
    readout.reset(seed=6)
    other = join([readout.sample(t, c) for t, c in zip(times, matrices, strict=True)])
    assert not same(other, whole)
    readout.reset(seed=5)
    again = join([readout.sample(t, c) for t, c in zip(times, matrices, strict=True)])
    assert same(again, whole)
    assert len(whole) > 3


def everything():
    """Every part of a readout that has a state or holds arrays."""
    return plain(
        dac=CapDac(1e-12, 8, follow=True), wiring=Wiring(crosstalk=0.01),
        stages=(
            LinearSensor([1.0, 1.1, 0.9], 1e-14, 1e-16, 0.0),
            ClimateDrift(1e-16, temperature=Profile.of([(0, 25), (1, 30)], "temperature")),
            RandomWalk(1e-16), Flicker(1e-15), Mains(1e-15), White(1e-15, 1e-3),
        ),
        detector=Detector(1e5, 1e4, SteppingTracker()),
    )  # fmt: skip


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda r: pickle.loads(pickle.dumps(r))])
def test_copies_go_on_where_the_original_stands(duplicate):
    """Invariant: to the last bit, and what one does the other does not feel."""
    rng = np.random.default_rng(0)
    times = np.arange(60) * 0.01
    matrices = moving(times, rng)
    readout = everything()
    for k in range(30):
        readout.sample(times[k], matrices[k])
    twin, third = duplicate(readout), duplicate(readout)
    original = join([readout.sample(times[k], matrices[k]) for k in range(30, 60)])
    assert len(original) > 100
    for other in (twin, third):
        assert same(join([other.sample(times[k], matrices[k]) for k in range(30, 60)]), original)


def test_start_shifts_everything():
    """Invariant: the same recording an hour later gives the same numbers an hour later."""
    times = np.arange(50) * 0.01
    matrices = moving(times, np.random.default_rng(1))
    now, later = plain()(times, matrices), plain()(times + 3600.0, matrices)
    assert later.time - 3600.0 == approx(now.time, abs=1e-9)
    readout = plain()
    first = readout.due(0.2)
    readout.reset(start=3600.0)
    assert readout.due(3600.2) - 3600.0 == approx(first, abs=1e-9)
    assert len(readout.due(3600.0)) == 0
    # Instants relative to the start are rounded differently, by 1e-13 s or so.
    assert np.abs(later.capacitance - now.capacitance).max() < 1e-20


def test_stages_know_the_time_of_the_recording():
    """Analytic: drift against the clock of the recording, and not since its start."""
    profile = Profile.of([(3600.0, 25.0), (3610.0, 35.0)], "temperature")
    stages = (LinearSensor(1.0, 0.0, 1e-15, 3600.0), ClimateDrift(1e-14, temperature=profile))
    counts = plain(stages=stages)([3600.0, 3605.0], np.full((2, 3), 1e-12))
    since = counts.time - 1e-3 - 3600.0
    assert np.abs(counts.capacitance - 1e-12 - 1.1e-14 * since).max() < 1e-20


def test_latency_only_delays():
    """Analytic: the same conversions, as much later, and none before its time."""
    times = np.arange(40) * 0.013
    matrices = moving(times, np.random.default_rng(1))
    prompt = plain(stages=(White(1e-15),))
    late = plain(replace(prompt.schedule, latency=0.02), stages=(White(1e-15),))
    now, then = prompt(times, matrices), late(times, matrices)
    assert len(now) > len(then) > 150
    assert (then.code == now.code[: len(then)]).all()
    assert then.time == approx(now.time[: len(then)] + 0.02, abs=1e-12)
    assert late.schedule.lag == approx(0.021, abs=1e-12)
    assert np.array_equal(late.due(0.5), prompt.due(0.5))
    for time, matrix in zip(times, matrices, strict=True):
        counts = late.sample(time, matrix)
        assert (counts.time <= time + 1e-9).all()
        assert (counts.time > time - 0.013 - 1e-9).all()


def test_wiring():
    """Analytic: crosstalk mixes channels at the same instant; parasitics add."""
    wiring = Wiring([1e-13, 2e-13, 3e-13], cable=1e-11, shield_gain=0.98, crosstalk=0.1)
    matrix = random_maxwell(np.random.default_rng(2), 3)
    counts = plain(Schedule.simultaneous(3, 1e-3), wiring=wiring)([0.0, 0.01], [matrix, matrix])
    c = np.diag(matrix)
    expected = c + 0.1 * (c.sum() - c) + np.array([1, 2, 3]) * 1e-13 + 0.02 * 1e-11
    assert counts.capacitance[:3] == approx(expected, rel=1e-9)
    moved = plain(Schedule.sequential(3, 1e-3), wiring=Wiring(crosstalk=[[0, 1, 0]] * 3))
    ramp = np.array([matrix, 2 * matrix])
    mixed = moved([0.0, 0.01], ramp)
    at = (1 + (mixed.time - 0.5e-3) / 0.01)[:3]
    assert mixed.capacitance[:3] == approx(at * (c + np.array([c[1], c[1], c[1]])), rel=1e-6)


def test_wiring_of_mutual_channels():
    """Analytic: leads to ground charge a self measurement only; between leads, a mutual one."""
    patterns = [Pattern("A"), Pattern("B", {"A": 1.0})]
    wiring = Wiring(trace=4e-12, cable=1e-11, shield_gain=0.5, coupling=[1e-13, 2e-13])
    readout = Readout(
        ChannelBank(patterns, NAMES), Schedule.simultaneous(2, 1e-3), FINE, wiring=wiring
    )
    matrix = random_maxwell(np.random.default_rng(2), 3)
    counts = readout([0.0, 0.01], [matrix, matrix])
    expected = [matrix[0, 0] + 4e-12 + 5e-12, -matrix[1, 0] + 2e-13]
    assert counts.capacitance[:2] == approx(expected, rel=1e-8)


@dataclass
class Reading:
    """As a simulator gives it."""

    capacitance: np.ndarray
    self_capacitance: np.ndarray
    electrode_names: tuple[str, ...] = NAMES


def test_readings_of_a_simulator():
    """A reading's shields are driven along with a self channel, and grounded for a mutual one."""
    matrix = random_maxwell(np.random.default_rng(3), 3)
    coupling = np.array([-0.1, -0.2, -0.3]) * 1e-12
    reading = Reading(matrix, np.diag(matrix) + coupling)
    patterns = [Pattern("A", shield=1.0), Pattern("B", shield=0.0), Pattern("C", {"A": 1.0})]
    readout = Readout(ChannelBank(patterns, NAMES), Schedule.simultaneous(3, 1e-3), FINE)
    expected = [matrix[0, 0] + coupling[0], matrix[1, 1], -matrix[2, 0]]
    assert readout.channel_values(reading) == approx(expected, rel=1e-12)
    assert readout.channel_values(np.array(expected)).tolist() == expected
    readout.sample(0.0, reading)
    assert readout.sample(1.0, reading).capacitance[:3] == approx(expected, rel=1e-8)
    assert readout([0.0, 1.0], [reading, reading]).capacitance[:3] == approx(expected, rel=1e-8)
    other = Reading(matrix, np.diag(matrix), ("A", "C", "B"))
    with pytest.raises(ReadoutError, match="make it with the simulator's electrode_names"):
        readout.sample(2.0, other)
    with pytest.raises(ReadoutError, match="make it with the simulator's electrode_names"):
        readout([0.0, 1.0], [reading, other])
    with pytest.raises(ReadoutError, match=r"1 times for capacitances of shape \(2, 3\)"):
        readout([0.0], [reading, reading])


def test_counts_by_channel_and_in_rows():
    times = np.arange(50) * 0.01
    counts = plain()(times, moving(times, np.random.default_rng(1)))
    assert counts.of("B").channel.tolist() == [1] * len(counts.of("B"))
    stamps, rows = counts.table()
    assert rows.shape == (len(counts) // 3, 3)
    _, codes = counts.table("code")
    assert codes.dtype == np.int64
    assert (codes == np.rint(rows / 1e-21)).all()
    assert not counts.table("flags")[1].any()
    for k, name in enumerate(NAMES):
        assert (rows[:, k] == counts.of(name).capacitance[: len(rows)]).all()
        assert (stamps[:, k] == counts.of(name).time[: len(rows)]).all()
    assert set(counts.latest()) == set(NAMES)
    assert counts.latest()["C"] == counts.of("C").capacitance[-1]
    with pytest.raises(ReadoutError, match="no channel 'D'"):
        counts.of("D")
    with pytest.raises(ReadoutError, match="not whole cycles"):
        counts[counts.channel != 1].table()
    with pytest.raises(ReadoutError, match="no 'touched'; valid are code, capacitance, flags"):
        counts.table("touched")
    with pytest.raises(ReadoutError, match="no counts to join"):
        join([])
    assert same(join([counts]), counts)


def test_representations_are_short():
    readout = Readout.preset("fdc1004", NAMES)
    assert repr(readout) == "<Readout 'Texas Instruments FDC1004': 3 channels, each every 30 ms>"
    counts = readout([0.0, 0.035], np.full((2, 3), 1e-12))
    assert repr(counts) == "<Counts: 3 conversions of 3 channels, 0.01 to 0.03 s>"
    assert repr(counts[:0]) == "<Counts: 0 conversions of 3 channels>"


def test_seeds_of_any_kind_of_integer():
    times, matrices = [0.0, 0.1], random_maxwell(np.random.default_rng(0), 3)[None].repeat(2, 0)
    assert same(full(np.int64(3))(times, matrices), full(3)(times, matrices))


@pytest.mark.parametrize("kind", [float, np.float32, np.float64, np.int64])
def test_numbers_of_any_kind(kind):
    """What is a real number is taken as one, whatever library it comes from."""
    matrix = random_maxwell(np.random.default_rng(0), 3)
    counts = [plain(stages=(White(kind(0)),)) for _ in range(2)]
    for readout in counts:
        readout.sample(kind(0), matrix)
    assert len(counts[0].sample(kind(1), matrix)) > 400
    with pytest.raises(ReadoutError, match="give a finite time"):
        counts[1].sample(True, matrix)


def test_leaps_are_refused():
    """A clock that does not start at zero, as that of the day, is no reason to run for hours."""
    readout = plain()
    matrix = random_maxwell(np.random.default_rng(0), 3)
    with pytest.raises(ReadoutError, match=r"more than 2e.07 conversions"):
        readout.sample(1.01 * 20e6 / 3 * readout.schedule.period, matrix)
    for leap in (lambda: readout.sample(1.7e9, matrix), lambda: readout.due(1.7e9),
                 lambda: readout([0.0, 1.7e9], [matrix, matrix])):  # fmt: skip
        with pytest.raises(ReadoutError, match=r"1.7e\+09 s is .*begin there: reset\(start=…\)"):
            leap()
    readout.reset(start=1.7e9)
    with pytest.raises(ReadoutError, match=r"1.8e\+09 s is more than"):
        readout.due(1.8e9)
    assert len(readout.due(1.7e9 + 1)) > 400
    readout.sample(1.7e9, matrix)
    done = len(readout.sample(1.7e9 + 1, matrix))
    assert done == readout.schedule.samples_until(1 - 1e-3)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"stages": [3]}, "3 is no Stage"),
        ({"detector": 3}, "3 is no Detector"),
        ({"wiring": "cable"}, "'cable' is no Wiring"),
        ({"wiring": Wiring(trace=-1e-12)}, "trace holds -1e-12 F"),
        ({"wiring": Wiring(trace="long")}, "trace: .* no real numbers"),
        ({"wiring": Wiring(shield_gain="good")}, "shield_gain is 'good'"),
        ({"wiring": Wiring(crosstalk=[[0.0], [0.0, 1.0]])}, "crosstalk: rows differ"),
        ({"seed": 1.5}, "seed is 1.5"),
    ],
)
def test_parts_that_do_not_fit_are_refused(options, words):
    with pytest.raises(ReadoutError, match=words):
        plain(**options)


def test_stages_are_applied_in_their_order():
    """Analytic: gain and offset, either way round; a stage and a law of one's own take part."""

    class Doubled:
        def start(self, context):
            return lambda channel, time, value: 2 * value

    class Square:
        """Code = (C/fF)²."""

        low, high, rising = 0, 10**9, True

        def level(self, capacitance):
            return (capacitance / 1e-15) ** 2

        def capacitance(self, code):
            return 1e-15 * np.sqrt(code)

    shift = LinearSensor(1.0, 3e-13, 0.0, 0.0)
    for stages, expected in (((Doubled(), shift), 2300), ((shift, Doubled()), 2600)):
        readout = Readout(
            ChannelBank(self_patterns(NAMES), NAMES),
            Schedule.simultaneous(3, 0.1),
            Square(),
            stages=stages,
        )
        counts = readout([0.0, 1.0], np.full((2, 3), 1e-12))
        assert (counts.code == expected**2).all()
        assert counts.capacitance == approx(np.full(len(counts), expected * 1e-15), rel=1e-12)


def test_a_stage_that_fails_is_noticed():
    """NaN is never turned into a code."""

    class Broken:
        def start(self, context):
            return lambda channel, time, value: value * np.nan

    matrix = random_maxwell(np.random.default_rng(0), 3)
    with pytest.raises(ReadoutError, match="a stage made a number that is not finite"):
        plain(stages=[Broken()])([0.0, 1.0], [matrix, matrix])


def test_misuse_is_refused():
    readout = plain()
    matrix = random_maxwell(np.random.default_rng(0), 3)
    readout.sample(1.0, matrix)
    with pytest.raises(ReadoutError, match=r"sample at 0.5 s, after one at 1 s; time must not go"):
        readout.sample(0.5, matrix)
    with pytest.raises(ReadoutError, match="sample at nan s; give a finite time"):
        readout.sample(float("nan"), matrix)
    with pytest.raises(ReadoutError, match="sample at 'now' s; give a finite time"):
        readout.sample("now", matrix)
    with pytest.raises(ReadoutError, match="sample takes one instant"):
        readout.sample(2.0, np.ones((4, 3, 3)))
    with pytest.raises(ReadoutError, match="until is nan"):
        readout.due(float("nan"))
    with pytest.raises(ReadoutError, match=r"shape \(2, 2\)"):
        readout.sample(2.0, np.eye(2))
    with pytest.raises(ReadoutError, match="not finite"):
        readout.sample(2.0, np.array([1e-12, np.nan, 1e-12]))
    with pytest.raises(ReadoutError, match=r"channel values have shape \(4,\); give 3"):
        readout.sample(2.0, np.ones(4))
    with pytest.raises(ReadoutError, match=r"2 times for capacitances of shape \(3, 3\)"):
        readout([0.0, 1.0], np.ones((3, 3)))
    with pytest.raises(ReadoutError, match="times must be finite numbers that rise"):
        readout([0.0, 0.0], np.ones((2, 3)))
    with pytest.raises(ReadoutError, match="samples 4 channels and there are 3"):
        plain(Schedule.sequential(4, 1e-3))
    with pytest.raises(ReadoutError, match="seed is -1"):
        plain(seed=-1)
    with pytest.raises(ReadoutError, match="start is nan"):
        readout.reset(start=float("nan"))
    with pytest.raises(ReadoutError, match=r"shield_gain is 1\.5"):
        plain(wiring=Wiring(shield_gain=1.5))
    with pytest.raises(ReadoutError, match="trace is"):
        plain(wiring=Wiring(trace=[1.0, 2.0]))
    with pytest.raises(ReadoutError, match="crosstalk is"):
        plain(wiring=Wiring(crosstalk=[1.0, 2.0]))


def test_held_values_are_of_fixed_size() -> None:
    """Every channel's last conversion and its age, at every call; 0 where there is none yet."""
    chip = Readout.preset("fdc1004", NAMES)
    counts = chip.sample(0.0, np.zeros((3, 3)))
    held = counts.held()
    assert len(counts) == 0
    assert held.capacitance.tolist() == [0.0] * len(chip.channel_names)
    assert np.isinf(held.age).all()
    seen: list[Counts] = []
    for time in np.arange(1, 60) * 0.7e-3:
        counts = chip.sample(time, np.eye(3) * (1 + time) * 1e-12)
        seen.append(counts)
        held = counts.held()
        for k, name in enumerate(chip.channel_names):
            own = [c.of(name) for c in seen if len(c.of(name))]
            if own:
                assert held.capacitance[k] == own[-1].capacitance[-1]
                assert held.code[k] == own[-1].code[-1]
                assert held.age[k] == approx(time - own[-1].time[-1])
            else:
                assert np.isinf(held.age[k])
    assert np.isfinite(held.age).all()
    whole = replace(join(seen), until=None)
    last = whole.last()
    np.testing.assert_allclose(whole.held().age[last.channel], last.time.max() - last.time)
    assert np.isinf(replace(seen[0][:0], until=None).held().age).all()
    chip.reset()
    assert np.isinf(chip.sample(0.0, np.zeros((3, 3))).held().age).all()


@dataclass
class LossyReading:
    """A reading of a sensor near matter that conducts."""

    electrode_names: tuple[str, ...]
    capacitance: np.ndarray
    conductance: np.ndarray | None

    @property
    def self_capacitance(self) -> np.ndarray:
        return np.diag(self.capacitance)


def demodulating(**options):
    """One mutual channel, demodulated with codes of 40 bits."""
    front = ShuntFrontEnd(excitation_frequency=250e3, shunt=800.0, gain=10.0, parasitic=20e-12)
    patterns = (Pattern("B", {"A": 1.0}),)
    law = ShuntLaw(front, full_scale=0.1, bits=40)
    bank = ChannelBank(patterns, NAMES)
    return Readout(bank, Schedule.sequential(1, 1e-3), law, **options), front


@pytest.mark.parametrize("chip", ["fdc1004", "mpr121"])
def test_no_age_is_negative(chip: str) -> None:
    """A conversion that ends with the reading has the age 0, however sums of times are rounded."""
    readout = Readout.preset(chip, NAMES)
    ages = [readout.sample(0.01 * k, np.eye(3) * 1e-12).held().age for k in range(400)]
    assert np.min(ages) == 0.0


def test_loss_reaches_the_demodulated_magnitude():
    """|V_o| of a divider of Y = G + jωC over 1/R + Y + jωC_p, worked out here.

    For a small Y it is ωC √(1 + tan²δ): a loss as large as the capacitance's current reads as
    41 % more of it.
    """
    c, omega = 0.4e-12, 2 * np.pi * 250e3
    matrix = c * np.array([[3.0, -1.0, 0.0], [-1.0, 3.0, 0.0], [0.0, 0.0, 1.0]])
    for tangent in (0.0, 0.3, 1.0):
        reading = LossyReading(NAMES, matrix, tangent * omega * matrix)
        readout, front = demodulating()
        counts = join([readout.sample(t, reading) for t in (0.0, 0.01)])
        admittance = omega * c * (1j + tangent)
        volts = abs(10.0 * admittance / (1 / 800.0 + admittance + 1j * omega * 20e-12))
        assert counts.code[0] == approx(volts / 0.1 * 2**39, rel=1e-9)
        assert counts.capacitance[0] == approx(front.recover(volts), rel=1e-9)
        assert counts.capacitance[0] == approx(c * np.hypot(1.0, tangent), rel=0.02)
        again = readout([0.0, 0.01], [reading, reading])
        assert np.array_equal(again.code, counts.code)
        assert readout.channel_values(reading) == approx([c])


def test_loss_passes_wiring_stages_and_an_offset_dac():
    """They act on the capacitance and leave the loss as it is."""
    omega = 2 * np.pi * 250e3
    matrix = 2e-12 * np.array([[3.0, -1.0, 0.0], [-1.0, 3.0, 0.0], [0.0, 0.0, 1.0]])
    reading = LossyReading(NAMES, matrix, 0.5 * omega * matrix)
    readout, front = demodulating(
        wiring=Wiring(coupling=1e-12), dac=CapDac(1e-12, 4), stages=(White(1e-30, 1e-3),)
    )
    counts = readout([0.0, 0.01], [reading, reading])
    left = abs(front.output(np.array(0.0e-12 - 1j * 1e-12)))
    assert np.abs(counts.code[0]) == approx(left / 0.1 * 2**39, rel=1e-4)


def test_loss_changes_nothing_of_other_laws():
    """What their chips make of a conductance no source says; they report the capacitance."""
    matrix = np.eye(3) * 1e-12
    lossy, dry = (LossyReading(NAMES, matrix, g) for g in (np.eye(3) * 1e-6, None))
    one, other = (plain()([0.0, 0.1], [r, r]) for r in (lossy, dry))
    assert same(one, other)
