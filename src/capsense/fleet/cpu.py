"""A fleet's step on the CPU: environments on all processors, those with losses one by one.

What is compiled solves each as :mod:`capsense.solver.system.step` does it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense._jit import compiled, kernel
from capsense._thread_pool import in_parts
from capsense.constants import UNIT
from capsense.errors import SolveError
from capsense.field.background import Terminals
from capsense.field.face_kernels import WALL_EDGE
from capsense.field.green_kernels import Green
from capsense.fleet.bodies import Bodies, BodyTable
from capsense.reading import FleetReading, FleetTouch
from capsense.solver.gap.gap_kernels import near_bodies
from capsense.solver.gap.touch_kernels import Foundation, press
from capsense.solver.surface_solver import SurfaceSolver
from capsense.solver.system.lossy import solve_lossy
from capsense.solver.system.network_kernels import tie_what_is_outside
from capsense.solver.system.step import slopes_of, solve
from capsense.solver.tree.matter import FLOATING_PENALTY
from capsense.solver.tree.rigid import BODY, HALF_SPACE

Array = NDArray[np.float64]


class Sensor(NamedTuple):
    """The sensor of a fleet, and how finely scenes are resolved."""

    green: Green
    """Green's function of the design, of m terminals."""
    threshold: float
    width: float
    """As :func:`capsense.solver.system.step.solve` takes them."""
    cover: Foundation
    """Its cover; without pressures where it has none."""


class Poses(NamedTuple):
    """Where everything is: position, over the solver's ``length``, and quaternion (x, y, z, w) in
    the world's frame."""

    bodies: NDArray[Any]
    """Shape (e, b, 7)."""
    sensors: NDArray[Any]
    """Shape (e, s, 7)."""
    middle: NDArray[Any]
    """Middle of the domain in the sensor frame, shape (3,)."""
    forces: NDArray[Any]
    """Normal forces that press bodies onto the cover [N], NaN for none, shape (e, b)."""


class Found(NamedTuple):
    """What was found; e environments, s sensors; 4π eps0 = 1."""

    delta: NDArray[Any]
    """Change of the Maxwell matrix of m terminals [m], NaN where there is no solution,
    shape (e, s, m, m)."""
    error: NDArray[Any]
    """Estimate of the error of the largest entry [m], shape (e, s)."""
    slope: NDArray[Any]
    """Change with the poses of the bodies in the sensor's frame, see ``gradient_kernels.jacobian``,
    shape (e, s, b, m, m, 6); no environments where it is not asked for."""
    lossy: NDArray[Any]
    """Where nothing was solved, as matter has losses, shape (e, s)."""
    force: NDArray[Any]
    """Forces that the cover carries above electrodes [N], shape (e, s, n); no electrodes where
    there is no cover."""
    deepest: NDArray[Any]
    """Its largest compressions there [m], the same shape."""
    total: NDArray[Any]
    """Force that the whole cover carries [N], shape (e, s)."""


@compiled
def _step_rows(
    start: int, stop: int, bodies: Bodies, poses: Poses, sensor: Sensor, found: Found
) -> None:
    """Solve environments ``start`` to ``stop``, but for those with losses."""
    sensors, places = poses.sensors.shape[1], bodies.choice.shape[1]
    green, slopes = sensor.green, found.slope.shape[0] > 0
    m = green.terminals
    room, place = np.empty(places, bodies.shapes.dtype), np.empty(places, np.int64)
    turn = np.empty((3, 3))
    for e in range(start, stop):
        for s in range(sensors):
            count = _seen(bodies, poses, e, s, green, room, place)
            for c in range(count):
                b = place[c]
                if (
                    bodies.inverse_susceptibility[e, b].imag != 0.0
                    or bodies.ground_elastance[e, b].imag != 0.0
                ):
                    found.lossy[e, s] = True
            if sensor.cover.strain.shape[0] > 0 and count > 0:
                found.total[e, s] = press(
                    room[:count], poses.forces[e][place[:count]], sensor.cover,
                    found.force[e, s], found.deepest[e, s],
                )  # fmt: skip
            if count == 0 or found.lossy[e, s]:
                continue
            out = solve(room[:count], green, sensor.threshold, sensor.width, slopes)
            found.error[e, s] = out.error
            for i in range(m):
                for j in range(m):
                    found.delta[e, s, i, j] = out.delta[i, j] if out.shift >= 0.0 else np.nan
            if slopes and out.shift >= 0.0:
                slope = slopes_of(out, room[:count], green, sensor.threshold, sensor.width)
                _matrix(poses.sensors[e, s], turn)
                for c in range(count):  # bodies turn about their own origins
                    x, y, z = room[c].position[0], room[c].position[1], room[c].position[2]
                    _position(poses, e, place[c], s, turn, room[c])
                    x -= room[c].position[0]
                    y -= room[c].position[1]
                    z -= room[c].position[2]
                    for i in range(m):
                        for j in range(m):
                            f = slope[c, i, j]
                            f[3] += y * f[2] - z * f[1]
                            f[4] += z * f[0] - x * f[2]
                            f[5] += x * f[1] - y * f[0]
                    found.slope[e, s, place[c]] = slope[c]


