"""Layouts of electrodes on links: where they are, which way they face, what they read."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from approximate import approx
from scipy.spatial.distance import pdist

import capsense as cs

RADIUS = 0.048


def cylinder(sections: int = 96) -> trimesh.Trimesh:
    """A closed link of 250 mm length along z."""
    return trimesh.creation.cylinder(RADIUS, 0.25, sections=sections)


def blob() -> trimesh.Trimesh:
    """A smooth link without any symmetry."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=1.0)
    x, y, z = ball.vertices.T
    grown = 1 + 0.15 * np.tanh(2 * x + y) + 0.1 * np.sin(z + 0.7)
    ball.vertices = ball.vertices * grown[:, None] * (0.05, 0.065, 0.12) + (0.01, 0.0, 0.0)
    return ball


def positions(layout: cs.skin.SkinLayout) -> np.ndarray:
    return np.array([pose.position for _, pose in layout.values()])


def normals(layout: cs.skin.SkinLayout) -> np.ndarray:
    return np.array([pose.rotation[:, 2] for _, pose in layout.values()])


def test_positions_lie_on_the_mesh_and_normals_point_out() -> None:
    layout = cs.skin.from_mesh(blob(), count=80)
    surface = cs.TriMesh(blob().vertices, blob().faces)
    at, out = positions(layout), normals(layout)
    assert np.abs(surface.signed_distance(at)).max() < 1e-9
    np.testing.assert_allclose(surface.signed_distance(at + 1e-3 * out), 1e-3, rtol=0.02)
    for _, pose in layout.values():
        np.testing.assert_allclose(pose.rotation.T @ pose.rotation, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("count", [10, 60, 150])
def test_spacing_is_even(count: int) -> None:
    """Farthest points are as far apart as the discs that as many must cover the surface with."""
    layout = cs.skin.from_mesh(blob(), count=count, patch=cs.skin.Pad(0.006))
    least = math.sqrt(blob().area / (math.pi * count))
    assert len(layout) == count
    assert pdist(positions(layout)).min() > least


def test_spacing_is_kept_and_leaves_no_room() -> None:
    """As many as fit: no place of the surface is farther than the spacing from a patch."""
    layout = cs.skin.from_mesh(blob(), spacing=0.025)
    assert pdist(positions(layout)).min() >= 0.025
    points = blob().triangles_center
    far = np.linalg.norm(points[:, None] - positions(layout), axis=2).min(axis=1)
    assert far.max() < 0.030


def test_turning_and_moving_the_link_turns_and_moves_the_patches() -> None:
    pose = cs.Pose((0.3, -0.2, 0.1), (0.3, -0.5, 0.2, 0.8))
    moved = blob()
    moved.vertices = pose.apply(moved.vertices)
    layout, other = (cs.skin.from_mesh(m, count=40) for m in (blob(), moved))
    for (design, here), (same, there) in zip(layout.values(), other.values(), strict=True):
        np.testing.assert_allclose((pose @ here).matrix, there.matrix, atol=1e-6)
        assert design.content_hash() == same.content_hash()


def test_inner_walls_and_edges_carry_nothing() -> None:
    """A tube within a closed tube is not reached, and patches keep off the rims of the lids."""
    inner = trimesh.creation.cylinder(RADIUS - 0.004, 0.24, sections=96)
    inner.invert()
    shell = trimesh.util.concatenate([cylinder(), inner])
    layout = cs.skin.from_mesh(shell, count=60)
    at = positions(layout)
    off = cs.TriMesh(cylinder().vertices, cylinder().faces).signed_distance(at)
    assert np.abs(off).max() < 1e-9
    lid = np.abs(at[:, 2]) > 0.125 - 1e-9
    assert np.hypot(*at[lid, :2].T).max() < RADIUS - 0.005
    assert np.abs(at[~lid, 2]).max() < 0.125 - 0.005
    assert max(layout.deviation.values()) < 2e-4


def test_region() -> None:
    box = ((-1, -1, -0.05), (1, 1, 0.05))
    by_box = cs.skin.from_mesh(cylinder(), count=20, region=box)
    by_rule = cs.skin.from_mesh(
        cylinder(), count=20, region=lambda points, _: np.abs(points[:, 2]) <= 0.05
    )
    np.testing.assert_array_equal(positions(by_box), positions(by_rule))
    assert np.abs(positions(by_box)[:, 2]).max() <= 0.05


def test_round_links_take_one_bent_design_of_their_radius() -> None:
    layout = cs.skin.from_mesh(cylinder(), count=30, region=((-1, -1, -0.1), (1, 1, 0.1)))
    designs = {id(d): d for d, _ in layout.values()}
    assert len(designs) == 1
    film = next(iter(designs.values())).film
    assert film is not None
    assert film.radius == approx(RADIUS, rel=1e-12)
    along = np.array([pose.rotation[:, 1] for _, pose in layout.values()])
    assert np.abs(along[:, 2]).min() > 0.999
    assert "1 distinct designs" in repr(layout)
    assert "30 patches, 30 electrodes" in repr(layout)


@pytest.mark.e2e
def test_a_patch_reads_what_its_design_reads_where_it_is_placed_by_hand() -> None:
    out = np.array([[math.cos(0.7), math.sin(0.7), 0.0]])
    layout = cs.skin.from_taxels(RADIUS * out, out, link=cylinder(), patch="arm_segment")
    name, (design, pose) = next(iter(layout.items()))
    x, y, z = pose.position
    long = math.copysign(1.0, pose.rotation[2, 1])
    n = np.array([x, y, 0.0]) / math.hypot(x, y)
    axes = np.column_stack([np.cross((0, 0, long), n), (0, 0, long), n])
    turn = cs.Pose.from_matrix(axes)
    hand = cs.Pose((RADIUS * n[0], RADIUS * n[1], z), turn.quaternion)
    ball = cs.Body(cs.Sphere(0.03), cs.Pose(hand.apply([(0.01, 0.005, 0.05)])[0]))
    link = cs.Pose((0.2, 0.1, 0.4), (0.1, 0.2, 0.3, 0.9))
    skin = cs.Skin({name: layout[name], "hand": (design, hand)})
    scene = cs.Scene([ball.moved(link @ ball.pose)])
    read = skin.step(scene, {name: layout.poses(link)[name], "hand": link @ hand})
    assert read["hand"].delta[0, 0] > 1e-16
    gains = np.diag(read["hand"].delta)
    np.testing.assert_allclose(np.diag(read[name].delta), gains, atol=0.02 * gains.max())


def test_patches_inside_neighbours_are_left_out() -> None:
    layout = cs.skin.from_mesh(cylinder(), count=40)
    ball = cs.Body(cs.Sphere(0.06), cs.Pose((0, 0, 0.13)), name="elbow")
    clear = layout.clear_of(cs.Scene([ball]))
    inside = np.linalg.norm(positions(layout) - (0, 0, 0.13), axis=1) < 0.055
    assert set(clear.left_out) >= {n for n, i in zip(layout, inside, strict=True) if i}
    assert "inside 'elbow'" in next(iter(clear.left_out.values()))
    assert 0 < len(clear) < 40
    with pytest.raises(cs.SceneError, match="all 40 patches lie inside other bodies"):
        layout.clear_of(cs.Scene([cs.Body(cs.Sphere(0.4))]))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "neither count nor spacing"),
        ({"count": 0}, "whole number from 1"),
        ({"count": 9000}, "decrease count, spacing or"),
        ({"count": 5, "spacing": 0.005}, "would overlap"),
        ({"count": 5, "unit": "km"}, "unit is 'km'"),
        ({"count": 5, "region": 3}, "lower and the upper corner"),
    ],
)
def test_wrong_options(options: dict, message: str) -> None:
    with pytest.raises(cs.SceneError, match=message):
        cs.skin.from_mesh(cylinder(), **options)


