"""A sensor's site, and the camera of a depth sensor, added to a MuJoCo model before it is built."""

from __future__ import annotations

from typing import TYPE_CHECKING

from capsense.adapters.attached import check_image, refuse_missing
from capsense.errors import SceneError
from capsense.scene import Pose

if TYPE_CHECKING:
    import mujoco

_TO_CAMERA = Pose((0, 0, 0), (1, 0, 0, 0))
"""MuJoCo's cameras look along -z: half a turn about x."""


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
        ``name``, as :func:`~capsense.adapters.mujoco.attach` takes it.

    Raises:
        SceneError: There is no such body, the name is taken, or something is of the wrong kind
            or out of range.
    """
    import mujoco

    if not isinstance(spec, mujoco.MjSpec):
        raise SceneError(
            f"spec is a {type(spec).__name__}; give a mujoco.MjSpec, such as "
            "mujoco.MjSpec.from_file(path)"
        )
    if not isinstance(pose, Pose):
        raise SceneError(f"pose is {pose!r}; give a Pose(position, quaternion)")
    if not isinstance(name, str) or not name:
        raise SceneError(f"name is {name!r}; give the new site a name, like 'pad'")
    carrier = spec.body(body) if isinstance(body, str) else None
    if carrier is None:
        raise refuse_missing("body", str(body), [b.name for b in spec.bodies if b.name])
    taken = {"site": spec.sites, "camera": spec.cameras if camera is not None else []}
    for kind, things in taken.items():
        if name in [thing.name for thing in things]:
            raise SceneError(f"the model has a {kind} named {name!r} already; give another name")
    size, pixels = check_image(camera, resolution, 1.0)
    carrier.add_site(name=name, pos=pose.position, quat=_scalar_first(pose))
    if camera is None:
        return name
    carrier.add_camera(
        name=name, pos=pose.position, quat=_scalar_first(pose @ _TO_CAMERA), fovy=size,
        proj=mujoco.mjtProjection.mjPROJ_ORTHOGRAPHIC, resolution=[pixels, pixels],
    )  # fmt: skip
    depth = 1 << int(mujoco.mjtRayDataField.mjRAYDATA_DEPTH)
    spec.add_sensor(
        type=mujoco.mjtSensor.mjSENS_RANGEFINDER, objtype=mujoco.mjtObj.mjOBJ_CAMERA,
        objname=name, intprm=[depth, 0, 0],
    )  # fmt: skip
    return name


def _scalar_first(pose: Pose) -> list[float]:
    x, y, z, w = pose.quaternion
    return [w, x, y, z]
