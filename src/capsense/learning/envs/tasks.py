"""Three tasks: follow a limb, take a sleeve along an arm, and keep off a person."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from capsense.learning.envs.base import CapacitiveEnv
from capsense.learning.envs.picture import Camera
from capsense.scene import Pose

Array = NDArray[np.float64]

GAP = 0.05
"""How far over the skin the pad is to be [m]."""
NEAR, TURN = 0.05, math.radians(20.0)
"""Errors [m], [rad] that each lower the reward of LimbFollow to 1/e."""
LOST = 0.15
"""Episodes with the pad end where it is further away than this from where it should be [m]."""
CLEAR = 0.02
"""The pad begins no nearer to the arm than this [m]: it is raised where it would."""
_RAISES = 3
"""So often, as the nearest points of both move meanwhile."""
EFFORT = 0.01
"""What the square of an action costs in LimbFollow."""
CUFF, THREAD, PARTS = 0.10, 0.004, 16
"""Radius of the sleeve's cuff, and of the ring that stands for it [m]; pieces of that."""
WAY, DONE = 20.0, 5.0
"""What the whole way is worth, along the arm or round to the goal, and its end."""
START, GOAL, THERE = math.radians(65.0), math.radians(-35.0), math.radians(3.0)
"""Where the robot's arm turns from and to, and how near to that is near enough [rad]."""
POSTURE = (math.radians(35.0), math.radians(55.0))
"""Its shoulder and elbow at the start [rad]: the forearm is level."""
HEIGHT = 0.30
"""Of its forearm and of the person's arm, about [m]."""
REACH, BACK = 0.38, 0.90
"""How far from the robot's axis the person's fingers are, out and drawn back [m]."""
SAFE, CLOSE = 0.05, 0.5
"""Gaps below this cost reward [m], a step in touch so much."""
SQUEEZED, STRUCK = 40.0, 50.0
"""Contact forces that end an episode of Dressing, and of ApproachStop [N]."""
_TO_X = Pose.from_euler((0, 0, 0), (0, math.pi / 2, 0))


class _PadEnv(CapacitiveEnv):
    """Six electrodes on a pad that is moved and turned; what it is to keep to is a limb."""

    model_file = "carriage.xml"
    sites = ("pad",)
    own_design = "six_patch"
    speeds = (0.2, 0.2, 0.2, 1.0, 1.0)


class LimbFollow(_PadEnv):
    """Six electrodes over a forearm that sways: stay 5 cm over it, in its middle and along it.

    Actions: velocities along x, y, z [0.2 m/s] and about z, y [1 rad/s] of the pad. Reward:
    ``exp(-(e/5 cm)² - (θ/20°)²) - 0.01 |a|² - 0.02 F``, of the error e of its place across the
    arm, the angle θ from its direction, the action a and the contact force F [N]. The episode ends
    early where the pad is 15 cm astray. Facts: ``error`` [m], ``angle`` [rad].
    """

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


class Dressing(_PadEnv):
    """Six electrodes over the cuff of a sleeve, which goes from the hand to the shoulder.

    The cuff hangs from the pad, 10 cm in radius, around the arm, and collides with it; it is of
    cloth, which the sensor does not feel. The elbow is bent to one side. Actions: as those of
    LimbFollow. Reward: 20 for the whole way along the arm, in proportion, less ``0.1 e / 5 cm`` at
    every step, of the error e of the pad's place across the arm from 5 cm over the skin, less
    0.02 F; and 5 at the shoulder. The episode ends there, 15 cm astray, or at 40 N. Facts:
    ``error`` [m], ``angle`` [rad], ``progress`` from 0 to 1, ``success``.
    """

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
        over = success or error > LOST or force > SQUEEZED
        return reward, over, {
            "error": error, "angle": angle, "progress": progress, "success": success,
        }  # fmt: skip


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
    camera = Camera((1.3, -1.2, 1.0), (0.35, 0.0, 0.2))

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
        return reward, success or force > STRUCK, {"gap": gap, "left": left, "success": success}

    def also(self) -> Array:
        return np.array([self._left])


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