def test_wrong_pads() -> None:
    with pytest.raises(cs.SceneError, match="size is -1"):
        cs.skin.Pad(-1)
    with pytest.raises(cs.SceneError, match="'shield' or 'ground'"):
        cs.skin.Pad(housing="floating")  # type: ignore[arg-type]


def test_wrong_links(tmp_path: Path) -> None:
    with pytest.raises(cs.SceneError, match="no mesh file"):
        cs.skin.from_mesh(tmp_path / "none.stl", count=3)
    with pytest.raises(cs.SceneError, match="give the path of a mesh file"):
        cs.skin.from_mesh(3, count=3)
    big = cylinder()
    big.apply_scale(1000)
    with pytest.raises(cs.SceneError, match="unit='mm'"):
        cs.skin.from_mesh(big, count=3)
    big.export(tmp_path / "link.stl")
    layout = cs.skin.from_mesh(tmp_path / "link.stl", count=3, unit="mm")
    assert np.abs(positions(layout)).max() < 0.13


def test_painted_faces_become_electrodes() -> None:
    """A square and a ring on a box: areas, places and normals are those that were painted."""
    mesh = trimesh.creation.box((0.1, 0.06, 0.04))
    for _ in range(4):
        mesh = mesh.subdivide()
    middle = mesh.triangles_center
    top = middle[:, 2] > 0.0199
    x, y = middle[:, :2].T
    square = top & (x < -0.0125) & (np.abs(y) < 0.015)
    ring = (
        top & (x > 0.0125) & (np.abs(y) < 0.0225) & ~((np.abs(x - 0.03) < 0.006) & (abs(y) < 0.01))
    )
    mask = np.where(square, 1, np.where(ring, 2, 0))
    layout = cs.skin.paint(mesh, mask)
    assert list(layout) == ["region_1", "region_2"]
    for name, painted in (("region_1", square), ("region_2", ring)):
        design, pose = layout[name]
        area = mesh.area_faces[painted].sum()
        assert design.electrodes[0].surface.area == approx(area, rel=1e-3)
        np.testing.assert_allclose(pose.rotation[:, 2], (0, 0, 1), atol=1e-9)
        bounds = mesh.vertices[mesh.faces[painted]].reshape(-1, 3)
        placed = pose.apply(design.electrodes[0].surface.triangles.reshape(-1, 3))
        np.testing.assert_allclose(placed.min(axis=0), bounds.min(axis=0), atol=3e-5)
        np.testing.assert_allclose(placed.max(axis=0), bounds.max(axis=0), atol=3e-5)


