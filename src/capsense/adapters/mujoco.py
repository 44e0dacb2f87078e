"""Sensors on the bodies of a MuJoCo model: ``cs.mujoco.attach(model, data, site="wrist_pad")``."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Unpack

import numpy as np
from numpy.typing import NDArray

from capsense.adapters import GeometrySensor, make_simulator, refuse_missing
from capsense.adapters.findings import Finding, Findings
from capsense.adapters.mujoco_depth import MujocoDepthSensor, check_stepped, find_camera, find_site
from capsense.adapters.mujoco_model import ModelSource
from capsense.adapters.placement import markers
from capsense.adapters.rules import AttachOptions, Image, Rules, check_perception, split_rules
from capsense.adapters.skin import AttachedSkin, Progress, clear_of_neighbours, simulators_of
from capsense.adapters.world import Frames
from capsense.design.model import Design
from capsense.errors import SceneError, listed, require_package
from capsense.readout import Readout
from capsense.scene import Pose
from capsense.scene.pose import checked_pose
from capsense.simulator import DEFAULT_DESIGN, Simulator
from capsense.skin import AnyDesign, SkinLayout

if TYPE_CHECKING:
    import mujoco

Array = NDArray[np.float64]

__all__ = [
    "AttachedSkin", "MujocoDepthSensor", "MujocoOptions", "MujocoSensor", "add_sensor", "add_skin",
    "attach", "attach_skin",
]  # fmt: skip

_AWAY = 5.0
"""No sensor is so far [m] from the body that carries it."""
_PLANE = 0
"""Type of planes, mjGEOM_PLANE."""
_SCALAR_LAST = [1, 2, 3, 0]
_TO_CAMERA = Pose((0, 0, 0), (1, 0, 0, 0))
"""MuJoCo's cameras look along -z: half a turn about x."""
_ONLY = {
    "geometry": (
        *("materials", "grounding", "exclude", "exclude_own"),
        *("hull", "shapes", "groups", "contact_forces"),
    ),
    "depth_camera": ("camera", "back"),
}


class MujocoSkinOptions(AttachOptions, total=False):
    """Keywords of :func:`attach_skin`."""

    groups: Collection[int] | None
    """See only geoms of these groups (MuJoCo's 0 to 5); default all. Of these, ``shapes`` chooses
    those that are seen."""
    contact_forces: bool
    """Whether the forces of MuJoCo's contacts press geoms onto the design's cover, True by default;
    of geoms without contact, the overlap with the cover counts."""


class MujocoOptions(MujocoSkinOptions, total=False):
    """Keywords of :func:`attach`; with a depth camera only the defaults and the two below."""

    camera: str | None
    """Name of the camera; by default that of the site. Depth only."""
    back: str | float
    """Where what the camera sees ends, as of :class:`ImageOptions`. Depth only."""


