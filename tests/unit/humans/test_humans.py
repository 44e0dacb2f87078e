"""Limbs: sizes against the tables, joints against anatomy, exports against simulators."""

from __future__ import annotations

import itertools
import math
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from approximate import approx
from limb_models import bend_in_mujoco, check_geoms, check_ranges, load_in_pybullet

import capsense as cs
from capsense.errors import MissingDependencyError, SceneError
from capsense.humans import Build, Limb, Segment, arm, hand, leg, load_smplx
from capsense.humans.formats import close_openings, mjcf_body
from capsense.scene import Ties
from capsense.solver.tree.matter import matter_of

LIMBS = [make(side=side) for make in (arm, leg, hand) for side in ("left", "right")]  # type: ignore[arg-type]


def random_angles(limb: Limb, seed: int) -> dict[str, float]:
    """Angles [rad] anywhere within the ranges."""
    rng = np.random.default_rng(seed)
    return {j.name: float(rng.uniform(j.lower, j.upper)) for j in limb.joints}


def conductors(bodies: list[cs.Body]) -> int:
    """How many conductors bodies are, by what touches what, whatever their names."""
    bodies = [cs.Body(b.shape, b.pose, b.material, "floating") for b in bodies]
    scene = cs.Scene(bodies)
    joined = matter_of(bodies, 250e3).joined(scene, scene.pack(), np.arange(len(bodies)))
    return len(set(joined.group.tolist()))


def lowest(limb: Limb) -> float:
    """Height [m] of the lowest point, hanging at rest."""
    return min(
        float(b.pose.apply(b.shape.to_trimesh().vertices)[:, 2].min()) for b in limb.bodies()
    )


# -- sizes ---------------------------------------------------------------------------------------


def test_stature_by_percentile() -> None:
    """The 5th and 95th percentile that the spread was made from, to their rounding."""
    for sex, low, high in (("male", 1.649, 1.869), ("female", 1.518, 1.724)):
        found = [Build(sex, percentile=q).height for q in (5, 95)]  # type: ignore[arg-type]
        assert found[1] - found[0] == approx(high - low, abs=5e-4)
        assert found == approx([low, high], abs=0.01)


def test_sizes_follow_the_tables() -> None:
    """Measured back from the capsules: lengths, circumferences, the hand's section."""
    build = Build("female", stature=1.70, girth=1.1)
    segments = {s.name: s for s in arm(build).segments}
    assert -segments["forearm"].origin[2] == approx(0.186 * 1.70)
    assert -segments["hand"].origin[2] == approx(0.146 * 1.70)
    around = max(p.radius for p in segments["forearm"].parts) * 2 * math.pi
    assert around == approx(0.2641 * 1.1 * 1.70 / 1.6285)
    fingers = segments["hand"].parts[:4]
    thickness = 2 * fingers[0].radius
    breadth = fingers[3].start[0] - fingers[0].start[0] + thickness
    assert breadth == approx(0.0782 * 1.1 * 1.70 / 1.6285)
    section = 2 * (breadth - thickness) + math.pi * thickness
    assert section == approx(0.1866 * 1.1 * 1.70 / 1.6285)
    assert lowest(arm(build)) == approx(-(0.186 + 0.146 + 0.108) * 1.70, abs=2e-4)
    assert lowest(leg(build)) == approx(-(0.245 + 0.246 + 0.039) * 1.70, abs=2e-4)


@pytest.mark.parametrize("sex", ["female", "male"])
def test_hands_follow_the_tables(sex: Any) -> None:
    """Length over all, bones of the fingers, breadth over the knuckles, mass."""
    build = Build(sex, girth=1.1)
    limb = hand(build)
    assert lowest(limb) == approx(-build.length("hand"), abs=2e-4)
    where = limb.forward()
    for finger, bones in {"index": (0.245, 0.143), "little": (0.204, 0.117)}.items():
        ends = [where[f"{finger}_{k}"].position for k in ("proximal", "intermediate", "distal")]
        found = [math.dist(a, b) for a, b in itertools.pairwise(ends)]
        assert found == approx(np.array(bones) * build.length("hand") / 0.99, rel=1e-3)
    across = [p.end[0] + side * p.radius for p in limb.segments[0].parts for side in (-1, 1)]
    assert max(across) - min(across) == approx(build.hand_breadth, rel=0.03)
    assert sum(s.mass for s in limb.segments) == approx(0.006 * build.mass)
    detailed = {s.name: s for s in arm(build, hand="detailed").segments}
    assert detailed["palm"].parent == "forearm"
    assert detailed["palm"].origin == approx(np.array((0, 0, -build.length("forearm"))))
    for segment in limb.segments[1:]:
        assert detailed[segment.name] == segment