def test_congruent_painted_regions_share_a_design() -> None:
    """Alike on all sides of a round link, also turned half round; others have their own."""
    link = cylinder()
    mesh = link.subdivide_to_size(0.008)
    middle = mesh.triangles_center
    angle, z = np.arctan2(middle[:, 1], middle[:, 0]), middle[:, 2]
    mask = np.zeros(len(mesh.faces), int)
    alike = {1: (0.0, 1.0), 2: (0.5 * np.pi, 1.0), 3: (-0.5 * np.pi, -1.0)}
    for label, (turn, side) in alike.items():
        off = side * (np.mod(angle - turn + np.pi, 2 * np.pi) - np.pi)
        up = side * z
        wedge = (np.abs(off) < 0.3) & (np.abs(up) < 0.03) & ((off < 0.0) | (up > 0.0))
        mask[wedge] = label
    mask[(np.abs(np.abs(angle) - np.pi) < 0.2) & (np.abs(z) < 0.02)] = 4
    layout = cs.skin.paint(mesh, mask)
    designs = [layout[f"region_{k}"][0] for k in (1, 2, 3, 4)]
    assert designs[0] is designs[1] is designs[2]
    assert designs[3] is not designs[0]
    surface = cs.TriMesh(link.vertices, link.faces)
    for label in (1, 2, 3, 4):
        design, pose = layout[f"region_{label}"]
        corners = pose.apply(design.electrodes[0].surface.triangles.reshape(-1, 3))
        painted = mesh.triangles[mask == label].reshape(-1, 3)
        np.testing.assert_allclose(corners.min(axis=0), painted.min(axis=0), atol=4e-4)
        np.testing.assert_allclose(corners.max(axis=0), painted.max(axis=0), atol=4e-4)
        assert np.abs(surface.signed_distance(corners)).max() < 4e-4


def test_painted_regions_of_a_round_link_unroll() -> None:
    """Two separate regions of one label; each is bent onto the link's radius."""
    heights = np.linspace(-0.125, 0.125, 51)
    outline = [(0.0, -0.125), *[(RADIUS, z) for z in heights], (0.0, 0.125)]
    mesh = trimesh.creation.revolve(outline, sections=96)
    x, y, z = mesh.triangles_center.T
    side = np.hypot(x, y) > 0.9 * RADIUS
    mask = side & (np.abs(np.arctan2(y, x)) < 0.4) & (np.abs(np.abs(z) - 0.06) < 0.03)
    layout = cs.skin.paint(mesh, mask)
    assert list(layout) == ["region_1_0", "region_1_1"]
    total = sum(d.electrodes[0].surface.area for d, _ in layout.values())
    assert total == approx(mesh.area_faces[mask].sum(), rel=0.01)
    for design, _ in layout.values():
        assert design.film is not None
        assert design.film.radius == approx(RADIUS, rel=0.01)
    assert max(layout.deviation.values()) < 2e-4


