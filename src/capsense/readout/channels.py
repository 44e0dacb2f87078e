"""Channels: which electrodes are driven and read, and what the wiring adds.

A pattern turns a Maxwell matrix into the one capacitance that a channel measures: the charge on the
electrodes read, per volt of the transmitter.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense._validate import as_number, suggest
from capsense.errors import ReadoutError
from capsense.readout.checks import Array, finite, per_channel, phasors, require

Rest = Literal["grounded", "floating", "guard"]
RESTS: tuple[Rest, ...] = ("grounded", "floating", "guard")


@dataclass(frozen=True)
class Pattern:
    """One measurement: potentials on some electrodes, and those whose charge is read.

    The value is ``±Σ_s w_s Q_s`` per volt of the transmitter, w being the weights of the electrodes
    read and Q their charges: plus where one of them is driven, minus where none is, so that self
    and mutual capacitances are positive.

    Raises:
        ReadoutError: Nothing is driven or read, a weight is not a finite number, an electrode has
            two roles, or a floating transmitter is given a guard or a shield.
    """

    sense: str | Sequence[str] | Mapping[str, float]
    """Electrode whose charge is measured; several that are joined; or several with the weights of
    their charges."""
    drive: Mapping[str, float] = field(default_factory=dict)
    """Potential of each driven electrode in units of the transmitter's, such as 1 or −1, or 0 for
    one that is held at ground; empty for those read, at 1: a self measurement."""
    floating: tuple[str, ...] = ()
    """Electrodes left open: they carry no charge and take the potential that follows."""
    rest: Rest = "grounded"
    """What electrodes named nowhere do; ``"guard"`` drives them at the transmitter's potential."""
    shield: float = 0.0
    """Potential of the design's driven shields in units of the transmitter's: 1 in phase, −1 out
    of phase."""
    name: str = ""
    """Channel name; by default that of the electrodes."""
    low: tuple[str, ...] = ()
    """Electrodes on the other end of a transmitter that floats, as that of an LCR meter does: they
    and the driven ones carry no charge together. Empty where the transmitter is at ground."""
    minus: str | Pattern | None = None
    """A measurement whose value is subtracted, or the electrode of which the same is measured."""

    def __post_init__(self) -> None:
        sense = self._weights_of_sense()
        if isinstance(self.low, str):
            object.__setattr__(self, "low", (self.low,))
        drive = dict(self.drive) or dict.fromkeys(sense, 1.0)
        label = self.name or self._default_name(sense, drive)
        where = f"channel {label!r}"
        weights = (("drive", {**drive, "shield": self.shield}), ("weight", sense))
        for what, given in weights:
            for electrode, weight in given.items():
                require(where, f"the {what} of {electrode!r}", weight, -math.inf, "")
        if all(weight == 0.0 for weight in drive.values()):
            raise ReadoutError(f"{where}: nothing is driven; give one electrode a weight")
        if all(weight == 0.0 for weight in sense.values()):
            raise ReadoutError(f"{where}: nothing is read; give one electrode a weight")
        if self.rest not in RESTS:
            raise ReadoutError(f"{where}: rest = {self.rest!r}; {suggest(str(self.rest), RESTS)}")
        for electrode in self.floating:
            if electrode in drive or electrode in sense or electrode in self.low:
                raise ReadoutError(
                    f"{where}: electrode {electrode!r} is floating, and driven or read; keep one"
                )
        for electrode in self.low:
            if electrode in drive:
                raise ReadoutError(f"{where}: electrode {electrode!r} is driven and low; keep one")
        if self.low and (self.rest == "guard" or self.shield != 0.0):
            raise ReadoutError(
                f"{where}: the transmitter floats between {', '.join(drive)} and "
                f"{', '.join(self.low)}, so that no guard and no shield is at its potential; give "
                'rest = "grounded" or "floating", and shield = 0'
            )
        object.__setattr__(self, "drive", MappingProxyType(drive))
        if not isinstance(self.sense, str):
            object.__setattr__(self, "sense", MappingProxyType(sense))
        object.__setattr__(self, "name", label)
        object.__setattr__(self, "minus", self._subtracted(where))

    def _weights_of_sense(self) -> dict[str, float]:
        if isinstance(self.sense, str):
            return {self.sense: 1.0}
        if isinstance(self.sense, Mapping):
            return dict(self.sense)
        return dict.fromkeys(self.sense, 1.0)

    def _subtracted(self, where: str) -> Pattern | None:
        """The measurement that is subtracted, from what was given."""
        if self.minus is None or isinstance(self.minus, Pattern):
            if self.minus is not None and self.minus.minus is not None:
                raise ReadoutError(
                    f"{where}: what is subtracted is a difference itself; give one of two patterns"
                )
            return self.minus
        sense = self._weights_of_sense()
        if dict(self.drive) != dict.fromkeys(sense, 1.0):
            raise ReadoutError(
                f"{where}: minus = {self.minus!r} names an electrode, which goes with a self "
                "measurement; give a Pattern"
            )
        if self.minus in sense:
            raise ReadoutError(f"{where}: {self.minus!r} is read and subtracted; give another one")
        return Pattern(self.minus, {}, self.floating, self.rest, self.shield, "", self.low)

    def __reduce__(self) -> tuple[Any, ...]:
        # A read-only mapping is neither copied nor pickled by itself.
        sense = self.sense if isinstance(self.sense, str) else self._weights_of_sense()
        figures = (self.floating, self.rest, self.shield, self.name, self.low, self.minus)
        return type(self), (sense, dict(self.drive), *figures)

    @property
    def weights(self) -> Mapping[str, float]:
        """Electrodes that are read, and the weights of their charges."""
        return MappingProxyType(self._weights_of_sense())

    @property
    def is_self(self) -> bool:
        """Whether an electrode that is read is driven."""
        return any(self.drive.get(name, 0.0) != 0.0 for name in self.weights)

    @property
    def sees_ground(self) -> bool:
        """Whether it charges what its leads have to ground: not a mutual one, nor one whose
        transmitter floats, nor a difference, of which equal leads cancel."""
        return self.is_self and not self.low and self.minus is None

    @property
    def excitation(self) -> Hashable:
        """What the electrodes do: patterns of which it is the same can be measured at once.

        Receivers are held at ground, as the rest is. Where the rest floats or is driven, what
        another pattern reads would have to float or be driven: such a pattern is measured alone.
        """
        plain = self.rest == "grounded" and not self.low and self.minus is None
        driven = frozenset(self.drive.items())
        return driven, frozenset(self.floating), self.shield, "" if plain else self.name

    def _default_name(self, sense: Mapping[str, float], drive: Mapping[str, float]) -> str:
        out = "+".join(sense)
        if set(drive) != set(sense):
            out = "+".join(drive) + f"-{out}"
        if self.low:
            out += f" to {'+'.join(self.low)}"
        if self.minus is not None:
            other = self.minus if isinstance(self.minus, str) else self.minus.name
            out += f" minus {other}"
        return out


