"""Hands that follow a tracker: where their segments stand, and what errors do to them."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

import capsense as cs
from capsense.errors import SceneError
from capsense.humans import Build, TrackedHand, arm, hand
from capsense.humans.tracked_hand import BONES
from capsense.humans.tracking import CONVENTIONS, TIPS

SIDES = ("left", "right")


def random_state(model: TrackedHand, rng: np.random.Generator) -> tuple[dict[str, float], cs.Pose]:
    """Angles anywhere within the ranges [rad], and any pose."""
    angles = {j.name: float(rng.uniform(j.lower, j.upper)) for j in model.limb.joints}
    return angles, cs.Pose(rng.uniform(-0.3, 0.3, 3), rng.normal(size=4))


def tips(model: TrackedHand, poses: dict[str, cs.Pose]) -> np.ndarray:
    """Where the model's fingers end, on the skin [m], shape (5, 3)."""
    out = []
    for names in BONES:
        part = next(s for s in model.limb.segments if s.name == names[2]).parts[0]
        end = np.array(part.end)
        out.append(poses[names[2]].apply(end * (1 + part.radius / np.linalg.norm(end))))
    return np.array(out)


def any_build(rng: np.random.Generator) -> Build:
    return Build(str(rng.choice(["male", "female"])), percentile=rng.uniform(5, 95))  # type: ignore[arg-type]


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("seed", range(3))
def test_joints_there_and_back(convention: str, side: Any, seed: int) -> None:
    """Angles to joints of a tracker, to segments: poses and bodies to rounding."""
    rng = np.random.default_rng(seed)
    model = TrackedHand(any_build(rng), side, convention)
    for _ in range(10):
        angles, pose = random_state(model, rng)
        joints = model.joints(angles, pose)
        assert joints.shape == (CONVENTIONS[convention].count, 3)
        landmarks = model.landmarks(joints)
        found, wanted = model.poses(landmarks), model.limb.forward(angles)
        assert found.keys() == wanted.keys()
        for name, there in found.items():
            np.testing.assert_allclose(there.matrix, (pose @ wanted[name]).matrix, atol=1e-12)
        for one, two in zip(model.bodies(landmarks), model.limb.bodies(pose, angles), strict=True):
            assert (one.name, one.shape) == (two.name, two.shape)
            np.testing.assert_allclose(one.pose.matrix, two.pose.matrix, atol=1e-12)
        np.testing.assert_allclose(landmarks[list(TIPS)], tips(model, found), atol=1e-12)