def test_colours_of_a_file(tmp_path: Path) -> None:
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.08)
    red = mesh.vertices[:, 2] > 0.07
    mesh.visual.vertex_colors = np.where(red[:, None], (255, 0, 0, 255), (200, 200, 200, 255))
    mesh.export(tmp_path / "link.ply")
    with pytest.warns(UserWarning, match="leave the surface"):
        layout = cs.skin.paint(tmp_path / "link.ply")
    assert len(layout) == 1
    np.testing.assert_allclose(normals(layout)[0], (0, 0, 1), atol=0.02)


def test_wrong_masks() -> None:
    mesh = cylinder()
    for mask, message in (
        (np.zeros(len(mesh.faces), int), "paints nothing"),
        (np.ones(7, int), "a label for each of the"),
        (np.full(len(mesh.faces), 0.5), "whole numbers or booleans"),
        (np.abs(mesh.triangles_center[:, 2]) < 0.12, "goes round the link"),
    ):
        with pytest.raises(cs.SceneError, match=message):
            cs.skin.paint(mesh, mask)
    with pytest.raises(cs.SceneError, match="no colours"):
        cs.skin.paint(cs.TriMesh(mesh.vertices, mesh.faces))


CSV = "name,x,y,z,nx,ny,nz\nfirst,0.01,0,0.02,0,0,2\nsecond,0.02,0,0.02,0,0,1\n"
POSITIONS = (
    "name l_forearm\nspatial_sampling taxel\ntaxel2Repr ( 0 -1 )\n[calibration]\n"
    "0.01\t0\t0.02\t0\t0\t2\n0 0 0 0 0 0\n0.02 0 0.02 0 0 1\n0.01 0 0.02 0 0 1\n"
)


