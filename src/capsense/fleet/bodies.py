"""What stands in the places of a fleet's environments."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense._validate import as_whole, chosen_rows, shorten
from capsense.errors import SceneError
from capsense.scene import Body, Layers, Shape, SurfaceMesh
from capsense.solver.bodies.outline import write_outline
from capsense.solver.bodies.panels import windowed
from capsense.solver.surface_solver import SurfaceSolver
from capsense.solver.tree.dynamic_surface import DynamicBody
from capsense.solver.tree.fine_panels import WIDE
from capsense.solver.tree.matter import matter_of
from capsense.solver.tree.rigid import BODY, RigidShape

Array = NDArray[np.float64]

WORLD: Array = np.array([0.0] * 6 + [1.0])
"""The pose of the world's own frame."""
_QUATERNION = 1e-3
"""Quaternions may be longer or shorter than 1 by so much; they are made 1 long."""


def on_device(values: Any) -> bool:
    """Whether values are an array of Warp, PyTorch or JAX, which is taken by DLPack."""
    return hasattr(values, "__dlpack__") and not isinstance(values, np.ndarray)


def host_array(values: Any) -> Any:
    """An array of Warp, PyTorch or JAX as one of NumPy, copied from its device; others as given."""
    if not on_device(values):
        return values
    values = values.cpu() if hasattr(values, "cpu") else values
    return values.numpy() if hasattr(values, "numpy") else np.asarray(values)


_EACH = ("choice", "scale", "inverse_susceptibility", "ground_elastance", "neutral", "slack")
"""What :class:`Bodies` have for every environment."""

_DOUBLINGS = 2
"""Panels of a body are doubled at most so often where they are wide, see :class:`BodyTable`."""


class Bodies(NamedTuple):
    """What stands in every environment; e environments, b places for bodies.

    Lengths are over the solver's ``length``.
    """

    shapes: NDArray[Any]
    """Shapes, of size 1, as records of ``solver.tree.rigid.BODY``, shape (u,)."""
    radius: NDArray[Any]
    """Radius of a ball about each shape's origin that holds it [m], shape (u,)."""
    choice: NDArray[Any]
    """Shape in each place, -1 where nothing is, shape (e, b)."""
    scale: NDArray[Any]
    """How many times as large it is, shape (e, b)."""
    inverse_susceptibility: NDArray[Any]
    """1 / (eps - 1), complex, 0 for conductors, shape (e, b)."""
    ground_elastance: NDArray[Any]
    """Energy that ties it to ground [1/m], complex, shape (e, b)."""
    neutral: NDArray[Any]
    """Whether it has no net charge, shape (e, b)."""
    slack: NDArray[Any]
    """Half of what is cut off of a long body along each axis [m], shape (e, b, 3); what is left is
    nearest to the middle of the domain, see ``solver.tree.dynamic_surface.windowed``."""
    hidden: NDArray[Any]
    """Whether a sensor does not see a place, shape (s, b)."""
    group: NDArray[Any]
    """Places that are joined to one conductor have the same number, shape (b,)."""

    def of(self, rows: NDArray[np.int64]) -> Bodies:
        """What stands in some of the environments, shape (k,)."""
        return self._replace(**{name: getattr(self, name)[rows] for name in _EACH})


