"""Contact mechanics of a step: how deep bodies lie in the cover, and which forces it carries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from capsense.cover import (
    Cover,
    Touch,
    Viscosity,
    compression,
    contact_force,
    depth_of_force,
)
from capsense.design.geometry import Surface
from capsense.scene.scene import Body
from capsense.surface.touch_kernels import extents, undersides

Array = NDArray[np.float64]

_COARSE, _FINE = 16, 32
"""Cells along each side of the grid that finds a contact, and of that which it is integrated on."""
_EXACT = 1e-4
"""How exactly heights are found, over the cover's thickness."""
_RASTER = 32
"""Cells along each side of the raster that an electrode's outline is kept on."""


@dataclass(frozen=True, eq=False)
class Pressed:
    """One body in contact with the cover."""

    rows: NDArray[np.intp]
    """Its records, shape (r,)."""
    held: bool
    """Whether a force holds it, rather than its pose."""
    elastic: float
    """What its force would be without relaxation and hysteresis [N]."""
    depth: float
    """How much lower it stands than its pose says [m]."""


@dataclass(frozen=True, eq=False)
class _Underside:
    """Of a body over the cover, on a grid of equal cells."""

    low: Array
    """Corner of the grid [m], shape (2,)."""
    size: Array
    """Size of a cell [m], shape (2,)."""
    height: Array
    """Over the cover's undeformed face at the middles [m], infinite beside the body, shape
    (:data:`_FINE`²,)."""

    @property
    def area(self) -> Array:
        """Areas of the cells [m²], shape (:data:`_FINE`²,)."""
        return np.full(len(self.height), self.size.prod())

    @property
    def edges(self) -> tuple[Array, Array]:
        """Edges of the cells along x and y [m], shape (:data:`_FINE` + 1,) each."""
        x, y = (self.low[i] + self.size[i] * np.arange(_FINE + 1) for i in range(2))
        return x, y


class _Outline:
    """The area of a level electrode, summed from its lower corner on."""

    def __init__(self, surface: Surface) -> None:
        self.low, self.high = surface.bounds[:, :2]
        points, size = _grid(self.low, self.high, _RASTER)
        inside, area = np.zeros(len(points), bool), 0.0
        for facet in surface.facets:
            outline = shapely.transform(facet.polygon, lambda uv, f=facet: f.to_sensor(uv)[:, :2])
            inside |= shapely.contains_xy(outline, points[:, 0], points[:, 1])
            area += outline.area
        share = area / (inside.sum() * size.prod()) if inside.any() else 0.0
        cells = (share * size.prod()) * inside.reshape(_RASTER, _RASTER)
        self._sums = np.pad(cells.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))

    def areas(self, x: Array, y: Array) -> Array:
        """What it has of the cells between edges (n,) and (m,) [m²], shape (n - 1, m - 1)."""
        along = self._weights(x, 0) @ self._sums @ self._weights(y, 1).T
        return np.diff(np.diff(along, axis=0), axis=1)

    def _weights(self, edges: Array, axis: int) -> Array:
        """Linear interpolation of the sums along an axis, shape (n, raster + 1)."""
        low, high = self.low[axis], self.high[axis]
        place = np.clip((edges - low) / (high - low), 0.0, 1.0)[:, None] * _RASTER
        return np.maximum(0.0, 1.0 - np.abs(place - np.arange(_RASTER + 1)))


