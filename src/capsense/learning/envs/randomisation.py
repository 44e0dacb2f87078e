"""What differs from episode to episode: the person, what the limb rests on, and the chip."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from capsense._validate import suggest
from capsense.errors import SceneError
from capsense.humans import Build
from capsense.readout.calibration import LinearSensor
from capsense.readout.presets import chip_of
from capsense.readout.readout import Readout

Range = tuple[float, float]
_LOG = ("grounding", "permittivity")
"""Uniform in the logarithm."""
_GIRTHS = 8
"""Girths take so many values, as bodies of proportions that were met before cost less time."""


@dataclass(frozen=True)
class Drawn:
    """What holds for one episode; see :class:`Randomisation`."""

    female: float
    percentile: float
    girth: float
    shift: float
    turn: float
    permittivity: float
    grounding: float
    gain: float
    noise: float
    drift: float
    latency: float

    @property
    def build(self) -> Build:
        """The size of the person."""
        sex = "female" if self.female > 0.5 else "male"
        return Build(sex, percentile=self.percentile, girth=self.girth)  # type: ignore[arg-type]

    def readout(self, chip: str, electrodes: tuple[str, ...], rng: Generator) -> Readout:
        """The readout of one sensor, at the chip's highest rate, with a gain of its own.

        Raises:
            ReadoutError: There is no such chip.
        """
        rate = max(r.per_second for r in chip_of(chip).rates)
        gain = 1.0 + self.gain * rng.uniform(-1.0, 1.0)
        stage = LinearSensor(np.array(gain), np.array(0.0), np.array(0.0), 0.0)
        return Readout.preset(
            chip, electrodes, rate=rate, latency=self.latency, white=self.noise,
            walk=self.drift, stages=(stage,),
        )  # fmt: skip


@dataclass(frozen=True)
class Randomisation:
    """Ranges ``(low, high)`` that every episode draws from.

    ``Randomisation().held()`` draws the middle of them always.

    Raises:
        SceneError: A range falls, or is not of two finite numbers.
    """

    female: Range = (0.0, 1.0)
    """Above one half the person is female, below male."""
    percentile: Range = (5.0, 95.0)
    """Of stature within the sex."""
    girth: Range = (0.85, 1.2)
    """Factor on circumferences."""
    shift: Range = (0.0, 0.03)
    """How far the limb or the sensor is from its usual place, in any direction [m]."""
    turn: Range = (0.0, 0.25)
    """How far it is turned, about any axis [rad]."""
    permittivity: Range = (1.1, 4.0)
    """Relative permittivity of what lies beneath the limb: foam to dense rubber or damp cloth."""
    grounding: Range = (30e-12, 300e-12)
    """What ties the person to ground [F]."""
    gain: Range = (0.0, 0.05)
    """Largest error of the readout's gain."""
    noise: Range = (0.2e-15, 1e-15)
    """Rms of the noise of one conversion [F]."""
    drift: Range = (0.0, 0.2e-15)
    """Random walk of each channel [F/√s]."""
    latency: Range = (0.0, 0.03)
    """From the end of a conversion until its result can be read [s]."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            low, high = getattr(self, field.name)
            if not (np.isfinite([low, high]).all() and low <= high):
                raise SceneError(
                    f"randomisation: {field.name} is {(low, high)}; give two finite numbers that "
                    "do not fall"
                )

    @classmethod
    def of(cls, given: Randomisation | Mapping[str, Sequence[float]] | None) -> Randomisation:
        """One that is given, or made of some ranges by name; else the usual one.

        Raises:
            SceneError: There is no range of a name, or one is wrong.
        """
        if isinstance(given, Randomisation):
            return given
        known = [field.name for field in dataclasses.fields(cls)]
        for name, pair in (given or {}).items():
            if name not in known:
                raise SceneError(f"randomisation: no range {name!r}; {suggest(name, known)}")
            if not isinstance(pair, Sequence) or len(pair) != 2:
                raise SceneError(f"randomisation: {name} is {pair!r}; give two numbers")
        return cls(**{name: (pair[0], pair[1]) for name, pair in (given or {}).items()})

    def held(self) -> Randomisation:
        """The middle of every range, and nothing random."""
        middle = {f.name: self._at(f.name, 0.5) for f in dataclasses.fields(self)}
        return Randomisation(**{name: (value, value) for name, value in middle.items()})

    def draw(self, rng: Generator) -> Drawn:
        """What holds for an episode."""
        shares = {f.name: rng.random() for f in dataclasses.fields(self)}
        shares["girth"] = round(shares["girth"] * (_GIRTHS - 1)) / (_GIRTHS - 1)
        return Drawn(**{name: self._at(name, share) for name, share in shares.items()})

    def _at(self, name: str, share: float) -> float:
        low, high = getattr(self, name)
        return float(low * (high / low) ** share if name in _LOG else low + share * (high - low))
