"""One world of things, made in plain CapSense and in every simulator, seen in every way.

Every builder takes things in the world's frame and the pose of the sensor in it, and returns the
attached sensor. The link that carries it has a box of its own that would hide the electrodes if it
were seen: they are 2 mm under its face. ``WAYS`` lists what the contract is checked on: to add an
adapter, add its builder.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import capsense as cs

CARRIER_BOX = (0.05, 0.04, 0.03)
BOX_AT = cs.Pose((0, 0, -0.013))
"""Where that stands in the sensor frame."""
IMAGE, PIXELS = 0.1, 64
"""Width of depth images [m], that of the small sensor's domain, and their pixels."""
_COUNT = itertools.count()

Builder = Callable[..., Any]


@dataclass(frozen=True)
class Thing:
    """Something that stands in the world."""

    name: str
    shape: cs.Box | cs.Sphere | cs.Capsule | cs.Cylinder | cs.TriMesh
    pose: cs.Pose


def plain_reading(
    things: Sequence[Thing], sensor: cs.Pose, simulator: cs.Simulator, **body: Any
) -> cs.Reading:
    """The reading of :meth:`capsense.Simulator.step`, for comparison."""
    world = sensor.inverse()
    simulator.reset()
    return simulator.step(
        cs.Scene([cs.Body(t.shape, world @ t.pose, name=t.name, **body) for t in things])
    )


def image_reading(things: Sequence[Thing], sensor: cs.Pose, simulator: cs.Simulator) -> cs.Reading:
    """The reading of the depth image of our own rasteriser, for comparison."""
    depth = np.full((PIXELS, PIXELS), np.nan)
    for thing in things:
        mesh = thing.shape.to_trimesh()
        vertices = (sensor.inverse() @ thing.pose).apply(mesh.vertices)
        raster = cs.render_depth(vertices, mesh.faces, (IMAGE, IMAGE), (PIXELS, PIXELS))
        depth = np.fmin(depth, np.where(raster.depth > 0, raster.depth, np.nan))
    simulator.reset()
    return simulator.step(cs.DepthFrame(depth, camera=cs.OrthographicCamera(IMAGE, IMAGE)))


# -- MuJoCo ------------------------------------------------------------------------------------


def numbers(values: Any) -> str:
    """Numbers as XML attributes hold them, to the last digit."""
    return " ".join(repr(float(v)) for v in np.ravel(values))


def mjcf_geom(thing: Thing) -> tuple[str, str]:
    """The geom of a thing, and the asset it needs."""
    shape, asset = thing.shape, ""
    match shape:
        case cs.Box():
            geom = f'type="box" size="{numbers(shape.params)}"'
        case cs.Sphere():
            geom = f'type="sphere" size="{shape.radius!r}"'
        case cs.Capsule():
            geom = f'type="capsule" size="{numbers((shape.radius, shape.length / 2))}"'
        case cs.Cylinder():
            geom = f'type="cylinder" size="{numbers((shape.radius, shape.length / 2))}"'
        case cs.TriMesh():
            geom = f'type="mesh" mesh="{thing.name}_mesh"'
            asset = (
                f'<mesh name="{thing.name}_mesh" inertia="exact" '
                f'vertex="{numbers(shape.vertices)}" '
                f'face="{" ".join(map(str, shape.faces.ravel()))}"/>'
            )
    return f'<geom name="{thing.name}_geom" {geom}/>', asset


def mjcf(things: Sequence[Thing], sensor: cs.Pose, pixels: int | None = None) -> str:
    """A model of the things, each a free body, and of the sensor's carrier.

    With ``pixels``, the sensor has a depth camera of so many along each side.
    """

    def frame(pose: cs.Pose) -> str:
        x, y, z, w = pose.quaternion
        return f'pos="{numbers(pose.position)}" quat="{numbers((w, x, y, z))}"'

    parts = [(t, *mjcf_geom(t)) for t in things]
    bodies = "".join(
        f'<body name="{t.name}" {frame(t.pose)}><freejoint/>{geom}</body>' for t, geom, _ in parts
    )
    offset = cs.Pose((0.01, -0.02, 0.03), (0.1, 0.2, 0.3, 0.9))
    camera, reader = "", ""
    if pixels is not None:
        view = frame(offset @ cs.Pose((0, 0, 0), (1, 0, 0, 0)))
        camera = (
            f'<camera name="pad" {view} projection="orthographic" fovy="{IMAGE}" '
            f'resolution="{pixels} {pixels}"/>'
        )
        reader = '<sensor><rangefinder camera="pad" data="depth"/></sensor>'
    return (
        '<mujoco><option gravity="0 0 0"/><default><geom contype="0" conaffinity="0"/></default>'
        f"<asset>{''.join(a for _, _, a in parts)}</asset><worldbody>{bodies}"
        f'<body name="carrier" {frame(sensor @ offset.inverse())}><freejoint/>'
        f'<geom name="carrier_geom" type="box" size="{numbers(np.divide(CARRIER_BOX, 2))}" '
        f"{frame(offset @ BOX_AT)}/>"
        f'<site name="pad" {frame(offset)}/>{camera}</body></worldbody>{reader}</mujoco>'
    )


