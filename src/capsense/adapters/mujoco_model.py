"""MuJoCo's geoms as solids, with the materials that the model gives them."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from capsense.adapters import WorldSource
from capsense.adapters.contacts import Contact
from capsense.adapters.meshes import (
    Terrain,
    path_order,
    primitive,
    solid_mesh,
    terrain_shape,
    tube,
    tube_faces,
)
from capsense.adapters.rules import Names, Rules, Tie, matches, read_grounding, read_material
from capsense.adapters.world import HalfSpace, SoftSolid, Solid
from capsense.errors import SceneError
from capsense.scene import Material, Pose, Shape, TriMesh

if TYPE_CHECKING:
    import mujoco

Array = NDArray[np.float64]

_SCALAR_LAST = [1, 2, 3, 0]
MATERIAL_KEY = "capsense.material:"
GROUNDING_KEY = "capsense.grounding:"

_PLANE = 0
"""Type of planes, mjGEOM_PLANE."""
_HEIGHT_FIELD = 1
"""Type of height fields, mjGEOM_HFIELD."""
_THINNEST = 1e-4
"""Flexes are no thinner than this [m], whatever their radius."""


@dataclass(frozen=True, eq=False)
class FlexVertices:
    """Gives the vertices of a flex at present; a copy of a sensor gives those of its own data."""

    data: mujoco.MjData
    own: slice
    """Its part of all vertices."""

    def __call__(self) -> Array:
        return self.data.flexvert_xpos[self.own]


@dataclass(frozen=True, eq=False)
class CableVertices:
    """Gives the vertices of the tube that stands for a flex of lines at present."""

    line: FlexVertices
    order: NDArray[np.int64]
    """Its vertices from one end to the other."""
    radius: float
    """[m]"""

    def __call__(self) -> Array:
        return tube(self.line()[self.order], self.radius)


class ModelReader:
    """Reads the geoms of one model.

    Args:
        model: The model.
        rules: What is seen, and what it is made of.

    Raises:
        SceneError: A pattern fits nothing, or one of the model's own texts is wrong.
    """

    def __init__(self, model: mujoco.MjModel, rules: Rules) -> None:
        self.model = model
        self.rules = rules
        self._names = [self._names_of(i) for i in range(model.ngeom)]
        self._flex_names = [self._names_of_flex(i) for i in range(model.nflex)]
        self._materials: dict[str, Material] = {}
        self._grounding: dict[str, Tie] = {}
        self._meshes: dict[tuple[int, bool], TriMesh] = {}
        self._read_texts()
        rules.check([*self._names, *self._flex_names])

    def seen(self, groups: Collection[int] | None) -> list[int]:
        """The geoms that ``groups`` and the rules' choice of shapes keep."""
        m = self.model
        kept = [k for k in range(m.ngeom) if groups is None or int(m.geom_group[k]) in groups]
        collides = (m.geom_contype != 0) | (m.geom_conaffinity != 0)
        collides[[*m.pair_geom1, *m.pair_geom2]] = True
        boxes = np.array([self._box(k) for k in kept]).reshape(-1, 2, 3)
        owner = m.geom_bodyid[kept] - 1  # the world is the first body
        instead = self.rules.replaced(collides[kept], owner, boxes)
        return [k for k, other in zip(kept, instead.tolist(), strict=True) if not other]

    def _box(self, geom: int) -> Array:
        """Corners of a box around a geom in the frame of its body [m], NaN for planes, (2, 3)."""
        m = self.model
        if m.geom_type[geom] == _PLANE:
            return np.full((2, 3), np.nan)
        x, y, z, w = np.take(m.geom_quat[geom], _SCALAR_LAST).tolist()
        pose = Pose(m.geom_pos[geom].tolist(), (x, y, z, w))
        middle, half = m.geom_aabb[geom, :3], m.geom_aabb[geom, 3:]
        reach = np.abs(pose.rotation) @ half
        return pose.apply(middle) + np.stack([-reach, reach])

    def excludes(self, geom: int) -> bool:
        """Whether the rules leave a geom out."""
        return self.rules.excludes(self._names[geom])

    def name(self, geom: int) -> str:
        """What a geom is called in scenes and messages."""
        return self._names[geom][-1]

    def solid(self, geom: int) -> Solid | None:
        """A geom as a solid, or None where the rules leave it out.

        Raises:
            SceneError: Its shape is not supported.
        """
        names = self._names[geom]
        if self.rules.excludes(names):
            return None
        material, tie = self._matter(names)
        w, x, y, z = self.model.geom_quat[geom].tolist()
        return Solid(
            label=names[-1],
            shape=self._shape(geom, names, material),
            frame=int(self.model.geom_bodyid[geom]),
            pose=Pose(self.model.geom_pos[geom].tolist(), (x, y, z, w)),
            material=material,
            tie=tie,
            tree=self._tree(int(self.model.geom_bodyid[geom])),
        )

    def soft_solid(self, flex: int, data: mujoco.MjData) -> SoftSolid | None:
        """A flex as a deformable, or None where the rules leave it out.

        Args:
            flex: Its number.
            data: The state that its vertices are taken from.

        Raises:
            SceneError: The flex is of lines that form no single open path.
        """
        names, m = self._flex_names[flex], self.model
        if self.rules.excludes(names):
            return None
        label, kind = names[0], int(m.flex_dim[flex])
        faces: NDArray[Any]
        if kind == 2:
            faces = _part(m.flex_elem, m.flex_elemdataadr[flex], 3 * int(m.flex_elemnum[flex]))
        elif kind == 3:
            faces = _part(m.flex_shell, m.flex_shelldataadr[flex], 3 * int(m.flex_shellnum[flex]))
        first = int(m.flex_vertadr[flex])
        vertices: FlexVertices | CableVertices
        vertices = FlexVertices(data, slice(first, first + int(m.flex_vertnum[flex])))
        if kind == 1:
            lines = _part(m.flex_elem, m.flex_elemdataadr[flex], 2 * int(m.flex_elemnum[flex]))
            order = path_order(lines.reshape(-1, 2))
            if order is None:
                raise SceneError(
                    f"flex {label!r} is of lines that branch, part or close, where a cable is one "
                    f"open path; leave it out with exclude=[{label!r}]"
                )
            vertices = CableVertices(vertices, order, max(float(m.flex_radius[flex]), _THINNEST))
            faces = tube_faces(len(order))
        material, tie = self._matter(names)
        return SoftSolid(
            label=label,
            faces=faces.reshape(-1, 3).astype(np.int64),
            vertices=vertices,
            material=material,
            tie=tie,
            thickness=max(2 * float(m.flex_radius[flex]), _THINNEST),
            tree=self._tree(int(m.flex_vertbodyid[first])),
        )

    def _tree(self, body: int) -> int:
        """Number of what hangs together with a body by joints; -1 for the world itself."""
        return int(self.model.body_rootid[body]) or -1

    def _matter(self, names: Names) -> tuple[Material, Tie]:
        """What something is made of, and its tie to ground."""
        material = next((m for p, m in self._materials.items() if matches(p, names)), None)
        tie = next((t for p, t in self._grounding.items() if matches(p, names)), None)
        return self.rules.material_of(names, material), self.rules.tie_of(names, tie)

    def _names_of_flex(self, flex: int) -> Names:
        import mujoco

        name = mujoco.mj_id2name(self.model, int(mujoco.mjtObj.mjOBJ_FLEX), flex)
        return (name or f"flex{flex}",)

    def _names_of(self, geom: int) -> Names:
        name = self.model.geom(geom).name or f"geom{geom}"
        body = self.model.body(int(self.model.geom_bodyid[geom])).name or "body"
        return name, body, f"{body}/{name}"

    def _read_texts(self) -> None:
        import mujoco

        raw = bytes(self.model.text_data)
        for i in range(self.model.ntext):
            name = mujoco.mj_id2name(self.model, int(mujoco.mjtObj.mjOBJ_TEXT), i)
            start = int(self.model.text_adr[i])
            text = raw[start : start + int(self.model.text_size[i])].rstrip(b"\0").decode()
            where = f'<text name="{name}">'
            if name.startswith(MATERIAL_KEY):
                self._materials[name.removeprefix(MATERIAL_KEY)] = read_material(text, where)
            elif name.startswith(GROUNDING_KEY):
                tie = Tie(read_grounding(text, where), f"text {name}")
                self._grounding[name.removeprefix(GROUNDING_KEY)] = tie
            elif name.startswith("capsense"):
                raise SceneError(
                    f"{where} is not known; write {MATERIAL_KEY}PATTERN or {GROUNDING_KEY}PATTERN"
                )
        for pattern in (*self._materials, *self._grounding):
            if not any(matches(pattern, names) for names in (*self._names, *self._flex_names)):
                raise SceneError(f"the model's capsense texts: no geom or body fits {pattern!r}")

    def _shape(self, geom: int, names: Names, material: Material) -> Shape | HalfSpace | Terrain:
        import mujoco

        kinds = mujoco.mjtGeom
        kind = int(self.model.geom_type[geom])
        name = kinds(kind).name.removeprefix("mjGEOM_")
        if kind == int(kinds.mjGEOM_PLANE):
            return HalfSpace()
        shape = primitive(name, self.model.geom_size[geom].tolist())
        if shape is not None:
            return shape
        if kind in (int(kinds.mjGEOM_MESH), int(kinds.mjGEOM_SDF)):
            return self._mesh(int(self.model.geom_dataid[geom]), names)
        if kind == int(kinds.mjGEOM_HFIELD):
            solid = not material.is_conductor()
            return self._terrain(int(self.model.geom_dataid[geom]), names, solid)
        raise SceneError(
            f"geom {names[-1]!r} is of a type that cannot be sensed ({kinds(kind).name}); leave "
            f"it out with exclude=[{names[-1]!r}]"
        )

    def _mesh(self, mesh: int, names: Names) -> TriMesh:
        """Geoms share the shape of a mesh. MuJoCo keeps meshes in the geom's frame."""
        hull = self.rules.takes_hull(names)
        if (mesh, hull) not in self._meshes:
            m = self.model
            v, f = int(m.mesh_vertadr[mesh]), int(m.mesh_faceadr[mesh])
            vertices = m.mesh_vert[v : v + int(m.mesh_vertnum[mesh])]
            faces = m.mesh_face[f : f + int(m.mesh_facenum[mesh])]
            self._meshes[mesh, hull] = solid_mesh(vertices, faces, names[-1], hull=hull)
        return self._meshes[mesh, hull]

    def _terrain(self, field: int, names: Names, solid: bool) -> TriMesh | Terrain:
        m = self.model
        rows, columns = int(m.hfield_nrow[field]), int(m.hfield_ncol[field])
        start = int(m.hfield_adr[field])
        half_x, half_y, top, base = m.hfield_size[field].tolist()
        heights = top * m.hfield_data[start : start + rows * columns].reshape(rows, columns)
        return terrain_shape(heights, (half_x, half_y), base, names[-1], solid=solid)


