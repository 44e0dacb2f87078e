"""What ``check`` finds, and says at attach: each a trap that would give wrong numbers silently."""

from __future__ import annotations

import pickle
import re
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from adapter_worlds import Thing

import capsense as cs
from capsense.adapters.placement import placement
from capsense.solver.tree import shape_cache

SensorIn = Callable[..., Any]
BALL = cs.Sphere(0.02)


def ball_at(x: float, y: float, z: float) -> list[Thing]:
    """A ball, its place in the sensor frame."""
    return [Thing("ball", BALL, cs.Pose((x, y, z)))]


def test_a_sound_sensor_warns_of_nothing(shapes_in: SensorIn) -> None:
    """No finding, no warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert shapes_in(ball_at(0, 0, 0.04), cs.Pose()).check() == []


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ((0.0, 0.0, 0.01), r"electrodes 'A', 'B' lie inside '.*ball.*', up to .* mm deep"),
        ((-0.01, 0.0, 0.02), r"touch(es)? '.*ball.*', as a short circuit would"),
        ((0.0, 0.0, -0.06), r"nothing is in view, .*, but '.*ball.*' would be if the sensor faced"),
        ((9.0, 0.0, 0.0), r"nothing is in view, .* exactly 0: the sensor sees 0\.1 × 0\.1 × 0\.1"),
        ((0.068, 0.068, 0.05), r"nothing is in view, .* exactly 0"),  # a box around it is
    ],
)
def test_a_wrong_place_is_told(place: Any, message: str, shapes_in: SensorIn) -> None:
    """At attach and by check, with the fix."""
    with pytest.warns(UserWarning, match=message):
        sensor = shapes_in(ball_at(*place), cs.Pose())
    (found,) = sensor.check()
    assert any(fix in found for fix in ("exclude=[", "quaternion (1, 0, 0, 0)", "exclude, groups"))


@pytest.mark.parametrize("kind", ["site", "link"])
def test_a_pose_in_the_wrong_unit_or_frame_is_named_as_that(
    kind: str, tiny_simulator: cs.Simulator
) -> None:
    """60 mm written as 60: not for lack of things to see."""
    message = r"nothing is in view, .*stands 60 m from the origin of the link .*millimetres × 1e-3"
    if kind == "site":
        mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")
        text = (
            '<mujoco><worldbody><body><geom size=".01"/><site name="pad" pos="0 0 60"/></body>'
            '<body pos="0 0 .1"><geom size=".02"/></body></worldbody></mujoco>'
        )
        model = mujoco.MjModel.from_xml_string(text)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        with pytest.warns(UserWarning, match=message):
            sensor = cs.mujoco.attach(model, data, "pad", tiny_simulator)
        data.site_xpos[0] = (0.0, 0.0, 0.05)
        assert not any("60 m" in text for text in sensor.check())
    else:
        p = pytest.importorskip("pybullet", reason="PyBullet is not installed")
        client = p.connect(p.DIRECT)
        ball = p.createCollisionShape(p.GEOM_SPHERE, radius=0.02, physicsClientId=client)
        bodies = [
            p.createMultiBody(0, ball, basePosition=(x, 0, 0), physicsClientId=client)
            for x in (0, 0.1)
        ]
        with pytest.warns(UserWarning, match=message):
            cs.pybullet.attach(client, bodies[0], -1, cs.Pose((0, 0, 60)), tiny_simulator)
        p.disconnect(physicsClientId=client)


@pytest.mark.parametrize(
    ("groups", "place", "finding"),
    [
        (
            [2],
            "0 0 .09",
            r"groups=\[2\] leaves out 'person/torso', in the sensor's range.*=\[1, 2\]",
        ),
        ([2], "9 0 0", r"groups=\[2\] leaves out 'person/torso', on bodies that move.*=\[1, 2\]"),
        ([1, 2], "0 0 .09", None),
        (
            [3],
            "0 0 .09",
            r"groups=\[3\] leaves out 'lamp/bulb', 'person/torso', in .*=\[1, 2, 3\]",
        ),
        ([2, 3], "9 0 0", r"groups=\[2, 3\] leaves out 'person/torso', on bodies that move"),
    ],
)
def test_groups_that_leave_a_person_out_are_told(
    groups: list[int], place: str, finding: str | None, tiny_simulator: cs.Simulator
) -> None:
    """Not of what collides where the same is drawn, and not of the robot's own links far off."""
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><worldbody>
      <body name="arm"><joint/><geom name="seen" size=".01" pos="0 0 -.05" group="2"/>
        <geom name="hit" size=".012" pos="0 0 -.05" group="3"/><site name="pad"/>
        <body name="tip" pos="0 0 -.9"><joint/><geom size=".01" group="5"/></body></body>
      <body name="cup" pos=".02 0 .04"><freejoint/><geom name="drawn" size=".01" group="2"/>
        <geom name="hull" size=".012" group="3"/></body>
      <body name="lamp" pos="0 .02 .05"><geom name="bulb" size=".01" group="2"/></body>
      <body name="person" pos="{place}" mocap="true">
        <geom name="torso" size=".02" group="1"/></body>
      <body name="shed" pos="5 5 5"><geom size=".1" group="1"/></body>
      </worldbody></mujoco>""")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    sensor = cs.mujoco.attach(model, data, "pad", tiny_simulator, groups=groups)
    told = [text for text in sensor.check() if "leaves out" in text]
    if finding is None:
        assert told == []
        return
    assert len(told) == 1
    assert re.match(finding, told[0]), told[0]
    with pytest.warns(UserWarning, match="leaves out"):
        cs.mujoco.attach(model, data, "pad", tiny_simulator, groups=groups)
    with pytest.warns(UserWarning, match=r"sensor 'pad': groups="):
        cs.mujoco.attach_skin(model, data, ["pad"], tiny_simulator, groups=groups)
    named = "lamp/*" if "lamp" in told[0] else "person/*"
    quiet = cs.mujoco.attach(
        model, data, "pad", tiny_simulator, groups=groups, exclude=[named, "person/*"]
    )
    assert not any("leaves out" in text for text in quiet.check())


def test_markers_are_told(tiny_simulator: cs.Simulator) -> None:
    """A robot's target of glass: three rods of a metre, read as steel. Not its drawn covers."""
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    ghost = 'contype="0" conaffinity="0" rgba="0 1 0 .3"'
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><asset><material name="glass"
        rgba="1 1 1 .5"/></asset><worldbody><site name="pad"/>
      <body name="target" mocap="true" pos="0 0 .03"><geom type="box" size=".5 .002 .002" {ghost}/>
        <geom type="box" size=".002 .5 .002" contype="0" conaffinity="0" material="glass"/></body>
      <body name="cup" pos=".02 .02 .06"><geom size=".01"/><geom size=".011" {ghost}/></body>
      <body name="drawn" pos="-.02 .02 .06"><geom size=".01" contype="0" conaffinity="0"/></body>
      <body name="far" pos="9 0 0"><geom size=".01" {ghost}/></body></worldbody></mujoco>""")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with pytest.warns(UserWarning, match="as markers do"):
        sensor = cs.mujoco.attach(model, data, "pad", tiny_simulator)
    (found,) = [text for text in sensor.check() if "markers" in text]
    assert found.startswith("'target/geom0', 'target/geom1' can be seen through")
    assert found.endswith("exclude=['target']")
    clean = cs.mujoco.attach(model, data, "pad", tiny_simulator, exclude=["target"])
    assert not any("markers" in text for text in clean.check())


def test_markers_in_pybullet(tiny_simulator: cs.Simulator) -> None:
    """A goal that is only drawn, and can be seen through; another one that cannot."""
    p = pytest.importorskip("pybullet", reason="PyBullet is not installed")
    client = p.connect(p.DIRECT)
    pad = p.createMultiBody(0, physicsClientId=client)
    for alpha, place in ((0.3, (0, 0, 0.05)), (1.0, (0.03, 0, 0.05))):
        ball = p.createVisualShape(
            p.GEOM_SPHERE, radius=0.01, rgbaColor=(1, 0, 0, alpha), physicsClientId=client
        )
        p.createMultiBody(0, -1, ball, place, physicsClientId=client)
    with pytest.warns(UserWarning, match="as markers do"):
        sensor = cs.pybullet.attach(client, pad, -1, cs.Pose(), tiny_simulator)
    (found,) = sensor.check().mounting
    assert re.match(r"'body1/\w*' can be seen through .* with exclude=\['body1/\w*'\]$", found)
    assert len(sensor.scene()) == 2
    p.disconnect(client)


def test_a_sensor_that_faces_out_of_its_link_may_be_mounted_well(
    tiny_simulator: cs.Simulator,
) -> None:
    """On the far side of an arm: there is something on the other side of the arm only."""
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><geom type="box" size=".02 .02 .01"/>'
        '<site name="out" pos="0 0 .011"/><site name="in" pos="0 0 .011" quat="0 1 0 0"/></body>'
        '<body pos="0 0 -.03"><geom name="ball" size=".01"/></body>'
        '<body pos="0 0 .05"><geom name="other" size=".01"/></body></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for site, exclude, told in (("out", ["other"], False), ("in", ["ball"], True)):
        found = cs.mujoco.attach(model, data, site, tiny_simulator, exclude=exclude).check()
        assert len(found) == 1
        assert "faced the other way" in found[0]
        assert bool(found.mounting) == told


@pytest.mark.parametrize(("height", "told"), [(0.05, False), (0.041, False), (0.02, True)])
def test_electrodes_within_their_own_link(
    height: float, told: bool, tiny_simulator: cs.Simulator
) -> None:
    """On the flange of a KUKA, 4 mm under its face, and in the middle of the last link.

    The link is not seen, so nothing else would tell.
    """
    p = pytest.importorskip("pybullet", reason="PyBullet is not installed")
    import pybullet_data

    client = p.connect(p.DIRECT)
    file = f"{pybullet_data.getDataPath()}/kuka_iiwa/model.urdf"
    body = p.loadURDF(file, useFixedBase=True, physicsClientId=client)
    pad = "lbr_iiwa_link_7", cs.Pose((0, 0, height))
    found = cs.pybullet.attach(client, body, *pad, tiny_simulator).check()
    buried = [text for text in found if "on the link that carries the sensor" in text]
    assert bool(buried) == told
    skin = cs.pybullet.attach_skin(client, body, {"tip": pad}, tiny_simulator)
    assert skin.check() == {"tip": found}
    if told:
        fix = r"lie up to \d+ mm deep inside '.*link_7.*Move .* or, .* exclude=\['(.*)'\]$"
        match = re.search(fix, buried[0])
        assert match
        with pytest.warns(UserWarning, match="deep inside"):
            cs.pybullet.attach(client, body, *pad, tiny_simulator)
        hollow = cs.pybullet.attach(client, body, *pad, tiny_simulator, exclude=[match[1]])
        assert not any("deep inside" in text for text in hollow.check())
    p.disconnect(physicsClientId=client)


def test_a_cover_of_plastic_screens_nothing(tiny_simulator: cs.Simulator) -> None:
    """Nor do shapes that a sensor sees anyway tell twice."""
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body name="link"><geom name="shell" type="box" size=".1 .1 .05"/>'
        '<site name="pad"/></body></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)

    def found(**options: Any) -> list[str]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return cs.mujoco.attach(model, data, "pad", tiny_simulator, **options).check()

    assert [("deep inside" in text) for text in found()] == [False, True]
    assert not any("deep inside" in text for text in found(materials={"shell": "PLA"}))
    (seen,) = found(exclude_own=False)
    assert "deep inside" not in seen


def test_bodies_one_in_another_are_one_finding(shapes_in: SensorIn) -> None:
    """A robot's links and their covers: every electrode and every body is named once."""
    with pytest.warns(UserWarning, match="lie inside"):
        sensor = shapes_in(
            [*ball_at(0, 0, 0.01), Thing("cover", cs.Sphere(0.03), cs.Pose())], cs.Pose()
        )
    (found,) = sensor.check()
    assert found.count("ball") == found.count("cover") >= 2
    assert found.count("'A'") == 1


