"""The first millimetres in front of a design: where its Green's function holds, and a table.

A compact Green's function does not resolve distances smaller than the spacing of its charges. The
boundary elements of the design do. A grounded plane is put in front of them, at some distances z,
by a Schur complement of their factorised system. From its charges follows T_ij(p, z): what the
plane changes in the charge density on terminal i at its point p, with terminal j, or the plane
itself, at 1 V. They also tell the validity distance h0, from which on the Green's function gives
the plane, and plates of the electrodes' size and less, the energy that they have.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.sparse import csr_array
from threadpoolctl import threadpool_limits

from capsense._thread_pool import processors
from capsense.constants import EPS0, UNIT
from capsense.design.model import Design
from capsense.field import bem_kernels as kernels
from capsense.field.bem_kernels import Panels
from capsense.field.boundary import (
    INTERFACE,
    POWER,
    Accuracy,
    BoundarySolution,
)
from capsense.field.face import plane_panels, sheet_on_face, top_of
from capsense.field.green import GreenFunction
from capsense.field.panels import (
    concatenate,
    samples,
)
from capsense.field.plane_tables import GapTable
from capsense.field.pressed_table import pressed_table_of

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Plate = tuple[Ints, slice]
"""Panels of a plane, and the electrodes in front of which they are."""

_HEIGHTS = 0.03 * 2.1 ** np.arange(8)
"""Distances of the plane, over the clearance of the Green's function."""
_SOUGHT = 0.25
"""The validity distance is sought from the first of these on that is larger than this."""
_EXACT = 0.02
"""Largest relative error of a plate's energy from the validity distance on."""
_PLATE = 0.5
"""Side of the small plates, over that of the electrodes."""
_MOST = 3500
"""About the most boundary elements that a table is made from."""
_BLOCK = 6
"""Cells lie in blocks of so many in a row."""
_DEEP = 3.0
"""Longest series distance, over the largest height."""
_MARGIN = 8.0
"""How far the plane reaches beyond the terminals, over the clearance."""
_CELL = 0.6
"""Size of the cells of the table, over the validity distance."""
_CELLS = 16_000
"""At most about so many cells."""
_AT_ONCE = 4
"""At most so many distances are solved for at a time: each takes memory."""
_PART = 500
"""So many panels at a time have their potentials averaged."""
_LEAST = 0.003
"""Columns that change less than this part of a terminal's own are left out."""


class GroundedPlane(NamedTuple):
    """A grounded plane in front of a design."""

    change: Array
    """What it changes in the free charge density on the design with each of t terminals, or the
    plane itself, at 1 V [C/m²], shape (n, t + 1)."""
    free: Array
    """Mean potentials of its panels by charges of each of them without the design, (m, m) …"""
    grounded: Array
    """… and with it at ground, (m, m): 4π eps0 = 1."""
    potential: Array
    """Their mean potentials with each terminal at 1 V, (m, t)."""


