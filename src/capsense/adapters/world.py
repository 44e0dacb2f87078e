"""The solids of a simulator: made once, placed in the sensor frame at every reading."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from capsense.adapters.meshes import Terrain
from capsense.adapters.rules import Tie
from capsense.design.model import Domain
from capsense.errors import SceneError
from capsense.scene import Body, Box, Material, Pose, Scene, Shape
from capsense.scene.surface_mesh import SHEET_THICKNESS

if TYPE_CHECKING:
    from capsense.scene.deformable import DeformableSurface

Array = NDArray[np.float64]


_PLATE = 0.1
"""Thickness over width of the plate that stands for a conducting half space."""


@dataclass(frozen=True)
class HalfSpace:
    """Everything below the plane z = 0 of its own frame, such as a floor."""


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


@dataclass(frozen=True, eq=False)
class Frames:
    """Where the moving frames of a simulator, and the sensor, are at one instant."""

    position: Array
    """Origins [m] in the simulator's world, shape (f, 3)."""
    quaternion: Array
    """Unit quaternions (x, y, z, w), shape (f, 4)."""
    sensor_position: Array
    """Origin of the sensor frame [m], shape (3,)."""
    sensor_quaternion: Array
    """Unit quaternion of the sensor frame, shape (4,)."""


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
        self._frame = np.array([s.frame for s in self.solids], dtype=np.int64)
        self._local_position = np.array([s.pose.position for s in self.solids]).reshape(n, 3)
        self._local_quaternion = np.array([s.pose.quaternion for s in self.solids]).reshape(n, 4)
        self._depth = np.array([edge * _thickness(s) for s in self.solids])
        self._bodies = []
        boxes = np.zeros((n, 2, 3))
        taken: dict[str, int] = {}
        for i, solid in enumerate(self.solids):
            boxes[i] = 0.0 if isinstance(solid.shape, HalfSpace) else solid.shape.bounds()
            plate = Box((edge, edge, edge * (_thickness(solid) or 1.0)))
            shape = solid.shape if isinstance(solid.shape, Shape) else plate
            count = taken[solid.label] = taken.get(solid.label, 0) + 1
            label = solid.label if count == 1 else f"{solid.label}#{count}"
            self._bodies.append(Body(shape, Pose(), solid.material, solid.tie.grounding, label))
        owners = list(dict.fromkeys(s.tie.owner for s in self.solids))
        self._sharing = np.array(
            [
                -1 if isinstance(s.tie.grounding, str) else owners.index(s.tie.owner)
                for s in self.solids
            ],
            dtype=np.int64,
        )
        self._surfaces: list[DeformableSurface | None] = [None] * len(self.soft)
        self._tied: dict[tuple[int, int], Body] = {}
        self._centre = boxes.mean(axis=1)
        self._half = 0.5 * (boxes[:, 1] - boxes[:, 0])
        self._lower, self._upper = self.domain.lower, self.domain.upper
        self._position = np.empty((n, 3))
        self._quaternion = np.empty((n, 4))
        self._seen = np.zeros(n, dtype=np.bool_)

    def scene(self, frames: Frames) -> Scene:
        """The solids that reach into the domain, in the sensor frame.

        Raises:
            SceneError: A frame stands at no finite place.
        """
        from capsense.adapters.kernels import place_solids

        place_solids(
            frames.position, frames.quaternion, self._frame, self._local_position,
            self._local_quaternion, self._centre, self._half, self._depth,
            frames.sensor_position, frames.sensor_quaternion, self._lower, self._upper,
            self._position, self._quaternion, self._seen,
        )  # fmt: skip
        if not np.isfinite(frames.sensor_position.sum() + frames.sensor_quaternion.sum()):
            raise _diverged("the sensor's link")
        if not np.isfinite(self._position.sum() + self._quaternion.sum()):
            bad = ~np.isfinite(self._position.sum(axis=1) + self._quaternion.sum(axis=1))
            raise _diverged(repr(self.solids[int(np.flatnonzero(bad)[0])].label))
        seen = np.flatnonzero(self._seen)
        sharing = self._sharing[seen]
        bodies = [self._bodies[i] for i in seen.tolist()]
        if sharing.max(initial=-1) >= 0:
            count = np.bincount(sharing + 1)[sharing + 1]
            for k in np.flatnonzero(sharing >= 0).tolist():
                bodies[k] = self._share(int(seen[k]), int(count[k]))
        poses = zip(self._position[seen].tolist(), self._quaternion[seen].tolist(), strict=True)
        placed = [
            part
            for i, b, p in zip(seen.tolist(), bodies, poses, strict=True)
            for part in self._parts(i, b.moved(Pose(*p)))
        ]
        return Scene(placed + self._soft_bodies(frames) if self.soft else placed)

    def _parts(self, index: int, body: Body) -> list[Body]:
        """A body that is placed; of a terrain, the tiles that reach into the domain."""
        terrain = self.solids[index].shape
        if not isinstance(terrain, Terrain):
            return [body]
        middle = body.pose.inverse().apply(0.5 * (self._lower + self._upper))
        tiles = terrain.near(middle, 0.5 * self._reach)
        ground = body.grounding
        tie = ground if isinstance(ground, str) else ground / max(1, len(tiles))
        return [
            Body(tile, body.pose, body.material, tie, body.name if k == 0 else f"{body.name}/{k}")
            for k, tile in enumerate(tiles)
        ]

    def _soft_bodies(self, frames: Frames) -> list[Body]:
        """The deformables that reach into the domain, as they are now."""
        from capsense.scene.deformable import DeformableSurface

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
                out.append(surface.body())
            except SceneError as error:
                raise SceneError(f"{soft.label!r}: {error}") from None
        return out

    def _share(self, index: int, count: int) -> Body:
        """A body that has one of ``count`` equal shares of its capacitance to ground."""
        key = index, count
        if key not in self._tied:
            b = self._bodies[index]
            assert not isinstance(b.grounding, str)
            self._tied[key] = Body(b.shape, b.pose, b.material, b.grounding / count, b.name)
        return self._tied[key]


def _thickness(solid: Solid) -> float:
    """Of the plate that stands for a half space, over its width; 0 for any other shape.

    A conductor's charge is on its face: its panels are better spent there than on a cube.
    """
    if not isinstance(solid.shape, HalfSpace):
        return 0.0
    return _PLATE if solid.material.is_conductor() else 1.0


def _diverged(what: str) -> SceneError:
    return SceneError(
        f"the simulation has diverged: {what} stands at a place that is not finite; set the "
        "simulation back, and take a smaller time step or gentler controls"
    )
