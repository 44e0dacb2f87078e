"""A cover that gives way, as the kernels take it: what lies between it and each cell below."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from capsense._by_reference import by_reference
from capsense.cover import NONE
from capsense.design.model import Design
from capsense.field.gap_table import GapTable
from capsense.field.panels import PLANE_TOL

Array = NDArray[np.float64]

BODY, FABRIC = 0, 1
"""Codes of :attr:`Soft.top`."""


@by_reference
class Soft(NamedTuple):
    """The cover of a flat design; its thickness is 0 if it has none."""

    thickness: float
    """Undeformed thickness [m]."""
    eps: float
    """Relative permittivity."""
    limit: float
    """Largest compression [m]."""
    top: int
    """What comes nearer as it is compressed: the body, or a fabric."""
    spread: float
    """Bending length of the fabric on it [m]; 0 for none."""
    below: NDArray[Any]
    """Thickness over permittivity of what lies between each cell of the gap table and the cover
    [m]; -1 where the cover is not above it, or a conductor is between them, shape (c,)."""
    bottom: float
    """Height of its lower face [m]."""
    strains: NDArray[Any]
    change: NDArray[Any]
    sheet_points: NDArray[Any]
    sheet_areas: NDArray[Any]
    sheet_terminals: NDArray[Any]
    sheet_density: NDArray[Any]
    """These as in :class:`~capsense.field.pressed_table.PressedTable`."""


def no_soft(count: int) -> Soft:
    """For designs without a cover, whose table has a number of cells."""
    none = np.zeros(0, np.float32)
    return Soft(
        0.0, 1.0, 0.0, BODY, 0.0, np.full(count, -1.0, np.float32), 0.0, np.zeros(2),
        np.zeros((0, 2, 1), np.float32), np.zeros((0, 2), np.float32), none,
        np.zeros((0, 1), np.int64), np.zeros((0, 2, 1), np.float32),
    )  # fmt: skip


def pack_soft(table: GapTable, design: Design) -> Soft:
    """The cover of a design, for the cells of its gap table."""
    cover, pressed = design.cover, table.pressed
    if cover is None or pressed is None:
        return no_soft(len(table.areas))
    points, bottom = np.asarray(table.points, float), float(cover.lower[2])
    over = (points[:, :2] > cover.lower[:2]).all(axis=1) & (points[:, 2] < bottom + PLANE_TOL)
    over &= (points[:, :2] < cover.upper[:2]).all(axis=1)
    for sheet in design.sheets:
        height = float(sheet.surface.bounds[1, 2])
        if height > bottom + PLANE_TOL:
            continue  # on the cover
        behind = over & (points[:, 2] < height - PLANE_TOL)
        for facet in sheet.surface.facets:
            if behind.any() and abs(facet.axes[2, 2]) > 0.5:
                over &= ~(behind & shapely.contains_xy(facet.footprint, *points[:, :2].T))
    below = np.zeros(len(points))
    for layer in design.layers:
        if layer.name == cover.name:
            continue
        inside = (points[:, :2] > layer.lower[:2]) & (points[:, :2] < layer.upper[:2])
        thick = np.minimum(bottom, layer.upper[2]) - np.maximum(points[:, 2], layer.lower[2])
        air = np.where(inside.all(axis=1), np.maximum(thick, 0.0), 0.0)
        below += air * (1.0 / layer.eps_r - 1.0)
    below += np.maximum(bottom - points[:, 2], 0.0)
    return Soft(
        cover.thickness, cover.eps_r, cover.limit, BODY if cover.top == NONE else FABRIC,
        cover.bending_length, np.where(over, np.maximum(below, 0.0), -1.0).astype(np.float32),
        bottom, pressed.strains, np.ascontiguousarray(pressed.change, np.float32),
        np.ascontiguousarray(pressed.sheet_points, np.float32),
        np.ascontiguousarray(pressed.sheet_areas, np.float32),
        np.ascontiguousarray(pressed.sheet_terminals, np.int64),
        np.ascontiguousarray(pressed.sheet_density, np.float32),
    )  # fmt: skip
