"""Whole people: sizes, postures, one conductor, exports, capacitance to ground."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from approximate import approx
from limb_models import bend_in_mujoco, check_geoms, check_ranges, load_in_pybullet

import capsense as cs
from capsense.errors import SceneError
from capsense.humans import (
    ON_BACK,
    POSTURES,
    Build,
    Limb,
    arm,
    capacitance_to_ground,
    hand,
    leg,
    person,
)
from capsense.solver.tree.matter import matter_of

BUILDS = [Build("male"), Build("female"), Build("female", stature=1.5, girth=1.3)]
REACH = POSTURES["standing"] | {"right_shoulder_flexion": 1.5, "right_wrist_flexion": 0.3}
"""The right arm held out ahead."""
EXTREMES = [
    Build(sex, stature=h, girth=g) for sex, h in (("male", 2.3), ("female", 0.8)) for g in (0.5, 2)
]  # type: ignore[arg-type]
DOWN = cs.Pose((0, 0, 0), (0, math.sqrt(0.5), 0, math.sqrt(0.5)))
"""What is ahead is below."""


def heights(limb: Limb, pose: cs.Pose, angles: Any) -> tuple[float, float]:
    """Lowest and highest point [m]."""
    points = [b.pose.apply(b.shape.to_trimesh().vertices) for b in limb.bodies(pose, angles)]
    z = np.concatenate(points)[:, 2]
    return float(z.min()), float(z.max())


def overlap(first: cs.Body, second: cs.Body) -> float:
    """How deep two capsules lie in each other [m]."""
    half = 0.5 * first.shape.length
    axis = first.pose.apply(np.linspace((0, 0, -half), (0, 0, half), 65))
    off = second.shape.signed_distance(second.pose.inverse().apply(axis))
    return float(first.shape.radius - off.min())


def over_a_sensor(limb: Limb, gap: float, grounding: Any) -> list[cs.Body]:
    """A person whose right hand reaches down to a sensor, the lowest point so high above it [m]."""
    pose = limb.on_floor(REACH, turn=DOWN.quaternion, floor=gap)
    bodies = limb.bodies(pose, REACH, grounding=grounding)
    lowest = min(bodies, key=lambda b: b.pose.position[2])
    x, y, _ = lowest.pose.position
    return [b.moved(cs.Pose((-x, -y, 0)) @ b.pose) for b in bodies]


# -- sizes ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("build", BUILDS + EXTREMES, ids=str)
def test_a_person_is_as_tall_as_its_stature(build: Build) -> None:
    """Standing on the floor, at ease; the soles are level with it."""
    limb = person(build)
    pose = limb.on_floor(POSTURES["standing"], floor=0.02)
    low, high = heights(limb, pose, POSTURES["standing"])
    assert low == approx(0.02, abs=1e-3)
    assert high - low == approx(build.height, abs=5e-3)
    assert sum(s.mass for s in limb.segments) == approx(build.mass, rel=1e-3)


@pytest.mark.parametrize("sex", ["male", "female"])
def test_sizes_that_went_into_no_table(sex: Any) -> None:
    """ANSUR II: sitting height, buttock-knee length, breadth over the shoulders, wrist height."""
    known = {"male": (0.9183, 0.618, 0.5104, 0.8475), "female": (0.8566, 0.5906, 0.4503, 0.7942)}
    limb = person(Build(sex, stature={"male": 1.7562, "female": 1.6285}[sex]))
    where = limb.bodies(angles=POSTURES["sitting"])
    points = {str(b.name): b.pose.apply(b.shape.to_trimesh().vertices) for b in where}
    seat = min(v[:, 2].min() for n, v in points.items() if "pelvis" in n or "thigh" in n)
    top = max(v[:, 2].max() for v in points.values())
    knee = max(v[:, 0].max() for n, v in points.items() if "thigh" in n or "shank" in n)
    back = min(v[:, 0].min() for n, v in points.items() if "pelvis" in n)
    arms = [
        b.pose.apply(b.shape.to_trimesh().vertices) for b in limb.bodies() if "arm" in str(b.name)
    ]
    across = np.concatenate(arms)[:, 1]
    wrist = limb.on_floor().position[2] + limb.forward()["left_hand"].position[2]
    found = (top - seat, knee - back, np.ptp(across), wrist)
    assert np.abs(np.divide(found, known[sex]) - 1).max() < 0.04


def test_limbs_of_a_person_are_those_alone() -> None:
    """Arms and legs as made alone, hung on the shoulders and hips."""
    build = Build("female", girth=1.2)
    whole = {s.name: s for s in person(build, hands="detailed").segments}
    for side in ("left", "right"):
        for limb in (arm(build, side, hand="detailed"), leg(build, side)):  # type: ignore[arg-type]
            for segment in limb.segments:
                hung = whole[f"{side}_{segment.name}"]
                assert hung.parts == segment.parts
                assert [j.axis for j in hung.joints] == [j.axis for j in segment.joints]
    assert whole["left_upper_arm"].parent == "chest"
    assert whole["right_thigh"].parent == "pelvis"
    assert whole["left_thigh"].origin[1] == approx(0.5 * build.hip_spacing)
    both = [b for name in ("anna", "ben") for b in person(build, name=name).bodies()]
    assert cs.Scene(both)["anna_left_foot_1"].shape == cs.Scene(both)["ben_left_foot_1"].shape
    with pytest.raises(SceneError, match="hand is 'none'; choose"):
        person(hands="none")  # type: ignore[arg-type]


# -- joints and postures ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("joint", "segment", "point", "direction"),
    [
        ("lumbar_flexion", "chest", (0, 0, 1), (1, 0, 0)),
        ("lumbar_lateral", "chest", (0, 0, 1), (0, 1, 0)),
        ("lumbar_rotation", "chest", (1, 0, 0), (0, 1, 0)),
        ("neck_flexion", "head", (0, 0, 1), (1, 0, 0)),
        ("neck_lateral", "head", (0, 0, 1), (0, 1, 0)),
        ("neck_rotation", "head", (1, 0, 0), (0, 1, 0)),
        ("left_shoulder_abduction", "left_upper_arm", (0, 0, -1), (0, 1, 0)),
        ("right_hip_abduction", "right_thigh", (0, 0, -1), (0, -1, 0)),
    ],
)
def test_joints_bend_as_they_are_called(
    joint: str, segment: str, point: Any, direction: Any
) -> None:
    """Which way a small positive angle moves a point of the segment."""
    move = [person().forward({joint: a})[segment].apply(point) for a in (0.0, 0.1)]
    assert np.dot(move[1] - move[0], np.asarray(direction, dtype=float)) > 0.09


def test_sides_mirror() -> None:
    """Angles swapped between the sides, and sideways ones negated: the mirror image."""
    limb, rng = person(hands="detailed"), np.random.default_rng(4)
    angles = {j.name: float(rng.uniform(j.lower, j.upper)) for j in limb.joints}
    swap = {"left": "right", "right": "left"}
    mirrored = {}
    for name, angle in angles.items():
        side, _, rest = name.partition("_")
        if side in swap:
            mirrored[f"{swap[side]}_{rest}"] = angle
        else:
            mirrored[name] = -angle if name.endswith(("lateral", "rotation")) else angle

    def points(angles: dict[str, float]) -> np.ndarray:
        found = [
            np.append(b.pose.apply((0, 0, h * b.shape.length / 2)), b.shape.radius)
            for b in limb.bodies(angles=angles)
            for h in (-1, 1)
        ]
        return np.array(found)

    one, other = points(angles) * (1, -1, 1, 1), points(mirrored)
    apart = np.abs(one[:, None] - other).max(axis=2)
    assert apart.min(axis=1).max() < 1e-9
    assert apart.min(axis=0).max() < 1e-9


@pytest.mark.parametrize("posture", list(POSTURES))
@pytest.mark.parametrize("build", BUILDS, ids=str)
def test_postures_keep_the_limbs_apart(posture: str, build: Build) -> None:
    """Arms beside trunk and legs; thighs touch at the top. At more girth, arms press in."""
    bodies = person(build, hands="detailed").bodies(angles=POSTURES[posture])
    kinds = {
        "trunk": ("pelvis", "chest", "neck", "head"),
        "left_arm": ("left_forearm", "left_palm", "left_thumb", "left_index", "left_little"),
        "right_arm": ("right_forearm", "right_palm", "right_thumb", "right_index"),
        "left_leg": ("left_shank", "left_foot", "left_thigh"),
        "right_leg": ("right_shank", "right_foot", "right_thigh"),
    }
    of = {
        kind: [b for b in bodies if str(b.name).removeprefix("person_").startswith(names)]
        for kind, names in kinds.items()
    }
    for first, second, most in (
        ("left_arm", "trunk", 0.01),
        ("right_arm", "trunk", 0.01),
        ("left_arm", "left_leg", 0.01),
        ("right_arm", "right_leg", 0.01),
        ("left_leg", "right_leg", 0.065),
    ):
        deep = max(overlap(a, b) for a in of[first] for b in of[second])
        assert deep < most + 0.25 * (build.girth - 1.0), (first, second)
    feet = [[b for b in of[f"{s}_leg"] if "thigh" not in str(b.name)] for s in ("left", "right")]
    assert max(overlap(a, b) for a in feet[0] for b in feet[1]) < 0


def test_on_floor() -> None:
    """Lying on the back: as low as the trunk is deep, faces up, head to -x."""
    limb = person()
    pose = limb.on_floor(POSTURES["lying"], turn=ON_BACK, floor=0.5)
    low, high = heights(limb, pose, POSTURES["lying"])
    assert low == approx(0.5, abs=1e-3)
    assert 0.2 < high - low < 0.32
    where = limb.forward(POSTURES["lying"])
    assert (pose @ where["head"]).position[0] < -0.7
    assert pose.rotation[:, 0] == approx(np.array((0, 0, 1)), abs=1e-9)


# -- one conductor ---------------------------------------------------------------------------------


@pytest.mark.parametrize("hands", ["simple", "detailed"])
@pytest.mark.parametrize("build", BUILDS + EXTREMES, ids=str)
def test_a_person_is_one_conductor(build: Build, hands: Any) -> None:
    """All parts touch, in all postures and at any angles."""
    limb = person(build, hands=hands)
    rng = np.random.default_rng(6)
    anyhow = [{j.name: float(rng.uniform(j.lower, j.upper)) for j in limb.joints} for _ in range(3)]
    for angles in (*POSTURES.values(), *anyhow):
        named = limb.bodies(angles=angles, grounding="floating")
        bodies = [cs.Body(b.shape, b.pose, b.material, "floating") for b in named]
        scene = cs.Scene(bodies)
        joined = matter_of(bodies, 250e3).joined(scene, scene.pack(), np.arange(len(bodies)))
        assert len(set(joined.group.tolist())) == 1


def test_parts_outside_the_domain_tie_a_person(simulators: Callable[..., cs.Simulator]) -> None:
    """A person on 100 pF reads as what is in the domain does; one that floats is tied by the
    capacitance of the rest in free space, some 40 pF; cut in two, a capsule reads the same."""
    grounding = 100e-12
    simulator = simulators("six_patch_bare")
    bodies = over_a_sensor(person(hands="detailed"), 0.05, grounding)
    scene = cs.Scene(bodies)
    low, high = simulator.design.domain.sight
    bounds = scene.pack().bounds
    seen = [
        b for b, (a, z) in zip(bodies, bounds, strict=True) if (a < high).all() and (z > low).all()
    ]
    assert 15 < len(seen) < 40
    whole = simulator.step(scene).delta

    def tied(parts: list[cs.Body]) -> list[cs.Body]:
        return [cs.Body(b.shape, b.pose, b.material, grounding, conductor="p") for b in parts]

    alone = simulator.step(cs.Scene(tied(seen))).delta
    assert np.abs(alone - whole).max() < 1e-9 * np.abs(whole).max()
    floats = [cs.Body(b.shape, b.pose, b.material, "floating", conductor="p") for b in bodies]
    lone = [cs.Body(b.shape, b.pose, b.material, 40e-12, conductor="p") for b in seen]
    on_rest, on_40 = (simulator.step(cs.Scene(parts)).delta for parts in (floats, lone))
    assert np.abs(on_rest - on_40).max() < 0.01 * np.abs(whole).max()
    alone = simulator.step(cs.Scene([b for b in floats if b.pose in {s.pose for s in seen}])).delta
    assert np.abs(on_rest - alone).max() > 0.05 * np.abs(whole).max()
    halves: list[cs.Body] = []
    for body in seen:
        if "index_proximal" in str(body.name):
            half = 0.5 * body.shape.length
            at = [cs.Pose((0, 0, s * half / 2)) for s in (-1, 1)]
            shape = cs.Capsule(body.shape.radius, half)
            halves += [cs.Body(shape, body.pose @ p, body.material, body.grounding) for p in at]
        else:
            halves.append(body)
    assert len(halves) == len(seen) + 1
    cut = simulator.step(cs.Scene(tied(halves))).delta
    assert np.abs(cut - whole).max() < 0.01 * np.abs(whole).max()


# -- exports ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("hands", ["simple", "detailed"])
def test_mjcf_of_a_person(hands: Any) -> None:
    """Differential: MuJoCo's kinematics, on a free joint, all joints bent; no contacts at ease."""
    mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    limb = person(Build("female"), hands=hands)
    base = limb.on_floor(POSTURES["standing"], turn=(0.1, 0.2, 0.3, 0.9))
    model = mujoco.MjModel.from_xml_string(limb.mjcf(base, free=True))
    data = mujoco.MjData(model)
    bend_in_mujoco(mujoco, model, data, limb, POSTURES["standing"])
    assert data.ncon == 0
    rng = np.random.default_rng(8)
    angles = {j.name: float(rng.uniform(j.lower, j.upper)) for j in limb.joints}
    bend_in_mujoco(mujoco, model, data, limb, angles)
    check_geoms(data, limb.bodies(base, angles))
    assert model.body_mass.sum() == approx(Build("female").mass, rel=1e-3)
    assert model.nq == 7 + len(limb.joints)
    check_ranges(model, limb)
    fixed = mujoco.MjModel.from_xml_string(limb.mjcf(base))
    assert fixed.nq == len(limb.joints)
    for alone in (arm(), hand()):
        with pytest.raises(SceneError, match=r"nothing of right_.* is fixed to its frame"):
            alone.mjcf(free=True)


