"""Sensors in Genesis: ``scene.add_sensor(Capacitance(…))``, or ``GenesisSensors`` beside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Unpack

import genesis as gs
import numpy as np
import torch
import warp as wp
from genesis.engine.sensors.base_sensor import SimpleSensor, SimpleSensorMetadata
from genesis.options.sensors.options import RigidSensorOptionsMixin, SimpleSensorOptions
from genesis.utils.geom import euler_to_quat

from capsense.adapters.meshes import primitive, solid_mesh
from capsense.adapters.parallel import FleetOptions, ParallelSensors, WorldShape, warn_left_out
from capsense.adapters.rules import Rules, split_rules
from capsense.design import load_design
from capsense.design.model import Design
from capsense.reading import FleetReading
from capsense.scene import Shape
from capsense.simulator import DEFAULT_DESIGN

_ORDER = [1, 2, 3, 0]
"""From quaternions (w, x, y, z) to (x, y, z, w)."""


@dataclass(frozen=True)
class LinkSite:
    """Where a sensor sits."""

    link: Any
    """A link of a rigid entity, or None for the world itself."""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """[m], in the link's frame."""
    quaternion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    """(x, y, z, w)."""


class GenesisSensors(ParallelSensors):
    """Sensors on links of a Genesis scene, in all of its environments.

    Collision geoms of rigid entities are seen, by the names of their links. Planes, terrains and
    matter that is not rigid are not.

    Args:
        scene: The scene, built.
        sites: Where the sensors sit.
        design: A design, its name, or the path of its file, for all sites.
        options: What is seen and what it is made of, by the names of links; and ``device``,
            ``preset``, ``budget``. All are those of
            :class:`~capsense.adapters.parallel.FleetOptions`.

    Raises:
        SceneError: A pattern fits nothing, or nothing can be seen.
        DesignError: The design is wrong.
    """

    def __init__(
        self,
        scene: Any,
        sites: Sequence[LinkSite],
        design: Design | str | Path = DEFAULT_DESIGN,
        **options: Unpack[FleetOptions],
    ) -> None:
        rules, other = split_rules(options, FleetOptions)
        self._solver = scene.sim.rigid_solver
        worlds, device = max(int(scene.n_envs), 1), wp.get_device(str(gs.device))
        parts: list[WorldShape] = []
        poses: list[tuple[float, ...]] = []
        left: list[str] = []
        for tree, entity in enumerate(self._solver.entities):
            for link in entity.links:
                for geom in link.geoms:
                    shape = _shape(geom, link.name, rules)
                    if shape is None:
                        left.append(link.name)
                        continue
                    body = rules.body(shape, (link.name,))
                    where = geom.active_envs_mask
                    each = body if where is None else [body if x else None for x in where.tolist()]
                    tie = rules.tie_of((link.name,))
                    parts.append(WorldShape((link.name,), link.idx, tree, tie.owner, each))
                    turn = np.asarray(geom.init_quat)[_ORDER]
                    poses.append((*np.asarray(geom.init_pos).tolist(), *turn.tolist()))
        warn_left_out(left, "a fleet sees no planes and terrains")
        carriers = [("world", -1) if s.link is None else (s.link.name, s.link.idx) for s in sites]
        super().__init__(parts, carriers, worlds, design, rules, device, other)
        seen = [parts[k].body for k in self.chosen], [poses[k] for k in self.chosen]
        at = [k for _, k in carriers], [(*s.position, *s.quaternion) for s in sites]

        def everywhere(values: Any, kind: type) -> Any:
            array: Any = np.asarray(values, kind)
            return np.broadcast_to(array, (worlds, *array.shape)).copy()

        self._fix(*((everywhere(n, np.int32), everywhere(p, np.float32)) for n, p in (seen, at)))

    def read(self, *, time: float | None = None) -> FleetReading:
        """Return the readings of all environments at the scene's state, shape (worlds, sites, …).

        Args:
            time: As of :meth:`Fleet.step`, where a readout is used.

        Raises:
            ReadoutError: As by :meth:`Fleet.step`.
            SolveError: As by :meth:`Fleet.step`.
        """
        place, turn = self._solver.get_links_pos(), self._solver.get_links_quat()
        poses = torch.cat([place, turn[..., _ORDER]], dim=-1).float()
        poses = poses.reshape(self.fleet.count, -1, 7).contiguous()
        self._follow(wp.from_torch(poses, dtype=wp.transform))
        return self._read(time)