@pytest.mark.parametrize("limb", LIMBS, ids=lambda k: k.name)
def test_a_limb_is_one_conductor(limb: Limb) -> None:
    """All parts hang together, at any angles; fingers without their palm do not."""
    for seed in range(3):
        bodies = limb.bodies(angles=random_angles(limb, seed), grounding="floating")
        assert conductors(bodies) == 1
    if "hand" in limb.name:
        assert conductors([b for b in limb.bodies() if "palm" not in str(b.name)]) > 1


def test_trees_are_checked() -> None:
    """A segment that hangs on what comes later, or on nothing."""
    palm, thumb, *_ = sorted(
        hand().segments, key=lambda s: s.name not in ("palm", "thumb_metacarpal")
    )
    with pytest.raises(
        cs.SceneError, match="thumb_metacarpal hangs on 'palm', which is no segment"
    ):
        Limb("a", (thumb, palm))
    with pytest.raises(cs.SceneError, match="b hangs on 'trunk'"):
        Limb("a", (Segment("b", (0, 0, 0), (), palm.parts, 1.0, "trunk"),))


@pytest.mark.parametrize("sex", ["female", "male"])
def test_densities_are_those_of_tissue(sex: Any) -> None:
    """A check between independent tables: mass of a limb over the volume of its capsules."""
    for make in (arm, leg):
        limb = make(Build(sex))
        hull = 0.0
        for segment in limb.segments[:2]:  # hands and feet are rough
            profile = [
                max(p.radius for p in segment.parts if p.start[2] >= z >= p.end[2])
                for z in np.linspace(0, -abs(segment.parts[-1].end[2]), 200)
            ]
            hull += np.mean(np.square(profile)) * math.pi * abs(segment.parts[-1].end[2])
        mass = sum(s.mass for s in limb.segments[:2])
        assert 700 < mass / hull < 1400


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sex": "m"}, "sex is 'm'; choose \"female\""),
        ({"stature": 176}, "stature is 176; give a number from 0.8 to 2.3 m"),
        ({"percentile": 0}, "percentile is 0"),
        ({"girth": "wide"}, "girth is 'wide'"),
    ],
)
def test_wrong_builds_are_refused(options: Any, message: str) -> None:
    """By name, value and range."""
    with pytest.raises(cs.SceneError, match=message):
        Build(**options)


# -- joints --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("joint", "segment", "point", "direction"),
    [
        ("shoulder_flexion", "upper_arm", (0, 0, -1), (1, 0, 0)),
        ("shoulder_abduction", "upper_arm", (0, 0, -1), "out"),
        ("shoulder_rotation", "upper_arm", (1, 0, 0), "in"),
        ("elbow_flexion", "forearm", (0, 0, -1), (1, 0, 0)),
        ("forearm_pronation", "forearm", (1, 0, 0), "in"),
        ("wrist_flexion", "hand", (0, 0, -1), "in"),
        ("wrist_deviation", "hand", (0, 0, -1), (1, 0, 0)),
        ("hip_flexion", "thigh", (0, 0, -1), (1, 0, 0)),
        ("hip_abduction", "thigh", (0, 0, -1), "out"),
        ("hip_rotation", "thigh", (1, 0, 0), "in"),
        ("knee_flexion", "shank", (0, 0, -1), (-1, 0, 0)),
        ("ankle_flexion", "foot", (1, 0, 0), (0, 0, 1)),
        ("ankle_inversion", "foot", (0, 0, -1), "in"),
        ("index_mcp_flexion", "index_proximal", (0, 0, -1), "in"),
        ("index_mcp_abduction", "index_proximal", (0, 0, -1), (1, 0, 0)),
        ("middle_mcp_abduction", "middle_proximal", (0, 0, -1), (1, 0, 0)),
        ("ring_mcp_abduction", "ring_proximal", (0, 0, -1), (-1, 0, 0)),
        ("little_mcp_abduction", "little_distal", (0, 0, -1), (-1, 0, 0)),
        ("ring_pip_flexion", "ring_distal", (0, 0, -1), "in"),
        ("middle_dip_flexion", "middle_distal", (0, 0, -1), "in"),
        ("thumb_cmc_flexion", "thumb_distal", (0.5, 0, -0.866), (-0.866, 0, -0.5)),
        ("thumb_cmc_abduction", "thumb_distal", (0.5, 0, -0.866), "in"),
        ("thumb_mcp_flexion", "thumb_proximal", (0.707, 0, -1.225), "in"),
        ("thumb_ip_flexion", "thumb_distal", (0.707, 0, -1.225), (-0.866, 0, -0.5)),
    ],
)
@pytest.mark.parametrize("side", ["left", "right"])
def test_joints_bend_as_they_are_called(
    joint: str, segment: str, point: Any, direction: Any, side: Any
) -> None:
    """Anatomy: which way a small positive angle moves a point of the segment."""
    inwards = np.array((0, 1, 0) if side == "right" else (0, -1, 0))
    towards = {"in": inwards, "out": -inwards}.get(str(direction), direction)
    limb = next(
        k
        for k in (arm(side=side), leg(side=side), hand(side=side))
        if joint in {j.name for j in k.joints}
    )
    move = [limb.forward({joint: a})[segment].apply(point) for a in (0.0, 0.1)]
    assert np.dot(move[1] - move[0], np.asarray(towards, dtype=float)) > 0.09


