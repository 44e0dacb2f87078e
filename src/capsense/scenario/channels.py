"""Channels: which numbers of a reading an excitation makes visible."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from capsense.reading import Reading


class Excitation(StrEnum):
    """How the electrodes are driven and read."""

    MATRIX = "matrix"
    """Every entry of the Maxwell matrix, as it is (off-diagonals negative)."""
    SELF = "self"
    """Each electrode against everything else at ground, guards driven with it."""
    MUTUAL = "mutual"
    """Pairs of electrodes: minus the off-diagonal entry, a positive number."""


@dataclass(frozen=True)
class Channel:
    """One number per sample."""

    excitation: Excitation
    row: int
    """Index of the electrode, or of the pair's first one."""
    column: int
    """Index of the pair's second electrode; ``row`` for a single one."""
    electrodes: tuple[str, str]
    """Names of the two electrodes."""

    @property
    def label(self) -> str:
        """Short name, as in plots: ``E1``, ``E1–E2``."""
        one, two = self.electrodes
        return one if self.row == self.column else f"{one}–{two}"

    @property
    def column_name(self) -> str:
        """Name in tables, without its unit: ``C_E1_E2`` (matrix, self), ``Cm_E1_E2`` (mutual)."""
        one, two = self.electrodes
        if self.excitation is Excitation.SELF:
            return f"C_{one}"
        return f"{'Cm' if self.excitation is Excitation.MUTUAL else 'C'}_{one}_{two}"

    @property
    def meaning(self) -> str:
        """What the number is, in words."""
        one, two = self.electrodes
        if self.excitation is Excitation.SELF:
            return f"self capacitance of {one}"
        if self.excitation is Excitation.MUTUAL:
            return f"mutual capacitance between {one} and {two}, positive"
        return f"entry ({one}, {two}) of the Maxwell matrix"

    def read(self, reading: Reading) -> float:
        """The channel's capacitance [F] in a reading."""
        if self.excitation is Excitation.SELF:
            return float(reading.self_capacitance[self.row])
        value = float(reading.capacitance[self.row, self.column])
        return -value if self.excitation is Excitation.MUTUAL else value


def channels_of(
    excitation: Excitation, names: Sequence[str], pairs: Sequence[tuple[str, str]] = ()
) -> tuple[Channel, ...]:
    """The channels of an excitation.

    Args:
        excitation: How the electrodes are driven.
        names: Electrode names in matrix order.
        pairs: For ``MUTUAL``, the pairs to read, by name; all of them if empty.

    Returns:
        For ``MATRIX`` the upper triangle row by row, the diagonal included; for ``SELF`` one per
        electrode; for ``MUTUAL`` one per pair.
    """
    index = {name: k for k, name in enumerate(names)}
    count = len(names)
    if excitation is Excitation.SELF:
        chosen = [(k, k) for k in range(count)]
    elif excitation is Excitation.MATRIX:
        chosen = [(i, j) for i in range(count) for j in range(i, count)]
    elif pairs:
        chosen = [(index[a], index[b]) for a, b in pairs]
    else:
        chosen = [(i, j) for i in range(count) for j in range(i + 1, count)]
    return tuple(Channel(excitation, i, j, (names[i], names[j])) for i, j in chosen)
