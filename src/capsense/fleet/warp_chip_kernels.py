"""Chips of one kind on Warp as kernels: a thread is one channel of one chip.

The twin is :class:`~capsense.readout.side_by_side.SideBySide`; converters have the laws of
:mod:`capsense.readout.laws`. All in double precision.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from capsense.errors import ReadoutError
from capsense.readout import streams
from capsense.readout.laws import LinearLaw, ReciprocalLaw, ResonanceLaw, ShuntLaw

wp.set_module_options({"enable_backward": False})

WHITE, POLES, MAINS, CLIMATE, LINEAR, CURVE = (wp.constant(k) for k in range(6))
_LINEAR, _RECIPROCAL, _RESONANCE, _SHUNT = (wp.constant(k) for k in range(4))
_FAR = wp.constant(wp.float64(1e300))  # stands for infinity
_GAMMA = wp.constant(wp.uint64(streams.GAMMA))
_COLUMNS = wp.constant(wp.int64(streams.COLUMNS))


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

    first: wp.array(dtype=wp.int32)  # first of a channel's charges, and their number, (K + 1,)
    sense: wp.array(dtype=wp.int32)  # electrode of a charge that is read, (t,)
    sign: wp.array(dtype=wp.float64)  # what it counts for
    volts: wp.array2d(dtype=wp.float64)  # of each electrode, (t, n)
    shield: wp.array(dtype=wp.float64)  # of the shields, (t,)
    empty: wp.array2d(dtype=wp.float64)  # Maxwell matrix of the empty domain [F], (n, n)
    mixing: wp.array2d(dtype=wp.float64)  # (K, K)
    offset: wp.array(dtype=wp.float64)  # [F], (K,)
    instant: wp.array(dtype=wp.float64)  # of a channel in a cycle, (K,)
    period: wp.float64
    lag: wp.float64
    slack: wp.float64
    law: WarpLaw
    codes: wp.int32  # of the offset DAC; 0: none
    begin: wp.array(dtype=wp.int32)  # its code at the start, -1 for none yet, -2 without it, (K,)
    step: wp.float64  # what its user takes for one step [F]
    follow: wp.int32
    stride: wp.int32
    stages: wp.array(dtype=wp.int32)  # kinds, in order
    figures: wp.array2d(dtype=wp.float64)  # of each stage, (stages, 10)
    keep: wp.array(dtype=wp.float64)  # what is kept of the states of poles, (p,)
    kick: wp.array(dtype=wp.float64)
    profile: wp.array2d(dtype=wp.float64)  # times and values of all profiles, (2, ...)
    table: wp.array3d(dtype=wp.float64)  # figures of channels, (rows, K, c)


@wp.struct
class State:
    """What changes, and what is drawn at a reset; c chips of e environments."""

    start: wp.array(dtype=wp.float64)  # [s], (e,)
    now: wp.array(dtype=wp.float64)  # since the start [s], (e,)
    before: wp.array(dtype=wp.float64)  # time of the last call [s], -1e300 before the first, (e,)
    raw: wp.array2d(dtype=wp.float64)  # channels before wiring [F], (K, c)
    last: wp.array2d(dtype=wp.float64)  # channels of the last call [F], (K, c)
    play: wp.array2d(dtype=wp.float64)  # channels with hysteresis [F], (K, c)
    taken: wp.array2d(dtype=wp.int32)  # samples that were taken, (K, c)
    told: wp.array2d(dtype=wp.int32)  # and that can be read
    keys: wp.array2d(dtype=wp.uint64)  # of random numbers, (K, c)
    dac: wp.array2d(dtype=wp.int32)  # -1 where it is not set, -2 where there is none
    bits: wp.array3d(dtype=wp.float64)  # what bits of the offset DAC have too much [F], (b, K, c)
    poles: wp.array3d(dtype=wp.float64)  # (p, K, c)
    waiting: wp.array3d(dtype=wp.vec2d)  # codes and capacitances that cannot be read yet, (d, K, c)
    connected: wp.array2d(dtype=wp.float64)  # 1 or 0, (n, c)
    gain: wp.array2d(dtype=wp.float64)  # figures that are drawn, (K, c)
    offset: wp.array2d(dtype=wp.float64)
    noise: wp.array2d(dtype=wp.float64)
    delay: wp.array2d(dtype=wp.float64)
    jitter: wp.array2d(dtype=wp.float64)
    hysteresis: wp.array2d(dtype=wp.float64)
    crosstalk: wp.array2d(dtype=wp.float64)
    stuck: wp.array2d(dtype=wp.float64)


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


@wp.func
def _mixed(word: wp.uint64):
    out = (word ^ (word >> wp.uint64(30))) * wp.uint64(0xBF58476D1CE4E5B9)
    out = (out ^ (out >> wp.uint64(27))) * wp.uint64(0x94D049BB133111EB)
    return out ^ (out >> wp.uint64(31))


@wp.func
def _drawn(key: wp.uint64, sample: int, stages: int, stage: int, column: int):
    """Random bits, as :class:`~capsense.readout.streams.Streams`; sample -1 is the start."""
    count = (wp.int64(sample) + wp.int64(1)) * wp.int64(stages + 1) + wp.int64(stage)
    count = count * _COLUMNS + wp.int64(column)
    return _mixed(key ^ _mixed((wp.uint64(count) + wp.uint64(1)) * _GAMMA))


@wp.func
def _uniform(word: wp.uint64):
    share = wp.float64(word >> wp.uint64(11)) + wp.float64(0.5)
    return share * wp.float64(1.1102230246251565e-16)


@wp.func
def _normal(key: wp.uint64, sample: int, stages: int, stage: int, column: int):
    """Of a pair of normal numbers from one word, after Box and Muller."""
    word = _drawn(key, sample, stages, stage, column // 2)
    half = wp.float64(2.3283064365386963e-10)
    size = (wp.float64(word >> wp.uint64(32)) + wp.float64(0.5)) * half
    turn = wp.float64(word & wp.uint64(0xFFFFFFFF)) + wp.float64(0.5)
    turn *= wp.float64(6.283185307179586) * half
    out = wp.sqrt(wp.float64(-2.0) * wp.log(size))
    if column % 2 == 0:
        return out * wp.cos(turn)
    return out * wp.sin(turn)


@wp.kernel
def tell(time: wp.array(dtype=Any), due: wp.array(dtype=wp.int32), state: State):
    """Tell each environment that is due its time [s]; one for all, or one for each."""
    e = wp.tid()
    if due[e] == 0:
        state.now[e] = state.before[e]
        return
    state.now[e] = wp.float64(time[e % time.shape[0]]) - state.start[e]


@wp.kernel
def channels(
    chip: ChipFigures, delta: wp.array4d(dtype=wp.float32), shields: wp.array3d(dtype=wp.float64),
    state: State,
):  # fmt: skip
    """Capacitances of all channels, as ``ChannelBank.values``."""
    k, c = wp.tid()
    e = c // delta.shape[1]
    s = c % delta.shape[1]
    out = wp.float64(0.0)
    for t in range(chip.first[k], chip.first[k + 1]):
        i = chip.sense[t]
        total = chip.shield[t] * shields[e, s, i]
        for j in range(delta.shape[3]):
            volts = chip.volts[t, j] * state.connected[j, c]
            total += volts * (chip.empty[i, j] + wp.float64(delta[e, s, i, j]))
        out += chip.sign[t] * state.connected[i, c] * total
    state.raw[k, c] = out


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
def _curve(chip: ChipFigures, first: int, count: int, k: int, c: int, value: wp.float64):
    """Value on a curve through points, straight between them and beyond."""
    out = value
    for p in range(count - 1):
        start = chip.table[first + p, k, c]
        if p == 0 or value >= start:
            low = chip.table[first + count + p, k, c]
            rise = chip.table[first + count + p + 1, k, c] - low
            slope = rise / (chip.table[first + p + 1, k, c] - start)
            out = low + (value - start) * slope
    return out


@wp.func
def _staged(
    chip: ChipFigures, state: State, k: int, c: int, sample: int, time: wp.float64,
    given: wp.float64,
):  # fmt: skip
    """Send a value through all stages."""
    value = given
    count = chip.stages.shape[0]
    for stage in range(count):
        kind = chip.stages[stage]
        a = chip.figures[stage, 0]
        b = chip.figures[stage, 1]
        if kind == WHITE:
            scale = a
            if b > wp.float64(0.0):
                scale = wp.sqrt(a * a + b * b * value * value)
            drawn = _normal(state.keys[k, c], sample, count, stage, 0)
            value += scale * (drawn * state.noise[k, c])
        elif kind == POLES:
            total = wp.float64(0.0)
            for p in range(int(b)):
                at = int(a) + p
                drawn = _normal(state.keys[k, c], sample, count, stage, p)
                kick = chip.kick[at] * (drawn * state.noise[k, c])
                state.poles[at, k, c] = chip.keep[at] * state.poles[at, k, c] + kick
                total += state.poles[at, k, c]
            value += total
        elif kind == MAINS:
            turn = _uniform(_drawn(state.keys[0, c], -1, count, stage, 0))
            value += a * wp.sin(b * time + wp.float64(6.283185307179586) * turn)
        elif kind == LINEAR:
            row = int(a)
            drift = chip.table[row + 2, k, c] * (time - b)
            value = value * chip.table[row, k, c] + chip.table[row + 1, k, c] + drift
        elif kind == CURVE:
            value = _curve(chip, int(a), int(b), k, c, value)
        else:
            warmer = _at(chip, int(chip.figures[stage, 4]), int(chip.figures[stage, 5]), time)
            damper = _at(chip, int(chip.figures[stage, 6]), int(chip.figures[stage, 7]), time)
            warmer -= chip.figures[stage, 8]
            damper -= chip.figures[stage, 9]
            gain = wp.float64(1.0) + b * warmer + chip.figures[stage, 3] * damper
            value = gain * value + a * warmer + chip.figures[stage, 2] * damper
    return value


@wp.func
def _converted(chip: ChipFigures, state: State, k: int, c: int, value: wp.float64):
    """Code and capacitance of a value, as ``Conversion``."""
    used = int(0)
    inside = value
    codes = chip.codes
    if chip.codes > 0 and state.dac[k, c] == -2:
        codes = 0
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


@wp.func
def _late(chip: ChipFigures, state: State, k: int, c: int, sample: int):
    """Time from a sample's instant until its result can be read [s]."""
    late = chip.lag + state.delay[k, c]
    if state.jitter[k, c] > wp.float64(0.0):
        count = chip.stages.shape[0]
        word = _drawn(state.keys[k, c], sample, count, count, 0)
        late += state.jitter[k, c] * _uniform(word)
    return late


