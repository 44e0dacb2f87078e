"""``capsense/LimbFollow-v0``: keep a pose relative to a moving forearm."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from capsense.learning.envs.base import CapacitiveEnv
from capsense.scene import Pose

Array = NDArray[np.float64]

GAP = 0.05
"""How far over the skin the pad is to be [m]."""
NEAR, TURN = 0.05, math.radians(20.0)
"""Errors [m], [rad] that each lower the reward to 1/e."""
LOST = 0.15
"""The episode ends where the pad is further away than this from where it should be [m]."""
CLEAR = 0.02
"""The pad begins no nearer to the arm than this [m]: it is raised where it would."""
_RAISES = 3
"""So often, as the nearest points of both move meanwhile."""
EFFORT = 0.01
"""What the square of an action costs."""
_TO_X = Pose.from_euler((0, 0, 0), (0, math.pi / 2, 0))


class LimbFollow(CapacitiveEnv):
    """Six electrodes over a forearm that sways: stay 5 cm over it, in its middle and along it.

    Actions: velocities along x, y, z [0.2 m/s] and about z, y [1 rad/s] of the pad. Reward:
    ``exp(-(e/5 cm)² - (θ/20°)²) - 0.01 |a|² - 0.02 F``, of the error e of its place across the
    arm, the angle θ from its direction, the action a and the contact force F [N]. The episode ends
    early where the pad is 15 cm astray. Facts: ``error`` [m], ``angle`` [rad].
    """

    model_file = "carriage.xml"
    sites = ("pad",)
    own_design = "six_patch"
    speeds = (0.2, 0.2, 0.2, 1.0, 1.0)
    parts = ("forearm",)

    def begin(self) -> dict[str, float]:
        self._phase = [self.between(0, 2 * math.pi) for _ in range(4)]
        self._pace = [2 * math.pi * self.between(0.05, 0.2) for _ in range(4)]
        self._sway = [self.between(0.4 * top, top) for top in (0.08, 0.04, 0.3, 0.15)]
        self._rest = self.astray()
        build = self.drawn.build
        self.radius = 0.5 * (build.radius("forearm") + build.radius("wrist"))
        """Of the middle of the forearm [m]."""
        self._middle = build.length("upper arm") + 0.5 * build.length("forearm")
        self._hang = _TO_X @ Pose((0, 0, self._middle))
        return {}

    def start(self) -> None:
        yaw, pitch, _ = self.astray(turned=True)
        self.data.qpos[:] = 0.0, 0.0, self.radius + GAP, yaw, pitch
        for _ in range(_RAISES):
            mujoco.mj_forward(self.model, self.data)
            self.data.qpos[2] += max(0.0, CLEAR - self.clearance())

    def limb_pose(self, time: float) -> Pose:
        y, z, yaw, pitch = (
            a * math.sin(p + w * time)
            for a, p, w in zip(self._sway, self._phase, self._pace, strict=True)
        )
        x0, y0, z0 = self._rest
        middle = Pose.from_euler((x0, y + y0, z + 0.5 * z0), (0.0, pitch, yaw))
        return middle @ self._hang

    def judge(self, action: Array, force: float) -> tuple[float, bool, dict[str, Any]]:
        pose = Pose(self.data.mocap_pos[0], self.data.mocap_quat[0][[1, 2, 3, 0]])
        middle = pose.apply((0.0, 0.0, -self._middle))
        error, angle = across(*self.site_frame("pad"), middle, pose.rotation[:, 2], self.radius)
        reward = math.exp(-((error / NEAR) ** 2) - (angle / TURN) ** 2)
        reward -= EFFORT * float(action @ action)
        return reward, error > LOST, {"error": error, "angle": angle}


def across(
    place: Array, axes: Array, middle: Array, along: Array, radius: float
) -> tuple[float, float]:
    """How far a sensor is from where it should be over a round limb.

    Args:
        place: Its origin [m].
        axes: Its axes as columns, shape (3, 3).
        middle: A point on the limb's axis [m].
        along: Unit vector along that.
        radius: Of the limb [m].

    Returns:
        Distance [m] across the limb from the place 5 cm over its skin, straight before the
        sensor; and the angle [rad] between the sensor's x and the limb.
    """
    to = middle - place
    to = axes.T @ (to - (to @ along) * along)
    angle = math.acos(min(1.0, abs(float(axes[:, 0] @ along))))
    return math.hypot(to[1], to[2] - radius - GAP), angle