class BodyTable:
    """The bodies of all environments, as the kernels take them.

    Args:
        solver: Works out what is known of a shape.
        count, places, sensors: How many environments, places in each, and sensors.
        width: The panels of a body are doubled, at most twice, as long as they are wider than this
            on average [m]; by default they are as many as usual.
    """

    def __init__(
        self, solver: SurfaceSolver, count: int, places: int, sensors: int,
        width: float = math.inf,
    ) -> None:  # fmt: skip
        self._solver, self._width = solver, width / solver.length
        self.count, self.places, self.sensors = count, places, sensors
        self.shapes: list[RigidShape | DynamicBody] = []
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
        self._conductors: list[str | None] = [None] * places
        self._ties = np.zeros(shape, complex), np.ones(shape, np.int64)
        """Tie and neutrality of each body by itself, shapes (e, b)."""
        self.forces: Array = np.full(shape, np.nan)
        """Normal forces that press them onto a cover [N], NaN for none, shape (e, b)."""

    def __getstate__(self) -> dict[str, Any]:
        """Without what is good in one process only: numbers of objects, and pointers to arrays."""
        soft = [kind[1] for kind in self._kinds]
        bodies = self.bodies._replace(shapes=np.zeros(0, BODY))
        outlines = [getattr(shape, "_outline", None) for shape in self.shapes]
        return {**vars(self), "_kinds": soft, "bodies": bodies, "outlines": outlines}

    def __setstate__(self, state: dict[str, Any]) -> None:
        outlines = state.pop("outlines")
        vars(self).update(state)
        for shape, outline in zip(self.shapes, outlines, strict=True):
            if outline is not None:  # which shapes do not take along
                write_outline(shape.record, outline)
                vars(shape)["_outline"] = outline
        kinds = list(zip(self.shapes, state["_kinds"], strict=True))
        self._kinds = {(id(shape), soft): k for k, (shape, soft) in enumerate(kinds)}
        records = [_record(shape, soft) for shape, soft in kinds]
        self.bodies = self.bodies._replace(shapes=np.concatenate([np.zeros(0, BODY), *records]))

    def change(
        self,
        place: int,
        bodies: Body | Sequence[Body | None] | None,
        environments: ArrayLike | None,
    ) -> None:
        """See :meth:`Fleet.change`."""
        whole = as_whole(place)
        if whole is None or not 0 <= whole < self.places:
            raise SceneError(f"place is {place!r}; there are places 0 to {self.places - 1}")
        rows = chosen_rows(environments, self.count, SceneError)
        if not rows.size:
            return
        each: list[Body | None]
        if isinstance(bodies, Body) or bodies is None:
            each = [bodies] * len(rows)
        else:
            each = list(bodies if isinstance(bodies, Iterable) else [bodies])
        if not all(body is None or isinstance(body, Body) for body in each):
            raise SceneError(f"bodies is {shorten(bodies)}; give a Body, None, or a list of them")
        if len(each) != len(rows):
            raise SceneError(f"{len(each)} bodies are given for {len(rows)} environments")
        alike = {id(body): body for body in each}
        for one in alike.values():
            name, own = self._conductor(one), self._conductors[place]
            if one is not None and name != own:
                raise SceneError(
                    f"place {place} belongs to conductor {own!r}, and a body of conductor {name!r} "
                    "is given; conductors of places stay as the fleet was made with"
                )
        known = {key: self._row(body) for key, body in alike.items()}
        table = self.bodies
        values = [known[id(body)] for body in each]
        if (table.group == table.group[place]).sum() > 1:
            _require_conductors(each, self._solver.excitation_frequency)
        for column, part in zip(table[2:-2], zip(*values, strict=True), strict=True):
            column[rows, place] = part
        for kept, column in zip(self._ties, (table.ground_elastance, table.neutral), strict=True):
            kept[rows, place] = column[rows, place]
        self._tie_once(rows, place)
        self.given[rows, place] = each
        self.forces[rows, place] = [
            np.nan if body is None or body.force is None else body.force for body in each
        ]

    def conduct(self, bodies: Sequence[Body | None]) -> None:
        """Make the places of bodies (b,) that name one conductor one."""
        self._conductors = [self._conductor(body) for body in bodies]
        for name in dict.fromkeys(self._conductors):
            known = [place for place, other in enumerate(self._conductors) if other == name]
            if name is not None and len(known) > 1:
                self.join(known)

    def _conductor(self, body: Body | None) -> str | None:
        """The conductor that a body names, if it conducts."""
        if body is None or body.conductor is None:
            return None
        conducts = matter_of([body], self._solver.excitation_frequency).conducting[0]
        return body.conductor if conducts else None

    def _tie_once(self, rows: NDArray[np.int64], place: int) -> None:
        """Give the tie of a place's conductor to the first of its bodies in each environment."""
        name, table = self._conductors[place], self.bodies
        if name is None:
            return
        known = [p for p, other in enumerate(self._conductors) if other == name]
        at = np.ix_(rows, np.array(known))
        there = table.choice[at] >= 0
        first = there & (np.cumsum(there, axis=1) == 1)
        tie, neutral = self._ties
        table.ground_elastance[at] = np.where(first, tie[at], 0.0)
        table.neutral[at] = np.where(first, neutral[at], 1)

    def hide(self, sensor: int, places: Sequence[int]) -> None:
        """See :meth:`Fleet.hide`."""
        _numbers("hide", "sensors", [sensor], self.sensors)
        known = _numbers("hide", "places", places, self.places)
        self.bodies.hidden[sensor] = np.isin(np.arange(self.places), known)

    def join(self, places: Sequence[int]) -> None:
        """See :meth:`Fleet.join`."""
        group, known = self.bodies.group, _numbers("join", "places", places, self.places)
        for number in known:
            _require_conductors(self.given[:, number].tolist(), self._solver.excitation_frequency)
        for number in known:
            group[group == group[number]] = group[known[0]]

    @property
    def lossy(self) -> bool:
        """Whether any matter has losses."""
        table = self.bodies
        return bool(
            (table.inverse_susceptibility.imag != 0).any()
            or (table.ground_elastance.imag != 0).any()
        )

    def _row(self, body: Body | None) -> tuple[int, float, complex, complex, int, Array]:
        """Shape, scale, softness, tie and neutrality of a body, and what is cut off of it."""
        if body is None:
            return -1, 1.0, 0.0, 0.0, 1, np.zeros(3)
        if not isinstance(body, Body):
            raise SceneError(f"{body!r} is not a Body")
        if isinstance(body.shape, Layers | SurfaceMesh):
            raise SceneError(
                f"{type(body.shape).__name__} is not rigid; a fleet takes primitives and TriMesh"
            )
        matter, length = self._solver.matter_of([body]), self._solver.length
        if matter.local is not None:
            raise SceneError(
                f"grounding is {body.grounding!r}, but fleets know no ties to a local ground that "
                "floats; give another grounding, or take a Simulator"
            )
        whole = body.shape.measured_in(length)
        window, _ = windowed(whole, np.zeros(3), self._solver.reach)
        shape, size = self._solver.functions_of(
            window, bool(matter.conducting[0]), self.share(window)
        )
        tie = complex(matter.ties(np.array([size * shape.capacitance]))[0])
        neutral = int(np.isinf(tie.real))
        soft = complex(matter.inverse_susceptibility[0])
        number = self._number(shape, soft != 0.0)
        cut = 0.5 * np.ptp(whole.bounds(), axis=0) - 0.5 * np.ptp(window.bounds(), axis=0)
        return number, size, soft, 0.0 if neutral else tie, neutral, cut

    def share(self, shape: Shape) -> float:
        """How many times the usual panels a wide shape has, whose lengths are over ``length``.

        Of clusters that are few, those in front of the design can be small only if panels are.
        """
        low, middle, high = np.ptp(shape.bounds(), axis=0).tolist()
        if sorted((low, middle, high))[1] * self._solver.length <= WIDE:
            return 1.0
        area = 2.0 * (low * middle + middle * high + high * low)
        more = area / self._width**2 / self._solver.preset.panels
        more = math.ceil(math.log2(max(more, 1.0)))
        return float(2 ** min(more, _DOUBLINGS))

    def _number(self, shape: RigidShape | DynamicBody, soft: bool) -> int:
        """The number of a shape in the table, which it joins if it is new."""
        found = self._kinds.setdefault((id(shape), soft), len(self._kinds))
        if found == len(self.shapes):
            self.shapes.append(shape)
            self.bodies = self.bodies._replace(
                shapes=np.concatenate([self.bodies.shapes, _record(shape, soft)]),
                radius=np.append(self.bodies.radius, shape.radius),
            )
        return found


