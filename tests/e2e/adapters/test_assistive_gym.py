"""Assistive Gym: environments of its API, with a robot, a person, a tool and furniture."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from approximate import approx

import capsense as cs

p = pytest.importorskip("pybullet", reason="PyBullet is not installed")
from small_gym import Agent, Env  # noqa: E402

NEAR = cs.Pose((0, 0, 0.05))
"""In front of the flange, so that the person's forearm lies in the small sensor's domain."""
BESIDE = ["right_upperarm", "hips", "right_thigh"]
"""What reaches into that domain, too."""


@pytest.fixture
def env() -> Iterator[Env]:
    """A robot before a person."""
    made = Env()
    made.reset()
    yield made
    p.disconnect(made.id)


def names(scene: cs.Scene) -> set[str]:
    """What a scene shows."""
    return {str(body.name) for body in scene}


def forearm(env: Env, sensor: Any, radius: float) -> cs.Body:
    """The right forearm in the sensor frame, by what the environment says of its link."""
    link = cs.Pose(*env.human.get_pos_orient(env.human.right_elbow))
    return cs.Body(
        cs.Capsule(radius, 0.25), sensor.pose.inverse() @ link @ cs.Pose((0, 0, -0.125)),
        "human", 100e-12,
    )  # fmt: skip


def test_a_forearm_reads_as_its_shape_does(env: Env, tiny_simulator: cs.Simulator) -> None:
    """Differential: the limb alone is in reach, the rest of the person has no charge there; in a
    person's material, on a person's capacity."""
    sensor = cs.assistive_gym.attach(env, pose_in_link=NEAR, design=tiny_simulator, exclude=BESIDE)
    assert all(name.startswith("human/") for name in names(sensor.scene()))
    assert "human/right_forearm" in names(sensor.scene())
    reading = sensor.read()
    tiny_simulator.reset()
    expected = tiny_simulator.step(cs.Scene([forearm(env, sensor, 0.033)])).delta
    assert reading.delta == approx(expected, rel=1e-4)
    flange = cs.Pose(*env.robot.get_pos_orient(env.robot.right_tool_joint))
    assert sensor.pose.position == approx((flange @ NEAR).position, abs=1e-6)


def test_it_follows_resets(env: Env, tiny_simulator: cs.Simulator) -> None:
    """Differential: another person in another client, and a readout that starts anew. The waist of
    the large one comes in at a corner of the domain: 0.13 %."""
    sensor = cs.assistive_gym.attach(
        env, pose_in_link=NEAR, design=tiny_simulator, readout="fdc1004", exclude=BESIDE
    )
    for radius in (0.033, 0.044, 0.033):
        env.scale = radius / 0.033
        env.reset()
        assert sensor.time == 0.0
        counts = 0
        for k in range(1, 4):
            env.take_step()
            assert sensor.time == approx(0.1 * k)
            reading = sensor.read()
            counts += len(reading.counts.time)
        assert counts > 0
        tiny_simulator.reset()
        expected = tiny_simulator.step(cs.Scene([forearm(env, sensor, radius)])).delta
        assert reading.delta == approx(expected, rel=2e-3)


def test_every_link_of_the_person_has_its_limb(env: Env, tiny_simulator: cs.Simulator) -> None:
    """As in the legend of Assistive Gym; the axes of a joint belong to the limb below it."""
    found = cs.assistive_gym.limbs(env)
    assert len(found) == 19
    assert {k: found[k] for k in ("chest", "right_upperarm", "left_hand", "hips")} == {
        "chest": -1, "right_upperarm": 5, "left_hand": 19, "hips": 27,
    }  # fmt: skip
    cs.assistive_gym.attach(env, design=tiny_simulator)

    def limb(link: int) -> str:
        number = p.getUserDataId(env.human.body, "capsense.link", link, physicsClientId=env.id)
        return p.getUserData(number, physicsClientId=env.id).decode()

    for limb_name, links in {
        "chest": [-1], "right_shoulder": [0, 1, 2], "right_upperarm": [3, 4, 5],
        "right_forearm": [6, 7], "right_hand": [8, 9], "left_shoulder": [10, 11, 12],
        "neck": [20], "head": [21, 22, 23], "waist": [24], "hips": [25, 26, 27],
        "right_shin": [31], "left_foot": [39, 40, 41],
    }.items():  # fmt: skip
        assert {limb(link) for link in links} == {limb_name}


def test_materials_and_grounding_by_limb(env: Env) -> None:
    """Patterns fit limbs, agents, and links of URDF; the person's own defaults come last."""
    sensor = cs.assistive_gym.attach(
        env, materials={"right_forearm": "skin", "human/*_hand": "wet skin", "furniture": "glass"},
        grounding={"right_forearm": "grounded"}, exclude=["tool", "*_upperarm"],
    )  # fmt: skip
    bodies = {str(body.name): body for body in sensor.scene()}
    assert "human/right_upperarm" not in bodies
    assert not any(name.startswith("tool") for name in bodies)
    assert bodies["human/right_forearm"].material.name == "skin"
    assert bodies["human/right_forearm"].grounding == "grounded"
    assert bodies["human/right_hand"].material.name == "wet skin"
    assert bodies["human/chest"].material.name == "human"
    others = [b.grounding for b in bodies.values() if b.grounding != "grounded"]
    assert set(others) == {100e-12}
    assert len({b.conductor for b in bodies.values() if b.grounding != "grounded"}) == 1
    owned = cs.assistive_gym.attach(env, materials={"human": "skin"}, grounding={"human": 5e-12})
    person = [body for body in owned.scene() if str(body.name).startswith("human/")]
    assert {body.material.name for body in person} == {"skin"}
    assert {body.grounding for body in person} == {5e-12}
    assert len({body.conductor for body in person}) == 1
    with pytest.raises(cs.SceneError, match="nothing is named 'right_forarm'; did you mean"):
        cs.assistive_gym.attach(env, materials={"right_forarm": "skin"})


