"""Schedules: when each channel is sampled, against a list written out."""

from __future__ import annotations

import numpy as np
import pytest
from approximate import approx

from capsense.errors import ReadoutError
from capsense.readout.conversions import Schedule, idle_of, rounds


def written_out(plan, cycles):
    """Slow reference: (instant, channel) of every sample, one after another."""
    out, now = [], 0.0
    for cycle in range(cycles):
        now = cycle * (len(plan.slots) * (plan.conversion + plan.gap) + plan.idle)
        for slot in plan.slots:
            now += plan.gap
            out += [(now + plan.conversion / 2, c) for c in slot]
            now += plan.conversion
    return out


PLANS = [
    Schedule.sequential(5, 2e-3),
    Schedule.sequential(6, 2.5e-3, inputs=4, gap=1e-4),
    Schedule.sequential(3, 1e-3, period=0.016),
    Schedule.simultaneous(4, 0.01),
    Schedule.simultaneous(4, 0.01, period=0.03),
    Schedule(((2, 0), (1,), (3, 4)), 1e-3, 2e-4, 3e-4, 5e-3),
]


@pytest.mark.parametrize("plan", PLANS)
def test_instants_follow_the_slots(plan):
    """Differential: instants and channels of many cycles."""
    expected = written_out(plan, 50)
    number = np.arange(len(expected))
    assert plan.instant(number) == approx([t for t, _ in expected], rel=1e-12)
    assert (plan.order[number % plan.count] == [c for _, c in expected]).all()
    assert plan.period == approx(expected[plan.count][0] - expected[0][0], rel=1e-12)


@pytest.mark.parametrize("plan", PLANS)
def test_counting_up_to_a_time(plan):
    """Differential: at random times, and at the instants themselves despite rounding."""
    instants = plan.instant(np.arange(60 * plan.count))
    rng = np.random.default_rng(0)
    for time in rng.uniform(-plan.period, 50 * plan.period, 300):
        assert plan.samples_until(time) == np.count_nonzero(instants <= time)
    for time in instants[: 40 * plan.count]:
        assert plan.samples_until(time) == np.count_nonzero(instants <= time + plan.slack)
        shaken = (time + 1234.5) - 1234.5
        assert plan.samples_until(shaken) == plan.samples_until(time)


def test_inputs_of_several_chips_run_side_by_side():
    assert Schedule.sequential(6, 1.0, inputs=4).slots == ((0, 4), (1, 5), (2,), (3,))
    assert Schedule.sequential(2, 1.0, inputs=4).slots == ((0,), (1,))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Schedule(((0,),), 0.0), "conversion is 0.0; give"),
        (lambda: Schedule(((0,),), float("nan")), "conversion is nan"),
        (lambda: Schedule(((0,),), 1.0, -1.0), "gap is -1.0"),
        (lambda: Schedule(((0,),), 1.0, 0.0, float("inf")), "idle is inf"),
        (lambda: Schedule(((0,),), 1.0, latency=-1.0), "latency is -1.0"),
        (lambda: Schedule((), 1.0), "list each of 0, 1, 2"),
        (lambda: Schedule(((0, 0),), 1.0), "list each of 0, 1, 2"),
        (lambda: Schedule(((0, 2),), 1.0), "list each of 0, 1, 2"),
        (lambda: Schedule.sequential(0, 1.0), "number of channels is 0"),
        (lambda: Schedule.sequential(3, 1.0, inputs=0), "number of inputs is 0"),
        (
            lambda: Schedule.sequential(3, 1.0, period=2.0),
            "too short for its conversions, which take 3 s",
        ),
        (lambda: Schedule.sequential(3, -1.0), "conversion is -1.0; give"),
        (lambda: Schedule.sequential(3, 1.0, period=float("nan")), "period is nan; give"),
        (lambda: Schedule(((0,), ()), 1.0), "a slot holds no channel"),
        (lambda: Schedule.simultaneous(3, 1.0, period=0.5), "conversions, which take 1 s"),
    ],
)
def test_bad_schedules_are_refused(make, words):
    with pytest.raises(ReadoutError, match=words):
        make()


def test_times_by_hand():
    """Two slots of 0.1 + 1.0 ms in a period of 5 ms, read 7 ms after a conversion's end."""
    plan = Schedule.sequential(channels=2, conversion=1e-3, gap=1e-4, period=5e-3)
    assert plan.idle == approx(2.8e-3)
    assert plan.period == approx(5e-3)
    assert Schedule(((0,),), 2e-3, latency=7e-3).lag == approx(8e-3)
    side_by_side = Schedule.simultaneous(channels=3, conversion=1e-3, period=4e-3)
    assert side_by_side.idle == approx(3e-3)
    with pytest.raises(ReadoutError, match="too short"):
        Schedule.sequential(2, 1e-3, gap=1e-4, period=2.1e-3)


def test_no_conversion_takes_no_time():
    for make in (Schedule.sequential, Schedule.simultaneous):
        with pytest.raises(ReadoutError, match="conversion is 0"):
            make(1, 0.0)


def test_idle_and_rounds():
    assert idle_of(1.0, 0.25) == approx(0.75)
    assert idle_of(None, 0.25) == 0.0
    assert list(rounds(5, 2)) == [slice(0, 2), slice(2, 4), slice(4, 6)]
