"""Boundary-element solution of a sensor in its grounded box, without any object in it.

Unknowns are the total (free and bound) charge densities on every conducting sheet, dielectric
interface and box wall; the floor is met by image charges. Potentials can then be evaluated at any
point, close to the electrodes as well as far away, without a volume mesh.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from shapely.geometry import Polygon

from capsense.constants import UNIT
from capsense.design.geometry import Facet
from capsense.design.model import LOCAL_GROUND, Conductor, Design, Electrode, Role
from capsense.errors import FieldError
from capsense.field import bem_kernels as kernels
from capsense.field.bem_kernels import Panels
from capsense.field.panels import (
    FAR_PLANE,
    Grading,
    concatenate,
    cut_facet,
    interfaces,
    make_panels,
    plane_spacings,
    smallest_gaps,
    thickness_of,
    walls,
)

Array = NDArray[np.float64]

GROUND, INTERFACE = -1, -2
"""Owners of panels that belong to no terminal."""

_MAX_PANELS = 16_000
_FEW_FACETS = 64
"""Sheets of more facets than this are curved; their facets are not searched for narrow gaps."""
_FEW, _MANY = 3_000, 9_000
"""Designs of fewer panels are cut finer, those of more coarser: a build takes no hours."""
_FINEST, _COARSEST = 0.5, 8.0
"""The finest, and where the search begins, as multiples of the default sizes."""
POWER = 1.7
"""The number of panels goes with their size to minus this power, about."""


@dataclass(frozen=True)
class Accuracy:
    """Panel sizes of the boundary-element solution, as multiples of the default."""

    scale: float = 1.0
    """Larger is coarser and faster."""
    fitted: bool = True
    """Whether designs of few panels are cut finer, and those of many coarser."""


@dataclass(frozen=True, eq=False)
class BoundaryModel:
    """Panels of a design, who owns them, and the permittivity on both sides."""

    panels: Panels
    owner: NDArray[np.int64]
    """Terminal index of each panel, or ``GROUND`` or ``INTERFACE``, shape (n,)."""
    eps_front: Array
    """Relative permittivity on the side the normal points to, shape (n,)."""
    eps_back: Array
    """Relative permittivity on the other side, shape (n,)."""
    floor: float
    """Height of the grounded floor [m]."""
    n_terminals: int
    sheets: tuple[tuple[tuple[Facet, int], Grading], ...]
    """Facets of all sheets with their owners, and how finely they are cut."""
    sheet_panels: int
    """Panels of sheets, which come first."""


def eps_at(design: Design, points: Array) -> Array:
    """Relative permittivity of a design at points [m], shape (..., 3) -> (...)."""
    flat = points.reshape(-1, 3)
    eps = np.ones(len(flat))
    for layer in design.layers:
        eps[layer.contains(flat)] = layer.eps_r
    return eps.reshape(points.shape[:-1])


def room_scale(design: Design) -> float:
    """How many times as large as one of 0.5 m the box is: walls are so much coarser."""
    return float(min(design.domain.size)) / 0.5


def terminals(design: Design) -> list[str]:
    """Names of the conductors apart from earth: electrodes, then shields, then floating ones.

    The last one is the local ground of a design whose conductors at ground are not earthed.
    """
    extra = [
        c for role in (Role.SHIELD, Role.FLOATING) for c in design.conductors if c.role == role
    ]
    local = [LOCAL_GROUND] if design.local_ground else []
    return [*design.electrode_names, *(c.name for c in extra), *local]


def terminal_of(sheet: Electrode | Conductor, design: Design) -> int:
    """Number of a sheet's terminal among :func:`terminals`, ``GROUND`` for earth."""
    names = terminals(design)
    if isinstance(sheet, Conductor) and sheet.role == Role.GROUND:
        return len(names) - 1 if design.local_ground else GROUND
    return names.index(sheet.name)


