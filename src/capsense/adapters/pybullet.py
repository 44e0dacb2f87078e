"""Sensors on links in PyBullet: ``cs.pybullet.attach(client, body, link="wrist")``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Unpack

import numpy as np
from numpy.typing import NDArray

from capsense.adapters import DepthSensor, GeometrySensor, make_simulator, refuse_missing
from capsense.adapters.findings import Findings
from capsense.adapters.placement import markers
from capsense.adapters.pybullet_bodies import (
    BodyWatch,
    Link,
    Mount,
    body_numbers,
    check_patterns,
    gone,
    links_of,
    matter_of,
)
from capsense.adapters.pybullet_model import ClientSource
from capsense.adapters.rules import (
    AttachOptions,
    Image,
    ImageOptions,
    Rules,
    check_perception,
    split_rules,
)
from capsense.adapters.skin import AttachedSkin, Progress, clear_of_neighbours, simulators_of
from capsense.adapters.world import Frames
from capsense.design.model import Design
from capsense.errors import SceneError, require_package
from capsense.readout import Readout
from capsense.scene import Pose
from capsense.scene.camera import OrthographicCamera
from capsense.scene.depth import DepthFrame
from capsense.scene.pose import checked_pose
from capsense.simulator import DEFAULT_DESIGN, Simulator
from capsense.skin import AnyDesign, SkinLayout

Array = NDArray[np.float64]

__all__ = [
    "AttachedSkin", "PybulletDepthSensor", "PybulletOptions", "PybulletSensor", "attach",
    "attach_layout", "attach_skin",
]  # fmt: skip

_NO_POSE = Pose()
_WITHDRAWN = 5.0
"""Distance of the renderer's camera behind the sensor [m]. TinyRenderer drops the faces that are
turned away from the camera as in a perspective view, which erodes silhouettes where it is near."""
_NEAR = 1e-4
"""Depth from which on things are seen [m]; what stands before is cut off."""
_CAMERA = Pose((0.0, 0.0, -_WITHDRAWN), (1.0, 0.0, 0.0, 0.0))
"""The OpenGL camera, which looks along its −z, in the sensor frame."""
_ONLY = {
    "geometry": ("grounding", "hull", "shapes", "contact_forces"),
    "depth_camera": ("size", "resolution", "back"),
}


class PybulletSkinOptions(AttachOptions, total=False):
    """Keywords of :func:`attach_skin`."""

    contact_forces: bool
    """Whether the forces of Bullet's contacts press links onto the design's cover, True by default;
    of links without contact, the overlap with the cover counts."""


class PybulletOptions(PybulletSkinOptions, ImageOptions, total=False):
    """Keywords of :func:`attach`; ``grounding``, ``hull``, ``shapes`` and ``contact_forces`` are
    for geometry only, ``size``, ``resolution`` and ``back`` for depth cameras only."""


def attach(
    client: Any,
    body: int,
    link: int | str = -1,
    pose_in_link: Pose = _NO_POSE,
    design: Design | str | Path | Simulator = DEFAULT_DESIGN,
    *,
    perception: Literal["geometry", "depth_camera"] = "geometry",
    readout: Readout | str | Path | None = None,
    **options: Unpack[PybulletOptions],
) -> PybulletSensor | PybulletDepthSensor:
    """Attach a sensor to a link; call ``read()`` after every ``stepSimulation``.

    With ``perception="geometry"`` shapes become solids once, at this call, and again when bodies
    were added or removed; only poses and the vertices of soft bodies are taken at a reading.

    Name patterns are tried on a link's name, on its body's name, and on
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
        design: A design, a packaged name, a design file, or a ready simulator, whose readout stays
            as it is.
        perception: ``"geometry"``, the shapes themselves, or ``"depth_camera"``, a rendered image.
        readout: A readout whose counts readings are to hold, a chip's name, or a file's; see
            :meth:`~capsense.adapters.AttachedSensor.read`. By default a copy of the simulator's, if
            it has one.
        options: What is seen and what it is made of: ``materials``, ``grounding``, ``exclude`` and
            the others of :class:`PybulletOptions`.

    Raises:
        MissingDependencyError: PyBullet is not installed.
        TypeError: There is no such option.
        ValueError: There is no such kind of perception or of shapes.
        SceneError: There is no such client, body or link, a pattern fits nothing, a shape is
            not supported, or an option is out of range or belongs to the other kind of perception.
        DesignError: The design is wrong.
        ReadoutError: There is no such chip.
    """
    require_package("pybullet", "PyBullet", "pybullet")
    check_perception(perception, options, _ONLY)
    rules, other = split_rules(options, PybulletOptions)
    pose = checked_pose(pose_in_link, "pose_in_link")
    number = _client_number(client)
    mount = Mount(body, _find_link(number, body, link), pose)
    simulator = make_simulator(design)
    sensor: PybulletSensor | PybulletDepthSensor
    if perception == "depth_camera":
        image = Image.of(other, simulator.design)
        sensor = PybulletDepthSensor(number, mount, simulator, rules, image)
    else:
        sensor = PybulletSensor(ClientSource(number, rules), mount, simulator)
        sensor.contact_forces = bool(other.get("contact_forces", True))
    sensor.use_readout(sensor.readout if readout is None else readout)
    sensor.warn()
    return sensor


def attach_skin(
    client: Any,
    body: int,
    mounts: Mapping[str, tuple[int | str, Pose]],
    design: AnyDesign | Mapping[str, AnyDesign] = DEFAULT_DESIGN,
    *,
    readout: Readout | str | Path | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
    **options: Unpack[PybulletSkinOptions],
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
        readout: Of which every sensor has a chip of its own, see
            :meth:`~capsense.adapters.skin.AttachedSkin.use_readout`; by default that of the
            simulator, if one is given.
        threads: How many threads read; by default as many as the process may use processors.
        progress: Called with a stage's name and the fraction done. What is worked out is kept, also
            if it is interrupted.
        options: As for :func:`attach`: those of :class:`PybulletSkinOptions`.

    Raises:
        MissingDependencyError: PyBullet is not installed.
        TypeError: There is no such option.
        ValueError: There are no such shapes, or ``threads`` is not a positive whole number.
        SceneError: There is no such client, body or link, a pattern fits nothing, or a shape is
            not supported.
        DesignError: A design is wrong.
        ReadoutError: There is no such chip.
    """
    require_package("pybullet", "PyBullet", "pybullet")
    rules, other = split_rules(options, PybulletSkinOptions)
    number = _client_number(client)
    places: dict[str, Mount] = {}
    for name, mount in mounts.items():
        if not (isinstance(mount, tuple) and len(mount) == 2 and isinstance(mount[1], Pose)):
            raise SceneError(f"mount {name!r} is {mount!r}; give a pair (link, Pose(…))")
        places[name] = Mount(body, _find_link(number, body, mount[0]), mount[1])
    source = ClientSource(number, rules)
    simulators = simulators_of(places, design, progress)
    sensors = {k: PybulletSensor(source, mount, simulators[k]) for k, mount in places.items()}
    for sensor in sensors.values():
        sensor.contact_forces = bool(other.get("contact_forces", True))
    skin = AttachedSkin(sensors, readout, threads)
    skin.warn(progress)
    return skin


