"""A person's arm or leg in MuJoCo, and a board of six electrodes that is carried along it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

import capsense as cs
from capsense.humans import Limb, arm, leg
from capsense.learning.envs import LOST
from capsense.learning.envs.base import CONTROL, CapacitiveEnv, Randomisation
from capsense.learning.envs.signals import UNIT
from capsense.learning.labels import limb_pose
from capsense.learning.servo import LimbPose, follow

Array = NDArray[np.float64]
Which = Literal["arm", "leg"]

GAPS, SPEED, WAY = (0.05, 0.03, 0.08), 0.05, 0.40
"""Set distances [m], speed along the limb [m/s], and how far the board is to come [m]."""
SETTLING = 1.0
"""Errors count from this time on [s]; from then on the board goes along the limb."""
FIRST = 0.03
"""The ride begins so far above the wrist or ankle [m]."""
SMOOTHING = 0.1
"""Time constant of the low-pass filter that all estimators read the chip through [s]."""
CLOSE = 0.02
"""A ride has succeeded if no error of place was larger than this [m], and nothing was touched."""
SEGMENTS = {"arm": ("forearm", "upper_arm", "elbow_flexion"),
            "leg": ("shank", "thigh", "knee_flexion")}  # fmt: skip
_TO_X = cs.Pose.from_euler((0, 0, 0), (0, math.pi / 2, 0))


class Estimator(Protocol):
    """What tells the limb's pose."""

    def estimate(self, measured: Array) -> LimbPose: ...


class LimbRide(CapacitiveEnv):
    """Six electrodes on a carriage over an arm or a leg, bent sideways a little, that sways."""

    model_file = "carriage.xml"
    sites = ("pad",)
    own_design = "six_patch"
    speeds = (0.2, 0.2, 0.2, 1.0, 1.0)

    def __init__(self, which: Which, gap: float, randomisation: Randomisation) -> None:
        self.which, self.gap = which, gap
        self.lower, self.upper, self.joint = SEGMENTS[which]
        self.parts = (self.upper, self.lower, "hand" if which == "arm" else "foot")
        super().__init__(randomisation, preset="standard")

    def make_limb(self) -> Limb:
        return (arm if self.which == "arm" else leg)(self.drawn.build)

    def begin(self) -> dict[str, float]:
        self._phase = [self.between(0, 2 * math.pi) for _ in range(4)]
        self._pace = [2 * math.pi * self.between(0.05, 0.2) for _ in range(4)]
        self._sway = [self.between(0.4 * top, top) for top in (0.04, 0.02, 0.15, 0.08)]
        angles = {self.joint: self.between(0.0, 0.3)}
        self.length = self.drawn.build.length(self.lower)
        side = 1.0 if self.between(-1.0, 1.0) > 0 else -1.0
        roll = cs.Pose.from_euler((0, 0, 0), (0, 0, side * math.pi / 2))
        middle = self.limb.forward(angles)[self.lower] @ cs.Pose((0, 0, -0.5 * self.length))
        self._root = _TO_X @ roll @ middle.inverse()
        return angles

    def _add_limb(self, spec: Any, angles: dict[str, float]) -> None:
        super()._add_limb(spec, angles)
        spec.geom("cushion").pos[2] = -0.25

    def start(self) -> None:
        build, end = self.drawn.build, FIRST - 0.5 * self.length
        radius = build.radius("wrist" if self.which == "arm" else "ankle")
        middle = self._sways(0.0).apply((end, 0.0, 0.0))
        yaw, pitch, _ = self.astray(turned=True)
        x, y, z = middle + self.astray() * (0.0, 1.0, 0.5)
        self.data.qpos[:] = x, y, z + radius + self.gap, yaw, pitch

    def _sways(self, time: float) -> cs.Pose:
        y, z, yaw, pitch = (
            a * math.sin(p + w * time)
            for a, p, w in zip(self._sway, self._phase, self._pace, strict=True)
        )
        return cs.Pose.from_euler((0.0, y, z), (0.0, pitch, yaw))

    def limb_pose(self, time: float) -> cs.Pose:
        return self._sways(time) @ self._root

    def judge(self, action: Array, force: float) -> tuple[float, bool, dict[str, Any]]:
        """No reward; facts: the limb's ``pose`` before the sensor, ``way`` made along it [m]."""
        names = (f"_{self.lower}_", f"_{self.upper}_")
        seen = [b for b in self.skin.sensors["pad"].scene()
                if any(n in str(b.name) for n in names)]  # fmt: skip
        place = self.site_frame("pad")[0]
        way = self._sways(self.data.time).inverse().apply(place)[0] + 0.5 * self.length - FIRST
        try:
            pose = limb_pose(seen)
        except cs.SceneError:
            return 0.0, True, {"pose": None, "way": way}
        lost = math.hypot(pose.lateral, pose.vertical - self.gap) > LOST
        return 0.0, lost, {"pose": pose, "way": way}

    def carriage(self, motion: Array) -> Array:
        """The action that moves the sensor at velocities in its own frame, shape (6,)."""
        _, axes = self.site_frame("pad")
        turn = axes @ motion[3:]
        return np.array([*(axes @ motion[:3]), turn[2], -turn @ axes[:, 1]]) / self.speeds


@dataclass
class Ride:
    """How one ride went."""

    estimated: list[Array] = field(default_factory=list)
    """Estimate less truth at each action: lateral, vertical [m], pitch, yaw [rad]."""
    kept: list[Array] = field(default_factory=list)
    """Truth less what it should be, the same."""
    force: float = 0.0
    """Largest force of contacts [N]."""
    way: float = 0.0
    """How far it came along the limb [m]."""
    lost: bool = False

    @property
    def success(self) -> bool:
        """Whether it came along, close to its place and without touching anything."""
        off = np.abs(self.kept)[:, :2].max() if self.kept else np.inf
        return bool(not self.lost and off < CLOSE and not self.force and self.way > 0.9 * WAY)


def ride(env: LimbRide, estimator: Estimator | None, seed: int) -> Ride:
    """One ride by an estimator, or by the true pose."""
    observation, facts = env.reset(seed=seed)
    out, felt, blend = Ride(), observation[:6] * UNIT, CONTROL / (SMOOTHING + CONTROL)
    while env.data.time < SETTLING + WAY / SPEED and not out.lost:
        true: LimbPose = facts["pose"]
        felt = felt + blend * (observation[:6] * UNIT - felt)
        found = true if estimator is None else estimator.estimate(felt)
        late = env.data.time > SETTLING
        if late:
            out.estimated.append(np.subtract(found, true))
            out.kept.append(np.subtract(true, (0.0, env.gap, 0.0, 0.0)))
        action = env.carriage(follow(found, env.gap, SPEED if late else 0.0))
        observation, _, out.lost, _, facts = env.step(action.astype(np.float32))
        out.force = max(out.force, facts["force"])
    out.way = facts["way"]
    return out
