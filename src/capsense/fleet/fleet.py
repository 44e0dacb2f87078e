"""Fleets: one scene in many environments, solved together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense._crew import in_parts
from capsense._patience import first_use
from capsense.design import load_design
from capsense.design.model import Design
from capsense.errors import SceneError, SolveError
from capsense.field.cache import default_settings, load_or_build
from capsense.field.terminals import Terminals
from capsense.fleet.step_kernels import Bodies, Found, Poses, step_rows
from capsense.scene.body import Body
from capsense.surface.matter import UNIT, matter_of
from capsense.surface.place_kernels import BODY
from capsense.surface.rigid import RigidShape
from capsense.surface.solver import DOUBTFUL, PRESETS, SurfaceSolver

Array = NDArray[np.float64]

_QUATERNION = 1e-3
"""Quaternions may be longer or shorter than 1 by so much; they are made 1 long."""


@dataclass(frozen=True, eq=False)
class FleetReading:
    """What the sensors of all environments see; e environments, s sensors, n electrodes."""

    capacitance: Array
    """Maxwell capacitance matrices [F], shape (e, s, n, n)."""
    delta: Array
    """Their change by the bodies [F], shape (e, s, n, n)."""
    error: Array
    """Estimated error of the largest entry [F], shape (e, s)."""
    jacobian: Array | None = None
    """Change of the matrices as each body moves along the sensor frame's x, y, z [F/m] and turns
    about axes parallel to these through its origin [F/rad], shape (e, s, b, n, n, 6)."""


class Fleet:
    """Sensors of one design in many environments, with the same places for bodies in each.

    What stands in a place may differ from environment to environment, and change at a reset: see
    :meth:`change`. Bodies out of a sensor's sight cost nothing. Readings are those of
    :meth:`Simulator.step` of the same preset; but bodies that touch each other are not joined to
    one conductor, and bodies longer than the diagonal of the sensor's box are not cut.

    Args:
        design: A design, its name, or the path of its file.
        bodies: What stands in every environment, one body for each place; their poses are not
            used. Rigid shapes, of matter without losses.
        count: How many environments, e.
        sensors: How many sensors of the design each has, s.
        preset: Accuracy, as of :class:`Simulator`.
        frequency: Excitation frequency [Hz].

    Raises:
        DesignError: The design is wrong.
        SceneError: ``bodies`` is empty, holds something else, or bodies that a fleet cannot have;
            or a count is not a positive whole number.
    """

    def __init__(
        self,
        design: Design | str | Path,
        bodies: Sequence[Body],
        count: int,
        *,
        sensors: int = 1,
        preset: Literal["standard", "learning", "fine"] = "learning",
        frequency: float = 250e3,
    ) -> None:
        for what, number in (("count", count), ("sensors", sensors)):
            if isinstance(number, bool) or not isinstance(number, int) or number < 1:
                raise SceneError(f"{what} is {number!r}; give a whole number from 1")
        if not bodies:
            raise SceneError("a fleet needs at least one body; give bodies=[Body(…), …]")
        if preset not in PRESETS:
            raise ValueError(f"preset is {preset!r}; choose one of {', '.join(map(repr, PRESETS))}")
        self.design = design if isinstance(design, Design) else load_design(design)
        field = load_or_build(self.design, default_settings(self.design))
        self._solver = SurfaceSolver(
            field.green, self.design, frequency=frequency, preset=PRESETS[preset]
        )
        self._terminals = Terminals(self.design, field.capacitance)
        n = self._terminals.electrodes
        self.baseline: Array = self._terminals.empty[:n, :n].copy()
        """Maxwell matrix of the electrodes in the empty domain [F], shape (n, n)."""
        self.count, self.sensors, self.places = count, sensors, len(bodies)
        """How many environments, sensors in each, and places for bodies."""
        self._kinds: dict[tuple[object, int], int] = {}
        self._held: list[RigidShape] = []  # records point to their arrays
        shape = count, self.places
        self._bodies = Bodies(
            np.zeros(0, BODY), np.zeros(0), np.full(shape, -1), np.ones(shape), np.zeros(shape),
            np.zeros(shape), np.zeros(shape, np.int64),
        )  # fmt: skip
        for place, body in enumerate(bodies):
            self.change(place, body)

    @property
    def electrode_names(self) -> tuple[str, ...]:
        """Electrode names in matrix order."""
        return self.design.electrode_names

    def change(
        self,
        place: int,
        bodies: Body | Sequence[Body | None] | None,
        environments: ArrayLike | None = None,
    ) -> None:
        """Change what stands in a place: shape, size, material, grounding, or nothing at all.

        Sizes of one proportion share what is worked out of a shape; a capsule or box of new
        proportions takes some ten milliseconds.

        Args:
            place: Number of the place.
            bodies: A body or None for all, or one for each of the environments.
            environments: Which environments, shape (k,); all by default.

        Raises:
            SceneError: There is no such place or environment, the numbers do not match, or a body
                is of matter with losses or of a shape that is not rigid.
        """
        if isinstance(place, bool) or not isinstance(place, int) or not 0 <= place < self.places:
            raise SceneError(f"place is {place!r}; there are places 0 to {self.places - 1}")
        rows = np.arange(self.count) if environments is None else np.asarray(environments).ravel()
        if rows.dtype.kind not in "iu" or (len(rows) and not (
            rows.min() >= 0 and rows.max() < self.count
        )):  # fmt: skip
            raise SceneError(
                f"environments is {environments!r}; give numbers from 0 to {self.count - 1}"
            )
        each = [bodies] * len(rows) if isinstance(bodies, Body) or bodies is None else list(bodies)
        if len(each) != len(rows):
            raise SceneError(f"{len(each)} bodies are given for {len(rows)} environments")
        known = {id(body): self._row(body) for body in each}
        table = self._bodies
        values = [known[id(body)] for body in each]
        for column, part in zip(table[2:], zip(*values, strict=True), strict=True):
            column[rows, place] = part

    def _row(self, body: Body | None) -> tuple[int, float, float, float, int]:
        """Shape, scale, softness, tie and neutrality of a body."""
        if body is None:
            return -1, 1.0, 0.0, 0.0, 1
        if not isinstance(body, Body):
            raise SceneError(f"{body!r} is not a Body")
        matter = matter_of([body], self._solver.frequency)
        if matter.lossy:
            raise SceneError(
                f"{body.material.name!r} has losses at {self._solver.frequency:g} Hz, which a "
                "fleet does not know; give the body a conductor's or a lossless material"
            )
        shape, size = self._solver.functions_of(body.shape)
        if not isinstance(shape, RigidShape):
            raise SceneError(
                f"{type(body.shape).__name__} is not rigid; a fleet takes primitives and TriMesh"
            )
        tie = complex(matter.ties(np.array([size * shape.capacitance]))[0]).real
        neutral = int(np.isinf(tie))
        soft = float(matter.softness[0].real)
        number = self._number(shape, soft != 0.0)
        return number, size, soft, 0.0 if neutral else tie, neutral

    def _number(self, shape: RigidShape, soft: bool) -> int:
        """The number of a shape in the table, which it joins if it is new."""
        found = self._kinds.setdefault((id(shape), soft), len(self._kinds))
        if found == len(self._held):
            record = np.array([shape.record], BODY)
            if soft:
                record["impedance"] = shape.impedance.ctypes.data
            radius = float(np.linalg.norm(shape.panels.corners, axis=2).max())
            self._held.append(shape)
            self._bodies = self._bodies._replace(
                shapes=np.concatenate([self._bodies.shapes, record]),
                radius=np.append(self._bodies.radius, radius),
            )
        return found

    def step(
        self, poses: ArrayLike, sensors: ArrayLike | None = None, *, jacobian: bool = False
    ) -> FleetReading:
        """Return the readings of all environments.

        Args:
            poses: Of the bodies in the world's frame: positions [m], then quaternions (x, y, z, w),
                shape (e, b, 7).
            sensors: The same of the sensors' frames, shape (e, s, 7). Without it, every sensor's
                frame is the world's.
            jacobian: Whether to work out ``reading.jacobian`` as well.

        Raises:
            SceneError: Poses are of a wrong shape, not finite, or their quaternions not 1 long.
            SolveError: Some environments have no solution; the message names the first.
        """
        e, s, b = self.count, self.sensors, self.places
        where = Poses(
            _checked("poses", poses, (e, b, 7)),
            np.broadcast_to(np.array([0.0] * 6 + [1.0]), (e, s, 7)).copy()
            if sensors is None else _checked("sensors", sensors, (e, s, 7)),
        )  # fmt: skip
        solver = self._solver
        m = solver.green.terminals
        slope = np.zeros((e if jacobian else 0, s, b, m, m, 6))
        found = Found(np.zeros((e, s, m, m)), np.zeros((e, s)), slope)
        preset = solver.preset
        with first_use():
            in_parts(
                step_rows, e, self._bodies, where, solver.green, preset.threshold,
                preset.width, DOUBTFUL, found,
            )  # fmt: skip
        failed = np.flatnonzero(~np.isfinite(found.delta).all(axis=(1, 2, 3)))
        if len(failed):
            raise SolveError(
                f"{len(failed)} of {e} environments have no solution, the first is {failed[0]}: "
                "look for bodies that coincide"
            )
        n, change = self._terminals.electrodes, self._terminals.screened(UNIT * found.delta)
        slopes = self._terminals.slope(change, UNIT * slope) if jacobian else None
        change = self._terminals.change(change)[..., :n, :n]
        return FleetReading(self.baseline + change, change, UNIT * found.error, slopes)


def _checked(what: str, values: ArrayLike, shape: tuple[int, ...]) -> Array:
    poses = np.array(values, float)
    if poses.shape != shape:
        raise SceneError(f"{what} has shape {poses.shape}; give {shape}")
    if not np.isfinite(poses).all():
        place = tuple(np.argwhere(~np.isfinite(poses))[0].tolist())
        raise SceneError(f"{what}{list(place)} is {poses[place]}; poses must be finite")
    length = np.linalg.norm(poses[..., 3:], axis=-1, keepdims=True)
    if (np.abs(length - 1.0) > _QUATERNION).any():
        place = tuple(np.argwhere(np.abs(length - 1.0) > _QUATERNION)[0].tolist())
        raise SceneError(
            f"the quaternion of {what}{list(place[:-1])} is {length[place]:g} long; give (x, y, z, "
            "w) of length 1"
        )
    poses[..., 3:] /= length
    return poses
