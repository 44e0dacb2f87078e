"""Calibration: making raw values comparable, and fitting the model to a sensor of one's own."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from capsense.errors import ReadoutError
from capsense.readout.checks import Array, Bools, Ints, finite, real, require
from capsense.readout.noise import Context, Flicker, Process

_ALIKE, _FINE, _APART = 4, 30.0, 4.0
"""So many samples at one end of what was measured were out of range, if the fit has them this many
steps of the converter apart, and of the noise where that is less than so many times the steps."""
_SIGNIFICANT = 3.0
"""Gains of fewer standard errors are none."""
_EXCESS = 2.0
"""Residuals that are so many times what noise explains are in doubt; of few samples, more."""
_OF_NORMAL = 1.4826**2
"""Variance of normal noise over the square of its median absolute deviation."""
_SMALL = 1e-3
"""Not where they are less than this part of what the channel changed by."""


def base_capacitance(values: ArrayLike) -> Array:
    """Mean of readings of the empty scene: the base capacitance of offset calibration.

    Args:
        values: Readings [F or codes], shape (n, ...).

    Raises:
        ReadoutError: There are no readings, or one is not finite.
    """
    array = finite("readings", values)
    if not array.size or array.ndim < 1:
        raise ReadoutError("base capacitance needs readings, at least one; give some")
    return array.mean(axis=0)


def tare(values: ArrayLike, base: ArrayLike) -> Array:
    """Readings less the base: what remains is what the scene changed.

    Args:
        values: Readings [F or codes], shape (n, ...).
        base: Of each channel, shape (...).

    Raises:
        ReadoutError: The shapes do not fit, or a number is not finite.
    """
    readings, level = _against(values, base)
    return readings - level


def relative_to(values: ArrayLike, base: ArrayLike) -> Array:
    """Readings as multiples of the base, as Schöffmann et al. 2022 plot them.

    Args:
        values: Readings [F or codes], shape (n, ...).
        base: Of each channel, shape (...).

    Raises:
        ReadoutError: A base is zero, the shapes do not fit, or a number is not finite.
    """
    readings, level = _against(values, base)
    if (level == 0).any():
        raise ReadoutError("a base is 0, to which nothing is relative; use tare() instead")
    return readings / level


def _against(values: ArrayLike, base: ArrayLike) -> tuple[Array, Array]:
    readings, level = finite("readings", values), finite("base", base)
    if level.ndim and readings.shape[readings.ndim - level.ndim :] != level.shape:
        raise ReadoutError(
            f"readings have shape {readings.shape}, the base {level.shape}; give one base a channel"
        )
    return readings, level


def unit_range(values: ArrayLike) -> Array:
    """Each channel stretched to run from 0 to 1 over a recording, shape (n, ...).

    Raises:
        ReadoutError: A channel is constant, or a number is not finite.
    """
    array = finite("readings", values)
    if not array.size:
        raise ReadoutError("there are no readings to stretch; give some")
    low, span = array.min(axis=0), np.ptp(array, axis=0)
    if (span == 0).any():
        raise ReadoutError("a channel is constant and has no range; leave it out")
    return (array - low) / span


def cross_correlation(one: ArrayLike, other: ArrayLike) -> float:
    """Normalised cross-correlation at lag zero of two signals, from −1 to 1.

    ``Σ (a − ā)(b − b̄) / √(Σ (a − ā)² Σ (b − b̄)²)``

    Raises:
        ReadoutError: The signals differ in length, one is constant, or a number is not finite.
    """
    a, b = finite("signal", one), finite("signal", other)
    if a.shape != b.shape:
        raise ReadoutError(f"signals have shapes {a.shape} and {b.shape}; make them the same")
    a, b = a - a.mean(), b - b.mean()
    size = math.sqrt(float((a * a).sum() * (b * b).sum()))
    if size == 0:
        raise ReadoutError("a signal is constant and correlates with nothing; leave it out")
    return float((a * b).sum()) / size


@dataclass(frozen=True, eq=False)
class LinearSensor:
    """How a sensor measures: ``measured = gain · true + offset + drift · (t − epoch)``.

    As a stage of a readout it makes the simulated sensor measure like the real one.

    Raises:
        ReadoutError: A figure is not finite, or a gain is zero.
    """

    gain: Array
    """Shape (K,), or a number for all channels, as the others; in a fleet also (sensors, K) or
    (environments, sensors, K)."""
    offset: Array
    """At the epoch [F]."""
    drift: Array
    """[F/s]"""
    epoch: float
    """Time that drift is counted from [s]."""

    def __post_init__(self) -> None:
        for name in ("gain", "offset", "drift"):
            figures = finite(f"calibration: {name}", getattr(self, name))
            object.__setattr__(self, name, figures)
        if (self.gain == 0).any():
            raise ReadoutError("calibration: a gain is 0; leave that channel out")
        require("calibration", "epoch", self.epoch, -math.inf, "s")

    def correct(self, measured: ArrayLike, time: ArrayLike | None = None) -> Array:
        """True capacitances [F] from measured ones, shape (n, K).

        ``time`` [s] is of shape (n,), or (n, K) where channels have instants of their own.
        """
        return (np.asarray(measured, dtype=float) - self._shift(time)) / self.gain

    def distort(self, true: ArrayLike, time: ArrayLike | None = None) -> Array:
        """Measured capacitances [F] from true ones, shape (n, K); ``time`` as of `correct`."""
        return np.asarray(true, dtype=float) * self.gain + self._shift(time)

    def toml(self) -> str:
        """The figures as the table ``[calibration]`` of a readout file."""
        lines = [f"{key} = {getattr(self, key).tolist()}" for key in ("gain", "offset", "drift")]
        return "\n".join(["[calibration]", *lines, f"epoch = {float(self.epoch)!r}", ""])

    def _shift(self, time: ArrayLike | None) -> Array:
        if time is None:
            return self.offset
        at = finite("time", time)
        at = at[..., None] if at.ndim < 2 else at
        return self.offset + self.drift * (at - self.epoch)

    def start(self, context: Context) -> Process:
        """The process of a readout's stage.

        Raises:
            ReadoutError: There are figures for another number of channels.
        """
        return partial(self._apply, *self.figures(context))

    def figures(self, context: Context) -> tuple[Array, Array, Array]:
        """Gain, offset and drift of all channels, each of shape (channels,).

        Raises:
            ReadoutError: There are figures for another number of channels.
        """
        names = ("gain", "offset", "drift")
        found = (context.figures("calibration", name, getattr(self, name)) for name in names)
        return tuple(found)  # type: ignore[return-value]

    def _apply(
        self, gain: Array, offset: Array, drift: Array, channel: Ints, time: Array, value: Array
    ) -> Array:
        return value * gain[channel] + offset[channel] + drift[channel] * (time - self.epoch)


@dataclass(frozen=True, eq=False)
class ResponseCurve:
    """How a sensor that is not linear measures: a curve through points, straight between them.

    Beyond the points, the first and the last piece go on. As a stage of a readout it makes the
    simulated sensor measure like the real one.

    Raises:
        ReadoutError: Points are not finite or fewer than two, true values do not rise, or the
            arrays do not fit each other.
    """

    true: Array
    """True capacitances of the points, rising [F], shape (P,), or (K, P) for each channel; in a
    fleet also (sensors, K, P) or (environments, sensors, K, P)."""
    measured: Array
    """What is measured there [F], of a shape that fits."""

    def __post_init__(self) -> None:
        for name in ("true", "measured"):
            object.__setattr__(self, name, finite(f"curve: {name}", getattr(self, name)))
        shapes = self.true.shape, self.measured.shape
        if not all(shapes) or shapes[0][-1] != shapes[1][-1] or shapes[0][-1] < 2:
            raise ReadoutError(
                f"curve: true has shape {shapes[0]}, measured {shapes[1]}; give at least two "
                "points, as many in both"
            )
        if (np.diff(self.true) <= 0).any():
            raise ReadoutError("curve: true values do not rise; sort the points")

    def start(self, context: Context) -> Process:
        """The process of a readout's stage.

        Raises:
            ReadoutError: There are curves for another number of channels.
        """
        return partial(_follow, *self.points(context))

    def toml(self) -> str:
        """The points as the table ``[curve]`` of a readout file."""
        lines = [f"{key} = {getattr(self, key).tolist()}" for key in ("true", "measured")]
        return "\n".join(["[curve]", *lines, ""])

    def points(self, context: Context) -> tuple[Array, Array]:
        """The points of all channels, true and measured [F], each of shape (channels, P).

        Raises:
            ReadoutError: There are curves for another number of channels.
        """
        out = []
        for name in ("true", "measured"):
            columns = np.moveaxis(getattr(self, name), -1, 0)
            found = [context.figures("curve", name, column) for column in columns]
            out.append(np.stack(found, axis=1))
        return out[0], out[1]


def _follow(true: Array, measured: Array, channel: Ints, time: Array, value: Array) -> Array:
    """Values on the curves of channels."""
    x, y = true[channel], measured[channel]
    piece = np.sum(value[:, None] >= x[:, 1:-1], axis=1)
    rows = np.arange(len(value))
    start, low = x[rows, piece], y[rows, piece]
    slope = (y[rows, piece + 1] - low) / (x[rows, piece + 1] - start)
    return low + (value - start) * slope


@dataclass(frozen=True, eq=False)
class Calibration(LinearSensor):
    """A sensor's figures as a recording shows them, with their uncertainties."""

    covariance: Array
    """Of (gain, offset, drift) of each channel, shape (K, 3, 3); zero where drift is not fitted."""
    residuals: Array
    """Measured values less the fit [F], NaN for samples that were left out, shape (n, K)."""
    residual: Array
    """Standard deviation about the fit [F], shape (K,)."""
    samples: Ints
    """Number of samples fitted, shape (K,)."""
    excess: Array
    """``residual`` over what the noise of most samples, or between neighbours, and the floor
    explain, shape (K,): about 1 where the model holds."""
    doubtful: Bools
    """Whether it is so large, or the sensor so often at an end of its range, that a channel's
    figures are not to be believed, shape (K,)."""

    @property
    def uncertainty(self) -> Array:
        """Standard uncertainties of (gain, offset, drift), shape (K, 3)."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))


class CalibrationWarning(UserWarning):
    """A sensor does not measure as the fit says."""


def calibrate(
    true: ArrayLike, measured: ArrayLike, time: ArrayLike | None = None, *,
    flags: ArrayLike | None = None, drift: bool = True, floor: float = 0.0,
) -> Calibration:  # fmt: skip
    """Fit gain, offset and drift of each channel to a recording with known poses.

    Ordinary least squares. Without a ``floor``, uncertainties follow from the residuals,
    ``s² (XᵀX)⁻¹``, and hold for noise that is white from sample to sample. A sensor's noise seldom
    is: with flicker they come out several times too small, that of the drift most. With the floor
    of the sensor's Allan plot, taken at rest, uncertainties hold for white noise and flicker
    together, ``A (s² + Σ) Aᵀ`` with A = (XᵀX)⁻¹Xᵀ, Σ being the covariance of
    :class:`~capsense.readout.noise.Flicker` at the samples' times.

    Where residuals are much larger than neighbouring samples differ, in time or in the order of
    their true values, or than most of them are, the sensor is not linear, or was out of its range,
    or somewhere else: the channel is ``doubtful``, and a :class:`CalibrationWarning` says so. So it
    is where several samples share the largest or smallest value though the fit has them apart, and
    where the gain is less than three of its standard errors: what was measured does not follow what
    is true, as where samples are out of order.

    Args:
        true: Capacitances that the simulator gives at the poses and times of the recording [F],
            shape (n, K).
        measured: What the sensor reported [F], shape (n, K).
        time: Times of the samples [s], shape (n,), or (n, K) where channels have instants of their
            own; needed for drift.
        flags: Samples to leave out, such as ``counts.table("flags")[1]``, which tells those that
            were out of the converter's range: any number but 0, shape (n, K). Values there may be
            NaN.
        drift: Whether to fit a drift that is linear in time.
        floor: Allan deviation of the flicker floor [F]; needs times that rise.

    Raises:
        ReadoutError: Shapes do not fit, numbers are not finite, samples are too few, or the
            recording does not tell the figures apart (a channel that never changes).
    """
    c, m = real("true", true), real("measured", measured)
    if c.ndim != 2 or c.shape != m.shape or not c.shape[1]:
        raise ReadoutError(f"true has shape {c.shape}, measured {m.shape}; give both as (n, K)")
    n, k = c.shape
    require("calibrate", "floor", floor, 0.0, "F")
    t = _times(time, n, k, drift or floor > 0)
    if floor > 0 and (np.diff(t, axis=0) <= 0).any():
        raise ReadoutError("with a floor, times must rise; sort the samples")
    unknowns, kept = 3 if drift else 2, _kept(flags, c)
    for what, values in (("true", c), ("measured", m)):
        finite(what, values[kept])
    epoch = float(t.mean())
    figures, covariance = np.zeros((k, 3)), np.zeros((k, 3, 3))
    residuals, excess = np.full((n, k), np.nan), np.zeros(k)
    clipped = np.zeros(k, np.bool_)
    for channel in range(k):
        used = kept[:, channel]
        at, x, y = (values[used, channel] for values in (t, c, m))
        if len(at) <= unknowns:
            raise ReadoutError(
                f"channel {channel}: {len(at)} samples for {unknowns} unknowns; record more"
            )
        columns = np.stack([x, np.ones(len(at)), at - epoch][:unknowns], axis=1)
        fit = least_squares(columns, y, channel, at, floor)
        figures[channel, :unknowns], covariance[channel, :unknowns, :unknowns] = fit[:2]
        residuals[used, channel] = rest = y - columns @ fit[0]
        noise = _white(rest, x, at)
        excess[channel] = _excess(rest, noise, fit[2])
        clipped[channel] = _clipped(y, y - rest, noise)
    samples = kept.sum(axis=0)
    residual = np.sqrt(np.nansum(residuals**2, axis=0) / (samples - unknowns))
    doubtful = (excess > _EXCESS * (1 + 8 / np.sqrt(samples))) & (
        residual > _SMALL * np.nanstd(np.where(kept, m, np.nan), axis=0)
    )
    blind = figures[:, 0] ** 2 < _SIGNIFICANT**2 * covariance[:, 0, 0]
    doubtful |= clipped | blind
    _warn(excess, doubtful, clipped, blind)
    return Calibration(
        figures[:, 0], figures[:, 1], figures[:, 2], epoch, covariance, residuals, residual,
        samples, excess, doubtful,
    )  # fmt: skip


def _kept(flags: ArrayLike | None, values: Array) -> Bools:
    """Samples that are not flagged, shape (n, K)."""
    if flags is None:
        return np.ones(values.shape, np.bool_)
    given = np.asarray(flags)
    if given.shape != values.shape:
        raise ReadoutError(
            f"flags have shape {given.shape}, measured {values.shape}; make them one"
        )
    return given == 0


def _white(residuals: Array, true: Array, time: Array) -> float:
    """Variance of the noise of a channel [F²], as most of its samples, shape (n,), show it."""
    orders = np.lexsort((true, time)), np.lexsort((time, true))
    white = [0.5 * float((np.diff(residuals[order]) ** 2).mean()) for order in orders]
    white.append(_OF_NORMAL * float(np.median(np.abs(residuals - np.median(residuals)))) ** 2)
    return min(white)


def _excess(residuals: Array, white: float, slow: float) -> float:
    """Residuals over what noise explains: see :attr:`Calibration.excess`.

    Args:
        residuals: Of a channel, shape (n,).
        white: Variance of its noise [F²].
        slow: Sum of the residuals' squares that the floor explains [F²].
    """
    explained = white * len(residuals) + slow
    return math.sqrt(float(residuals @ residuals) / explained) if explained > 0 else 0.0


def _clipped(measured: Array, fitted: Array, white: float) -> bool:
    """Whether a channel met an end of its range: samples (n,), and the variance of its noise."""
    levels = np.unique(measured)
    if len(levels) < _ALIKE:
        return False
    grain, noise = float(np.diff(levels).min()), math.sqrt(white)
    least = _APART * (grain if _FINE * grain < noise else grain + noise)
    ends = (fitted[measured == level] for level in (levels[0], levels[-1]))
    return any(len(end) >= _ALIKE and np.ptp(end) > least for end in ends)


def _warn(excess: Array, doubtful: Bools, clipped: Bools, blind: Bools) -> None:
    for channel in np.flatnonzero(doubtful).tolist():
        why = f"residuals are {excess[channel]:.1f} times as large as noise explains"
        if clipped[channel]:
            why = "many samples share its largest or smallest value, as at the end of a range"
        elif blind[channel]:
            why = "what it measured does not follow the true capacitances"
        warnings.warn(
            f"channel {channel}: {why}, so gain, offset and their uncertainties are not to be "
            "believed; leave out samples out of range (flags=), check poses and times, or give the "
            "flicker's floor",
            CalibrationWarning,
            stacklevel=3,
        )


def _times(time: ArrayLike | None, count: int, channels: int, needed: bool) -> Array:
    """Times of each channel's samples [s], shape (count, channels)."""
    if time is None:
        if needed:
            raise ReadoutError(
                "drift and floor need the times of the samples; give time, or drift=False and "
                "no floor"
            )
        return np.zeros((count, channels))
    t = finite("time", time)
    if t.shape not in ((count,), (count, channels)):
        raise ReadoutError(f"time has shape {t.shape}; give {count} numbers, one a sample")
    return np.broadcast_to(t if t.ndim == 2 else t[:, None], (count, channels))


