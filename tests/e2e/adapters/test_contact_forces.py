"""Contact forces of simulators, which press bodies onto the cover of a sensor."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from approximate import approx

import capsense as cs
from capsense.adapters.contacts import Contact, pressed
from capsense.errors import SceneError

RADIUS, MASS, GRAVITY, TOP = 0.01, 0.05, 9.81, 0.002
RISE = 0.3
"""Height of the sensor frame in the world [m]."""


@pytest.fixture
def simulator(foam: tuple[cs.Design, Any]) -> cs.Simulator:
    return cs.Simulator(foam[0], preset="fast", background=foam[1])


class MujocoBall:
    """A ball on the foam of a pad whose box ends at the foam's face."""

    def __init__(self, simulator: cs.Simulator, **options: Any) -> None:
        import mujoco

        self._mj = mujoco
        x, low = -0.012, TOP - 0.02
        self.model = mujoco.MjModel.from_xml_string(
            f'<mujoco><option timestep="0.001" gravity="0 0 -{GRAVITY}"/><worldbody>'
            f'<body name="pad" pos="0 0 {RISE}"><geom type="box" size=".025 .015 .01" '
            f'pos="0 0 {low + 0.01}"/><site name="pad"/></body>'
            f'<body name="ball" pos="{x} 0 {RISE + TOP + RADIUS + 0.0002}"><freejoint/>'
            f'<geom name="ball" type="sphere" size="{RADIUS}" mass="{MASS}" margin="0.001" '
            'condim="6" friction="1 .1 .1"/></body></worldbody></mujoco>'
        )
        self.data = mujoco.MjData(self.model)
        self.sensor = cs.mujoco.attach(self.model, self.data, "pad", simulator, **options)

    def rest(self, push: float = 0.0) -> None:
        """Step until the ball rests, under a force down [N]."""
        self.data.xfrc_applied[-1, 2] = -push
        for _ in range(1500):
            self._mj.mj_step(self.model, self.data)

    def lift(self) -> None:
        self.data.qpos[2] += 0.05
        self._mj.mj_forward(self.model, self.data)


class PybulletBall:
    """The same in Bullet."""

    def __init__(self, simulator: cs.Simulator, substeps: int = 0, **options: Any) -> None:
        import pybullet as p

        self._p, self._id = p, p.connect(p.DIRECT)
        p.setPhysicsEngineParameter(numSubSteps=substeps, physicsClientId=self._id)
        p.setGravity(0, 0, -GRAVITY, physicsClientId=self._id)
        p.setTimeStep(0.001, physicsClientId=self._id)
        box = p.createCollisionShape(
            p.GEOM_BOX, halfExtents=[0.025, 0.015, 0.01], physicsClientId=self._id
        )
        ball = p.createCollisionShape(p.GEOM_SPHERE, radius=RADIUS, physicsClientId=self._id)
        low = RISE + TOP - 0.01
        pad = p.createMultiBody(0, box, basePosition=[0, 0, low], physicsClientId=self._id)
        start = [-0.012, 0, RISE + TOP + RADIUS + 0.0002]
        self._ball = p.createMultiBody(MASS, ball, basePosition=start, physicsClientId=self._id)
        p.changeDynamics(self._ball, -1, rollingFriction=1e-3, physicsClientId=self._id)
        self.sensor = cs.pybullet.attach(
            self._id, pad, pose_in_link=cs.Pose((0, 0, 0.01 - TOP)), design=simulator, **options
        )

    def rest(self, push: float = 0.0) -> None:
        p = self._p
        for _ in range(1500):
            at = p.getBasePositionAndOrientation(self._ball, physicsClientId=self._id)[0]
            p.applyExternalForce(
                self._ball, -1, [0, 0, -push], at, p.WORLD_FRAME, physicsClientId=self._id
            )
            p.stepSimulation(physicsClientId=self._id)

    def lift(self) -> None:
        at = [-0.012, 0, RISE + 0.06]
        self._p.resetBasePositionAndOrientation(
            self._ball, at, [0, 0, 0, 1], physicsClientId=self._id
        )
        self._p.performCollisionDetection(physicsClientId=self._id)

    def close(self) -> None:
        self._p.disconnect(self._id)


@pytest.fixture(params=["mujoco", "pybullet"])
def world(request: pytest.FixtureRequest, simulator: cs.Simulator) -> Any:
    """``world(**options)``: a ball over a foam in one of the simulators."""
    pytest.importorskip(request.param)
    made: list[Any] = []

    def make(**options: Any) -> Any:
        made.append({"mujoco": MujocoBall, "pybullet": PybulletBall}[request.param](
            simulator, **options
        ))  # fmt: skip
        return made[-1]

    yield make
    for each in made:
        if isinstance(each, PybulletBall):
            each.close()