def attach_layout(
    client: Any,
    body: int,
    link: int | str,
    layout: SkinLayout,
    *,
    readout: Readout | str | Path | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
    **options: Unpack[PybulletSkinOptions],
) -> AttachedSkin:
    """Attach the patches of a layout to a link; one ``read()`` reads them all.

    Patches that lie inside other links or bodies at present are left out; a warning names them.

    Args:
        client: What ``pybullet.connect`` returned, or a ``BulletClient``.
        body: The body that carries the skin.
        link: The link, by index or name; the layout is in its frame.
        layout: What ``cs.skin.from_mesh``, ``from_taxels`` or ``paint`` returns.
        readout: As of :func:`attach_skin`.
        threads: As of :func:`attach_skin`.
        progress: As of :func:`attach_skin`.
        options: As of :func:`attach_skin`.

    Raises:
        MissingDependencyError: PyBullet is not installed.
        TypeError: There is no such option, or ``layout`` is no layout.
        ValueError: There are no such shapes, or ``threads`` is not a positive whole number.
        SceneError: There is no such client, body or link, a pattern fits nothing, a shape is not
            supported, or all patches lie inside other links.
        ReadoutError: There is no such chip.
    """
    require_package("pybullet", "PyBullet", "pybullet")
    import pybullet as p

    rules, _ = split_rules(options, PybulletSkinOptions)
    number = _client_number(client)
    source = ClientSource(number, rules)
    at = _find_link(number, body, link)
    inertial = p.getDynamicsInfo(body, at, physicsClientId=number)[3:5]
    clear = clear_of_neighbours(layout, source, source.index(body, at), Pose(*inertial).inverse())
    mounts = {name: (at, pose) for name, (_, pose) in clear.items()}
    return attach_skin(
        client, body, mounts, clear.designs, readout=readout, threads=threads,
        progress=progress, **options,
    )  # fmt: skip