def test_an_open_mesh_is_entered_as_a_closed_one(tiny_simulator: cs.Simulator) -> None:
    """Differential: the shell of a real robot, a third of it missing at its far end."""
    ball = cs.Sphere(0.03).to_trimesh()
    corners = ball.vertices[ball.faces].mean(axis=1)
    shell = cs.TriMesh(ball.vertices, ball.faces[corners[:, 2] < 0.01])
    assert not shell.closed
    for z in (0.0, 0.02, 0.04):
        whole, part = (
            placement(cs.Scene([cs.Body(s, cs.Pose((0, 0, z)), name="link")]), tiny_simulator)
            for s in (cs.Sphere(0.03), shell)
        )
        assert [f.partition("up to")[0] for f in whole] == [f.partition("up to")[0] for f in part]


def test_bodies_behind_flat_electrodes_are_told(shapes_in: SensorIn) -> None:
    """A neighbouring link: there it reads thousands of fF that no preset agrees on."""
    behind = [Thing("finger", cs.Box((0.01, 0.01, 0.02)), cs.Pose((0, 0, -0.013)))]
    ahead = [Thing("ball", BALL, cs.Pose((0, 0, 0.04)))]
    with pytest.warns(UserWarning, match="behind electrode"):
        (found,) = shapes_in(behind + ahead, cs.Pose()).check()
    assert re.match(r"'.*finger.*' is behind electrodes? '.*, from [345]\.?\d? mm on", found)
    assert "ball" not in found
    beside = [Thing("plate", cs.Box((0.02, 0.02, 0.002)), cs.Pose((0, 0, 0.004)))]
    assert shapes_in(ahead + beside, cs.Pose()).check() == []


