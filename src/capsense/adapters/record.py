"""What sensors in many worlds read last, and before: arrays of Warp that stay in their place."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Any, no_type_check

import numpy as np
import warp as wp
from numpy.typing import NDArray

from capsense.reading import FleetReading, Reading


@dataclass(frozen=True, eq=False)
class ParallelData:
    """What the sensors of one design read last; w worlds, s sensors, n electrodes, k channels.

    Arrays of Warp on the simulator's device, or tensors of PyTorch, see :meth:`torch`. They are
    written anew by the next reading, each world's when it is due. After a reset they hold what a
    sensor reads in an empty environment, at 0 s, and no codes.
    """

    time: Any
    """Time of each world's reading [s], NaN where none was given, in double precision, (w,)."""
    capacitance: Any
    """Maxwell capacitance matrices [F], shape (w, s, n, n)."""
    delta: Any
    """Their change by the bodies [F], shape (w, s, n, n)."""
    error: Any
    """Estimated error of the largest entry [F], shape (w, s)."""
    conductance: Any
    """Conductance that matter with losses adds [S], shape (w, s, n, n)."""
    force: Any = None
    """Force that the cover carries above each electrode [N], shape (w, s, n); None where the design
    has no cover, as the next two."""
    compression: Any = None
    """Largest compression of the cover above each electrode [m], shape (w, s, n)."""
    total: Any = None
    """Force that the whole cover carries [N], shape (w, s)."""
    codes: Any = None
    """What the chips' registers hold, whole numbers of 64 bits, shape (w, s, k); None where there
    is no readout, as the next two."""
    measured: Any = None
    """What a user makes of the codes [F], shape (w, s, k)."""
    ages: Any = None
    """Time since the results could be read [s], infinite where there is none, (w, s, k)."""
    history: ParallelData | None = None
    """The last readings, the newest first, with an axis of ``history_length`` after that of the
    worlds; None where none is kept. As arrays of Warp have no more than four axes, the matrices
    there are of shape (w, ``history_length``, s, n·n)."""

    def torch(self) -> ParallelData:
        """The same as tensors of PyTorch, which share the memory."""
        out = {name: wp.to_torch(values) for name, values in self.arrays()}
        history = None
        if self.history is not None:
            old = self.history.torch()
            history = replace(old, **{
                name: values.reshape(*values.shape[:2], *out[name].shape[1:])
                for name, values in old.arrays()
            })  # fmt: skip
        return replace(self, **out, history=history)

    def arrays(self) -> Iterator[tuple[str, Any]]:
        """Names and arrays of what there is, without the history."""
        for each in fields(self):
            values = getattr(self, each.name)
            if values is not None and each.name != "history":
                yield each.name, values


