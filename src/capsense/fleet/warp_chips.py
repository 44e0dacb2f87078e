"""Chips of one kind on Warp, one for each sensor of a fleet, with noise and drift of their own.

The twin is :class:`~capsense.readout.side_by_side.SideBySide`: the same channels, schedule, stages
and converters in double precision, but other random numbers. A thread is one channel of one chip.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from capsense.errors import ReadoutError
from capsense.fleet import warp_laws as laws
from capsense.fleet.warp_laws import Law, law_of
from capsense.readout.counts import Held
from capsense.readout.noise import ClimateDrift, Context, Flicker, Mains, RandomWalk, White
from capsense.readout.readout import Readout

wp.set_module_options({"enable_backward": False})

WHITE, POLES, MAINS, CLIMATE = (wp.constant(k) for k in range(4))


@wp.struct
class Chip:
    """The figures of a chip with K channels; times in seconds."""

    sense: wp.array(dtype=wp.int32)  # electrode that a channel reads, (K,)
    sign: wp.array(dtype=wp.float64)
    volts: wp.array2d(dtype=wp.float64)  # of each electrode, (K, n)
    shield: wp.array(dtype=wp.float64)  # of the shields, (K,)
    base: wp.array(dtype=wp.float64)  # what it reads of the electrodes in the empty domain [F]
    mixing: wp.array2d(dtype=wp.float64)  # (K, K)
    offset: wp.array(dtype=wp.float64)  # [F], (K,)
    instant: wp.array(dtype=wp.float64)  # of a channel in a cycle, (K,)
    period: wp.float64
    lag: wp.float64
    slack: wp.float64
    law: Law
    actual: wp.array(dtype=wp.float64)  # what the offset DAC subtracts [F], (codes,); empty: none
    step: wp.float64  # what its user takes for one step [F]
    follow: wp.int32
    stride: wp.int32
    stages: wp.array(dtype=wp.int32)  # kinds, in order
    figures: wp.array2d(dtype=wp.float64)  # of each stage, (stages, 10)
    keep: wp.array(dtype=wp.float64)  # what is kept of the states of poles, (p,)
    kick: wp.array(dtype=wp.float64)
    profile: wp.array2d(dtype=wp.float64)  # times and values of all profiles, (2, ...)


@wp.struct
class State:
    """What changes; c chips."""

    now: wp.array(dtype=wp.float64)  # [s], (1,)
    before: wp.array(dtype=wp.float64)  # time of the last call [s], -1e300 before the first, (1,)
    raw: wp.array2d(dtype=wp.float64)  # channels before wiring [F], (K, c)
    last: wp.array2d(dtype=wp.float64)  # channels of the last call [F], (K, c)
    taken: wp.array2d(dtype=wp.int32)  # samples that were taken, (K, c)
    told: wp.array2d(dtype=wp.int32)  # and that can be read
    random: wp.array2d(dtype=wp.uint32)
    dac: wp.array2d(dtype=wp.int32)  # -1 where it is not set
    poles: wp.array3d(dtype=wp.float64)  # (p, K, c)
    waiting: wp.array3d(dtype=wp.vec2d)  # codes and capacitances that cannot be read yet, (d, K, c)


@wp.kernel
def channels(
    chip: Chip, delta: wp.array4d(dtype=wp.float32), shields: wp.array3d(dtype=wp.float64),
    state: State,
):  # fmt: skip
    """Capacitances of all channels, as ``ChannelBank.values``."""
    k, c = wp.tid()
    e = c // delta.shape[1]
    s = c % delta.shape[1]
    i = chip.sense[k]
    total = chip.base[k] + chip.shield[k] * shields[e, s, i]
    for j in range(delta.shape[3]):
        total += chip.volts[k, j] * wp.float64(delta[e, s, i, j])
    state.raw[k, c] = chip.sign[k] * total


@wp.func
def _at(chip: Chip, first: int, count: int, time: wp.float64):
    """Value of a profile at a time, linear between its points."""
    out = chip.profile[1, first]
    for k in range(1, count):
        start = chip.profile[0, first + k - 1]
        end = chip.profile[0, first + k]
        if time > start:
            share = wp.min((time - start) / (end - start), wp.float64(1.0))
            low = chip.profile[1, first + k - 1]
            out = low + share * (chip.profile[1, first + k] - low)
    return out


@wp.func
def _staged(
    chip: Chip, state: State, k: int, c: int, time: wp.float64, given: wp.float64, seed: wp.uint32
):
    """Send a value through all stages."""
    value = given
    for stage in range(chip.stages.shape[0]):
        kind = chip.stages[stage]
        a = chip.figures[stage, 0]
        b = chip.figures[stage, 1]
        if kind == WHITE:
            scale = wp.sqrt(a * a + b * b * value * value)
            value += scale * wp.float64(wp.randn(seed))
        elif kind == POLES:
            for p in range(int(a), int(a) + int(b)):
                kick = chip.kick[p] * wp.float64(wp.randn(seed))
                state.poles[p, k, c] = chip.keep[p] * state.poles[p, k, c] + kick
                value += state.poles[p, k, c]
        elif kind == MAINS:
            value += a * wp.sin(b * time + chip.figures[stage, 2])
        else:
            warmer = _at(chip, int(chip.figures[stage, 4]), int(chip.figures[stage, 5]), time)
            damper = _at(chip, int(chip.figures[stage, 6]), int(chip.figures[stage, 7]), time)
            warmer -= chip.figures[stage, 8]
            damper -= chip.figures[stage, 9]
            gain = wp.float64(1.0) + b * warmer + chip.figures[stage, 3] * damper
            value = gain * value + a * warmer + chip.figures[stage, 2] * damper
    state.random[k, c] = seed
    return value


@wp.func
def _converted(chip: Chip, state: State, k: int, c: int, value: wp.float64):
    """Code and capacitance of a value, as ``Conversion``."""
    used = int(0)
    inside = value
    codes = chip.actual.shape[0]
    if codes > 0:
        used = state.dac[k, c]
        if used < 0:
            used = wp.clamp(int(wp.rint(value / chip.step)), 0, codes - 1)
        inside = value - chip.actual[used]
    level = wp.rint(laws.level(chip.law, inside))
    code = wp.clamp(level, chip.law.low, chip.law.high)
    reported = laws.capacitance(chip.law, code) + wp.float64(used) * chip.step
    if codes > 0:
        if chip.follow != 0 and level != code:
            up = (level > code) == (chip.law.rising != 0)
            used = wp.clamp(used + wp.where(up, chip.stride, -chip.stride), 0, codes - 1)
        state.dac[k, c] = used
    return wp.vec2d(code, reported)


@wp.kernel
def convert(
    chip: Chip, state: State, seed: int, code: wp.array3d(dtype=wp.int64),
    capacitance: wp.array3d(dtype=wp.float64), age: wp.array3d(dtype=wp.float64),
):  # fmt: skip
    """Take the samples whose instants have come, and tell those that can be read."""
    k, c = wp.tid()
    e = c // code.shape[1]
    s = c % code.shape[1]
    now = state.now[0]
    before = state.before[0]
    value = chip.offset[k]
    for other in range(state.raw.shape[0]):
        value += chip.mixing[k, other] * state.raw[other, c]
    first = before < wp.float64(-1.0e299)
    if first:
        state.random[k, c] = wp.rand_init(seed, c * state.raw.shape[0] + k)
    old = wp.where(first, value, state.last[k, c])
    taken = state.taken[k, c]
    told = state.told[k, c]
    late = chip.lag - chip.slack
    moment = wp.float64(taken) * chip.period + chip.instant[k]
    depth = state.waiting.shape[0]
    while moment - chip.slack <= now:
        share = wp.float64(1.0)
        if not first and now > before:
            share = wp.min((moment - before) / (now - before), share)
        sample = _staged(chip, state, k, c, moment, old + share * (value - old), state.random[k, c])
        state.waiting[taken % depth, k, c] = _converted(chip, state, k, c, sample)
        taken += 1
        moment = wp.float64(taken) * chip.period + chip.instant[k]
        if taken - told >= depth:
            told += 1  # a later one can be read by now
    while told < taken and wp.float64(told) * chip.period + chip.instant[k] + late <= now:
        told += 1
    if told > 0:
        held = state.waiting[(told - 1) % depth, k, c]
        code[e, s, k] = wp.int64(held[0])
        capacitance[e, s, k] = held[1]
        stamp = wp.float64(told - 1) * chip.period + chip.instant[k] + chip.lag
        age[e, s, k] = now - stamp
    state.last[k, c] = value
    state.taken[k, c] = taken
    state.told[k, c] = told


@wp.kernel
def pass_on(state: State):
    """Remember the time of this call."""
    state.before[0] = state.now[0]


class WarpChips:
    """Chips on a device, all switched on at 0 s.

    Args:
        readout: A readout of one sensor; it stays as it is.
        shape: How many environments and sensors.
        empty: Maxwell matrix of the electrodes in the empty domain [F], shape (n, n).
        seed: Of all random numbers.
        device: Warp's device.

    Raises:
        ReadoutError: The readout has parts that are not known on Warp.
    """

    def __init__(
        self, readout: Readout, shape: tuple[int, int], empty: Any, seed: int, device: Any
    ) -> None:
        self._seed, self._device, self._readout, self._last = seed, device, readout, -math.inf
        k, chips = len(readout.bank), shape[0] * shape[1]

        def room(*size: int, dtype: Any = wp.float64) -> Any:
            return wp.zeros(size, dtype=dtype, device=device)

        self._chip = self._figures(readout, empty)
        state, plan = State(), readout.schedule
        state.now, state.before = room(1), room(1)
        state.before.fill_(-1e300)
        state.raw, state.last = room(k, chips), room(k, chips)
        for name in ("taken", "told", "dac"):
            setattr(state, name, room(k, chips, dtype=wp.int32))
        state.random = room(k, chips, dtype=wp.uint32)
        dac = readout.dac
        state.dac.fill_(-1 if dac is None or dac.start == "auto" else dac.start)
        state.waiting = room(math.ceil(plan.lag / plan.period) + 2, k, chips, dtype=wp.vec2d)
        self._set_stages(readout, k, chips, state)
        self._state = state
        self._held = Held(
            room(*shape, k),
            room(*shape, k, dtype=wp.int64),
            room(*shape, k),  # type: ignore
        )
        self._held.age.fill_(math.inf)

    def _array(self, values: Any, dtype: Any = wp.float64) -> Any:
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self._device)

    def _figures(self, readout: Readout, empty: Any) -> Any:
        bank, plan, dac, array = readout.bank, readout.schedule, readout.dac, self._array
        if bank._with_floating:
            name = bank.names[bank._with_floating[0]]
            raise ReadoutError(
                f'channel {name!r} leaves electrodes open, which chips know on device "cpu" only; '
                'give it rest="grounded" or "guard"'
            )
        out = Chip()
        out.sense, out.sign = array(bank._sense, wp.int32), array(bank._sign)
        out.volts, out.shield = array(bank._volts), array(bank._shield)
        out.base = array((empty[bank._sense] * bank._volts).sum(axis=1))
        mixing, offset = readout.wiring.start(np.array([p.is_self for p in bank.patterns]))
        out.mixing, out.offset = array(mixing), array(offset)
        instant = np.empty(len(bank))
        instant[plan.order] = plan.offsets
        out.instant, out.period = array(instant), plan.period
        out.lag, out.slack = plan.lag, plan.slack
        out.law = law_of(readout.law)
        if dac is not None:
            out.actual, out.step, out.follow = array(dac.actual()), dac.step, int(dac.follow)
            out.stride = dac.stride(readout.law)
        else:
            out.actual = array(np.zeros(0))
        return out

    def _set_stages(self, readout: Readout, k: int, chips: int, state: Any) -> None:
        """Set the stages of the chip, and the states that they begin with."""
        seeds = np.random.SeedSequence(self._seed).spawn(len(readout.stages))
        plan = readout.schedule
        kinds: list[int] = []
        figures: list[Sequence[float]] = []
        keep: list[float] = []
        kick: list[float] = []
        poles: list[Any] = []
        profiles: list[Any] = []
        for stage, seed in zip(readout.stages, seeds, strict=True):
            rng = np.random.default_rng(seed)
            process: Any = stage.start(Context(k * chips, plan.conversion, plan.period, rng))
            if isinstance(stage, White):
                kinds.append(WHITE)
                figures.append((stage.rms, stage.relative))
            elif isinstance(stage, Flicker | RandomWalk):
                walk = isinstance(stage, RandomWalk)
                _, *rest = process.args
                own_keep, own_kick = ([1.0], [rest[0]]) if walk else (rest[0], rest[1])
                kinds.append(POLES)
                figures.append((len(keep), len(own_keep)))
                keep.extend(own_keep)
                kick.extend(own_kick)
                poles.append(rest[-1].reshape(chips, k, -1).transpose(2, 1, 0))
            elif isinstance(stage, Mains):
                passed, phase = process.args
                kinds.append(MAINS)
                figures.append((passed, 2 * math.pi * stage.frequency, phase))
            elif isinstance(stage, ClimateDrift):
                first = sum(len(p.times) for p in profiles)
                warm, damp = stage.temperature, stage.humidity
                profiles += [warm, damp]
                kinds.append(CLIMATE)
                figures.append((
                    stage.offset_per_kelvin, stage.gain_per_kelvin, stage.offset_per_percent,
                    stage.gain_per_percent, first, len(warm.times), first + len(warm.times),
                    len(damp.times), *stage.reference,
                ))  # fmt: skip
            else:
                raise ReadoutError(f'{stage!r} is a stage that chips know on device "cpu" only')
        chip, array = self._chip, self._array
        chip.stages = array(kinds, wp.int32)
        chip.figures = array([[*f, *[0.0] * (10 - len(f))] for f in figures] or np.zeros((0, 10)))
        chip.keep, chip.kick = array(keep), array(kick)
        points = [(p.times, p.values) for p in profiles]
        chip.profile = array(np.concatenate(points, axis=1) if points else np.zeros((2, 0)))
        state.poles = array(np.concatenate(poles) if poles else np.zeros((0, k, chips)))

    def sample(self, time: Any, delta: Any, shields: Any) -> Held:
        """Tell what the sensors see at a time; get what the chips' registers hold.

        Args:
            time: [s], not before the last call's; or an array of Warp that holds it, of shape
                (1,) and double precision, which is not looked at.
            delta: Change of the Maxwell matrices [F], shape (e, s, n, n).
            shields: Charge on each electrode per volt on all shields together [F], (e, s, n).

        Returns:
            Arrays of shape (e, s, K), written anew by the next call.

        Raises:
            ReadoutError: Time is not finite, goes back, or leaps.
        """
        if isinstance(time, wp.array):
            wp.copy(self._state.now, time)
        else:
            self._readout.require_forward(time, self._last)
            self._last = float(time)
            self._state.now.fill_(self._last)
        held, dim = self._held, self._state.raw.shape
        for kernel, size, arguments in (
            (channels, dim, [self._chip, delta, shields, self._state]),
            (
                convert, dim,
                [self._chip, self._state, self._seed, held.code, held.capacitance, held.age],
            ),
            (pass_on, 1, [self._state]),
        ):  # fmt: skip
            wp.launch(kernel, dim=size, inputs=arguments, device=self._device)
        return held
