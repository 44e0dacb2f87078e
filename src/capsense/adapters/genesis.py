"""Sensors in Genesis: ``scene.add_sensor(Capacitance(…))``, or ``GenesisSensors`` beside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, Unpack

import genesis as gs
import numpy as np
import torch
import trimesh
import warp as wp
from genesis.engine.sensors.base_sensor import SimpleSensor, SimpleSensorMetadata
from genesis.options.sensors.options import RigidSensorOptionsMixin, SimpleSensorOptions
from genesis.utils.geom import euler_to_quat

from capsense._style import signal_colours, strength
from capsense.adapters.grounds import Ground
from capsense.adapters.meshes import Terrain, primitive, solid_mesh, terrain_shape
from capsense.adapters.parallel import FleetOptions, ParallelSensors, WorldShape
from capsense.adapters.rules import Rules, matches, split_rules
from capsense.adapters.world import HalfSpace
from capsense.design import load_design
from capsense.design.model import Design
from capsense.errors import SceneError
from capsense.reading import FleetReading
from capsense.readout.config import make_readout
from capsense.scene import Pose, Shape
from capsense.simulator import DEFAULT_DESIGN, Simulator

_ORDER = [1, 2, 3, 0]
"""From quaternions (w, x, y, z) to (x, y, z, w)."""
_SLACK = 1e-6
"""An environment is due so much before its period is over [s], as in Isaac Lab."""
_BASE = 0.1
"""Depth of the floor of a terrain below its lowest point, over its half width."""


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

    Collision geoms of rigid entities are seen, by the names of their links, planes and terrains
    included, as each environment has them. Matter that is not rigid is not.

    Args:
        scene: The scene, built.
        sites: Where the sensors sit.
        design: A design, its name, or the path of its file, for all sites.
        options: What is seen and what it is made of, by the names of links; and ``device``,
            ``preset``, ``budget``, ``readout``, ``randomisation``, ``seed``, ``history_length``.
            All are those of :class:`~capsense.adapters.parallel.FleetOptions`.

    Raises:
        SceneError: A pattern fits nothing, or nothing can be seen.
        DesignError: The design is wrong.
        ReadoutError: As by :meth:`Fleet.use_readout`.
    """

    def __init__(
        self,
        scene: Any,
        sites: Sequence[LinkSite],
        design: Design | str | Path = DEFAULT_DESIGN,
        **options: Unpack[FleetOptions],
    ) -> None:
        rules, other = split_rules(options, FleetOptions)
        if rules.shapes != "collision":
            raise SceneError(
                f"shapes is {rules.shapes!r}; of a scene of Genesis only what collides is seen: "
                "leave shapes out"
            )
        self._solver = scene.sim.rigid_solver
        worlds, device = max(int(scene.n_envs), 1), wp.get_device(str(gs.device))
        parts: list[WorldShape] = []
        poses: list[tuple[float, ...]] = []
        for tree, entity in enumerate(self._solver.entities):
            for link in entity.links:
                for geom in link.geoms:
                    tie = rules.tie_of((link.name,))
                    own = Pose(np.asarray(geom.init_pos), np.asarray(geom.init_quat)[_ORDER])
                    shape, pose = _shape(geom, entity, link.name, rules)
                    own = own @ pose
                    each: Any
                    if isinstance(shape, Shape):
                        body, where = rules.body(shape, (link.name,)), geom.active_envs_mask
                        each = body if where is None else [
                            body if x else None for x in where.tolist()
                        ]  # fmt: skip
                    else:
                        each = Ground(shape, rules.material_of((link.name,)), tie.grounding)
                    parts.append(WorldShape((link.name,), link.idx, tree, tie, each))
                    poses.append((*own.position, *own.quaternion))
        carriers = [("world", -1) if s.link is None else (s.link.name, s.link.idx) for s in sites]
        super().__init__(parts, carriers, worlds, design, rules, device, other)
        seen = [parts[k].body for k in self.chosen], [poses[k] for k in self.chosen]
        at = [k for _, k in carriers], [(*s.position, *s.quaternion) for s in sites]

        def everywhere(values: Any, kind: type) -> Any:
            array: Any = np.asarray(values, kind)
            return np.broadcast_to(array, (worlds, *array.shape)).copy()

        self._fix(*((everywhere(n, np.int32), everywhere(p, np.float32)) for n, p in (seen, at)))

    def read(self, *, time: Any = None, environments: Any = None) -> FleetReading:
        """Return the readings of all environments at the scene's state, shape (worlds, sites, …).

        Args:
            time: As of :meth:`Fleet.step`, where a readout is used. ``scene.sim.get_time()`` has
                each environment's own.
            environments: Which environments are solved, as of :meth:`Fleet.step`; all by default.

        Raises:
            ReadoutError: As by :meth:`Fleet.step`.
            SolveError: As by :meth:`Fleet.step`.
        """
        place, turn = self._solver.get_links_pos(), self._solver.get_links_quat()
        poses = torch.cat([place, turn[..., _ORDER]], dim=-1).float()
        poses = poses.reshape(self.fleet.count, -1, 7).contiguous()
        self._follow(wp.from_torch(poses, dtype=wp.transform))
        return self._read(time, environments)


