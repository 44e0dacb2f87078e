"""Laws of converters: how code and capacitance belong together.

A radio sees the front end with a shunt: the transmitter drives one plate of the capacitance C with
an amplitude V and an angular frequency ω; the other plate goes to ground through the shunt R_S,
over which lies the parasitic capacitance C_p of traces and cable. The amplifier, of gain A and one
pole at its bandwidth, sees the shunt's voltage. As phasors

    V_o = A/(1 + jf/f_b) · V · jωC / (1/R_S + jω(C + C_p)).

Without C_p and with a fast amplifier, A V/V_o − 1 = 1/(jω R_S C), and hence
``C = 1/(ω R_S |A V/V_o − 1|)``, the recovery formula of Schöffmann et al. 2022 (there V is called
V_RX). Given the phasor V_o it is exact. Given its magnitude only, it is too large by the factor
1 + ω R_S C, to first order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense._validate import as_number
from capsense.errors import ReadoutError
from capsense.readout.checks import Array, Ints, finite, require, require_positive, require_whole

Phasors = NDArray[np.complex128]

_MOST_CURVED = 0.1
"""Larger deviations from a straight line are refused; beyond 0.25 codes would fall again."""


class Law(Protocol):
    """How code and capacitance belong together."""

    @property
    def low(self) -> int:
        """Smallest code."""

    @property
    def high(self) -> int:
        """Largest code."""

    @property
    def rising(self) -> bool:
        """Whether the code grows with the capacitance."""

    def level(self, capacitance: Array) -> Array:
        """Code before rounding, of capacitances [F] of any shape."""

    def capacitance(self, code: Ints) -> Array:
        """Capacitance [F] that a code stands for."""


@dataclass(frozen=True)
class LinearLaw:
    """``code = C/lsb + zero``: sigma-delta converters with a reference capacitor, and counters."""

    lsb: float
    """Capacitance of one code [F]."""
    low: int
    high: int
    zero: int = 0
    """Code at 0 F."""
    nonlinearity: float = 0.0
    """Largest deviation of the codes from the straight line through the ends of their range, over
    the range: a parabola, up where it is positive. Its user does not know of it."""
    rising = True

    def __post_init__(self) -> None:
        require("linear law", "lsb", self.lsb, 0.0, "F", open_=True)
        _require_codes(self.low, self.high)
        if not abs(as_number(self.nonlinearity)) <= _MOST_CURVED:
            raise ReadoutError(
                f"linear law: nonlinearity is {self.nonlinearity!r}; give a share of the range, up "
                f"to {_MOST_CURVED} of it"
            )

    def level(self, capacitance: Array) -> Array:
        """Code before rounding."""
        code = capacitance / self.lsb + self.zero
        if not self.nonlinearity:
            return code
        share = np.clip((code - self.low) / (self.high - self.low), 0.0, 1.0)
        return code + 4.0 * self.nonlinearity * (self.high - self.low) * share * (1.0 - share)

    def capacitance(self, code: Ints) -> Array:
        """Capacitance of a code [F]."""
        return self.lsb * (np.asarray(code) - self.zero).astype(float)


@dataclass(frozen=True)
class ReciprocalLaw:
    """``code = 2^bits · I T/(C V_dd)``: charge with a current I for a time T, read the voltage.

    The charger needs a headroom to either rail; codes beyond it are out of range.
    """

    current: float
    """I [A]."""
    time: float
    """T [s]."""
    supply: float
    """V_dd [V]."""
    bits: int = 10
    headroom: float = 0.7
    """[V]"""
    rising = False

    def __post_init__(self) -> None:
        require_positive("reciprocal law", self, current="A", time="s", supply="V")
        require("reciprocal law", "headroom", self.headroom, 0.0, "V")
        _require_codes(self.low, self.high)

    @property
    def low(self) -> int:
        """Smallest code in range: at the largest capacitance."""
        return math.ceil(self.headroom / self.supply * 2**self.bits)

    @property
    def high(self) -> int:
        """Largest code in range."""
        full = 2**self.bits
        return min(math.floor((self.supply - self.headroom) / self.supply * full), full - 1)

    @property
    def _product(self) -> float:
        return 2**self.bits * self.current * self.time / self.supply

    def level(self, capacitance: Array) -> Array:
        """Code before rounding; beyond all codes for a capacitance of zero or less."""
        with np.errstate(divide="ignore"):
            return np.where(capacitance > 0, self._product / np.maximum(capacitance, 0.0), np.inf)

    def capacitance(self, code: Ints) -> Array:
        """Capacitance of a code [F]; infinite at code 0."""
        with np.errstate(divide="ignore"):
            return self._product / np.asarray(code, dtype=float)

    def set_for(self, capacitance: float) -> ReciprocalLaw:
        """This law with an MPR121's current and time that bring a capacitance [F] near 90 %.

        Raises:
            ReadoutError: No setting brings it into the range.
        """
        settings = [(k * 1e-6, 0.5e-6 * 2**power) for power in range(7) for k in range(1, 64)]
        laws = [replace(self, current=current, time=time) for current, time in settings]
        wanted = np.array(capacitance)
        fitting = [law for law in laws if law.low <= float(law.level(wanted)) <= law.high]
        if not fitting:
            raise ReadoutError(
                f"expected = {capacitance:g} F is outside of what an MPR121 can charge; give "
                "0.2e-12 to 2800e-12 F"
            )
        goal = self.low + 0.9 * (self.high - self.low)
        return min(fitting, key=lambda law: abs(float(law.level(wanted)) - goal))


@dataclass(frozen=True)
class ResonanceLaw:
    """``code = 2^bits f/f_ref`` with ``f = 1/(2π √(L (C_fixed + C)))``: an LC tank's frequency."""

    inductance: float
    """L [H]."""
    fixed: float
    """C_fixed, the tank's own capacitor [F]."""
    reference: float
    """f_ref [Hz]."""
    bits: int = 28
    slowest: float = 10e3
    """Least frequency that is counted [Hz]."""
    rising = False

    def __post_init__(self) -> None:
        units = {"inductance": "H", "fixed": "F", "reference": "Hz", "slowest": "Hz"}
        require_positive("resonance law", self, **units)
        _require_codes(self.low, self.high)

    @property
    def low(self) -> int:
        """Smallest code: that of the least frequency."""
        return math.ceil(self.slowest / self.reference * 2**self.bits)

    @property
    def high(self) -> int:
        """Largest code: a quarter of the reference frequency, beyond which it is not counted."""
        return 2**self.bits // 4

    def level(self, capacitance: Array) -> Array:
        """Code before rounding; beyond all codes where the tank has no capacitance left."""
        total = np.maximum(self.fixed + capacitance, 0.0)
        with np.errstate(divide="ignore"):
            frequency = 1 / (2 * math.pi * np.sqrt(self.inductance * total))
        return frequency / self.reference * 2**self.bits

    def capacitance(self, code: Ints) -> Array:
        """Capacitance of a code [F]."""
        frequency = np.asarray(code, dtype=float) * (self.reference / 2**self.bits)
        return 1 / (self.inductance * (2 * math.pi * frequency) ** 2) - self.fixed


