"""What is MuJoCo's own: its geoms, its texts, its state."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from approximate import approx

import capsense as cs
from capsense.adapters.meshes import Terrain, height_field
from capsense.adapters.mujoco_model import ModelSource
from capsense.adapters.rules import Rules

mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")

PAD = '<body name="link"><geom name="own" type="sphere" size=".02"/><site name="pad"/></body>'


def sensor_in(
    world: str, simulator: cs.Simulator, *, top: str = "", forward: bool = True, **options: Any
) -> Any:
    """A sensor at the world's origin."""
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco>{top}<worldbody>{PAD}{world}</worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    if forward:
        mujoco.mj_forward(model, data)
    return cs.mujoco.attach(model, data, options.pop("site", "pad"), simulator, **options)


def test_every_primitive_has_its_size(tiny_simulator: cs.Simulator) -> None:
    """MuJoCo's half sizes become full ones."""
    kinds = {
        "box": (".01 .02 .03", cs.Box((0.02, 0.04, 0.06))),
        "sphere": (".01", cs.Sphere(0.01)),
        "capsule": (".01 .02", cs.Capsule(0.01, 0.04)),
        "cylinder": (".01 .02", cs.Cylinder(0.01, 0.04)),
        "ellipsoid": (".01 .02 .03", cs.Ellipsoid((0.01, 0.02, 0.03))),
    }
    world = "".join(
        f'<geom name="{kind}" type="{kind}" size="{size}" pos="0 0 .04"/>'
        for kind, (size, _) in kinds.items()
    )
    scene = sensor_in(world, tiny_simulator).scene()
    assert {str(b.name).removeprefix("world/"): b.shape for b in scene} == {
        kind: shape for kind, (_, shape) in kinds.items()
    }


def test_a_floor_has_no_end(tiny_simulator: cs.Simulator) -> None:
    """Differential: a plane reads as a sheet as wide as the domain does, wherever its middle.

    Measured 3.0 % with fine panels, and 11.4 % for a table of 100 m; 5 mm nearer is 30 %.
    """
    fine = cs.Simulator("six_patch", preset="fine")
    vertices, faces = height_field(np.zeros((9, 9)), (0.25, 0.25), 0.1)
    sheet = cs.Body(cs.TriMesh(vertices, faces[:128]), cs.Pose((0, 0, 0.05), (1, 0, 0, 0)))
    expected = fine.step(cs.Scene([sheet])).delta
    found = []
    for floor, most in (
        ('<geom type="plane" size="1 1 .1" pos="0 0 .05" euler="180 0 0"/>', 0.05),
        ('<geom type="plane" size="1 1 .1" pos="50 -80 .05" euler="180 0 0"/>', 0.05),
        ('<geom type="box" size="50 70 5" pos="30 20 5.05"/>', 0.13),
    ):
        found.append(sensor_in(floor, fine).read().delta)
        assert np.abs(found[-1] - expected).max() < most * np.abs(expected).max()
    assert found[1] == approx(found[0], rel=1e-6)
    behind = sensor_in('<geom type="plane" size="0 0 .1" pos="0 0 -.5"/>', tiny_simulator)
    assert len(behind.scene()) == 0


@pytest.mark.parametrize(("matter", "most"), [("steel", 0.05), ("wood", 0.06)])
def test_a_wide_terrain_is_seen_where_the_sensor_is(matter: str, most: float) -> None:
    """Differential: of 60 m, what lies near the sensor reads as one fine mesh of the same hills.

    Anywhere on it: the hills repeat every 1.2 m, and so do its parts. Next to nothing changes from
    one part to the next, either.
    """

    def hills(half: float) -> Any:
        axis = np.linspace(-half, half, 2 * round(half / 0.1) + 1)
        return 0.5 + 0.25 * np.add.outer(*[np.cos(axis * 2 * np.pi / 1.2)] * 2)

    def felt(x: float, y: float) -> Any:
        model = mujoco.MjModel.from_xml_string(
            '<mujoco><asset><hfield name="h" nrow="601" ncol="601" size="30 30 .1 .5"/></asset>'
            '<worldbody><geom name="hill" type="hfield" hfield="h"/>'
            f'<body pos="{x} {y} .15"><site name="pad" euler="180 0 0"/></body></worldbody>'
            "</mujoco>"
        )
        model.hfield_data[:] = hills(30).ravel()
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        sensor = cs.mujoco.attach(model, data, "pad", "six_patch", default_material=matter)
        assert len(sensor.scene()) == 1
        return np.diag(sensor.read().delta)

    vertices, faces = height_field(0.1 * hills(0.3), (0.3, 0.3), 0.1)
    mesh = cs.TriMesh(vertices, faces[:72] if matter == "steel" else faces)
    body = cs.Body(mesh, cs.Pose((0, 0, 0.15), (1, 0, 0, 0)), matter)
    expected = np.diag(cs.Simulator("six_patch", preset="fine").step(cs.Scene([body])).delta)
    assert felt(0, 0) == approx(expected, rel=most, abs=0)
    assert felt(12.0, -24.0) == approx(felt(0, 0), rel=1e-3, abs=0)
    assert felt(-1e-3, 0) == approx(felt(1e-3, 0), rel=0.03, abs=0)