def build_model(design: Design, accuracy: Accuracy | None = None) -> BoundaryModel:
    """Cut all conductors, interfaces and walls of a design into panels.

    Raises:
        FieldError: The design needs more panels than fit in memory.
    """
    accuracy = accuracy or Accuracy()
    scale = accuracy.scale
    if accuracy.fitted:
        fitted = _fitted(design)
        scale *= fitted if scale <= 1.0 else max(fitted, 1.0)
    model = _cut(design, scale)
    if model.panels.size > _MAX_PANELS:
        raise FieldError(
            f"design {design.name!r} needs {model.panels.size} boundary panels, more than the "
            f"{_MAX_PANELS} that fit in memory; lower [build] resolution, simplify its outlines or "
            "coarsen its STL files"
        )
    return model


def build_cost(panels: int) -> tuple[float, float]:
    """Estimated processor time [s] and memory [byte] of building a field of so many panels.

    From builds of 297 panels (5 s, ``docs/tutorials/electrodes.md``), of 2,957 (26 s,
    ``three_stripes``), of 6,228 (48 s, ``six_patch``) and of 9,013 (3.2 GB), on two slow cores.
    """
    return 4.0 + 6.5e-3 * panels + 1.5e-11 * panels**3, 4e8 + 33.0 * panels**2


def _fitted(design: Design) -> float:
    """Panel sizes that a design can afford, as multiples of the default: 1 for most.

    Sizes are halved from the coarsest on, so that no cut has many more panels than are allowed.
    """

    def count_at(scale: float) -> int:
        return sum(len(part.pieces) for part in _pieces(design, scale))

    scale, count = _COARSEST, count_at(_COARSEST)
    while scale > 1.0 and count * 2**POWER < 1.5 * _MANY:
        scale /= 2
        count = count_at(scale)
    if scale > 1.0 or count > _MANY:
        return scale * (count / _MANY) ** (1 / POWER)
    return float(np.clip((count / _FEW) ** (1 / POWER), _FINEST, 1.0))


class _CutFacet(NamedTuple):
    """A facet that is cut, one panel a piece."""

    facet: Facet
    owner: int
    grading: Grading
    pieces: list[Polygon]


def _pieces(design: Design, scale: float) -> list[_CutFacet]:
    """Cut facets of sheets, then interfaces, then walls into pieces of the default sizes times
    ``scale``."""
    sheets: list[tuple[Facet, int]] = []
    flat: list[bool] = []
    for body in design.sheets:
        owner = terminal_of(body, design)
        for facet in body.surface.facets:
            sheets.append((facet, owner))
            flat.append(len(body.surface.facets) <= _FEW_FACETS)
    rims = np.concatenate([b.surface.rims for b in design.sheets])
    gaps, spacings = np.full(len(sheets), np.inf), np.full(len(sheets), FAR_PLANE)
    few = np.flatnonzero(flat)
    if len(few):
        gaps[few] = smallest_gaps([sheets[k] for k in few])
        spacings[few] = plane_spacings([sheets[k] for k in few])
    thin = min((thickness_of(la) for la in design.layers), default=math.inf)
    out: list[_CutFacet] = []

    def add(facet: Facet, owner: int, grading: Grading, reach: float) -> None:
        out.append(_CutFacet(facet, owner, grading, cut_facet(facet, rims, grading, reach)))

    for (facet, owner), gap, spacing in zip(sheets, gaps, spacings, strict=True):
        add(facet, owner, sheet_grading(facet, gap, spacing, scale), 2.5 * spacing)
    reach = 2.5 * thin if math.isfinite(thin) else 0.0
    for facet, thickness in interfaces(design, [facet for facet, _ in sheets]):
        edge = scale * min(3e-4, 0.3 * thickness)
        largest = scale * min(0.006, max(1.25 * thickness, 0.001))
        largest = max(largest, scale * 0.01 * _extent(facet))
        add(facet, INTERFACE, _grading(facet, edge, largest, scale), reach)
    for facet in walls(design):
        add(facet, GROUND, _wall_grading(design, scale), 0.0)
    return out


def _cut(design: Design, scale: float) -> BoundaryModel:
    """Cut a design into panels of the default sizes times ``scale``."""
    parts = _pieces(design, scale)
    sheets = parts[: sum(len(body.surface.facets) for body in design.sheets)]
    owners = [np.full(len(part.pieces), part.owner, np.int64) for part in parts]
    panels = concatenate([make_panels(p.facet, p.pieces) for p in parts if p.pieces])
    step = 1e-7 * panels.normals
    front, back = (eps_at(design, panels.centers + side * step) for side in (1, -1))
    return BoundaryModel(
        panels, np.concatenate(owners), front, back, design.domain.floor, len(terminals(design)),
        tuple(((p.facet, p.owner), p.grading) for p in sheets), sum(len(p.pieces) for p in sheets),
    )  # fmt: skip