def self_patterns(
    electrodes: Sequence[str], *, rest: Rest = "grounded", shield: float = 1.0
) -> tuple[Pattern, ...]:
    """Each electrode by itself: driven and read; shields follow it unless ``shield`` is 0."""
    return tuple(Pattern(name, rest=rest, shield=shield) for name in electrodes)


def mutual_patterns(
    electrodes: Sequence[str], pairs: Iterable[tuple[str, str]] = (), *, rest: Rest = "grounded"
) -> tuple[Pattern, ...]:
    """Pairs (transmitter, receiver); by default every pair once, in the order of the electrodes.

    Raises:
        ReadoutError: A pair names one electrode twice.
    """
    return tuple(Pattern(rx, {tx: 1.0}, rest=rest) for tx, rx in _pairs(electrodes, pairs))


def differential_patterns(
    electrodes: Sequence[str], pairs: Iterable[tuple[str, str]] = (), *,
    rest: Rest = "grounded", shield: float = 1.0,
) -> tuple[Pattern, ...]:  # fmt: skip
    """Self measurements of the first of each pair minus those of the second; by default of all.

    So measures an FDC1004 with CHA − CHB: it drives the two and their shields in antiphase, and
    each pair's mutual capacitance cancels.

    Raises:
        ReadoutError: A pair names one electrode twice.
    """
    return tuple(
        Pattern(one, rest=rest, shield=shield, minus=two) for one, two in _pairs(electrodes, pairs)
    )


def two_terminal_patterns(
    electrodes: Sequence[str], pairs: Iterable[tuple[str, str]] = (), *, rest: Rest = "grounded"
) -> tuple[Pattern, ...]:
    """What an LCR meter that floats reads between the two of each pair; by default of all.

    With the others at ground, ``(C₁₁ C₂₂ − C₁₂²)/(C₁₁ + C₂₂ + 2 C₁₂)``.

    Raises:
        ReadoutError: A pair names one electrode twice.
    """
    return tuple(Pattern(one, low=(two,), rest=rest) for one, two in _pairs(electrodes, pairs))


