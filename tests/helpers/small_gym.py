"""A minimal environment of Assistive Gym's API, on PyBullet.

Attributes, numbers of links and what a reset does are those of Assistive Gym 1.0
(Healthcare-Robotics/assistive-gym: ``envs/env.py``, ``envs/agents/*.py``,
``envs/human_creation.py``); the person is of capsules of other sizes, and stands still.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pybullet as p

import capsense as cs

ARM, LEG = 0.28, 0.4
_CAPSULES = {
    # link: radius [m], length [m], middle in the link's frame [m]
    2: (0.10, 0.03, (-0.09, 0, 0)), 5: (0.043, ARM, (0, 0, -ARM / 2)),
    7: (0.033, 0.25, (0, 0, -0.125)), 9: (0.043, 0.01, (0, 0, -0.043)),
    12: (0.10, 0.03, (0.09, 0, 0)), 15: (0.043, ARM, (0, 0, -ARM / 2)),
    17: (0.033, 0.25, (0, 0, -0.125)), 19: (0.043, 0.01, (0, 0, -0.043)),
    20: (0.06, 0.12, (0, 0, 0.09)), 23: (0.10, 0.05, (0, 0, 0.1)), 24: (0.12, 0.05, (0, 0, 0)),
    27: (0.13, 0.1, (0, 0, -0.08)), 30: (0.08, LEG, (0, 0, -LEG / 2)),
    31: (0.05, LEG, (0, 0, -LEG / 2)), 34: (0.05, 0.2, (0, 0, -0.05)),
    37: (0.08, LEG, (0, 0, -LEG / 2)), 38: (0.05, LEG, (0, 0, -LEG / 2)),
    41: (0.05, 0.2, (0, 0, -0.05)),
}  # fmt: skip
_PARENTS = {0: -1, 3: 2, 10: -1, 13: 12, 20: -1, 24: -1, 28: 27, 35: 27}
"""Link → parent where that is not the link before; chains of axes follow one another."""
_ORIGINS = {
    0: (0, 0, 0.07), 3: (-0.18, 0, 0), 6: (0, 0, -ARM), 8: (0, 0, -0.29),
    10: (0, 0, 0.07), 13: (0.18, 0, 0), 16: (0, 0, -ARM), 18: (0, 0, -0.29),
    20: (0, 0, 0.15), 21: (0, 0, 0.14), 24: (0, 0, -0.16), 25: (0, 0, -0.08),
    28: (-0.09, 0, -0.08), 31: (0, 0, -LEG), 32: (0, 0, -LEG),
    35: (0.09, 0, -0.08), 38: (0, 0, -LEG), 39: (0, 0, -LEG),
}  # fmt: skip


class Agent:
    """What every body in an environment is."""

    def __init__(self) -> None:
        self.base = -1
        self.body: int | None = None

    def init(self, body: int | None, client: int) -> None:
        """Take over a body that was made."""
        self.body, self.id = body, client

    def get_pos_orient(self, link: int) -> tuple[Any, Any]:
        """Position [m] and quaternion of a link's frame; the base's is its centre of mass."""
        if link == self.base:
            return p.getBasePositionAndOrientation(self.body, physicsClientId=self.id)
        state = p.getLinkState(self.body, link, computeForwardKinematics=True,
                               physicsClientId=self.id)  # fmt: skip
        return state[4:6]


class Robot(Agent):
    """A mast with an arm of one joint and a flange on either side."""

    def __init__(self) -> None:
        super().__init__()
        self.right_tool_joint, self.left_tool_joint = 1, 3
        self.right_end_effector, self.left_end_effector = 1, 3


class Human(Agent):
    """A person of 42 links."""

    def __init__(self) -> None:
        super().__init__()
        self.right_pecs, self.right_shoulder, self.right_elbow, self.right_wrist = 2, 5, 7, 9
        self.left_pecs, self.left_shoulder, self.left_elbow, self.left_wrist = 12, 15, 17, 19
        self.neck, self.head, self.stomach, self.waist = 20, 23, 24, 27
        self.right_hip, self.right_knee, self.right_ankle = 30, 31, 34
        self.left_hip, self.left_knee, self.left_ankle = 37, 38, 41
        self.j_right_shoulder_x, self.j_right_elbow = 3, 6


class Tool(Agent):
    """A rod in the robot's right or left hand."""

    def __init__(self, right: bool) -> None:
        super().__init__()
        self.right = right


