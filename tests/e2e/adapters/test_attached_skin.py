"""Skins on simulated robots: the same readings as from sensors attached one by one."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import capsense as cs
from capsense.errors import ReadoutError, SceneError, SkinError

MJCF = """
<mujoco><option gravity="0 0 0"/>
<default><geom contype="0" conaffinity="0"/></default>
<worldbody>
  <body name="upper"><joint name="turn" axis="0 0 1"/>
    <geom name="upper_shell" type="box" size=".03 .02 .005" pos="0 0 -.01"/>
    <site name="a"/>
    <body name="fore" pos=".08 0 0"><joint name="bend" axis="0 1 0"/>
      <geom name="fore_shell" type="box" size=".03 .02 .005" pos="0 0 -.01"/>
      <site name="b"/><site name="c" pos="0 0 -.02" euler="180 0 0"/>
    </body>
  </body>
  <body name="person" pos="0 0 .06"><joint name="near" type="slide" axis="0 0 1"/>
    <geom name="hand" type="capsule" size=".015 .08" euler="0 90 0"/></body>
</worldbody></mujoco>"""
SITES = ("a", "b", "c")

URDF = """
<robot name="arm">
<link name="upper"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0"
 iyz="0"/></inertial><collision><origin xyz="0 0 -.01"/><geometry><box size=".06 .04 .01"/>
</geometry></collision></link>
<joint name="bend" type="revolute"><parent link="upper"/><child link="fore"/>
<origin xyz=".08 0 0"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="9" velocity="9"/>
</joint>
<link name="fore"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0"
 iyz="0"/></inertial><collision><origin xyz="0 0 -.01"/><geometry><box size=".06 .04 .01"/>