def _pairs(electrodes: Sequence[str], pairs: Iterable[tuple[str, str]]) -> list[tuple[str, str]]:
    chosen = list(pairs) or [
        (one, two) for k, one in enumerate(electrodes) for two in electrodes[k + 1 :]
    ]
    for one, two in chosen:
        if one == two:
            raise ReadoutError(f"pair {[one, two]} names one electrode twice; give two")
    return chosen


class _Measurement(NamedTuple):
    """One of the measurements whose values make a channel's."""

    channel: int
    factor: Array
    """What the charge of each electrode counts for in the value, shape (M,)."""
    volts: Array
    """Potentials of the electrodes, of free ones before they rise, shape (M,)."""
    shield: float
    free: tuple[NDArray[np.int64], ...]
    """Electrodes that rise together until they carry no charge."""


class ChannelBank:
    """Patterns, ready to be applied to the Maxwell matrices of a sensor.

    Args:
        patterns: What is measured, in channel order.
        electrodes: Electrode names in matrix order.

    Raises:
        ReadoutError: A pattern names an electrode that is not there, or two have one name.
    """

    def __init__(self, patterns: Sequence[Pattern], electrodes: Sequence[str]) -> None:
        if isinstance(electrodes, str):
            raise ReadoutError(f"electrodes are {electrodes!r}; give a list of names")
        if not patterns:
            raise ReadoutError(
                f"a readout needs at least one channel; electrodes {list(electrodes)} make none"
            )
        for pattern in patterns:
            if not isinstance(pattern, Pattern):
                raise ReadoutError(f"channel {pattern!r} is no Pattern; make one, Pattern('E1')")
        self.patterns = tuple(patterns)
        self.electrodes = tuple(electrodes)
        self.names = tuple(p.name for p in patterns)
        for name in self.names:
            if self.names.count(name) > 1:
                raise ReadoutError(f"two channels are named {name!r}; give them names")
        index = {name: k for k, name in enumerate(self.electrodes)}
        self._measurements: list[_Measurement] = []
        for k, pattern in enumerate(self.patterns):
            self._measurements.append(_measurement(pattern, k, 1.0, index))
            if isinstance(pattern.minus, Pattern):
                self._measurements.append(_measurement(pattern.minus, k, -1.0, index))
        first: list[tuple[_Measurement, int]] = []  # charges that are read, one of each channel
        further: list[tuple[_Measurement, int]] = []
        for part in self._measurements:
            for s in np.flatnonzero(part.factor).tolist():
                (first if len(first) == part.channel else further).append((part, s))
        terms = first + further
        self._channel = np.array([part.channel for part, _ in terms])
        self._sense = np.array([s for _, s in terms])
        self._factor = np.array([part.factor[s] for part, s in terms])
        self._volts = np.array([part.volts for part, _ in terms])
        self._shield = np.array([part.shield for part, _ in terms])
        self._with_free = [part for part in self._measurements if part.free]

    def __len__(self) -> int:
        return len(self.patterns)

    @property
    def differences(self) -> NDArray[np.bool_]:
        """Which channels are differences of two measurements, shape (K,)."""
        return np.array([p.minus is not None for p in self.patterns])

    def values(
        self, capacitance: Array, shield_coupling: Array | None = None,
        connected: NDArray[np.bool_] | None = None,
    ) -> Array:  # fmt: skip
        """Capacitance of every channel.

        A channel's value is ``±Σ_s w_s Σ_j C_sj v_j``: plus for a self measurement, minus for a
        mutual one, so that both are positive. Electrodes that are free to rise first get the
        potentials at which they carry no charge: open ones each by itself, and those between which
        a transmitter floats together, ``u = −(Nᵀ C N)⁻¹ Nᵀ C v``, with a column of N for each.

        Args:
            capacitance: Maxwell matrices [F], shields at ground, shape (..., M, M); complex ones
                where matter has losses, C − jG/ω.
            shield_coupling: Charge on each electrode per volt on all shields together [F],
                shape (..., M); None where the sensor has no shields.
            connected: Which electrodes are connected to the chip, shape (..., M); all by default.
                Others are neither read nor driven.

        Returns:
            Channel capacitances [F], shape (..., K).

        Raises:
            ReadoutError: The shape does not fit the electrodes, or a number is not finite.
        """
        matrix = phasors("capacitance", capacitance)
        m = len(self.electrodes)
        if matrix.shape[-2:] != (m, m):
            raise ReadoutError(
                f"capacitance has shape {matrix.shape}; {m} electrodes need (..., {m}, {m})"
            )
        rows = matrix[..., self._sense, :]
        volts: Array = self._volts
        if connected is not None:
            volts = volts * connected[..., None, :] * connected[..., self._sense, None]
        terms = (rows * volts).sum(axis=-1)
        if shield_coupling is not None:
            shields = np.asarray(shield_coupling)[..., self._sense] * self._shield
            terms = terms + (
                shields if connected is None else shields * connected[..., self._sense]
            )
        terms = self._factor * terms
        out = terms[..., : len(self)]
        for number in range(len(self), len(self._channel)):
            out[..., self._channel[number]] += terms[..., number]
        for part in self._with_free:
            out[..., part.channel] += self._induced(matrix, shield_coupling, part, connected)
        if not np.isfinite(out).all():
            raise ReadoutError(
                "capacitance holds a number that is not finite; correct the readings"
            )
        return out

    def _induced(
        self, matrix: Array, coupling: Array | None, part: _Measurement,
        connected: NDArray[np.bool_] | None,
    ) -> Array:  # fmt: skip
        """What the potentials of free electrodes add to a channel [F]."""
        volts_given, factor = part.volts, part.factor
        if connected is not None:
            volts_given, factor = volts_given * connected, factor * connected
        charge = (matrix * volts_given[..., None, :]).sum(axis=-1)
        if coupling is not None:
            charge = charge + np.asarray(coupling) * part.shield
        lift = np.stack([matrix[..., group].sum(axis=-1) for group in part.free], axis=-1)
        own = np.stack([lift[..., group, :].sum(axis=-2) for group in part.free], axis=-2)
        side = np.stack([charge[..., group].sum(axis=-1) for group in part.free], axis=-1)
        try:
            volts = -np.linalg.solve(own, side[..., None])[..., 0]
        except np.linalg.LinAlgError:
            raise ReadoutError(
                f"channel {self.names[part.channel]!r}: its open electrodes have no capacitance; "
                "correct the readings"
            ) from None
        raised = (lift * volts[..., None, :]).sum(axis=-1)
        return (raised * factor).sum(axis=-1)


