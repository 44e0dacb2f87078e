"""``capsense/ApproachStop-v0``: a skin-covered arm goes its way, and keeps off a person."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capsense.learning.envs.base import CapacitiveEnv
from capsense.scene import Pose

Array = NDArray[np.float64]

START, GOAL, THERE = math.radians(65.0), math.radians(-35.0), math.radians(3.0)
"""Where the arm turns from and to, and how near to that is near enough [rad]."""
POSTURE = (math.radians(35.0), math.radians(55.0))
"""Shoulder and elbow at the start [rad]: the forearm is level."""
HEIGHT = 0.30
"""Of the forearm and of the person's arm, about [m]."""
REACH, BACK = 0.38, 0.90
"""How far from the robot's axis the person's fingers are, out and drawn back [m]."""
SAFE = 0.05
"""Gaps below this cost reward [m]."""
WAY, DONE, CLOSE = 20.0, 5.0, 0.5
"""What the whole way is worth, its end, and a step in touch."""
PAIN = 50.0
"""Contact force that ends the episode [N]."""


class ApproachStop(CapacitiveEnv):
    """A robot turns from one side to the other; a person reaches into its way for a while.

    Eight curved sensors cover the forearm. Actions: velocities of turn, shoulder and elbow [0.6,
    0.3, 0.3 rad/s]. Observations end with the angle that is left [rad]. Reward: 20 for the whole
    turn, in proportion, negative for turning back; less 0.5 a step in touch, and in proportion
    below a gap of 5 cm; less 0.02 F; and 5 at the goal. The episode ends there, or at 50 N. Facts:
    ``gap`` [m], up to 0.5, ``left`` [rad], ``success``.
    """

    model_file = "robot.xml"
    sites = tuple(f"fore_{ring}_{side}" for ring in (1, 2) for side in (0, 90, 180, 270))
    own_design = "arm_segment"
    speeds = (0.6, 0.3, 0.3)
    parts = ("upper_arm", "forearm", "hand")
    extra = ("left",)

    def begin(self) -> dict[str, float]:
        build = self.drawn.build
        self._length = sum(build.length(n) for n in ("upper arm", "forearm", "hand"))
        self._side = self.between(-0.25, 0.4)
        self._times = np.cumsum([self.between(0.2, 1.2), 0.8, self.between(3.0, 5.0), 0.8])
        self._off, (_, self._rise, self._roll) = self.astray(), self.astray(turned=True)
        return {}

    def start(self) -> None:
        self.data.qpos[:] = START, *POSTURE
        self._left = START - GOAL

    def limb_pose(self, time: float) -> Pose:
        out = float(np.interp(time, self._times, (0.0, 1.0, 1.0, 0.0)))
        tip = BACK + (REACH - BACK) * (0.5 - 0.5 * math.cos(math.pi * out))
        x, y, z = self._off
        line = Pose.from_euler((0.0, 0.0, HEIGHT + z), (0.0, 0.0, self._side))
        turned = Pose.from_euler((tip + x, y, 0.0), (self._roll, 0.3 * self._rise, 0.0))
        hang = Pose.from_euler((self._length, 0.0, 0.0), (0.0, math.pi / 2, 0.0))
        return line @ turned @ hang

    def judge(self, action: Array, force: float) -> tuple[float, bool, dict[str, Any]]:
        left, gap = float(self.data.qpos[0]) - GOAL, self.clearance()
        success = abs(left) < THERE
        reward = WAY * (abs(self._left) - abs(left)) / (START - GOAL) + DONE * success
        reward -= CLOSE * min(1.0, max(0.0, 1.0 - gap / SAFE))
        self._left = left
        return reward, success or force > PAIN, {"gap": gap, "left": left, "success": success}

    def also(self) -> Array:
        return np.array([self._left])