def _shape(
    geom: Any, entity: Any, name: str, rules: Rules
) -> tuple[Shape | HalfSpace | Terrain, Pose]:
    """A geom as a shape, and where its frame is in the geom's."""
    kind, here = gs.GEOM_TYPE(geom.type).name, Pose()
    if kind == "TERRAIN":
        return _terrain(entity, name, rules)
    a, b, c = np.asarray(geom.data, float)[:3].tolist()
    if kind == "PLANE":
        return HalfSpace(), _upright((a, b, c))
    shape = None
    if kind in ("CAPSULE", "CYLINDER"):
        shape = primitive(kind, (a, 0.5 * b, 0.0))
    elif kind == "BOX":
        shape = primitive(kind, (0.5 * a, 0.5 * b, 0.5 * c))
    elif kind != "MESH":
        shape = primitive(kind, (a, b, c))
    if shape is None:
        hull = rules.takes_hull((name,))
        shape = solid_mesh(geom.init_verts, geom.init_faces, name, hull=hull)
    return shape, here


def _upright(normal: tuple[float, float, float]) -> Pose:
    """A frame whose z axis is a normal."""
    x, y, z = np.array(normal) / np.linalg.norm(normal)
    if z < -1.0 + 1e-12:
        return Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    turn = np.array([-y, x, 0.0, 1.0 + z])
    return Pose((0.0, 0.0, 0.0), turn / np.linalg.norm(turn))


def _terrain(entity: Any, name: str, rules: Rules) -> tuple[Shape | Terrain, Pose]:
    """A terrain, whose frame in Genesis is at a corner; heights there run along x first."""
    heights = np.asarray(entity.terrain_hf, float).T
    half = [0.5 * float(entity.terrain_scale[0]) * (n - 1) for n in heights.T.shape]
    base = max(0.0, -float(heights.min())) + _BASE * max(half)
    solid = not rules.material_of((name,)).is_conductor()
    shape = terrain_shape(heights, (half[0], half[1]), base, name, solid=solid)
    return shape, Pose((half[0], half[1], 0.0))


class CapacitanceReading(NamedTuple):
    """What ``read()`` of a sensor gives: tensors of shape (environments, sites, …).

    With Genesis's own ``history_length`` there is an axis for it after that of the environments.
    """

    delta: torch.Tensor
    """Change of the Maxwell matrices by the bodies [F], (…, n, n)."""
    capacitance: torch.Tensor
    """The matrices [F], (…, n, n)."""
    conductance: torch.Tensor
    """Conductance that matter with losses adds [S], (…, n, n)."""
    error: torch.Tensor
    """Estimated error of the largest entry [F]."""
    time: torch.Tensor
    """Time of the reading [s], without an axis for sites."""
    force: torch.Tensor
    """Force that the cover carries above each electrode [N], (…, n); (…, 0) without a cover."""
    compression: torch.Tensor
    """Largest compression of the cover above each electrode [m], the same shape."""
    total: torch.Tensor
    """Force that the whole cover carries [N], 0 without a cover."""
    codes: torch.Tensor
    """What the chips' registers hold, whole numbers, (…, k); (…, 0) without a readout. In Genesis's
    single precision they are exact up to 24 bits, with ``gs.init(precision="64")`` all are."""
    measured: torch.Tensor
    """What a user makes of the codes [F], the same shape."""
    ages: torch.Tensor
    """Time since the results could be read [s], infinite where there is none, the same shape."""