def mujoco_sensor(
    things: Sequence[Thing], sensor: cs.Pose, simulator: cs.Simulator, folder: Path, **options: Any
) -> Any:
    """A sensor in MuJoCo, after one step."""
    import mujoco

    pixels = (
        options.pop("resolution", PIXELS) if options.get("perception") == "depth_camera" else None
    )
    model = mujoco.MjModel.from_xml_string(mjcf(things, sensor, pixels))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    return cs.mujoco.attach(model, data, "pad", simulator, **options)


# -- PyBullet ----------------------------------------------------------------------------------


def urdf(name: str, geometry: str, origin: cs.Pose | None = None) -> str:
    """A body of one link, its centre of mass off the origin."""
    origin = origin or cs.Pose()
    x, y, z, w = origin.quaternion
    rpy = np.array(
        [
            np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
            np.arcsin(np.clip(2 * (w * y - z * x), -1, 1)),
            np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
        ]
    )
    place = f'<origin xyz="{numbers(origin.position)}" rpy="{numbers(rpy)}"/>'
    shape = f"{place}<geometry>{geometry}</geometry>"
    return (
        f'<robot name="{name}"><link name="{name}_link"><inertial>'
        '<origin xyz="0.01 0.02 -0.03" rpy="0.1 0.2 0.3"/><mass value="1"/>'
        '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
        f"<visual>{shape}</visual><collision>{shape}</collision></link></robot>"
    )


def urdf_geometry(thing: Thing, folder: Path) -> str:
    """The geometry of a thing; a mesh is written beside."""
    shape = thing.shape
    match shape:
        case cs.Box():
            return f'<box size="{numbers(shape.size)}"/>'
        case cs.Sphere():
            return f'<sphere radius="{shape.radius!r}"/>'
        case cs.Capsule():
            return f'<capsule radius="{shape.radius!r}" length="{shape.length!r}"/>'
        case cs.Cylinder():
            return f'<cylinder radius="{shape.radius!r}" length="{shape.length!r}"/>'
    assert isinstance(shape, cs.TriMesh)
    file = folder / f"{thing.name}.obj"
    lines = [f"v {numbers(v)}" for v in shape.vertices]
    lines += ["f " + " ".join(str(i + 1) for i in f) for f in shape.faces]
    file.write_text("\n".join(lines))
    return f'<mesh filename="{file}"/>'


def _as_mesh(shape: Any) -> cs.TriMesh:
    mesh = shape.to_trimesh()
    return cs.TriMesh(mesh.vertices, mesh.faces)


def load(client: int, text: str, pose: cs.Pose, folder: Path) -> int:
    """Load a URDF so that its link frame stands at a pose."""
    import pybullet as p

    file = folder / f"{next(_COUNT)}.urdf"
    file.write_text(text)
    return p.loadURDF(str(file), pose.position, pose.quaternion, physicsClientId=client)


def pybullet_sensor(
    things: Sequence[Thing], sensor: cs.Pose, simulator: cs.Simulator, folder: Path, **options: Any
) -> Any:
    """A sensor in PyBullet, after one step; the caller disconnects ``sensor.client``.

    What a depth image is to show is given as meshes, as PyBullet draws its own round shapes as
    coarse polyhedra.
    """
    import pybullet as p

    if options.get("perception") == "depth_camera":
        things = [Thing(t.name, _as_mesh(t.shape), t.pose) for t in things]
    client = p.connect(p.DIRECT)
    carrier, offset = fill_bullet(client, things, sensor, folder)
    return cs.pybullet.attach(client, carrier, "carrier_link", offset, simulator, **options)


