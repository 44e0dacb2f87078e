"""The solids of a simulator: made once, placed in the sensor frame at every reading."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense._jit import compiled, kernel
from capsense.adapters.contacts import Contact, pressed
from capsense.adapters.meshes import Terrain
from capsense.adapters.rules import Tie
from capsense.cover import Cover
from capsense.design.model import Domain
from capsense.errors import SceneError
from capsense.scene import Body, Box, Material, Pose, Scene, Shape
from capsense.scene.mesh_shape import SHEET_THICKNESS

if TYPE_CHECKING:
    from capsense.scene.scene import DeformableSurface

Array = NDArray[np.float64]


_PLATE = 0.1
"""Thickness over width of the plate that stands for a conducting half space."""


@dataclass(frozen=True)
class HalfSpace:
    """Everything below the plane z = 0 of its own frame, such as a floor."""


def plate_thickness(domain: Domain, material: Material) -> float:
    """Thickness [m] of the plate that stands for a half space of some matter.

    A conductor's charge is on its face: its panels are better spent there than on a cube.
    """
    edge = float(np.linalg.norm(domain.size))
    return edge * (_PLATE if material.is_conductor() else 1.0)


@dataclass(frozen=True, eq=False)
class Solid:
    """One solid of a simulator, fixed to one of its moving frames."""

    label: str
    """What it is called in scenes and messages."""
    shape: Shape | HalfSpace | Terrain
    frame: int
    """Index of the frame that carries it, among those the simulator gives at every reading."""
    pose: Pose
    """Where it stands in that frame."""
    material: Material
    tie: Tie
    """What ties it to ground."""
    tree: int = -1
    """What hangs together by joints has the same number; -1 for what is fixed to the world."""


@dataclass(frozen=True, eq=False)
class SoftSolid:
    """A deformable of a simulator: its vertices are taken anew at every reading."""

    label: str
    """What it is called in scenes and messages."""
    faces: NDArray[np.int64]
    """Vertex indices, shape (m, 3)."""
    vertices: Callable[[], Array]
    """Gives the vertices [m] in the simulator's world at present, shape (n, 3)."""
    material: Material
    tie: Tie
    """What ties it to ground."""
    thickness: float = SHEET_THICKNESS
    """That of a sheet [m]."""
    tree: int = -1
    """As of :class:`Solid`."""


class Frames(NamedTuple):
    """Where the moving frames of a simulator, and the sensor, are at one instant."""

    position: Array
    """Origins [m] in the simulator's world, shape (f, 3)."""
    quaternion: Array
    """Unit quaternions (x, y, z, w), shape (f, 4)."""
    sensor_position: Array
    """Origin of the sensor frame [m], shape (3,)."""
    sensor_quaternion: Array
    """Unit quaternion of the sensor frame, shape (4,)."""


class Layout(NamedTuple):
    """Where n solids stand in the frames that carry them, and how far they reach."""

    frame: NDArray[np.int64]
    """Frame of each solid, shape (n,)."""
    position: Array
    """Origins of the solids [m] in their frames, shape (n, 3)."""
    quaternion: Array
    """Their unit quaternions (x, y, z, w), shape (n, 4)."""
    centre: Array
    """Centres of the solids' own bounding boxes [m], shape (n, 3)."""
    half: Array
    """Half edge lengths of those boxes [m], shape (n, 3)."""
    depth: Array
    """Zero for a solid; for a half space below its local plane z = 0, the thickness [m] of the
    plate that stands for it, shape (n,)."""


class Placed(NamedTuple):
    """Where n solids stand in the sensor frame."""

    position: Array
    """Origins [m], shape (n, 3)."""
    quaternion: Array
    """Unit quaternions, shape (n, 4)."""
    seen: NDArray[np.bool_]
    """Whether the bounding box reaches into the domain, shape (n,)."""