def test_a_reading_that_the_solver_itself_doubts_is_told(tiny_simulator: cs.Simulator) -> None:
    """The solver's own estimate, not looked at by most."""

    class Doubtful(cs.AttachedSensor):
        pose = cs.Pose()

        def scene(self) -> cs.Scene:
            return cs.Scene([cs.Body(BALL, cs.Pose((0, 0, 0.04)), "steel", name="ball")])

    sensor = Doubtful(tiny_simulator.copy())
    assert sensor.check() == []
    reading = sensor.read()
    largest = float(np.abs(reading.delta).max())
    rough = replace(reading, stats=replace(reading.stats, solver_error=0.6 * largest))
    sensor.simulator.solved_batch = lambda scenes, threads: [rough]  # type: ignore[method-assign]
    (found,) = sensor.check()
    assert found.startswith("the estimated error of electrode A is 60% of what ball, 21 mm away")
    assert found.kind == "rough"
    sensor.simulator.solved_batch = cs.Simulator.solved_batch.__get__(sensor.simulator)  # type: ignore[method-assign]
    words = re.escape(found.partition(";")[0])
    with pytest.warns(UserWarning, match=words):  # in the words of the reading itself
        sensor.simulator._of(
            replace(sensor.simulator._solver.solve(sensor.scene()), error=0.6 * largest, loss=None),
            sensor.scene(),
            0.0,
        )