def assistive_gym_sensor(
    things: Sequence[Thing], sensor: cs.Pose, simulator: cs.Simulator, folder: Path, **options: Any
) -> Any:
    """A sensor in an environment of Assistive Gym's kind that holds an agent of its own."""
    import small_gym

    env = small_gym.Env(person=False)
    env.iteration, env.carrier = 0, small_gym.Agent()
    carrier, offset = fill_bullet(env.id, things, sensor, folder)
    env.carrier.init(carrier, env.id)
    return cs.assistive_gym.attach(env, "carrier", "carrier_link", offset, simulator, **options)


def fill_bullet(
    client: int, things: Sequence[Thing], sensor: cs.Pose, folder: Path
) -> tuple[int, cs.Pose]:
    """Fill a world of PyBullet and make a step.

    Returns:
        The body that carries the sensor, and the sensor frame in its link's.
    """
    import pybullet as p

    for thing in things:
        load(client, urdf(thing.name, urdf_geometry(thing, folder)), thing.pose, folder)
    offset = cs.Pose((0.01, -0.02, 0.03), (0.1, 0.2, 0.3, 0.9))
    box = f'<box size="{numbers(CARRIER_BOX)}"/>'
    carrier = load(client, urdf("carrier", box, offset @ BOX_AT), sensor @ offset.inverse(), folder)
    for body in range(p.getNumBodies(physicsClientId=client)):
        p.setCollisionFilterGroupMask(body, -1, 0, 0, physicsClientId=client)
    p.stepSimulation(physicsClientId=client)
    return carrier, offset


# -- CoppeliaSim -------------------------------------------------------------------------------


def coppeliasim_sensor(
    things: Sequence[Thing], sensor: cs.Pose, simulator: cs.Simulator, folder: Path, **options: Any
) -> Any:
    """A sensor in the stand-in for CoppeliaSim."""
    from coppelia_stand_in import StandIn

    server = StandIn()
    offset = cs.Pose((0.01, -0.02, 0.03), (0.1, 0.2, 0.3, 0.9))
    box = server.add("carrier", cs.Box(CARRIER_BOX), sensor @ BOX_AT)
    for thing in things:
        server.add(thing.name, thing.shape, thing.pose)
    sim = cs.coppeliasim.connect(port=server.port)
    sim.startSimulation()
    on = server.add("link", local=(offset @ BOX_AT).inverse(), on=box)
    made = cs.coppeliasim.attach(sim, on, simulator, pose_in_object=offset, **options)
    made.server = server
    return made


def release(sensor: Any) -> None:
    """Give back what the sensor's simulator holds."""
    if hasattr(sensor, "server"):
        sensor.server.close()
    elif hasattr(sensor, "client"):
        import pybullet as p

        p.disconnect(physicsClientId=sensor.client)


# -- what the contract is checked on -----------------------------------------------------------


@dataclass(frozen=True)
class Way:
    """One way in which an adapter sees a world."""

    package: str
    """What must be installed."""
    build: Builder
    """``build(things, pose, simulator, folder, **options)``: the attached sensor."""
    options: dict[str, Any]
    """Of the builder, for this way."""
    expected: Callable[..., cs.Reading]
    """What a reading is compared with: ``expected(things, pose, simulator)``."""
    same: float
    """Largest difference from that, relative to the largest change."""
    moved: float
    """Largest difference of two readings of one scene in another place, relative likewise."""
    has_clock: bool
    """Whether the simulator tells its time."""

    @property
    def sees_shapes(self) -> bool:
        """Whether it sees the shapes themselves, with their names."""
        return self.expected is plain_reading


WAYS = {
    # MuJoCo keeps meshes in single precision and in a frame of its own: measured 1e-7. PyBullet
    # makes a hull of other triangles of them: measured 1.0e-4
    "mujoco": Way("mujoco", mujoco_sensor, {}, plain_reading, 1e-4, 1e-4, True),
    "pybullet": Way("pybullet", pybullet_sensor, {}, plain_reading, 2e-4, 1e-4, False),
    "assistive gym": Way("pybullet", assistive_gym_sensor, {}, plain_reading, 2e-4, 1e-4, True),
    # rays hit round bodies, our rasteriser draws meshes of them; PyBullet draws one pixel of a
    # ball's rim more or less: measured 0.4 %
    "mujoco depth": Way(
        "mujoco", mujoco_sensor, {"perception": "depth_camera"}, image_reading, 0.03, 1e-4, True
    ),
    "pybullet depth": Way(
        "pybullet",
        pybullet_sensor,
        {"perception": "depth_camera"},
        image_reading,
        8e-3,
        1e-3,
        False,
    ),
    "coppeliasim": Way(
        "coppeliasim_zmqremoteapi_client", coppeliasim_sensor, {}, image_reading, 0.02, 1e-3, True
    ),
}