@compiled
def _seen(
    bodies: Bodies, poses: Poses, e: int, s: int, green: Green, records: Any, place: Any
) -> int:
    """Fill the records and places of what a sensor sees, (b,) each.

    So are those out of its sight that are one conductor with what it sees and not at ground.

    Returns:
        How many there are.
    """
    turns = np.empty((3, 3)), np.empty((3, 3))
    sight = green.active_bounds, WALL_EDGE * green.extent
    _matrix(poses.sensors[e, s], turns[0])
    count, places = 0, bodies.choice.shape[1]
    there = np.zeros(places, np.bool_)
    for b in range(places):
        if bodies.choice[e, b] >= 0 and not bodies.hidden[s, b]:
            record = records[count : count + 1]
            there[b] = _placed(bodies, e, b, poses, s, turns, sight, record)
            if there[b]:
                place[count] = b
                count += 1
    for b in range(places):
        if there[b] or bodies.choice[e, b] < 0 or bodies.hidden[s, b]:
            continue
        free = bodies.neutral[e, b] != 0 or bodies.ground_elastance[e, b].real > 0.0
        if not free or bodies.inverse_susceptibility[e, b] != 0.0:
            continue
        joined = False
        for c in range(places):
            joined = joined or (there[c] and bodies.group[c] == bodies.group[b])
        if joined:
            _placed(bodies, e, b, poses, s, turns, (sight[0], np.inf), records[count : count + 1])
            place[count] = b
            count += 1
    for c in range(count):
        _connect(bodies, e, records[:count], place, c)
    for c in range(count):
        conducts = records[c].inverse_susceptibility == 0.0
        tied = records[c].neutral != 0 or records[c].ground_elastance > 0.0
        records[c].free = 1 if conducts and tied else 0
    tie_what_is_outside(records[:count], green.space)
    return count


@kernel
def _connect(bodies: Bodies, e: int, records: Any, place: Any, c: int) -> None:
    """Make a body one conductor with those that it is joined with, as ``Matter.write`` does.

    Those that are out of sight count for what ties it to ground.
    """
    groups, neutral = bodies.group, bodies.neutral[e]
    mine, leader, others = groups[place[c]], c, False
    for d in range(records.shape[0]):
        if groups[place[d]] == mine and d != c:
            leader, others = min(leader, d), True
    records[c].group = leader
    if leader < c:  # which has the tie of all by now
        records[c].ground_elastance, records[c].neutral = records[leader].ground_elastance, 0
        return
    grounded, ground = False, 0.0
    for b in range(groups.shape[0]):
        if groups[b] == mine and bodies.choice[e, b] >= 0 and not neutral[b]:
            tie = bodies.ground_elastance[e, b].real
            grounded = grounded or tie == 0.0
            ground += 1.0 / tie if tie > 0.0 else 0.0
            others = others or b != place[c]
    if others:
        records[c].neutral = 0
        records[c].ground_elastance = (
            0.0 if grounded else 1.0 / ground if ground > 0.0 else FLOATING_PENALTY
        )


@kernel
def _matrix(pose: Array, out: Array) -> None:
    """Rotation matrix of a pose."""
    x, y, z, w = pose[3], pose[4], pose[5], pose[6]
    out[0, 0], out[1, 1] = 1.0 - 2.0 * (y * y + z * z), 1.0 - 2.0 * (x * x + z * z)
    out[2, 2] = 1.0 - 2.0 * (x * x + y * y)
    out[0, 1], out[1, 0] = 2.0 * (x * y - z * w), 2.0 * (x * y + z * w)
    out[0, 2], out[2, 0] = 2.0 * (x * z + y * w), 2.0 * (x * z - y * w)
    out[1, 2], out[2, 1] = 2.0 * (y * z - x * w), 2.0 * (y * z + x * w)