class Record:
    """Keeps the readings of a fleet.

    Args:
        empty: What a sensor reads in an empty environment.
        shape: How many worlds, and sensors in each.
        channels: How many channels the chips have; 0 where there are none.
        covered: Whether the design has a cover.
        length: How many readings of each world are kept beside the last; 0 for no history.
        device: Warp's device of the simulator's arrays.
    """

    def __init__(
        self, empty: Reading, shape: tuple[int, int], channels: int, covered: bool, length: int,
        device: Any,
    ) -> None:  # fmt: skip
        worlds, sensors = shape
        n = len(empty.delta)
        zero = np.zeros((n, n))
        one: dict[str, tuple[NDArray[Any], type]] = {
            "time": (np.zeros(()), wp.float64),
            "capacitance": (empty.capacitance, wp.float32), "delta": (zero, wp.float32),
            "error": (np.zeros(()), wp.float32), "conductance": (zero, wp.float32),
        }  # fmt: skip
        if covered:
            one |= {"force": (np.zeros(n), wp.float32), "compression": (np.zeros(n), wp.float32)}
            one["total"] = np.zeros(()), wp.float32
        if channels:
            one["codes"] = np.zeros(channels, np.int64), wp.int64
            one["measured"] = np.zeros(channels), wp.float32
            one["ages"] = np.full(channels, np.inf), wp.float32
        self._device, self._worlds = device, worlds
        now: dict[str, Any] = {}
        before: dict[str, Any] = {}
        self._rows: dict[str, tuple[Any, Any, Any]] = {}
        for name, (value, kind) in one.items():
            each = value.shape if name == "time" else (sensors, *value.shape)
            blank = np.broadcast_to(value, each)
            now[name] = wp.array(np.broadcast_to(blank, (worlds, *each)), dtype=kind, device=device)
            size = int(np.prod(each, dtype=int))
            kept = wp.zeros((worlds, length, size), dtype=kind, device=device)
            self._rows[name] = (
                wp.array(blank.reshape(1, size), dtype=kind, device=device),
                now[name].reshape((worlds, size)), kept,
            )  # fmt: skip
            if length:
                own = each if len(each) < 3 else (sensors, n * n)
                before[name] = kept.reshape((worlds, length, *own))
        self._all = wp.ones(worlds, dtype=wp.bool, device=device)
        self.data = ParallelData(**now, history=ParallelData(**before) if length else None)
        """The last readings."""
        self.clear(None)

    def clear(self, mask: Any) -> None:
        """Set some worlds back, named by a mask on the device, or all."""
        for blank, now, kept in self._rows.values():
            self._launch(_clear, now, self._all if mask is None else mask, blank, now, kept)

    def take(self, reading: FleetReading, time: Any, mask: Any) -> None:
        """Take over a reading.

        Args:
            reading: Of all worlds.
            time: Times [s] of all worlds, NaN for none, an array of Warp or NumPy, shape (w,).
            mask: Which worlds are taken over, on the device; None for all.
        """
        touch, held = reading.touch, reading.held
        given = {
            "time": time, "capacitance": reading.capacitance, "delta": reading.delta,
            "error": reading.error, "conductance": reading.conductance,
        }  # fmt: skip
        if touch is not None:
            given |= {
                "force": touch.force, "compression": touch.compression, "total": touch.total,
            }  # fmt: skip
        if held is not None:
            given |= {"codes": held.code, "measured": held.capacitance, "ages": held.age}
        for name, (_, now, kept) in self._rows.items():
            values = given[name]
            if values is None:  # no matter with losses: as in an empty environment
                values = np.zeros(now.shape)
            if isinstance(values, np.ndarray):
                values = wp.array(
                    np.ascontiguousarray(values.reshape(now.shape), wp.dtype_to_numpy(now.dtype)),
                    device=self._device,
                )
            else:
                values = values.reshape(now.shape)
            self._launch(_take, now, self._all if mask is None else mask, values, now, kept)

    def _launch(self, kernel: Any, over: Any, *inputs: Any) -> None:
        wp.launch(kernel, dim=over.shape, inputs=list(inputs), device=self._device)


@no_type_check
@wp.kernel(enable_backward=False)
def _take(
    mask: wp.array(dtype=wp.bool), values: wp.array2d(dtype=Any), now: wp.array2d(dtype=Any),
    kept: wp.array3d(dtype=Any),
) -> None:  # fmt: skip
    """Enter the numbers of some worlds."""
    w, k = wp.tid()
    if not mask[w]:
        return
    value = now.dtype(values[w, k])
    now[w, k] = value
    length = kept.shape[1]
    for j in range(1, length):
        kept[w, length - j, k] = kept[w, length - j - 1, k]
    if length > 0:
        kept[w, 0, k] = value


@no_type_check
@wp.kernel(enable_backward=False)
def _clear(
    mask: wp.array(dtype=wp.bool), blank: wp.array2d(dtype=Any), now: wp.array2d(dtype=Any),
    kept: wp.array3d(dtype=Any),
) -> None:  # fmt: skip
    """Set the numbers of some worlds back."""
    w, k = wp.tid()
    if not mask[w]:
        return
    now[w, k] = blank[0, k]
    for j in range(kept.shape[1]):
        kept[w, j, k] = blank[0, k]