def _shape(geom: Any, name: str, rules: Rules) -> Shape | None:
    kind = gs.GEOM_TYPE(geom.type).name
    a, b, c = np.asarray(geom.data, float)[:3].tolist()
    if kind in ("CAPSULE", "CYLINDER"):
        return primitive(kind, (a, 0.5 * b, 0.0))
    if kind == "BOX":
        return primitive(kind, (0.5 * a, 0.5 * b, 0.5 * c))
    if kind != "MESH":
        return primitive(kind, (a, b, c))
    return solid_mesh(geom.init_verts, geom.init_faces, name, hull=rules.takes_hull((name,)))


class Capacitance(
    RigidSensorOptionsMixin["CapacitanceSensor"], SimpleSensorOptions["CapacitanceSensor"]
):
    """Options of a capacitive proximity sensor, for ``scene.add_sensor``.

    ``read()`` gives the change of the Maxwell matrix by the bodies [F], shape (worlds, n, n), with
    what Genesis's own options for noise and delay make of it.
    """

    design: Any = DEFAULT_DESIGN
    """A design, its name, or the path of its file."""
    options: dict[str, Any] = {}  # noqa: RUF012 - pydantic copies it
    """Those of :class:`~capsense.adapters.parallel.FleetOptions`."""


@dataclass
class CapacitanceMetadata(SimpleSensorMetadata):
    """All capacitive sensors of a scene."""

    asked: list[tuple[Any, LinkSite, int]] = field(default_factory=list)
    """Options of each sensor, where it sits, and how many numbers it has."""
    groups: list[tuple[GenesisSensors, list[slice]]] = field(default_factory=list)
    """Sensors of one design and their rows of the data."""
    scene: Any = None

    def start(self) -> None:
        """Make one fleet for all sensors of one design and the same options."""
        rows = np.cumsum([0, *(size for *_, size in self.asked)]).tolist()
        left = list(range(len(self.asked)))
        while left:
            first = self.asked[left[0]][0]
            alike = [
                k for k in left
                if self.asked[k][0].design == first.design
                and self.asked[k][0].options == first.options
            ]  # fmt: skip
            left = [k for k in left if k not in alike]
            sites = [self.asked[k][1] for k in alike]
            sensors = GenesisSensors(self.scene, sites, first.design, **first.options)
            self.groups.append((sensors, [slice(rows[k], rows[k + 1]) for k in alike]))


class CapacitanceSensor(SimpleSensor[Capacitance, None, CapacitanceMetadata]):
    """A capacitive proximity sensor on a link; made by ``scene.add_sensor(Capacitance(…))``."""

    def build(self) -> None:
        """Take note of the sensor; fleets are made when the scene is."""
        super().build()
        given, metadata = self._options, self._shared_metadata
        link = None
        if given.entity_idx >= 0:
            link = self._manager._sim.entities[given.entity_idx].links[given.link_idx_local]
        turn = np.asarray(euler_to_quat([given.euler_offset]), float).reshape(-1)[_ORDER]
        metadata.scene = self._manager._sim.scene
        site = LinkSite(link, given.pos_offset, tuple(turn.tolist()))
        metadata.asked.append((given, site, self._cache_size))

    def _get_return_format(self) -> tuple[int, ...]:
        design = self._options.design
        loaded = design if isinstance(design, Design) else load_design(design)
        return (len(loaded.electrodes),) * 2

    @classmethod
    def _get_cache_dtype(cls) -> torch.dtype:
        return gs.tc_float

    @classmethod
    def _update_raw_data(
        cls, shared_context: None, shared_metadata: CapacitanceMetadata, raw_data_T: torch.Tensor
    ) -> None:
        if not shared_metadata.groups:
            shared_metadata.start()
        for sensors, rows in shared_metadata.groups:
            delta = torch.from_dlpack(sensors.read().delta).to(raw_data_T)
            for place, part in enumerate(rows):
                raw_data_T[part].copy_(delta[:, place].flatten(1).T)
