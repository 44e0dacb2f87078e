"""What stands in the places of a fleet's environments."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense.errors import SceneError
from capsense.fleet.step_kernels import Bodies
from capsense.scene import Body
from capsense.surface.matter import matter_of
from capsense.surface.place_kernels import BODY
from capsense.surface.rigid import RigidShape
from capsense.surface.solver import SurfaceSolver

_QUATERNION = 1e-3
"""Quaternions may be longer or shorter than 1 by so much; they are made 1 long."""


class BodyTable:
    """The bodies of all environments, as the kernels take them.

    Args:
        solver: Works out what is known of a shape.
        count, places, sensors: How many environments, places in each, and sensors.
    """

    def __init__(self, solver: SurfaceSolver, count: int, places: int, sensors: int) -> None:
        self._solver = solver
        self.count, self.places, self.sensors = count, places, sensors
        self.shapes: list[RigidShape] = []
        """Those in the table, in its order; records point to their arrays."""
        self._kinds: dict[tuple[int, bool], int] = {}
        shape = count, places
        self.bodies = Bodies(
            np.zeros(0, BODY), np.zeros(0), np.full(shape, -1), np.ones(shape), np.zeros(shape),
            np.zeros(shape), np.zeros(shape, np.int64), np.zeros((sensors, places), np.bool_),
            np.arange(places),
        )  # fmt: skip
        self.given = np.full(shape, None, object)
        """The bodies themselves, shape (e, b)."""

    def change(
        self,
        place: int,
        bodies: Body | Sequence[Body | None] | None,
        environments: ArrayLike | None,
    ) -> None:
        """See :meth:`Fleet.change`."""
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
        alike = {id(body): body for body in each}
        known = {key: self._row(body) for key, body in alike.items()}
        table = self.bodies
        values = [known[id(body)] for body in each]
        for column, part in zip(table[2:-2], zip(*values, strict=True), strict=True):
            column[rows, place] = part
        self.given[rows, place] = each

    def hide(self, sensor: int, places: Sequence[int]) -> None:
        """See :meth:`Fleet.hide`."""
        _known("hide", "sensors", [sensor], self.sensors)
        _known("hide", "places", places, self.places)
        self.bodies.hidden[sensor] = np.isin(np.arange(self.places), places)

    def join(self, places: Sequence[int]) -> None:
        """See :meth:`Fleet.join`."""
        _known("join", "places", places, self.places)
        self.bodies.group[list(places)] = min(places, default=0)

    def _row(self, body: Body | None) -> tuple[int, float, float, float, int]:
        """Shape, scale, softness, tie and neutrality of a body."""
        if body is None:
            return -1, 1.0, 0.0, 0.0, 1
        if not isinstance(body, Body):
            raise SceneError(f"{body!r} is not a Body")
        matter = matter_of([body], self._solver.excitation_frequency)
        if matter.lossy:
            hertz = self._solver.excitation_frequency
            raise SceneError(
                f"{body.material.name!r} has losses at {hertz:g} Hz, which a "
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
        if found == len(self.shapes):
            record = np.array([shape.record], BODY)
            if soft:
                record["impedance"] = shape.impedance.ctypes.data
            radius = float(np.linalg.norm(shape.panels.corners, axis=2).max())
            self.shapes.append(shape)
            self.bodies = self.bodies._replace(
                shapes=np.concatenate([self.bodies.shapes, record]),
                radius=np.append(self.bodies.radius, radius),
            )
        return found


def _known(task: str, what: str, given: Sequence[int], count: int) -> None:
    for number in given:
        if number not in range(count):
            raise SceneError(f"{task}: {number!r} is none of the {what} 0 to {count - 1}")


def checked_poses(what: str, values: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Poses of a shape, finite, with quaternions of length 1.

    Raises:
        SceneError: They are not.
    """
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