def _record(shape: RigidShape | DynamicBody, soft: bool) -> NDArray[Any]:
    """What the kernels take of a shape, with its inside if it is soft; points to its arrays."""
    record = np.array([shape.record], BODY)
    if soft and (block := shape.neumann_to_dirichlet) is not None:
        record["neumann_to_dirichlet"], record["n_tabulated"] = block.ctypes.data, len(block)
    return record


def _numbers(doing: str, what: str, given: Sequence[int], known: int) -> list[int]:
    """The numbers that are given, each one of those that are known."""
    if not isinstance(given, Iterable):
        raise SceneError(f"{doing}: {what} is {given!r}; give a list of numbers, such as [{given}]")
    numbers = list(given)
    for number in numbers:
        if (whole := as_whole(number)) is None or not 0 <= whole < known:
            raise SceneError(f"{doing}: {number!r} is none of the {what} 0 to {known - 1}")
    return numbers


def _require_conductors(bodies: Sequence[Body | None], frequency: float) -> None:
    known = {id(body): body for body in bodies if body is not None}.values()
    for body in known:
        if not matter_of([body], frequency).conducting[0]:
            raise SceneError(
                f"a body of {body.material.name!r} stands in a place that is joined with others; "
                "only conductors can be joined"
            )


def require_no_gradient(what: str, values: Any) -> None:
    """Refuse tensors whose gradients would be lost.

    Raises:
        SceneError: It is such a tensor.
    """
    if getattr(values, "requires_grad", False):
        raise SceneError(
            f"{what} is a tensor that requires gradients, which step does not follow; give "
            f"{what}.detach(), or write capsense.fleet.autograd.change(fleet, poses)"
        )


def checked_forces(forces: ArrayLike, shape: tuple[int, int]) -> Array:
    """Normal forces on bodies [N], NaN for none, on the host.

    Raises:
        SceneError: They have another shape, or one is negative or infinite.
    """
    require_no_gradient("forces", forces)
    out = np.array(forces, float, order="C")
    if out.shape != shape:
        raise SceneError(f"forces has shape {out.shape}; give {shape}, NaN for no force")
    wrong = np.argwhere((out < 0.0) | np.isinf(out))
    if len(wrong):
        place = tuple(wrong[0].tolist())
        raise SceneError(f"forces{list(place)} is {out[place]} N; give 0 or more, NaN for none")
    return out


def checked_poses(what: str, values: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Poses on the host, with quaternions of length 1.

    Raises:
        SceneError: They have another shape, are not finite, or their quaternions not 1 long.
    """
    require_no_gradient(what, values)
    poses = np.array(values, float, order="C")
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
