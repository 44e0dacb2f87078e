"""PyBullet's collision and visual shapes as solids."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capsense.adapters import WorldSource
from capsense.adapters.contacts import Contact
from capsense.adapters.meshes import (
    UnusableShape,
    is_flat,
    joined_hulls,
    load_triangles,
    primitive,
    round_cylinder,
    solid_mesh,
)
from capsense.adapters.pybullet_bodies import (
    BodyWatch,
    Link,
    check_patterns,
    gone,
    is_soft,
    links_of,
    matter_of,
)
from capsense.adapters.rules import Rules
from capsense.adapters.world import HalfSpace, SoftSolid, Solid
from capsense.errors import SceneError
from capsense.scene import Pose, Shape

Array = NDArray[np.float64]

_HEIGHT_FIELD = 9
"""Shape type of height fields."""
_NO_FILE = b"unknown_file"


class SoftMesh:
    """The surface of a soft body, as PyBullet draws it: three vertices for every triangle.

    Before the first step the drawn vertices are those of the file, neither scaled nor placed.

    Raises:
        SceneError: It is not made of triangles.
    """

    def __init__(self, client: int, link: Link) -> None:
        self._client, self._link = client, link
        self._stepped = False
        soup = self._mesh(0)
        if not len(soup) or len(soup) % 3:
            raise _refuse(link, "is a soft body whose surface is not made of triangles")
        size = float(np.ptp(soup, axis=0).max())
        _, self._first, corner = np.unique(
            np.rint(soup / (1e-6 * size)), axis=0, return_index=True, return_inverse=True
        )
        self.faces: NDArray[np.int64] = corner.reshape(-1, 3)
        """Indices of merged vertices, shape (m, 3)."""

    def vertices(self) -> Array:
        """The merged vertices [m] at present, shape (n, 3).

        Raises:
            SceneError: The world has not been stepped since the soft body was loaded.
        """
        drawn = self._mesh(0)
        if not self._stepped:
            import pybullet as p

            simulated = self._mesh(p.MESH_DATA_SIMULATION_MESH)
            apart = [
                np.abs(f(drawn, axis=0) - f(simulated, axis=0)).max() for f in (np.min, np.max)
            ]
            if max(apart) > 1e-3 * float(np.ptp(simulated, axis=0).max()):
                raise SceneError(
                    f"{self._link.names[-1]!r} is a soft body that has not been stepped yet; call "
                    "stepSimulation first"
                )
            self._stepped = True
        return drawn[self._first]

    def _mesh(self, flags: int) -> Array:
        import pybullet as p

        link = self._link
        _, vertices = p.getMeshData(link.body, -1, flags=flags, physicsClientId=self._client)
        return np.array(vertices)


class ClientSource(WorldSource):
    """The solids of a PyBullet world; frames are its links' centres of mass.

    They are taken over again when bodies were added or removed, or the world was reset. A pattern
    must fit something at first; what it fits may leave.

    Args:
        client: Number of the physics client.
        rules: What is seen, and what it is made of.

    Raises:
        SceneError: A pattern fits nothing.
    """

    def __init__(self, client: int, rules: Rules) -> None:
        self.client = client
        self._watch = BodyWatch(client)
        super().__init__(rules)
        check_patterns(rules, self._links)

    def refresh(self) -> None:
        super().refresh()
        bodies = self._watch.bodies()
        self._links = [link for body in bodies for link in links_of(self.client, body)]
        self._groups = [
            (body, [k.link for k in self._links if k.body == body and k.link >= 0])
            for body in bodies
        ]
        self._meshes: dict[tuple[object, ...], Shape] = {}
        self._notes: list[str] = []  # what was left out or replaced, and why
        self._made: dict[int, list[Solid]] = {}
        self.clear: set[int] = set()
        """Links that are only drawn, and can be seen through."""

    def index(self, body: int, link: int) -> int:
        """Number of a link's frame.

        Raises:
            SceneError: The link has left the world.
        """
        for number, known in enumerate(self._links):
            if (known.body, known.link) == (body, link):
                return number
        raise gone(body)

    def solids(self, own: int | None) -> list[Solid]:
        out = []
        for i, link in enumerate(self._links):
            if i == own or is_soft(self.client, link):
                continue
            if i not in self._made:
                self._made[i] = list(self._solids_of(i))
            out += self._made[i]
        notes, self._notes = self._notes, []
        if notes:
            warnings.warn("sensor: " + ";\n".join(dict.fromkeys(notes)), stacklevel=2)
        return out

    def contacts(self, frame: int) -> list[Contact]:
        import pybullet as p

        own = self._links[frame]
        numbers = {(link.body, link.link): k for k, link in enumerate(self._links)}
        points = p.getContactPoints(
            bodyA=own.body, linkIndexA=own.link, physicsClientId=self.client
        )
        # Bullet divides the impulse of the last substep by the whole step
        steps = p.getPhysicsEngineParameters(physicsClientId=self.client)["numSubSteps"]
        out = []
        for point in points or ():
            other = numbers.get((point[2], point[4]))  # Bullet's normal is out of the second
            if other is not None:
                normal = -np.array(point[7])
                force = max(steps, 1) * float(point[9])
                out.append(Contact(other, point[6], normal, force, float(point[8])))
        return out

    def robot(self, frame: int) -> set[int]:
        body = self._links[frame].body
        return {number for number, link in enumerate(self._links) if link.body == body}

    def neighbours(self, frame: int) -> set[int]:
        import pybullet as p

        body = self._links[frame].body
        numbers = sorted(self.robot(frame))  # the base and the links, in order
        joints = [p.getJointInfo(body, k, self.client) for k in range(len(numbers) - 1)]
        weld = list(range(len(numbers)))  # the first of what is fixed together
        above = [-1] * len(numbers)
        for k, joint in enumerate(joints, start=1):  # a parent comes before its children
            parent = weld[joint[16] + 1]
            weld[k] = parent if joint[2] == p.JOINT_FIXED else k
            above[k] = above[parent] if joint[2] == p.JOINT_FIXED else parent
        own = numbers.index(frame)
        return {
            number
            for k, number in enumerate(numbers)
            if weld[k] == weld[own] or weld[own] == above[k] or weld[k] == above[own]
        }

    def soft(self, own: int | None) -> list[SoftSolid]:
        numbers = [i for i, k in enumerate(self._links) if i != own and is_soft(self.client, k)]
        return [soft for i in numbers for soft in self._soft_of(i)]

    def links(self) -> tuple[Array, Array]:
        import pybullet as p

        if self._watch.changed():
            self.refresh()
        poses: list[Any] = []
        for body, links in self._groups:
            poses.append(p.getBasePositionAndOrientation(body, physicsClientId=self.client))
            if links:
                states = p.getLinkStates(
                    body, links, computeForwardKinematics=1, physicsClientId=self.client
                )
                poses += [s[:2] for s in states]
        return np.array([pose[0] for pose in poses]), np.array([pose[1] for pose in poses])

    def _solids_of(self, index: int) -> Iterator[Solid]:
        """The solids of one link.

        Raises:
            SceneError: A shape is not supported.
        """
        link = self._links[index]
        if self.rules.excludes(link.names):
            return
        material, tie = matter_of(self.client, link, self.rules)
        for shape, pose in self._shapes_of(index):
            yield Solid(
                label=link.names[-1],
                shape=shape,
                frame=index,
                pose=pose,
                material=material,
                tie=tie,
                tree=link.body,
            )

    def _soft_of(self, index: int) -> list[SoftSolid]:
        """A soft body as a deformable; none where the rules leave it out.

        Raises:
            SceneError: Its mesh is not made of triangles.
        """
        link = self._links[index]
        if self.rules.excludes(link.names):
            return []
        mesh = SoftMesh(self.client, link)
        material, tie = matter_of(self.client, link, self.rules)
        return [SoftSolid(link.names[-1], mesh.faces, mesh.vertices, material, tie, tree=link.body)]

    def _shapes_of(self, index: int) -> Iterator[tuple[Shape | HalfSpace, Pose]]:
        """Shapes of a link, and their poses in the frame of its centre of mass."""
        import pybullet as p

        link = self._links[index]
        dynamics = p.getDynamicsInfo(link.body, link.link, physicsClientId=self.client)
        drawn = p.getVisualShapeData(link.body, physicsClientId=self.client)
        drawn = [entry for entry in drawn if entry[1] == link.link]
        if any(entry[2] == _HEIGHT_FIELD for entry in drawn):
            self._notes.append(
                f"{link.names[-1]!r} is a height field, of which PyBullet tells nothing but its "
                "bounds (left out)"
            )
            return
        # entries 0 and 1 are sound in the first record of a link only
        data = p.getCollisionShapeData(link.body, link.link, physicsClientId=self.client)
        preferred, seen = self.rules.shapes, False
        if preferred == "collision":
            for found in self._solid_shapes(link, data):
                seen = True
                yield found
            if seen:
                return
        if not data and any(entry[7][3] < 1 for entry in drawn):
            self.clear.add(index)
        to_mass = Pose(*dynamics[3:5]).inverse()  # visual shapes stand in the URDF frame
        more = preferred == "both"
        for entry in drawn:
            if entry[2] == p.GEOM_PLANE:  # its normal is told of the collision shape only
                more = True
                continue
            if self._is_nothing(link, entry):
                continue
            try:
                shape = self._visual(link, entry)
            except UnusableShape as error:
                taken = bool(data) and preferred != "collision"
                instead = "its link's collision shapes are taken" if taken else "left out"
                self._notes.append(f"{error} ({instead})")
                more = True
                continue
            if shape is not None:
                seen = True
                yield shape, to_mass @ Pose(entry[5], entry[6])
                continue
            more = True
            if not data:
                self._notes.append(
                    f"{link.names[-1]!r} has a flat visual mesh and no collision shape (left out)"
                )
        if preferred != "collision" and (more or not seen):
            yield from self._solid_shapes(link, data)

    def _solid_shapes(
        self, link: Link, data: Sequence[Any]
    ) -> Iterator[tuple[Shape | HalfSpace, Pose]]:
        """What a link collides with, from the entries that PyBullet has of it."""
        for number, entry in enumerate(data):
            if self._is_nothing(link, entry):
                continue
            try:
                yield self._collision(link, number, entry)
            except UnusableShape as error:
                self._notes.append(f"{error} (left out)")

    def _is_nothing(self, link: Link, entry: Any) -> bool:
        """Whether a shape has no volume, as the empty boxes that some URDFs hold."""
        import pybullet as p

        kind, (a, b, c) = entry[2], entry[3]
        least = {
            p.GEOM_BOX: min(a, b, c), p.GEOM_SPHERE: a, p.GEOM_CAPSULE: b,
            p.GEOM_CYLINDER: min(a, b),
        }.get(kind, 1.0)  # fmt: skip
        if least > 0:
            return False
        self._notes.append(
            f"{link.names[-1]!r} has a shape of sizes {a:g}, {b:g}, {c:g} (left out)"
        )
        return True

    def _visual(self, link: Link, entry: Any) -> Shape | None:
        """A visual shape; None for a flat mesh, such as that of a drawn floor."""
        import pybullet as p

        kind, sizes, file = entry[2:5]
        shape = _primitive(kind, sizes)
        if shape is not None:
            return shape
        if kind != p.GEOM_MESH or not file:
            what = "mesh without a file" if kind == p.GEOM_MESH else f"shape of type {kind}"
            raise UnusableShape(f"{link.names[-1]!r} has a visual {what}")
        hull = self.rules.takes_hull(link.names)
        key = (file, sizes, hull)
        if key not in self._meshes:
            label = link.names[-1]
            vertices, faces = load_triangles(file.decode(), sizes, label)
            if is_flat(vertices):
                return None
            self._meshes[key] = solid_mesh(vertices, faces, label, hull=hull)
        return self._meshes[key]

    def _collision(self, link: Link, number: int, entry: Any) -> tuple[Shape | HalfSpace, Pose]:
        import pybullet as p

        kind, sizes, file = entry[2:5]
        pose = Pose(entry[5], entry[6])
        shape = _primitive(kind, sizes)
        if shape is not None:
            return shape, pose
        if kind == p.GEOM_PLANE:
            return HalfSpace(), pose @ _turned_to(sizes)
        if kind != p.GEOM_MESH:
            raise UnusableShape(f"{link.names[-1]!r} has a collision shape of type {kind}")
        label = link.names[-1]
        if file != _NO_FILE:
            key = (file, sizes, "parts")
            if key not in self._meshes:
                vertices, faces = joined_hulls(*load_triangles(file.decode(), sizes, label), label)
                self._meshes[key] = solid_mesh(vertices, faces, label)
            return self._meshes[key], pose
        _, vertices = p.getMeshData(
            link.body, link.link, collisionShapeIndex=number, physicsClientId=self.client
        )
        if not vertices:
            raise UnusableShape(
                f"{link.names[-1]!r} has a concave collision mesh that PyBullet does not give out"
            )
        corners = pose.inverse().apply(vertices)  # given in the frame of the centre of mass
        return round_cylinder(corners) or solid_mesh(corners, (), label, hull=True), pose


def _primitive(kind: int, sizes: tuple[float, float, float]) -> Shape | None:
    """The shape that one of Bullet's types and its sizes [m] stand for."""
    import pybullet as p

    a, b, c = (0.5 * size for size in sizes)
    known = {
        p.GEOM_BOX: ("BOX", (a, b, c)), p.GEOM_SPHERE: ("SPHERE", (2 * a, 0, 0)),
        p.GEOM_CAPSULE: ("CAPSULE", (2 * b, a, 0)), p.GEOM_CYLINDER: ("CYLINDER", (2 * b, a, 0)),
    }  # fmt: skip
    return primitive(*known[kind]) if kind in known else None


def _turned_to(normal: Sequence[float]) -> Pose:
    """The rotation that turns z to a unit normal, the short way."""
    x, y, z = normal
    if z < -1 + 1e-9:
        return Pose((0, 0, 0), (1, 0, 0, 0))
    return Pose((0, 0, 0), (-y, x, 0, 1 + z))


def _refuse(link: Link, what: str) -> SceneError:
    label = link.names[-1]
    return SceneError(f"{label!r} {what}; leave it out with exclude=[{label!r}]")
