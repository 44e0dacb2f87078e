"""Chips of one kind on Warp, one for each sensor of a fleet.

The twin is :class:`~capsense.readout.side_by_side.SideBySide`: the same channels, clocks, stages,
converters, figures and random numbers, in double precision.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from capsense.errors import ReadoutError
from capsense.fleet import warp_chip_kernels as kernels
from capsense.fleet.bodies import on_device
from capsense.fleet.warp_cut import mark
from capsense.readout import Readout
from capsense.readout.calibration import LinearSensor, ResponseCurve
from capsense.readout.checks import Array, Ints
from capsense.readout.conversions import Held
from capsense.readout.noise import (
    ClimateDrift,
    Context,
    Flicker,
    Mains,
    Poles,
    RandomWalk,
    White,
)
from capsense.readout.randomisation import FIGURES
from capsense.readout.side_by_side import ManyChips

_WORDS = {"keys": wp.uint64}


def registers(device: Any, *shape: int) -> Held:
    """Room for what chips hold, of that shape."""
    room = (wp.zeros(shape, dtype=d, device=device) for d in (wp.float64, wp.int64, wp.float64))
    return Held(*room)


class WarpChips(ManyChips):
    """Chips on a device.

    Args:
        readout: A readout of one sensor; it stays as it is.
        environments: How many.
        sensors: How many each has.
        empty: Maxwell matrix of the electrodes in the empty domain [F], shape (n, n).
        device: Warp's device.
        held: Where registers are written, shape (e, s, K); by default in memory of their own.
        **how: As of :class:`ManyChips`.

    Raises:
        ReadoutError: The readout has parts that are not known on Warp, or as of :class:`ManyChips`.
    """

    def __init__(
        self, readout: Readout, environments: int, sensors: int, empty: Array, device: Any,
        held: Held | None = None, **how: Any,
    ) -> None:  # fmt: skip
        self._device = device
        super().__init__(readout, environments, sensors, **how)
        (e, s, k), chips = self.shape, environments * sensors
        self._chip = self._describe(readout, empty)
        state = kernels.State()
        for name in ("start", "now", "before"):
            setattr(state, name, self._room(e))
        for name in ("raw", "last", "play"):
            setattr(state, name, self._room(k, chips))
        for name in ("taken", "told", "dac"):
            setattr(state, name, self._room(k, chips, dtype=wp.int32))
        state.waiting = self._room(self._depth, k, chips, dtype=wp.vec2d)
        state.poles = self._room(len(self._chip.keep), k, chips)
        self._state, self._time = state, self._room(e)
        self._which, self._due = (self._room(e, dtype=wp.int32) for _ in range(2))
        self._held = held or registers(device, e, s, k)
        for name, values in self._lanes().items():
            setattr(state, name, self._array(values, _WORDS.get(name, wp.float64)))
        self._ready = True
        self._restart(np.arange(e))

    def _room(self, *size: int, dtype: Any = wp.float64) -> Any:
        return wp.zeros(size, dtype=dtype, device=self._device)

    def _array(self, values: Any, dtype: Any = wp.float64) -> Any:
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self._device)

    def _lanes(self) -> dict[str, Any]:
        """What is drawn at a reset, by the names of the kernels' arrays, shape (..., chips)."""
        chips = self.shape[0] * self.shape[1]
        given: dict[str, Any] = {name: self._figures[name] for name in FIGURES if name != "dead"}
        given |= {"keys": self._keys, "connected": ~self._figures["dead"]}
        out = {name: values.reshape(chips, -1).T for name, values in given.items()}
        errors = self._errors.reshape(chips, self.shape[2], -1)
        return {**out, "bits": errors.transpose(2, 1, 0)}

    def _begin(self, rows: Ints, start: ArrayLike, seed: int | None) -> None:
        super()._begin(rows, start, seed)
        if hasattr(self, "_ready"):
            for name, values in self._lanes().items():
                if values.size:
                    getattr(self._state, name).assign(np.ascontiguousarray(values))
            self._restart(rows)

    def _restart(self, rows: Ints) -> None:
        which = np.zeros(self.shape[0], np.int32)
        which[rows] = 1
        self._which.assign(which)
        self._state.start.assign(self._start)
        held = self._held
        arguments = [
            self._chip, self._state, self._which, held.code, held.capacitance, held.age
        ]  # fmt: skip
        self._launch(kernels.restart, self._state.raw.shape, arguments)

    def _launch(self, kernel: Any, dim: Any, arguments: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=arguments, device=self._device)

    def _describe(self, readout: Readout, empty: Array) -> Any:
        """The figures of all chips, as the kernels take them."""
        bank, plan, dac, array = readout.bank, readout.schedule, readout.dac, self._array
        if bank._with_free:
            name = bank.names[bank._with_free[0].channel]
            raise ReadoutError(
                f"channel {name!r} leaves electrodes open, or its transmitter floats, which chips "
                'know on device "cpu" only; give it rest="grounded" or "guard", and none low'
            )
        out = kernels.ChipFigures()
        order = np.argsort(bank._channel, kind="stable")
        first = np.searchsorted(bank._channel[order], np.arange(len(bank) + 1))
        out.first, out.sense = array(first, wp.int32), array(bank._sense[order], wp.int32)
        out.sign, out.volts = array(bank._factor[order]), array(bank._volts[order])
        out.shield, out.empty = array(bank._shield[order]), array(empty)
        mixing, offset = readout.wiring.start(np.array([p.sees_ground for p in bank.patterns]))
        out.mixing, out.offset = array(mixing), array(offset)
        out.instant, out.period = array(self._instant), plan.period
        out.lag, out.slack = plan.lag, plan.slack
        out.law = kernels.law_of(readout.law)
        begin = np.full(len(bank), -1)
        if dac is not None:
            out.codes, out.step, out.follow = dac.codes, dac.step, int(dac.follow)
            out.stride = dac.stride(readout.law)
            begin[:] = -1 if dac.start == "auto" else dac.start
            if not dac.differential:
                begin[bank.differences] = -2
        out.begin = array(begin, wp.int32)
        self._set_stages(readout, out)
        return out

    def _set_stages(self, readout: Readout, chip: Any) -> None:
        """Set the stages of the chips."""
        plan, (e, s, k) = readout.schedule, self.shape
        context = Context(e * s * k, plan.conversion, plan.period, np.random.default_rng(0), (e, s))
        kinds: list[int] = []
        figures: list[Sequence[float]] = []
        poles: list[Poles] = []
        profiles: list[Any] = []
        tables: list[Array] = []
        for stage in readout.stages:
            rows = sum(len(table) for table in tables)
            if isinstance(stage, White):
                kinds.append(kernels.WHITE)
                figures.append((stage.rms, stage.relative))
            elif isinstance(stage, Flicker | RandomWalk):
                process = cast("Poles", stage.start(context))
                first = sum(len(p.keep) for p in poles)
                poles.append(process)
                kinds.append(kernels.POLES)
                figures.append((first, len(process.keep), process.spread))
            elif isinstance(stage, Mains):
                kinds.append(kernels.MAINS)
                figures.append((stage.passed(plan.conversion), 2 * math.pi * stage.frequency))
            elif isinstance(stage, LinearSensor):
                kinds.append(kernels.LINEAR)
                figures.append((rows, stage.epoch))
                tables.append(np.array(stage.figures(context)))
            elif isinstance(stage, ResponseCurve):
                true, measured = stage.points(context)
                kinds.append(kernels.CURVE)
                figures.append((rows, len(true.T)))
                tables.append(np.concatenate([true.T, measured.T]))
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
        array = self._array
        chip.stages = array(kinds, wp.int32)
        chip.figures = array([[*f, *[0.0] * (10 - len(f))] for f in figures] or np.zeros((0, 10)))
        chip.keep = array(np.concatenate([p.keep for p in poles]) if poles else [])
        chip.kick = array(np.concatenate([p.kick for p in poles]) if poles else [])
        points = [(p.times, p.values) for p in profiles]
        chip.profile = array(np.concatenate(points, axis=1) if points else np.zeros((2, 0)))
        table = np.concatenate(tables) if tables else np.zeros((0, e * s * k))
        chip.table = array(table.reshape(len(table), e * s, k).transpose(0, 2, 1))

    def clock(self, time: Any, due: Any = None) -> Any:
        """As of :class:`ManyChips`; an array on the device is not looked at.

        Nor does a mask on the device tell which of the host's times are looked at.
        """
        if not on_device(time) and on_device(due):
            times = np.broadcast_to(np.asarray(time, float), self.shape[:1])
            return self._array(times)
        if not on_device(time):
            return super().clock(time, due)
        time = time if isinstance(time, wp.array) else wp.from_dlpack(time)
        fits = time.dtype in (wp.float32, wp.float64) and time.shape in ((1,), (self.shape[0],))
        if not fits:
            raise ReadoutError(
                f"time is {time.dtype.__name__} of shape {time.shape}; give float64 or float32, "
                f"of (1,) or ({self.shape[0]},)"
            )
        return time

    def sample(self, time: Any, delta: Any, shields: Any, due: Any = None) -> Held:
        """Tell what the sensors see at a time; get what the chips' registers hold.

        Args:
            time: [s], a number or one for each environment, not before that of the last call; or an
                array on the device that holds it, of shape (1,) or (e,), which is not looked at.
            delta: Change of the Maxwell matrices [F], shape (e, s, n, n).
            shields: Charge on each electrode per volt on all shields together [F], (e, s, n).
            due: Mask of the environments whose clocks go on, of NumPy or of Warp; None for all.

        Returns:
            Arrays of shape (e, s, K), written anew by the next call.

        Raises:
            ReadoutError: Time is not finite or goes back, or an array is another one.
        """
        time = self.clock(time, due)
        if isinstance(time, np.ndarray):
            self._last[:] = time
            if (time == time[0]).all():
                self._time.fill_(float(time[0]))
            else:
                self._time.assign(time)
            time = self._time
        if due is None:
            self._due.fill_(1)
        elif isinstance(due, np.ndarray):
            self._due.assign(due.astype(np.int32))
        else:
            self._launch(mark, self.shape[0], [due, self._due])
        held, dim, state = self._held, self._state.raw.shape, self._state
        registers = [held.code, held.capacitance, held.age]
        self._launch(kernels.tell, self.shape[0], [time, self._due, state])
        self._launch(kernels.channels, dim, [self._chip, delta, shields, state])
        self._launch(kernels.convert, dim, [self._chip, state, *registers])
        self._launch(kernels.pass_on, self.shape[0], [state])
        return held