@pytest.mark.parametrize("limb", LIMBS, ids=lambda k: k.name)
def test_sides_mirror(limb: Limb) -> None:
    """The left limb is the right one's mirror image, at any angles."""
    other = next(k for k in LIMBS if k.name != limb.name and k.name[-3:] == limb.name[-3:])
    angles = random_angles(limb, 1)
    for a, b in zip(limb.bodies(angles=angles), other.bodies(angles=angles), strict=True):
        assert b.shape == a.shape
        ends = [k.pose.apply([[0, 0, h * k.shape.length / 2] for h in (-1, 1)]) for k in (a, b)]
        assert ends[1] * (1, -1, 1) == approx(ends[0], abs=1e-12)


def test_wrong_angles_are_refused() -> None:
    """A joint there is not, or one bent too far, in degrees."""
    with pytest.raises(cs.SceneError, match="no joint 'elbow'; did you mean 'elbow_flexion'"):
        arm().forward({"elbow": 0.1})
    with pytest.raises(cs.SceneError, match="elbow_flexion is 160 degrees; it bends from 0 to 150"):
        arm().forward({"elbow_flexion": 160}, degrees=True)
    with pytest.raises(cs.SceneError, match="elbow_flexion is nan degrees"):
        arm().forward({"elbow_flexion": math.nan})
    with pytest.raises(cs.SceneError, match="side is 'middle'"):
        leg(side="middle")  # type: ignore[arg-type]
    with pytest.raises(cs.SceneError, match='hand is \'rough\'; choose "simple" or "detailed"'):
        arm(hand="rough")  # type: ignore[arg-type]
    with pytest.raises(cs.SceneError, match="pose is"):
        arm().bodies((0, 0, 0))  # type: ignore[arg-type]


def test_a_person_is_tied_to_ground_once() -> None:
    """The bodies of a limb are one conductor of its name, on the whole capacitance."""
    for tie in (100e-12, "floating", Ties(100e-12, 20e-12)):
        found = {(b.grounding, b.conductor) for b in arm().bodies(grounding=tie)}
        assert found == {(tie, "right_arm")}
    with pytest.raises(SceneError, match=r"which a MuJoCo model cannot say.*attach"):
        arm().mjcf(grounding=Ties(100e-12, 20e-12))
    assert {b.material.name for b in arm().bodies(material="skin")} == {"skin"}


# -- exports -------------------------------------------------------------------------------------


@pytest.mark.parametrize("limb", LIMBS, ids=lambda k: k.name)
def test_mjcf_stands_as_the_limb_does(limb: Limb) -> None:
    """Differential: MuJoCo's kinematics against ours, all joints bent; masses add up."""
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    base = cs.Pose((0.1, 0.2, 1.4), (0.1, 0.2, 0.3, 0.9))
    model = mujoco.MjModel.from_xml_string(limb.mjcf(base))
    data = mujoco.MjData(model)
    angles = random_angles(limb, 2)
    bend_in_mujoco(mujoco, model, data, limb, angles)
    bodies = limb.bodies(base, angles)
    check_geoms(data, bodies)
    for body in bodies:
        size = model.geom(str(body.name)).size
        assert isinstance(body.shape, cs.Capsule)
        assert (size[0], 2 * size[1]) == approx((body.shape.radius, body.shape.length))
    assert model.body_mass.sum() == approx(sum(s.mass for s in limb.segments))
    check_ranges(model, limb)
    pasted = f"<mujoco><worldbody>{mjcf_body(limb, base)}</worldbody></mujoco>"
    assert mujoco.MjModel.from_xml_string(pasted).nq == model.nq