def test_a_mesh_too_large_for_its_panels(tiny_simulator: cs.Simulator) -> None:
    """A pane of glass, too thin to be solved for on small panels; of steel it is not."""
    mesh = cs.Box((3.0, 3.0, 0.01)).to_trimesh()
    pane = cs.Body(cs.TriMesh(mesh.vertices, mesh.faces), cs.Pose((0, 0, 0.1)), "glass", name="x")
    (found,) = placement(cs.Scene([pane]), tiny_simulator)
    assert "'x' is a mesh of 18 m², solved with panels of some 161 mm; cut it" in found
    steel = replace(pane, material=cs.MATERIALS["steel"])
    assert placement(cs.Scene([steel]), tiny_simulator) == []


@pytest.mark.parametrize(
    ("camera", "reader", "message"),
    [
        ('euler="180 0 0" resolution="32 32"', "", r'shows 45 m; .* like fovy="0\.1"'),
        ('euler="180 0 0" fovy=".1" resolution="4 4"', "", "has pixels of 25 mm"),
        ('euler="180 0 0" fovy=".1" resolution="32 32"', 'cutoff=".05"', r"cut off at 0\.05 m"),
        ('fovy=".1" resolution="32 32"', "", "does not look along the sensor's z"),
        ('euler="180 0 0" fovy=".1" resolution="32 32" pos="9 0 0"', "", "nothing is in view"),
    ],
)
def test_a_wrong_camera_is_told(
    camera: str, reader: str, message: str, tiny_simulator: cs.Simulator
) -> None:
    """Each would give zeros or a wrong world without an error."""
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body name="link"><geom size=".001"/><site name="pad"/>'
        f'<camera name="pad" projection="orthographic" {camera}/></body>'
        f'<body pos="0 0 .05"><geom size=".02"/></body></worldbody>'
        f'<sensor><rangefinder camera="pad" data="depth" {reader}/></sensor></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with pytest.warns(UserWarning, match=message):
        sensor = cs.mujoco.attach(model, data, "pad", tiny_simulator, perception="depth_camera")
    assert len(sensor.check()) == 1