def sheet_grading(facet: Facet, gap: float, spacing: float, scale: float) -> Grading:
    """How finely a conducting sheet is cut, by its distance from others in its plane, and from
    parallel ones [m]."""
    width = 2 * facet.polygon.area / facet.polygon.length
    coarse = max(5e-5, 5e-4 * _extent(facet))
    edge = scale * max(min(0.01 * width, 0.075 * gap, coarse), 5e-6)
    largest = scale * min(max(0.005, 0.05 * width), max(2 * spacing, 0.001))
    return _grading(facet, edge, largest, scale)


def _wall_grading(design: Design, scale: float) -> Grading:
    size = room_scale(design)
    return Grading(0.01 * size, largest=scale * 0.04 * size)


def _grading(facet: Facet, edge: float, largest: float, scale: float) -> Grading:
    """Long thin panels along straight rims, as fine as the facet's size asks for."""
    extent = _extent(facet)
    smallest = scale * min(max(0.08 * extent, 3e-4), max(2.5e-3, 0.02 * extent))
    return Grading(edge, smallest=smallest, largest=max(largest, 1.01 * smallest))


def _extent(facet: Facet) -> float:
    """The longer side of a facet's bounding rectangle [m]."""
    x0, y0, x1, y1 = facet.polygon.bounds
    return float(max(x1 - x0, y1 - y0))


