"""Sensors in all worlds of Newton: ``SensorCapacitance(model, sites="skin_*").update(state)``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from capsense.adapters.grounds import Ground
from capsense.adapters.meshes import primitive, solid_mesh, terrain_shape
from capsense.adapters.parallel import (
    FleetOptions,
    ParallelSensors,
    WorldShape,
    matching,
    warn_left_out,
)
from capsense.adapters.rules import Rules, split_rules
from capsense.adapters.world import HalfSpace
from capsense.design.model import Design
from capsense.errors import SceneError
from capsense.reading import FleetReading
from capsense.scene import Body, Pose, Shape
from capsense.simulator import DEFAULT_DESIGN

Array = NDArray[np.float64]

_BASE = 0.1
"""Depth of the floor of a height field below its lowest point, over its half width."""


class SensorCapacitance(ParallelSensors):
    """Capacitive proximity sensors on sites of a Newton model, in all of its worlds.

    Worlds must hold the same shapes in the same order, as ``ModelBuilder.replicate`` makes them;
    sizes may differ. Shapes outside of all worlds are seen by all. Cones and Gaussians are not
    seen. The sizes in ``model.shape_scale`` are followed, but for planes and height fields; change
    :attr:`fleet` for other materials.

    Args:
        model: The model, after ``ModelBuilder.finalize``.
        sites: Label patterns of the sites; those of the first world decide.
        design: A design, its name, or the path of its file, for all sites. For sites of several
            designs see :meth:`by_design`.
        options: What is seen and what it is made of, by the labels of shapes; and ``device``,
            ``preset``, ``budget``, ``readout``, ``randomisation``, ``seed``, ``history_length``.
            All are those of :class:`~capsense.adapters.parallel.FleetOptions`.

    Raises:
        SceneError: There is no such site, a pattern fits nothing, nothing can be seen, or worlds
            differ in their shapes.
        DesignError: The design is wrong.
        ReadoutError: As by :meth:`Fleet.use_readout`.
    """

    def __init__(
        self,
        model: Any,
        sites: str | Sequence[str],
        design: Design | str | Path = DEFAULT_DESIGN,
        **options: Unpack[FleetOptions],
    ) -> None:
        from newton import ShapeFlags

        rules, other = split_rules(options, FleetOptions)
        table = _by_world(model)
        site = (model.shape_flags.numpy()[table[0]] & int(ShapeFlags.SITE)) != 0
        labels = [model.shape_label[k] for k in table[0].tolist()]
        reader = _Reader(model, rules)
        parts: list[WorldShape] = []
        columns: list[int] = []
        left: list[str] = []
        carrier, trees = model.shape_body.numpy(), _trees(model)
        instead = reader.replaced(table[0], labels)
        for column in np.flatnonzero(~site & ~instead).tolist():
            if not reader.known(table[0, column]):
                left.append(labels[column])
                continue
            bodies: Any = reader.ground(table[0, column], labels[column])
            if bodies is None:
                bodies = [reader.body(k, labels[column]) for k in table[:, column].tolist()]
            link, label = int(carrier[table[0, column]]), labels[column]
            tree = int(trees[link]) if link >= 0 else -1
            parts.append(WorldShape((label,), link, tree, rules.tie_of((label,)), bodies))
            columns.append(column)
        warn_left_out(left, "a fleet sees no cones and Gaussians")
        known = np.flatnonzero(site)
        names = [labels[k] for k in known]
        chosen = known[matching(names, sites, "site")]
        carriers = [(labels[k], int(carrier[table[0, k]])) for k in chosen.tolist()]
        device = model.shape_transform.device
        super().__init__(parts, carriers, len(table), design, rules, device, other)
        local = model.shape_transform.numpy()
        seen = np.array([columns[k] for k in self.chosen])
        self._fix(*((carrier[table[:, k]], local[table[:, k]]) for k in (seen, chosen)))
        self._reader, self._model, self._shapes = reader, model, table[:, seen]
        self._labels = [labels[k] for k in seen.tolist()]
        self._sizes = model.shape_scale.numpy()[self._shapes]
        self.capacitance: Any = None
        self.delta: Any = None
        """Maxwell matrices of the last update and their change by the bodies [F], shape (worlds,
        sites, n, n)."""

    def update(self, state: Any, *, time: Any = None, environments: Any = None) -> None:
        """Read all worlds, or some.

        Args:
            state: The state, whose ``body_q`` is up to date.
            time: As of :meth:`Fleet.step`, where a readout is used.
            environments: Which worlds are solved, as of :meth:`Fleet.step`; all by default.

        Raises:
            ReadoutError: As by :meth:`Fleet.step`.
            SolveError: As by :meth:`Fleet.step`.
        """
        self.read(state, time=time, environments=environments)

    def read(self, state: Any, *, time: Any = None, environments: Any = None) -> FleetReading:
        """As :meth:`update`; returns the reading."""
        bodies = state.body_q
        # bodies of all worlds stand in one row, which every world is shown
        self._follow(
            wp.array(
                ptr=bodies.ptr, dtype=wp.transform, shape=(self.fleet.count, bodies.shape[0]),
                strides=(0, bodies.strides[0]), device=bodies.device,
            )
        )  # fmt: skip
        self.reading = self._read(time, environments)
        self.capacitance, self.delta = self.reading.capacitance, self.reading.delta
        return self.reading

    def _resized(self) -> Iterator[tuple[int, NDArray[np.integer], list[Body]]]:
        now = self._model.shape_scale.numpy()[self._shapes]
        changed = (now != self._sizes).any(axis=2)
        self._sizes = now
        if changed.any():
            self._reader.look()
        for place in np.flatnonzero(changed.any(axis=0)).tolist():
            shapes, label = self._shapes[:, place], self._labels[place]
            if self._reader.ground(shapes[0], label) is None:
                rows = np.flatnonzero(changed[:, place])
                bodies = {k: self._reader.body(k, label) for k in set(shapes[rows].tolist())}
                alike = {id(body): self._like(place, body.shape) for body in bodies.values()}
                yield place, rows, [alike[id(bodies[k])] for k in shapes[rows].tolist()]

    def draw(
        self, viewer: Any, name: str = "/capsense/electrodes", environments: Any = None
    ) -> None:
        """Draw the electrodes in a viewer of Newton, coloured by their signals.

        They are drawn where the sensors were at the last reading.

        Args:
            viewer: Any of ``newton.viewer``.
            name: What the lines are called there.
            environments: Of which worlds; all by default.

        Raises:
            SceneError: There is no such world.
        """
        starts, ends, colours = (
            wp.array(values.astype(np.float32), dtype=wp.vec3, device=viewer.device)
            for values in self.electrode_lines(environments)
        )
        viewer.log_lines(name, starts, ends, colours)


def _by_world(model: Any) -> NDArray[np.int64]:
    """Shapes of every world, those outside of all worlds last, shape (worlds, shapes)."""
    world = model.shape_world.numpy()
    count = max(int(model.world_count), 1)
    shared = np.flatnonzero(world < 0)
    rows = [np.flatnonzero(world == w) for w in range(count)]
    kinds = model.shape_type.numpy()
    for w, row in enumerate(rows):
        if len(row) != len(rows[0]) or (kinds[row] != kinds[rows[0]]).any():
            raise SceneError(
                f"world {w} of the model has other shapes than world 0; a sensor needs the same "
                "shapes in the same order in all worlds, as ModelBuilder.replicate makes them"
            )
    return np.array([np.concatenate([row, shared]) for row in rows], dtype=np.int64)


def _trees(model: Any) -> NDArray[np.integer]:
    """Bodies that hang together by joints have the same number, shape (bodies,)."""
    parent, child = model.joint_parent.numpy(), model.joint_child.numpy()
    between = parent >= 0
    n = model.body_count
    graph = coo_array((np.ones(between.sum()), (parent[between], child[between])), (n, n))
    _, number = connected_components(graph, directed=False)
    found: NDArray[np.integer] = number
    return found


class _Reader:
    """Makes bodies of a model's shapes; alike ones are one body."""

    def __init__(self, model: Any, rules: Rules) -> None:
        from newton import GeoType

        self._kinds = GeoType
        self._model, self._type = model, model.shape_type.numpy()
        self.look()
        self._source = model.shape_source
        self._rules = rules
        self._made: dict[Any, Body] = {}
        self._fields: dict[Any, Any] = {}

    def known(self, shape: int) -> bool:
        kinds = self._kinds
        return int(self._type[shape]) in {
            int(k) for k in (
                kinds.SPHERE, kinds.CAPSULE, kinds.ELLIPSOID, kinds.CYLINDER, kinds.BOX,
                kinds.MESH, kinds.CONVEX_MESH, kinds.PLANE, kinds.HFIELD,
            )
        }  # fmt: skip

    def replaced(self, shapes: NDArray[np.int64], labels: Sequence[str]) -> NDArray[np.bool_]:
        """Which shapes of a world the rules' choice leaves out, as others stand for them."""
        from newton import ShapeFlags

        model = self._model
        flags = model.shape_flags.numpy()[shapes]
        site = (flags & int(ShapeFlags.SITE)) != 0
        boxes = np.full((len(shapes), 2, 3), np.nan)
        place = model.shape_transform.numpy()[shapes].tolist()
        for k in np.flatnonzero(~site).tolist():
            if self.known(shapes[k]) and self.ground(shapes[k], labels[k]) is None:
                low, high = self._bounds(shapes[k], labels[k])
                pose = Pose(place[k][:3], place[k][3:])
                reach = np.abs(pose.rotation) @ (0.5 * (high - low))
                boxes[k] = pose.apply(0.5 * (low + high)) + np.stack([-reach, reach])
        owner = np.where(site, -2, model.shape_body.numpy()[shapes])
        collides = (flags & int(ShapeFlags.COLLIDE_SHAPES)) != 0
        return self._rules.replaced(collides, owner, boxes) & ~site

    def _bounds(self, shape: int, label: str) -> Array:
        """Corners of the box around a shape in its own frame [m], shape (2, 3)."""
        kind, size = int(self._type[shape]), tuple(self._scale[shape].tolist())
        made = primitive(self._kinds(kind).name, size)
        if made is None and kind == int(self._kinds.HFIELD):
            made = self._terrain(shape, label)
        if made is not None:
            return np.asarray(made.bounds())
        corners = np.asarray(self._source[shape].vertices, float) * np.array(size)
        return np.stack([corners.min(axis=0), corners.max(axis=0)])

    def look(self) -> None:
        """Take over the sizes of the model."""
        self._scale = self._model.shape_scale.numpy()

    def ground(self, shape: int, label: str) -> Ground | None:
        """A plane or a wide height field, None for all others."""
        kind, rules = int(self._type[shape]), self._rules
        if kind not in (int(self._kinds.PLANE), int(self._kinds.HFIELD)):
            return None
        material, grounding = rules.material_of((label,)), rules.tie_of((label,)).grounding
        made = HalfSpace() if kind == int(self._kinds.PLANE) else self._terrain(shape, label)
        return None if isinstance(made, Shape) else Ground(made, material, grounding)

    def _terrain(self, shape: int, label: str) -> Any:
        """A height field; those of all worlds share their mesh or terrain."""
        field, size = self._source[shape], tuple(self._scale[shape].tolist())
        key = id(field), size, label
        if key not in self._fields:
            low, high = float(field.min_z), float(field.max_z)
            rows = np.asarray(field.data, float).reshape(field.nrow, field.ncol)
            heights = size[2] * (low + (high - low) * rows)
            half = size[0] * float(field.hx), size[1] * float(field.hy)
            base = max(0.0, -float(heights.min())) + _BASE * max(half)
            solid = not self._rules.material_of((label,)).is_conductor()
            self._fields[key] = terrain_shape(heights, half, base, label, solid=solid)
        return self._fields[key]

    def body(self, shape: int, label: str) -> Body:
        kind, size = int(self._type[shape]), tuple(self._scale[shape].tolist())
        key = (label, kind, size, id(self._source[shape]))
        if key not in self._made:
            made = self._shape(shape, kind, size, label)
            self._made[key] = self._rules.body(made, (label,))
        return self._made[key]

    def _shape(self, shape: int, kind: int, size: tuple[float, ...], label: str) -> Shape:
        made = primitive(self._kinds(kind).name, size)
        if made is not None:
            return made
        if kind == int(self._kinds.HFIELD):
            return self._terrain(shape, label)
        mesh = self._source[shape]
        vertices = np.asarray(mesh.vertices, float) * np.array(size)
        faces = np.asarray(mesh.indices).reshape(-1, 3)
        return solid_mesh(vertices, faces, label, hull=self._rules.takes_hull((label,)))
