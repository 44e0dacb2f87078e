"""What stands in the places of a fleet's environments."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense.elements.matter import matter_of
from capsense.elements.pieces import windowed
from capsense.elements.rigid import BODY, RigidShape
from capsense.errors import SceneError
from capsense.fleet.step_kernels import Bodies
from capsense.scene import Body
from capsense.surface.solver import SurfaceSolver

Array = NDArray[np.float64]


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
            np.zeros(0, BODY), np.zeros(0), np.full(shape, -1), np.ones(shape),
            np.zeros(shape, complex), np.zeros(shape, complex), np.zeros(shape, np.int64),
            np.zeros((*shape, 3)), np.zeros((sensors, places), np.bool_), np.arange(places),
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
        if not rows.size:
            return
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
        if (table.group == table.group[place]).sum() > 1:
            _require_conductors(each, self._solver.excitation_frequency)
        for column, part in zip(table[2:-2], zip(*values, strict=True), strict=True):
            column[rows, place] = part
        self.given[rows, place] = each

    def hide(self, sensor: int, places: Sequence[int]) -> None:
        """See :meth:`Fleet.hide`."""
        for what, known, given in (
            ("sensors", self.sensors, [sensor]), ("places", self.places, places),
        ):  # fmt: skip
            for number in given:
                if number not in range(known):
                    raise SceneError(f"hide: {number!r} is none of the {what} 0 to {known - 1}")
        self.bodies.hidden[sensor] = np.isin(np.arange(self.places), places)

    def join(self, places: Sequence[int]) -> None:
        """See :meth:`Fleet.join`."""
        group = self.bodies.group
        for number in places:
            if number not in range(self.places):
                raise SceneError(f"join: {number!r} is none of the places 0 to {self.places - 1}")
            _require_conductors(self.given[:, number].tolist(), self._solver.excitation_frequency)
        for number in places:
            group[group == group[number]] = group[places[0]]

    @property
    def lossy(self) -> bool:
        """Whether any matter has losses."""
        table = self.bodies
        return bool((table.softness.imag != 0).any() or (table.tie.imag != 0).any())

    def _row(self, body: Body | None) -> tuple[int, float, complex, complex, int, Array]:
        """Shape, scale, softness, tie and neutrality of a body, and what is cut off of it."""
        if body is None:
            return -1, 1.0, 0.0, 0.0, 1, np.zeros(3)
        if not isinstance(body, Body):
            raise SceneError(f"{body!r} is not a Body")
        matter = matter_of([body], self._solver.excitation_frequency)
        window, _ = windowed(body.shape, np.zeros(3), self._solver.reach)
        shape, size = self._solver.functions_of(window)
        if not isinstance(shape, RigidShape):
            raise SceneError(
                f"{type(body.shape).__name__} is not rigid; a fleet takes primitives and TriMesh"
            )
        tie = complex(matter.ties(np.array([size * shape.capacitance]))[0])
        neutral = int(np.isinf(tie.real))
        soft = complex(matter.softness[0])
        number = self._number(shape, soft != 0.0)
        cut = 0.5 * np.ptp(body.shape.bounds(), axis=0) - 0.5 * np.ptp(window.bounds(), axis=0)
        return number, size, soft, 0.0 if neutral else tie, neutral, cut

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


def _require_conductors(bodies: Sequence[Body | None], frequency: float) -> None:
    known = {id(body): body for body in bodies if body is not None}.values()
    for body in known:
        if not matter_of([body], frequency).conducting[0]:
            raise SceneError(
                f"a body of {body.material.name!r} stands in a place that is joined with others; "
                "only conductors can be joined"
            )