@pytest.mark.parametrize("hands", ["simple", "detailed"])
def test_urdf_of_a_person(hands: Any, tmp_path: Path) -> None:
    """Differential: PyBullet's kinematics, all joints bent; links below its limit of 127."""
    p = pytest.importorskip("pybullet", reason="PyBullet is not installed")
    limb = person(hands=hands)
    client = p.connect(p.DIRECT)
    try:
        base = cs.Pose((0.1, 0.2, 1.4), (0.1, 0.2, 0.3, 0.9))
        rng = np.random.default_rng(9)
        angles = {j.name: float(rng.uniform(j.lower, j.upper)) for j in limb.joints}
        body, links = load_in_pybullet(p, client, limb, base, angles, tmp_path)
        assert p.getNumJoints(body, physicsClientId=client) < 128
        where = limb.forward(angles)
        for segment in limb.segments:
            link = links[f"person_{segment.name}"]
            state = p.getLinkState(body, link, computeForwardKinematics=1, physicsClientId=client)
            expected = base @ where[segment.name]
            assert cs.Pose(*state[4:6]).matrix == approx(expected.matrix, abs=1e-5)
            shapes = p.getCollisionShapeData(body, link, physicsClientId=client)
            assert len(shapes) == len(segment.parts)
    finally:
        p.disconnect(physicsClientId=client)


