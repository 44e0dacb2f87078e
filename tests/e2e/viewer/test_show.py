"""Sensors on robots, shown with the robot; pictures and videos for the one who watches."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
from approximate import approx
from PIL import Image

pytest.importorskip("viser", reason='needs viser: pip install "capsense[view]"')

from view_nodes import nodes_of
from view_sources import Counting, until

import capsense as cs
from capsense.viewer.player import Player
from capsense.viewer.view import SIZE, send_picture, send_video

ARM = """<mujoco><worldbody>
<body name="arm" pos="0 0 .3"><joint type="slide" axis="1 0 0"/>
<geom type="box" size=".06 .05 .005"/><site name="pad" pos="0 0 .006"/></body>
<body name="limb" pos="0 0 .4"><geom type="capsule" size=".03 .1" euler="0 90 0"/></body>
</worldbody></mujoco>"""


def test_the_robot_in_mujoco() -> None:
    """All geoms, the one that carries the sensor too, where they are as the sensor sees them."""
    mujoco = pytest.importorskip("mujoco", reason="needs pip install 'capsense[mujoco]'")
    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    data.qvel[0] = 1.0
    sensor = cs.mujoco.attach(model, data, "pad", materials={"limb": "human"})
    with cs.show(sensor, port=0) as page:
        assert page.url.startswith("http://127.0.0.1:")
        for _ in range(10):
            mujoco.mj_step(model, data)
            reading = page.read()
        with pytest.raises(TypeError, match=r"call read\(\)"):
            page.step(cs.Scene())
        assert reading.delta.diagonal().min() > 0
        until(lambda: page.player.newest is not None and page.player.newest.index == 9)
        frame = page.player.newest
        assert frame is not None
        assert frame.time == approx(data.time)
        (carrier, at, metal), (limb, there, flesh) = frame.around
        assert (metal.name, flesh.name) == ("steel", "human")
        assert isinstance(carrier, cs.Box)
        np.testing.assert_allclose(at.position, (0, 0, -0.006), atol=1e-12)
        assert isinstance(limb, cs.Capsule)
        np.testing.assert_allclose(there.position, (-data.site_xpos[0, 0], 0, 0.094), atol=1e-9)
        page.view.refresh()
        drawn = nodes_of(page.view.server)
        assert {"/robot/0", "/robot/1"} <= set(drawn)
        assert not any(name.startswith("/bodies/") for name in drawn)


def test_the_robot_in_pybullet() -> None:
    p = pytest.importorskip("pybullet", reason="needs pip install 'capsense[pybullet]'")
    client = p.connect(p.DIRECT)
    pad = p.createCollisionShape(
        p.GEOM_BOX, halfExtents=[0.06, 0.045, 0.005], physicsClientId=client
    )
    robot = p.createMultiBody(0, pad, physicsClientId=client)
    ball = p.createCollisionShape(p.GEOM_SPHERE, radius=0.03, physicsClientId=client)
    p.createMultiBody(0, ball, basePosition=[0, 0, 0.09], physicsClientId=client)
    sensor = cs.pybullet.attach(client, robot, link=-1, pose_in_link=cs.Pose((0, 0, 0.006)))
    with cs.show(sensor, port=0) as page:
        page.read()
        until(lambda: page.player.newest is not None)
        frame = page.player.newest
        assert frame is not None
        assert [type(shape) for shape, *_ in frame.around] == [cs.Box, cs.Sphere]
    p.disconnect(client)


def test_a_simulator_by_itself() -> None:
    """Scenes are stepped and shown as they are; each kind of page says what it is for."""
    simulator, plain = cs.Simulator("patch"), cs.Simulator("patch")
    with cs.show(simulator, port=0) as page:
        for k in range(5):
            ball = cs.Body(cs.Sphere(0.02), cs.Pose((0, 0, 0.06 - 0.005 * k)), name="ball")
            reading = page.step(cs.Scene([ball]), time=0.1 * k)
            np.testing.assert_array_equal(reading.delta, plain.step(cs.Scene([ball])).delta)
        until(lambda: page.player.newest is not None and page.player.newest.index == 4)
        frame = page.player.newest
        assert frame is not None
        assert (frame.time, frame.around) == (0.4, ())
        assert frame.scene.bodies[0].pose.position[2] == approx(0.04)
        page.view.refresh()
        assert any(name.startswith("/bodies/") for name in nodes_of(page.view.server))
        with pytest.raises(TypeError, match="call step"):
            page.read()


SKIN = """<mujoco><worldbody>
<body name="arm" pos="0 0 .3"><joint type="slide" axis="1 0 0"/>
<geom type="box" size=".06 .05 .005"/><site name="top" pos="0 0 .006"/>
<site name="under" pos="0 0 -.006" quat="0 1 0 0"/></body>
<body name="limb" pos="0 0 .4"><geom type="capsule" size=".03 .1" euler="0 90 0"/></body>
</worldbody></mujoco>"""


def test_a_skin_on_a_robot() -> None:
    """All sensors where they stand in the world, coloured by their own signals; the robot."""
    mujoco = pytest.importorskip("mujoco", reason="needs pip install 'capsense[mujoco]'")
    model = mujoco.MjModel.from_xml_string(SKIN)
    data = mujoco.MjData(model)
    data.qvel[0] = 1.0
    mujoco.mj_forward(model, data)
    skin = cs.mujoco.attach_skin(model, data, ["top", "under"], materials={"limb": "human"})
    with cs.show(skin, port=0) as page:
        for _ in range(3):
            mujoco.mj_step(model, data)
            readings = page.read()
        until(lambda: page.player.newest is not None and page.player.newest.index == 2)
        frame = page.player.newest
        assert frame is not None
        assert frame.time == approx(data.time)
        assert list(frame.skin) == ["top", "under"]
        pose, changes, touch = frame.skin["top"]
        assert touch is None
        np.testing.assert_allclose(pose.position, data.site_xpos[0], atol=1e-12)
        np.testing.assert_array_equal(changes, np.abs(readings["top"].delta.diagonal()))
        (arm, at, _), _ = frame.around
        assert isinstance(arm, cs.Box)
        np.testing.assert_allclose(at.position, data.xpos[1], atol=1e-12)
        page.view.refresh()
        drawn = nodes_of(page.view.server)
        np.testing.assert_allclose(drawn["/skin/1"].position, data.site_xpos[1], atol=1e-9)
        plates = [node for name, node in drawn.items() if "/skin/0/electrodes/" in name]
        assert len(plates) == 6
        assert any(node.position.any() for node in plates)
        assert "/robot/1" in drawn
        assert "/domain" not in drawn
        _, history = page.player.history(2)
        assert history.shape == (3, 2)
        largest = max(float(np.abs(r.delta.diagonal()).max()) for r in readings.values())
        assert history[-1].max() == largest


def test_a_skin_on_no_robot() -> None:
    """With the scene in place of a robot."""
    sim = cs.Simulator("six_patch")
    skin = cs.Skin({"a": (sim, cs.Pose()), "b": (sim, cs.Pose((0.2, 0, 0)))})
    with cs.show(skin, port=0) as page:
        with pytest.raises(TypeError, match="on no robot; write step"):
            page.read()
        ball = cs.Body(cs.Sphere(0.03), cs.Pose((0.2, 0, 0.08)))
        readings = page.step(cs.Scene([ball]), {"b": cs.Pose((0.2, 0.01, 0))}, time=0.5)
        until(lambda: page.player.newest is not None)
        frame = page.player.newest
        assert frame is not None
        assert (frame.time, frame.around) == (0.5, ((ball.shape, ball.pose, ball.material),))
        assert frame.skin["b"][0] == cs.Pose((0.2, 0.01, 0))
        assert np.abs(readings["b"].delta).max() > np.abs(readings["a"].delta).max()
        page.view.refresh()


class Watcher:
    """A client of a page, whose picture is of one colour; on the right there is nothing."""

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}
        self.shade = 0

    def get_render(self, rows: int, columns: int, **_: Any) -> np.ndarray:
        self.shade += 10
        picture = np.full((rows, columns, 4), self.shade, np.uint8)
        picture[:, : columns // 2, 3], picture[:, columns // 2 :, 3] = 255, 0
        return picture

    def send_file_download(self, name: str, content: bytes, *, save_immediately: bool) -> None:
        assert save_immediately
        self.files[name] = content


def test_pictures_and_videos() -> None:
    """A picture on white; a video of all samples, as long as they last."""
    player = Player(Counting(6, period=0.05))
    watcher = Watcher()
    try:
        send_picture(watcher)
        send_video(watcher, player)
    finally:
        player.stop()
    with Image.open(io.BytesIO(watcher.files["capsense.png"])) as picture:
        assert picture.size == SIZE[::-1]
        assert picture.getpixel((5, 5)) == (10, 10, 10)
        assert picture.getpixel((SIZE[1] - 5, 5)) == (255, 255, 255)
    with Image.open(io.BytesIO(watcher.files["capsense.webp"])) as video:
        assert video.n_frames == 6  # type: ignore[attr-defined]
        video.seek(5)
        video.load()
        assert video.info["duration"] == 50


def test_what_is_no_sensor() -> None:
    """A design is shown by another command."""
    with pytest.raises(TypeError, match=r"sensor is of Design; .* capsense view"):
        cs.show(cs.load_design("six_patch"), port=0)  # type: ignore[arg-type]
