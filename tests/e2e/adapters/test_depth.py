"""Worlds seen as depth images, against the same worlds seen as shapes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from adapter_worlds import Thing, load, numbers, plain_reading, urdf, urdf_geometry
from approximate import approx

import capsense as cs

SENSOR = cs.Pose((0.3, -0.2, 0.5), (0.1, 0.3, -0.2, 0.9))
AHEAD = cs.Pose((0.004, -0.003, 0.03), (0.0, 0.0, 0.2, 1.0))
"""Where a block stands in the sensor frame, square to the view."""
BLOCK = cs.Box((0.04, 0.03, 0.01))


def quat(pose: cs.Pose) -> str:
    """MuJoCo's order."""
    x, y, z, w = pose.quaternion
    return numbers((w, x, y, z))


def mujoco_camera(
    things: list[Thing], simulator: cs.Simulator, folder: Path, resolution: int = 64, **options: Any
) -> Any:
    """A sensor in MuJoCo that sees a square image of 0.1 m."""
    import mujoco
    from adapter_worlds import mjcf_geom

    geoms = "".join(
        mjcf_geom(t)[0].replace("<geom", f'<geom pos="{numbers(w.position)}" quat="{quat(w)}"')
        for t in things
        for w in (SENSOR @ t.pose,)
    )
    camera = cs.Pose((0, 0, 0), (1, 0, 0, 0))
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody>{geoms}<body pos="{numbers(SENSOR.position)}" quat="{quat(SENSOR)}">'
        '<geom type="box" size=".05 .05 .001"/><site name="pad"/>'
        f'<camera name="pad" quat="{quat(camera)}" projection="orthographic" fovy="0.1" '
        f'resolution="{resolution} {resolution}"/></body></worldbody>'
        '<sensor><rangefinder camera="pad" data="depth"/></sensor></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    return cs.mujoco.attach(model, data, "pad", simulator, perception="depth_camera", **options)


def pybullet_camera(
    things: list[Thing], simulator: cs.Simulator, folder: Path, resolution: int = 64, **options: Any
) -> Any:
    """A sensor in PyBullet that sees a square image of 0.1 m; things are named after it."""
    import pybullet as p

    client = p.connect(p.DIRECT)
    for thing in things:
        load(client, urdf(thing.name, urdf_geometry(thing, folder)), SENSOR @ thing.pose, folder)
    pad = load(client, urdf("pad", '<box size="0.1 0.1 0.002"/>'), SENSOR, folder)
    return cs.pybullet.attach(
        client, pad, design=simulator, perception="depth_camera", resolution=resolution, **options
    )


def coppeliasim_camera(
    things: list[Thing], simulator: cs.Simulator, folder: Path, resolution: int = 64, **options: Any
) -> Any:
    """A sensor in the stand-in for CoppeliaSim that sees a square image of 0.1 m."""
    from coppelia_stand_in import StandIn

    server = StandIn()
    link = server.add("link", local=SENSOR)
    server.add("pad", cs.Box((0.1, 0.1, 0.002)), on=link)
    for thing in things:
        server.add(thing.name, thing.shape, SENSOR @ thing.pose)
    sim = cs.coppeliasim.connect(port=server.port)
    sim.startSimulation()
    sensor = cs.coppeliasim.attach(sim, "/link/pad", simulator, resolution=resolution, **options)
    sensor.server = server
    return sensor


CAMERAS = {"coppeliasim": coppeliasim_camera, "mujoco": mujoco_camera, "pybullet": pybullet_camera}
MODULES = {"coppeliasim": "coppeliasim_zmqremoteapi_client"}


@pytest.fixture(params=sorted(CAMERAS))
def adapter(request: pytest.FixtureRequest) -> str:
    """The name of an adapter whose simulator, or its client, is installed."""
    module = MODULES.get(request.param, request.param)
    pytest.importorskip(module, reason=f"{module} is not installed")
    return str(request.param)


@pytest.fixture
def attached(
    adapter: str, tiny_simulator: cs.Simulator, tmp_path: Path
) -> Iterator[Callable[..., Any]]:
    """``attached(things, **options)``: a sensor that sees a depth image."""
    sensors: list[Any] = []

    def make(things: list[Thing], **options: Any) -> Any:
        sensors.append(CAMERAS[adapter](things, tiny_simulator, tmp_path, **options))
        tiny_simulator.reset()
        return sensors[-1]

    yield make
    for sensor in sensors:
        close(sensor)


def close(sensor: Any) -> None:
    """End the simulator of a sensor."""
    if hasattr(sensor, "server"):
        sensor.server.close()
    elif hasattr(sensor, "client"):
        import pybullet as p

        p.disconnect(physicsClientId=sensor.client)


def error(found: cs.Reading, expected: cs.Reading) -> float:
    """Largest difference of self-capacitance changes, relative to each."""
    a, b = np.diag(found.delta), np.diag(expected.delta)
    return float(np.abs(a / b - 1).max())


def test_a_block_reads_as_its_shape_does(
    attached: Callable[..., Any], tiny_simulator: cs.Simulator
) -> None:
    """Differential: within 7 % at 64 x 64, its thickness known; sensor anywhere in the world."""
    things = [Thing("block", BLOCK, AHEAD)]
    found = attached(things, back=0.01).read()
    assert error(found, plain_reading(things, cs.Pose(), tiny_simulator)) < 0.07


