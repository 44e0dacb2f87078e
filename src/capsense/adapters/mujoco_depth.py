"""Depth images of MuJoCo's rangefinder cameras: rays in C, no OpenGL."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from capsense.adapters import DepthSensor, refuse_missing
from capsense.adapters.findings import Finding, Findings
from capsense.adapters.rules import Rules
from capsense.errors import SceneError
from capsense.scene import Pose
from capsense.scene.camera import OrthographicCamera
from capsense.scene.depth import DepthFrame
from capsense.simulator import Simulator

if TYPE_CHECKING:
    import mujoco

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DepthCamera:
    """A camera and where its depths lie among the sensor data."""

    number: int
    """The camera's number."""
    start: int
    """First entry of ``sensordata``."""
    rows: int
    columns: int
    height: float
    """Height of the image [m]."""
    cutoff: float
    """Depths beyond this [m] are cut to it; 0 where none are."""


class MujocoDepthSensor(DepthSensor):
    """A sensor that sees a depth image; made by :func:`capsense.adapters.mujoco.attach`."""

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        site: int,
        camera: DepthCamera,
        simulator: Simulator,
        rules: Rules,
        back: str | float,
    ) -> None:
        super().__init__(simulator)
        self.model = model
        """The model."""
        self.data = data
        """The state that readings are taken of."""
        self._site, self._depth_camera = site, camera
        self._material, self._grounding = rules.default_material, rules.default_grounding
        self._back = back
        width = camera.height * camera.columns / camera.rows
        far = float(simulator.design.domain.upper[2])
        self._camera = OrthographicCamera.opengl(width, camera.height, Pose(), far=far)
        self._same_body = model.site_bodyid[site] == model.cam_bodyid[camera.number]
        self._placed: OrthographicCamera | None = None
        DepthFrame(np.zeros((1, 1)), self._material, back=back)  # checks them

    def frame(self) -> DepthFrame:
        """The depth image of the present state.

        Raises:
            SceneError: The simulator has not been stepped yet.
        """
        check_stepped(self.data, self._site)
        camera = self._depth_camera
        depth = self.data.sensordata[camera.start : camera.start + camera.rows * camera.columns]
        return DepthFrame(
            depth.reshape(camera.rows, camera.columns), self._material, self._camera_now(),
            grounding=self._grounding, back=self._back,
        )  # fmt: skip

    def check(self) -> Findings:
        camera, size = self._depth_camera, self._design.domain.size
        name, far = self.model.camera(camera.number).name, self._camera.far
        found: list[str] = []
        if camera.height > 4 * max(size[:2]):
            found.append(
                f"camera {name!r} shows {camera.height:g} m; give it the height of its image in "
                f'metres, like fovy="{max(size[:2]):g}" (without it, MuJoCo takes 45)'
            )
        elif camera.height / camera.rows > max(size[:2]) / 16:
            found.append(
                f"camera {name!r} has pixels of {1e3 * camera.height / camera.rows:.0f} mm; give "
                'it more of them, like resolution="64 64"'
            )
        if 0 < camera.cutoff < far:
            found.append(
                f"the rangefinder of camera {name!r} is cut off at {camera.cutoff:g} m, where "
                f"everything beyond seems to stand; leave cutoff out, or let it be {far:g} or more"
            )
        if self._camera_now().pose.rotation[2, 2] < 0.5:
            found.append(
                f"camera {name!r} does not look along the sensor's z; its frame is the site's, "
                'turned half round about x (euler="180 0 0")'
            )
        if not found:
            return super().check()
        return Findings(Finding(text, "camera", mounting=True) for text in found)

    def _time(self) -> float:
        return float(self.data.time)

    @property
    def pose(self) -> Pose:
        check_stepped(self.data, self._site)
        return _pose(self.data.site_xpos[self._site], self.data.site_xmat[self._site])

    def _camera_now(self) -> OrthographicCamera:
        """The camera in the sensor frame; a fixed one on the site's own body is placed once."""
        if self._placed is not None:
            return self._placed
        number = self._depth_camera.number
        view = self.pose.inverse() @ _pose(self.data.cam_xpos[number], self.data.cam_xmat[number])
        c = self._camera
        camera = OrthographicCamera.opengl(c.width, c.height, view, far=c.far)
        if self._same_body and int(self.model.cam_mode[number]) == 0:
            self._placed = camera
        return camera


def find_site(model: mujoco.MjModel, name: str) -> int:
    """The number of a site.

    Raises:
        SceneError: There is none of that name.
    """
    import mujoco

    _require_name("site", name)
    site = mujoco.mj_name2id(model, int(mujoco.mjtObj.mjOBJ_SITE), name)
    if site < 0:
        known = [model.site(i).name for i in range(model.nsite)]
        raise refuse_missing("site", name, known, "cs.mujoco.add_sensor(spec, body, pose)")
    return int(site)


def find_camera(model: mujoco.MjModel, name: str) -> DepthCamera:
    """An orthographic camera that a rangefinder reads.

    Raises:
        SceneError: There is no such camera, it is in perspective, or nothing reads its depths.
    """
    import mujoco

    _require_name("camera", name)
    number = mujoco.mj_name2id(model, int(mujoco.mjtObj.mjOBJ_CAMERA), name)
    if number < 0:
        known = [model.camera(i).name for i in range(model.ncam)]
        raise refuse_missing("camera", name, known, "cs.mujoco.add_sensor(…, camera=width)")
    if int(model.cam_projection[number]) != 1:
        raise SceneError(
            f"camera {name!r} is in perspective, but depth frames need parallel rays; give it "
            'projection="orthographic"'
        )
    columns, rows = (int(v) for v in model.cam_resolution[number])
    for k in range(model.nsensor):
        reads = (
            int(model.sensor_type[k]),
            int(model.sensor_objtype[k]),
            int(model.sensor_objid[k]),
        )
        wanted = (int(mujoco.mjtSensor.mjSENS_RANGEFINDER), int(mujoco.mjtObj.mjOBJ_CAMERA), number)
        if reads == wanted and int(model.sensor_dim[k]) == rows * columns:
            height = float(model.cam_fovy[number])
            cutoff = float(model.sensor_cutoff[k])
            return DepthCamera(int(number), int(model.sensor_adr[k]), rows, columns, height, cutoff)
    raise SceneError(
        f'nothing reads the depths of camera {name!r}; add <rangefinder camera="{name}" '
        'data="depth"/> to the <sensor> section'
    )


def _require_name(what: str, name: object) -> None:
    if not isinstance(name, str):
        raise SceneError(f"{what} is {name!r}; give the {what}'s name, like 'wrist_pad'")


def check_stepped(data: mujoco.MjData, site: int) -> None:
    """Refuse data that hold no poses.

    Raises:
        SceneError: Such data.
    """
    if not data.site_xmat[site].any():
        raise SceneError(
            "the data hold no poses yet; call mujoco.mj_forward(model, data) or mj_step first"
        )


def _pose(position: Array, matrix: Array) -> Pose:
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = matrix.reshape(3, 3), position
    return Pose.from_matrix(whole)
