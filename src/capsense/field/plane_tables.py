"""Tables of what a grounded plane changes near the face of a design, and their arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class PressedTable:
    """Charge densities below a cover that is compressed, times its thickness over eps0 [V]."""

    strains: Array
    """Compression over thickness, ascending from 0, shape (k,)."""
    change: Single
    """What the density on each cell of the gap table changes by from contact on, with each terminal
    of its columns at 1 V, and the plane at 1 V in the last column, shape (c, k, n + 1); no cells
    below a fabric."""
    sheet_points: Single
    """Cells of the fabric [m], shape (f, 2); none without one."""
    sheet_areas: Single
    """Their areas [m²], shape (f,)."""
    sheet_terminals: Ints
    """Terminals that they screen most, -1 for none, shape (f, m)."""
    sheet_density: Single
    """Density on them, with these terminals at 1 V, shape (f, k, m)."""


@dataclass(frozen=True, eq=False)
class GapTable:
    """What a grounded plane near the face of a design changes in the charges of its terminals."""

    validity: float
    """Distance h0 from the design [m] from which the Green's function holds."""
    top: float
    """Height of the face of the design [m], from which distances count."""
    heights: Array
    """Distances z of the plane from the face [m], ascending, shape (k,)."""
    points: NDArray[np.float32]
    """Centres of the cells, in coordinates of the face (:mod:`capsense.field.face`) [m], (c, 3)."""
    areas: NDArray[np.float32]
    """Their areas [m²], shape (c,)."""
    terminal: NDArray[np.int64]
    """Terminal of each cell, -1 for grounded sheets, ascending, shape (c,)."""
    series: NDArray[np.float32]
    """Distance that adds to z in series [m]: (z + series) T is nearly constant, shape (c,)."""
    columns: NDArray[np.int64]
    """Terminals j of the columns of each terminal (the last row: of grounded sheets), -1 for none,
    shape (t + 1, n)."""
    change: NDArray[np.float32]
    """(z + series) T_ij / eps0, with the plane at 1 V in the last column, shape (c, k, n + 1)."""
    blocks: NDArray[np.int64]
    """First cell of each block of neighbouring cells of one terminal, ascending, shape (q,)."""
    pressed: PressedTable | None = None
    """What compression of the cover changes, if it gives way."""


_PREFIX, _PRESSED = "gap_", "pressed_"


def to_arrays(table: GapTable) -> dict[str, NDArray[Any]]:
    """All of a table, each name after ``gap_`` or ``pressed_``; changes in half precision."""
    own = {name: value for name, value in vars(table).items() if name != "pressed"}
    out = {_PREFIX + name: np.asarray(value) for name, value in own.items()}
    change = np.asarray(table.change).transpose(2, 1, 0)  # packs better
    out[_PREFIX + "change"] = change.astype(np.float16)
    if table.pressed is not None:
        out |= {_PRESSED + name: np.asarray(value) for name, value in vars(table.pressed).items()}
        for name in ("change", "sheet_density"):
            out[_PRESSED + name] = out[_PRESSED + name].astype(np.float16)
    return out


def from_arrays(arrays: Mapping[str, Any]) -> GapTable | None:
    """Undo :func:`to_arrays`; None where there is no table."""
    if _PREFIX + "change" not in arrays:
        return None
    own = [f.name for f in fields(GapTable) if f.name != "pressed"]
    values: dict[str, Any] = {name: np.asarray(arrays[_PREFIX + name]) for name in own}
    change = np.ascontiguousarray(values["change"].transpose(2, 1, 0), np.float32)
    numbers = {name: float(values[name]) for name in ("validity", "top")}
    if _PRESSED + "strains" in arrays:
        parts = {f.name: np.asarray(arrays[_PRESSED + f.name]) for f in fields(PressedTable)}
        for name in ("change", "sheet_density"):
            parts[name] = np.ascontiguousarray(parts[name], np.float32)
        values["pressed"] = PressedTable(**parts)
    return GapTable(**{**values, **numbers, "change": change})
