"""CoppeliaSim: the real client against a stand-in that speaks the simulator's wire format."""

from __future__ import annotations

import runpy
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from approximate import approx

import capsense as cs
from capsense import errors
from capsense.errors import ReadoutError

pytest.importorskip(
    "coppeliasim_zmqremoteapi_client", reason="CoppeliaSim's client is not installed"
)
from coppelia_stand_in import TIME_STEP, UNPAINTED, StandIn

BLOCK = cs.Box((0.03, 0.024, 0.01))
BALL = cs.Sphere(0.012)
AHEAD = cs.Pose((0.004, -0.003, 0.03))


@pytest.fixture
def server() -> Iterator[StandIn]:
    """A scene of one dummy, ``/Robot/flange``."""
    stand_in = StandIn()
    robot = stand_in.add("Robot", local=cs.Pose((0.3, -0.2, 0.5), (0.1, 0.3, -0.2, 0.9)))
    stand_in.add("flange", on=robot, local=cs.Pose((0, 0, 0.1), (0, 0.5, 0, 1)))
    yield stand_in
    stand_in.close()


@pytest.fixture
def sim(server: StandIn) -> Any:
    """What the real client makes of it."""
    return cs.coppeliasim.connect(port=server.port, timeout=5.0)


def put(server: StandIn, name: str, shape: Any = BLOCK, pose: cs.Pose = AHEAD) -> int:
    """Add a shape before the flange."""
    flange = server.pose(server.getObject("/Robot/flange"))
    return server.add(name, shape, flange @ pose)


def error(found: cs.Reading, simulator: cs.Simulator, *bodies: cs.Body) -> float:
    """Largest difference of self-capacitance changes from those of the shapes, relative."""
    simulator.reset()
    expected = np.diag(simulator.step(cs.Scene(bodies)).delta)
    simulator.reset()
    return float(np.abs(np.diag(found.delta) / expected - 1).max())


def test_a_moving_block_reads_as_its_shape_does(
    server: StandIn, sim: Any, tiny_simulator: cs.Simulator
) -> None:
    """Differential, along a path: as an image of its own, and as the geometry; with times.

    The block's edges lie between pixels, so that its image is as wide as itself. Measured 4.6 %
    from the geometry; from the image made by hand, less than 0.1 %.
    """
    block = put(server, "block")
    flange = server.pose(server.getObject("/Robot/flange"))

    def place(time: float) -> cs.Pose:
        return cs.Pose((0.2 * time - 0.02, 0.01, 0.05 - 0.1 * time))

    def move(time: float) -> None:
        server.things[block].local = flange @ place(time)

    server.on_step = move
    sensor = cs.coppeliasim.attach(sim, "/Robot/flange", tiny_simulator, back=0.01, resolution=100)
    with cs.coppeliasim.running(sim) as step:
        assert server.stepping
        for k in range(1, 5):
            now = step()
            assert now == approx(k * TIME_STEP)
            assert sensor.time == now
            reading = sensor.read()
            assert error(reading, tiny_simulator, cs.Body(BLOCK, place(now), "steel")) < 0.08
            mesh = BLOCK.to_trimesh()
            seen = cs.render_depth(
                place(now).apply(mesh.vertices), mesh.faces, (0.1, 0.1), (100, 100)
            )
            depth = np.where(seen.depth > 0, seen.depth, np.nan)
            by_hand = cs.DepthFrame(depth, camera=cs.OrthographicCamera(0.1, 0.1), back=0.01)
            expected = tiny_simulator.step(by_hand).delta
            assert np.abs(reading.delta - expected).max() < 1e-3 * np.abs(expected).max()
    assert not server.running
    assert not server.stepping


def test_the_red_channel_tells_materials(
    server: StandIn, sim: Any, tiny_simulator: cs.Simulator
) -> None:
    """Differential: as a frame made by hand; what is left out hides nothing."""
    put(server, "left_glass", pose=cs.Pose((-0.02, 0, 0.03)))
    put(server, "right_steel", pose=cs.Pose((0.02, 0, 0.03)))
    screen = put(server, "screen", cs.Box((0.08, 0.08, 0.001)), cs.Pose((0, 0, 0.01)))
    sensor = cs.coppeliasim.attach(
        sim, "/Robot/flange", tiny_simulator, materials={"*glass": "glass"}, exclude=["/scr*"],
        default_grounding="floating", back=0.01, resolution=100,
    )  # fmt: skip
    sim.startSimulation()
    frame = sensor.frame()
    assert set(np.unique(frame.permittivity)) == {0.0, 5.0, np.inf}
    assert frame.resolution == (100, 100)
    by_hand = cs.DepthFrame(
        np.where(frame.valid[0], 0.025, np.inf), np.array(frame.permittivity[0]),
        cs.OrthographicCamera(0.1, 0.1, far=0.1, columns="-x"), back=0.01, grounding="floating",
    )  # fmt: skip
    x = frame.camera.pixel_centres((100, 100))[0]
    (seen,) = np.nonzero(frame.permittivity[0, 50])
    assert set(np.floor(1000 * x[seen]).astype(int)) == {*range(-35, -5), *range(5, 35)}
    assert (np.isinf(frame.permittivity[0, 50, seen]) == (x[seen] > 0)).all()
    expected = tiny_simulator.step(by_hand).delta
    tiny_simulator.reset()
    assert sensor.read().delta == approx(expected, rel=1e-3)
    late = put(server, "late_glass", pose=cs.Pose((0, 0.03, 0.03)))
    assert server.things[late].colour == UNPAINTED
    sensor.refresh()
    assert server.things[late].colour == approx((5 / 255, 0, 0))
    assert server.collections[
        server.things[sensor.vision_sensor.handle].parameters["entity_to_render"]
    ] == {screen}