@dataclass(eq=False, repr=False)
class World:
    """All solids that a sensor may see.

    Args:
        solids: The solids; labels that repeat are numbered.
        domain: The box outside which nothing is seen.
        soft: The deformables.
    """

    solids: Sequence[Solid]
    domain: Domain
    soft: Sequence[SoftSolid] = ()
    _bodies: list[Body] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        n = len(self.solids)
        edge = self._reach = float(np.linalg.norm(self.domain.size))
        self._bodies = []
        boxes = np.zeros((n, 2, 3))
        taken: dict[str, int] = {}
        for i, solid in enumerate(self.solids):
            boxes[i] = 0.0 if isinstance(solid.shape, HalfSpace) else solid.shape.bounds()
            plate = Box((edge, edge, plate_thickness(self.domain, solid.material)))
            shape = solid.shape if isinstance(solid.shape, Shape) else plate
            count = taken[solid.label] = taken.get(solid.label, 0) + 1
            label = solid.label if count == 1 else f"{solid.label}#{count}"
            conductor = solid.tie.conductor(solid.tree)
            self._bodies.append(
                Body(shape, Pose(), solid.material, solid.tie.grounding, label, conductor=conductor)
            )
        names = [body.conductor for body in self._bodies]
        known = {name: k for k, name in enumerate(dict.fromkeys(names))} | {None: -1}
        self._conductor = np.array([known[name] for name in names], np.int64)
        self._surfaces: list[DeformableSurface | None] = [None] * len(self.soft)
        self._layout = Layout(
            np.array([s.frame for s in self.solids], dtype=np.int64),
            np.array([s.pose.position for s in self.solids]).reshape(n, 3),
            np.array([s.pose.quaternion for s in self.solids]).reshape(n, 4),
            boxes.mean(axis=1), 0.5 * (boxes[:, 1] - boxes[:, 0]),
            np.array([self._depth(s) for s in self.solids]),
        )  # fmt: skip
        self._lower, self._upper = self.domain.sight
        self._placed = Placed(np.empty((n, 3)), np.empty((n, 4)), np.zeros(n, dtype=np.bool_))

    def scene(
        self, frames: Frames, contacts: Sequence[Contact] = (), cover: Cover | None = None
    ) -> Scene:
        """The solids that reach into the domain, in the sensor frame.

        Args:
            frames: Where everything is.
            contacts: Contacts of the sensor's carrier, whose forces press solids onto the cover.
            cover: The design's cover.

        Raises:
            SceneError: A frame stands at no finite place.
        """
        placed = self._placed
        place_solids(frames, self._layout, self._lower, self._upper, placed)
        if not np.isfinite(frames.sensor_position.sum() + frames.sensor_quaternion.sum()):
            raise _diverged("the sensor's link")
        if not np.isfinite(placed.position.sum() + placed.quaternion.sum()):
            bad = ~np.isfinite(placed.position.sum(axis=1) + placed.quaternion.sum(axis=1))
            raise _diverged(repr(self.solids[int(np.flatnonzero(bad)[0])].label))
        joined = self._conductor[placed.seen]
        seen = np.flatnonzero(placed.seen | (np.isin(self._conductor, joined[joined >= 0])))
        bodies = [self._bodies[i] for i in seen.tolist()]
        poses = zip(placed.position[seen].tolist(), placed.quaternion[seen].tolist(), strict=True)
        parts = [
            self._near(i, b.moved(Pose(*p)))
            for i, b, p in zip(seen.tolist(), bodies, poses, strict=True)
        ]
        if contacts and cover is not None:
            sensor = Pose(frames.sensor_position, frames.sensor_quaternion)
            parts = pressed(parts, self._layout.frame[seen].tolist(), contacts, sensor, cover)
        return Scene(parts + self._soft_bodies(frames) if self.soft else parts)

    def names(self, frames: set[int]) -> set[str | None]:
        """What the bodies that some frames carry are called in scenes."""
        pairs = zip(self.solids, self._bodies, strict=True)
        return {body.name for solid, body in pairs if solid.frame in frames}

    def _depth(self, solid: Solid) -> float:
        """Thickness [m] of the plate that stands for a half space; 0 for any other shape."""
        half_space = isinstance(solid.shape, HalfSpace)
        return plate_thickness(self.domain, solid.material) if half_space else 0.0

    def _near(self, index: int, body: Body) -> Body:
        """A body that is placed; of a terrain, the part that reaches into the domain."""
        terrain = self.solids[index].shape
        if not isinstance(terrain, Terrain):
            return body
        middle = body.pose.inverse().apply(0.5 * (self._lower + self._upper))
        return replace(body, shape=terrain.near(middle, 0.5 * max(self.domain.size)))

    def _soft_bodies(self, frames: Frames) -> list[Body]:
        """The deformables that reach into the domain, as they are now."""
        from capsense.scene.scene import DeformableSurface

        rotation = Pose((0, 0, 0), frames.sensor_quaternion).rotation
        out = []
        for k, soft in enumerate(self.soft):
            vertices = (soft.vertices() - frames.sensor_position) @ rotation
            low, high = vertices.min(axis=0), vertices.max(axis=0)
            if not np.isfinite(low.sum() + high.sum()):
                raise _diverged(repr(soft.label))
            if np.any(low >= self._upper) or np.any(high <= self._lower):
                continue
            surface = self._surfaces[k]
            try:
                if surface is None:
                    surface = self._surfaces[k] = DeformableSurface(
                        vertices, soft.faces, thickness=soft.thickness,
                        material=soft.material, grounding=soft.tie.grounding, name=soft.label,
                    )  # fmt: skip
                else:
                    surface.vertices = vertices
                out.append(replace(surface.body(), conductor=soft.tie.conductor(soft.tree)))
            except SceneError as error:
                raise SceneError(f"{soft.label!r}: {error}") from None
        return out