@kernel
def _position(poses: Poses, e: int, b: int, s: int, turn: Array, body: Any) -> None:
    """Set the position of a record to that of a body in a sensor's frame."""
    for i in range(3):
        at = 0.0
        for k in range(3):
            at += turn[k, i] * (poses.bodies[e, b, k] - poses.sensors[e, s, k])
        body.position[i] = at


@kernel
def _placed(
    bodies: Bodies, e: int, b: int, poses: Poses, s: int, turns: tuple[Array, Array],
    sight: tuple[Array, float],     record: Any,
) -> bool:  # fmt: skip
    """Fill the record of a body in a sensor's frame; False where it is out of its sight.

    ``turns`` are the sensor's rotation matrix, and room for that of the body.
    """
    (turn, own), (room, shore) = turns, sight
    _matrix(poses.bodies[e, b], own)
    u, scale = bodies.choice[e, b], bodies.scale[e, b]
    reach = scale * bodies.radius[u] + shore
    record[0] = bodies.shapes[u]
    body = record[0]
    _position(poses, e, b, s, turn, body)
    for j in range(3):
        off = 0.0
        for i in range(3):
            total = 0.0
            for k in range(3):
                total += turn[k, i] * own[k, j]
            body.rotation[i, j] = total
            off += total * (poses.middle[i] - body.position[i])
        off = min(max(off, -bodies.slack[e, b, j]), bodies.slack[e, b, j])
        for i in range(3):
            body.position[i] += body.rotation[i, j] * off
    for i in range(3):
        at = body.position[i]
        if at + reach < room[0, i] or at - reach > room[1, i]:
            return False
    body.scale, body.ground_elastance = scale, bodies.ground_elastance[e, b].real
    body.neutral, body.inverse_susceptibility = (
        bodies.neutral[e, b],
        bodies.inverse_susceptibility[e, b].real,
    )
    body.polarization_stiffness = HALF_SPACE * abs(bodies.inverse_susceptibility[e, b])
    if bodies.inverse_susceptibility[e, b] == 0.0:
        body.neumann_to_dirichlet = 0
    return True


def _in_units(solver: SurfaceSolver, bodies: Array, sensors: Array, forces: Array) -> Poses:
    """Poses, (e, b, 7) and (e, s, 7), with lengths as the solver's kernels take them.

    Forces are (e, b), in N.
    """
    length = np.array([solver.length] * 3 + [1.0] * 4)
    return Poses(bodies / length, sensors / length, solver.middle, forces)


