"""Poses: conventions against SciPy, algebra, refusals."""

import numpy as np
import pytest
from approximate import approx
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from capsense.errors import SceneError
from capsense.scene import Pose

component = st.floats(-1.0, 1.0, allow_nan=False).filter(lambda v: v == 0 or abs(v) > 1e-3)
quaternions = st.tuples(component, component, component, component).filter(any)
positions = st.tuples(*[st.floats(-2.0, 2.0)] * 3)
poses = st.builds(Pose, positions, quaternions)


def test_quaternion_order_is_xyzw_on_an_asymmetric_pose():
    """Differential (SciPy) and by hand: a quarter turn about z takes x to y."""
    q = (0.1, -0.2, 0.3, 0.9)
    pose = Pose((1.0, 2.0, 3.0), q)
    point = np.array([0.3, -0.5, 0.7])
    expected = np.array([1.0, 2.0, 3.0]) + Rotation.from_quat(q).apply(point)
    np.testing.assert_allclose(pose.apply(point), expected, atol=1e-15)
    quarter = Pose((0, 0, 0), (0, 0, np.sqrt(0.5), np.sqrt(0.5)))
    np.testing.assert_allclose(quarter.apply([1, 0, 0]), [0, 1, 0], atol=1e-15)


def test_quaternion_is_normalised():
    pose = Pose(quaternion=(0, 0, 3, 4))
    assert pose.quaternion == approx((0, 0, 0.6, 0.8))
    assert pose == Pose(quaternion=(0, 0, 0.6, 0.8))


@given(poses, poses, positions)
def test_composition_and_inverse(a, b, p):
    """Invariant: chaining is application in turn, and the inverse undoes it."""
    np.testing.assert_allclose((a @ b).apply(p), a.apply(b.apply(p)), atol=1e-12)
    np.testing.assert_allclose(a.inverse().apply(a.apply(p)), p, atol=1e-12)
    np.testing.assert_allclose((a @ b).matrix, a.matrix @ b.matrix, atol=1e-12)


@given(poses)
def test_matrix_round_trip(pose):
    """Differential: matrix to quaternion and back, half turns included."""
    back = Pose.from_matrix(pose.matrix)
    np.testing.assert_allclose(back.matrix, pose.matrix, atol=1e-12)
    np.testing.assert_allclose(
        pose.rotation, Rotation.from_quat(pose.quaternion).as_matrix(), atol=1e-14
    )


@pytest.mark.parametrize("axis", range(3))
def test_half_turns_from_matrix(axis):
    r = -np.eye(3)
    r[axis, axis] = 1.0
    np.testing.assert_allclose(Pose.from_matrix(r).rotation, r, atol=1e-15)


def test_euler_follows_urdf():
    """Differential: roll, pitch, yaw about fixed x, y, z."""
    rpy = (0.3, -0.7, 2.1)
    pose = Pose.from_euler((1, 2, 3), rpy)
    expected = Rotation.from_euler("xyz", rpy).as_matrix()
    np.testing.assert_allclose(pose.rotation, expected, atol=1e-14)
    turned = Pose.from_euler((1, 2, 3), np.degrees(rpy), degrees=True)
    np.testing.assert_allclose(turned.rotation, expected, atol=1e-14)
    assert pose.position == (1, 2, 3)


def test_pose_is_immutable_and_hashable():
    pose = Pose((1, 2, 3))
    with pytest.raises(AttributeError):
        pose.position = (0, 0, 0)
    with pytest.raises(ValueError, match="read-only"):
        pose.rotation[0, 0] = 2.0
    assert len({pose, Pose((1, 2, 3))}) == 1
    assert (pose == 3) is False
    with pytest.raises(TypeError):
        pose @ 3


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        ({"position": (0, 0)}, "position has 2 entries"),
        ({"position": (0, 0, np.nan)}, "not finite"),
        ({"position": (0, 0, np.inf)}, "not finite"),
        ({"position": 3.0}, "three numbers"),
        ({"position": "abc"}, "three numbers"),
        ({"quaternion": (0, 0, 0, 0)}, "length zero"),
        ({"quaternion": (0, 0, 1)}, "order \\(x, y, z, w\\)"),
        ({"quaternion": (0, 0, 0, np.nan)}, "not finite"),
    ],
)
def test_bad_poses_are_refused(kwargs, words):
    with pytest.raises(SceneError, match=words):
        Pose(**kwargs)


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (np.eye(2), "shape"),
        (2 * np.eye(3), "scale the shape"),
        (np.diag([1.0, 1.0, -1.0]), "not a rotation"),
        (np.full((3, 3), np.nan), "not finite"),
        (np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1, 1.0]]), "0, 0, 0, 1"),
    ],
)
def test_bad_matrices_are_refused(matrix, words):
    with pytest.raises(SceneError, match=words):
        Pose.from_matrix(matrix)


def test_radians_beyond_a_turn_look_like_degrees(recwarn):
    """Said once at each place, with the fix; never of degrees."""
    for yaw in (0.0, 2 * np.pi, 90.0, -180.0):
        Pose.from_euler((0, 0, 0), (0, 0, yaw))
    Pose.from_euler((0, 0, 0), (0, 0, 360.5), degrees=True)
    assert ["degrees=True" in str(w.message) for w in recwarn] == [True]
    assert recwarn[0].filename == __file__


def test_bad_angles_are_refused():
    with pytest.raises(SceneError, match="roll, pitch, yaw"):
        Pose.from_euler((0, 0, 0), (1, 2))


@pytest.mark.parametrize("seed", range(5))
def test_from_mujoco(seed):
    """Differential: MuJoCo's own frames of a turned body, by quaternion and by matrix."""
    mujoco = pytest.importorskip("mujoco", reason='needs pip install "capsense[mujoco]"')
    rng = np.random.default_rng(seed)
    position, quaternion = rng.normal(size=3), rng.normal(size=4)
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body name='b'><freejoint/><geom size='.1'/><site name='s'/></body>"
        "</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    data.qpos[:3], data.qpos[3:] = position, quaternion
    mujoco.mj_forward(model, data)
    w, x, y, z = quaternion
    expected = Pose(position, (x, y, z, w)).matrix
    for place, orientation in (
        (data.xpos[1], data.xquat[1]), (data.xpos[1], data.xmat[1]),
        (data.site_xpos[0], data.site_xmat[0]), (data.xpos[1], data.xmat[1].reshape(3, 3)),
        (position.tolist(), tuple(quaternion)),
    ):  # fmt: skip
        np.testing.assert_allclose(
            Pose.from_mujoco(place, orientation).matrix, expected, rtol=0, atol=1e-12
        )


@pytest.mark.parametrize(
    ("orientation", "message"),
    [
        ((1.0, 0.0, 0.0), r"orientation has shape \(3,\); give a quaternion \(w, x, y, z\)"),
        ("wxyz", "orientation has shape"),
        ((0.0, 0.0, 0.0, 0.0), "of length zero"),
        ((np.nan, 0.0, 0.0, 0.0), "not finite"),
        (2.0 * np.eye(3), "is not a rotation"),
    ],
)
def test_from_mujoco_refuses(orientation, message):
    """By name, with the fix."""
    with pytest.raises(SceneError, match=message):
        Pose.from_mujoco((0.0, 0.0, 0.0), orientation)
