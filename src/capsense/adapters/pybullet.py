"""Sensors on links in PyBullet: ``cs.pybullet.attach(client, body, link="wrist")``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from capsense.adapters.attached import GeometrySensor, check_world, make_simulator, refuse_missing
from capsense.adapters.pybullet_depth import PybulletDepthSensor, check_image
from capsense.adapters.pybullet_model import (
    Link,
    WorldReader,
    body_numbers,
    is_soft,
    links_of,
)
from capsense.adapters.rules import Rules
from capsense.adapters.world import Frames, SoftSolid, Solid, World
from capsense.design.model import Design
from capsense.errors import MissingDependencyError, SceneError
from capsense.readout.read_out import ReadOut
from capsense.scene import Material, Pose
from capsense.scene.body import Grounding
from capsense.simulator import Simulator

Array = NDArray[np.float64]
Shapes = Literal["collision", "visual"]

__all__ = ["PybulletDepthSensor", "PybulletSensor", "attach"]

_NO_POSE = Pose()


def attach(
    client: Any,
    body: int,
    link: int | str = -1,
    pose_in_link: Pose = _NO_POSE,
    design: Design | str | Path | Simulator = "six_patch",
    *,
    world: Literal["geometry", "depth"] = "geometry",
    shapes: Shapes = "collision",
    materials: Mapping[str, Material | str] | None = None,
    grounding: Mapping[str, Grounding] | None = None,
    default_material: Material | str = "steel",
    default_grounding: Grounding = "grounded",
    exclude: Sequence[str] = (),
    exclude_own: bool = True,
    hull: Sequence[str] = (),
    sheet_thickness: float = 1e-3,
    size: float | None = None,
    resolution: int = 64,
    back: str | float = "fill",
    readout: ReadOut | str | None = None,
) -> PybulletSensor | PybulletDepthSensor:
    """Attach a sensor to a link; call ``read()`` after every ``stepSimulation``.

    With ``world="geometry"`` shapes become solids once, at this call, and again when bodies were
    added or removed; only poses and the vertices of soft bodies are taken at a reading.

    Patterns are shell patterns. They are tried on a link's name, on its body's name, and on
    ``body/link``; bodies without a name are called ``body3``, say. A body can say the same in its
    user data: ``addUserData(body, "capsense.material", "human", linkIndex=2)`` and the key
    ``"capsense.grounding"``. What is given here comes first, then user data, then the defaults.
    A capacitance to ground is that of all links that its pattern fits, together.

    With ``world="depth"`` the sensor sees what TinyRenderer draws from the sensor's origin along
    its z, which needs no OpenGL: visual shapes, each with its material. All conductors in the
    image are one body. What is left out still hides what stands behind it.

    Args:
        client: What ``pybullet.connect`` returned, or a ``BulletClient``.
        body: The body that carries the sensor.
        link: Its link, by index or name; -1 is the base.
        pose_in_link: The sensor frame in the link's frame (the URDF frame, not the centre of
            mass): origin at the centre of the electrode plane, z out of the sensor.
        design: A design, a packaged name, a design file, or a ready simulator.
        world: ``"geometry"``, the shapes themselves, or ``"depth"``, a rendered image.
        shapes: ``"collision"``: what Bullet collides with, where a mesh is the convex hull of
            each of its connected parts; or ``"visual"``: what it draws, meshes as they are.
            Geometry only.
        materials: Name pattern → material; the first that fits decides.
        grounding: Name pattern → grounding; the first that fits decides. Geometry only.
        default_material: Material of everything else.
        default_grounding: Grounding of everything else.
        exclude: Name patterns of links that the sensor does not see.
        exclude_own: Leave out the link that carries the sensor, which the design itself
            describes.
        hull: Name patterns of links whose visual meshes are taken as their convex hulls.
            Geometry only.
        sheet_thickness: Thickness [m] of soft bodies that are open surfaces, such as cloth.
        size: Width and height of the image [m]; by default the width of the domain. Depth only.
        resolution: Pixels along each side of the image.
        back: Where what is drawn ends: ``"fill"``, at the end of the domain, or after an assumed
            thickness [m]; see :class:`~capsense.scene.depth.DepthFrame`. Depth only.
        readout: A chip, or its name, whose counts readings are to hold; see
            :meth:`~capsense.adapters.attached.AttachedSensor.read`.

    Raises:
        MissingDependencyError: PyBullet is not installed.
        SceneError: There is no such client, body or link, a pattern fits nothing, a shape is
            not supported, or an option is out of range or belongs to the other kind of world.
        DesignError: The design is wrong.
        ReadOutError: There is no such chip.
    """
    _require()
    if shapes not in ("collision", "visual"):
        raise SceneError(f'shapes is {shapes!r}; choose "collision" or "visual"')
    only_geometry = {
        "grounding": grounding, "hull": hull, 'shapes="visual"': shapes == "visual",
    }  # fmt: skip
    check_world(world, only_geometry, {"size": size, "back": back != "fill"})
    if not isinstance(pose_in_link, Pose):
        raise SceneError(f"pose_in_link is {pose_in_link!r}; give a Pose(position, quaternion)")
    rules = Rules(
        materials or {}, grounding or {}, default_material, default_grounding, exclude, hull
    )
    number = _client_number(client)
    index = _find_link(number, body, link)
    simulator = make_simulator(design)
    if world == "depth":
        size, resolution = check_image(size, resolution, max(simulator.design.domain.size[:2]))
        sensor: PybulletSensor | PybulletDepthSensor = PybulletDepthSensor(
            number, body, index, pose_in_link, simulator, rules,
            exclude_own=exclude_own, size=size, resolution=resolution, back=back,
        )  # fmt: skip
        sensor.use_readout(readout)
        return sensor
    sensor = PybulletSensor(
        number, body, index, pose_in_link, simulator, rules,
        shapes=shapes, exclude_own=exclude_own, sheet_thickness=sheet_thickness,
    )  # fmt: skip
    sensor.use_readout(readout)
    return sensor


class PybulletSensor(GeometrySensor):
    """A sensor on a link in PyBullet; made by :func:`attach`."""

    def __init__(
        self,
        client: int,
        body: int,
        link: int,
        pose_in_link: Pose,
        simulator: Simulator,
        rules: Rules,
        *,
        shapes: Shapes,
        exclude_own: bool,
        sheet_thickness: float,
    ) -> None:
        self.client = client
        """Number of the physics client."""
        self.body = body
        """The body that carries the sensor."""
        self.link = link
        """Its link, -1 for the base."""
        self._in_link = pose_in_link
        self._rules = rules
        self._shapes: Shapes = shapes
        self._exclude_own = exclude_own
        self._sheet_thickness = sheet_thickness
        super().__init__(simulator)

    def _world(self) -> World:
        import pybullet as p

        self._bodies = body_numbers(self.client)
        self._links: list[Link] = [
            link for body in self._bodies for link in links_of(self.client, body)
        ]
        self._groups = [
            (body, [k.link for k in self._links if k.body == body and k.link >= 0])
            for body in self._bodies
        ]
        own = (self.body, self.link)
        self._carrier = [(k.body, k.link) for k in self._links].index(own)
        inertial = p.getDynamicsInfo(*own, physicsClientId=self.client)[3:5]
        self._in_frame = Pose(*inertial).inverse() @ self._in_link
        reader = WorldReader(
            self.client, self._links, self._rules, self._shapes, self._sheet_thickness
        )
        solids: list[Solid] = []
        soft: list[SoftSolid] = []
        for i, link in enumerate(self._links):
            if self._exclude_own and (link.body, link.link) == own:
                continue
            if is_soft(self.client, link):
                soft += reader.soft_solids(i)
            else:
                solids += reader.solids(i)
        return World(solids, self.simulator.design.domain, soft)

    def _frames(self) -> Frames:
        """Frames of the links' centres of mass, in the order of ``self._links``."""
        import pybullet as p

        if body_numbers(self.client) != self._bodies:
            self.refresh()
        poses: list[Any] = []
        for body, links in self._groups:
            poses.append(p.getBasePositionAndOrientation(body, physicsClientId=self.client))
            if links:
                states = p.getLinkStates(
                    body, links, computeForwardKinematics=1, physicsClientId=self.client
                )
                poses += [s[:2] for s in states]
        position = np.array([pose[0] for pose in poses])
        quaternion = np.array([pose[1] for pose in poses])
        sensor = Pose(position[self._carrier], quaternion[self._carrier]) @ self._in_frame
        return Frames(position, quaternion, np.array(sensor.position), np.array(sensor.quaternion))


def _require() -> None:
    try:
        import pybullet  # noqa: F401
    except ImportError:
        raise MissingDependencyError(
            "PyBullet is not installed; pip install 'capsense[pybullet]'"
        ) from None


def _client_number(client: Any) -> int:
    import pybullet as p

    number = getattr(client, "_client", client)
    if isinstance(number, bool) or not isinstance(number, int):
        raise SceneError(
            f"client is {client!r}; give what pybullet.connect returned, or a BulletClient"
        )
    if not p.isConnected(physicsClientId=number):
        raise SceneError(f"there is no physics client {number}; call pybullet.connect first")
    return number


def _find_link(client: int, body: int, link: int | str) -> int:
    known = body_numbers(client)
    if body not in known:
        raise SceneError(f"there is no body {body!r} in the world; there are {known}")
    links = {k.name: k.link for k in links_of(client, body)}
    if isinstance(link, str):
        if link not in links:
            raise refuse_missing("link", link, list(links))
        return links[link]
    if link not in links.values():
        raise SceneError(
            f"body {body} has no link {link!r}; give a name, or an index from -1 (the base) to "
            f"{len(links) - 2}"
        )
    return int(link)