class CoverContact:
    """How bodies are pressed into a cover, step by step.

    Args:
        cover: The cover.
        electrodes: The electrodes of the design, which are level.
    """

    def __init__(self, cover: Cover, electrodes: Sequence[Surface]) -> None:
        self.cover, self._electrodes = cover, len(electrodes)
        self._outlines = [_Outline(surface) for surface in electrodes]
        self._low = np.array([outline.low for outline in self._outlines])
        self._high = np.array([outline.high for outline in self._outlines])
        self._states: dict[str | int, Viscosity] = {}

    def reset(self) -> None:
        """Forget all contacts."""
        self._states.clear()

    def press(
        self,
        records: NDArray[np.void],
        chosen: NDArray[np.intp],
        bodies: Sequence[Body] | Mapping[int, Body],
        time: float | None = None,
    ) -> tuple[Touch, list[Pressed]]:
        """Lower or raise bodies that a force holds, and work out the forces.

        Args:
            records: Records of bodies or of parts of them, whose heights are changed, shape (n,).
            chosen: Body of each, ascending, shape (n,).
            bodies: The bodies.
            time: Time of the scene [s]; without it there is no relaxation and no hysteresis.
        """
        force, deepest = np.zeros(self._electrodes), np.zeros(self._electrodes)
        total = 0.0
        found: list[Pressed] = []
        touching: set[str | int] = set()
        spans = extents(records)
        for k, rows in self._near(spans, chosen, bodies):
            body = bodies[k]
            held = body.force is not None
            under = self._underside(records[rows], spans[rows], held)
            if not np.isfinite(under.height).any():
                continue
            state = self._state(body.name or k, time)
            touching.add(body.name or k)
            depth = 0.0
            if held:
                depth = self._depth(under, float(body.force or 0.0), state, time)
                records["position"][rows, 2] -= depth
            elastic = contact_force(
                under.height, under.area, depth, self.cover.thickness, self.cover.law
            )
            now = elastic if state is None or time is None else state.force(elastic, time)
            found.append(Pressed(rows, held, elastic, depth))
            if elastic > 0.0:
                self._share_out(under, depth, now / elastic, force, deepest)
                total += now
        if time is not None:
            for name, state in self._states.items():
                if name not in touching:
                    state.force(0.0, time)
        return Touch(force, deepest, total), found

    def lower(self, records: NDArray[np.void], pressed: Pressed) -> None:
        """Put a body that a force holds to the height at which it is carried.

        ``records`` are its own, at the height of its pose; see :class:`Pressed`.
        """
        under = self._underside(records, extents(records), True)
        if np.isfinite(under.height).any():
            records["position"][:, 2] -= self._depth(under, pressed.elastic, None, None)

    def _near(
        self,
        spans: Array,
        chosen: NDArray[np.intp],
        bodies: Sequence[Body] | Mapping[int, Body],
    ) -> list[tuple[int, NDArray[np.intp]]]:
        """Bodies that may touch the cover, and their records."""
        low, high, top = self.cover.lower, self.cover.upper, self.cover.upper[2]
        over = (spans[:, 0] < high[0]) & (spans[:, 1] > low[0])
        over &= (spans[:, 2] < high[1]) & (spans[:, 3] > low[1]) & (spans[:, 5] >= top)
        out = []
        for k in np.unique(chosen[over]).tolist():
            rows = np.flatnonzero(over & (chosen == k))
            force = bodies[k].force
            if force or spans[rows, 4].min() < top:
                out.append((k, rows))
        return out

    def _underside(self, rows: NDArray[np.void], spans: Array, held: bool) -> _Underside:
        """Find a body's underside over what it may be pressed into.

        Where a force holds it, over what is at most the cover's thickness higher than its lowest
        point.
        """
        cover, top = self.cover, float(self.cover.upper[2])
        exact = _EXACT * cover.thickness
        low = np.maximum(spans[:, [0, 2]].min(axis=0), cover.lower[:2])
        high = np.minimum(spans[:, [1, 3]].max(axis=0), cover.upper[:2])
        points, size = _grid(low, high, _COARSE)
        highest = float(spans[:, 5].max()) if held else top
        height = undersides(rows, points, highest, exact)
        if not np.isfinite(height).any():  # it may be smaller than a cell, or just touch
            fine = points
        else:
            limit = height.min() + cover.thickness if held else top
            fine = points[height < limit]
        low = np.maximum(low, fine.min(axis=0) - size)
        high = np.minimum(high, fine.max(axis=0) + size)
        points, size = _grid(low, high, _FINE)
        return _Underside(low, size, undersides(rows, points, highest, exact) - top)

    def _depth(
        self, under: _Underside, force: float, state: Viscosity | None, time: float | None
    ) -> float:
        """How far a body has to be lowered for a force to be carried [m]."""
        if state is not None and time is not None:
            force = state.elastic(force, time)
        if force <= 0.0:  # to where it just touches, if it is in the cover
            return min(0.0, float(under.height.min()))
        return depth_of_force(under.height, under.area, force, self.cover.thickness, self.cover.law)

    def _share_out(
        self, under: _Underside, depth: float, factor: float, force: Array, deepest: Array
    ) -> None:
        """Add a body's forces above the electrodes [N], and raise compressions to its own [m].

        ``factor`` is its force over the elastic one; the other arrays have shape (electrodes,).
        """
        thickness, law = self.cover.thickness, self.cover.law
        pressed = compression(under.height, depth, thickness, law).reshape(_FINE, _FINE)
        strain = np.maximum(depth - under.height, 0.0) / thickness
        pressure = factor * law.pressure(strain).reshape(_FINE, _FINE)
        x, y = under.edges
        below = (self._low < [x[-1], y[-1]]).all(axis=1) & (self._high > [x[0], y[0]]).all(axis=1)
        for k in np.flatnonzero(below).tolist():
            areas = self._outlines[k].areas(x, y)
            force[k] += float((areas * pressure).sum())
            deepest[k] = max(deepest[k], float(pressed[areas > 0.0].max(initial=0.0)))

    def _state(self, name: str | int, time: float | None) -> Viscosity | None:
        """What is remembered of a body's contact; None where nothing is."""
        cover = self.cover
        if time is None or not (cover.relaxation or cover.hysteresis):
            return None
        state = self._states.get(name)
        if state is None or time < state.time:
            state = self._states[name] = Viscosity(cover)
        return state


def _grid(low: Array, high: Array, count: int) -> tuple[Array, Array]:
    """Middles of count² equal cells of a rectangle [m], and their size, (count², 2) and (2,)."""
    size = (high - low) / count
    steps = np.arange(count) + 0.5
    x, y = (low[i] + size[i] * steps for i in range(2))
    return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2), size
