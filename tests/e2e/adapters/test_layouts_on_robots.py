"""Layouts of a skin on links in MuJoCo and PyBullet: places, and what neighbours cover."""

from __future__ import annotations

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
