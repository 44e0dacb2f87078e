"""The view without a browser: what it hands to the page."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser", reason='needs viser: pip install "capsense[view]"')

from recorded_scenes import SLAB, bodies, frame_at, scene_at
from view_sources import Queued, until

import capsense as cs
from capsense.errors import ProtocolError, ServerError
from capsense.viewer.follower import Follower
from capsense.viewer.plane import Plane, region
from capsense.viewer.stage import LOUD, QUIET, Stage
from capsense.viewer.view import View, check_address


@pytest.fixture(scope="module")
def server() -> Iterator[Any]:
    from viser import ViserServer

    server = ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield server
    server.stop()


def nodes(server: Any, under: str) -> list[str]:
    return sorted(n for n in server.scene._handle_from_node_name if n.startswith(under))


@pytest.mark.parametrize("name", ["six_patch", "meander", "stripe", "arm_segment"])
def test_designs(server: Any, name: str) -> None:
    """Every electrode, conductor and layer is a node of its own."""
    server.scene.reset()
    design = cs.load_design(name)
    Stage(server, design)
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
    stage = Stage(server, cs.load_design("six_patch"))
    scene = scene_at(0)
    stage.show_bodies(scene)
    assert len(nodes(server, "/bodies/")) == len(bodies())
    handles = dict(server.scene._handle_from_node_name)
    moved = cs.Scene([b.moved(cs.Pose((0.01, 0.02, 0.1), b.pose.quaternion)) for b in scene])
    stage.show_bodies(moved)
    for k, body in enumerate(moved):
        handle = server.scene._handle_from_node_name[f"/bodies/{k}"]
        assert handle is handles[f"/bodies/{k}"]
        np.testing.assert_allclose(handle.position, (0.01, 0.02, 0.1))
        np.testing.assert_allclose(handle.wxyz, np.roll(body.pose.quaternion, 1))
    stage.show_bodies(scene_at(2))  # one is missing
    assert len(nodes(server, "/bodies/")) == len(bodies()) - 1
    stage.show_bodies(cs.Scene())
    assert nodes(server, "/bodies/") == []


def test_depth_images(server: Any) -> None:
    """A dot for each pixel, where the camera saw it."""
    server.scene.reset()
    stage = Stage(server, cs.load_design("six_patch"))
    frame = frame_at(0)
    scene = frame.scene()
    stage.show_bodies(scene)
    found = 0
    for k, body in enumerate(scene):
        handle = server.scene._handle_from_node_name[f"/bodies/{k}"]
        points = body.pose.apply(handle.points.astype(float))
        distance = body.shape.signed_distance(handle.points.astype(float))
        assert np.abs(distance).max() < 2e-3
        assert (points[:, 2] > 0.05).all()
        found += len(points)
    assert found == np.isfinite(frame.depth).sum()
    stage.show_bodies(cs.Scene([cs.Body(SLAB, material="steel")]))
    assert len(server.scene._handle_from_node_name["/bodies/0"].points) == 48


def test_deforming_surfaces(server: Any) -> None:
    """Triangles, from both sides, where they are now."""
    server.scene.reset()
    stage = Stage(server, cs.load_design("six_patch"))
    foil = cs.DeformableSurface(0.1 * np.eye(3), [[0, 1, 2]], material="steel")
    for k in range(2):
        foil.vertices = np.eye(3) * (0.1 + 0.1 * k)
        stage.show_bodies(cs.Scene([foil.body()]))
        handle = server.scene._handle_from_node_name["/bodies/0"]
        np.testing.assert_allclose(handle.vertices, foil.vertices, rtol=1e-6)
        assert handle.side == "double"


def test_signals(server: Any) -> None:
    """From quiet to loud, and no further."""
    server.scene.reset()
    stage = Stage(server, cs.load_design("patch"))
    stage.show_signals(np.array([0.0, 0.5, 1.0, 7.0]))
    colours = [server.scene._handle_from_node_name[f"/electrodes/{k}"].color for k in range(4)]
    assert tuple(colours[0]) == QUIET
    assert tuple(colours[2]) == tuple(colours[3]) == LOUD
    np.testing.assert_allclose(colours[1], (np.array(QUIET) + LOUD) / 2, atol=1)


def test_plane(server: Any) -> None:
    """Points where the potential is worth showing; none once it is hidden."""
    server.scene.reset()
    simulator = cs.Simulator("six_patch")
    stage = Stage(server, simulator.design)
    plane = Plane(simulator.background.green, region(simulator.design), 1, 0.0)
    simulator.step(cs.Scene())
    stage.show_plane(plane, simulator.potentials(plane.points)[:, 1])
    cloud = server.scene._handle_from_node_name["/potential"]
    assert 1000 < len(cloud.points) < len(plane.drawn)
    assert np.abs(cloud.points[:, 1].astype(float)).max() == 0
    stage.hide_plane()
    assert "/potential" not in server.scene._handle_from_node_name
    stage.hide_plane()


def test_live_controls() -> None:
    """Hold and follow; the slider spans what is kept; what is wrong is said, as text."""
    stream = Queued()
    player = Follower(stream)  # type: ignore[arg-type]
    view = View(player, port=0)
    try:
        view.refresh()
        stream.put(7)
        until(lambda: player.span == (0, 6))
        view.refresh()
        controls = view._time
        assert (controls._play.label, controls._slider.max, controls._slider.value) == (
            "Hold",
            6,
            6,
        )
        assert "sample 6 of 6" in view._status.content
        player.go(2)
        view.refresh()
        assert (controls._play.label, controls._slider.value) == ("Follow", 2)
        player.failure = ProtocolError("<b>gone</b>")
        view.refresh()
        assert "&lt;b&gt;gone" in view._status.content
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
            View(None, port=port)  # type: ignore[arg-type]


@pytest.mark.parametrize(("host", "port"), [("127.0.0.1", 70000), ("no.such.host.invalid", 0)])
def test_address_that_is_none(host: str, port: int) -> None:
    """Neither a port nor a host of that name."""
    with pytest.raises(ServerError, match="cannot listen"):
        check_address(host, port)