def _check_groups(groups: Any) -> None:
    if groups is None:
        return
    if isinstance(groups, str) or not isinstance(groups, Collection):
        raise SceneError(f"groups is {groups!r}; give the numbers of geom groups, like [0, 2]")
    if not groups:
        raise SceneError("groups is empty, so that nothing is seen; leave it out to see all")


class ModelSource(WorldSource):
    """The solids of a MuJoCo model; frames are its bodies.

    Args:
        model: The model.
        data: The state that readings are taken of.
        rules: What is seen, and what it is made of.
        groups: See only geoms of these groups; all where None.

    Raises:
        SceneError: A pattern fits nothing, a group is empty, or one of the model's own texts is
            wrong.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        rules: Rules,
        groups: Collection[int] | None,
    ) -> None:
        import mujoco

        self.model = model
        self.data = data
        _check_groups(groups)
        kinds = ("mjWARN_BADQPOS", "mjWARN_BADQVEL", "mjWARN_BADQACC")
        self._warnings = [int(getattr(mujoco.mjtWarning, kind)) for kind in kinds]
        there = {int(g) for g in (*model.geom_group, *model.flex_group)}
        for group in () if groups is None else groups:
            if group not in there:
                raise SceneError(
                    f"groups: nothing is in group {group!r}; there are geoms in {sorted(there)}"
                )
        self.groups = groups
        """The groups that are seen, None for all."""
        super().__init__(rules)

    def refresh(self) -> None:
        super().refresh()
        self.reader = ModelReader(self.model, self.rules)
        self.geoms = self.reader.seen(self.groups)
        """The geoms that are seen, as far as no pattern excludes them."""
        self._made: dict[int, Solid | None] = {}
        self._known = [a.copy() for a in self._sizes()]
        self._set_back = self._bad_numbers()

    def solids(self, own: int | None) -> list[Solid]:
        """All solids but those of a body; of one mesh twice at one place, the first."""
        kept: dict[object, Solid] = {}
        for geom in self.geoms:
            if int(self.model.geom_bodyid[geom]) == own:
                continue
            if geom not in self._made:
                self._made[geom] = self.reader.solid(geom)
            s = self._made[geom]
            if s is not None:  # geoms share the shapes of meshes
                place = tuple(s.pose.position), tuple(s.pose.quaternion)
                kept.setdefault((s.frame, id(s.shape), place, s.material, s.tie), s)
        return list(kept.values())

    def contacts(self, frame: int) -> list[Contact]:
        import mujoco

        model, data, out = self.model, self.data, []
        weld, count = model.body_weldid, int(data.ncon)
        force, found = np.empty(6), data.contact
        bodies = np.where(found.geom >= 0, model.geom_bodyid[found.geom], -1)
        for k in range(count):
            one, two = bodies[k].tolist()
            if min(one, two) < 0 or found.efc_address[k] < 0:
                continue  # of flexes, or without a force of its own
            sides = [weld[b] == weld[frame] for b in (one, two)]
            if sides[0] == sides[1]:
                continue
            mujoco.mj_contactForce(model, data, k, force)
            normal = found.frame[k, :3] * (
                1.0 if sides[0] else -1.0
            )  # MuJoCo's is out of the first
            other = two if sides[0] else one
            out.append(Contact(other, found.pos[k], normal, float(force[0]), float(found.dist[k])))
        return out

    def robot(self, frame: int) -> set[int]:
        root = self.model.body_rootid
        return set(np.flatnonzero(root == root[frame]).tolist())

    def neighbours(self, frame: int) -> set[int]:
        m = self.model
        weld, root = m.body_weldid, m.body_rootid == m.body_rootid[frame]
        above = weld[m.body_parentid[weld]]  # what the joints of each body are on
        near = (weld == weld[frame]) | (above == weld[frame]) | (weld == above[frame])
        return set(np.flatnonzero(near & root).tolist())

    def soft(self, own: int | None) -> list[SoftSolid]:
        soft = [self.reader.soft_solid(flex, self.data) for flex in range(self.model.nflex)]
        return [s for s in soft if s is not None]

    def links(self) -> tuple[Array, Array]:
        (bad, time), self._set_back = self._set_back, self._bad_numbers()
        if self._set_back[0] > bad or (bad and self._set_back[0] and self._set_back[1] < time):
            raise SceneError(
                "the simulation has diverged (a bad number in its positions, velocities or "
                "accelerations) and MuJoCo has set it back to its start; take a smaller time step "
                "or gentler controls, and call reset()"
            )
        self._follow()
        return self.data.xpos, np.take(self.data.xquat, _SCALAR_LAST, axis=1)

    def _follow(self) -> None:
        """Take over geoms that were moved on their bodies, or resized, since the last reading."""
        now = self._sizes()
        if all(map(np.array_equal, now, self._known)):
            return
        *geoms, terrain = zip(now, self._known, strict=True)
        changed = np.any([(a != b).any(axis=1) for a, b in geoms], axis=0)
        if not np.array_equal(*terrain):
            changed |= self.model.geom_type == _HEIGHT_FIELD
        for geom in np.flatnonzero(changed).tolist():
            self._made.pop(geom, None)
        self._known = [a.copy() for a in now]
        self.version += 1

    def _sizes(self) -> tuple[Array, ...]:
        """What a simulation may change of its geoms, as domain randomisation does."""
        m = self.model
        return m.geom_pos, m.geom_quat, m.geom_size, m.hfield_data

    def _bad_numbers(self) -> tuple[int, float]:
        """Warnings that a diverged simulation was set back, since the last reset; and the time."""
        return int(self.data.warning.number[self._warnings].sum()), float(self.data.time)


def _part(array: Any, start: Any, count: int) -> NDArray[np.int32]:
    return np.asarray(array)[int(start) : int(start) + count]