def attach(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    site: str,
    design: Design | str | Path | Simulator = DEFAULT_DESIGN,
    *,
    perception: Literal["geometry", "depth_camera"] = "geometry",
    readout: Readout | str | Path | None = None,
    **options: Unpack[MujocoOptions],
) -> MujocoSensor | MujocoDepthSensor:
    """Attach a sensor to a site of a model; call ``read()`` after every ``mj_step``.

    The site's frame is the sensor frame: origin at the centre of the electrode plane, z out of
    the sensor. With ``perception="geometry"`` geoms become solids once, at this call, and only
    their poses and the vertices of flexes are taken at a reading.

    Name patterns are tried on a geom's name (``geom3`` for the unnamed
    third, say), on its body's name, and on ``body/geom``; on a flex's name. The model can say the
    same in its ``<custom>`` section: ``<text name="capsense.material:arm*" data="human"/>`` and
    ``<text name="capsense.grounding:arm*" data="100e-12"/>``. What is given here comes first,
    then the model's texts, then the defaults. A capacitance to ground is that of all geoms that
    its pattern fits, together.

    With ``perception="depth_camera"`` the sensor sees the image of an orthographic camera that a
    rangefinder reads, which needs no OpenGL::

        <camera name="pad" projection="orthographic" resolution="64 64" fovy="0.5"/>
        <rangefinder camera="pad" data="depth"/>

    The camera should sit on the body of the site and look along the site's z: its frame is the
    site's, turned half round about x. It does not see the geoms of that body. Its rays tell no
    materials: everything is of the default ones.

    Args:
        model: The model.
        data: Its state.
        site: Name of the site that carries the sensor.
        design: A design, a packaged name, a design file, or a ready simulator, whose readout stays
            as it is.
        perception: ``"geometry"``, the shapes themselves, or ``"depth_camera"``, the image of a
            camera.
        readout: A readout whose counts readings are to hold, a chip's name, or a file's; see
            :meth:`~capsense.adapters.AttachedSensor.read`. By default a copy of the simulator's, if
            it has one.
        options: What is seen and what it is made of: ``materials``, ``grounding``, ``exclude`` and
            the others of :class:`MujocoOptions`.

    Raises:
        MissingDependencyError: MuJoCo is not installed.
        TypeError: ``model`` or ``data`` is something else, or there is no such option.
        ValueError: There is no such kind of perception.
        SceneError: There is no such site or camera, a pattern fits nothing, a shape is not
            supported, the camera is not orthographic or nothing reads it, the data belong to
            another model, or an option belongs to the other kind of perception.
        DesignError: The design is wrong.
        ReadoutError: There is no such chip.
    """
    require_package("mujoco", "MuJoCo", "mujoco")
    _check_pair(model, data)
    check_perception(perception, options, _ONLY)
    rules, other = split_rules(options, MujocoOptions)
    number = find_site(model, site)
    sensor: MujocoSensor | MujocoDepthSensor
    if perception == "depth_camera":
        name = other.get("camera")
        camera = find_camera(model, site if name is None else name)
        back = other.get("back", "fill")
        sensor = MujocoDepthSensor(model, data, number, camera, make_simulator(design), rules, back)
    else:
        source = ModelSource(model, data, rules, other.get("groups"))
        sensor = MujocoSensor(source, number, make_simulator(design))
        sensor.contact_forces = bool(other.get("contact_forces", True))
    sensor.use_readout(sensor.readout if readout is None else readout)
    sensor.warn()
    return sensor


def attach_skin(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    sites: Sequence[str],
    design: AnyDesign | Mapping[str, AnyDesign] = DEFAULT_DESIGN,
    *,
    readout: Readout | str | Path | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
    **options: Unpack[MujocoSkinOptions],
) -> AttachedSkin:
    """Attach a sensor to each of several sites; one ``read()`` reads them all, in parallel.

    The model is taken over once for all of them, and sensors of one design share its field. Each
    sees the geometry from its own frame, without the geoms of its own body.

    Args:
        model: The model.
        data: Its state.
        sites: Names of the sites, which are also those of the readings.
        design: What :func:`attach` takes, for all sites, or site → design. A simulator that is
            given for several sites stands for its own design.
        readout: Of which every sensor has a chip of its own, see
            :meth:`~capsense.adapters.skin.AttachedSkin.use_readout`; by default that of the
            simulator, if one is given.
        threads: How many threads read; by default as many as the process may use processors.
        progress: Called with a stage's name and the fraction done. What is worked out is kept, also
            if it is interrupted.
        options: As for :func:`attach`: those of :class:`MujocoSkinOptions`.

    Raises:
        MissingDependencyError: MuJoCo is not installed.
        TypeError: ``model`` or ``data`` is something else, ``sites`` is a single name, or there is
            no such option.
        ValueError: ``threads`` is not a positive whole number.
        SceneError: There is no such site, a pattern fits nothing, a shape is not supported, or
            the data belong to another model.
        DesignError: A design is wrong.
        ReadoutError: There is no such chip.
    """
    require_package("mujoco", "MuJoCo", "mujoco")
    _check_pair(model, data)
    rules, other = split_rules(options, MujocoSkinOptions)
    if isinstance(sites, str):
        raise TypeError(f"sites is {sites!r}; give a list of names, like [{sites!r}]")
    numbers = {site: find_site(model, site) for site in sites}
    source = ModelSource(model, data, rules, other.get("groups"))
    simulators = simulators_of(sites, design, progress)
    sensors = {site: MujocoSensor(source, k, simulators[site]) for site, k in numbers.items()}
    for sensor in sensors.values():
        sensor.contact_forces = bool(other.get("contact_forces", True))
    skin = AttachedSkin(sensors, readout, threads)
    skin.warn(progress)
    return skin