class PlaneResponse:
    """The boundary elements of a design with a plane in front of it.

    Args:
        solution: The factorised boundary elements of the design, of n panels.
    """

    def __init__(self, solution: BoundarySolution) -> None:
        self.solution, model = solution, solution.model
        jump = model.eps_front - model.eps_back
        self._rows = np.flatnonzero((model.owner != INTERFACE) & (np.abs(jump) > 1e-12))
        """Panels of sheets between two media."""
        self._gradient = kernels.normal_gradient_matrix(self._rows, model.floor, model.panels)

    def at(self, plane: Panels, densities: Array) -> GroundedPlane:
        """What a plane, or another grounded surface, does.

        Args:
            plane: Its m panels.
            densities: Densities of the design without it, with each of t terminals at 1 V [C/m²],
                shape (n, t).
        """
        solution, model = self.solution, self.solution.model
        n, m = model.panels.size, plane.size
        both = concatenate([model.panels, plane])
        kind = np.concatenate([solution.kind, np.zeros(m, np.int64)])
        contrast = np.concatenate([solution.contrast, np.zeros(m)])
        blocks = partial(kernels.system_block, kind, contrast, model.floor, both)
        # All blocks by the same quadrature: near contact their errors cancel, panel by panel.
        onto, own = blocks((n, n + m), (0, n)), blocks((n, n + m), (n, n + m))
        answer = solution.solve(blocks((0, n), (n, n + m)))
        sides = np.concatenate([-onto @ densities, np.full((m, 1), UNIT)], axis=1)
        grounded = own - onto @ answer
        on_plane = np.linalg.solve(grounded, sides)
        total = -answer @ on_plane
        out = 0.5 * (model.eps_front + model.eps_back)[:, None] * total
        if len(self._rows):
            jump = (model.eps_front - model.eps_back)[self._rows, None]
            gradient = (
                self._gradient @ total
                + kernels.normal_gradient_block(self._rows, model.floor, both, n) @ on_plane
            )
            out[self._rows] -= jump * gradient / (4 * math.pi)
        return GroundedPlane(out, own / plane.areas, grounded / plane.areas, -sides[:, :-1] / UNIT)


def table_solution(solution: BoundarySolution, panel_scale: float) -> BoundarySolution:
    """Boundary elements of the same design that a table can be made from: few enough of them.

    What a plane changes is found on the same panels with and without it.

    Args:
        solution: The factorised boundary elements of the design.
        panel_scale: Size of their panels, as :class:`~capsense.field.boundary.Accuracy` has it.
    """
    count = solution.model.panels.size
    if count <= _MOST:
        return solution
    scale = max(panel_scale, 1.0) * (count / _MOST) ** (1 / POWER)
    return BoundarySolution(solution.design, Accuracy(scale))


def gap_table_of(
    solution: BoundarySolution,
    panel_scale: float,
    green: GreenFunction,
    progress: Callable[[str], None] = lambda _: None,
) -> GapTable:
    """The table of a design, and what compression of its cover changes.

    Args:
        solution: Boundary elements, from :func:`table_solution`.
        panel_scale: As of the Green's function.
        green: The Green's function of the design, in their lengths.
        progress: Called with what is being done.
    """
    densities = solution.densities(np.eye(solution.model.n_terminals))
    table = build_gap_table(solution, densities, green.clearance, green, progress)
    if solution.design.cover is None:
        return table
    return replace(table, pressed=pressed_table_of(solution, panel_scale, table, progress))


