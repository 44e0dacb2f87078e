"""What a study is, and what it leaves behind."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Verdict = Literal["met", "missed", "for information"]
Cell = str | int | float
Report = Callable[[str, float], None]
"""Told what is being done, and the fraction of the whole study that is done, from 0 to 1."""


@dataclass(frozen=True)
class Row:
    """One figure of a study, and how it stands against its target.

    Raises:
        ValueError: The value is not finite; a figure that could not be computed is no figure.
    """

    what: str
    value: float
    unit: str = ""
    target: str = ""
    """In words, like ``"> 0.976 (the paper's simulation)"``; empty without one."""
    verdict: Verdict = "for information"

    def __post_init__(self) -> None:
        if not math.isfinite(self.value):
            raise ValueError(f"{self.what}: the value is {self.value}; give a finite number")


def judged(
    what: str,
    value: float,
    unit: str = "",
    *,
    above: float | None = None,
    below: float | None = None,
    source: str = "",
) -> Row:
    """A row whose target is met strictly above or strictly below a limit.

    Args:
        what: What the figure is.
        value: The figure.
        unit: Its unit.
        above: Limit that the value must exceed, or …
        below: … stay under; exactly one of the two.
        source: Where the limit comes from, for the target's text.

    Raises:
        ValueError: Not exactly one limit is given, or the value is not finite.
    """
    if (above is None) == (below is None):
        raise ValueError(f"{what}: give one of above and below")
    limit, sign = (above, ">") if above is not None else (below, "<")
    assert limit is not None
    met = value > limit if sign == ">" else value < limit
    target = f"{sign} {limit:.5g}" + (f" ({source})" if source else "")
    return Row(what, value, unit, target, "met" if met else "missed")


@dataclass(frozen=True)
class ReportTable:
    """Columns with a heading each; written as csv, and shown in the report where it is short."""

    columns: tuple[str, ...]
    """Headings, with units in square brackets."""
    rows: tuple[tuple[Cell, ...], ...]

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(f"a row has {len(row)} cells for {len(self.columns)} columns")


@dataclass(frozen=True)
class Outcome:
    """What a study found."""

    title: str
    rows: tuple[Row, ...]
    tables: Mapping[str, ReportTable] = field(default_factory=dict)
    """By file name without ending."""
    plots: Mapping[str, Figure] = field(default_factory=dict)
    """By file name without ending."""
    notes: tuple[str, ...] = ()
    """Paragraphs in Markdown: what it does and does not show."""
    parts: str = ""
    """How much was computed and how much reused, of :meth:`capsense.reproduce.store.Store.told`."""

    @property
    def missed(self) -> tuple[Row, ...]:
        """The rows that missed their target."""
        return tuple(row for row in self.rows if row.verdict == "missed")


class Study(Protocol):
    """A module-level function that carries a study out."""

    def __call__(self, folder: Path, *, reduced: bool, report: Report) -> Outcome:
        """Carry it out.

        Args:
            folder: Its output folder, which exists; parts are kept there, see
                :class:`capsense.reproduce.store.Store`.
            reduced: In little time, at less resolution or with fewer cases.
            report: To be told how far it is.
        """