class CpuCore:
    """Solves all sensors of all environments.

    Args:
        solver: Knows the design and how finely scenes are resolved.
        terminals: Of the design.
        table: What stands where.
        names: Of the electrodes.
    """

    def __init__(
        self,
        solver: SurfaceSolver,
        terminals: Terminals,
        table: BodyTable,
        names: tuple[str, ...],
    ) -> None:
        self._solver, self._terminals, self._table = solver, terminals, table
        self._names = names

    def step(
        self, bodies: Array, sensors: Array, forces: Array, jacobian: bool,
        rows: NDArray[np.int64] | None = None,
    ) -> FleetReading:  # fmt: skip
        """The reading of poses, shapes (e, b, 7) and (e, s, 7), and forces [N], shape (e, b).

        ``rows`` are the numbers of these environments, shape (e,), where they are not all.

        Raises:
            SolveError: Some environments have no solution.
        """
        (e, b, _), s = bodies.shape, sensors.shape[1]
        solver, terminals = self._solver, self._terminals
        table = self._table.bodies if rows is None else self._table.bodies.of(rows)
        where = _in_units(solver, bodies, sensors, forces)
        green, cover = solver.green, solver.cover
        m = green.terminals
        slope = np.zeros((e if jacobian else 0, s, b, m, m, 6))
        n = terminals.electrodes
        own = e, s, n if len(cover.strain) else 0
        found = Found(
            np.zeros((e, s, m, m)), np.zeros((e, s)), slope, np.zeros((e, s), np.bool_),
            np.zeros(own), np.zeros(own), np.zeros((e, s)),
        )  # fmt: skip
        sensor = Sensor(green, solver.preset.threshold, solver.preset.width, cover)
        in_parts(_step_rows, e, table, where, sensor, found)
        loss = self._lossy(table, where, found)
        failed = np.flatnonzero(~np.isfinite(found.delta).all(axis=(1, 2, 3)))
        if len(failed):
            raise SolveError(
                f"{len(failed)} of {e} environments have no solution, the first is "
                f"{failed[0] if rows is None else rows[failed[0]]}: "
                "look for bodies that coincide"
            )
        unit = solver.unit
        change = terminals.screened(unit * found.delta)
        slope[..., :3] *= UNIT
        slope[..., 3:] *= unit
        slopes = terminals.slope(change, slope) if jacobian else None
        whole = change if loss is None else change - 1j * unit * loss
        change = terminals.change(whole)
        error = terminals.error(unit * found.error, whole, change)
        shields = (terminals.empty + change.real)[..., :n, n:].sum(axis=-1)
        change = change[..., :n, :n]
        omega = 2 * np.pi * solver.excitation_frequency
        return FleetReading(
            terminals.empty[:n, :n] + change.real, change.real, self._names, error,
            shields,
            conductance=None if loss is None else -omega * change.imag, jacobian=slopes,
            touch=FleetTouch(found.force, solver.length * found.deepest, found.total)
            if own[2] else None,
        )  # fmt: skip

    def lifted(
        self, bodies: Array, sensors: Array, rows: NDArray[np.int64], nodes: int | None
    ) -> NDArray[np.bool_]:
        """Where bodies near the design are lifted and nothing is added for it, shape (k, s).

        These are conductors where some matter has losses. On Warp they are dielectrics, too,
        conductors that are not at ground beyond the number of ``nodes``, and all bodies near a bent
        film, which are not even lifted; see ``solver.gap.gap_kernels``.

        Args:
            bodies, sensors: Poses, shapes (e, b, 7) and (e, s, 7).
            rows: Which environments are looked at, shape (k,).
            nodes: How many such conductors can be nodes; None for a fleet on the CPU.
        """
        solver, table = self._solver, self._table.bodies
        where = _in_units(solver, bodies, sensors, self._table.forces)
        green = solver.green
        records = np.empty(table.choice.shape[1], BODY)
        place = np.empty(len(records), np.int64)
        out = np.zeros((len(rows), sensors.shape[1]), np.bool_)
        for k, s in np.ndindex(out.shape):
            e = int(rows[k])
            some = records[: _seen(table, where, e, s, green, records, place)].copy()
            at = place[: len(some)]
            soft, ties = table.inverse_susceptibility[e, at], table.ground_elastance[e, at]
            some["inverse_susceptibility"] = 0.0
            near = near_bodies(some, green, False)
            metal = near & (soft == 0.0)
            lossy = (soft.imag != 0.0).any() or (ties.imag != 0.0).any()
            out[k, s] = metal.any() and lossy
            if nodes is not None:
                loose = metal & ((some["neutral"] != 0) | (some["ground_elastance"] > 0.0))
                bent = green.gap.curvature != 0.0
                out[k, s] |= (near & (bent | ~metal)).any()
                out[k, s] |= len(set(some["group"][loose])) > nodes
        return out

    def _lossy(self, bodies: Bodies, where: Poses, found: Found) -> NDArray[Any] | None:
        """Solve what has losses; the part in quadrature (e, s, m, m), None where nothing has."""
        if not found.lossy.any():
            return None
        solver, table = self._solver, self._table
        preset = solver.preset
        loss = np.zeros_like(found.delta)
        records, place = np.empty(table.places, BODY), np.empty(table.places, np.int64)
        for e, s in np.argwhere(found.lossy).tolist():
            count = _seen(bodies, where, e, s, solver.green, records, place)
            at = place[:count]
            if len(solver.cover.strain):
                unused = np.empty((2, found.force.shape[-1]))
                press(records[:count], where.forces[e][at], solver.cover, *unused)
            soft, lone = bodies.inverse_susceptibility[e, at], records["neutral"][:count] != 0
            ties = np.where(
                bodies.ground_elastance[e, at].imag != 0,
                bodies.ground_elastance[e, at],
                records["ground_elastance"][:count],
            )
            out = solve_lossy(
                records[:count], np.where(lone, np.inf, ties), soft, solver.green,
                preset.threshold, preset.width,
            )  # fmt: skip
            found.delta[e, s], loss[e, s] = out.delta.real, -out.delta.imag
            found.error[e, s] = out.error
        return loss