def _measurement(
    pattern: Pattern, channel: int, sign: float, index: Mapping[str, int]
) -> _Measurement:
    """A pattern, without what it subtracts, by the numbers of the electrodes.

    Raises:
        ReadoutError: It names an electrode that is not there.
    """
    sense = pattern.weights
    for name in (*sense, *pattern.drive, *pattern.floating, *pattern.low):
        if name not in index:
            raise ReadoutError(
                f"channel {pattern.name!r} names no electrode {name!r} of the sensor; "
                f"{suggest(name, list(index))}"
            )
    held = {**dict.fromkeys((*sense, *pattern.low, *pattern.floating), 0.0), **pattern.drive}
    volts = np.full(len(index), 1.0 if pattern.rest == "guard" else 0.0)
    volts[[index[name] for name in held]] = list(held.values())
    factor = np.zeros(len(index))
    sign = sign if pattern.is_self else -sign
    factor[[index[name] for name in sense]] = [sign * weight for weight in sense.values()]
    opened = set(pattern.floating)
    if pattern.rest == "floating":
        opened = set(index) - {*sense, *pattern.drive, *pattern.low}
    free = [[number] for number in sorted(index[name] for name in opened)]
    if pattern.low:
        free.append(sorted(index[name] for name in (*pattern.drive, *pattern.low)))
    groups = tuple(np.array(group, dtype=np.int64) for group in free)
    return _Measurement(channel, factor, volts, pattern.shield, groups)


@dataclass(frozen=True)
class Wiring:
    """Parasitics, as they change the capacitances of all channels at an instant.

    A self measurement charges what its lead has to ground; a mutual one does not see that, but
    what the receiver's lead has to the transmitter's:

        ``y_k = c_k + Σ_l crosstalk_kl c_l + (ground_k or coupling_k)``,
        ``ground_k = trace_k + (1 − shield_gain) cable_k``.

    A cable whose shield is driven with the signal counts only as far as the shield's driver falls
    short of a gain of one. What a mutual channel's receiver has to ground loads its shunt, if it
    has one: :attr:`~capsense.readout.laws.ShuntFrontEnd.parasitic`.
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
            is_self: Which channels charge what their leads have to ground, shape (K,).

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