@wp.kernel
def convert(
    chip: ChipFigures, state: State, code: wp.array3d(dtype=wp.int64),
    capacitance: wp.array3d(dtype=wp.float64), age: wp.array3d(dtype=wp.float64),
):  # fmt: skip
    """Take the samples whose instants have come, and tell those that can be read."""
    k, c = wp.tid()
    e = c // code.shape[1]
    s = c % code.shape[1]
    now = state.now[e]
    before = state.before[e]
    value = chip.offset[k]
    others = -state.raw[k, c]
    for other in range(state.raw.shape[0]):
        value += chip.mixing[k, other] * state.raw[other, c]
        others += state.raw[other, c]
    value += state.crosstalk[k, c] * others
    first = before < wp.float64(-1.0e299)
    old = wp.where(first, value, state.last[k, c])
    taken = state.taken[k, c]
    told = state.told[k, c]
    moment = wp.float64(taken) * chip.period + chip.instant[k]
    depth = state.waiting.shape[0]
    half = wp.float64(0.5) * state.hysteresis[k, c]
    while moment - chip.slack <= now:
        share = wp.float64(1.0)
        if not first and now > before:
            share = wp.min((moment - before) / (now - before), share)
        sample = old + share * (value - old)
        if taken > 0:
            sample = wp.min(wp.max(state.play[k, c], sample - half), sample + half)
        state.play[k, c] = sample
        sample = state.gain[k, c] * sample + state.offset[k, c]
        sample = _staged(chip, state, k, c, taken, state.start[e] + moment, sample)
        result = _converted(chip, state, k, c, sample)
        if taken > 0 and state.stuck[k, c] > wp.float64(0.0):
            result = state.waiting[(taken - 1) % depth, k, c]
        state.waiting[taken % depth, k, c] = result
        taken += 1
        moment = wp.float64(taken) * chip.period + chip.instant[k]
        if taken - told >= depth:
            told += 1  # a later one can be read by now
    stamp = wp.float64(told) * chip.period + chip.instant[k] + _late(chip, state, k, c, told)
    while told < taken and stamp - chip.slack <= now:
        told += 1
        stamp = wp.float64(told) * chip.period + chip.instant[k] + _late(chip, state, k, c, told)
    if told > 0:
        held = state.waiting[(told - 1) % depth, k, c]
        code[e, s, k] = wp.int64(held[0])
        capacitance[e, s, k] = held[1]
        stamp = wp.float64(told - 1) * chip.period + chip.instant[k]
        stamp += _late(chip, state, k, c, told - 1)
        age[e, s, k] = wp.max(now - stamp, wp.float64(0.0))
    state.last[k, c] = value
    state.taken[k, c] = taken
    state.told[k, c] = told