@dataclass(frozen=True)
class ShuntLaw:
    """``code = 2^(bits−1) |V_o|/full_scale``: a front end's IQ magnitude, sampled by a radio.

    The phase tells the sign, so that noise about zero stays noise about zero. The capacitance is
    what the recovery formula makes of the magnitude, as in Schöffmann et al. 2022; see
    above for its error. A complex capacitance C − jG/ω, of matter that
    conducts, has a phasor V_o of another phase and magnitude.
    """

    front_end: ShuntFrontEnd
    full_scale: float
    """Largest amplitude [V]."""
    bits: int = 16
    rising = True

    def __post_init__(self) -> None:
        require("shunt law", "full_scale", self.full_scale, 0.0, "V", open_=True)
        require_whole("shunt law", "bits", self.bits, 2)
        _require_codes(self.low, self.high)

    @property
    def low(self) -> int:
        """Smallest code; the one below it has no counterpart."""
        return -self.high

    @property
    def high(self) -> int:
        """Largest code: the radio's, or the last below what the amplifier gives for any C."""
        most = self.front_end.gain * self.front_end.amplitude / self.full_scale
        return min(2 ** (self.bits - 1) - 1, math.ceil(most * 2 ** (self.bits - 1)) - 1)

    def level(self, capacitance: Array) -> Array:
        """Code before rounding."""
        sign = np.where(capacitance.real < 0.0, -1.0, 1.0)
        size = np.abs(self.front_end.output(sign * capacitance))
        scale = 2 ** (self.bits - 1) / self.full_scale
        return np.asarray(sign * size * scale, dtype=float)

    def capacitance(self, code: Ints) -> Array:
        """Capacitance of a code [F]."""
        volts = np.abs(code) * (self.full_scale / 2 ** (self.bits - 1))
        return np.asarray(np.sign(code) * self.front_end.recover(volts), dtype=float)


def _require_codes(low: int, high: int) -> None:
    if not low < high:
        raise ReadoutError(
            f"the codes run from {low} to {high}; widen the range (at a reciprocal law, raise the "
            "supply or lower the headroom; at a shunt law, lower the full scale)"
        )


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
        units = {"excitation_frequency": "Hz", "shunt": "Ω", "gain": "", "amplitude": "V"}
        if self.bandwidth != math.inf:
            units["bandwidth"] = "Hz"
        require_positive("front end", self, **units)
        require("front end", "parasitic", self.parasitic, 0.0, "F")

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