def test_a_sensor_rides_on_its_object(
    server: StandIn, sim: Any, tiny_simulator: cs.Simulator
) -> None:
    """Its pose and what it sees follow; the shape it stands on is seen on request alone."""
    flange = server.getObject("/Robot/flange")
    pad = server.add("pad", cs.Box((0.05, 0.04, 0.03)), on=flange)
    put(server, "ball", BALL, cs.Pose((0, 0, 0.045)))
    on_pad = cs.Pose((0, 0, 0.014), (0, 0, 1, 0))
    sensor = cs.coppeliasim.attach(sim, "/Robot/flange/pad", tiny_simulator, pose_in_object=on_pad)
    sim.startSimulation()
    near = sensor.frame()
    assert near.points()[:, 2].min() == approx(0.045 - 0.014 - 0.012, abs=2e-4)
    server.things[flange].local @= cs.Pose((0, 0, -0.01))
    assert sensor.pose.position == approx((server.pose(pad) @ on_pad).position)
    assert sensor.pose.quaternion == approx((server.pose(pad) @ on_pad).quaternion)
    far = sensor.frame()
    assert far.points()[:, 2].min() == approx(0.045 - 0.004 - 0.012, abs=2e-4)
    own = cs.coppeliasim.attach(sim, pad, tiny_simulator, exclude_own=False)
    assert own.frame().points()[:, 2].min() == approx(0.015, abs=1e-6)


def test_attaching_again_replaces_what_was_made(
    server: StandIn, sim: Any, tiny_simulator: cs.Simulator
) -> None:
    """Scripts that run many times leave one vision sensor and one collection behind."""
    flange = server.getObject("/Robot/flange")
    first = cs.coppeliasim.attach(sim, "/Robot/flange", tiny_simulator)
    second = cs.coppeliasim.attach(sim, "/Robot/flange", tiny_simulator)
    assert [t.alias for t in server.things.values() if t.parent == flange] == ["capsense"]
    assert len(server.collections) == 1
    sim.startSimulation()
    with pytest.raises(cs.AdapterError, match=r"sim.handleVisionSensor: Object does not exist"):
        first.read()
    second.remove()
    assert not [t for t in server.things.values() if t.parent == flange]
    assert not server.collections


def test_a_vision_sensor_of_the_scene_is_taken_as_it_is(
    server: StandIn, sim: Any, tiny_simulator: cs.Simulator
) -> None:
    """Its image, and its frame; materials by its red channel, or one for all."""
    flange = server.getObject("/Robot/flange")
    camera = server.add_vision("camera", flange, render_mode=1)
    put(server, "ball")
    for name in ("/Robot/flange", "/Robot/flange/camera", camera):
        sensor = cs.coppeliasim.attach(sim, name, tiny_simulator, resolution=64)
        assert sensor.vision_sensor.handle == camera
    sim.startSimulation()
    seen = sensor.frame()
    assert set(np.unique(seen.permittivity)) == {0.0, round(255 * UNPAINTED[0])}
    sensor = cs.coppeliasim.attach(
        sim, camera, tiny_simulator, default_material="steel", back=0.01, readout="fdc1004"
    )
    assert error(sensor.read(), tiny_simulator, cs.Body(BLOCK, AHEAD, "steel")) < 0.05
    sim.step()
    counts = sensor.read().counts
    assert counts is not None
    assert len(counts.time) > 0
    with pytest.raises(cs.SceneError, match=r"exclude goes with a vision sensor that attach makes"):
        cs.coppeliasim.attach(sim, camera, tiny_simulator, exclude=["ball"])
    with pytest.raises(cs.SceneError, match=r"has 64 x 64 pixels, not 32 x 32"):
        cs.coppeliasim.attach(sim, camera, tiny_simulator, resolution=32)
    server.things[camera].parameters["resolution_y"] = 48
    with pytest.raises(cs.SceneError, match=r"now has 64 x 48 pixels, not 64 x 64; attach again"):
        sensor.read()
    server.things[camera].parameters["perspective_operation"] = 1
    with pytest.raises(cs.SceneError, match=r"'/Robot/flange/camera' is in perspective"):
        cs.coppeliasim.attach(sim, "/Robot/flange", tiny_simulator)
    server.add_vision("other", flange)
    with pytest.raises(
        cs.SceneError, match=r"2 vision sensors \('/Robot/flange/camera', .*name one"
    ):
        cs.coppeliasim.attach(sim, "/Robot/flange", tiny_simulator)


