"""Sensors on links in PyBullet: ``cs.pybullet.attach(client, body, link="wrist")``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from capsense.adapters.attached import (
    GeometrySensor,
    check_image,
    check_perception,
    make_simulator,
    refuse_missing,
)
from capsense.adapters.pybullet_bodies import body_numbers, links_of
from capsense.adapters.pybullet_depth import PybulletDepthSensor
from capsense.adapters.pybullet_model import ClientSource
from capsense.adapters.rules import Rules
from capsense.adapters.skin import AttachedSkin, simulators_of
from capsense.adapters.world import Frames
from capsense.design.model import Design
from capsense.errors import MissingDependencyError, SceneError
from capsense.readout.readout import Readout
from capsense.scene import Material, Pose
from capsense.scene.scene import Grounding
from capsense.simulator import Simulator
from capsense.skin import AnyDesign

Array = NDArray[np.float64]
Shapes = Literal["collision", "visual"]

__all__ = ["AttachedSkin", "PybulletDepthSensor", "PybulletSensor", "attach", "attach_skin"]

_NO_POSE = Pose()


def attach(
    client: Any,
    body: int,
    link: int | str = -1,
    pose_in_link: Pose = _NO_POSE,
    design: Design | str | Path | Simulator = "six_patch",
    *,
    perception: Literal["geometry", "depth_camera"] = "geometry",
    shapes: Shapes = "collision",
    materials: Mapping[str, Material | str] | None = None,
    grounding: Mapping[str, Grounding] | None = None,
    default_material: Material | str = "steel",
    default_grounding: Grounding = "grounded",
    exclude: Sequence[str] = (),
    exclude_own: bool = True,
    hull: Sequence[str] = (),
    size: float | None = None,
    resolution: int = 64,
    back: str | float = "fill",
    readout: Readout | str | Path | None = None,
) -> PybulletSensor | PybulletDepthSensor:
    """Attach a sensor to a link; call ``read()`` after every ``stepSimulation``.

    With ``perception="geometry"`` shapes become solids once, at this call, and again when bodies
    were added or removed; only poses and the vertices of soft bodies are taken at a reading.

    Patterns are shell patterns. They are tried on a link's name, on its body's name, and on
    ``body/link``; bodies without a name are called ``body3``, say. A body can say the same in its
    user data: ``addUserData(body, "capsense.material", "human", linkIndex=2)`` and the key
    ``"capsense.grounding"``. What is given here comes first, then user data, then the defaults.
    A capacitance to ground is that of all links that its pattern fits, together.

    With ``perception="depth_camera"`` the sensor sees what TinyRenderer draws from the sensor's
    origin along its z, which needs no OpenGL: visual shapes, each with its material. All
    conductors in the image are one body. What is left out still hides what stands behind it.

    Args:
        client: What ``pybullet.connect`` returned, or a ``BulletClient``.
        body: The body that carries the sensor.
        link: Its link, by index or name; -1 is the base.
        pose_in_link: The sensor frame in the link's frame (the URDF frame, not the centre of
            mass): origin at the centre of the electrode plane, z out of the sensor.
        design: A design, a packaged name, a design file, or a ready simulator.
        perception: ``"geometry"``, the shapes themselves, or ``"depth_camera"``, a rendered image.
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
        size: Width and height of the image [m]; by default the width of the domain. Depth only.
        resolution: Pixels along each side of the image. Depth only.
        back: Where what is drawn ends: ``"fill"``, at the end of the domain, or after an assumed
            thickness [m]; see :class:`~capsense.scene.depth.DepthFrame`. Depth only.
        readout: A readout whose counts readings are to hold, a chip's name, or a file's; see
            :meth:`~capsense.adapters.attached.AttachedSensor.read`.

    Raises:
        MissingDependencyError: PyBullet is not installed.
        SceneError: There is no such client, body or link, a pattern fits nothing, a shape is
            not supported, or an option is out of range or belongs to the other kind of perception.
        DesignError: The design is wrong.
        ReadoutError: There is no such chip.
    """
    _require()
    _check_shapes(shapes)
    only_geometry = {
        "grounding": grounding, "hull": hull, 'shapes="visual"': shapes == "visual",
    }  # fmt: skip
    only_depth = {"size": size, "resolution": resolution != 64, "back": back != "fill"}
    check_perception(perception, only_geometry, only_depth)
    if not isinstance(pose_in_link, Pose):
        raise SceneError(f"pose_in_link is {pose_in_link!r}; give a Pose(position, quaternion)")
    rules = Rules(
        materials or {}, grounding or {}, default_material, default_grounding, exclude, hull
    )
    number = _client_number(client)
    index = _find_link(number, body, link)
    simulator = make_simulator(design)
    if perception == "depth_camera":
        size, resolution = check_image(size, resolution, max(simulator.design.domain.size[:2]))
        sensor: PybulletSensor | PybulletDepthSensor = PybulletDepthSensor(
            number, body, index, pose_in_link, simulator, rules,
            exclude_own=exclude_own, size=size, resolution=resolution, back=back,
        )  # fmt: skip
        sensor.use_readout(sensor.readout if readout is None else readout)
        sensor.warn()
        return sensor
    source = ClientSource(number, rules, shapes)
    sensor = PybulletSensor(source, body, index, pose_in_link, simulator, exclude_own=exclude_own)
    sensor.use_readout(sensor.readout if readout is None else readout)
    sensor.warn()
    return sensor


def attach_skin(
    client: Any,
    body: int,
    mounts: Mapping[str, tuple[int | str, Pose]],
    design: AnyDesign | Mapping[str, AnyDesign] = "arm_segment",
    *,
    shapes: Shapes = "collision",
    materials: Mapping[str, Material | str] | None = None,
    grounding: Mapping[str, Grounding] | None = None,
    default_material: Material | str = "steel",
    default_grounding: Grounding = "grounded",
    exclude: Sequence[str] = (),
    exclude_own: bool = True,
    hull: Sequence[str] = (),
    readout: str | Path | None = None,
    threads: int | None = None,
) -> AttachedSkin:
    """Attach several sensors to a robot's links; one ``read()`` reads them all, in parallel.

    The world is taken over once for all of them, and sensors of one design share its field. Each
    sees the geometry from its own frame, without its own link.

    Args:
        client: What ``pybullet.connect`` returned, or a ``BulletClient``.
        body: The body that carries the sensors.
        mounts: Name → link, by index or name, and the sensor frame in the link's frame.
        design: What :func:`attach` takes, for all sensors, or name → design. A simulator that is
            given for several sensors stands for its own design.
        shapes: As for :func:`attach`, like all that follow up to ``hull``.
        materials: Name pattern → material.
        grounding: Name pattern → grounding.
        default_material: Material of everything else.
        default_grounding: Grounding of everything else.
        exclude: Name patterns of links that no sensor sees.
        exclude_own: Leave out the link that carries a sensor, for that sensor.
        hull: Name patterns of links whose visual meshes are taken as their convex hulls.
        readout: Name of the chip behind every sensor, or the path of a readout file.
        threads: How many threads read; by default as many as the process may use processors.

    Raises:
        MissingDependencyError: PyBullet is not installed.
        SceneError: There is no such client, body or link, a pattern fits nothing, or a shape is
            not supported.
        DesignError: A design is wrong.
        ReadoutError: There is no such chip.
    """
    _require()
    _check_shapes(shapes)
    number = _client_number(client)
    links: dict[str, tuple[int, Pose]] = {}
    for name, mount in mounts.items():
        if not (isinstance(mount, tuple) and len(mount) == 2 and isinstance(mount[1], Pose)):
            raise SceneError(f"mount {name!r} is {mount!r}; give a pair (link, Pose(…))")
        links[name] = _find_link(number, body, mount[0]), mount[1]
    rules = Rules(
        materials or {}, grounding or {}, default_material, default_grounding, exclude, hull
    )
    source = ClientSource(number, rules, shapes)
    simulators = simulators_of(links, design)
    sensors = {
        name: PybulletSensor(source, body, *mount, simulators[name], exclude_own=exclude_own)
        for name, mount in links.items()
    }
    skin = AttachedSkin(sensors, readout, threads)
    skin.warn()
    return skin


class PybulletSensor(GeometrySensor):
    """A sensor on a link in PyBullet; made by :func:`attach`."""

    source: ClientSource

    def __init__(
        self,
        source: ClientSource,
        body: int,
        link: int,
        pose_in_link: Pose,
        simulator: Simulator,
        *,
        exclude_own: bool,
    ) -> None:
        self.client = source.client
        """Number of the physics client."""
        self.body = body
        """The body that carries the sensor."""
        self.link = link
        """Its link, -1 for the base."""
        self._in_link = pose_in_link
        self._exclude_own = exclude_own
        super().__init__(simulator, source)

    def _take_over(self) -> None:
        import pybullet as p

        self._carrier = self.source.index(self.body, self.link)
        dynamics = p.getDynamicsInfo(self.body, self.link, physicsClientId=self.client)
        self._in_frame = Pose(*dynamics[3:5]).inverse() @ self._in_link
        super()._take_over()

    def _own_frame(self) -> int | None:
        return self._carrier if self._exclude_own else None

    def _frames(self, position: Array, quaternion: Array) -> Frames:
        sensor = Pose(position[self._carrier], quaternion[self._carrier]) @ self._in_frame
        return Frames(position, quaternion, np.array(sensor.position), np.array(sensor.quaternion))


def _require() -> None:
    try:
        import pybullet  # noqa: F401
    except ImportError:
        raise MissingDependencyError(
            "PyBullet is not installed; pip install 'capsense[pybullet]'"
        ) from None


def _check_shapes(shapes: object) -> None:
    if shapes not in ("collision", "visual"):
        raise SceneError(f'shapes is {shapes!r}; choose "collision" or "visual"')


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
