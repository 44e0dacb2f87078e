"""Contact mechanics of a step: how deep bodies lie in the cover, and which forces it carries."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capsense.cover import Cover, Viscosity
from capsense.design.geometry import Surface
from capsense.reading import Touch
from capsense.scene.scene import Body
from capsense.solver.gap.touch_kernels import (
    contact_force,
    depth_of_force,
    electrode_forces,
    extents,
    foundation,
    heights,
    is_over,
)

Array = NDArray[np.float64]


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
        electrodes: The electrodes of the design, which are level, in the same unit.
        unit: The length unit [m].
    """

    def __init__(self, cover: Cover, electrodes: Sequence[Surface], unit: float) -> None:
        self.cover, self._electrodes, self._unit = cover, len(electrodes), unit
        self.foundation = foundation(cover, electrodes, unit)
        """The cover as the kernels take it."""
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
            height, grid = heights(records[rows], spans[rows], held, self.foundation)
            if not np.isfinite(height).any():
                continue
            state = self._state(body.name or k, time)
            touching.add(body.name or k)
            depth, area = 0.0, float(grid[2] * grid[3])
            if held:
                depth = self._depth(height, area, float(body.force or 0.0), state, time)
                records["position"][rows, 2] -= depth
            elastic = contact_force(height, area, depth, self.foundation)
            now = elastic if state is None or time is None else state.force(elastic, time)
            found.append(Pressed(rows, held, elastic, depth))
            if elastic > 0.0:
                own = np.zeros(self._electrodes)
                electrode_forces(height, grid, depth, self.foundation, own, deepest)
                force += own * (now / elastic)
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
        height, grid = heights(records, extents(records), True, self.foundation)
        if np.isfinite(height).any():
            area = float(grid[2] * grid[3])
            records["position"][:, 2] -= self._depth(height, area, pressed.elastic, None, None)

    def _near(
        self,
        spans: Array,
        chosen: NDArray[np.intp],
        bodies: Sequence[Body] | Mapping[int, Body],
    ) -> list[tuple[int, NDArray[np.intp]]]:
        """Bodies that may touch the cover, and their records."""
        top = self.cover.upper[2]
        over = np.array([is_over(span, self.foundation) for span in spans], bool)
        out = []
        for k in np.unique(chosen[over]).tolist():
            rows = np.flatnonzero(over & (chosen == k))
            force = bodies[k].force
            if force or spans[rows, 4].min() < top:
                out.append((k, rows))
        return out

    def _depth(
        self, height: Array, area: float, force: float, state: Viscosity | None, time: float | None
    ) -> float:
        """How far a body has to be lowered for a force to be carried, in the length unit."""
        if state is not None and time is not None:
            force = state.elastic(force, time)
        return depth_of_force(height, area, force, self.foundation)

    def _state(self, name: str | int, time: float | None) -> Viscosity | None:
        """What is remembered of a body's contact; None where nothing is."""
        cover = self.cover
        if time is None or not (cover.relaxation or cover.hysteresis):
            return None
        state = self._states.get(name)
        if state is None or time < state.time:
            state = self._states[name] = Viscosity(cover)
        return state
