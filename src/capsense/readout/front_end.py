"""What lies between electrodes and converter: wiring, a shunt, an amplifier, IQ demodulation.

The transmitter drives one plate of the capacitance C with an amplitude V and an angular frequency
ω; the other plate goes to ground through the shunt R_S, over which lies the parasitic capacitance
C_p of traces and cable. The amplifier, of gain A and one pole at its bandwidth, sees the shunt's
voltage. As phasors

    V_o = A/(1 + jf/f_b) · V · jωC / (1/R_S + jω(C + C_p)).

Without C_p and with a fast amplifier, A V/V_o − 1 = 1/(jω R_S C), and hence
``C = 1/(ω R_S |A V/V_o − 1|)``, the recovery formula of Schöffmann et al. 2022 (there V is called
V_RX). Given the phasor V_o it is exact. Given its magnitude only, it is too large by the factor
1 + ω R_S C, to first order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense._validate import as_number
from capsense.errors import ReadoutError
from capsense.readout.checks import Array, finite, per_channel, require, require_whole

Phasors = NDArray[np.complex128]


@dataclass(frozen=True)
class Wiring:
    """Parasitics, as they change the capacitances of all channels at an instant.

    A self measurement charges what its lead has to ground; a mutual one does not see that, but
    what the receiver's lead has to the transmitter's:

        ``y_k = c_k + Σ_l crosstalk_kl c_l + (ground_k or coupling_k)``,
        ``ground_k = trace_k + (1 − shield_gain) cable_k``.

    A cable whose shield is driven with the signal counts only as far as the shield's driver falls
    short of a gain of one. What a mutual channel's receiver has to ground loads its shunt, if it
    has one: :attr:`ShuntFrontEnd.parasitic`.
    """

    trace: Any = 0.0
    """Capacitance of traces and pins to ground [F]: a number, or one per channel."""
    cable: Any = 0.0
    """Capacitance from the cable's core to its shield [F]: a number, or one per channel."""
    shield_gain: float = 0.0
    """Gain of the driven shield: 0 for a grounded one, 1 for a perfect driver."""
    crosstalk: Any = 0.0
    """Share of each other channel that is added: a number, or a matrix of shape (K, K)."""
    coupling: Any = 0.0
    """Capacitance between the leads of transmitter and receiver [F]: a number, or one per
    channel."""

    def ground(self, channels: int) -> Array:
        """Capacitance of each channel's lead to ground [F], shape (K,).

        Raises:
            ReadoutError: A size does not fit the channels, a number is negative or not finite,
                or the shield's gain is not between 0 and 1.
        """
        if not 0.0 <= as_number(self.shield_gain) <= 1.0:
            raise ReadoutError(
                f"wiring: shield_gain is {self.shield_gain!r}; give a number from 0 to 1"
            )
        trace, cable = self._capacitances("trace", channels), self._capacitances("cable", channels)
        return trace + (1.0 - self.shield_gain) * cable

    def start(self, is_self: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Mixing matrix and offsets of channels.

        Args:
            is_self: Which channels are self measurements, shape (K,).

        Returns:
            The matrix, shape (K, K), and offsets [F], shape (K,).

        Raises:
            ReadoutError: As of :meth:`ground`.
        """
        channels = len(is_self)
        share = finite("wiring: crosstalk", self.crosstalk)
        if share.shape not in ((), (channels, channels)):
            raise ReadoutError(
                f"wiring: crosstalk is {self.crosstalk!r}; give a number, or {channels} lists of "
                f"{channels}"
            )
        mixing = np.array(np.broadcast_to(share, (channels, channels)))
        if share.shape == ():
            np.fill_diagonal(mixing, 0.0)
        coupling = self._capacitances("coupling", channels)
        return mixing + np.eye(channels), np.where(is_self, self.ground(channels), coupling)

    def _capacitances(self, name: str, channels: int) -> Array:
        values = per_channel("wiring", name, getattr(self, name), channels)
        if (values < 0).any():
            raise ReadoutError(f"wiring: {name} holds {values.min():g} F; give zero or more")
        return values


@dataclass(frozen=True)
class ShuntFrontEnd:
    """Voltage divider of capacitance and shunt, with amplifier.

    Raises:
        ReadoutError: A number is not finite or not positive (``parasitic`` may be zero,
            ``bandwidth`` infinite).
    """

    excitation_frequency: float = 1e6
    """Excitation frequency [Hz]."""
    shunt: float = 1e3
    """R_S [Ω]."""
    gain: float = 100.0
    """A, at low frequency."""
    amplitude: float = 1.0
    """V, of the transmitter [V]."""
    bandwidth: float = math.inf
    """Frequency of the amplifier's pole, −3 dB [Hz]."""
    parasitic: float = 0.0
    """C_p [F]."""

    def __post_init__(self) -> None:
        for name, unit in (
            ("excitation_frequency", "Hz"),
            ("shunt", "Ω"),
            ("gain", ""),
            ("amplitude", "V"),
        ):
            require("front end", name, getattr(self, name), 0.0, unit, open_=True)
        require("front end", "parasitic", self.parasitic, 0.0, "F")
        if self.bandwidth != math.inf:
            require("front end", "bandwidth", self.bandwidth, 0.0, "Hz", open_=True)

    @property
    def omega(self) -> float:
        """Angular frequency [rad/s]."""
        return 2 * math.pi * self.excitation_frequency

    def output(self, capacitance: ArrayLike) -> Phasors:
        """Phasor at the amplifier's output [V], for capacitances [F] of any shape.

        They may be complex: matter with a conductance G [S] has ``capacitance - 1j * G / ω``, and
        turns the phase.
        """
        admittance = 1j * self.omega * np.asarray(capacitance)
        divider = admittance / (1 / self.shunt + admittance + 1j * self.omega * self.parasitic)
        amplifier = self.gain / (1 + 1j * self.excitation_frequency / self.bandwidth)
        return amplifier * self.amplitude * divider

    def recover(self, output: ArrayLike) -> Array:
        """Capacitance [F] by the recovery formula, from phasors V_o or from magnitudes [V].

        The formula knows neither the parasitic capacitance nor the bandwidth; what they change
        is the error that calibration is there to take out. An output of zero gives 0 F.

        Raises:
            ReadoutError: An output is not a number.
        """
        v_o = np.asarray(output)
        if np.isnan(v_o).any():
            raise ReadoutError("front end: an output is not a number; leave it out")
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.abs(self.gain * self.amplitude / v_o - 1.0)
            return 1.0 / (self.omega * self.shunt * distance)

    def waveform(self, capacitance: float, sample_rate: float, count: int) -> Array:
        """Samples of the amplifier's output [V], from phase 0 of the transmitter on, (count,).

        Raises:
            ReadoutError: The rate is not above zero, or the count not a whole number from 1 on.
        """
        _require_window(sample_rate, count)
        phase = self.omega * np.arange(count) / sample_rate
        return np.real(self.output(capacitance) * np.exp(1j * phase))


def demodulate(samples: ArrayLike, frequency: float, sample_rate: float) -> Phasors:
    """IQ demodulation of sampled waveforms: mix with the transmitter, average.

    I and Q are twice the means of the signal times cos ωt and −sin ωt over the window; the
    average is the low-pass filter ("integrate and dump"). Magnitude and phase are those of I + jQ.

    Args:
        samples: Signals [V], shape (..., N), from phase 0 of the transmitter on.
        frequency: Of the transmitter [Hz].
        sample_rate: Samples per second [Hz].

    Returns:
        Phasors I + jQ [V], shape (...).

    Raises:
        ReadoutError: There are no samples, one is not finite, or the rate is not above zero.
    """
    signal = finite("samples", samples)
    _require_window(sample_rate, signal.shape[-1] if signal.ndim else 0)
    phase = 2 * math.pi * frequency * np.arange(signal.shape[-1]) / sample_rate
    return 2 * (signal @ np.exp(-1j * phase)) / signal.shape[-1]


def demodulated(
    phasor: ArrayLike, signal_frequency: float, frequency: float, sample_rate: float, count: int
) -> Phasors:
    """Closed form of :func:`demodulate` for a sine.

    For a signal Re(P e^{jω_s t}) sampled N times, I + jQ = P D(ω_s − ω) + P* D(−ω_s − ω), where
    D(Ω) is the mean of e^{jΩt} over the window, a Dirichlet kernel. A signal at the transmitter's
    own frequency over a whole number of half periods comes out as P itself; otherwise its image
    at 2ω leaks, and so does an interferer at another frequency.

    White noise of variance σ² per sample leaves a variance of 2σ²/N on each of I and Q.

    Args:
        phasor: P [V], of any shape.
        signal_frequency: Of the signal [Hz].
        frequency: Of the transmitter [Hz].
        sample_rate: Samples per second [Hz].
        count: Number of samples N in the window.

    Returns:
        I + jQ [V], of the shape of ``phasor``.

    Raises:
        ReadoutError: The rate is not above zero, or the count not a whole number from 1 on.
    """
    _require_window(sample_rate, count)
    p = np.asarray(phasor, dtype=complex)
    near = _window_mean((signal_frequency - frequency) / sample_rate, count)
    image = _window_mean((-signal_frequency - frequency) / sample_rate, count)
    return p * near + np.conj(p) * image


def _require_window(sample_rate: float, count: int) -> None:
    require("demodulation", "sample_rate", sample_rate, 0.0, "Hz", open_=True)
    require_whole("demodulation", "the number of samples", count, 1)


def _window_mean(cycles: float, count: int) -> complex:
    """Mean of e^{2πj·cycles·n} over n = 0 … count − 1."""
    turn = cycles - round(cycles)
    if abs(turn) * count < 1e-12:
        return 1.0 + 0.0j
    size = math.sin(math.pi * turn * count) / (count * math.sin(math.pi * turn))
    return complex(size * np.exp(1j * math.pi * turn * (count - 1)))