_IMPERFECTIONS = ("resolution", "bias", "random_walk", "noise")
_NOISY = 2
"""So many of these first have the noise, bias and resolution of Genesis's options."""


class Capacitance(
    RigidSensorOptionsMixin["CapacitanceSensor"], SimpleSensorOptions["CapacitanceSensor"]
):
    """Options of capacitive proximity sensors, for ``scene.add_sensor``.

    ``read()`` gives a :class:`CapacitanceReading`; from a reset to the next step it is that of a
    sensor in an empty environment, at 0 s, without codes. Genesis's own options for noise, bias and
    resolution make something of the capacitances alone; those for delay, jitter and history are for
    all of it. With ``draw_debug`` electrodes are drawn, coloured by the signals of the first
    environment that is drawn.
    """

    design: Any = DEFAULT_DESIGN
    """A design, its name, or the path of its file."""
    links: tuple[str, ...] = ()
    """Name patterns of the entity's links, each of which gets a sensor; by default there is one, on
    the link of ``link_idx_local``."""
    update_period: float = 0.0
    """Time from one reading of an environment to the next [s]; by default all are read at each
    step."""
    readout: Any = None
    """A readout, a chip's name, or the path of a readout file, for codes and ages."""
    randomisation: Any = None
    """In what chips differ, drawn anew at a reset: a ``ReadoutRandomisation``."""
    seed: int | None = None
    """Of all random numbers of the chips; by default the readout's own."""
    options: dict[str, Any] = {}  # noqa: RUF012 - pydantic copies it
    """Others of :class:`~capsense.adapters.parallel.FleetOptions`."""

    def alike(self, other: Capacitance) -> bool:
        """Whether sensors of these options can share a fleet."""
        names = ("design", "options", "readout", "randomisation", "seed", "update_period")
        return all(_same(getattr(self, n), getattr(other, n)) for n in names)


def _same(one: Any, two: Any) -> bool:
    plain = (str, int, float, Path, dict, type(None))
    return one is two or (isinstance(one, plain) and isinstance(two, plain) and one == two)


@dataclass
class _Asked:
    """A sensor that was added to a scene."""

    options: Capacitance
    sites: list[LinkSite]
    size: int
    """How many numbers it gives."""


@dataclass
class _Group:
    """Sensors that share a fleet."""

    sensors: GenesisSensors
    rows: list[slice]
    """Rows of the data of each."""
    sites: list[slice]
    """Its sites among those of the fleet."""
    period: float
    read_at: torch.Tensor
    """When each environment was read last [s]."""


