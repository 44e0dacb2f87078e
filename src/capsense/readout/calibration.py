"""Calibration: making raw values comparable, and fitting the model to a sensor of one's own."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from capsense.errors import ReadOutError
from capsense.readout.stage import Array, Context, Ints, Process


def base_capacitance(values: ArrayLike) -> Array:
    """Mean of readings of the empty scene: the base capacitance of offset calibration.

    Args:
        values: Readings [F or codes], shape (n, ...).

    Raises:
        ReadOutError: There are no readings, or one is not finite.
    """
    array = np.asarray(values, dtype=float)
    if array.ndim < 1 or not len(array) or not np.isfinite(array).all():
        raise ReadOutError("base capacitance needs finite readings, at least one; give some")
    return array.mean(axis=0)


def tare(values: ArrayLike, base: ArrayLike) -> Array:
    """Readings less the base: what remains is what the scene changed."""
    return np.asarray(values, dtype=float) - np.asarray(base, dtype=float)


def relative_to(values: ArrayLike, base: ArrayLike) -> Array:
    """Readings as multiples of the base, as Schöffmann et al. 2022 plot them.

    Raises:
        ReadOutError: A base is zero.
    """
    level = np.asarray(base, dtype=float)
    if (level == 0).any():
        raise ReadOutError("a base is 0, to which nothing is relative; use tare() instead")
    return np.asarray(values, dtype=float) / level


def unit_range(values: ArrayLike) -> Array:
    """Each channel stretched to run from 0 to 1 over a recording, shape (n, ...).

    Raises:
        ReadOutError: A channel is constant.
    """
    array = np.asarray(values, dtype=float)
    low, span = array.min(axis=0), np.ptp(array, axis=0)
    if (span == 0).any():
        raise ReadOutError("a channel is constant and has no range; leave it out")
    return (array - low) / span


def cross_correlation(one: ArrayLike, other: ArrayLike) -> float:
    """Normalised cross-correlation at lag zero of two signals, from −1 to 1.

    ``Σ (a − ā)(b − b̄) / √(Σ (a − ā)² Σ (b − b̄)²)``

    Raises:
        ReadOutError: The signals differ in length, or one is constant.
    """
    a, b = np.asarray(one, dtype=float), np.asarray(other, dtype=float)
    if a.shape != b.shape:
        raise ReadOutError(f"signals have shapes {a.shape} and {b.shape}; make them the same")
    a, b = a - a.mean(), b - b.mean()
    size = math.sqrt(float((a * a).sum() * (b * b).sum()))
    if size == 0:
        raise ReadOutError("a signal is constant and correlates with nothing; leave it out")
    return float((a * b).sum()) / size


@dataclass(frozen=True, eq=False)
class Calibration:
    """A linear model of a sensor, ``measured = gain · true + offset + drift · (t − epoch)``.

    As a stage of a read-out it makes the simulated sensor measure like the real one.
    """

    gain: Array
    """Shape (K,)."""
    offset: Array
    """At the epoch [F], shape (K,)."""
    drift: Array
    """[F/s], shape (K,)."""
    epoch: float
    """Time that drift is counted from: the recording's mean time [s]."""
    covariance: Array
    """Of (gain, offset, drift) of each channel, shape (K, 3, 3); zero where drift is not fitted."""
    residual: Array
    """Standard deviation about the fit [F], shape (K,)."""
    samples: int
    """Number of samples fitted."""

    @property
    def uncertainty(self) -> Array:
        """Standard uncertainties of (gain, offset, drift), shape (K, 3)."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    def correct(self, measured: ArrayLike, time: ArrayLike | None = None) -> Array:
        """True capacitances [F] from measured ones, shape (n, K); ``time`` [s] of shape (n,)."""
        return (np.asarray(measured, dtype=float) - self._shift(time)) / self.gain

    def distort(self, true: ArrayLike, time: ArrayLike | None = None) -> Array:
        """Measured capacitances [F] from true ones, shape (n, K); ``time`` [s] of shape (n,)."""
        return np.asarray(true, dtype=float) * self.gain + self._shift(time)

    def _shift(self, time: ArrayLike | None) -> Array:
        if time is None:
            return self.offset
        since = np.asarray(time, dtype=float)[..., None] - self.epoch
        return self.offset + self.drift * since

    def start(self, context: Context) -> Process:
        """The process of a read-out's stage."""
        if len(self.gain) != context.channels:
            raise ReadOutError(
                f"the calibration has {len(self.gain)} channels and the read-out "
                f"{context.channels}; calibrate each of its channels"
            )

        def process(channel: Ints, time: Array, value: Array) -> Array:
            shift = self.offset[channel] + self.drift[channel] * (time - self.epoch)
            return value * self.gain[channel] + shift

        return process


