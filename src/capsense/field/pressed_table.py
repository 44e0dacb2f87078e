"""What compression of a cover changes: boundary elements of the design with a thinner cover.

A conducting plane lies on the cover, or the fabric that it has. From its undeformed thickness on,
at some strains, follow the charge densities of the terminals below it, and those of the fabric.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from capsense.constants import EPS0
from capsense.cover import NONE, Cover
from capsense.design.geometry import level_rectangle
from capsense.design.model import Conductor, Design, Role
from capsense.field.boundary import POWER, Accuracy, BoundarySolution, terminals
from capsense.field.panels import PLANE_TOL, samples
from capsense.field.plane_tables import GapTable, PressedTable

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Ints = NDArray[np.int64]

_STRAINS = 0.0, 0.25, 0.5, 0.75, 0.95
"""Compression over thickness that is solved for."""
_MOST = 2000
"""About the most boundary elements of each of these."""
_CELL = 0.5
"""Size of the cells of a fabric, over the cover's thickness."""
_CELLS = 4000
"""At most about so many of these."""
_SEEN = 4
"""So many terminals are kept for each of them, those that it screens most."""
_PLANE = "plane on the cover"


def pressed_design(design: Design, cover: Cover, strain: float) -> Design:
    """A design whose cover is compressed all over, below its fabric or a plane as a shield."""
    top = cover.upper - [0.0, 0.0, strain * cover.thickness]
    layers = [
        replace(la, upper=top) if la.name == cover.name else la for la in design.layers
    ]  # fmt: skip
    surface = level_rectangle(cover.lower[:2], cover.upper[:2], top[2])
    if cover.top == NONE:
        conductors = [*design.conductors, Conductor(_PLANE, Role.SHIELD, surface)]
    else:
        conductors = [
            replace(c, surface=surface) if c.name == f"{cover.name} top" else c
            for c in design.conductors
        ]
    return replace(design, layers=tuple(layers), conductors=tuple(conductors))


def pressed_table_of(
    solution: BoundarySolution,
    panel_scale: float,
    table: GapTable,
    progress: Callable[[str], None] = lambda _: None,
) -> PressedTable:
    """Work out what compression changes.

    Args:
        solution: The boundary elements of the design.
        panel_scale: Size of their panels, as :class:`~capsense.field.boundary.Accuracy` has it.
        table: The gap table of the design.
        progress: Called with what is being done.
    """
    design = solution.design
    cover = design.cover
    assert cover is not None
    scale = max(panel_scale, (max(solution.model.panels.size, 1) / _MOST) ** (1 / POWER))
    names = terminals(design)
    found: list[BoundarySolution] = []
    free: list[Array] = []
    for k, strain in enumerate(_STRAINS):
        progress(f"response to compression: {k + 1} of {len(_STRAINS)}")
        pressed = pressed_design(design, cover, strain)
        found.append(BoundarySolution(pressed, Accuracy(scale)))
        order = terminals(pressed)
        columns = [order.index(n) for n in names]
        columns += [order.index(_PLANE)] if _PLANE in order else []
        unit = np.eye(len(order))[:, columns]
        density = found[-1].free_densities(found[-1].densities(unit))
        free.append(density * cover.thickness / EPS0)
    strains = np.array(_STRAINS)
    if cover.top == NONE:
        change = _on_cells(found, free, table, names)
        none = np.zeros((0, _SEEN))
        return PressedTable(
            strains, change, np.zeros((0, 2), np.float32), np.zeros(0, np.float32),
            none.astype(np.int64), np.zeros((0, len(strains), _SEEN), np.float32),
        )  # fmt: skip
    sheet = _on_fabric(found, free, cover)
    return PressedTable(strains, np.zeros((0, len(strains), 1), np.float32), *sheet)


