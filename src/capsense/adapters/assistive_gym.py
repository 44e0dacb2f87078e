"""Sensors in Assistive Gym's environments, on PyBullet: ``cs.assistive_gym.attach(env)``.

Written after Assistive Gym 1.0: ``env.id`` is the physics client, and ``env.robot``, ``env.human``,
``env.tool`` and others are agents, each with the number of its ``body``. The package itself is not
needed here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, Unpack

from capsense.adapters import AttachedSensor, make_simulator, pybullet, refuse_missing
from capsense.adapters.pybullet_bodies import BODY_NAME, LINK_NAME
from capsense.design.model import Design
from capsense.readout import Readout
from capsense.scene import DepthFrame, Pose, Scene
from capsense.simulator import DEFAULT_DESIGN, Simulator

__all__ = ["AssistiveGymSensor", "attach", "limbs"]

PERSON = 100e-12
"""What ties a person to ground unless said otherwise [F], as in the human body model of ESD
tests."""
_BASE = -1
_LIMBS = {
    "right_pecs": "right_shoulder", "right_shoulder": "right_upperarm",
    "right_elbow": "right_forearm", "right_wrist": "right_hand",
    "left_pecs": "left_shoulder", "left_shoulder": "left_upperarm",
    "left_elbow": "left_forearm", "left_wrist": "left_hand",
    "neck": "neck", "head": "head", "stomach": "waist", "waist": "hips",
    "right_hip": "right_thigh", "right_knee": "right_shin", "right_ankle": "right_foot",
    "left_hip": "left_thigh", "left_knee": "left_shin", "left_ankle": "left_foot",
}  # fmt: skip
"""Attribute of ``env.human``, the joint at a limb's upper end → the limb, as Assistive Gym's
``human_creation.py`` calls it. The joint's number is that of the limb's link."""


def attach(
    env: Any,
    agent: str = "robot",
    link: int | str | None = None,
    pose_in_link: Pose = Pose(),  # noqa: B008, it is immutable
    design: Design | str | Path | Simulator = DEFAULT_DESIGN,
    *,
    perception: Literal["geometry", "depth_camera"] = "geometry",
    readout: Readout | str | Path | None = None,
    **options: Unpack[pybullet.PybulletOptions],
) -> AssistiveGymSensor:
    """Attach a sensor to an agent of an environment that was reset; call ``read()`` after a step.

    It follows the environment through later resets, with their new people and furniture.

    Bodies are named ``robot``, ``human``, ``tool`` and so on, as the environment calls its agents,
    and the person's links as :func:`limbs` does, so that patterns such as
    ``{"right_forearm": "skin"}`` or ``{"human/left_*": "wet skin"}`` fit. Where none does, a
    person is of the material "human", and tied to ground by 100 pF as one body.

    Args:
        env: An environment, wrapped or not.
        agent: What carries the sensor: ``"robot"``, ``"tool"``, ``"human"``, …
        link: Its link, by index or name, or by the name of an attribute such as
            ``"right_end_effector"``, which holds the index; by default the joint of the robot
            that holds the tool, else the base.
        pose_in_link: The sensor frame in the link's frame (the URDF frame): origin at the centre
            of the electrode plane, z out of the sensor.
        design: A design, a packaged name, a design file, or a ready simulator, whose readout stays
            as it is.
        perception: As for :func:`capsense.adapters.pybullet.attach`.
        readout: A readout whose counts readings are to hold, a chip's name, or a file's; see
            :meth:`~capsense.adapters.AttachedSensor.read`. By default a copy of the simulator's, if
            it has one.
        options: As for :func:`capsense.adapters.pybullet.attach`: those of
            :class:`~capsense.adapters.pybullet.PybulletOptions`.

    Raises:
        TypeError: ``env`` is no environment of Assistive Gym.
        SceneError: The environment was not reset, has no such agent or link, or as for
            :func:`capsense.adapters.pybullet.attach`.
        DesignError: The design is wrong.
        ReadoutError: There is no such chip.
    """
    env = getattr(env, "unwrapped", env)
    if not hasattr(env, "agents") or not hasattr(env, "id"):
        raise TypeError(
            f"env is a {type(env).__name__}; give an environment of Assistive Gym 1.0 or later"
        )
    simulator = make_simulator(design)

    def attach_now() -> AttachedSensor:
        agents = _agents(env)
        if agent not in agents:
            raise refuse_missing("agent with a body", agent, list(agents))
        number = _link(env, agent, link)
        _name(env, agents)
        known = options.copy()
        if "human" in agents:
            known["materials"] = _and_person(options.get("materials"), "human")
            if perception == "geometry":
                known["grounding"] = _and_person(options.get("grounding"), PERSON)
        return pybullet.attach(
            env.id, agents[agent], number, pose_in_link, simulator, perception=perception, **known
        )

    sensor = AssistiveGymSensor(env, simulator, attach_now)
    sensor.use_readout(sensor.readout if readout is None else readout)
    return sensor


def limbs(env: Any) -> dict[str, int]:
    """The limbs of an environment's person, and their links.

    Returns:
        ``{"chest": -1, "right_shoulder": 2, "right_upperarm": 5, "right_forearm": 7, …}``; empty
        for a person who is one mesh.

    Raises:
        SceneError: There is no person.
    """
    import pybullet as p

    env = getattr(env, "unwrapped", env)
    agents = _agents(env)
    if "human" not in agents:
        raise refuse_missing("agent with a body", "human", list(agents))
    if p.getNumJoints(agents["human"], physicsClientId=env.id) == 0:
        return {}  # of a mesh, the attributes number vertices
    return {"chest": _BASE, **{limb: int(getattr(env.human, a)) for a, limb in _LIMBS.items()}}


class AssistiveGymSensor(AttachedSensor):
    """A sensor in an environment of Assistive Gym; made by :func:`attach`."""

    def __init__(
        self, env: Any, simulator: Simulator, attach_now: Callable[[], AttachedSensor]
    ) -> None:
        super().__init__(simulator)
        self.env = env
        """The environment, unwrapped."""
        self._attach_now = attach_now
        self._inner = attach_now()
        self._episode = env.agents

    @property
    def client(self) -> int:
        """Number of the physics client, which a reset may change."""
        return int(self.env.id)

    def _time(self) -> float:
        """Time since the reset [s]: Assistive Gym counts whole steps of the environment."""
        env = self.env
        return float(env.iteration * env.frame_skip * env.time_step)

    def view(self) -> Scene | DepthFrame:
        return self._now().view()

    def scene(self) -> Scene:
        return self._now().scene()

    @property
    def pose(self) -> Pose:
        return self._now().pose

    def _now(self) -> AttachedSensor:
        """The sensor in PyBullet, attached again if the environment was reset meanwhile."""
        if self._episode is not self.env.agents:  # every reset makes a new list
            self._inner = self._attach_now()
            self._episode = self.env.agents
            self.reset()
        return self._inner


def _agents(env: Any) -> dict[str, int]:
    """Name → body of the agents that an environment holds at present."""
    held = {name: getattr(value, "body", None) for name, value in vars(env).items()}
    return {n: b for n, b in held.items() if isinstance(b, int) and not isinstance(b, bool)}


def _link(env: Any, agent: str, link: int | str | None) -> int | str:
    """What names a link for PyBullet."""
    holder = getattr(env, agent)
    if link is None:
        if agent != "robot":
            return _BASE
        tool = getattr(env, "tool", None)
        link = "right_tool_joint" if getattr(tool, "right", True) else "left_tool_joint"
    number = getattr(holder, link, None) if isinstance(link, str) else link
    return number if isinstance(number, int) else str(link)


def _and_person(given: Any, value: Any) -> Any:
    """Rules, and one for the person behind them; what is no mapping is left to be refused."""
    if given is not None and not isinstance(given, Mapping):
        return given
    rules = dict(given or {})
    rules.setdefault("human", value)
    return rules


def _name(env: Any, agents: Mapping[str, int]) -> None:
    """Name the bodies of all agents, and every link of the person by the limb it belongs to."""
    import pybullet as p

    for name, body in agents.items():
        p.addUserData(body, BODY_NAME, name, physicsClientId=env.id)
    if "human" not in agents:
        return
    ends = sorted((number, limb) for limb, number in limbs(env).items())
    first = 0
    for end, limb in ends:  # a joint of several axes is a chain of links that ends in the limb's
        for number in range(min(first, end), end + 1):
            p.addUserData(agents["human"], LINK_NAME, limb, number, physicsClientId=env.id)
        first = end + 1