def test_the_image_is_the_right_way_round(attached: Callable[..., Any]) -> None:
    """Three balls, each in its place: no mirrored rows or columns, no shift beyond half a pixel."""
    places = {"a": (0.02, 0.03, 0.03), "b": (-0.03, 0.01, 0.05), "c": (0.01, -0.025, 0.07)}
    sensor = attached([Thing(k, cs.Sphere(0.008), cs.Pose(v)) for k, v in places.items()])
    points = sensor.frame().points()
    assert np.isfinite(points).all()
    for centre in places.values():
        near = points[np.linalg.norm(points - centre, axis=1) < 0.012]
        assert len(near) > 60
        assert near[:, :2].mean(axis=0) == approx(centre[:2], abs=0.0003)
        radius = np.linalg.norm(near - centre, axis=1)  # PyBullet draws a polyhedron
        assert radius == approx(np.full(len(near), 0.008), abs=0.0008)
    assert sensor.pose.position == approx(SENSOR.position, abs=1e-6)


def test_an_empty_view_changes_nothing(attached: Callable[..., Any]) -> None:
    """The sensor's own link is not seen."""
    sensor = attached([Thing("behind", BLOCK, cs.Pose((0, 0, -0.05)))])
    assert not sensor.frame().valid.any()
    assert np.abs(sensor.read().delta).max() == 0.0


def test_wrong_options_are_refused(adapter: str, attached: Callable[..., Any]) -> None:
    """By name; so are those of the other world, where there is one."""
    things = [Thing("block", BLOCK, AHEAD)]
    cases: list[tuple[dict[str, Any], str]] = [
        ({"back": "full"}, "back is 'full'"),
        ({"default_grounding": 0.0}, "grounding is 0.0, not a positive"),
    ]
    if adapter != "coppeliasim":
        cases += [
            ({"grounding": {"block": "floating"}}, 'grounding goes with perception="geometry"'),
            ({"hull": ["block"]}, 'hull goes with perception="geometry"'),
        ]
    for options, message in cases:
        with pytest.raises(cs.SceneError, match=message):
            attached(things, **options).read()


def test_all_simulators_see_the_same(tiny_simulator: cs.Simulator, tmp_path: Path) -> None:
    """Differential: one scene through all depth paths, within 1 %."""
    for name in CAMERAS:
        module = MODULES.get(name, name)
        pytest.importorskip(module, reason=f"{module} is not installed")
    things = [
        Thing("block", BLOCK, AHEAD),
        Thing("ball", cs.Sphere(0.01), cs.Pose((0.03, 0.03, 0.06))),
    ]
    readings = []
    for make in CAMERAS.values():
        tiny_simulator.reset()
        sensor = make(things, tiny_simulator, tmp_path)
        readings.append(sensor.read())
        close(sensor)
    for other in readings[1:]:
        assert error(other, readings[0]) < 0.01


def test_materials_of_drawn_links(tiny_simulator: cs.Simulator, tmp_path: Path) -> None:
    """PyBullet's image tells links apart: a dielectric, a conductor, one left out."""
    pytest.importorskip("pybullet", reason="PyBullet is not installed")
    things = [
        Thing(n, cs.Sphere(0.008), cs.Pose((x, 0, 0.03)))
        for n, x in (("glass", -0.03), ("steel", 0.0), ("gone", 0.03))
    ]
    sensor = pybullet_camera(
        things, tiny_simulator, tmp_path,
        materials={"glass": "glass"}, exclude=["gone"], default_grounding="floating",
    )  # fmt: skip
    scene = sensor.scene()
    assert sorted(b.material.eps_r for b in scene if not b.material.is_conductor()) == [5.0]
    assert len(scene) == 2
    assert {b.grounding for b in scene} == {"floating"}
    assert sensor.frame().points()[:, 0].max() < 0.01
    close(sensor)


def test_wrong_cameras_are_refused(tiny_simulator: cs.Simulator) -> None:
    """In MuJoCo: no camera, one in perspective, one that nothing reads, no poses yet."""
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><geom size=".1"/><site name="pad"/><camera name="wide"/>'
        '<camera name="idle" projection="orthographic" resolution="8 8" fovy=".1"/>'
        '<camera name="front" projection="orthographic" resolution="8 8" fovy=".1"/></body>'
        '</worldbody><sensor><rangefinder camera="front" data="depth"/></sensor></mujoco>'
    )
    data = mujoco.MjData(model)

    def attach(camera: str | None, **options: Any) -> Any:
        return cs.mujoco.attach(
            model, data, "pad", tiny_simulator, perception="depth_camera", camera=camera, **options
        )

    for camera, message in (
        ("frnt", "no camera named 'frnt'; did you mean 'front'"),
        (None, "no camera named 'pad'"),
        ("wide", "'wide' is in perspective.*orthographic"),
        ("idle", "nothing reads the depths of camera 'idle'; add <rangefinder"),
    ):
        with pytest.raises(cs.SceneError, match=message):
            attach(camera)
    with pytest.raises(cs.SceneError, match="hold no poses yet"):
        attach("front").read()
    with pytest.raises(cs.SceneError, match='camera goes with perception="depth_camera"'):
        cs.mujoco.attach(model, data, "pad", tiny_simulator, camera="front")
    with pytest.raises(ValueError, match=r"perception is .image."):
        cs.mujoco.attach(model, data, "pad", tiny_simulator, perception="image")
    with pytest.raises(cs.SceneError, match='groups goes with perception="geometry"'):
        attach("front", groups=[0])