def test_the_part_of_a_terrain_around_a_sensor() -> None:
    """It reaches far enough, stands where the terrain does, and few of them are kept."""
    axis = np.linspace(-2.0, 2.0, 41)
    terrain = Terrain(0.1 * np.add.outer(axis, axis**2), (2.0, 2.0), 0.5, True, "hills")
    rng = np.random.default_rng(0)
    seen = set()
    for x, y in rng.uniform(-2.2, 2.2, (100, 2)):
        part = terrain.near(np.array([x, y, 0.0]), 0.25)
        seen.add(id(part))
        low, high = part.bounds()[:, :2]
        inside = np.clip((x, y), -2.0, 2.0)
        assert (low <= np.maximum(inside - 0.25, -2.0) + 1e-9).all()
        assert (high >= np.minimum(inside + 0.25, 2.0) - 1e-9).all()
        assert (high - low < 0.9 + 1e-9).all()
        top = part.vertices[part.vertices[:, 2] > -0.5]
        assert 2 * len(top) == len(part.vertices)
        np.testing.assert_allclose(top[:, 2], 0.1 * (top[:, 1] + top[:, 0] ** 2), atol=1e-12)
        assert terrain.near(np.array([x, y, 1.0]), 0.25) is part
        assert len(terrain._parts) <= 8
    assert len(seen) > 8


def test_a_terrain_stands_where_mujoco_has_it(tiny_simulator: cs.Simulator) -> None:
    """Differential: height above the terrain, as rays of MuJoCo find it."""
    rng = np.random.default_rng(0)
    heights = " ".join(f"{v:.3f}" for v in rng.uniform(0, 1, 35))
    sensor = sensor_in(
        '<geom name="hill" type="hfield" hfield="hill" pos="0 .01 .02" euler="0 0 30"/>',
        tiny_simulator,
        top=f'<asset><hfield name="hill" nrow="5" ncol="7" size=".1 .08 .04 .01" '
        f'elevation="{heights}"/></asset>',
    )
    (body,) = sensor.scene()
    points = np.column_stack([rng.uniform(-0.04, 0.04, (60, 2)), np.full(60, 0.2)])
    geom = np.zeros(1, np.int32)
    only = np.zeros(6, np.uint8)
    only[0] = 1
    for point in points:
        down = np.array([0.0, 0.0, -1.0])
        try:
            depth = mujoco.mj_ray(sensor.model, sensor.data, point, down, only, 1, 1, geom)
        except TypeError:
            depth = mujoco.mj_ray(sensor.model, sensor.data, point, down, only, 1, 1, geom, None)
        hit = point + depth * down
        assert body.shape.signed_distance(body.pose.inverse().apply([hit]))[0] == approx(
            0.0, abs=1e-8
        )


def test_signed_distance_geoms_and_shared_meshes(tiny_simulator: cs.Simulator) -> None:
    """An SDF plugin's surface is taken; geoms of one mesh share one shape."""
    top = (
        '<asset><mesh name="m" vertex="0 0 0 .03 0 0 0 .03 0 0 0 .03"/></asset>'
        if not _has_torus()
        else '<extension><plugin plugin="mujoco.sdf.torus"><instance name="t">'
        '<config key="radius1" value="0.03"/><config key="radius2" value="0.01"/>'
        '</instance></plugin></extension><asset><mesh name="torus"><plugin instance="t"/></mesh>'
        '<mesh name="m" vertex="0 0 0 .03 0 0 0 .03 0 0 0 .03"/></asset>'
    )
    world = '<geom type="mesh" mesh="m" pos="0 0 .04"/><geom type="mesh" mesh="m" pos="0 0 .05"/>'
    if _has_torus():
        world += (
            '<geom name="ring" type="sdf" mesh="torus" pos="0 0 .04"><plugin instance="t"/></geom>'
        )
    scene = sensor_in(world, tiny_simulator, top=top).scene()
    assert scene[0].shape is scene[1].shape
    assert scene[0].shape.volume == approx(0.03**3 / 6, rel=1e-5)
    if _has_torus():
        ring = scene["world/ring"].shape
        assert ring.volume == approx(2 * np.pi**2 * 0.03 * 0.01**2, rel=0.01)


