"""Planes and terrains in many worlds: what of them stands near each sensor."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capsense.adapters.meshes import Terrain
from capsense.adapters.world import HalfSpace, plate_thickness
from capsense.design.model import Domain
from capsense.scene import Body, Box, Material, Pose, Sphere
from capsense.scene.materials import Grounding

_ENDLESS = 1e4
"""Width of the plate that stands for a half space [m]; a fleet uses what is near the sensor."""


@dataclass(frozen=True)
class Ground:
    """Matter that goes on below a face, such as a floor or a terrain."""

    shape: HalfSpace | Terrain
    material: Material
    grounding: Grounding

    @property
    def is_terrain(self) -> bool:
        """Whether each sensor has a part of its own of it."""
        return isinstance(self.shape, Terrain)

    def body(self, domain: Domain) -> Body:
        """The plate that stands for a half space; for a terrain, a ball of its matter."""
        plate = plate_thickness(domain, self.material)
        shape = Sphere(0.01) if self.is_terrain else Box((_ENDLESS, _ENDLESS, plate))
        return Body(shape, Pose(), self.material, self.grounding)

    def drop(self, domain: Domain) -> float:
        """How far the middle of its body is below its frame [m]."""
        return 0.0 if self.is_terrain else 0.5 * plate_thickness(domain, self.material)


class TerrainParts:
    """The parts of a terrain that sensors are over.

    Args:
        terrain: The terrain.
        body: A body of its matter, of any shape.
        places: Numbers of the places for its parts, one for each sensor.
        worlds: How many worlds.
        domain: Of the sensors.
    """

    def __init__(
        self, terrain: Terrain, body: Body, places: Sequence[int], worlds: int, domain: Domain
    ) -> None:
        self._terrain, self._body, self._places = terrain, body, places
        self._tiles = np.full((worlds, len(places), 2), -1)
        self._middle, self._reach = domain.sight.mean(axis=0), 0.5 * max(domain.size)
        self.known: dict[tuple[int, int], Body] = {}
        """The parts that were needed so far, by the numbers of their tiles."""

    def moved(
        self, poses: NDArray[Any], frames: NDArray[Any]
    ) -> Iterator[tuple[int, Body, NDArray[np.int64]]]:
        """Places where other parts are needed than before: place, part and worlds.

        Args:
            poses: Of what stands in all places, shape (w, b, 7).
            frames: Of the sensors, shape (w, s, 7).
        """
        for sensor, place in enumerate(self._places):
            at = _applied(frames[:, sensor].astype(float), self._middle)
            seen = _inverse_applied(poses[:, place].astype(float), at)
            now, before = self._terrain.tiles(seen), self._tiles[:, sensor]
            rows = np.flatnonzero((now != before).any(axis=1))
            self._tiles[:, sensor] = now
            for x, y in np.unique(now[rows], axis=0).tolist():
                mine = rows[(now[rows] == (x, y)).all(axis=1)]
                if (x, y) not in self.known:
                    shape = self._terrain.near(seen[mine[0]], self._reach)
                    self.known[x, y] = replace(self._body, shape=shape)
                yield place, self.known[x, y], mine


def _applied(poses: NDArray[Any], point: NDArray[Any]) -> NDArray[Any]:
    """A point (3,) of frames with some poses (n, 7) in the world's, shape (n, 3)."""
    axis, w = poses[:, 3:6], poses[:, 6:]
    turn = 2.0 * np.cross(axis, point)
    return np.asarray(poses[:, :3] + point + w * turn + np.cross(axis, turn))


def _inverse_applied(poses: NDArray[Any], points: NDArray[Any]) -> NDArray[Any]:
    """Points (n, 3) of the world's frame in frames with some poses (n, 7)."""
    off = points - poses[:, :3]
    axis, w = -poses[:, 3:6], poses[:, 6:]
    turn = 2.0 * np.cross(axis, off)
    return np.asarray(off + w * turn + np.cross(axis, turn))