class PybulletSensor(GeometrySensor):
    """A sensor on a link in PyBullet; made by :func:`attach`."""

    source: ClientSource

    def __init__(self, source: ClientSource, mount: Mount, simulator: Simulator) -> None:
        self.client = source.client
        """Number of the physics client."""
        self.body, self.link = mount.body, mount.link
        """The body that carries the sensor, and its link, -1 for the base."""
        self._in_link = mount.pose_in_link
        super().__init__(simulator, source)

    def check(self) -> Findings:
        seen = self.world.names(self.source.clear)
        names = [str(body.name) for body in self.scene() if body.name in seen]
        return Findings([*super().check(), *markers(names, names)])

    def _take_over(self) -> None:
        import pybullet as p

        self._carrier = self.source.index(self.body, self.link)
        dynamics = p.getDynamicsInfo(self.body, self.link, physicsClientId=self.client)
        self._in_frame = Pose(*dynamics[3:5]).inverse() @ self._in_link
        super()._take_over()

    def _own_frame(self) -> int | None:
        return self._carrier if self.source.rules.exclude_own else None

    def _frames(self, position: Array, quaternion: Array) -> Frames:
        sensor = Pose(position[self._carrier], quaternion[self._carrier]) @ self._in_frame
        return Frames(position, quaternion, np.array(sensor.position), np.array(sensor.quaternion))


class PybulletDepthSensor(DepthSensor):
    """A sensor that sees a depth image; made by :func:`attach`."""

    def __init__(
        self, client: int, mount: Mount, simulator: Simulator, rules: Rules, image: Image
    ) -> None:
        super().__init__(simulator)
        self.client = client
        """Number of the physics client."""
        self.body, self.link = mount.body, mount.link
        """The body that carries the sensor, and its link, -1 for the base."""
        self._in_link, self._rules, self._image = mount.pose_in_link, rules, image
        far = float(simulator.design.domain.upper[2])
        self._near, self._far = _WITHDRAWN + _NEAR, _WITHDRAWN + far
        self._camera = OrthographicCamera(image.size, image.size, Pose(), near=_NEAR, far=far)
        self._projection = _projection(image.size, self._near, self._far, image.resolution)
        self._watch = BodyWatch(client)
        self._eps_r: dict[int, float] = {}
        check_patterns(rules, self._read_materials())

    def frame(self) -> DepthFrame:
        """The depth image of the present state."""
        import pybullet as p

        if self._watch.changed():
            links = self._read_materials()
            if (self.body, self.link) not in [(k.body, k.link) for k in links]:
                raise gone(self.body)
        n = self._image.resolution
        view = (self.pose @ _CAMERA).inverse().matrix.T.ravel().tolist()
        image = p.getCameraImage(
            n, n, view, self._projection, renderer=p.ER_TINY_RENDERER,
            flags=p.ER_SEGMENTATION_MASK_OBJECT_AND_LINKINDEX, physicsClientId=self.client,
        )  # fmt: skip
        buffer = np.asarray(image[3], dtype=float).reshape(n, n)
        seen = np.asarray(image[4]).reshape(n, n)
        depth = self._far * self._near / (self._far - (self._far - self._near) * buffer)
        depth -= _WITHDRAWN
        eps_r = np.zeros((n, n))
        for code in np.unique(seen[seen >= 0]).tolist():
            eps_r[seen == code] = self._eps_r.get(code, 0.0)
        return DepthFrame(
            depth, eps_r, self._camera, grounding=self._rules.default_grounding,
            back=self._image.back,
        )  # fmt: skip

    @property
    def pose(self) -> Pose:
        import pybullet as p

        if self.link < 0:
            inertial = p.getDynamicsInfo(self.body, -1, physicsClientId=self.client)[3:5]
            mass = p.getBasePositionAndOrientation(self.body, physicsClientId=self.client)
            return Pose(*mass) @ Pose(*inertial).inverse() @ self._in_link
        state = p.getLinkState(
            self.body, self.link, computeForwardKinematics=1, physicsClientId=self.client
        )
        return Pose(*state[4:6]) @ self._in_link

    def _read_materials(self) -> list[Link]:
        """What each code of the segmentation mask is made of: 0 for what is not seen."""
        links = [link for body in self._watch.bodies() for link in links_of(self.client, body)]
        self._eps_r = {}
        for link in links:
            own = (link.body, link.link) == (self.body, self.link)
            code = link.body + ((link.link + 1) << 24)
            if (own and self._rules.exclude_own) or self._rules.excludes(link.names):
                self._eps_r[code] = 0.0
                continue
            matter, _ = matter_of(self.client, link, self._rules)
            conducts = matter.is_conductor()
            self._eps_r[code] = np.inf if conducts else matter.eps_r
        return links


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


def _projection(size: float, near: float, far: float, resolution: int) -> list[float]:
    """The projection matrix, column by column, that TinyRenderer takes as orthographic.

    It mistreats true orthographic matrices, in which depth is linear (bulletphysics/bullet3 issue
    2628). This one has their rows for x and y and the row of a perspective for z; the shift by
    half a pixel brings its samples to the pixels' centres.
    """
    m = np.diag([2 / size, 2 / size, -(far + near) / (far - near), 1.0])
    m[2, 3] = -2 * far * near / (far - near)
    m[0, 3] = m[1, 3] = -1 / resolution
    return [float(v) for v in m.T.ravel()]