def calibrate(
    true: ArrayLike, measured: ArrayLike, time: ArrayLike | None = None, *, drift: bool = True
) -> Calibration:
    """Fit gain, offset and drift of each channel to a recording with known poses.

    Ordinary least squares. Uncertainties follow from the residuals, ``s² (XᵀX)⁻¹``, and hold for
    noise that is white from sample to sample: where an Allan plot shows flicker or a random walk
    within the recording's length, they are too small.

    Args:
        true: Capacitances that the simulator gives at the poses and times of the recording [F],
            shape (n, K).
        measured: What the sensor reported [F], shape (n, K).
        time: Times of the samples [s], shape (n,); needed for drift.
        drift: Whether to fit a drift that is linear in time.

    Raises:
        ReadOutError: Shapes do not fit, numbers are not finite, samples are too few, or the
            recording does not tell the figures apart (a channel that never changes).
    """
    c = np.asarray(true, dtype=float)
    m = np.asarray(measured, dtype=float)
    if c.ndim != 2 or c.shape != m.shape:
        raise ReadOutError(f"true has shape {c.shape}, measured {m.shape}; give both as (n, K)")
    if not (np.isfinite(c).all() and np.isfinite(m).all()):
        raise ReadOutError("a capacitance is not finite; leave such samples out")
    n, k = c.shape
    t = _times(time, n, drift)
    unknowns = 3 if drift else 2
    if n <= unknowns:
        raise ReadOutError(f"{n} samples for {unknowns} unknowns a channel; record more")
    epoch = float(t.mean())
    figures = np.zeros((k, 3))
    covariance = np.zeros((k, 3, 3))
    residual = np.zeros(k)
    for channel in range(k):
        columns = [c[:, channel], np.ones(n), t - epoch][:unknowns]
        fit = _least_squares(np.stack(columns, axis=1), m[:, channel], channel)
        figures[channel, :unknowns], covariance[channel, :unknowns, :unknowns] = fit[:2]
        residual[channel] = fit[2]
    return Calibration(figures[:, 0], figures[:, 1], figures[:, 2], epoch, covariance, residual, n)


def _times(time: ArrayLike | None, count: int, drift: bool) -> Array:
    if time is None:
        if drift:
            raise ReadOutError("drift needs the times of the samples; give time, or drift=False")
        return np.zeros(count)
    t = np.asarray(time, dtype=float)
    if t.shape != (count,) or not np.isfinite(t).all():
        raise ReadOutError(f"time has shape {t.shape}; give {count} finite numbers")
    return t


def _least_squares(design: Array, seen: Array, channel: int) -> tuple[Array, Array, float]:
    """Figures, their covariance and the residual's deviation, in columns scaled to one."""
    scale = np.sqrt((design**2).mean(axis=0))
    # A column that is a constant, or a multiple of another one, tells nothing of its own.
    if (scale == 0).any() or np.linalg.cond(design / np.where(scale > 0, scale, 1.0)) > 1e6:
        raise ReadOutError(
            f"channel {channel}: the recording does not tell gain, offset and drift apart; move "
            "the body so that the capacitance changes, and not along with time only"
        )
    unit = design / scale
    inverse = np.linalg.inv(unit.T @ unit)
    figures = inverse @ (unit.T @ seen)
    n, p = design.shape
    variance = float(((seen - unit @ figures) ** 2).sum()) / (n - p)
    return figures / scale, variance * inverse / np.outer(scale, scale), math.sqrt(variance)