def test_slips_are_refused_before_the_scene_is_changed(
    server: StandIn, sim: Any, tiny_simulator: cs.Simulator
) -> None:
    """By name: objects, patterns, options; and nothing is left behind."""
    put(server, "ball")
    for thing, options, message in (
        ("/Robot/flang", {}, "no object named '/Robot/flang'; did you mean '/Robot/flange'"),
        (999, {}, "no object of handle 999"),
        (None, {}, "object is None; give a path"),
        ("/Robot/flange", {"materials": {"bal": "glass"}}, "nothing is named 'bal'; did you mean"),
        ("/Robot/flange", {"materials": {"ball": cs.Material("x", 300.0)}}, "eps_r is 300.0"),
        ("/Robot/flange", {"exclude": "ball"}, "exclude is 'ball'; give a list"),
        ("/Robot/flange", {"resolution": 0}, "resolution is 0"),
        ("/Robot/flange", {"size": -0.1}, "size is -0.1"),
        ("/Robot/flange", {"default_grounding": "grouded"}, "grounding is 'grouded'"),
        ("/Robot/flange", {"pose_in_object": (0, 0, 1)}, r"pose_in_object is \(0, 0, 1\)"),
    ):
        with pytest.raises(cs.SceneError, match=message):
            cs.coppeliasim.attach(sim, thing, tiny_simulator, **options)
    with pytest.raises(ReadoutError):
        cs.coppeliasim.attach(sim, "/Robot/flange", tiny_simulator, readout="fdc1005")
    assert len(server.things) == 3
    assert not server.collections


def test_a_reading_wants_a_running_simulation(
    server: StandIn, sim: Any, tiny_simulator: cs.Simulator
) -> None:
    """Refused before the start; a start that takes some steps is waited for."""
    sensor = cs.coppeliasim.attach(sim, "/Robot/flange", tiny_simulator)
    with pytest.raises(cs.SceneError, match=r"not running; call sim.startSimulation\(\)"):
        sensor.read()
    server.starts_late = 3
    with cs.coppeliasim.running(sim) as step:
        assert np.abs(sensor.read().delta).max() == 0.0
        with cs.coppeliasim.running(sim):  # goes on, as it ran before
            pass
        assert server.running
        server.running = False
        with pytest.raises(cs.AdapterError, match="stopped from elsewhere"):
            step()
    server.starts_late = 1000
    with pytest.raises(cs.AdapterError, match="does not start"), cs.coppeliasim.running(sim):
        pass


def test_an_error_within_a_run_stops_it(server: StandIn, sim: Any) -> None:
    """The simulation is stopped and the error goes on, even if CoppeliaSim is gone by then."""
    with pytest.raises(ZeroDivisionError), cs.coppeliasim.running(sim):
        raise ZeroDivisionError
    assert not server.running
    short = cs.coppeliasim.connect(port=server.port, timeout=0.2)

    def crash() -> None:
        server.close()
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError), cs.coppeliasim.running(short):
        crash()


def test_a_lost_simulator_is_named(server: StandIn, tiny_simulator: cs.Simulator) -> None:
    """One that never answers, one that vanished, and the broken connection afterwards."""
    sim = cs.coppeliasim.connect(port=server.port, timeout=0.2)
    sensor = cs.coppeliasim.attach(sim, "/Robot/flange", tiny_simulator)
    sim.startSimulation()
    server.close()
    with pytest.raises(cs.AdapterError, match=r"did not answer sim.callScriptFunction in time"):
        sensor.read()
    with pytest.raises(cs.AdapterError, match="connection to CoppeliaSim is broken"):
        sensor.read()
    with pytest.raises(cs.AdapterError, match=rf"nobody answers at localhost:{server.port}"):
        cs.coppeliasim.connect(port=server.port, timeout=0.1)
    with pytest.raises(cs.AdapterError, match="timeout is 0"):
        cs.coppeliasim.connect(timeout=0)