def test_the_foam_carries_what_rests_on_it(world: Callable[..., Any]) -> None:
    """Closed form: m g, then m g and what pushes; more force is more capacitance."""
    ball, forces, found = world(), (0.0, 0.3, 1.0, 2.0), []
    for push in forces:
        ball.rest(push)
        reading = ball.sensor.read()
        assert reading.touch is not None
        assert reading.touch.total == approx(MASS * GRAVITY + push, rel=0.02)
        assert reading.touch.force[0] == approx(reading.touch.total, rel=0.03)
        found.append([reading.delta[0, 0], reading.touch.compression[0]])
    assert (np.diff(found, axis=0) > 0.0).all()
    ball.lift()
    away = ball.sensor.read()
    assert away.touch is not None
    assert away.touch.total == 0.0
    assert away.delta[0, 0] < 0.5 * found[0][0]


def test_substeps_of_bullet_count(simulator: cs.Simulator) -> None:
    pytest.importorskip("pybullet")
    ball = PybulletBall(simulator, substeps=4)
    ball.rest()
    touch = ball.sensor.read().touch
    ball.close()
    assert touch is not None
    assert touch.total == approx(MASS * GRAVITY, rel=0.02)


def test_without_contact_forces_the_overlap_counts(world: Callable[..., Any]) -> None:
    ball = world(contact_forces=False)
    ball.rest()
    reading = ball.sensor.read()
    assert all(body.force is None for body in ball.sensor.scene())
    assert reading.touch is not None
    assert reading.touch.total < 0.5 * MASS * GRAVITY  # hard contacts overlap by micrometres


def test_a_body_without_contact_has_no_force(world: Callable[..., Any]) -> None:
    ball = world()
    ball.lift()
    assert [body.force for body in ball.sensor.scene()] == [None]


def test_which_contacts_count(foam: tuple[cs.Design, Any]) -> None:
    cover = foam[0].cover
    assert cover is not None
    bodies = [
        cs.Body(cs.Sphere(0.01), cs.Pose((-0.012, 0, 0.012))),
        cs.Body(cs.Sphere(0.01), cs.Pose((0.012, 0, 0.012))),
        cs.Body(cs.Box((0.01, 0.01, 0.01)), cs.Pose((0, 0.01, 0.007))),
    ]
    sensor = cs.Pose((1.0, 2.0, 3.0), (0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)))

    def felt(*contacts: tuple[int, Any, Any, float, float]) -> list[float | None]:
        turn = sensor.rotation
        out = [Contact(f, sensor.apply(np.array(p)), turn @ np.array(n), *r)
               for f, p, n, *r in contacts]  # fmt: skip
        found = [body.force for body in pressed(bodies, [7, 7, 8], out, sensor, cover)]
        return [None if force is None else round(force, 9) for force in found]

    up, down = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
    at, beside = (-0.012, 0.0, 0.002), (0.012, 0.0, 0.002)
    assert felt((7, at, up, 2.0, 0.0), (7, beside, up, 1.0, 0.0)) == [2.0, 1.0, None]
    assert felt((7, at, up, 2.0, 0.0), (7, at, up, 1.0, -1e-4)) == [3.0, None, None]
    assert felt((7, at, (0.6, 0.0, 0.8), 1.0, 0.0))[0] == approx(0.8)
    assert felt((7, at, up, 0.0, 1e-4)) == [None] * 3  # within a margin
    assert felt((7, at, up, 0.0, -1e-4)) == [0.0, None, None]  # it overlaps, and is not held
    assert felt((7, at, down, 1.0, 0.0), (9, at, up, 1.0, 0.0)) == [None] * 3
    assert felt((8, (0.0, 0.016, 0.002), up, 1.0, 0.0)) == [None] * 3  # beside the cover
    assert felt((8, (0.0, 0.01, -0.02), up, 1.0, 0.0)) == [None] * 3  # on the sensor's back


def test_forces_are_of_shapes_only(simulator: cs.Simulator) -> None:
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><site name="pad"/></worldbody></mujoco>'
    )
    with pytest.raises(SceneError, match="contact_forces"):
        cs.mujoco.attach(
            model, mujoco.MjData(model), "pad", simulator, perception="depth_camera",
            contact_forces=False,
        )  # fmt: skip