def _has_torus() -> bool:
    """Whether the wheel carries the plugin."""
    try:
        mujoco.MjSpec.from_string(
            '<mujoco><extension><plugin plugin="mujoco.sdf.torus"/></extension></mujoco>'
        ).compile()
    except ValueError:
        return False
    return True


def test_texts_of_the_model_say_what_things_are(tiny_simulator: cs.Simulator) -> None:
    """The call's patterns come before the model's, and those before the defaults."""
    world = "".join(f'<geom name="{n}" size=".01" pos="0 0 .04"/>' for n in ("a1", "a2", "b"))
    top = (
        '<custom><text name="capsense.material:a*" data="human"/>'
        '<text name="capsense.grounding:a2" data="100e-12"/></custom>'
    )
    sensor = sensor_in(
        world, tiny_simulator, top=top, materials={"a1": "copper"}, default_grounding="floating"
    )
    found = {str(b.name): (b.material.name, b.grounding) for b in sensor.scene()}
    assert found == {
        "world/a1": ("copper", "floating"),
        "world/a2": ("human", 100e-12),
        "world/b": ("steel", "floating"),
    }


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('name="capsense.material:z*" data="human"', "no geom or body fits 'z\\*'"),
        ('name="capsense.material:b" data="humam"', 'text name="capsense.material:b">: unknown'),
        ('name="capsense.grounding:b" data="-3"', "grounding is -3.0, not a positive"),
        ('name="capsense.grounding:b" data="loose"', "grounding is 'loose'"),
        ('name="capsense.grouding:b" data="floating"', "is not known; write capsense.material"),
    ],
)
def test_wrong_texts_are_refused(text: str, message: str, tiny_simulator: cs.Simulator) -> None:
    """By name, before anything is read."""
    with pytest.raises(cs.SceneError, match=message):
        sensor_in(
            '<geom name="b" size=".01"/>', tiny_simulator, top=f"<custom><text {text}/></custom>"
        )


def test_groups_select_geoms(tiny_simulator: cs.Simulator) -> None:
    """Visual copies of collision geoms can be left out."""
    world = "".join(f'<geom name="g{g}" size=".01" pos="0 0 .04" group="{g}"/>' for g in range(4))
    scene = sensor_in(world, tiny_simulator, groups=(1, 3)).scene()
    assert [b.name for b in scene] == ["world/g1", "world/g3"]
    with pytest.raises(cs.SceneError, match=r"nothing is in group 5; there are geoms in \[0, 1"):
        sensor_in(world, tiny_simulator, groups=(1, 5))


def test_a_site_of_the_world_keeps_the_world(tiny_simulator: cs.Simulator) -> None:
    """The world body is no link of the sensor's."""
    world = '<site name="desk"/><geom name="lamp" size=".01" pos="0 0 .04"/>'
    scene = sensor_in(world, tiny_simulator, site="desk").scene()
    assert [b.name for b in scene] == ["world/lamp", "link/own"]


def test_wrong_calls_are_refused(tiny_simulator: cs.Simulator) -> None:
    """A missing site, a state of no pose, foreign data, foreign objects."""
    with pytest.raises(cs.SceneError, match="no site named 'pat'; did you mean 'pad'"):
        sensor_in("", tiny_simulator, site="pat")
    bare = mujoco.MjModel.from_xml_string("<mujoco/>")
    with pytest.raises(cs.SceneError, match=r"none at all; cs\.mujoco\.add_sensor\(spec, body"):
        cs.mujoco.attach(bare, mujoco.MjData(bare), "pad", tiny_simulator)
    with pytest.raises(cs.SceneError, match=r"hold no poses yet; call mujoco\.mj_forward"):
        sensor_in("", tiny_simulator, forward=False).read()
    sensor = sensor_in("", tiny_simulator)
    other = sensor_in('<body name="more"/>', tiny_simulator)
    with pytest.raises(cs.SceneError, match="data belong to another model"):
        cs.mujoco.attach(sensor.model, other.data, "pad", tiny_simulator)
    with pytest.raises(TypeError, match="model is a str"):
        cs.mujoco.attach("model.xml", other.data, "pad", tiny_simulator)
    with pytest.raises(TypeError, match="data is a MjModel"):
        cs.mujoco.attach(sensor.model, other.model, "pad", tiny_simulator)
    with pytest.raises(cs.DesignError, match="six_pach"):
        cs.mujoco.attach(sensor.model, sensor.data, "pad", "six_pach")