def _diverged(what: str) -> SceneError:
    return SceneError(
        f"the simulation has diverged: {what} stands at a place that is not finite; set the "
        "simulation back, and take a smaller time step or gentler controls"
    )


@kernel
def _multiply(a: Array, b: Array, out: Array) -> None:
    """Quaternion product a b, (x, y, z, w)."""
    x1, y1, z1, w1 = a[0], a[1], a[2], a[3]
    x2, y2, z2, w2 = b[0], b[1], b[2], b[3]
    out[0] = w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2
    out[1] = w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2
    out[2] = w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2
    out[3] = w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2


@kernel
def _rotate(q: Array, v: Array, out: Array) -> None:
    """Turn v by the unit quaternion q: v + 2 u × (u × v + w v), with q = (u, w)."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    vx, vy, vz = v[0], v[1], v[2]
    cx = y * vz - z * vy + w * vx
    cy = z * vx - x * vz + w * vy
    cz = x * vy - y * vx + w * vz
    out[0] = vx + 2.0 * (y * cz - z * cy)
    out[1] = vy + 2.0 * (z * cx - x * cz)
    out[2] = vz + 2.0 * (x * cy - y * cx)


@compiled
def place_solids(
    frames: Frames, layout: Layout, lower: Array, upper: Array, placed: Placed
) -> None:
    """Find where solids stand in the sensor frame, and which of them reach into its domain.

    Args:
        frames: Where the moving frames and the sensor are.
        layout: The solids in their frames.
        lower: Lower corner of the domain [m] in the sensor frame, shape (3,).
        upper: Upper corner, shape (3,).
        placed: Receives the result.
    """
    position, quaternion, seen = placed.position, placed.quaternion, placed.seen
    depth = layout.depth
    inverse = frames.sensor_quaternion * np.array([-1.0, -1.0, -1.0, 1.0])
    turn, arm, axis = np.empty(4), np.empty(3), np.empty(3)
    middle, reach = np.empty(3), np.empty(3)
    for i in range(layout.frame.shape[0]):
        f = layout.frame[i]
        _multiply(frames.quaternion[f], layout.quaternion[i], turn)
        _rotate(frames.quaternion[f], layout.position[i], arm)
        for k in range(3):
            arm[k] += frames.position[f, k] - frames.sensor_position[k]
        _multiply(inverse, turn, quaternion[i])
        _rotate(inverse, arm, position[i])
        if depth[i] > 0.0:
            axis[:] = 0.0
            axis[2] = 1.0
            _rotate(quaternion[i], axis, arm)
            above, extent = 0.0, 0.0
            for k in range(3):
                above += arm[k] * (0.5 * (lower[k] + upper[k]) - position[i, k])
                extent += abs(arm[k]) * 0.5 * (upper[k] - lower[k])
            for k in range(3):
                foot = 0.5 * (lower[k] + upper[k]) - above * arm[k]
                position[i, k] = foot - 0.5 * depth[i] * arm[k]
            seen[i] = above < extent
            continue
        _rotate(quaternion[i], layout.centre[i], middle)
        reach[:] = 0.0
        for j in range(3):
            axis[:] = 0.0
            axis[j] = layout.half[i, j]
            _rotate(quaternion[i], axis, arm)
            for k in range(3):
                reach[k] += abs(arm[k])
        seen[i] = True
        for k in range(3):
            at = position[i, k] + middle[k]
            if at - reach[k] >= upper[k] or at + reach[k] <= lower[k]:
                seen[i] = False
