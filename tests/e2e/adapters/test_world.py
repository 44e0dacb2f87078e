"""Placing solids in the sensor frame, and meshes made into solids."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from approximate import approx

import capsense as cs
from capsense.adapters.meshes import height_field, joined_hulls, load_triangles, round_cylinder
from capsense.adapters.rules import Tie
from capsense.adapters.world import Frames, HalfSpace, Solid, World
from capsense.design.model import Domain
from capsense.errors import MissingDependencyError
from capsense.scene import material

STEEL = cs.MATERIALS["steel"]
DOMAIN = Domain((0.3, 0.4, 0.5), 0.01)
SHAPES = (
    cs.Box((0.1, 0.2, 0.3)),
    cs.Sphere(0.1),
    cs.Capsule(0.05, 0.2),
    cs.Cylinder(0.05, 0.2),
    cs.Ellipsoid((0.1, 0.02, 0.05)),
)


def random_pose(rng: np.random.Generator, spread: float) -> cs.Pose:
    return cs.Pose(rng.uniform(-spread, spread, 3), rng.normal(size=4))


def solid(
    shape: cs.Box | HalfSpace,
    frame: int,
    pose: cs.Pose,
    label: str = "it",
    matter: cs.Material = STEEL,
) -> Solid:
    return Solid(label, shape, frame, pose, matter, Tie("grounded", "test"))


def frames_of(poses: list[cs.Pose], sensor: cs.Pose) -> Frames:
    return Frames(
        np.array([p.position for p in poses]),
        np.array([p.quaternion for p in poses]),
        np.array(sensor.position),
        np.array(sensor.quaternion),
    )


def test_against_chained_poses() -> None:
    """Differential: the kernel against ``Pose``; what is left out lies off the domain."""
    rng = np.random.default_rng(0)
    left_out = 0
    for _ in range(40):
        frames = [random_pose(rng, 0.3) for _ in range(4)]
        local = [random_pose(rng, 0.2) for _ in range(20)]
        owner = rng.integers(0, 4, 20)
        sensor = random_pose(rng, 0.2)
        solids = [
            solid(SHAPES[i % 5], int(owner[i]), local[i], f"s{i}")  # type: ignore[arg-type]
            for i in range(20)
        ]
        scene = World(solids, DOMAIN).scene(frames_of(frames, sensor))
        for i in range(20):
            expected = sensor.inverse() @ frames[owner[i]] @ local[i]
            try:
                found = scene[f"s{i}"].pose
            except KeyError:
                corners = expected.apply(SHAPES[i % 5].to_trimesh().vertices)
                apart = (corners.min(axis=0) >= DOMAIN.upper) | (
                    corners.max(axis=0) <= DOMAIN.lower
                )
                assert apart.any()
                left_out += 1
            else:
                assert found.matrix == approx(expected.matrix, abs=1e-12)
    assert 100 < left_out < 700


@pytest.mark.parametrize("matter", ["wood", "steel"])
@pytest.mark.parametrize("seed", range(20))
def test_half_space_covers_its_side(seed: int, matter: str) -> None:
    """Every point of the domain is inside the box that stands for it just if below the plane.

    Of a conductor, it is inside just if a tenth of the domain's diagonal below it at most.
    """
    rng = np.random.default_rng(seed)
    plane, sensor = random_pose(rng, 0.15), random_pose(rng, 0.15)
    far = plane @ cs.Pose((300.0, -200.0, 0.0))  # the plane has no middle
    world = World([solid(HalfSpace(), 0, cs.Pose(), matter=material(matter))], DOMAIN)
    points = rng.uniform(DOMAIN.lower, DOMAIN.upper, (500, 3))
    below = (plane.inverse() @ sensor).apply(points)[:, 2]
    scene = world.scene(frames_of([far], sensor))
    if not len(scene):
        assert below.min() > 0
        return
    body = scene[0]
    inside = body.shape.signed_distance(body.pose.inverse().apply(points))
    depth = np.linalg.norm(DOMAIN.size) * (0.1 if matter == "steel" else 1.0)
    clear = (np.abs(below) > 1e-9) & (np.abs(below + depth) > 1e-9)
    assert np.array_equal(inside[clear] < 0, ((below < 0) & (below > -depth))[clear])


def test_repeated_labels_are_numbered() -> None:
    """Names differ within a scene."""
    world = World([solid(cs.Box((0.1, 0.1, 0.1)), 0, cs.Pose())] * 3, DOMAIN)
    scene = world.scene(frames_of([cs.Pose()], cs.Pose()))
    assert [b.name for b in scene] == ["it", "it#2", "it#3"]


def test_a_place_that_is_not_finite_is_refused() -> None:
    """A diverged simulation is told, by the name of what flew off."""
    world = World([solid(cs.Box((0.1, 0.1, 0.1)), 0, cs.Pose(), "ball")], DOMAIN)
    frames = frames_of([cs.Pose()], cs.Pose())
    frames.position[0, 1] = np.nan
    with pytest.raises(cs.SceneError, match="'ball' stands at a place that is not finite"):
        world.scene(frames)


def test_height_field_is_closed_and_of_the_right_volume() -> None:
    """Analytic: a tilted plane over a slab."""
    x = np.linspace(0, 0.1, 6)
    shape = cs.TriMesh(*height_field(np.tile(x, (4, 1)), (0.3, 0.2), 0.05))
    assert shape.volume == approx(0.6 * 0.4 * (0.05 + 0.05))
    assert shape.bounds() == approx(np.array([[-0.3, -0.2, -0.05], [0.3, 0.2, 0.1]]))
    rows = np.zeros((3, 3))
    rows[2, 0] = 0.1  # last row is +y, first column is −x
    vertices, _ = height_field(rows, (1.0, 1.0), 1.0)
    assert vertices[vertices[:, 2].argmax()] == approx((-1.0, 1.0, 0.1))


def test_hulls_are_taken_part_by_part() -> None:
    """Two apart boxes stay two; a dent is filled; a stray triangle is dropped."""
    box = cs.Box((0.1, 0.1, 0.1)).to_trimesh()
    dented = np.vstack([box.vertices, [[0, 0, 0]]])
    faces = box.faces[2:].tolist()
    a, b, c = box.faces[0]
    d = next(int(k) for k in box.faces[1] if k not in (a, b, c))
    ring = [a, b, c, d] if {a, c} <= set(box.faces[1]) else [a, b, d, c]
    faces += [[ring[k], ring[(k + 1) % 4], 8] for k in range(4)]
    stray = [[1, 0, 0], [1, 0.1, 0], [1, 0, 0.1]]
    both = np.vstack([dented, np.add(dented, (0.5, 0, 0)), stray])
    every = np.vstack([faces, np.add(faces, 9), [[18, 19, 20]]])
    shape = cs.TriMesh(*joined_hulls(both, every, "boxes"))
    assert shape.volume == approx(2e-3)
    with pytest.raises(cs.SceneError, match="'flat' has no part with a volume"):
        joined_hulls(stray, [[0, 1, 2]], "flat")


def test_a_prism_of_bullet_is_a_cylinder() -> None:
    """32 corners on both ends; anything else stays what it is."""
    angle = np.arange(32) * 2 * np.pi / 32
    ring = np.stack([0.05 * np.cos(angle), 0.05 * np.sin(angle)], axis=1)
    prism = np.vstack([np.column_stack([ring, np.full(32, z)]) for z in (-0.1, 0.1)])
    found = round_cylinder(prism)
    assert found is not None
    assert (found.radius, found.length) == approx((0.05, 0.2))
    assert round_cylinder(prism[:40]) is None
    assert round_cylinder(prism * (1.0, 1.1, 1.0)) is None


def test_wrong_mesh_files_are_refused(tmp_path: object) -> None:
    """By the name of the thing and the file."""
    with pytest.raises(cs.SceneError, match=r"'arm': there is no mesh file .*gone\.stl"):
        load_triangles(f"{tmp_path}/gone.stl", (1, 1, 1), "arm")
    file = f"{tmp_path}/empty.obj"
    with open(file, "w") as stream:
        stream.write("v 0 0 0\n")
    with pytest.raises(cs.SceneError, match=r"'arm': .*empty\.obj"):
        load_triangles(file, (1, 1, 1), "arm")


@pytest.mark.parametrize("name", ["mujoco", "pybullet"])
def test_a_missing_simulator_is_named(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The error gives the command that installs it."""
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingDependencyError, match=rf"pip install 'capsense\[{name}\]'"):
        getattr(cs, name).attach(None, None, "pad")