@pytest.mark.parametrize(
    ("name", "text", "names"),
    [
        ("a.csv", CSV, ["first", "second"]),
        ("a.txt", POSITIONS, ["taxel_0", "taxel_2"]),
        ("a.ini", POSITIONS, ["taxel_0", "taxel_2"]),
    ],
)
def test_taxel_files(tmp_path: Path, name: str, text: str, names: list[str]) -> None:
    (tmp_path / name).write_text(text)
    pose = cs.Pose((0, 0, 0.1), (0, 0, 1, 1))
    layout = cs.skin.from_taxels(tmp_path / name, pose=pose)
    assert list(layout) == names
    np.testing.assert_allclose(positions(layout), [(0, 0.01, 0.12), (0, 0.02, 0.12)], atol=1e-12)
    np.testing.assert_allclose(normals(layout), [(0, 0, 1)] * 2, atol=1e-12)
    if name != "a.csv":
        assert layout.left_out == {
            "taxel_1": "a line of zeros, no taxel", "taxel_3": "at the place of 'taxel_0'",
        }  # fmt: skip


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.csv", CSV.replace("nz", "mz"), "line 1: there is no column 'nz'"),
        ("a.csv", CSV.replace("0.02,0,0.02", "x,0,0.02"), "line 3: .* are not all numbers"),
        ("a.csv", CSV.replace("0,0,2", "0,0,0"), "line 2: the normal .* has no length"),
        ("a.csv", CSV.replace("0,0,2", "0,0,nan"), "line 2: .* are not all finite"),
        ("a.csv", CSV.replace("second", "first"), "two taxels named 'first'"),
        ("a.csv", CSV + "third,1,2\n", "line 4: there are 3 cells, not 7"),
        ("a.csv", CSV.replace("0.02,0,0.02", "0.02,0,20"), "set unit"),
        ("a.csv", "name,x,y,z,nx,ny,nz\n", "holds no taxel"),
        ("a.txt", POSITIONS.replace("[calibration]", ""), "has no .calibration. section"),
        ("a.txt", POSITIONS.replace("0 0 0 0 0 0", "0 0 0"), "line 6: there are 3 numbers"),
        ("a.dat", CSV, "is no .csv, .txt or .ini file"),
    ],
)
def test_wrong_taxel_files(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(cs.SceneError, match=message):
        cs.skin.from_taxels(tmp_path / name)
    with pytest.raises(cs.SceneError, match="there is no taxel file"):
        cs.skin.from_taxels(tmp_path / "none.csv")


def test_taxels_bend_with_the_link() -> None:
    angle = np.linspace(0, 6, 12)
    out = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    bent = cs.skin.from_taxels(RADIUS * out, out, link=cylinder(), patch=cs.skin.Pad())
    flat = cs.skin.from_taxels(RADIUS * out, out, patch=cs.skin.Pad())
    assert all(d.film is not None and d.film.radius == RADIUS for d, _ in bent.values())
    assert all(d.film is None for d, _ in flat.values())
    np.testing.assert_allclose(normals(flat), out, atol=1e-12)
    np.testing.assert_allclose(normals(bent), out, atol=0.03)
    assert bent.deviation
    assert not flat.deviation
    with pytest.raises(cs.SceneError, match="normals are missing"):
        cs.skin.from_taxels(RADIUS * out)
    with pytest.raises(cs.SceneError, match="have shapes"):
        cs.skin.from_taxels(RADIUS * out, out[:3])


URDF = """<robot name="r">
  <link name="base"/><link name="arm"/><link name="cover"/>
  <link name="skin_0"/><link name="skin_1"/><link name="tip_0"/>
  <joint name="a" type="revolute"><parent link="base"/><child link="arm"/></joint>
  <joint name="b" type="fixed"><parent link="arm"/><child link="cover"/>
    <origin xyz="0 0 0.1" rpy="0 0 1.5707963267948966"/></joint>
  <joint name="c" type="fixed"><parent link="cover"/><child link="skin_0"/>
    <origin xyz="0.02 0 0" rpy="0 1.5707963267948966 0"/></joint>
  <joint name="d" type="fixed"><parent link="arm"/><child link="skin_1"/>
    <origin xyz="0 -0.03 0" rpy="1.5707963267948966 0 0"/></joint>
  <joint name="e" type="continuous"><parent link="arm"/><child link="hand"/></joint>
  <link name="hand"/>
  <joint name="f" type="fixed"><parent link="hand"/><child link="tip_0"/></joint>
</robot>"""


def test_taxels_of_a_urdf(tmp_path: Path) -> None:
    """Fixed joints are followed up to the link that moves; normals are the z axes."""
    file = tmp_path / "model.urdf"
    file.write_text(URDF)
    layout = cs.skin.from_taxels(file, frames="skin_*")
    poses = layout.poses()
    assert list(poses) == ["skin_0", "skin_1"]
    for name, place, normal in (
        ("skin_0", (0.0, 0.02, 0.1), (0.0, 1.0, 0.0)),
        ("skin_1", (0.0, -0.03, 0.0), (0.0, -1.0, 0.0)),
    ):
        np.testing.assert_allclose(poses[name].position, place, atol=1e-12)
        np.testing.assert_allclose(poses[name].rotation[:, 2], normal, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "frames", "message"),
    [
        (URDF, "sleeve_*", "no link named 'sleeve_\\*'; its links are 'base', 'arm'"),
        (URDF, "*_0", "'skin_0' is fixed to 'arm', but 'tip_0' to 'hand'"),
        (URDF, None, "frames is None; give a pattern"),
        ("robot", "skin_*", "is no XML"),
        (URDF.replace("0 -0.03 0", "0 -0.03"), "skin_*", "xyz of link 'skin_1' is '0 -0.03'"),
        (URDF.replace('parent link="base"', 'parent link="cover"'), "skin_*", "in a circle"),
    ],
)
def test_wrong_frames(tmp_path: Path, text: str, frames: str | None, message: str) -> None:
    file = tmp_path / "model.urdf"
    file.write_text(text)
    with pytest.raises(cs.SceneError, match=message):
        cs.skin.from_taxels(file, frames=frames)
    with pytest.raises(cs.SceneError, match="there is no URDF file"):
        cs.skin.from_taxels(tmp_path / "none.urdf", frames="*")
    with pytest.raises(cs.SceneError, match="and none without"):
        cs.skin.from_taxels(np.zeros((1, 3)), np.ones((1, 3)), frames="*")