class BoundarySolution:
    """A factorised boundary-element system of one design."""

    def __init__(
        self,
        design: Design,
        accuracy: Accuracy | None = None,
        progress: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.design = design
        self.model = build_model(design, accuracy)
        panels, owner = self.model.panels, self.model.owner
        progress(f"boundary elements: {panels.size} panels")
        self.contrast = (self.model.eps_front - self.model.eps_back) / (
            self.model.eps_front + self.model.eps_back
        )
        self._interfaces = np.flatnonzero(owner == INTERFACE)
        self.kind = np.where(owner == INTERFACE, 1 + any(k.facets != () for k in design.layers), 0)
        matrix = kernels.system_matrix(self.kind, self.contrast, self.model.floor, panels)
        progress("boundary elements: factorising")
        # Its transpose lies in memory as LAPACK has it, and is overwritten.
        self._lu = scipy.linalg.lu_factor(matrix.T, overwrite_a=True, check_finite=True)

    def densities(self, potentials: Array, sources: Array | None = None) -> Array:
        """Total charge densities [C/m²] on all panels.

        ``potentials``: terminal potentials [V], shape (terminals, k). ``sources``: optional points
        [m], shape (k, 3), one a column, where a point charge of 4π eps0 · 1 V·m sits.
        """
        panels, owner = self.model.panels, self.model.owner
        rhs = np.zeros((panels.size, potentials.shape[1]))
        driven = owner >= 0
        rhs[driven] = potentials[owner[driven]]
        if sources is not None:
            points = np.ascontiguousarray(sources)
            rhs += self._source_terms(self._potentials(points), self._fluxes(points))
        return UNIT * self.solve(rhs)

    def solve(self, sides: Array) -> Array:
        """Charge densities over 4π eps0 of right-hand sides in the order of the panels, (n, k)."""
        matrix, pivots = self._lu
        # SciPy counts pivots up while LAPACK has them, and down again: each thread has its own.
        return np.asarray(scipy.linalg.lu_solve((matrix, pivots.copy()), sides, trans=1))

    def answers(self, points: Array) -> Answers:
        """What point charges at points [m] draw while all terminals are at ground, (n, 3)."""
        return Answers(self, np.ascontiguousarray(points))

    def _potentials(self, points: Array) -> Array:
        """Potentials at points of unit densities, times 4π eps0, (n, 3) -> (n, panels)."""
        return kernels.potential_matrix(points, self.model.floor, self.model.panels)

    def _fluxes(self, points: Array) -> Array:
        """Fluxes of unit 1/r sources at points through the panels of interfaces, (n, rows)."""
        rows, model = self._interfaces, self.model
        if not len(rows):
            return np.empty((len(points), 0))
        return kernels.flux_matrix(points, rows, model.floor, model.panels)

    def _source_terms(self, potentials: Array, fluxes: Array) -> Array:
        """Right-hand sides of unit 1/r sources and their images, means over panels, (panels, k).

        Of sources with other charges, by :meth:`_potentials` and :meth:`_fluxes` times these.
        """
        rhs = np.negative(potentials).T  # as LAPACK has it
        if len(self._interfaces):
            # sigma / (2 eps0) + contrast E_n = 0 with E_n of the source moved to the right
            rhs[self._interfaces] = self.contrast[self._interfaces, None] * fluxes.T
        rhs /= self.model.panels.areas[:, None]
        return rhs

    def free_densities(self, densities: Array) -> Array:
        """Free charge density [C/m²] on the panels of conductors, of total densities, (n, k)."""
        model, panels = self.model, self.model.panels
        mean = 0.5 * (model.eps_front + model.eps_back)
        jump = model.eps_front - model.eps_back
        free = mean[:, None] * densities
        rows = np.flatnonzero((model.owner != INTERFACE) & (np.abs(jump) > 1e-12))
        if len(rows):
            grad = kernels.normal_gradient_matrix(rows, model.floor, panels)
            # eps0 E_n = -grad . n sigma / (4 pi)
            free[rows] -= jump[rows, None] * (grad @ densities) / (4 * math.pi)
        return free

    def terminal_charges(self, densities: Array) -> Array:
        """Free charge [C] on each terminal, shape (terminals, k)."""
        model = self.model
        charge = self.free_densities(densities) * model.panels.areas[:, None]
        out = np.zeros((model.n_terminals, densities.shape[1]))
        driven = model.owner >= 0
        np.add.at(out, model.owner[driven], charge[driven])
        return out

    def potential(self, points: Array, densities: Array, chunk: int = 2000) -> Array:
        """Potential [V] of charge densities at points [m], shape (n, 3) -> (n, k)."""
        out = np.empty((len(points), densities.shape[1]))
        scaled = densities / UNIT
        for start in range(0, len(points), chunk):
            block = np.ascontiguousarray(points[start : start + chunk])
            out[start : start + chunk] = self._potentials(block) @ scaled
        return out


class Answers:
    """Potentials at points of the charges that a grounded design answers with to charges there.

    They make a matrix D [1/m], shape (n, n): at each point, the potential of what a charge of 4π
    eps0 · 1 V·m at each of them draws, without that of the charge itself. D = P A⁻¹ T is never
    made as a whole: A is the system of the boundary elements, P the potentials of their panels at
    the points, and T their right-hand sides.

    Args:
        solution: The factorised boundary elements of the design.
        points: Where potentials and charges are [m], shape (n, 3).
    """

    def __init__(self, solution: BoundarySolution, points: Array) -> None:
        self._solution = solution
        self._potentials, self._fluxes = solution._potentials(points), solution._fluxes(points)

    def of_densities(self, densities: Array) -> Array:
        """Potentials of charge densities on the panels [C/m²] at the points [V], (n, k)."""
        return self._potentials @ (densities / UNIT)

    def by(self, charges: Array) -> Array:
        """D Q of charges Q at the points, shape (n, k) -> (n, k).

        It takes k solutions of the boundary elements, where all of D takes n.
        """
        return self._potentials @ self._drawn(charges.T @ self._potentials, charges)

    def between(self, charges: Array) -> Array:
        """Qᵀ D Q of charges Q at the points, shape (n, k) -> (k, k)."""
        sides = charges.T @ self._potentials
        return sides @ self._drawn(sides, charges)

    def _drawn(self, potentials: Array, charges: Array) -> Array:
        """Densities over 4π eps0 that charges draw, from their potentials too, (panels, k)."""
        fluxes = charges.T @ self._fluxes
        return self._solution.solve(self._solution._source_terms(potentials, fluxes))