def test_a_skin_warns_where_all_are_blind(tiny_simulator: cs.Simulator) -> None:
    """One that sees nothing is usual in a skin; an electrode within a body never is."""
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    text = (
        '<mujoco><worldbody><site name="near"/><site name="far" pos="9 0 0"/>'
        '<body pos="0 0 {}"><geom name="ball" size=".02"/></body></worldbody></mujoco>'
    )

    def attach(height: float) -> Any:
        model = mujoco.MjModel.from_xml_string(text.format(height))
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        return cs.mujoco.attach_skin(model, data, ["near", "far"], tiny_simulator)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        skin = attach(0.04)
    assert [len(found) for found in skin.check().values()] == [0, 1]
    with pytest.warns(UserWarning, match="^scene: sensor 'near': electrodes 'A', 'B' lie inside"):
        attach(0.0)
    with pytest.warns(UserWarning, match="sensor 'near' and 1 more: nothing is in view"):
        attach(5.0)


def two_links(ball: str, extra: str = "") -> Any:
    """A robot whose second link is turned onto the pad on the first; a ball beside it."""
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><option gravity="0 0 0"/><worldbody>
      <body name="one"><joint axis="0 0 1"/><geom name="one" type="box" size=".03 .03 .01"
        pos="0 0 -.0101" mass="100"/><site name="pad"/><site name="high" pos="0 0 .004"/>
        <body name="two" pos=".1 0 0"><joint name="fold" axis="0 1 0" range="-3.2 3.2"/>
          <geom name="two" type="box" size=".05 .01 .005" pos="-.05 0 .05" contype="0"
            conaffinity="0"/>
          <body name="three" pos="0 0 1"><joint/><geom name="three" size=".01"/></body></body>
      </body><body name="ball" {ball}><geom name="ball" size=".02"/></body>{extra}
      </worldbody></mujoco>""")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def test_mounting_is_told_apart_from_the_scene(tiny_simulator: cs.Simulator) -> None:
    """Another link of the sensor's own robot stays there; a ball goes."""
    model, data = two_links('mocap="true" pos="0 0 .05"')
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sensor = cs.mujoco.attach(model, data, "pad", tiny_simulator)
    assert str(sensor.check()) == "nothing is wrong"
    data.mocap_pos[0] = 0, 0, 0.01
    two = model.geom("two").id
    model.geom_pos[two] = -0.1, 0, 0.0
    mujoco = pytest.importorskip("mujoco")
    mujoco.mj_forward(model, data)
    found = sensor.check()
    (link,), (ball,) = found.mounting, found.scene
    assert re.match(r".*inside 'two/two', up to 5 mm deep.*move the sensor's frame", link)
    assert re.match(
        r".*inside 'ball/ball', up to [89]\.\d mm deep.*until they part; move one of", ball
    )
    assert list(found) == [link, ball]
    assert str(found) == f"mounting: {link};\nscene: {ball}"
    assert sensor.source.neighbours(1) == {1, 2}


