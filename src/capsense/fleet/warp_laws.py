"""Converters on Warp: the laws of :mod:`capsense.readout.converter` in double precision."""

from __future__ import annotations

from typing import Any

import warp as wp

from capsense.errors import ReadoutError
from capsense.readout.laws import LinearLaw, ReciprocalLaw, ResonanceLaw, ShuntLaw

wp.set_module_options({"enable_backward": False})

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
def level(law: WarpLaw, capacitance: wp.float64):
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
def capacitance(law: WarpLaw, code: wp.float64):
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