def test_where_it_can_be_attached(tiny_simulator: cs.Simulator) -> None:
    """To the hand that holds the tool, to the tool, to the person, through a wrapper."""
    env = Env(right=False)
    env.reset()

    class Wrapped:
        unwrapped = env

    for arguments, holder, link in (
        ((), env.robot, 3),
        (("robot", "right_end_effector"), env.robot, 1),
        (("robot", 1), env.robot, 1),
        (("human", "right_wrist"), env.human, 9),
        (("human", "right_forearm"), env.human, 7),
        (("tool",), env.tool, -1),
    ):
        sensor = cs.assistive_gym.attach(Wrapped(), *arguments, design=tiny_simulator)
        expected = holder.get_pos_orient(link)
        assert sensor.pose.position == approx(expected[0], abs=1e-6), arguments
    with pytest.raises(cs.SceneError, match="no link named 'right_wrists'; did you mean"):
        cs.assistive_gym.attach(env, "human", "right_wrists")
    with pytest.raises(cs.SceneError, match="no agent with a body named 'tools'; did you mean"):
        cs.assistive_gym.attach(env, "tools")
    p.disconnect(env.id)


def test_what_is_no_environment_is_refused() -> None:
    """One that was not reset, one of an older version, one without a person."""
    env = Env(person=False)
    with pytest.raises(cs.SceneError, match="no agent with a body named 'robot'"):
        cs.assistive_gym.attach(env)
    env.reset()
    with pytest.raises(cs.SceneError, match="no agent with a body named 'human'"):
        cs.assistive_gym.limbs(env)
    (seen,) = names(cs.assistive_gym.attach(env).scene())
    assert seen.startswith("tool/")
    p.disconnect(env.id)
    with pytest.raises(TypeError, match=r"env is a int; .* Assistive Gym 1\.0 or later"):
        cs.assistive_gym.attach(3)


def test_a_person_of_one_mesh_has_no_limbs(env: Env, tiny_simulator: cs.Simulator) -> None:
    """Its attributes number vertices; it is the person as a whole."""
    shape = p.createCollisionShape(p.GEOM_SPHERE, radius=0.05, physicsClientId=env.id)
    place = cs.Pose(*env.robot.get_pos_orient(1)) @ cs.Pose((0, 0, 0.12))
    env.human = Agent()
    env.human.right_pecs = 14
    env.human.init(
        p.createMultiBody(0, shape, basePosition=place.position, physicsClientId=env.id), env.id
    )
    assert cs.assistive_gym.limbs(env) == {}
    sensor = cs.assistive_gym.attach(env, pose_in_link=NEAR, design=tiny_simulator)
    (seen,) = [body for body in sensor.scene() if str(body.name).startswith("human/")]
    assert seen.material.name == "human"


def test_by_depth_camera(env: Env, tiny_simulator: cs.Simulator) -> None:
    """What is drawn, in the person's material; groundings by name are for shapes alone."""
    sensor = cs.assistive_gym.attach(
        env,
        pose_in_link=NEAR,
        design=tiny_simulator,
        perception="depth_camera",
        materials={"human": "glass"},
    )
    frame = sensor.view()
    assert isinstance(frame, cs.DepthFrame)
    assert set(np.unique(frame.permittivity)) == {0.0, 5.0}
    assert sensor.read().delta[0, 0] > 0
    with pytest.raises(cs.SceneError, match='grounding goes with perception="geometry"'):
        cs.assistive_gym.attach(env, perception="depth_camera", grounding={"human": "floating"})