def test_every_convention_tells_the_same() -> None:
    rng = np.random.default_rng(7)
    models = [TrackedHand(convention=c) for c in CONVENTIONS]
    angles, pose = random_state(models[0], rng)
    first, *others = (m.landmarks(m.joints(angles, pose)) for m in models)
    for other in others:
        np.testing.assert_allclose(other, first, atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_mirror_images(seed: int) -> None:
    """What the left hand does in a mirror, the right one does."""
    rng = np.random.default_rng(seed)
    left, right = (TrackedHand(side=side) for side in SIDES)  # type: ignore[arg-type]
    angles, pose = random_state(left, rng)
    mirror = np.array([1.0, -1.0, 1.0])
    one = left.landmarks(left.joints(angles))
    two = right.landmarks(right.joints(angles))
    np.testing.assert_allclose(one * mirror, two, atol=1e-12)
    axes = right.poses(pose.apply(two))
    for name, there in left.poses(one).items():
        np.testing.assert_allclose(
            pose.apply(np.array(there.position) * mirror), axes[name].position, atol=1e-12
        )


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("seed", range(3))
def test_noise_and_another_size(convention: str, seed: int) -> None:
    """Of another person, with noise: fingertips are where they were tracked, and every bone is
    off by no more than half of what its length is."""
    rng = np.random.default_rng(seed)
    person = TrackedHand(Build("female", percentile=10), "left", convention)
    model = TrackedHand(Build("male", percentile=90), "left", convention)
    angles, pose = random_state(person, rng)
    landmarks = person.landmarks(person.joints(angles, pose))
    landmarks += 2e-3 * rng.normal(size=landmarks.shape)
    found = model.poses(landmarks)
    np.testing.assert_allclose(tips(model, found), landmarks[list(TIPS)], atol=1e-12)
    segments = {s.name: s for s in model.limb.segments}
    for i, names in enumerate(BONES):
        for k, (name, after) in enumerate(pairwise(names)):
            start, end = landmarks[1 + 4 * i + k], landmarks[2 + 4 * i + k]
            length = np.linalg.norm(segments[after].origin)
            off = 0.5 * abs(np.linalg.norm(end - start) - length)
            here = found[name]
            assert np.linalg.norm(here.apply(segments[after].origin) - end) < off + 1e-12
            assert np.linalg.norm(np.array(here.position) - start) < off + 1e-12


@pytest.mark.parametrize("seed", range(3))
def test_fit_takes_lengths_from_the_tracker(seed: int) -> None:
    """Frames of another person: the fitted hand fits them; thicknesses stay those of the build.

    With noise of 1 mm per axis, medians over 408 frames have a standard deviation of 0.09 mm, and
    noise makes every distance longer: by its variance across the bone over the length.
    """
    rng = np.random.default_rng(seed)
    person = TrackedHand(any_build(rng), "right")
    model = TrackedHand(Build(), "right")
    exact = np.array([person.landmarks(person.joints(*random_state(person, rng)))
                      for _ in range(12)])  # fmt: skip
    fitted = model.fit(exact)
    assert fitted.limb.joints == model.limb.joints
    palm, *others = fitted.limb.segments
    knuckles = [s.origin for s in others if s.name.endswith("_proximal") and "thumb" not in s.name]
    np.testing.assert_allclose([p.end for p in palm.parts], knuckles, atol=1e-12)
    wanted = person.limb.segments[0].parts
    np.testing.assert_allclose(
        [p.start for p in palm.parts], [p.start for p in wanted], atol=2e-3
    )  # estimated: they scale with the knuckles
    for one, two in zip(fitted.limb.segments, model.limb.segments, strict=True):
        assert [p.radius for p in one.parts] == [p.radius for p in two.parts]
    for landmarks in exact:
        found = fitted.poses(landmarks)
        for i, names in enumerate(BONES):
            for k, name in enumerate(names):
                np.testing.assert_allclose(
                    found[name].position, landmarks[1 + 4 * i + k], atol=1e-9
                )
    again = np.repeat(exact, 34, axis=0)
    noisy = model.fit(again + 1e-3 * rng.normal(size=again.shape))
    for one, two in zip(noisy.limb.segments, fitted.limb.segments, strict=True):
        if one.name == "palm":
            continue
        a, b = (np.linalg.norm(np.subtract(s.parts[0].end, s.parts[0].start)) for s in (one, two))
        assert -4 * 9e-5 < a - b < 4 * 9e-5 + 2e-6 / b


def test_frames_that_no_fit_takes() -> None:
    rng = np.random.default_rng(1)
    right = TrackedHand(side="right")
    bent = {f"{f}_pip_flexion": 60.0 for f in ("index", "middle", "ring", "little")}
    one = right.landmarks(right.joints(bent, degrees=True))
    with pytest.raises(SceneError, match="this left hand bend backwards; is it a right"):
        TrackedHand(side="left").fit([one])
    with pytest.raises(SceneError, match="mirrored"):
        right.fit([one * (1, -1, 1)])
    with pytest.raises(SceneError, match="shape"):
        right.fit(one)
    with pytest.raises(SceneError, match="none of 2 is whole"):
        right.fit(np.full((2, 21, 3), np.nan))
    short = one.copy()
    short[7] = short[6]
    with pytest.raises(SceneError, match="index_intermediate measures 0 mm"):
        right.fit([short])
    right.fit([one, rng.permutation(one) * np.nan])  # the second is left out


def test_frames_of_the_tracker() -> None:
    """Its pose, the wrist of MediaPipe, radii of tips, tips on the skin, and the wrong unit."""
    model = TrackedHand(convention="openxr")
    joints = model.joints({"index_pip_flexion": 0.5})
    pose = cs.Pose((0.1, 0.2, 0.3), (0.1, 0.2, 0.3, 0.9))
    plain = model.landmarks(joints)
    np.testing.assert_allclose(model.landmarks(joints, pose=pose), pose.apply(plain), atol=1e-15)
    moved = model.landmarks(joints, pose=pose, wrist=(1.0, 2.0, 3.0))
    np.testing.assert_allclose(moved - moved[0], pose.apply(plain) - pose.apply(plain[0]),
                               atol=1e-12)  # fmt: skip
    np.testing.assert_allclose(moved[0], (1.0, 2.0, 3.0), atol=1e-12)
    radii = np.full(26, 0.012)
    radii[5] = np.nan
    wide = model.landmarks(joints, radii)
    on_skin = TrackedHand(tip="skin").landmarks(joints)
    for k, tip in enumerate(TIPS):
        length = np.linalg.norm(wide[tip] - on_skin[tip])
        wanted = 0.012 if k else model.limb.segments[-1].parts[0].radius  # the thumb's
        assert abs(length - wanted) < 1e-12
    with pytest.raises(SceneError, match="openxr gives metres"):
        model.landmarks(1e3 * joints)
    leap = TrackedHand(convention="leap")
    with pytest.raises(SceneError, match="leap gives millimetres"):
        leap.landmarks(1e-3 * leap.joints())
    with pytest.raises(SceneError, match=r"\(21, 3\); give \(26, 3\)"):
        model.landmarks(plain)
    with pytest.raises(SceneError, match="radii has shape"):
        model.landmarks(joints, radii[:3])
    with pytest.raises(SceneError, match="wrist has shape"):
        model.landmarks(joints, wrist=(0, 0))


def test_bodies_keep_their_shapes_and_are_one_conductor() -> None:
    """Shapes are the same objects from frame to frame, so that no geometry is made anew."""
    model = TrackedHand()
    one = model.bodies(model.landmarks(model.joints()), grounding="floating")
    two = model.bodies(
        model.landmarks(model.joints({"index_pip_flexion": 1.0})), grounding="floating"
    )
    assert len(one) == 19
    assert all(a.shape is b.shape for a, b in zip(one, two, strict=True))
    assert {b.conductor for b in one} == {"right_hand"}
    assert {b.grounding for b in one} == {"floating"}
    person = model.bodies(model.landmarks(model.joints()), conductor="person")
    assert {b.conductor for b in person} == {"person"}
    assert {b.grounding for b in person} == {100e-12}
    assert model.bodies(None) == []
    missing = model.landmarks(model.joints())
    missing[7] = np.nan
    with pytest.raises(SceneError, match="landmark 7 is missing"):
        model.bodies(missing)


def test_bones_without_a_direction() -> None:
    """Two landmarks in one place, a finger folded back: poses are still rotations."""
    model = TrackedHand()
    landmarks = model.landmarks(model.joints())
    landmarks[8] = landmarks[7]
    back = landmarks.copy()
    back[10] = 2 * back[9] - back[10]  # the middle finger points to the wrist
    for points in (landmarks, back):
        for pose in model.poses(points).values():
            assert abs(np.linalg.det(pose.rotation) - 1.0) < 1e-9


def test_what_is_no_hand() -> None:
    for words, match in (
        ({"side": "both"}, "side is 'both'"), ({"convention": "kinect"}, "convention is 'kinect'"),
        ({"tip": "nail"}, "tip is 'nail'"), ({"model": 3}, "model is 3"),
        ({"model": arm()}, "right_arm is no hand"),
    ):  # fmt: skip
        with pytest.raises(SceneError, match=match):
            TrackedHand(**words)  # type: ignore[arg-type]
    given = TrackedHand(hand(Build(), "left"))
    assert given.side == "left"