def test_geoms_changed_later_are_followed(tiny_simulator: cs.Simulator) -> None:
    """Differential: what domain randomisation changes is as if the model had been made so."""
    world = '<geom name="ball" size="{}" pos="{}"/><geom name="box" type="box" size=".01 .01 .01" '
    world += (
        'pos=".02 0 .04" quat="{}"/><geom name="hill" type="hfield" hfield="hill" pos="0 0 .06"/>'
    )
    top = '<asset><hfield name="hill" nrow="3" ncol="3" size=".04 .04 .02 .01" '
    top += 'elevation="{}"/></asset>'
    flat, rough = "0 0 0 0 1 0 0 0 0", "0 0 0 1 1 0 0 0 0"
    sensor = sensor_in(
        world.format(".01", "0 0 .04", "1 0 0 0"), tiny_simulator, top=top.format(flat)
    )
    first, box = sensor.read().delta, sensor.scene()["world/box"].shape
    model = sensor.model
    model.geom("ball").size[0] = 0.012
    model.geom("ball").pos[:] = (0.01, 0.0, 0.03)
    model.geom("box").quat[:] = (0.8, 0.6, 0.0, 0.0)
    model.hfield_data[3] = 1.0
    mujoco.mj_forward(model, sensor.data)
    made = sensor_in(
        world.format(".012", ".01 0 .03", ".8 .6 0 0"), tiny_simulator, top=top.format(rough)
    )
    found = sensor.read().delta
    assert np.array_equal(found, made.read().delta)
    assert np.abs(found - first).max() > 1e-16
    assert sensor.scene()["world/box"].shape == box


def test_a_diverged_simulation_is_told(tiny_simulator: cs.Simulator) -> None:
    """MuJoCo sets it back on its own, or leaves bad numbers; neither is read silently."""
    world = '<body name="ball" pos="0 0 .05"><freejoint/><geom size=".01"/></body>'
    sensor = sensor_in(world, tiny_simulator)
    sensor.read()
    for _ in range(2):
        for _ in range(3):
            mujoco.mj_step(sensor.model, sensor.data)
        sensor.read()
        sensor.data.qvel[:] = np.nan
        mujoco.mj_step(sensor.model, sensor.data)
        with pytest.raises(cs.SceneError, match=r"has diverged .* MuJoCo has set it back"):
            sensor.read()
        sensor.reset()
        sensor.read()
    sensor.data.qpos[:] = np.nan
    mujoco.mj_forward(sensor.model, sensor.data)
    with pytest.raises(cs.SceneError, match=r"the simulation has diverged: 'ball/.*' stands"):
        sensor.read()
    mujoco.mj_resetData(sensor.model, sensor.data)
    mujoco.mj_forward(sensor.model, sensor.data)
    sensor.read()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"site": 0}, "site is 0; give the site's name"),
        ({"groups": 0}, r"groups is 0; give the numbers of geom groups, like \[0, 2\]"),
        ({"groups": "0"}, "groups is '0'"),
        ({"groups": []}, "groups is empty"),
    ],
)
def test_numbers_in_the_place_of_names(
    options: dict[str, Any], message: str, tiny_simulator: cs.Simulator
) -> None:
    """Each says what to give."""
    with pytest.raises(cs.SceneError, match=message):
        sensor_in("", tiny_simulator, **options)


def test_readings_follow_the_simulation(tiny_simulator: cs.Simulator) -> None:
    """A ball that falls towards the sensor is felt more and more."""
    sensor = sensor_in(
        '<body name="ball" pos="0 0 .07"><freejoint/><geom size=".01"/></body>', tiny_simulator
    )
    felt = []
    for _ in range(5):
        felt.append(sensor.read().delta[0, 0])
        mujoco.mj_step(sensor.model, sensor.data, 10)
    assert felt[0] > 0
    assert np.all(np.diff(felt) > 0)


