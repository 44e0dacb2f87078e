"""A sensor added to a model that nobody made for it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from approximate import approx

import capsense as cs

mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")

MODEL = """<mujoco><worldbody>
  <body name="link" pos="0.3 0 0.2" euler="0 40 10"><geom type="box" size=".05 .05 .005"/></body>
  <body name="ball"><geom name="ball" size=".015"/></body>
</worldbody></mujoco>"""
ON_LINK = cs.Pose((0.01, 0.02, 0.006), (0.1, 0.2, -0.3, 0.9))


def build(spec: Any, place: cs.Pose) -> tuple[Any, Any]:
    """Compile a model, with the ball at a place in the frame of the sensor on the link."""
    spec.body("ball").pos = (spec_pose(spec) @ ON_LINK @ place).position
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def spec_pose(spec: Any) -> cs.Pose:
    """Where the link stands."""
    model = spec.copy().compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    body = model.body("link").id
    w, *xyz = data.xquat[body]
    return cs.Pose(data.xpos[body], (*xyz, w))


def test_a_site_is_where_it_was_asked_for(tiny_simulator: cs.Simulator) -> None:
    """The ball stands in the sensor frame where it was put, and is felt."""
    spec = mujoco.MjSpec.from_string(MODEL)
    name = cs.mujoco.add_sensor(spec, "link", ON_LINK)
    place = cs.Pose((0.004, -0.006, 0.04))
    sensor = cs.mujoco.attach(*build(spec, place), name, tiny_simulator)
    assert sensor.pose.position == approx((spec_pose(spec) @ ON_LINK).position)
    (ball,) = sensor.scene()
    assert ball.pose.position == approx(place.position)
    assert np.diag(sensor.read().delta).min() > 1e-15


def test_a_camera_looks_along_the_sensor(tiny_simulator: cs.Simulator) -> None:
    """Differential: the image's middle is as far as the ball; the reading is that of our camera."""
    spec = mujoco.MjSpec.from_string(MODEL)
    cs.mujoco.add_sensor(spec, "link", ON_LINK, "pad", camera=0.1, resolution=32)
    sensor = cs.mujoco.attach(
        *build(spec, cs.Pose((0.02, 0, 0.045))), "pad", tiny_simulator, perception="depth_camera"
    )
    (depth,) = sensor.frame().depth
    assert depth.shape == (32, 32)
    row, column = np.unravel_index(np.argmin(np.where(depth > 0, depth, 9)), depth.shape)
    assert depth[row, column] == approx(0.03, abs=5e-4)
    points = sensor.frame().camera.pose.apply(((column - 15.5) * 0.1 / 32, 0, 0))
    assert points[0] == approx(0.02, abs=4e-3)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("lnk", ON_LINK), "no body named 'lnk'; did you mean 'link'"),
        (("link", (0, 0, 1)), r"pose is \(0, 0, 1\); give a Pose"),
        (("link", ON_LINK, "old"), "has a site named 'old' already"),
        (
            ("link", cs.Pose((0, 0, 50))),
            "50 m from body 'link'; .*millimetres × 1e-3.* in the frame of the body",
        ),
        (("link", ON_LINK, ""), "name is ''; give the new site a name"),
    ],
)
def test_wrong_calls_name_the_fix(args: Any, message: str) -> None:
    """Nothing is added."""
    spec = mujoco.MjSpec.from_string(MODEL)
    cs.mujoco.add_sensor(spec, "world", cs.Pose(), "old")
    with pytest.raises(cs.SceneError, match=message):
        cs.mujoco.add_sensor(spec, *args)
    with pytest.raises(TypeError, match="spec is a str; give a mujoco"):
        cs.mujoco.add_sensor("model.xml", "link", ON_LINK)
    with pytest.raises(cs.SceneError, match="size is -1; give the width"):
        cs.mujoco.add_sensor(spec, "link", ON_LINK, "new", camera=-1)
    assert len(spec.sites) == 1