# -- capacitance to ground -------------------------------------------------------------------------


def test_capacitance_to_ground() -> None:
    """The range that is measured, 100 to 150 pF in shoes by an AC bridge; the laws of its parts."""
    for footwear, low, high in (("thick soles", 95e-12, 110e-12), ("shoes", 140e-12, 155e-12)):
        for posture in ("standing", "sitting"):
            assert low < capacitance_to_ground(posture, footwear) < high
    kinds = ("barefoot", "thin soles", "shoes", "thick soles")
    found = [capacitance_to_ground("standing", k) for k in kinds]
    assert found == sorted(found, reverse=True)
    assert found[0] < 400e-12
    assert capacitance_to_ground() == capacitance_to_ground("standing", 0.010)
    thin, thick = (capacitance_to_ground("standing", d) for d in (0.01, 0.02))
    soles = 2 * 8.854e-12 * 3.0 * 0.015
    assert thin - thick == approx(soles / 0.01 - soles / 0.02, rel=1e-3)
    assert capacitance_to_ground("lying", "shoes") == capacitance_to_ground("lying", "thin soles")
    lying = capacitance_to_ground("lying")
    small = capacitance_to_ground("lying", build=Build(stature=1.7562 / 2))
    assert lying == approx(2 * small)
    whole = capacitance_to_ground("sitting", "thick soles")
    assert {b.grounding for b in person().bodies(grounding=whole)} == {whole}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"posture": "siting"}, "no posture 'siting'; did you mean 'sitting'"),
        ({"footwear": "boots"}, "no footwear 'boots'; .*valid are barefoot, .*in metres"),
        ({"footwear": 10.0}, "footwear is 10.0; give the thickness of the soles, 0.0001 to 0.2 m"),
        ({"footwear": math.nan}, "footwear is nan"),
    ],
)
def test_wrong_footwear_is_refused(options: Any, message: str) -> None:
    """By name, value and range."""
    with pytest.raises(SceneError, match=message):
        capacitance_to_ground(**options)