</geometry></collision></link></robot>"""
DOWN = cs.Pose((0.0, 0.0, -0.02), (1.0, 0.0, 0.0, 0.0))
MOUNTS = {"a": ("upper", cs.Pose()), "b": ("fore", cs.Pose()), "c": ("fore", DOWN)}
OPTIONS: dict[str, Any] = {
    "materials": {"hand*": "human"}, "grounding": {"hand*": 100e-12},
}  # fmt: skip


class MujocoArm:
    """Two links and a hand, in MuJoCo."""

    def __init__(self) -> None:
        mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")
        self.model = mujoco.MjModel.from_xml_string(MJCF)
        self.data = mujoco.MjData(self.model)
        self.move(0)

    def move(self, k: int) -> None:
        """Take the k-th posture."""
        import mujoco

        self.data.qpos[:] = 0.1 * k, 0.2 * k, -0.004 * k
        mujoco.mj_forward(self.model, self.data)
        self.data.time = 0.1 * k

    def skin(self, *args: Any, **options: Any) -> Any:
        """A skin of three sensors."""
        return cs.mujoco.attach_skin(self.model, self.data, SITES, *args, **OPTIONS | options)

    def single(self, name: str, simulator: cs.Simulator) -> Any:
        """One sensor."""
        return cs.mujoco.attach(self.model, self.data, name, simulator, **OPTIONS)


class PybulletArm:
    """The same in PyBullet."""

    def __init__(self, folder: Path) -> None:
        p = pytest.importorskip("pybullet", reason="PyBullet is not installed")
        self.client = p.connect(p.DIRECT)
        (folder / "arm.urdf").write_text(URDF)
        self.body = p.loadURDF(str(folder / "arm.urdf"), physicsClientId=self.client)
        shape = p.createCollisionShape(
            p.GEOM_CAPSULE, radius=0.015, height=0.16, physicsClientId=self.client,
        )  # fmt: skip
        self.hand = p.createMultiBody(0, shape, physicsClientId=self.client)
        p.addUserData(self.hand, "capsense.material", "human", physicsClientId=self.client)
        self.move(0)

    def move(self, k: int) -> None:
        """Take the k-th posture."""
        import pybullet as p

        turn, side = (0.0, np.sin(np.pi / 4), 0.0, np.cos(np.pi / 4)), self.client
        p.resetJointState(self.body, 0, 0.2 * k, physicsClientId=side)
        p.resetBasePositionAndOrientation(
            self.hand, (0, 0, 0.06 - 0.004 * k), turn, physicsClientId=side
        )

    def skin(self, *args: Any, **options: Any) -> Any:
        """A skin of three sensors."""
        return cs.pybullet.attach_skin(self.client, self.body, MOUNTS, *args, **options)

    def single(self, name: str, simulator: cs.Simulator) -> Any:
        """One sensor."""
        return cs.pybullet.attach(self.client, self.body, *MOUNTS[name], simulator)


@pytest.fixture(params=["mujoco", "pybullet"])
def arm(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Any]:
    """The arm in a simulator that is installed."""
    if request.param == "mujoco":
        yield MujocoArm()
        return
    made = PybulletArm(tmp_path)
    yield made
    import pybullet as p

    p.disconnect(physicsClientId=made.client)


@pytest.mark.parametrize("threads", [1, 3])
def test_the_same_as_attached_one_by_one(
    arm: Any, tiny_simulator: cs.Simulator, threads: int
) -> None:
    """Differential, to the last bit; a sensor does not see its own link, but the others."""
    skin = arm.skin(tiny_simulator.copy(), threads=threads)
    alone = {name: arm.single(name, tiny_simulator.copy()) for name in MOUNTS}
    for k in range(5):
        arm.move(k)
        readings = skin.read()
        assert list(readings) == list(MOUNTS)
        for name, reading in readings.items():
            assert np.array_equal(reading.delta, alone[name].read().delta)
            assert skin.poses[name] == alone[name].pose
    assert readings["a"].delta[0, 0] > 1e-15
    labels = {name: {b.name for b in s.scene()} for name, s in skin.sensors.items()}
    assert not any("upper" in label for label in labels["a"])
    assert any("fore" in label for label in labels["a"])
    assert not any("fore" in label for label in labels["c"])


def test_the_world_is_taken_over_once(arm: Any, tiny_simulator: cs.Simulator) -> None:
    """All sensors share the solids, and their fields; refreshing one source serves them all."""
    skin = arm.skin(tiny_simulator.copy())
    a, b, c = skin.sensors.values()
    assert a.source is b.source is c.source
    assert a.simulator.background is tiny_simulator.background is b.simulator.background
    shared = {id(s) for s in b.world.solids} & {id(s) for s in a.world.solids}
    assert len(shared) == 1, "the hand"
    version = a.source.version
    skin.refresh()
    assert a.source.version == version + 1
    skin.reset()
    assert set(skin.read()) == set(MOUNTS)


def test_designs_of_their_own(arm: Any, tiny_simulator: cs.Simulator) -> None:
    """Each sensor may have another design."""
    other = tiny_simulator.copy()
    skin = arm.skin({"a": tiny_simulator.copy(), "b": other, "c": "six_patch_bare"})
    assert skin.sensors["b"].simulator is other
    assert [len(r.electrode_names) for r in skin.read().values()] == [2, 2, 6]
    with pytest.raises(SceneError, match="design: no sensor is named 'd'"):
        arm.skin({"a": other, "d": other})
    with pytest.raises(SceneError, match="nothing is given for 'b'"):
        arm.skin({"a": other})


def test_one_failing_sensor(arm: Any, tiny_simulator: cs.Simulator) -> None:
    """Readings of the others come with the error."""
    skin = arm.skin(tiny_simulator.copy())
    expected = skin.read()
    skin.reset()

    def fails(*_: object, **__: object) -> None:
        raise SceneError("no sensor here")

    skin.sensors["b"].simulator.solved = fails
    with pytest.raises(SkinError, match="1 of 3 sensors failed; 'b': no sensor here") as caught:
        skin.read()
    for name in ("a", "c"):
        assert np.array_equal(caught.value.readings[name].delta, expected[name].delta)


def test_each_sensor_has_its_own_chip() -> None:
    """With a readout, every reading holds counts, time-stamped by the simulator."""
    arm = MujocoArm()
    skin = arm.skin("six_patch_bare", readout="fdc1004")
    chips = {id(s.readout) for s in skin.sensors.values()}
    assert len(chips) == 3
    assert [s.readout.seed for s in skin.sensors.values()] == [0, 2**32, 2**33]  # noise apart
    for k in range(3):
        arm.move(k)
        readings = skin.read()
    assert all(r.counts is not None and len(r.counts.time) for r in readings.values())


def test_chips_start_at_the_simulators_time(tiny_simulator: cs.Simulator) -> None:
    """Sensors attached, or reset, in the middle of a simulation do not report what was before."""
    arm = MujocoArm()
    arm.data.time = 50.0
    skin = arm.skin(tiny_simulator, readout="fdc1004")
    for start in (50.0, 70.0):
        arm.data.time = start
        skin.reset(seed=3)
        arm.data.time = start + 0.1
        for reading in skin.read().values():
            assert start < reading.counts.time.min() <= start + 0.0101
    arm.data.time = 90.0
    sensor = arm.single("a", tiny_simulator)
    sensor.use_readout("fdc1004")
    arm.data.time = 90.1
    assert sensor.read().counts.time.min() > 90.0


def test_seeds_of_a_skin() -> None:
    """Noise is each sensor's own; it repeats after a reset, unless there is another seed."""
    arm = MujocoArm()
    skin = arm.skin("six_patch_bare", readout="teensy")

    def codes() -> dict[str, list[int]]:
        arm.data.time = 0.1
        found = {name: r.counts.code.tolist() for name, r in skin.read().items()}
        arm.data.time = 0.0
        return found

    arm.data.time = 0.0
    skin.reset()
    first = codes()
    assert first["a"] != first["b"] != first["c"]
    skin.reset()
    assert codes() == first
    skin.reset(seed=1)
    second = codes()
    assert all(second[name] != first[other] for name in SITES for other in SITES)
    single = arm.single("b", cs.Simulator("six_patch_bare"))
    single.use_readout("teensy")
    single.reset(seed=1 + 2**32)
    arm.data.time = 0.1
    assert single.read().counts.code.tolist() == second["b"]
    with pytest.raises(ReadoutError, match="seed is -1"):
        single.reset(seed=-1)