def test_example_models_load(tmp_path: Path, tiny_simulator: cs.Simulator) -> None:
    """A mesh file goes through MuJoCo's own frame of inertia and comes back where it was."""
    box = cs.Box((0.02, 0.03, 0.04)).to_trimesh()
    box.apply_translation((0.01, -0.005, 0.05))
    file = tmp_path / "box.stl"
    box.export(file)
    sensor = sensor_in(
        '<geom type="mesh" mesh="b"/>', tiny_simulator,
        top=f'<asset><mesh name="b" file="{file}"/></asset>',
    )  # fmt: skip
    (body,) = sensor.scene()
    corners = body.pose.apply(body.shape.vertices)
    assert corners.min(axis=0) == approx(box.bounds[0], abs=1e-7)
    assert corners.max(axis=0) == approx(box.bounds[1], abs=1e-7)


@pytest.mark.parametrize(("drawn", "both"), [("obj", 14), ("stl", 7)])
def test_a_robot_that_is_drawn_and_collides(
    drawn: str, both: int, tiny_simulator: cs.Simulator
) -> None:
    """A KUKA of a URDF: of each link what collides is seen; the same mesh twice is seen once."""
    pybullet_data = pytest.importorskip("pybullet_data", reason="PyBullet is not installed")
    folder = Path(pybullet_data.getDataPath()) / "kuka_iiwa"
    text = (folder / "model.urdf").read_text().replace(".obj", f".{drawn}")
    compiler = f'<compiler discardvisual="false" strippath="false" meshdir="{folder}"/>'
    text = text.replace("</robot>", f"<mujoco>{compiler}</mujoco></robot>")
    spec = mujoco.MjSpec.from_string(text)
    cs.mujoco.add_sensor(spec, "lbr_iiwa_link_7", cs.Pose((0, 0, 0.05)))
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for shapes, groups in (("both", None), ("visual", [1]), ("collision", [0])):
        sensor = cs.mujoco.attach(model, data, "pad", tiny_simulator, shapes=shapes)
        assert len(sensor.world.solids) == (both if shapes == "both" else 7)
        assert groups is None or set(model.geom_group[sensor.source.geoms]) == set(groups)
    (found,) = sensor.check()  # the robot behind is no reason to turn the sensor round
    assert "nothing is in view" in found
    assert "faced the other way" not in found


def test_what_collides_stands_for_what_is_drawn(tiny_simulator: cs.Simulator) -> None:
    """Of each body; what nothing that collides stands in for is seen as it is drawn."""
    text = """<mujoco><default><default class="drawn"><geom contype="0" conaffinity="0" group="2"/>
      </default></default><worldbody>
      <geom name="floor" type="plane" size="1 1 1"/><geom name="wall" type="box" size=".1 .1 .1"/>
      <geom name="wall_drawn" class="drawn" type="box" size=".1 .1 .09" pos="0 0 .001"/>
      <geom name="shelf" class="drawn" type="box" size=".1 .1 .01" pos="0 0 .5"/>
      <body name="cup" pos="1 0 1"><geom name="cup" class="drawn" size=".03"/></body>
      <body name="link" pos="0 1 1"><geom name="hull" type="capsule" size=".05 .1"/>
        <geom name="shell" class="drawn" type="capsule" size=".049 .1"/>
        <geom name="cap" class="drawn" size=".04" pos="0 0 .1"/>
        <geom name="lamp" class="drawn" size=".01" pos="0 0 .5"/></body>
      <body name="calf" pos="0 2 1"><freejoint/><geom name="foot" class="drawn" size=".02"/>
        <geom name="shin" class="drawn" type="capsule" size=".02 .1" pos="0 0 .15"/>
        <geom name="toe" class="drawn" size=".01"/></body>
      <site name="pad" pos="0 0 3"/></worldbody>
      <contact><pair geom1="floor" geom2="foot"/></contact></mujoco>"""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    names = [model.geom(k).name for k in range(model.ngeom)]

    def seen(**options: Any) -> set[str]:
        source = ModelSource(model, data, Rules(**options), None)
        return {names[k] for k in source.geoms}

    assert seen() == set(names) - {"wall_drawn", "shell", "cap", "toe"}
    assert seen(shapes="both") == set(names)
    assert seen(shapes="visual") == set(names) - {"wall", "hull", "foot"}
    only = ModelSource(model, data, Rules(), [2]).geoms  # "foot" collides, the others do not
    assert {names[k] for k in only} == set(names) - {"floor", "wall", "hull", "toe"}
    with pytest.raises(ValueError, match="shapes is 'drawn'; choose"):
        cs.mujoco.attach(model, data, "pad", tiny_simulator, shapes="drawn")
