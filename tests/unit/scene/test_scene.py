"""Bodies and scenes: construction, packing, refusals."""

import subprocess
import sys
import warnings

import numpy as np
import pytest
import trimesh
from approximate import approx

from capsense.errors import SceneError
from capsense.scene import (
    Body,
    Box,
    Capsule,
    Cylinder,
    Ellipsoid,
    Material,
    Pose,
    Scene,
    Sphere,
    TriMesh,
)

POSE = Pose((0.1, -0.2, 0.3), (0.1, -0.2, 0.3, 0.9))
SHAPES = [
    Box((0.1, 0.2, 0.3)),
    Sphere(0.1),
    Capsule(0.1, 0.3),
    Cylinder(0.1, 0.3),
    Ellipsoid((0.1, 0.2, 0.3)),
]


def test_body_defaults_and_lookup():
    body = Body(SHAPES[0])
    assert body.pose == Pose()
    assert body.material.name == "steel"
    assert body.grounding == "grounded"
    assert body.name is None
    assert Body(SHAPES[0], material=Material("goo", 7.0)).material.eps_r == 7.0
    assert Body(SHAPES[0], grounding=1e-10).grounding == 1e-10


def test_moved_shares_all_but_the_pose():
    body = Body(SHAPES[0], POSE, "PLA", "floating", "bar")
    moved = body.moved(Pose((0, 0, 1)))
    assert moved.pose == Pose((0, 0, 1))
    assert body.pose == POSE
    assert moved.shape is body.shape
    assert (moved.material, moved.grounding, moved.name) == (body.material, "floating", "bar")
    with pytest.raises(AttributeError):
        moved.pose = POSE
    with pytest.raises(SceneError, match="pose"):
        body.moved((0, 0, 1))


def test_scene_is_a_sequence():
    bodies = [Body(s, name=f"b{i}") for i, s in enumerate(SHAPES)]
    scene = Scene(iter(bodies))
    assert list(scene) == bodies
    assert len(scene) == 5
    assert scene[1] is bodies[1]
    assert scene["b2"] is bodies[2]
    with pytest.raises(KeyError, match="named bodies: 'b0'"):
        scene["nope"]
    assert len(Scene()) == 0


def test_pack_follows_the_bodies():
    """Differential: rotations against Pose, boxes against points of the surface."""
    scene = Scene([Body(s, POSE) for s in SHAPES])
    packed = scene.pack()
    assert len(packed) == 5
    assert packed.kinds.dtype == np.int64
    for i, shape in enumerate(SHAPES):
        assert packed.kinds[i] == shape.kind
        assert packed.shapes[i] is shape
        np.testing.assert_array_equal(packed.params[i], shape.params)
        np.testing.assert_allclose(packed.rotation[i], POSE.rotation, atol=1e-15)
        np.testing.assert_array_equal(packed.position[i], POSE.position)
        mesh = shape.to_trimesh()
        points = POSE.apply(mesh.vertices)
        box = np.array([points.min(axis=0), points.max(axis=0)])
        np.testing.assert_allclose(packed.bounds[i], box, atol=1e-3)
        assert np.all(packed.bounds[i, 0] <= box[0] + 1e-12)
        assert np.all(packed.bounds[i, 1] >= box[1] - 1e-12)


@pytest.mark.parametrize(
    ("sizes", "told"), [((), False), ((90.0,), True), ((90.0, 20.0), True), ((90.0, 0.1), False)]
)
def test_scenes_in_millimetres_are_told(sizes, told):
    """Only where every body is far larger than what the sensor sees."""
    scene = Scene([Body(Sphere(size), name=f"b{k}") for k, size in enumerate(sizes)])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene.warn_of_units(0.5)
    assert [str(w.message).startswith("b0 is 180 × 180 × 180 m") for w in caught] == [True] * told


@pytest.mark.parametrize(
    ("distances", "told"),
    [((28.9,), False), ((29.1,), True), ((29.1, 40.0), True), ((29.1, 1.0), False)],
)
def test_scenes_far_beyond_the_sensor_are_told(distances, told):
    """Analytic: only where every body is farther off than 50 times what the sensor sees and its own
    size together."""
    poses = [Pose((0.0, 0.6 * far, 0.8 * far)) for far in distances]
    scene = Scene([Body(Sphere(2.0), pose, name=f"b{k}") for k, pose in enumerate(poses)])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene.warn_of_units(0.5)
    assert [str(w.message).startswith("b0 is at (0, 17.46, ") for w in caught] == [True] * told


def test_an_empty_scene_packs():
    packed = Scene().pack()
    assert packed.params.shape == (0, 3)
    assert packed.bounds.shape == (0, 2, 3)


def test_import_is_light():
    """Neither a compiler nor a mesh library is loaded to describe a scene."""
    code = (
        "import sys, capsense.scene as s; s.Scene([s.Body(s.Sphere(1))]); "
        "heavy = {'numba', 'trimesh', 'scipy'} & set(sys.modules); assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Body("box"), "give a Box"),
        (lambda: Body(Box), "give a Box"),
        (lambda: Body(SHAPES[0], pose=(0, 0, 1)), "give a Pose"),
        (lambda: Body(SHAPES[0], material="stele"), "steel"),
        (lambda: Body(SHAPES[0], material=3), "give a name"),
        (lambda: Body(SHAPES[0], grounding="ground"), "grounded"),
        (lambda: Body(SHAPES[0], grounding=0.0), "positive"),
        (lambda: Body(SHAPES[0], grounding=-1e-12), "positive"),
        (lambda: Body(SHAPES[0], grounding=float("nan")), "positive"),
        (lambda: Body(SHAPES[0], grounding=True), "grounding is True"),
        (lambda: Body(SHAPES[0], grounding=None), "grounding is None"),
        (lambda: Body(SHAPES[0], name=""), "name"),
        (lambda: Scene(Body(SHAPES[0])), "Scene\\(\\[body\\]\\)"),
        (lambda: Scene([SHAPES[0]]), "write Body\\(Box"),
        (lambda: Scene([Body(SHAPES[0]), None]), "bodies\\[1\\] is None"),
        (lambda: Scene(3), "list of bodies"),
        (lambda: Scene([Body(SHAPES[0], name="a")] * 2), "two bodies are named 'a'"),
        (lambda: Pose((0, 0, float("nan"))), "not finite"),
    ],
)
def test_bad_input_is_refused(make, words):
    with pytest.raises(SceneError, match=words):
        make()


def test_printing_stays_short() -> None:
    """A scene of a robot's meshes is a line."""
    mesh = Sphere(0.1).to_trimesh()
    shape = TriMesh(mesh.vertices, mesh.faces)
    scene = Scene([Body(shape, name=f"link{k}") for k in range(100)])
    assert len(repr(scene)) < 300
    assert repr(scene).startswith("<Scene of 100: link0 (TriMesh), link1")
    assert len(repr(scene[0])) < 500
    assert repr(Scene()) == "<Scene of 0: nothing>"


def test_a_mesh_of_trimesh() -> None:
    """The message says how it becomes a shape."""
    mesh = trimesh.creation.icosphere(radius=0.03)
    with pytest.raises(SceneError, match=r"give a TriMesh\(mesh\.vertices, mesh\.faces\)"):
        Body(mesh)
    assert Body(TriMesh(mesh.vertices, mesh.faces)).shape.volume == approx(mesh.volume)