@wp.kernel
def restart(
    chip: ChipFigures, state: State, which: wp.array(dtype=wp.int32),
    code: wp.array3d(dtype=wp.int64), capacitance: wp.array3d(dtype=wp.float64),
    age: wp.array3d(dtype=wp.float64),
):  # fmt: skip
    """Switch on the chips of some environments; their figures are there already."""
    k, c = wp.tid()
    e = c // code.shape[1]
    s = c % code.shape[1]
    if which[e] == 0:
        return
    state.before[e] = -_FAR
    state.taken[k, c] = 0
    state.told[k, c] = 0
    state.dac[k, c] = chip.begin[k]
    code[e, s, k] = wp.int64(0)
    capacitance[e, s, k] = wp.float64(0.0)
    age[e, s, k] = wp.float64(wp.inf)
    count = chip.stages.shape[0]
    for stage in range(count):
        if chip.stages[stage] == POLES:
            for p in range(int(chip.figures[stage, 1])):
                drawn = _normal(state.keys[k, c], -1, count, stage, p) * state.noise[k, c]
                at = int(chip.figures[stage, 0]) + p
                state.poles[at, k, c] = chip.figures[stage, 2] * drawn


@wp.kernel
def pass_on(state: State):
    """Remember the time of this call."""
    e = wp.tid()
    state.before[e] = state.now[e]