def build_gap_table(
    solution: BoundarySolution,
    densities: Array,
    unit: float,
    green: GreenFunction | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> GapTable:
    """Work out what a plane near the face of a design changes, and from where on its G is valid.

    Args:
        solution: The factorised boundary elements of the design.
        densities: With each of its t terminals at 1 V [C/m²], shape (n, t).
        unit: Smallest distance that its Green's function was fitted at.
        green: That, in the same lengths. Without it, it counts as valid from there on.
        progress: Called with what is being done.
    """
    model = solution.model
    design, heights = solution.design, np.asarray(unit * _HEIGHTS, float)
    plane, top = plane_panels(solution, _MARGIN * unit), top_of(design)
    plates = plates_of(plane.panels, design)
    changes = np.empty((len(heights), model.sheet_panels, densities.shape[1] + 1))
    response, errors = PlaneResponse(solution), np.full(len(heights), np.inf)

    @threadpool_limits.wrap(limits=1, user_api="blas")  # with OpenMP it is one for each thread
    def solve(k: int) -> None:
        panels = plane.at(top + heights[k])
        found = response.at(panels, densities)
        changes[k] = found.change[: model.sheet_panels]
        if green is not None and heights[k] >= _SOUGHT * unit:
            errors[k] = energy_error(found, panels, plates, green)

    with ThreadPoolExecutor(min(_AT_ONCE, processors()), "capsense") as pool:
        parts = [pool.submit(solve, k) for k in range(len(heights))]
        try:
            for k, part in enumerate(parts):
                progress(f"response to a plane: {k + 1} of {len(heights)}")
                part.result()
        finally:
            for part in parts:  # after an interrupt, those that have not begun
                part.cancel()
    validity = unit if green is None else valid_from(heights, errors)
    return _cells_of(solution, changes, heights, top, validity, plane.panels)


def plates_of(plane: Panels, design: Design) -> list[Plate]:
    """All of a plane, and for each electrode plates of its size and of ``_PLATE`` of it.

    ``plane`` are the panels in coordinates of the face, m of them.
    """
    out: list[Plate] = [(np.arange(plane.size), slice(0, len(design.electrodes)))]
    for i, electrode in enumerate(design.electrodes):
        low, high = sheet_on_face(design, electrode.name).bounds[:, :2]
        off = np.abs(plane.centers[:, :2] - 0.5 * (low + high)) / (0.5 * (high - low))
        out += [(np.flatnonzero((off < x).all(axis=1)), slice(i, i + 1)) for x in (1.0, _PLATE)]
    return out


def energy_error(
    found: GroundedPlane, plane: Panels, plates: list[Plate], green: GreenFunction
) -> float:
    """Largest relative error that a Green's function makes of a plate's energy.

    Infinite where the plane's energies by it are not definite.
    """
    modes, potential = _means(green, plane)
    compact, grounded = found.free - modes @ modes.T, found.grounded
    try:
        factor = scipy.linalg.cho_factor(0.5 * (compact + compact.T), overwrite_a=True)
    except np.linalg.LinAlgError:
        return math.inf
    worst = 0.0
    for some, columns in plates:
        if len(some):
            phi, exact = potential[some, columns], found.potential[some, columns]
            part = np.ix_(some, some)
            one = (
                scipy.linalg.cho_solve(factor, phi)
                if len(some) == plane.size
                else _solved(compact[part], phi)
            )
            two = _solved(grounded[part], exact)
            worst = max(worst, float(np.abs((phi * one).sum(0) / (exact * two).sum(0) - 1).max()))
    return worst


def _solved(matrix: Array, sides: Array) -> Array:
    """Charges of panels, with what the quadrature lacks of the symmetry of their potentials."""
    return np.asarray(np.linalg.solve(0.5 * (matrix + matrix.T), sides))


def _means(green: GreenFunction, plane: Panels) -> tuple[Array, Array]:
    """Mean modes ψ and potentials φ⁰ over panels, shapes (m, modes) and (m, terminals)."""
    share = plane.weights / plane.weights.sum(axis=1, keepdims=True)
    parts = []
    for start in range(0, plane.size, _PART):
        some = slice(start, start + _PART)
        used = plane.weights[some] > 0.0  # panels of few corners have fewer points
        both = np.hstack(green.psi_and_phi0(plane.quad[some][used]))
        panel = np.repeat(np.arange(len(used)), used.sum(axis=1))
        where = panel, np.arange(len(panel))
        mean = csr_array((share[some][used], where), (len(used), len(panel)))
        parts.append(mean @ both)
    means = np.concatenate(parts)
    return means[:, : green.n_modes], means[:, green.n_modes :]


def valid_from(heights: Array, errors: Array) -> float:
    """Distance from which on errors stay below ``_EXACT``, or below the least that they reach.

    Between heights, errors follow a power law.
    """
    largest = 0.5 * float(heights[-1])  # the table reaches twice as far
    if not np.isfinite(errors).any():
        return largest
    limit = max(_EXACT, 1.25 * float(errors.min()))
    last = int(np.flatnonzero(errors <= limit)[-1])
    above = np.flatnonzero(errors[:last] > limit)
    first = int(above[-1]) + 1 if len(above) else 0
    if first == 0 or not math.isfinite(errors[first - 1]):
        return min(float(heights[first]), largest)
    x, y = np.log(heights[first - 1 : first + 1]), np.log(errors[first - 1 : first + 1])
    return min(float(np.exp(np.interp(-math.log(limit), -y, x))), largest)


def _cells_of(
    solution: BoundarySolution, changes: Array, heights: Array, top: float, validity: float,
    plane: Panels,
) -> GapTable:  # fmt: skip
    """Gather panels in cells of the table; ``changes`` [C/m²] has shape (k, p, t + 1)."""
    model, film = solution.model, solution.design.film
    areas = model.panels.areas[: model.sheet_panels]
    size = max(_CELL * validity, math.sqrt(areas[model.owner[: len(areas)] >= 0].sum() / _CELLS))
    panel, points, area = samples(model.panels, model.sheet_panels, 0.5 * size)
    if film is not None:  # what is behind it may reach all the way round
        points, ends = film.coordinates(points), plane.edges[..., :2].reshape(-1, 2)
        within = ((points[:, :2] > ends.min(axis=0)) & (points[:, :2] < ends.max(axis=0))).all(1)
        panel, points, area = panel[within], points[within], area[within]
    owner = model.owner[panel]
    place = np.floor((points - points.min(axis=0)) / size + 1e-6).astype(np.int64)
    key = np.column_stack([owner % (model.n_terminals + 1), place // _BLOCK, place])
    _, first, cell = np.unique(key, axis=0, return_index=True, return_inverse=True)
    _, blocks = np.unique(key[first, :4], axis=0, return_index=True)
    cell = cell.ravel()
    total = np.bincount(cell, area)
    centers = np.stack([np.bincount(cell, area * x) / total for x in points.T], axis=1)
    gather = csr_array((area / total[cell], (cell, panel)), (len(total), len(areas)))
    k, _, columns = changes.shape
    density = gather @ np.ascontiguousarray(changes.transpose(1, 0, 2)).reshape(len(areas), -1)
    density = density.reshape(len(total), k, columns) / EPS0
    terminal = owner[first]
    chosen = _columns_of(density, np.asarray(terminal), np.asarray(total, float), model.n_terminals)
    take = np.concatenate([chosen, np.full((len(chosen), 1), columns - 1)], axis=1)[terminal]
    kept = np.take_along_axis(density, np.maximum(take, 0)[:, None], axis=2)
    kept = np.where(take[:, None] >= 0, kept, 0.0)
    own = np.where(terminal >= 0, terminal, columns - 1)
    near = np.abs(density[np.arange(len(total)), :2, own])
    fall = np.maximum(near[:, 0] - near[:, 1], 1e-6 * near[:, 0] + 1e-300)
    series = (near[:, 1] * heights[1] - near[:, 0] * heights[0]) / fall
    series = np.clip(series, 0.0, _DEEP * heights[-1])
    scaled = kept * (heights[None, :] + series[:, None])[..., None]
    return GapTable(
        validity, top, heights, centers.astype(np.float32), total.astype(np.float32),
        terminal, series.astype(np.float32), chosen,
        scaled.astype(np.float16).astype(np.float32), np.sort(blocks),
    )  # fmt: skip


def _columns_of(density: Array, terminal: Ints, areas: Array, terminals: int) -> Ints:
    """The terminals j whose T_ij count, -1 for none, shape (terminals + 1, n)."""
    worth = np.zeros((terminals + 1, terminals))
    for i in range(-1, terminals):
        some = terminal == i
        moved = np.abs(np.einsum("c,ckj->kj", areas[some], density[some][..., :-1]))
        worth[i] = moved.max(axis=0, initial=0.0)
    worth[:-1] = np.maximum(worth[:-1], worth[:-1].T)
    worth[-1] = 0.0  # charge on grounded sheets is not read
    own = np.diag(worth[:-1]).max()
    wanted = worth > _LEAST * own
    n = max(1, int(wanted.sum(axis=1).max()))
    best = np.argsort(-worth, axis=1, kind="stable")[:, :n]
    return np.where(np.take_along_axis(wanted, best, axis=1), best, -1)