def test_a_readout_is_not_shared(tiny_simulator: cs.Simulator) -> None:
    """Every sensor has a copy with noise of its own; the one that is given stays as it is."""
    readout = cs.Readout.preset("fdc1004", tiny_simulator.electrode_names, seed=5)
    skin = MujocoArm().skin(tiny_simulator, readout=readout)
    chips = [sensor.readout for sensor in skin.sensors.values()]
    assert [chip.seed for chip in chips] == [5, 5 + 2**32, 5 + 2**33]
    assert len({id(chip) for chip in (readout, *chips)}) == 4
    assert readout.seed == 5
    skin.use_readout("teensy", start=1.0, seed=2)
    assert [s.readout.seed for s in skin.sensors.values()] == [2, 2 + 2**32, 2 + 2**33]
    skin.use_readout(None)
    assert all(s.readout is None for s in skin.sensors.values())


def test_mujoco_names(tiny_simulator: cs.Simulator) -> None:
    """Slips in names are refused."""
    arm = MujocoArm()
    for sites, words in (
        (["a", "x"], "there is no site named 'x'"),
        ("a", r"sites is 'a'; give a list"),
        ([], "give at least one"),
        (["a", "b", "a"], "'a' is given 2 times"),
    ):
        with pytest.raises((SceneError, TypeError), match=words):
            cs.mujoco.attach_skin(arm.model, arm.data, sites, tiny_simulator)


def test_pybullet_mounts(tmp_path: Path, tiny_simulator: cs.Simulator) -> None:
    """So are links, and mounts that are no pairs; bodies that appear later are seen."""
    arm = PybulletArm(tmp_path)
    import pybullet as p

    for mounts, words in (
        ({"a": ("hand", cs.Pose())}, "no link named 'hand'"),
        ({"a": "upper"}, r"mount 'a' is 'upper'; give a pair"),
    ):
        with pytest.raises(SceneError, match=words):
            cs.pybullet.attach_skin(arm.client, arm.body, mounts, tiny_simulator)
    skin = arm.skin(tiny_simulator.copy())
    before = skin.read()
    shape = p.createCollisionShape(p.GEOM_SPHERE, radius=0.02, physicsClientId=arm.client)
    p.createMultiBody(0, shape, basePosition=(0.08, 0, 0.04), physicsClientId=arm.client)
    after = skin.read()
    assert after["b"].delta[0, 0] > 1.5 * before["b"].delta[0, 0]
    p.disconnect(physicsClientId=arm.client)