class MujocoSensor(GeometrySensor):
    """A sensor on a site of a MuJoCo model; made by :func:`attach`."""

    source: ModelSource

    def __init__(self, source: ModelSource, site: int, simulator: Simulator) -> None:
        self.model = source.model
        """The model."""
        self.data = source.data
        """The state that readings are taken of."""
        self._site = site
        self._carrier = int(self.model.site_bodyid[site])
        self._turn = np.empty(4)
        super().__init__(simulator, source)

    def _time(self) -> float:
        return float(self.data.time)

    def check(self) -> Findings:
        domain, sensor = self._design.domain, self.pose
        walls = domain.sight
        near = [
            g for g in range(self.model.ngeom) if _reaches(self.model, self.data, g, sensor, walls)
        ]
        own = self._carrier
        more = [*_left_out(self.source, own, near), *_markers(self.source, own, near)]
        return Findings([*super().check(), *more])

    def _own_frame(self) -> int | None:
        return self._carrier if self.source.rules.exclude_own and self._carrier else None

    def _frames(self, position: Array, quaternion: Array) -> Frames:
        import mujoco

        data = self.data
        check_stepped(data, self._site)
        mujoco.mju_mulQuat(self._turn, data.xquat[self._carrier], self.model.site_quat[self._site])
        return Frames(position, quaternion, data.site_xpos[self._site], self._turn[_SCALAR_LAST])


def _left_out(source: ModelSource, own: int, near: Sequence[int]) -> list[Finding]:
    """The finding for geoms that ``groups`` leaves out, though they matter.

    These are in range, or on bodies that move, that are not seen otherwise and not of the sensor's
    robot. A geom in the place of another one of the same body is not missed: robots have geoms
    that collide and geoms that are drawn.

    Args:
        source: The solids of the model.
        own: The body that carries the sensor.
        near: Geoms that reach into the sensor's domain.
    """
    m = source.model
    if source.groups is None:
        return []
    taken = np.zeros(m.ngeom, dtype=bool)
    taken[source.geoms] = True
    missed = [
        g
        for g in np.flatnonzero(~np.isin(m.geom_group, [*source.groups])).tolist()
        if m.geom_bodyid[g] != own
        and not source.reader.excludes(g) and not _twins(source, g, taken).any()
    ]  # fmt: skip
    seen, root = set(m.geom_bodyid[taken].tolist()), m.body_rootid
    free = (m.body_weldid > 0) | (m.body_mocapid[root] >= 0)
    moving = [
        g
        for g in missed
        if free[b := int(m.geom_bodyid[g])] and b not in seen and root[b] != root[own]
    ]
    found = list(dict.fromkeys([g for g in missed if g in near] + moving))
    if not found:
        return []
    groups = sorted(set(m.geom_group[source.geoms].tolist()))
    more = sorted({*groups, *m.geom_group[found].tolist()})
    what = "in the sensor's range" if set(found) & set(near) else "on bodies that move"
    text = (
        f"groups={groups} leaves out {listed([source.reader.name(g) for g in found], 4)}, {what}, "
        f"so that readings do not tell of {'it' if len(found) == 1 else 'them'}; give "
        f"groups={more}, or exclude them by name"
    )
    return [Finding(text, "groups", mounting=True, severity=len(found))]


