"""The view without a browser: what it hands to the page."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser", reason='needs viser: pip install "capsense[view]"')

from recorded_scenes import SLAB, bodies, frame_at, scene_at
from view_nodes import nodes_of
from view_sources import Queued, until

import capsense as cs
from capsense._style import LOUD, QUIET
from capsense.errors import ProtocolError, ServerError
from capsense.reading import Touch
from capsense.viewer.appearance import colour_of
from capsense.viewer.plane import Plane, region
from capsense.viewer.player import Follower
from capsense.viewer.scene_drawing import APART, ARROW, FAR, SHADES, SceneDrawing
from capsense.viewer.view import LiveView, check_address


@pytest.fixture(scope="module")
def server() -> Iterator[Any]:
    from viser import ViserServer

    server = ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield server
    server.stop()


def nodes(server: Any, under: str) -> list[str]:
    return sorted(n for n in nodes_of(server) if n.startswith(under))


@pytest.mark.parametrize("name", ["six_patch", "meander", "stripe", "arm_segment"])
def test_designs(server: Any, name: str) -> None:
    """Every electrode, conductor and layer is a node of its own."""
    server.scene.reset()
    design = cs.load_design(name)
    SceneDrawing(server, design)
    assert len(nodes(server, "/axes/")) == 3
    for under, parts in (
        ("/electrodes/", design.electrodes), ("/conductors/", design.conductors),
        ("/layers/", design.layers), ("/labels/", design.electrodes),
    ):  # fmt: skip
        assert len(nodes(server, under)) == len(parts)
    at = server.initial_camera.position
    assert at[2] > 0


def test_bodies_of_every_shape(server: Any) -> None:
    """They stand where their poses say; those that only move are not made anew."""
    server.scene.reset()
    stage = SceneDrawing(server, cs.load_design("six_patch"))
    scene = scene_at(0)
    stage.show_bodies(scene)
    assert len(nodes(server, "/bodies/")) == len(bodies())
    handles = nodes_of(server)
    moved = cs.Scene([b.moved(cs.Pose((0.01, 0.02, 0.1), b.pose.quaternion)) for b in scene])
    stage.show_bodies(moved)
    for k, body in enumerate(moved):
        handle = nodes_of(server)[f"/bodies/{k}"]
        assert handle is handles[f"/bodies/{k}"]
        np.testing.assert_allclose(handle.position, (0.01, 0.02, 0.1))
        np.testing.assert_allclose(handle.wxyz, np.roll(body.pose.quaternion, 1))
    stage.show_bodies(scene_at(2))  # one is missing
    assert len(nodes(server, "/bodies/")) == len(bodies()) - 1
    stage.show_bodies(cs.Scene())
    assert nodes(server, "/bodies/") == []


def test_one_label_a_conductor(server: Any) -> None:
    """Parts of one conductor bear its name once; other bodies their own."""
    server.scene.reset()
    stage = SceneDrawing(server, cs.load_design("six_patch"))
    parts = [
        cs.Body(cs.Sphere(0.01), cs.Pose((0.03 * k, 0, 0.1)), name=f"b{k}", conductor=conductor)
        for k, conductor in enumerate(("hand", "hand", None, "other", "hand"))
    ]
    stage.show_bodies(cs.Scene([*parts, cs.Body(cs.Sphere(0.01), cs.Pose((0, 0, 0.2)))]))
    found = nodes_of(server)
    labels = {name: found[name].text for name in nodes(server, "/names/")}
    assert labels == {"/names/0": "hand", "/names/2": "b2", "/names/3": "other"}
    assert len(nodes(server, "/bodies/")) == 6


def test_depth_images(server: Any) -> None:
    """A dot for each pixel, where the camera saw it."""
    server.scene.reset()
    stage = SceneDrawing(server, cs.load_design("six_patch"))
    frame = frame_at(0)
    scene = frame.scene()
    stage.show_bodies(scene)
    found = 0
    for k, body in enumerate(scene):
        handle = nodes_of(server)[f"/bodies/{k}"]
        points = body.pose.apply(handle.points.astype(float))
        distance = body.shape.signed_distance(handle.points.astype(float))
        assert np.abs(distance).max() < 2e-3
        assert (points[:, 2] > 0.05).all()
        found += len(points)
    assert found == np.isfinite(frame.depth).sum()
    stage.show_bodies(cs.Scene([cs.Body(SLAB, material="steel")]))
    assert len(nodes_of(server)["/bodies/0"].points) == 48


def test_deforming_surfaces(server: Any) -> None:
    """Triangles, from both sides, where they are now."""
    server.scene.reset()
    stage = SceneDrawing(server, cs.load_design("six_patch"))
    foil = cs.DeformableSurface(0.1 * np.eye(3), [[0, 1, 2]], material="steel")
    for k in range(2):
        foil.vertices = np.eye(3) * (0.1 + 0.1 * k)
        stage.show_bodies(cs.Scene([foil.body()]))
        handle = nodes_of(server)["/bodies/0"]
        np.testing.assert_allclose(handle.vertices, foil.vertices, rtol=1e-6)
        assert handle.side == "double"


def test_signals(server: Any) -> None:
    """From quiet to loud, and no further; light does not change the colours.

    One node an electrode holds it in all colours; that of the signal is where the electrode is.
    """
    server.scene.reset()
    design = cs.load_design("patch")
    stage = SceneDrawing(server, design)
    handles = [nodes_of(server)[f"/electrodes/{k}"] for k in range(4)]
    stage.show_signals(np.array([0.0, 0.5, 1.0, 7.0]))
    assert [-h.position[2] / APART for h in handles] == [0, 16, SHADES, SHADES]
    stage.show_signals(np.zeros(4))
    assert all(not h.position.any() and h.visible for h in handles)
    assert [nodes_of(server)[f"/electrodes/{k}"] for k in range(4)] == handles
    data = handles[0].glb_data
    length = int.from_bytes(data[12:16], "little")
    gltf = json.loads(data[20 : 20 + length])
    assert len(gltf["nodes"]) >= SHADES + 1
    at = {}
    for node in gltf["nodes"]:
        if "mesh" in node:
            height = node.get("matrix", [0.0] * 16)[14]
            material = gltf["meshes"][node["mesh"]]["primitives"][0]["material"]
            at[round(height / APART)] = gltf["materials"][material]
    assert sorted(at) == list(range(SHADES + 1))
    assert APART > 10 * FAR
    for shade, colour in ((0, QUIET), (SHADES, LOUD)):
        assert at[shade]["extensions"] == {"KHR_materials_unlit": {}}
        linear = np.array(at[shade]["pbrMetallicRoughness"]["baseColorFactor"][:3])
        srgb = np.where(linear < 0.0031, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        np.testing.assert_allclose(255 * srgb, colour, atol=3)


def test_force_is_an_arrow(server: Any) -> None:
    """Onto the electrode, longest for the largest force so far; none where nothing presses."""
    server.scene.reset()
    design = cs.load_design("patch")
    stage = SceneDrawing(server, design)
    stage.show_touch(None)
    assert "/touch" not in nodes_of(server)
    nothing = np.zeros(4)
    stage.show_touch(Touch(np.array([0.0, 2.0, 0.5, 0.0]), nothing, 2.5))
    arrows = nodes_of(server)["/touch"]
    tails, tips = arrows.points.astype(float).transpose(1, 0, 2)
    middles = np.array([e.surface.bounds.mean(axis=0) for e in design.electrodes])
    np.testing.assert_allclose(tips, middles[1:3], atol=1e-6)
    np.testing.assert_allclose(tails - tips, [[0, 0, ARROW], [0, 0, ARROW / 4]], atol=1e-6)
    stage.show_touch(Touch(nothing, nothing, 0.0))
    assert not arrows.visible
    stage.show_touch(Touch(np.array([1.0, 0.0, 0.0, 0.0]), nothing, 1.0))
    assert nodes_of(server)["/touch"].visible
    assert len(arrows.points) == 1


@pytest.mark.parametrize("material", ["steel", "human", "wood", "PLA", "water"])
def test_bodies_have_the_colour_of_their_material(server: Any, material: str) -> None:
    server.scene.reset()
    stage = SceneDrawing(server, cs.load_design("patch"))
    ball = cs.Body(cs.Sphere(0.02), cs.Pose((0, 0, 0.1)), material)
    stage.show_bodies(cs.Scene([ball]))
    assert tuple(nodes_of(server)["/bodies/0"].color) == colour_of(ball.material)


def test_plane(server: Any) -> None:
    """Lines of equal potential on the plane; none once they are hidden."""
    server.scene.reset()
    simulator = cs.Simulator("six_patch")
    stage = SceneDrawing(server, simulator.design)
    plane = Plane(simulator.background.green, region(simulator.design), 1, 0.0)
    reading = simulator.step(cs.Scene(), keep_field=True)
    stage.show_plane(plane, reading.potentials(plane.points)[:, 1])
    lines = nodes_of(server)["/potential"]
    assert len(lines.points) > 1000
    assert np.abs(lines.points[..., 1].astype(float)).max() == 0
    stage.hide("/potential")
    assert "/potential" not in nodes_of(server)
    stage.hide("/potential")


def test_charges(server: Any) -> None:
    """On the surface of the ball, the densest nearest to the electrode; none without a body."""
    server.scene.reset()
    simulator = cs.Simulator("six_patch")
    stage = SceneDrawing(server, simulator.design)
    x, y, _ = simulator.design.electrodes[1].surface.bounds.mean(axis=0)
    ball = cs.Body(cs.Sphere(0.02), cs.Pose((x, y, 0.04)), "steel", name="ball")
    scene = cs.Scene([ball])
    charges = simulator.step(scene, keep_field=True).charges()
    assert charges is not None
    stage.show_bodies(scene)
    stage.show_charges(charges, 1)
    cloud = nodes_of(server)["/charge"]
    points = cloud.points.astype(float)
    radius = np.linalg.norm(points - ball.pose.position, axis=1)
    np.testing.assert_allclose(radius, 0.02, atol=1.5e-3)  # a mesh stands for the sphere
    darkest = points[np.argmin(cloud.colors.astype(int).sum(axis=1))]
    assert darkest[2] < 0.025
    assert nodes(server, "/names/") == ["/names/0"]
    assert simulator.step(cs.Scene(), keep_field=True).charges() is None
    stage.show_charges(None, 1)
    assert "/charge" not in nodes_of(server)


def test_live_controls() -> None:
    """Hold and follow; the slider spans what is kept; what is wrong is said, as text."""
    stream = Queued()
    player = Follower(stream)  # type: ignore[arg-type]
    view = LiveView(player, port=0)
    try:
        view.refresh()
        stream.put(7)
        until(lambda: player.span == (0, 6))
        view.refresh()
        controls = view.time
        assert (controls.play.label, controls.slider.max, controls.slider.value) == (
            "Hold",
            6,
            6,
        )
        assert "sample 6 of 6" in view.status.content
        player.go(2)
        view.refresh()
        assert (controls.play.label, controls.slider.value) == ("Follow", 2)
        player.failure = ProtocolError("<b>gone</b>")
        view.refresh()
        assert "&lt;b&gt;gone" in view.status.content
    finally:
        view.stop()
        player.stop()


def test_address_that_is_taken() -> None:
    """It is named before anything else is done."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ServerError, match=f"cannot listen at 127.0.0.1, port {port}"):
            check_address("127.0.0.1", port)
        with pytest.raises(ServerError, match="another --host or --port"):
            LiveView(None, port=port)  # type: ignore[arg-type]


@pytest.mark.parametrize(("host", "port"), [("127.0.0.1", 70000), ("no.such.host.invalid", 0)])
def test_address_that_is_none(host: str, port: int) -> None:
    """Neither a port nor a host of that name."""
    with pytest.raises(ServerError, match="cannot listen"):
        check_address(host, port)