def test_contact_is_no_collision(tiny_simulator: cs.Simulator) -> None:
    """The simulator's overlap of a ball that is pressed onto the pad; deeper, it is a collision."""
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    model, data = two_links('pos="-.01 0 .0195" mocap="true"')
    sensor = cs.mujoco.attach(model, data, "pad", tiny_simulator)
    (found,) = sensor.check()
    assert re.match(r".*in contact with 'ball/ball', which .* overlap by up to 0\.49 mm", found)
    assert "move" not in found
    assert sensor.check().mounting == []
    data.mocap_pos[0, 2] = 0.01
    model.geom_conaffinity[model.geom("ball").id] = model.geom_contype[model.geom("ball").id] = 0
    mujoco.mj_forward(model, data)
    (found,) = sensor.check()
    assert "lie inside 'ball/ball'" in found


@pytest.mark.parametrize(("material", "gap", "told"), [
    ("steel", -1e-6, True), ("steel", 1.9e-4, False), ("wood", 1e-6, False), ("wood", -1e-3, True),
])  # fmt: skip
def test_what_touches_is_what_readings_warn_of(
    material: str, gap: float, told: bool, tiny_simulator: cs.Simulator
) -> None:
    """Differential: nothing is told of what the reading takes without a warning."""
    body = cs.Body(BALL, cs.Pose((-0.01, 0, 0.02 + gap)), material, name="ball")
    found = placement(cs.Scene([body]), tiny_simulator)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        tiny_simulator.copy().step(cs.Scene([body]))
    warned = any("readings mean nothing" in str(w.message) for w in caught)
    assert (bool(found), warned) == (told, told)


def test_findings_of_many_sensors_are_one_sentence(tiny_simulator: cs.Simulator) -> None:
    """With the worst of them."""
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    model, data = two_links('mocap="true" pos="0 0 .022"')
    told: list[tuple[str, float]] = []
    skin = cs.mujoco.attach_skin(
        model, data, ["pad", "high"], tiny_simulator, progress=lambda *x: told.append(x)
    )
    parts = [fraction for stage, fraction in told if stage == "shapes that sensors see"]
    assert parts == [0.0, 0.5, 1.0]
    data.mocap_pos[0, 2] = 0.015
    mujoco.mj_forward(model, data)
    found = skin.check()
    (text,) = found.scene
    assert re.match(
        r"2 of 2 sensors, 'high', 'pad'; the worst, 'high': electrodes .* 7\.9 mm", text
    )
    assert found.mounting == []
    assert str(found) == f"scene: {text}"
    assert pickle.loads(pickle.dumps(found)) == found
    assert pickle.loads(pickle.dumps(found)).scene == [text]


def test_what_was_worked_out_survives_an_interruption(
    tiny_simulator: cs.Simulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A user loses patience after the first of two sensors."""
    model, data = two_links('mocap="true" pos="0 0 .0731"')
    model.geom_size[model.geom("ball").id] = 0.0471  # a size that no other test has
    made: list[str] = []
    before = shape_cache.rigid_shape

    def rigid_shape(panels: Any, **options: Any) -> Any:
        made.append("one")
        return before(panels, **options)

    monkeypatch.setattr(shape_cache, "rigid_shape", rigid_shape)

    def impatient(stage: str, fraction: float) -> None:
        if fraction >= 0.5 and stage.startswith("shapes"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cs.mujoco.attach_skin(model, data, ["pad", "high"], tiny_simulator, progress=impatient)
    first = len(made)
    cs.mujoco.attach_skin(model, data, ["pad", "high"], tiny_simulator)
    assert len(made) == first


def test_farads_are_not_picofarads() -> None:
    """100 F is 100 pF without its exponent."""
    with pytest.raises(cs.SceneError, match=r"100 F, more than .* did you mean 1e-10\?"):
        cs.Body(BALL, grounding=100)
    assert np.isclose(cs.Body(BALL, grounding=100e-12).grounding, 1e-10)
