"""Layouts of a skin on links in MuJoCo and PyBullet: places, and what neighbours cover."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

import capsense as cs

ROBOT = (
    '<mujoco><worldbody><body name="fore" pos="0.1 0.2 0.5" euler="20 30 40"><freejoint/>'
    '<geom type="cylinder" size="0.048 0.125"/><body name="hand" pos="0 0 0.13"><joint/>'
    '<geom name="palm" type="sphere" size="0.06"/></body></body></worldbody></mujoco>'
)


def layout() -> cs.skin.SkinLayout:
    link = trimesh.creation.cylinder(0.048, 0.25, sections=64)
    return cs.skin.from_mesh(link, count=30)


def covered(made: cs.skin.SkinLayout) -> set[str]:
    """Patches of which a part is well within the sphere of the hand."""
    far = {n: np.linalg.norm(np.subtract(p.position, (0, 0, 0.13))) for n, (_, p) in made.items()}
    return {name for name, r in far.items() if r < 0.06}


def test_mujoco_sites() -> None:
    mujoco = pytest.importorskip("mujoco", reason='needs pip install "capsense[mujoco]"')
    spec, made = mujoco.MjSpec.from_string(ROBOT), layout()
    assert covered(made)
    with pytest.warns(UserWarning, match="inside .*palm"):
        clear = cs.mujoco.add_skin(spec, "fore", made)
    assert set(made) - set(clear) >= covered(made)
    assert len(clear) > 15
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    fore = cs.Pose.from_mujoco(data.body("fore").xpos, data.body("fore").xquat)
    for name, pose in clear.poses(fore).items():
        site = data.site(name)
        np.testing.assert_allclose(site.xpos, pose.position, atol=1e-12)
        np.testing.assert_allclose(site.xmat.reshape(3, 3), pose.rotation, atol=1e-9)
    with pytest.raises(TypeError, match=r"give what cs\.skin\.from_mesh"):
        cs.mujoco.add_skin(spec, "fore", {})
    with pytest.raises(cs.SceneError, match="no body named 'forearm'"):
        cs.mujoco.add_skin(spec, "forearm", made)


URDF = """
<robot name="r"><link name="base"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1"
 ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j" type="revolute"><parent link="base"/><child link="plate"/><origin xyz="0.1 0 0.2"
 rpy="0.2 0 0"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="9" velocity="9"/></joint>
<link name="plate"><inertial><origin xyz="0.02 -0.01 0.03" rpy="0.3 0.1 0"/><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial><collision><geometry>
<box size="0.4 0.3 0.1"/></geometry></collision></link></robot>"""


def test_pybullet_links(tmp_path: Path) -> None:
    """Differential: a skin of the same layout that is given its scene and its poses by hand."""
    p = pytest.importorskip("pybullet", reason="PyBullet is not installed")
    link = trimesh.creation.box((0.4, 0.3, 0.1))
    region = ((-0.12, -0.08, 0.04), (0.12, 0.08, 0.06))
    made = cs.skin.from_mesh(link, count=2, region=region, patch=cs.load_design("six_patch"))
    (tmp_path / "r.urdf").write_text(URDF)
    client = p.connect(p.DIRECT)
    try:
        body = p.loadURDF(str(tmp_path / "r.urdf"), useFixedBase=True, physicsClientId=client)
        p.resetJointState(body, 0, 0.3, physicsClientId=client)
        place = p.getLinkState(body, 0, computeForwardKinematics=True, physicsClientId=client)[4:6]
        fore = cs.Pose(*place)
        above = fore @ next(iter(made.values()))[1] @ cs.Pose((0.01, 0.02, 0.06))
        ball = cs.Pose(above.position)
        shape = p.createCollisionShape(p.GEOM_SPHERE, radius=0.03, physicsClientId=client)
        p.createMultiBody(0, shape, basePosition=ball.position, physicsClientId=client)
        skin = cs.pybullet.attach_layout(client, body, "plate", made)
        found = skin.read()
        scene = cs.Scene([cs.Body(cs.Sphere(0.03), ball)])
        wanted = cs.Skin(made).step(scene, made.poses(fore))
        assert set(found) == set(wanted) == set(made)
        largest = max(reading.delta.max() for reading in wanted.values())
        assert largest > 2e-14
        for name, reading in wanted.items():
            np.testing.assert_allclose(found[name].delta, reading.delta, atol=1e-4 * largest)
    finally:
        p.disconnect(client)
