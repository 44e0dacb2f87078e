"""Channels: which electrodes are driven and read, and what the wiring adds.

A pattern turns a Maxwell matrix into the one capacitance that a channel measures: the charge on the
electrode read, per volt of the transmitter.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from capsense._validate import as_number, suggest
from capsense.errors import ReadoutError
from capsense.readout.checks import Array, finite, per_channel, phasors, require

Rest = Literal["grounded", "floating", "guard"]
RESTS: tuple[Rest, ...] = ("grounded", "floating", "guard")


@dataclass(frozen=True)
class Pattern:
    """One measurement: potentials on some electrodes, and the electrode whose charge is read.

    Raises:
        ReadoutError: Nothing is driven, a weight is not a finite number, an electrode is both
            driven and floating, or a receiver other than the transmitter is driven.
    """

    sense: str
    """Electrode whose charge is measured."""
    drive: Mapping[str, float] = field(default_factory=dict)
    """Potential of each driven electrode in units of the transmitter's, such as 1 or −1; empty
    for the electrode read itself: a self measurement."""
    floating: tuple[str, ...] = ()
    """Electrodes left open: they carry no charge and take the potential that follows."""
    rest: Rest = "grounded"
    """What electrodes named nowhere do; ``"guard"`` drives them at the transmitter's potential."""
    shield: float = 0.0
    """Potential of the design's driven shields in units of the transmitter's."""
    name: str = ""
    """Channel name; by default that of the electrodes."""

    def __post_init__(self) -> None:
        drive = dict(self.drive) or {self.sense: 1.0}
        label = self.name or _default_name(self.sense, drive)
        where = f"channel {label!r}"
        for electrode, weight in (*drive.items(), ("shield", self.shield)):
            require(where, f"the drive of {electrode!r}", weight, -math.inf, "")
        if all(weight == 0.0 for weight in drive.values()):
            raise ReadoutError(f"{where}: nothing is driven; give one electrode a weight")
        if self.rest not in RESTS:
            raise ReadoutError(f"{where}: rest = {self.rest!r}; {suggest(str(self.rest), RESTS)}")
        for electrode in self.floating:
            if electrode in drive or electrode == self.sense:
                raise ReadoutError(
                    f"{where}: electrode {electrode!r} is floating, and driven or read; keep one"
                )
        if self.sense in drive and len(drive) > 1:
            raise ReadoutError(
                f"{where}: {self.sense!r} is read and driven together with other electrodes; "
                'read it alone, with the others as rest = "guard"'
            )
        object.__setattr__(self, "drive", MappingProxyType(drive))
        object.__setattr__(self, "name", label)

    def __reduce__(self) -> tuple[Any, ...]:
        # A read-only mapping is neither copied nor pickled by itself.
        figures = (self.floating, self.rest, self.shield, self.name)
        return type(self), (self.sense, dict(self.drive), *figures)

    @property
    def is_self(self) -> bool:
        """Whether the electrode read is the one driven."""
        return self.sense in self.drive

    @property
    def excitation(self) -> Hashable:
        """What the electrodes do: patterns of which it is the same can be measured at once.

        Receivers are held at ground, as the rest is. Where the rest floats or is driven, what
        another pattern reads would have to float or be driven: such a pattern is measured alone.
        """
        alone = "" if self.rest == "grounded" else self.name
        driven = frozenset(self.drive.items())
        return driven, frozenset(self.floating), self.shield, alone


def _default_name(sense: str, drive: Mapping[str, float]) -> str:
    if sense in drive:
        return sense
    return "+".join(drive) + f"-{sense}"


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
    chosen = list(pairs) or [
        (one, two) for k, one in enumerate(electrodes) for two in electrodes[k + 1 :]
    ]
    for tx, rx in chosen:
        if tx == rx:
            raise ReadoutError(f"pair {[tx, rx]} names one electrode twice; give two")
    return tuple(Pattern(rx, {tx: 1.0}, rest=rest) for tx, rx in chosen)


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
        for pattern in self.patterns:
            for name in (pattern.sense, *pattern.drive, *pattern.floating):
                if name not in index:
                    raise ReadoutError(
                        f"channel {pattern.name!r} names no electrode {name!r} of the sensor; "
                        f"{suggest(name, self.electrodes)}"
                    )
        self._sense = np.array([index[p.sense] for p in self.patterns])
        self._sign = np.array([1.0 if p.is_self else -1.0 for p in self.patterns])
        self._volts = np.array([self._potentials(p, index) for p in self.patterns])
        self._shield = np.array([p.shield for p in self.patterns])
        self._open = [self._floating_of(p, index) for p in self.patterns]
        self._with_floating = [k for k, f in enumerate(self._open) if len(f)]

    def __len__(self) -> int:
        return len(self.patterns)

    def values(self, capacitance: Array, shield_coupling: Array | None = None) -> Array:
        """Capacitance of every channel.

        A channel's value is ``±Σ_j C[sense, j] v_j``: plus for a self measurement, minus for a
        mutual one, so that both are positive. Open electrodes first get the potentials at which
        they carry no charge, ``v_f = −C_ff⁻¹ (C_fd v_d)``.

        Args:
            capacitance: Maxwell matrices [F], shields at ground, shape (..., M, M); complex ones
                where matter has losses, C − jG/ω.
            shield_coupling: Charge on each electrode per volt on all shields together [F],
                shape (..., M); None where the sensor has no shields.

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
        out = (rows * self._volts).sum(axis=-1)
        if shield_coupling is not None:
            out = out + np.asarray(shield_coupling)[..., self._sense] * self._shield
        for k in self._with_floating:
            out[..., k] += self._induced(matrix, shield_coupling, k)
        out = self._sign * out
        if not np.isfinite(out).all():
            raise ReadoutError(
                "capacitance holds a number that is not finite; correct the readings"
            )
        return out

    def _induced(self, matrix: Array, coupling: Array | None, k: int) -> Array:
        """Charge on the electrode read that the potentials of open electrodes add."""
        open_ = self._open[k]
        charge = (matrix[..., open_, :] * self._volts[k]).sum(axis=-1)
        if coupling is not None:
            charge = charge + np.asarray(coupling)[..., open_] * self._shield[k]
        own = matrix[..., open_[:, None], open_]
        try:
            volts = -np.linalg.solve(own, charge[..., None])[..., 0]
        except np.linalg.LinAlgError:
            raise ReadoutError(
                f"channel {self.names[k]!r}: its open electrodes have no capacitance; correct the "
                "readings"
            ) from None
        return (matrix[..., self._sense[k], open_] * volts).sum(axis=-1)

    def _potentials(self, pattern: Pattern, index: Mapping[str, int]) -> Array:
        volts = np.full(len(self.electrodes), 1.0 if pattern.rest == "guard" else 0.0)
        volts[[index[f] for f in pattern.floating]] = 0.0
        volts[index[pattern.sense]] = 0.0
        for name, weight in pattern.drive.items():
            volts[index[name]] = weight
        return volts

    def _floating_of(self, pattern: Pattern, index: Mapping[str, int]) -> NDArray[np.int64]:
        names = set(pattern.floating)
        if pattern.rest == "floating":
            names = set(self.electrodes) - {pattern.sense, *pattern.drive}
        return np.array(sorted(index[n] for n in names), dtype=np.int64)


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
