"""Chips of one kind on Warp, one for each sensor of a fleet, with noise and drift of their own.

The twin is :class:`~capsense.readout.side_by_side.SideBySide`: the same channels, schedule, stages
and converters in double precision, but other random numbers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from capsense.errors import ReadoutError
from capsense.fleet import warp_chip_kernels as kernels
from capsense.fleet.bodies import on_device
from capsense.readout import Readout
from capsense.readout.conversions import Held
from capsense.readout.noise import ClimateDrift, Context, Flicker, Mains, RandomWalk, White


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
        state, plan = kernels.State(), readout.schedule
        state.now, state.before = room(1), room(1)
        state.before.fill_(-1e300)
        state.raw, state.last = room(k, chips), room(k, chips)
        for name in ("taken", "told", "dac"):
            setattr(state, name, room(k, chips, dtype=wp.int32))
        states = np.random.SeedSequence(seed).generate_state(k * chips).reshape(k, chips)
        state.random = self._array(states, wp.uint32)
        dac = readout.dac
        state.dac.fill_(-1 if dac is None or dac.start == "auto" else dac.start)
        state.bits = room(0, k, chips)
        if dac is not None:
            errors = dac.specimens(k, seed, chips)
            state.bits = self._array(errors.reshape(chips, k, -1).transpose(2, 1, 0))
        state.waiting = room(math.ceil(plan.lag / plan.period) + 2, k, chips, dtype=wp.vec2d)
        self._set_stages(readout, k, chips, state)
        self._state = state
        age = room(*shape, k)
        age.fill_(math.inf)
        self._held = Held(room(*shape, k), room(*shape, k, dtype=wp.int64), age)

    def _array(self, values: Any, dtype: Any = wp.float64) -> Any:
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self._device)

    def _figures(self, readout: Readout, empty: Any) -> Any:
        bank, plan, dac, array = readout.bank, readout.schedule, readout.dac, self._array
        if bank._with_free:
            name = bank.names[bank._with_free[0].channel]
            raise ReadoutError(
                f"channel {name!r} leaves electrodes open, or its transmitter floats, which chips "
                'know on device "cpu" only; give it rest="grounded" or "guard", and none low'
            )
        if bank.differences.any() or len(bank._sense) > len(bank):
            name = bank.names[bank._channel[-1]]
            raise ReadoutError(
                f'channel {name!r} reads several electrodes, which chips know on device "cpu" only'
            )
        out = kernels.ChipFigures()
        out.sense, out.sign = array(bank._sense, wp.int32), array(bank._factor)
        out.volts, out.shield = array(bank._volts), array(bank._shield)
        out.base = array((empty[bank._sense] * bank._volts).sum(axis=1))
        mixing, offset = readout.wiring.start(np.array([p.sees_ground for p in bank.patterns]))
        out.mixing, out.offset = array(mixing), array(offset)
        instant = np.empty(len(bank))
        instant[plan.order] = plan.offsets
        out.instant, out.period = array(instant), plan.period
        out.lag, out.slack = plan.lag, plan.slack
        out.law = kernels.law_of(readout.law)
        if dac is not None:
            out.codes, out.step, out.follow = dac.codes, dac.step, int(dac.follow)
            out.stride = dac.stride(readout.law)
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
                kinds.append(kernels.WHITE)
                figures.append((stage.rms, stage.relative))
            elif isinstance(stage, Flicker | RandomWalk):
                walk = isinstance(stage, RandomWalk)
                _, *rest = process.args
                own_keep, own_kick = ([1.0], [rest[0]]) if walk else (rest[0], rest[1])
                kinds.append(kernels.POLES)
                figures.append((len(keep), len(own_keep)))
                keep.extend(own_keep)
                kick.extend(own_kick)
                poles.append(rest[-1].reshape(chips, k, -1).transpose(2, 1, 0))
            elif isinstance(stage, Mains):
                passed, phase = process.args
                kinds.append(kernels.MAINS)
                figures.append((passed, 2 * math.pi * stage.frequency, phase))
            elif isinstance(stage, ClimateDrift):
                first = sum(len(p.times) for p in profiles)
                warm, damp = stage.temperature, stage.humidity
                profiles += [warm, damp]
                kinds.append(kernels.CLIMATE)
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
            time: [s], not before the last call's; or an array on the device that holds it, of
                shape (1,) and double precision, which is not looked at.
            delta: Change of the Maxwell matrices [F], shape (e, s, n, n).
            shields: Charge on each electrode per volt on all shields together [F], (e, s, n).

        Returns:
            Arrays of shape (e, s, K), written anew by the next call.

        Raises:
            ReadoutError: Time is not finite, goes back, or leaps; or an array is another one.
        """
        if on_device(time):
            time = time if isinstance(time, wp.array) else wp.from_dlpack(time)
            if (time.dtype, time.shape) != (wp.float64, (1,)):
                raise ReadoutError(
                    f"time is {time.dtype.__name__} of shape {time.shape}; give float64 of (1,)"
                )
            wp.copy(self._state.now, time)
        else:
            self._readout.require_forward(time, self._last)
            self._last = float(time)
            self._state.now.fill_(self._last)
        held, dim = self._held, self._state.raw.shape
        for kernel, size, arguments in (
            (kernels.channels, dim, [self._chip, delta, shields, self._state]),
            (
                kernels.convert, dim,
                [self._chip, self._state, held.code, held.capacitance, held.age],
            ),
            (kernels.pass_on, 1, [self._state]),
        ):  # fmt: skip
            wp.launch(kernel, dim=size, inputs=arguments, device=self._device)
        return held