class Env:
    """A robot before a person.

    Args:
        person: Whether there is one.
        right: The hand that holds the tool.
    """

    def __init__(self, person: bool = True, right: bool = True) -> None:
        self.time_step, self.frame_skip, self.task = 0.02, 5, "bed_bathing"
        self.id = p.connect(p.DIRECT)
        self.agents: list[Agent] = []
        self.plane, self.furniture = Agent(), Agent()
        self.robot, self.tool = Robot(), Tool(right)
        self.human = Human() if person else None
        self.scale = 1.0
        """Of the person's radii, which differ from one reset to the next."""

    def reset(self) -> None:
        """A new world, in a new client."""
        p.resetSimulation(physicsClientId=self.id)
        p.disconnect(self.id)
        self.id = p.connect(p.DIRECT)
        p.setTimeStep(self.time_step, physicsClientId=self.id)
        self.agents = []
        self.iteration = 0
        self.plane.init(self._single(p.GEOM_PLANE, (0, 0, 0)), self.id)
        self.robot.init(self._robot(), self.id)
        self.agents.append(self.robot)
        if self.human is not None:
            self.human.init(_person(self.id, self.scale), self.id)
        self.furniture.init(
            self._single(p.GEOM_BOX, (0, 0.6, 0.3), halfExtents=[0.4, 0.1, 0.3]), self.id
        )
        hand = self.robot.right_tool_joint if self.tool.right else self.robot.left_tool_joint
        place = cs.Pose(*self.robot.get_pos_orient(hand)) @ cs.Pose((0, 0, 0.3))
        self.tool.init(
            self._single(p.GEOM_CYLINDER, place.position, radius=0.01, height=0.1), self.id
        )

    def take_step(self) -> None:
        """One step of the environment: some of the simulation, nobody driven."""
        self.iteration += 1
        for _ in range(self.frame_skip):
            p.stepSimulation(physicsClientId=self.id)

    def _single(self, kind: int, position: Any, **sizes: Any) -> int:
        shape = p.createCollisionShape(kind, physicsClientId=self.id, **sizes)
        return p.createMultiBody(0, shape, basePosition=position, physicsClientId=self.id)

    def _robot(self) -> int:
        """Its flanges stand to the sides, at a person's forearms, their z towards the person."""
        shape = p.createCollisionShape(
            p.GEOM_BOX, halfExtents=[0.06, 0.045, 0.005], physicsClientId=self.id
        )
        to_person = p.getQuaternionFromEuler((-np.pi / 2, 0, 0))
        return p.createMultiBody(
            0, -1, basePosition=(0, -0.12, 0.9), physicsClientId=self.id,
            **_links([-1, shape, -1, shape],
                     [(-0.18, 0, 0), (0, 0, 0), (0.18, 0, 0), (0, 0, 0)],
                     [0, 1, 0, 3], [p.JOINT_FIXED] * 4, to_person),
        )  # fmt: skip


def _person(client: int, scale: float) -> int:
    """Its chest stands 1.2 m above the ground."""
    shapes, origins, parents = [], [], []
    for link in range(42):
        radius, length, middle = _CAPSULES.get(link, (0.0, 0.0, (0, 0, 0)))
        shapes.append(-1 if not radius else p.createCollisionShape(
            p.GEOM_CAPSULE, radius=radius * scale, height=length, collisionFramePosition=middle,
            physicsClientId=client,
        ))  # fmt: skip
        origins.append(_ORIGINS.get(link, (0, 0, 0)))
        parents.append(_PARENTS.get(link, link - 1) + 1)
    chest = p.createCollisionShape(
        p.GEOM_CAPSULE, radius=0.12 * scale, height=0.05, physicsClientId=client
    )
    return p.createMultiBody(
        0, chest, basePosition=(0, 0, 1.2), physicsClientId=client,
        **_links(shapes, origins, parents, [p.JOINT_REVOLUTE] * 42, (0, 0, 0, 1)),
    )  # fmt: skip


def _links(shapes: list[int], origins: Any, parents: list[int], kinds: Any, first: Any) -> Any:
    """Arguments of ``createMultiBody``; links of the base are turned as ``first`` says."""
    n = len(shapes)
    upright = (0, 0, 0, 1)
    return {
        "linkMasses": [0] * n,
        "linkCollisionShapeIndices": shapes,
        "linkVisualShapeIndices": [-1] * n,
        "linkPositions": origins,
        "linkOrientations": [upright if parent else first for parent in parents],
        "linkInertialFramePositions": [(0, 0, 0)] * n,
        "linkInertialFrameOrientations": [upright] * n,
        "linkParentIndices": parents,
        "linkJointTypes": list(kinds),
        "linkJointAxis": [(1, 0, 0)] * n,
    }