def least_squares(
    design: Array, seen: Array, channel: int, time: Array, floor: float
) -> tuple[Array, Array, float]:
    """Figures, their covariance, and squares of residuals that flicker explains [F²]."""
    scale = np.sqrt((design**2).mean(axis=0))
    # A column that is a constant, or a multiple of another one, tells nothing of its own.
    if (scale == 0).any() or np.linalg.cond(design / np.where(scale > 0, scale, 1.0)) > 1e6:
        raise ReadoutError(
            f"channel {channel}: the recording does not tell gain, offset and drift apart; move "
            "the body so that the capacitance changes, and not along with time only"
        )
    # By QR: the normal equations would lose the gain where C changes by little of its own size.
    q, r = np.linalg.qr(design / scale)
    figures = np.linalg.solve(r, q.T @ seen)
    root = np.linalg.inv(r)
    n, p = design.shape
    squares = float(((seen - (design / scale) @ figures) ** 2).sum())
    slow, total = np.zeros((p, p)), 0.0
    if floor > 0:
        covered, total = flicker_covariance(q, time, floor)
        slow = q.T @ covered
    # The residuals hold the white noise, and what of the flicker the fit did not follow.
    white = max(0.0, squares - total + float(np.trace(slow))) / (n - p)
    covariance = root @ (white * np.eye(p) + slow) @ root.T / np.outer(scale, scale)
    return figures / scale, covariance, total - float(np.trace(slow))


def flicker_covariance(columns: Array, time: Array, floor: float) -> tuple[Array, float]:
    """Σ times columns, shape (n, p), and the trace of Σ, Σ being flicker's covariance [F²].

    ``Σ_ij = v Σ_k exp(−|t_i − t_j|/τ_k)``; each exponential is carried along, forth and back.
    """
    taus, variance = Flicker(floor).poles(float(np.median(np.diff(time))))
    keep = np.exp(-np.diff(time)[:, None] / taus)[:, :, None]
    out = len(taus) * columns
    for sums, rows, kept in ((out, columns, keep), (out[::-1], columns[::-1], keep[::-1])):
        memory = np.zeros((len(taus), columns.shape[1]))
        for n in range(1, len(rows)):
            memory = kept[n - 1] * (memory + rows[n - 1])
            sums[n] += memory.sum(axis=0)
    return variance * out, variance * len(taus) * len(time)