def _on_cells(
    found: list[BoundarySolution], free: list[Array], table: GapTable, names: list[str]
) -> Single:
    """Changes of the densities on the cells of the gap table, shape (c, k, n + 1)."""
    t = len(names)
    take = np.concatenate([table.columns, np.full((len(table.columns), 1), t)], axis=1)
    take = take[table.terminal]
    far = 10.0 * float(np.ptp(table.points, axis=0).max())
    out = np.zeros((len(table.areas), len(found), take.shape[1]))
    for k, (solution, density) in enumerate(zip(found, free, strict=True)):
        order = terminals(solution.design)
        owner = solution.model.owner[: solution.model.sheet_panels]
        lookup = np.array([names.index(n) if n in names else -9 for n in order] + [-1])
        mine = lookup[owner]  # the last one is that of grounded sheets
        values = _cell_means(solution, mine, density, table, far)
        kept = np.take_along_axis(values, np.maximum(take, 0), axis=1)
        out[:, k] = np.where(take >= 0, kept, 0.0)
    return (out - out[:, :1]).astype(np.float16).astype(np.float32)


def _cell_means(
    solution: BoundarySolution, owner: Ints, density: Array, table: GapTable, far: float
) -> Array:
    """Mean densities on the cells of a gap table, of panels of the same terminals."""
    size = 0.5 * float(np.sqrt(np.median(table.areas)))
    panel, points, area = samples(solution.model.panels, solution.model.sheet_panels, size)
    some = owner[panel] > -9
    panel, points, area = panel[some], points[some], area[some]

    def placed(where: Array, terminal: Ints) -> Array:
        return np.column_stack([where[:, :2], where[:, 2] + far * (terminal + 1.0)])

    cells = placed(np.asarray(table.points, float), table.terminal)
    spots = placed(points, owner[panel])
    cell = cKDTree(cells).query(spots)[1]
    total = np.bincount(cell, area, len(cells))
    sums = np.stack([np.bincount(cell, area * d, len(cells)) for d in density[panel].T], axis=1)
    empty = total <= 0.0
    if empty.any():
        nearest = cKDTree(spots).query(cells[empty])[1]
        sums[empty], total[empty] = density[panel[nearest]], 1.0
    return np.asarray(sums / total[:, None])


def _on_fabric(
    found: list[BoundarySolution], free: list[Array], cover: Cover
) -> tuple[Single, Single, Ints, Single]:
    """Cells of a fabric, and the densities on them."""
    extent = cover.upper[:2] - cover.lower[:2]
    size = max(_CELL * cover.thickness, float(np.sqrt(extent.prod() / _CELLS)))
    count = np.maximum(1, np.ceil(extent / size)).astype(int)
    cells = int(count.prod())
    values: list[Array] = []
    for solution, density in zip(found, free, strict=True):
        panels = solution.model.panels
        panel, points, area = samples(panels, solution.model.sheet_panels, 0.3 * size)
        top = next(la.upper[2] for la in solution.design.layers if la.name == cover.name)
        some = np.abs(points[:, 2] - top) < PLANE_TOL
        panel, points, area = panel[some], points[some], area[some]
        place = np.floor((points[:, :2] - cover.lower[:2]) / (extent / count)).astype(int)
        place = np.clip(place, 0, count - 1)
        cell = place[:, 0] * count[1] + place[:, 1]
        total = np.bincount(cell, area, cells)
        values.append(np.stack(
            [np.bincount(cell, area * d, cells) for d in density[panel].T], axis=1
        ) / np.maximum(total, 1e-300)[:, None])  # fmt: skip
    x, y = np.meshgrid(*(np.arange(n) + 0.5 for n in count), indexing="ij")
    points = cover.lower[:2] + np.stack([x.ravel(), y.ravel()], axis=1) * extent / count
    density = np.stack(values, axis=1)  # (f, k, t)
    most = np.abs(density).max(axis=1)
    best = np.argsort(-most, axis=1, kind="stable")[:, :_SEEN]
    seen = np.take_along_axis(most, best, axis=1) > 3e-3 * most.max()
    if best.shape[1] < _SEEN:
        wide = ((0, 0), (0, _SEEN - best.shape[1]))
        best, seen = np.pad(best, wide), np.pad(seen, wide)
    kept = np.take_along_axis(density, best[:, None], axis=2) * seen[:, None]
    some = seen.any(axis=1)
    return (
        points[some].astype(np.float32),
        np.full(int(some.sum()), extent.prod() / cells, np.float32),
        np.where(seen, best, -1)[some],
        kept[some].astype(np.float16).astype(np.float32),
    )