@dataclass
class CapacitanceMetadata(SimpleSensorMetadata):
    """All capacitive sensors of a scene."""

    asked: list[_Asked] = field(default_factory=list)
    """The sensors, in order."""
    groups: list[_Group] = field(default_factory=list)
    """Their fleets."""
    manager: Any = None
    """Genesis's manager of all sensors."""
    imperfect: bool = False
    """Whether any has noise, bias or a resolution."""

    @property
    def scene(self) -> Any:
        """The scene of the sensors."""
        return self.manager._sim.scene

    def start(self) -> None:
        """Make one fleet for all sensors of one design and the same options."""
        rows = np.cumsum([0, *(each.size for each in self.asked)]).tolist()
        left = list(range(len(self.asked)))
        while left:
            first = self.asked[left[0]].options
            alike = [k for k in left if self.asked[k].options.alike(first)]
            left = [k for k in left if k not in alike]
            sites = [site for k in alike for site in self.asked[k].sites]
            ends = np.cumsum([0, *(len(self.asked[k].sites) for k in alike)]).tolist()
            given = dict(first.options)
            for name in ("readout", "randomisation", "seed"):
                if getattr(first, name) is not None:
                    given[name] = getattr(first, name)
            sensors = GenesisSensors(self.scene, sites, first.design, **given)
            never = torch.full((sensors.fleet.count,), -torch.inf, dtype=torch.float64)
            self.groups.append(
                _Group(
                    sensors,
                    [slice(rows[k], rows[k + 1]) for k in alike],
                    [slice(a, b) for a, b in pairwise(ends)],
                    first.update_period, never.to(gs.device),
                )
            )  # fmt: skip

    def read(self, data: torch.Tensor) -> None:
        """Read what is due, and enter all readings into the data, shape (numbers, worlds)."""
        if not self.groups:
            self.start()
        time = torch.as_tensor(self.scene.sim.get_time(), device=gs.device).double().reshape(-1)
        for group in self.groups:
            due = time - group.read_at + _SLACK >= group.period
            group.sensors.read(time=time, environments=due)
            group.read_at = torch.where(due, time, group.read_at)
            self.enter(group, data)

    def enter(self, group: _Group, data: torch.Tensor) -> None:
        """Enter the readings of a fleet into the data."""
        found = group.sensors.data.torch()
        worlds = len(found.time)
        nothing = torch.zeros((worlds, len(group.sensors.sites), 0), device=found.delta.device)
        none = torch.zeros_like(found.error)
        for rows, sites in zip(group.rows, group.sites, strict=True):
            parts = []
            for name in CapacitanceReading._fields:
                values = getattr(found, name)
                if values is None:
                    values = none if name == "total" else nothing
                part = values if name == "time" else values[:, sites]
                parts.append(part.reshape(worlds, -1).to(data))
            data[rows].copy_(torch.cat(parts, dim=1).T)