@pytest.mark.parametrize("limb", LIMBS, ids=lambda k: k.name)
def test_urdf_stands_as_the_limb_does(limb: Limb, tmp_path: Path) -> None:
    """Differential: PyBullet's kinematics and shapes against ours, all joints bent."""
    p = pytest.importorskip("pybullet", reason="PyBullet is not installed")
    client = p.connect(p.DIRECT)
    try:
        base = cs.Pose((0.1, 0.2, 1.4), (0.1, 0.2, 0.3, 0.9))
        angles = random_angles(limb, 3)
        body, links = load_in_pybullet(p, client, limb, base, angles, tmp_path)
        assert len(links) == len(limb.joints)
        where = limb.forward(angles)
        for segment in limb.segments:
            link = links[f"{limb.name}_{segment.name}"]
            state = p.getLinkState(body, link, computeForwardKinematics=1, physicsClientId=client)
            expected = base @ where[segment.name]
            assert cs.Pose(*state[4:6]).matrix == approx(expected.matrix, abs=1e-5)
            shapes = p.getCollisionShapeData(body, link, physicsClientId=client)
            for found, part in zip(shapes, segment.parts, strict=True):
                assert found[3][:2] == approx((part.shape.length, part.radius))
                middle = cs.Pose(*state[:2]) @ cs.Pose(*found[5:7])
                assert middle.position == approx((expected @ part.pose).position, abs=1e-5)
                axes = middle.rotation[:, 2] @ (expected @ part.pose).rotation[:, 2]
                assert axes == approx(1, abs=1e-5)
    finally:
        p.disconnect(physicsClientId=client)


def test_an_attached_sensor_knows_a_limb(simulators: Any) -> None:
    """The texts of the MJCF carry over: human, one conductor on 100 pF."""
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    model = mujoco.MjSpec.from_string(arm().mjcf(cs.Pose((0, 0, 0.1))))
    model.worldbody.add_site(name="pad", pos=(0.0, 0.1, -0.1), quat=(0.7071, 0.7071, 0, 0))
    compiled = model.compile()
    data = mujoco.MjData(compiled)
    mujoco.mj_forward(compiled, data)
    scene = cs.mujoco.attach(compiled, data, "pad", simulators("six_patch_bare")).scene()
    assert len(scene) > 2
    assert {b.material.name for b in scene} == {"human"}
    assert {b.grounding for b in scene} == {100e-12}
    assert len({b.conductor for b in scene}) == 1


# -- meshes --------------------------------------------------------------------------------------


def open_box() -> tuple[np.ndarray, np.ndarray]:
    """A box of 0.4 x 0.5 x 0.6 m without its lid and its floor."""
    mesh = cs.Box((0.4, 0.5, 0.6)).to_trimesh()
    keep = np.abs(mesh.face_normals[:, 2]) < 0.5
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)[keep]


def test_openings_are_closed() -> None:
    """A box without lid and floor has its volume again."""
    shape = cs.TriMesh(*close_openings(*open_box()))
    assert shape.volume == approx(0.4 * 0.5 * 0.6)


def test_smplx_without_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error gives the command."""
    monkeypatch.setitem(sys.modules, "smplx", None)
    with pytest.raises(MissingDependencyError, match="pip install smplx"):
        load_smplx("models")


def test_smplx_with_a_stand_in(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The calls that the loader makes, on a stand-in of the package."""
    vertices = open_box()[0]
    asked: dict[str, Any] = {}

    class Tensor:
        def __init__(self, array: np.ndarray) -> None:
            self.array = array

        def detach(self) -> Tensor:
            return self

        cpu = detach

        def numpy(self) -> np.ndarray:
            return self.array

    class Model:
        faces = open_box()[1]

        def forward(self, betas: Any = None, return_verts: bool = True, **_: Any) -> Any:
            assert return_verts
            if betas.array.shape != (1, 10):
                raise RuntimeError("einsum(): subscript l")
            return types.SimpleNamespace(vertices=Tensor(vertices[None].astype(np.float32)))

        __call__ = forward

    def create(path: str, **options: Any) -> Model:
        asked.update(options, path=path)
        assert options["gender"] != "male", "Path SMPLX_MALE.npz does not exist!"
        return Model()

    monkeypatch.setitem(sys.modules, "smplx", types.SimpleNamespace(create=create))
    monkeypatch.setitem(sys.modules, "torch", types.SimpleNamespace(from_numpy=Tensor))
    shape = load_smplx(tmp_path, gender="female", betas=np.zeros(10))
    assert asked == {"path": str(tmp_path), "model_type": "smplx", "gender": "female"}
    assert shape.volume == approx(0.12, rel=1e-5)
    with pytest.raises(cs.SceneError, match="betas holds a number"):
        load_smplx(tmp_path, betas=[math.nan] * 10)
    with pytest.raises(cs.SceneError, match="has no parameter 'bets'; did you mean 'betas'"):
        load_smplx(tmp_path, bets=[0.0] * 10)
    with pytest.raises(cs.SceneError, match=r"refuses \['betas'\]: einsum"):
        load_smplx(tmp_path, betas=[0.0] * 3)
    with pytest.raises(cs.SceneError, match=r"holds no male smplx model: .*does not exist"):
        load_smplx(tmp_path, gender="male")
    with pytest.raises(cs.SceneError, match="there are no model files"):
        load_smplx(tmp_path / "gone")
