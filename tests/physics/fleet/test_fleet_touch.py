"""What a cover that gives way reports, step by step, and in many environments at once."""

from __future__ import annotations

import numpy as np
import pytest
from approximate import approx

import capsense as cs
from capsense.errors import SceneError

RADIUS = 0.01


def ball(force: float | None = None, x: float = -0.012, **more: object) -> cs.Body:
    """A ball, 0.1 mm deep in the cover of a design with its face 2 mm high."""
    return cs.Body(cs.Sphere(RADIUS), cs.Pose((x, 0, RADIUS + 0.0019)), force=force, **more)


def pose(body: cs.Body) -> list[float]:
    return [*body.pose.position, *body.pose.quaternion]


def test_a_ball_is_pressed_in_as_deep_as_a_foundation_says(foam_field: cs.Design) -> None:
    """Closed form: pi E R d² / t; the paraboloid that this is for is 2 % off the ball here."""
    reading = cs.Simulator(foam_field).step(cs.Scene([ball(0.5)]))
    assert reading.touch is not None
    depth = np.sqrt(0.5 * 0.002 / (np.pi * 60e3 * RADIUS))
    assert reading.touch.total == approx(0.5, rel=1e-9)
    assert reading.touch.compression[0] == approx(depth, rel=0.03)
    assert reading.touch.force == approx([0.5, 0.0], rel=0.02)


def test_fleets_feel_what_simulators_feel(foam_field: cs.Design) -> None:
    """Differential: forces, overlaps and both together, on two sensors of which one is turned."""
    sim = cs.Simulator(foam_field)
    box = cs.Body(cs.Box((0.01, 0.01, 0.01)), cs.Pose((0.012, 0.001, 0.0067)), "wood")
    forces = np.array([[0.5, np.nan], [np.nan, np.nan], [0.0, 0.3], [2.0, 0.1]])
    bodies = [ball(), box]
    fleet = cs.Fleet(foam_field, bodies, len(forces), sensors=2)
    turn = cs.Pose((0, 0, 0), (0, 0, 0.6, 0.8))
    frames = [cs.Pose(), cs.Pose((0.3, 0.1, 0)) @ turn]
    poses = np.broadcast_to([pose(b) for b in bodies], (len(forces), 2, 7))
    sensors = np.broadcast_to([[*f.position, *f.quaternion] for f in frames], (len(forces), 2, 7))
    found = fleet.step(poses, sensors, forces=forces)
    assert found.touch is not None
    for e, row in enumerate(forces):
        pressed = [b.pressed(None if np.isnan(f) else f) for b, f in zip(bodies, row, strict=True)]
        truth = sim.step(cs.Scene(pressed))
        assert truth.touch is not None
        np.testing.assert_allclose(found.delta[e, 0], truth.delta, rtol=1e-9, atol=1e-22)
        np.testing.assert_allclose(found.touch.force[e, 0], truth.touch.force, rtol=1e-9)
        np.testing.assert_allclose(
            found.touch.compression[e, 0], truth.touch.compression, rtol=1e-9
        )
        assert found.touch.total[e, 0] == approx(truth.touch.total, rel=1e-9)
    assert not found.touch.force[:, 1].any()  # the second sensor is elsewhere
    assert found.touch.total[3, 0] == approx(2.1, rel=1e-9)


def test_compression_beside_an_electrode_is_not_above_it(foam_field: cs.Design) -> None:
    """Invariant: in the corners of the rectangle around a disc, which no electrode is in."""
    small = cs.Body(cs.Sphere(0.001))
    x, y = 0.012 + 0.0075 * np.array([1, 1, -1, -1]), 0.0075 * np.array([1, -1, 1, -1])
    poses = np.zeros((4, 1, 7))
    poses[..., 6], poses[:, 0, 0], poses[:, 0, 1], poses[..., 2] = 1.0, x, y, 0.0025
    touch = cs.Fleet(foam_field, [small], 4).step(poses).touch
    assert (touch.total > 0.0).all()
    assert not touch.force.any()
    assert not touch.compression.any()


def test_fleets_press_bodies_by_their_own_forces(foam_field: cs.Design) -> None:
    fleet = cs.Fleet(foam_field, [ball(0.5)], 2)
    fleet.change(0, ball(), [1])
    where = np.broadcast_to(pose(ball()), (2, 1, 7))
    total = fleet.step(where).touch.total[:, 0]
    assert total[0] == approx(0.5, rel=1e-9)
    assert 0.0 < total[1] < 0.1
    assert fleet.step(where, forces=[[0.2], [np.nan]]).touch.total[0, 0] == approx(0.2)


def test_fleets_refuse_what_they_cannot_do_with_forces(foam_field: cs.Design) -> None:
    fleet = cs.Fleet(foam_field, [ball()], 2)
    where = np.broadcast_to(pose(ball()), (2, 1, 7))
    for forces, fix in (([0.5, 0.5], "shape"), ([[-1.0], [0.0]], "-1"), ([[np.inf], [0]], "inf")):
        with pytest.raises(SceneError, match=fix):
            fleet.step(where, forces=forces)
    with pytest.raises(SceneError, match="Jacobian"):
        fleet.step(where, forces=[[0.5], [0.5]], jacobian=True)
    assert fleet.step(where, jacobian=True).jacobian.any()
    bare = cs.Fleet("six_patch", [ball()], 1)
    with pytest.raises(SceneError, match="cover"):
        bare.step(where[:1], forces=[[0.5]])
    assert bare.step(where[:1], forces=[[np.nan]]).touch is None


def test_lossy_matter_is_pressed_in_too(foam_field: cs.Design) -> None:
    body = ball(0.5, material=cs.Material("wet", 30.0, 1e-4))
    sim = cs.Simulator(foam_field)
    truth = sim.step(cs.Scene([body]))
    found = cs.Fleet(foam_field, [body], 1).step([[pose(body)]])
    assert truth.conductance is not None
    np.testing.assert_allclose(found.delta[0, 0], truth.delta, rtol=1e-9, atol=1e-22)
    np.testing.assert_allclose(found.touch.force[0, 0], truth.touch.force, rtol=1e-9)
