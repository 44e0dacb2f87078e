"""Plain text tables and numbers for people."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from capsense.simulator import Simulator


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Align columns: words to the left, numbers to the right."""
    body = [list(r) for r in rows]
    lines = [list(header), *body]
    widths = [max(len(line[k]) for line in lines) for k in range(len(header))]
    right = [bool(body) and all(_numeric(r[k]) for r in body) for k in range(len(header))]
    return "\n".join(
        "  ".join(
            cell.rjust(w) if r else cell.ljust(w)
            for cell, w, r in zip(line, widths, right, strict=True)
        ).rstrip()
        for line in lines
    )


def _numeric(cell: str) -> bool:
    return not cell or cell[0].isdigit() or (cell[0] in "+-−." and cell[1:2] != "")


def facts(pairs: Iterable[tuple[str, str]]) -> str:
    """Lines of a name and what it is, aligned."""
    items = list(pairs)
    width = max((len(name) for name, _ in items), default=0)
    return "\n".join(f"{name.ljust(width)}  {value}".rstrip() for name, value in items)


def seconds(value: float) -> str:
    """A time with a fitting unit."""
    if value < 1e-3:
        return f"{value * 1e6:.0f} µs"
    if value < 1.0:
        return f"{value * 1e3:.3g} ms"
    return f"{value:.3g} s"


def grouped(value: object) -> str:
    """A count with thin groups of three, any other value as it is."""
    if isinstance(value, bool) or not isinstance(value, int):
        return f"{value:.4g}" if isinstance(value, float) else str(value)
    return f"{value:,}".replace(",", " ")


def field_figures(simulator: Simulator) -> dict[str, float | int | str]:
    """The figures of a design's field, without what is printed elsewhere."""
    told = ("design", "electrodes", "method")
    return {key: value for key, value in simulator.describe().items() if key not in told}