def test_other_versions_are_named(tiny_simulator: cs.Simulator) -> None:
    """The first version of the protocol; a ``sim`` that lacks a function; no ``sim`` at all."""
    old = StandIn(protocol=1)
    with pytest.raises(cs.AdapterError, match=r"another version .* CoppeliaSim 4\.6 or later"):
        cs.coppeliasim.connect(port=old.port)
    old.close()
    poor = StandIn(without=("getVisionSensorDepth", "sceneobject_shape"))
    sim = cs.coppeliasim.connect(port=poor.port)
    with pytest.raises(cs.AdapterError, match=r"no sim\.getVisionSensorDepth.* 4\.6 or later"):
        cs.coppeliasim.attach(sim, "/Robot", tiny_simulator)
    poor.close()
    with pytest.raises(cs.AdapterError, match=r"sim is 'sim'; give what"):
        cs.coppeliasim.attach("sim", "/Robot", tiny_simulator)


def test_the_check_list_runs(server: StandIn, capsys: pytest.CaptureFixture[str]) -> None:
    """What is offered to those who have the simulator: all right here, wrong where mirrored."""
    check = runpy.run_path(str(Path(__file__).parents[3] / "examples" / "coppeliasim_check.py"))
    before = set(server.things)
    check["main"](server.port)
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == "all as it should be"
    assert all(line.startswith("ok") for line in lines[:-1])
    server.mirrored = True
    with pytest.raises(SystemExit, match="checks failed"):
        check["main"](server.port)
    assert "WRONG  the glass block is in its place" in capsys.readouterr().out
    assert set(server.things) == before
    assert not server.collections


def test_what_draws_nothing_is_told(
    server: StandIn, sim: Any, tiny_simulator: cs.Simulator
) -> None:
    """A build without OpenGL answers all calls, and its images stay empty."""
    put(server, "block")
    sensor = cs.coppeliasim.attach(sim, "/Robot/flange", tiny_simulator)
    sim.startSimulation()
    sensor.read()
    server.headless = True
    with pytest.raises(cs.AdapterError, match=r"draws nothing .*without OpenGL"):
        sensor.read()


def test_a_collection_that_is_gone_is_made_anew(
    server: StandIn, sim: Any, tiny_simulator: cs.Simulator
) -> None:
    """It goes with the script of the connection; what is left out stays left out."""
    put(server, "block")
    screen = put(server, "screen", cs.Box((0.08, 0.08, 0.001)), cs.Pose((0, 0, 0.01)))
    sensor = cs.coppeliasim.attach(sim, "/Robot/flange", tiny_simulator, exclude=["screen"])
    sim.startSimulation()
    before = sensor.read().delta
    server.collections.clear()
    assert sensor.read().delta == approx(before)
    (hidden,) = server.collections.values()
    assert hidden == {screen}
    server.collections.clear()
    sensor.remove()


def test_one_call_a_read(server: StandIn, sim: Any, tiny_simulator: cs.Simulator) -> None:
    """By a script at the vision sensor, which goes with it; the same reading without one."""
    put(server, "block")
    sensor = cs.coppeliasim.attach(sim, "/Robot/flange", tiny_simulator)
    sim.startSimulation()
    server.calls.clear()
    expected = sensor.read().delta
    assert server.calls == ["sim.callScriptFunction"]
    server.script_fails = True
    assert np.array_equal(sensor.read().delta, expected)
    server.calls.clear()
    assert np.array_equal(sensor.read().delta, expected)
    assert server.calls == [
        "sim.getSimulationState", "sim.handleVisionSensor", "sim.getVisionSensorDepth",
        "sim.getVisionSensorImg",
    ]  # fmt: skip
    things = len(server.things)
    sensor.remove()
    assert len(server.things) == things - 2


def test_a_simulator_that_makes_no_scripts(tiny_simulator: cs.Simulator) -> None:
    """CoppeliaSim 4.6 reads by several calls."""
    server = StandIn(without=("createScript",))
    server.add("pad")
    sim = cs.coppeliasim.connect(port=server.port, timeout=5.0)
    sensor = cs.coppeliasim.attach(sim, "/pad", tiny_simulator)
    sim.startSimulation()
    assert not sensor.read().delta.any()
    assert "sim.callScriptFunction" not in server.calls
    server.close()


def test_the_adapter_says_once_that_it_is_experimental(
    server: StandIn, sim: Any, tiny_simulator: cs.Simulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the first use in a process."""
    monkeypatch.setattr(errors, "_warned", set())
    put(server, "block")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(2):
            cs.coppeliasim.attach(sim, "/Robot/flange", tiny_simulator, resolution=100)
    said = [w for w in caught if issubclass(w.category, cs.ExperimentalWarning)]
    assert len(said) == 1
    assert "stand-in" in str(said[0].message)
    assert said[0].filename == __file__
