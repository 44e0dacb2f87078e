"""Chips of one kind on Warp as kernels: a thread is one channel of one chip.

The twin is :class:`~capsense.readout.side_by_side.SideBySide`; converters have the laws of
:mod:`capsense.readout.laws`. All in double precision.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from capsense.errors import ReadoutError
from capsense.readout.laws import LinearLaw, ReciprocalLaw, ResonanceLaw, ShuntLaw

wp.set_module_options({"enable_backward": False})

WHITE, POLES, MAINS, CLIMATE = (wp.constant(k) for k in range(4))
_LINEAR, _RECIPROCAL, _RESONANCE, _SHUNT = (wp.constant(k) for k in range(4))
_FAR = wp.constant(wp.float64(1e300))  # stands for infinity


@wp.struct
class WarpLaw:
    """How code and capacitance belong together."""

    kind: wp.int32
    rising: wp.int32
    low: wp.float64
    high: wp.float64
    scale: wp.float64  # codes per farad; codes times farad; codes times √farad; codes per volt
    zero: wp.float64  # code at 0 F
    curve: wp.float64  # nonlinearity, in codes
    fixed: wp.float64  # capacitance of the tank [F]
    most: wp.float64  # amplitude that a large capacitance gives [V]
    nominal: wp.float64  # the same without a bandwidth [V]
    shunt: wp.float64  # ω R_S [1/F]
    load: wp.float64  # ω R_S C_p


@wp.struct
class ChipFigures:
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
    law: WarpLaw
    codes: wp.int32  # of the offset DAC; 0: none
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
    bits: wp.array3d(dtype=wp.float64)  # what bits of the offset DAC have too much [F], (b, K, c)
    poles: wp.array3d(dtype=wp.float64)  # (p, K, c)
    waiting: wp.array3d(dtype=wp.vec2d)  # codes and capacitances that cannot be read yet, (d, K, c)


def law_of(law: Any) -> Any:
    """A law for the kernels.

    Raises:
        ReadoutError: It is none that is known here.
    """
    out = WarpLaw()
    out.rising, out.low, out.high = int(law.rising), law.low, law.high
    if isinstance(law, LinearLaw):
        out.kind, out.scale, out.zero = _LINEAR, 1 / law.lsb, law.zero
        out.curve = 4.0 * law.nonlinearity * (law.high - law.low)
    elif isinstance(law, ReciprocalLaw):
        out.kind, out.scale = _RECIPROCAL, law._product
    elif isinstance(law, ResonanceLaw):
        out.kind, out.fixed = _RESONANCE, law.fixed
        out.scale = float(law.level(1.0 - law.fixed))
    elif isinstance(law, ShuntLaw):
        end = law.front_end
        out.kind, out.scale = _SHUNT, 2 ** (law.bits - 1) / law.full_scale
        out.nominal = end.gain * end.amplitude
        out.most = out.nominal / abs(1 + 1j * end.excitation_frequency / end.bandwidth)
        out.shunt = end.omega * end.shunt
        out.load = out.shunt * end.parasitic
    else:
        raise ReadoutError(f'{law!r} is a law that chips know on device "cpu" only')
    return out


@wp.func
def _level(law: WarpLaw, capacitance: wp.float64):
    """Code before rounding."""
    one = wp.float64(1.0)
    zero = wp.float64(0.0)
    out = _FAR
    if law.kind == _LINEAR:
        out = capacitance * law.scale + law.zero
        share = wp.clamp((out - law.low) / (law.high - law.low), zero, one)
        out += law.curve * share * (one - share)
    elif law.kind == _RECIPROCAL:
        if capacitance > zero:
            out = law.scale / capacitance
    elif law.kind == _RESONANCE:
        if law.fixed + capacitance > zero:
            out = law.scale / wp.sqrt(law.fixed + capacitance)
    else:
        x = law.shunt * wp.abs(capacitance)
        across = one + (x + law.load) * (x + law.load)
        out = wp.sign(capacitance) * law.scale * law.most * x / wp.sqrt(across)
    return out


@wp.func
def _capacitance(law: WarpLaw, code: wp.float64):
    """Capacitance of a code [F]."""
    one = wp.float64(1.0)
    out = (code - law.zero) / law.scale
    if law.kind == _RECIPROCAL:
        out = law.scale / code
    elif law.kind == _RESONANCE:
        root = law.scale / code
        out = root * root - law.fixed
    elif law.kind == _SHUNT:
        out = wp.float64(0.0)
        if code != out:
            volts = wp.abs(code) / law.scale
            out = wp.sign(code) / (law.shunt * wp.abs(law.nominal / volts - one))
    return out


@wp.kernel
def channels(
    chip: ChipFigures, delta: wp.array4d(dtype=wp.float32), shields: wp.array3d(dtype=wp.float64),
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
def _at(chip: ChipFigures, first: int, count: int, time: wp.float64):
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
    chip: ChipFigures,
    state: State,
    k: int,
    c: int,
    time: wp.float64,
    given: wp.float64,
    seed: wp.uint32,
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
def _converted(chip: ChipFigures, state: State, k: int, c: int, value: wp.float64):
    """Code and capacitance of a value, as ``Conversion``."""
    used = int(0)
    inside = value
    codes = chip.codes
    if codes > 0:
        used = state.dac[k, c]
        if used < 0:
            used = wp.clamp(int(wp.rint(value / chip.step)), 0, codes - 1)
        wrong = wp.float64(0.0)
        for bit in range(state.bits.shape[0]):
            if ((used >> bit) & 1) == 1:
                wrong += state.bits[bit, k, c]
        inside = value - (wp.float64(used) * chip.step + wrong)
    level = wp.rint(_level(chip.law, inside))
    code = wp.clamp(level, chip.law.low, chip.law.high)
    reported = _capacitance(chip.law, code) + wp.float64(used) * chip.step
    if codes > 0:
        if chip.follow != 0 and level != code:
            up = (level > code) == (chip.law.rising != 0)
            used = wp.clamp(used + wp.where(up, chip.stride, -chip.stride), 0, codes - 1)
        state.dac[k, c] = used
    return wp.vec2d(code, reported)


@wp.kernel
def convert(
    chip: ChipFigures, state: State, code: wp.array3d(dtype=wp.int64),
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