def _markers(source: ModelSource, own: int, near: Sequence[int]) -> list[Finding]:
    """The finding for geoms in range that look like markers: see-through, and nothing hits them."""
    m = source.model
    collide = (m.geom_contype != 0) | (m.geom_conaffinity != 0)
    clear = m.geom_rgba[:, 3] < 1
    clear |= (m.geom_matid >= 0) & (np.append(m.mat_rgba[:, 3], 1.0)[m.geom_matid] < 1)
    found = [
        g
        for g in source.geoms
        if g in near and clear[g] and not collide[g] and m.geom_bodyid[g] != own
        and not source.reader.excludes(g)
    ]  # fmt: skip
    names = [source.reader.name(g) for g in found]
    bodies = list(dict.fromkeys(name.partition("/")[0] for name in names))
    exclude = names if "world" in bodies else bodies
    return markers(names, exclude)


def _twins(source: ModelSource, geom: int, among: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which geoms stand in the same place as one, on the same body; ``among`` is (ngeom,)."""
    m, data, plane = source.model, source.data, source.model.geom_type == _PLANE
    weld = m.body_weldid[m.geom_bodyid]
    away = np.linalg.norm(data.geom_xpos - data.geom_xpos[geom], axis=1)
    same = (weld == weld[geom]) & (plane == plane[geom]) & among
    return np.asarray(same & (away <= np.maximum(m.geom_rbound, m.geom_rbound[geom])))


def _reaches(
    model: mujoco.MjModel, data: mujoco.MjData, geom: int, sensor: Pose, walls: Array
) -> bool:
    """Whether the box around a geom reaches into a sensor's domain, corners ``walls`` (2, 3)."""
    turn = sensor.rotation.T @ data.geom_xmat[geom].reshape(3, 3)
    at = sensor.inverse().apply(data.geom_xpos[geom])
    if model.geom_type[geom] == _PLANE:
        lowest = np.where(turn[:, 2] > 0, walls[0], walls[1])
        return bool(turn[:, 2] @ (lowest - at) < 0)
    box = model.geom_aabb[geom]
    middle, half = at + turn @ box[:3], np.abs(turn) @ box[3:]
    return bool((middle - half < walls[1]).all() and (middle + half > walls[0]).all())


def add_sensor(
    spec: mujoco.MjSpec,
    body: str,
    pose: Pose,
    name: str = "pad",
    *,
    camera: float | None = None,
    resolution: int = 64,
) -> str:
    """Add the site of a sensor to a body of a model, and on request the camera it sees through.

    Args:
        spec: A model before ``spec.compile()``, such as ``mujoco.MjSpec.from_file(path)``.
        body: Name of the body that carries the sensor; ``"world"`` for the world itself.
        pose: The sensor frame in the body's frame: origin at the centre of the electrode plane,
            z out of the sensor.
        name: Of the site, and of the camera.
        camera: Width and height [m] of the image of an orthographic camera with a rangefinder,
            for ``attach(…, perception="depth_camera")``; by default there is none.
        resolution: Pixels along each side of the image.

    Returns:
        ``name``, as :func:`attach` takes it.

    Raises:
        TypeError: ``spec`` is not an ``MjSpec``.
        SceneError: There is no such body, the name is taken, or something is of the wrong kind
            or out of range.
    """
    import mujoco

    carrier = _find_body(spec, body)
    checked_pose(pose)
    if not isinstance(name, str) or not name:
        raise SceneError(f"name is {name!r}; give the new site a name, like 'pad'")
    away = math.hypot(*pose.position)
    if away > _AWAY and body != "world":
        raise SceneError(
            f"pose places the sensor {away:g} m from body {body!r}; give it in metres "
            "(millimetres × 1e-3) and in the frame of the body, not in that of the world"
        )
    taken = {"site": spec.sites, "camera": spec.cameras if camera is not None else []}
    for kind, things in taken.items():
        if name in [thing.name for thing in things]:
            raise SceneError(f"the model has a {kind} named {name!r} already; give another name")
    image = Image(1.0 if camera is None else camera, resolution)
    carrier.add_site(name=name, pos=pose.position, quat=_scalar_first(pose))
    if camera is None:
        return name
    carrier.add_camera(
        name=name, pos=pose.position, quat=_scalar_first(pose @ _TO_CAMERA), fovy=image.size,
        proj=mujoco.mjtProjection.mjPROJ_ORTHOGRAPHIC, resolution=[resolution, resolution],
    )  # fmt: skip
    depth = 1 << int(mujoco.mjtRayDataField.mjRAYDATA_DEPTH)
    spec.add_sensor(
        type=mujoco.mjtSensor.mjSENS_RANGEFINDER, objtype=mujoco.mjtObj.mjOBJ_CAMERA,
        objname=name, intprm=[depth, 0, 0],
    )  # fmt: skip
    return name


def add_skin(spec: mujoco.MjSpec, body: str, layout: SkinLayout) -> SkinLayout:
    """Add a site for each patch of a layout to a body of a model.

    Patches that lie inside the geoms of other bodies, in the model's initial state, are left out;
    a warning names them. After ``spec.compile()``, :func:`attach_skin` takes the sites and the
    designs of what is returned: ``attach_skin(model, data, sites=list(layout),
    design=layout.designs)``.

    Args:
        spec: A model before ``spec.compile()``.
        body: Name of the body that carries the skin; the layout is in its frame.
        layout: What ``cs.skin.from_mesh``, ``from_taxels`` or ``paint`` returns.

    Returns:
        The layout of the patches that were added.

    Raises:
        MissingDependencyError: MuJoCo is not installed.
        TypeError: ``spec`` is not an ``MjSpec``, or ``layout`` is no layout.
        SceneError: There is no such body, a site has the name of a patch, a geom is not supported,
            or all patches lie inside other bodies.
    """
    require_package("mujoco", "MuJoCo", "mujoco")
    import mujoco

    carrier = _find_body(spec, body)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    source = ModelSource(model, data, Rules(), None)
    clear = clear_of_neighbours(layout, source, int(carrier.id), Pose())
    for name, (_, pose) in clear.items():
        add_sensor(spec, body, pose, name)
    return clear


def _find_body(spec: mujoco.MjSpec, body: str) -> Any:
    """A body of a model before it is compiled."""
    import mujoco

    if not isinstance(spec, mujoco.MjSpec):
        raise TypeError(
            f"spec is a {type(spec).__name__}; give a mujoco.MjSpec, such as "
            "mujoco.MjSpec.from_file(path)"
        )
    carrier = spec.body(body) if isinstance(body, str) else None
    if carrier is None:
        raise refuse_missing("body", str(body), [b.name for b in spec.bodies if b.name])
    return carrier


def _scalar_first(pose: Pose) -> list[float]:
    x, y, z, w = pose.quaternion
    return [w, x, y, z]


def _check_pair(model: Any, data: Any) -> None:
    import mujoco

    if not isinstance(model, mujoco.MjModel):
        raise TypeError(f"model is a {type(model).__name__}; give a mujoco.MjModel")
    if not isinstance(data, mujoco.MjData):
        raise TypeError(f"data is a {type(data).__name__}; give a mujoco.MjData")
    if (len(data.xpos), len(data.site_xpos)) != (model.nbody, model.nsite):
        raise SceneError(
            f"the data belong to another model ({len(data.xpos)} bodies, not {model.nbody}); "
            "make them with mujoco.MjData(model)"
        )
