"""``capsense/Dressing-v0``: take a sleeve along an arm, at a set distance from the skin."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from capsense.learning.envs.base import CapacitiveEnv
from capsense.learning.envs.follow import GAP, NEAR, across
from capsense.scene import Pose

Array = NDArray[np.float64]

CUFF, THREAD, PARTS = 0.10, 0.004, 16
"""Radius of the sleeve's cuff, and of the ring that stands for it [m]; pieces of that."""
WAY, DONE = 20.0, 5.0
"""What the whole way along the arm is worth, and its end."""
LOST, PAIN = 0.15, 40.0
"""The episode ends this far from the arm's axis [m], and at this contact force [N]."""
_TO_X = Pose.from_euler((0, 0, 0), (0, math.pi / 2, 0))


class Dressing(CapacitiveEnv):
    """Six electrodes over the cuff of a sleeve, which goes from the hand to the shoulder.

    The cuff hangs from the pad, 10 cm in radius, around the arm, and collides with it; it is of
    cloth, which the sensor does not feel. The elbow is bent to one side. Actions: as those of
    LimbFollow. Reward: 20 for the whole way along the arm, in proportion, less ``0.1 e / 5 cm`` at
    every step, of the error e of the pad's place across the arm from 5 cm over the skin, less
    0.02 F; and 5 at the shoulder. The episode ends there, 15 cm astray, or at 40 N. Facts:
    ``error`` [m], ``angle`` [rad], ``progress`` from 0 to 1, ``success``.
    """

    model_file = "carriage.xml"
    sites = ("pad",)
    own_design = "six_patch"
    speeds = (0.2, 0.2, 0.2, 1.0, 1.0)
    parts = ("upper_arm", "forearm", "hand")

    def begin(self) -> dict[str, float]:
        angles = {"elbow_flexion": self.between(0.0, 0.6)}
        side = 1.0 if self.between(-1.0, 1.0) > 0 else -1.0
        build, away, turned = self.drawn.build, self.astray(), self.astray(turned=True)
        length = build.length("upper arm") + build.length("forearm")
        place = np.array([length, 0.0, 0.0]) + away
        roll = Pose.from_euler((0, 0, 0), (0, 0, side * math.pi / 2))
        self._pose = Pose.from_euler(place, 0.3 * turned) @ _TO_X @ roll
        where = self.limb.forward(angles)
        elbow, wrist = (np.array(where[s].position) for s in ("forearm", "hand"))
        self._joints = self._pose.apply(np.array([wrist, elbow, np.zeros(3)]))
        self._radii = [build.radius(n) for n in ("wrist", "forearm", "upper arm")]
        self._best = 0.0
        return angles

    def _add_limb(self, spec: mujoco.MjSpec, angles: dict[str, float]) -> None:
        super()._add_limb(spec, angles)
        spec.geom("cushion").pos[2] = -0.22
        middle = -(GAP + self._radii[1])
        for k in range(PARTS):
            a, b = (2 * math.pi * (k + j) / PARTS for j in (0, 1))
            ends = [(0.0, CUFF * math.cos(t), middle + CUFF * math.sin(t)) for t in (a, b)]
            spec.body("carriage").add_geom(
                type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=np.ravel(ends), size=(THREAD, 0, 0),
                contype=1, conaffinity=1, mass=0.002,
            )  # fmt: skip

    def start(self) -> None:
        wrist, elbow, _ = self._joints
        along = (elbow - wrist) / np.linalg.norm(elbow - wrist)
        x, y, z = wrist + 0.02 * along + 0.3 * self.astray()
        yaw = math.atan2(along[1], along[0])
        self.data.qpos[:] = x, y, z + self._radii[0] + GAP, yaw, 0.0

    def limb_pose(self, time: float) -> Pose:
        return self._pose

    def judge(self, action: Array, force: float) -> tuple[float, bool, dict[str, Any]]:
        place, axes = self.site_frame("pad")
        wrist, elbow, shoulder = self._joints
        lengths = [math.dist(elbow, wrist), math.dist(shoulder, elbow)]
        fore, upper = (elbow - wrist) / lengths[0], (shoulder - elbow) / lengths[1]
        gone = float((place - elbow) @ upper)
        if gone > 0:
            done, along, middle = lengths[0] + min(gone, lengths[1]), upper, elbow
        else:
            done = min(max(0.0, float((place - wrist) @ fore)), lengths[0])
            along, middle = fore, wrist
        radius = float(np.interp(done, [0.0, lengths[0], sum(lengths)], self._radii))
        error, angle = across(place, axes, middle, along, radius)
        progress = done / sum(lengths)
        success = progress > 0.9
        ahead = max(0.0, progress - self._best) if self.data.time > 0 else 0.0
        self._best = max(self._best, progress)
        reward = WAY * ahead - 0.1 * error / NEAR + DONE * success
        over = success or error > LOST or force > PAIN
        return reward, over, {
            "error": error, "angle": angle, "progress": progress, "success": success,
        }  # fmt: skip
