"""A fleet's step on the CPU: environments on all processors, those with losses one by one."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from capsense._jit import first_use
from capsense._thread_pool import in_parts
from capsense.elements.matter import UNIT
from capsense.elements.rigid import BODY
from capsense.errors import SolveError
from capsense.field.background import Terminals
from capsense.fleet.bodies import BodyTable
from capsense.fleet.reading import FleetReading
from capsense.fleet.step_kernels import Found, Poses, Sensor, seen, step_rows
from capsense.surface.solver import SurfaceSolver
from capsense.surface.step import solve_lossy

Array = NDArray[np.float64]


class CpuCore:
    """Solves all sensors of all environments.

    Args:
        solver: Knows the design and how finely scenes are resolved.
        terminals: Of the design.
        table: What stands where.
    """

    def __init__(self, solver: SurfaceSolver, terminals: Terminals, table: BodyTable) -> None:
        self._solver, self._terminals, self._table = solver, terminals, table

    def step(self, bodies: Array, sensors: Array, jacobian: bool) -> FleetReading:
        """The reading of poses, shapes (e, b, 7) and (e, s, 7).

        Raises:
            SolveError: Some environments have no solution.
        """
        (e, b, _), s = bodies.shape, sensors.shape[1]
        solver, terminals = self._solver, self._terminals
        where = Poses(bodies, sensors, solver.middle)
        green = solver.green
        m = green.terminals
        slope = np.zeros((e if jacobian else 0, s, b, m, m, 6))
        found = Found(
            np.zeros((e, s, m, m)), np.zeros((e, s)), slope, np.zeros((e, s), np.bool_)
        )  # fmt: skip
        sensor = Sensor(green, solver.preset.threshold, solver.preset.width)
        with first_use():
            in_parts(step_rows, e, self._table.bodies, where, sensor, found)
            loss = self._lossy(where, found)
        failed = np.flatnonzero(~np.isfinite(found.delta).all(axis=(1, 2, 3)))
        if len(failed):
            raise SolveError(
                f"{len(failed)} of {e} environments have no solution, the first is {failed[0]}: "
                "look for bodies that coincide"
            )
        n, change = terminals.electrodes, terminals.screened(UNIT * found.delta)
        slopes = terminals.slope(change, UNIT * slope) if jacobian else None
        change = terminals.change(change if loss is None else change - 1j * UNIT * loss)
        shields = (terminals.empty + change.real)[..., :n, n:].sum(axis=-1)
        change = change[..., :n, :n]
        omega = 2 * np.pi * solver.excitation_frequency
        return FleetReading(
            terminals.empty[:n, :n] + change.real, change.real, UNIT * found.error, shields,
            conductance=None if loss is None else -omega * change.imag, jacobian=slopes,
        )  # fmt: skip

    def _lossy(self, where: Poses, found: Found) -> NDArray[Any] | None:
        """Solve what has losses; the part in quadrature (e, s, m, m), None where nothing has."""
        if not found.lossy.any():
            return None
        solver, table = self._solver, self._table
        bodies, preset = table.bodies, solver.preset
        loss = np.zeros_like(found.delta)
        records, place = np.empty(table.places, BODY), np.empty(table.places, np.int64)
        for e, s in np.argwhere(found.lossy).tolist():
            count = seen(bodies, where, e, s, solver.green.room, records, place)
            at = place[:count]
            soft, lone = bodies.softness[e, at], records["neutral"][:count] != 0
            ties = np.where(bodies.tie[e, at].imag != 0, bodies.tie[e, at], records["tie"][:count])
            out = solve_lossy(
                records[:count], np.where(lone, np.inf, ties), soft,
                [
                    table.shapes[u].impedance if x != 0 else None
                    for u, x in zip(bodies.choice[e, at], soft, strict=True)
                ],
                solver.green, preset.threshold, preset.width,
            )  # fmt: skip
            found.delta[e, s], loss[e, s] = out.delta.real, -out.delta.imag
            found.error[e, s] = (np.abs(np.diag(out.left)) + out.coarse).max()
        return loss
