"""Domain randomisation of chips: how they scatter from one to the next, and from reset to reset."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.special import ndtri

from capsense.errors import ReadoutError
from capsense.readout.checks import Array, Ints, finite, spread
from capsense.readout.streams import Words, drawn, uniform

_EDGE = 2.0**-32
"""Shares nearer to 0 or 1 are not drawn, so that every distribution has ends."""
_FIRST = 2**48
"""Counts from here on are draws of figures; below lie those of noise."""


class Distribution(NamedTuple):
    """How a parameter scatters."""

    kind: Literal["normal", "uniform", "triangular"]
    first: float
    """Mean of a normal distribution, lower end of others."""
    second: float
    """Standard deviation of a normal distribution, upper end of others."""
    peak: float = 0.0
    """The most likely value of a triangular distribution."""

    @property
    def deviation(self) -> float:
        """Standard deviation."""
        if self.kind == "normal":
            return self.second
        low, high, peak = self.first, self.second, self.peak
        if self.kind == "uniform":
            return (high - low) / math.sqrt(12.0)
        return math.sqrt(((high - low) ** 2 + (peak - low) * (peak - high)) / 18.0)

    def values(self, shares: Array) -> Array:
        """Quantiles of shares in (0, 1)."""
        low, high, peak = self.first, self.second, self.peak
        if self.kind == "normal":
            return np.asarray(self.first + self.second * ndtri(shares))
        if self.kind == "uniform":
            return low + (high - low) * shares
        rising = low + np.sqrt(shares * (high - low) * (peak - low))
        falling = high - np.sqrt((1.0 - shares) * (high - low) * (high - peak))
        return np.where(shares * (high - low) < peak - low, rising, falling)


_LEAST = {"noise": 0.0, "delay": 0.0, "jitter": 0.0, "hysteresis": 0.0, "dead": 0.0, "stuck": 0.0}
"""Least value of a figure; others may have any sign."""
_UNITS = {"offset": "F", "delay": "s", "jitter": "s", "hysteresis": "F"}


@dataclass(frozen=True, kw_only=True, eq=False)
class ReadoutRandomisation:
    """How chips of one kind differ, and are drawn anew at each reset of their environment.

    Each figure is a number, a :class:`Distribution`, or an array that can be broadcast to
    (environments, sensors, channels), such as (K,), (s, K) or (e, 1, 1). Of a distribution every
    channel gets a value of its own; of ``delay`` and ``jitter`` every chip does. Where a figure
    must not be negative, what a distribution has below 0 is taken as 0.

    A conversion sees ``gain · h(c + crosstalk · (Σ_l c_l − c)) + offset``, with the channel's
    capacitance c, wiring included, and the play h; then come the stages, and the converter.

    Raises:
        ReadoutError: A figure is none of these, or out of its range.
    """

    gain: Any = 1.0
    """Factor on the capacitance."""
    offset: Any = 0.0
    """[F]"""
    noise: Any = 1.0
    """Factor on the readout's noise: white, flicker, random walk."""
    delay: Any = 0.0
    """Further time until a result can be read, beside the schedule's latency [s]."""
    jitter: Any = 0.0
    """Largest further delay, drawn evenly from 0 for each conversion [s]; up to the period."""
    hysteresis: Any = 0.0
    """Width of the loop of a play operator: what is measured follows the capacitance at half that
    distance [F]."""
    crosstalk: Any = 0.0
    """Share of every other channel that is added."""
    dead: Any = 0.0
    """Probability that an electrode, (e, s, n), is cut off from the chip; or which are, as
    booleans. It is then neither read nor driven, and taken to be at ground."""
    stuck: Any = 0.0
    """Probability that a channel reports its first code for ever; or which do, as booleans."""

    def __post_init__(self) -> None:
        for name in FIGURES:
            value = getattr(self, name)
            if isinstance(value, Distribution):
                _require_distribution(name, value)
                if name in ("dead", "stuck"):
                    raise ReadoutError(
                        f"randomisation: {name} is {value!r}; give a probability, or booleans"
                    )
                continue
            if np.asarray(value).dtype != bool:
                array = finite(f"randomisation: {name}", value)
                low, high = _LEAST.get(name, -math.inf), math.inf
                high = 1.0 if name in ("dead", "stuck") else high
                if not ((array >= low) & (array <= high)).all():
                    bounds = f"at least {low:g}" if high == math.inf else f"from {low:g} to 1"
                    raise ReadoutError(
                        f"randomisation: {name} holds {array.min() if high > 1 else array.max():g}"
                        f"; give numbers {bounds} {_UNITS.get(name, '')}".rstrip()
                    )
                object.__setattr__(self, name, array)
            elif name not in ("dead", "stuck"):
                raise ReadoutError(f"randomisation: {name} is of booleans; give numbers")

    def most(self, name: str) -> float:
        """Largest value of a figure that can be drawn."""
        value = getattr(self, name)
        if isinstance(value, Distribution):
            return float(value.values(np.array(1.0 - _EDGE)))
        return float(np.max(value))

    def of_sensor(self, number: int, count: int) -> ReadoutRandomisation:
        """What it says of one sensor of several."""
        part = {}
        for name in FIGURES:
            value = getattr(self, name)
            many = not isinstance(value, Distribution) and np.shape(value)[-2:-1] == (count,)
            part[name] = np.asarray(value)[..., number : number + 1, :] if many else value
        return ReadoutRandomisation(**part)

    def draw(self, keys: Words, rows: Ints, shape: tuple[int, int, int, int]) -> dict[str, Array]:
        """Figures of some environments, by name.

        Args:
            keys: Of their chips, shape (r, sensors).
            rows: Numbers of the environments, shape (r,).
            shape: Numbers of environments, sensors, channels and electrodes.

        Returns:
            Of shape (r, sensors, channels), those of dead electrodes (r, sensors, electrodes); of
            booleans where they say what is dead or stuck.

        Raises:
            ReadoutError: An array cannot be broadcast.
        """
        e, s, k, n = shape
        out = {}
        for number, name in enumerate(FIGURES):
            size = n if name == "dead" else k
            value = getattr(self, name)
            places = np.zeros(k, np.int64) if name in _OF_CHIP else np.arange(size)
            shares = uniform(drawn(keys[..., None], _FIRST + number * 2**32 + places))
            if isinstance(value, Distribution):
                found = value.values(np.clip(shares, _EDGE, 1.0 - _EDGE))
                out[name] = np.maximum(found, _LEAST.get(name, -math.inf))
                continue
            array = np.asarray(value)
            known = spread("randomisation", name, array.astype(float), (e, s, size))[rows]
            if name in ("dead", "stuck"):
                out[name] = known > 0.5 if array.dtype == bool else shares < known
            else:
                out[name] = known
        return out


FIGURES = tuple(field.name for field in dataclasses.fields(ReadoutRandomisation))
"""Names of the figures."""
_OF_CHIP = ("delay", "jitter")


def _require_distribution(name: str, given: Distribution) -> None:
    kind, first, second, peak = given
    numbers = finite(f"randomisation: {name}", [first, second, peak])
    low, high = numbers[:2]
    fine = {
        "normal": high >= 0.0, "uniform": low <= high,
        "triangular": low <= peak <= high and low < high,
    }  # fmt: skip
    if not fine.get(kind, False):
        raise ReadoutError(
            f"randomisation: {name} is {given!r}; give Distribution('normal', mean, deviation), "
            "('uniform', low, high) or ('triangular', low, high, peak)"
        )