class CapacitanceSensor(SimpleSensor[Capacitance, None, CapacitanceMetadata, CapacitanceReading]):
    """Capacitive proximity sensors on links; made by ``scene.add_sensor(Capacitance(…))``."""

    def build(self) -> None:
        """Take note of the sensor; fleets are made when the scene is."""
        super().build()
        metadata = self._shared_metadata
        metadata.manager = self._manager
        metadata.asked.append(_Asked(self._options, self._sites(), self._cache_size))
        self._keep_clean()

    def _set_metadata_field(self, *args: Any, **options: Any) -> None:
        super()._set_metadata_field(*args, **options)
        self._keep_clean()

    def _keep_clean(self) -> None:
        """Leave all but the capacitances without noise, bias and resolution."""
        metadata = self._shared_metadata
        clean = slice(self._cache_offset + self._noisy(), self._cache_offset + self._cache_size)
        given = [getattr(metadata, name) for name in _IMPERFECTIONS]
        for values in given:
            values[:, clean] = 0.0
        metadata.imperfect = any(bool(values.any()) for values in given)

    def _noisy(self) -> int:
        """How many of the first numbers are capacitances."""
        return sum(int(np.prod(shape)) for shape in self._get_return_format()[:_NOISY])

    def _sites(self) -> list[LinkSite]:
        given = self._options
        turn = np.asarray(euler_to_quat([given.euler_offset]), float).reshape(-1)[_ORDER]
        if given.entity_idx < 0:
            links: list[Any] = [None]
        else:
            entity = self._manager._sim.entities[given.entity_idx]
            links = [entity.links[given.link_idx_local]]
            if given.links:
                links = [x for x in entity.links if any(matches(p, (x.name,)) for p in given.links)]
                for p in given.links:
                    if not any(matches(p, (x.name,)) for x in entity.links):
                        names = [x.name for x in entity.links]
                        raise SceneError(f"links: no link fits {p!r}; there are {names}")
        return [LinkSite(link, given.pos_offset, tuple(turn.tolist())) for link in links]

    @cached_property
    def _loaded(self) -> Design:
        design = self._options.design
        return design if isinstance(design, Design) else load_design(design)

    def _get_return_format(self) -> tuple[tuple[int, ...], ...]:
        design, readout = self._loaded, self._options.readout
        n, s, k = len(design.electrodes), len(self._sites()), 0
        if readout is not None:
            k = len(make_readout(readout, Simulator(design)).bank)
        pressed = n if design.cover is not None else 0
        return (
            (s, n, n), (s, n, n), (s, n, n), (s,), (1,), (s, pressed), (s, pressed), (s,),
            (s, k), (s, k), (s, k),
        )  # fmt: skip

    @classmethod
    def _get_cache_dtype(cls) -> torch.dtype:
        return gs.tc_float

    @classmethod
    def reset(
        cls, shared_metadata: CapacitanceMetadata, shared_ground_truth_cache: torch.Tensor,
        envs_idx: Any,
    ) -> None:  # fmt: skip
        """Restart the chips of some environments, and read them at the next step."""
        super().reset(shared_metadata, shared_ground_truth_cache, envs_idx)
        for group in shared_metadata.groups:
            group.read_at[envs_idx] = -torch.inf
            worlds = torch.zeros_like(group.read_at, dtype=torch.bool)
            worlds[envs_idx] = True
            group.sensors.reset(worlds)
            shared_metadata.enter(group, shared_ground_truth_cache)
        if shared_metadata.groups:  # Genesis has set to zero what a read gives
            blank = shared_ground_truth_cache.T[envs_idx]
            manager = shared_metadata.manager
            for caches in (manager._return_cache, manager._ground_truth_return_cache):
                caches[cls][envs_idx] = blank
            for rings in (
                manager._measured_return_timeline_ring, manager._ground_truth_return_timeline_ring,
            ):  # fmt: skip
                if cls in rings:
                    rings[cls].buffer[:, envs_idx] = blank

    @classmethod
    def _update_raw_data(
        cls, shared_context: None, shared_metadata: CapacitanceMetadata, raw_data_T: torch.Tensor
    ) -> None:
        shared_metadata.read(raw_data_T)

    @classmethod
    def _apply_hardware_imperfections(
        cls, shared_metadata: CapacitanceMetadata, measured_slot_0: torch.Tensor
    ) -> None:
        """Do as Genesis does, but also where numbers are as small as capacitances are [F]."""
        given, data = shared_metadata, measured_slot_0
        if not given.imperfect:
            return
        given._cur_random_walk += torch.normal(0.0, given.random_walk)
        data += given._cur_random_walk + given.bias + torch.normal(0.0, given.noise)
        step = given.resolution
        data.copy_(torch.where(step > 0.0, torch.round(data / step) * step, data))

    def _draw_debug(self, context: Any, envs_idx: list[int]) -> list[tuple[None, Any, None]]:
        """Make meshes of the electrodes, coloured by the signals of the first rendered one."""
        if 0 not in envs_idx or not self._shared_metadata.groups:
            return []
        metadata = self._shared_metadata
        own = next(k for k, each in enumerate(metadata.asked) if each.options is self._options)
        start = sum(each.size for each in metadata.asked[:own])
        group, sites = next(
            (g, sites) for g in metadata.groups
            for rows, sites in zip(g.rows, g.sites, strict=True) if rows.start == start
        )  # fmt: skip
        shown = list(context.rendered_envs_idx)
        surfaces = [e.surface.triangles for e in group.sensors.design.electrodes]
        corners = np.concatenate(surfaces)
        owner = np.repeat(np.arange(len(surfaces)), [3 * len(t) for t in surfaces])
        out = []
        delta = group.sensors.data.torch().delta
        for s in range(sites.start, sites.stop):
            change = delta[shown[0], s].diagonal().numpy(force=True)
            colours = np.full((len(owner), 4), 255, np.uint8)
            colours[:, :3] = signal_colours(strength(change))[owner]
            mesh = trimesh.Trimesh(
                corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3),
                vertex_colors=colours, process=False,
            )  # fmt: skip
            poses = np.tile(np.eye(4), (len(shown), 1, 1))
            frames = group.sensors.frames()[shown, s]
            for k, frame in enumerate(frames):
                pose = Pose(frame[:3], frame[3:])
                poses[k, :3, :3], poses[k, :3, 3] = pose.rotation, frame[:3]
            out.append((None, context.make_debug_mesh(mesh, T=poses), None))
        return out
