"""Contact mechanics of a step: how deep bodies lie in the cover, and which forces it carries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capsense.cover import (
    Cover,
    Touch,
    Viscosity,
    compression,
    contact_force,
    depth_of_force,
)
from capsense.field.green_kernels import Gap
from capsense.scene.scene import Body
from capsense.surface.touch_kernels import extents, undersides

Array = NDArray[np.float64]

_COARSE, _FINE = 16, 32
"""Cells along each side of the grid that finds a contact, and of that which it is integrated on."""
_EXACT = 1e-4
"""How exactly heights are found, over the cover's thickness."""


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
    """How much lower it stands than its pose says, in the length unit."""


class CoverContact:
    """How bodies are pressed into a cover, step by step.

    Args:
        cover: The cover, in a length unit.
        gap: Cells of the design's gap table, in the same unit.
        electrodes: How many of its terminals are electrodes, the first ones.
        unit: The length unit [m].
    """

    def __init__(self, cover: Cover, gap: Gap, electrodes: int, unit: float) -> None:
        self.cover, self._electrodes, self._unit = cover, electrodes, unit
        some = (gap.terminal >= 0) & (gap.terminal < electrodes) & (gap.soft.below >= 0.0)
        self._points = np.ascontiguousarray(gap.points[some], np.float64)
        self._areas, self._owner = unit**2 * gap.areas[some].astype(float), gap.terminal[some]
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
            height, area = self._heights(records[rows], spans[rows], held)
            if not np.isfinite(height).any():
                continue
            state = self._state(body.name or k, time)
            touching.add(body.name or k)
            depth, law, t = 0.0, self.cover.law, self.cover.thickness
            if held:
                depth = self._depth(height, area, float(body.force or 0.0), state, time)
                records["position"][rows, 2] -= depth
            elastic = contact_force(height, area, depth, t, law)
            now = elastic if state is None or time is None else state.force(elastic, time)
            found.append(Pressed(rows, held, elastic, depth))
            if elastic > 0.0:
                own, deep = self._electrode_forces(records[rows])
                force += own * (now / elastic)
                deepest = np.maximum(deepest, deep)
                total += now
        if time is not None:
            for name, state in self._states.items():
                if name not in touching:
                    state.force(0.0, time)
        return Touch(force, self._unit * deepest, total), found

    def lower(self, records: NDArray[np.void], pressed: Pressed) -> None:
        """Put a body that a force holds to the height at which it is carried.

        ``records`` are its own, at the height of its pose; see :class:`Pressed`.
        """
        height, area = self._heights(records, extents(records), True)
        if np.isfinite(height).any():
            records["position"][:, 2] -= self._depth(height, area, pressed.elastic, None, None)

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

    def _heights(self, rows: NDArray[np.void], spans: Array, held: bool) -> tuple[Array, Array]:
        """Heights of a body's underside over the cover's face, and areas of the cells [m²].

        Of the cells that it may be pressed into; where a force holds it, of those that are at most
        the cover's thickness higher than the lowest one.
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
        height = undersides(rows, points, highest, exact) - top
        return height, np.full(len(height), self._unit**2 * size.prod())

    def _depth(
        self, height: Array, area: Array, force: float, state: Viscosity | None, time: float | None
    ) -> float:
        """How far a body has to be lowered for a force to be carried, in the length unit."""
        if state is not None and time is not None:
            force = state.elastic(force, time)
        if force <= 0.0:  # to where it just touches, if it is in the cover
            return min(0.0, float(height.min()))
        return depth_of_force(height, area, force, self.cover.thickness, self.cover.law)

    def _electrode_forces(self, rows: NDArray[np.void]) -> tuple[Array, Array]:
        """Elastic forces [N] and largest compressions above the electrodes, (m,) each."""
        cover, top = self.cover, float(self.cover.upper[2])
        height = undersides(rows, self._points, top, _EXACT * cover.thickness) - top
        strain = np.maximum(-height, 0.0) / cover.thickness
        force = np.bincount(self._owner, self._areas * cover.law.pressure(strain), self._electrodes)
        deep = np.zeros(self._electrodes)
        np.maximum.at(deep, self._owner, compression(height, 0.0, cover.thickness, cover.law))
        return force.astype(float), deep

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
