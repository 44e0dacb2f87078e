"""Filter and gaps of tracked hands, and files of them."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from capsense.errors import SceneError
from capsense.humans import HandFilter, HandRecording, OneEuroFilter
from capsense.humans.tracking import CONVENTIONS, LANDMARKS, PALM, rigid_motion

RATE = 60.0


def random_hand(seed: int) -> np.ndarray:
    """Landmarks [m] anywhere in a box of 0.2 m."""
    return np.random.default_rng(seed).uniform(-0.1, 0.1, (LANDMARKS, 3))


def up(height: float) -> np.ndarray:
    """A way along z [m]."""
    return np.array([0.0, 0.0, height])


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


# -- conventions ---------------------------------------------------------------------------------


def test_orders_are_those_of_the_makers() -> None:
    """By name: XrHandJointEXT, HandLandmark, and the bones of LEAP_DIGIT."""
    fingers = ("index", "middle", "ring", "little")
    openxr = [
        "palm", "wrist", *(f"thumb_{j}" for j in ("metacarpal", "proximal", "distal", "tip")),
        *(f"{f}_{j}" for f in fingers
          for j in ("metacarpal", "proximal", "intermediate", "distal", "tip")),
    ]  # fmt: skip
    mediapipe = [
        "wrist", *(f"thumb_{j}" for j in ("cmc", "mcp", "ip", "tip")),
        *(f"{f}_{j}" for f in fingers for j in ("mcp", "pip", "dip", "tip")),
    ]  # fmt: skip
    same = {"metacarpal": "cmc", "proximal": "mcp", "intermediate": "pip", "distal": "dip"}
    thumb = {"metacarpal": "cmc", "proximal": "mcp", "distal": "ip"}

    def translated(name: str) -> str:
        if "_" not in name:
            return name
        digit, joint = name.split("_")
        return f"{digit}_{(thumb if digit == 'thumb' else same).get(joint, joint)}"

    found = [translated(openxr[k]) for k in CONVENTIONS["openxr"].landmarks]
    assert found == mediapipe
    assert CONVENTIONS["mediapipe"].landmarks == tuple(range(21))
    # Of Leap: the wrist, then five ends of bones of each digit; the metacarpal of the thumb has no
    # length, and is followed by the three bones that a thumb has.
    leap = ["wrist"]
    leap += ["thumb_none", *(f"thumb_{j}" for j in ("cmc", "mcp", "ip", "tip"))]
    leap += [f"{f}_{j}" for f in fingers for j in ("cmc", "mcp", "pip", "dip", "tip")]
    assert [leap[k] for k in CONVENTIONS["leap"].landmarks] == mediapipe


@pytest.mark.parametrize("seed", range(5))
def test_rigid_motion_is_found(seed: int) -> None:
    """Exactly, where points lie in a plane too; and never a mirror image."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(6, 3)) * (1.0, 1.0, seed % 2)
    turn, shift = random_rotation(rng), rng.normal(size=3)
    found, moved = rigid_motion(points, points @ turn.T + shift)
    np.testing.assert_allclose(found, turn, atol=1e-12)
    np.testing.assert_allclose(moved, shift, atol=1e-12)
    mirrored, _ = rigid_motion(points, points * (1, 1, -1))
    assert np.linalg.det(mirrored) > 0.999


# -- smoothing -----------------------------------------------------------------------------------


def plain_one_euro(
    times: np.ndarray, values: np.ndarray, min_cutoff: float, beta: float, d_cutoff: float
) -> list[float]:
    """The filter of the paper for one number, written as the paper says it."""

    def alpha(cutoff: float, period: float) -> float:
        tau = 1.0 / (2 * math.pi * cutoff)
        return 1.0 / (1.0 + tau / period)

    out = [values[0]]
    speed = 0.0
    for k in range(1, len(values)):
        period = times[k] - times[k - 1]
        a = alpha(d_cutoff, period)
        speed = a * (values[k] - values[k - 1]) / period + (1 - a) * speed
        a = alpha(min_cutoff + beta * abs(speed), period)
        out.append(a * values[k] + (1 - a) * out[-1])
    return out


@pytest.mark.parametrize("seed", range(4))
def test_one_euro_is_that_of_the_paper(seed: int) -> None:
    """Along one axis, with uneven time stamps."""
    rng = np.random.default_rng(seed)
    cutoff, beta, derivative = rng.uniform((0.3, 0, 0.5), (5, 100, 10))
    times = np.cumsum(rng.uniform(0.005, 0.05, 80))
    values = 0.01 * np.cumsum(rng.normal(size=80))
    smooth = OneEuroFilter(cutoff, beta, derivative)
    axis = random_rotation(rng)[0]
    found = [smooth(t, v * axis[None, :]) @ axis for t, v in zip(times, values, strict=True)]
    wanted = plain_one_euro(times, values, cutoff, beta, derivative)
    np.testing.assert_allclose(np.ravel(found), wanted, atol=1e-14)


def test_smoothing_does_not_depend_on_the_axes() -> None:
    """Filter and then turn, or turn and then filter."""
    rng = np.random.default_rng(5)
    path = np.cumsum(rng.normal(size=(50, 7, 3)), axis=0) * 0.01
    turn = random_rotation(rng)
    one, two = OneEuroFilter(), OneEuroFilter()
    for k, points in enumerate(path):
        a, b = one(k / RATE, points), two(k / RATE, points @ turn.T)
        np.testing.assert_allclose(a @ turn.T, b, atol=1e-12)


def test_noise_shrinks_and_motion_is_followed() -> None:
    """With the defaults at 60 Hz: at rest under half of the noise is left; a motion of 0.5 m/s is
    less than 10 ms behind, which is less than a frame."""
    rng = np.random.default_rng(0)
    smooth = OneEuroFilter()
    still = [smooth(k / RATE, 1e-3 * rng.normal(size=(21, 3))) for k in range(600)]
    assert np.std(still[60:]) < 0.5e-3
    smooth.reset()
    for k in range(120):
        wanted = np.full((1, 3), (0.5 * k / RATE, 0, 0))
        found = smooth(k / RATE, wanted)
    assert 0 < wanted[0, 0] - found[0, 0] < 0.5 * 0.010


def test_bad_smoothing() -> None:
    for words in ({"min_cutoff": 0}, {"beta": -1}, {"derivative_cutoff": math.nan}):
        with pytest.raises(SceneError, match=next(iter(words))):
            OneEuroFilter(**words)
    smooth = OneEuroFilter()
    smooth(1.0, np.zeros((2, 3)))
    with pytest.raises(SceneError, match="order of time"):
        smooth(1.0, np.zeros((2, 3)))


# -- gaps ----------------------------------------------------------------------------------------


def test_a_hand_that_is_lost_and_found() -> None:
    """Held, leaving, absent, returning, tracked, at the times that the arguments say."""
    hand, there = random_hand(1), random_hand(2)
    tracker = HandFilter(False, hold=0.2, fade=0.1, retreat=(0, 0, 0.4))
    assert tracker.update(0.0, None).status == "absent"
    first = tracker.update(0.1, hand)
    assert (first.status, first.landmarks is not None) == ("tracked", True)
    np.testing.assert_array_equal(first.landmarks, hand)  # it begins where it is seen
    for time in (0.15, 0.29, 0.3):
        held = tracker.update(time, None)
        assert held.status == "held"
        np.testing.assert_array_equal(held.landmarks, hand)
    leaving = tracker.update(0.35, None)
    assert leaving.status == "leaving"
    np.testing.assert_allclose(leaving.landmarks, hand + up(0.2), atol=1e-12)
    gone = tracker.update(0.41, None)
    assert (gone.status, gone.landmarks) == ("absent", None)
    back = tracker.update(1.0, there)
    assert back.status == "returning"
    np.testing.assert_allclose(back.landmarks, there + up(0.4), atol=1e-12)
    half = tracker.update(1.05, there)
    np.testing.assert_allclose(half.landmarks, there + up(0.2), atol=1e-12)
    whole = tracker.update(1.1, there)
    assert whole.status == "tracked"
    np.testing.assert_array_equal(whole.landmarks, there)


@pytest.mark.parametrize("seed", range(12))
def test_hands_never_jump(seed: int) -> None:
    """Whatever is lost and when: between two samples no landmark moves faster than the hand does,
    the way out is, and the way back from where it was held; absent hands are out of the way.
    """
    rng = np.random.default_rng(seed)
    tracker = HandFilter(hold=0.1, fade=0.2, retreat=(0, 0, 0.5))
    shape, velocity = random_hand(seed), rng.uniform(-0.3, 0.3, 3)
    lost, before, statuses = False, None, set()
    for k in range(900):
        lost = k > 0 and rng.random() < (0.93 if lost else 0.02)
        moving = shape + 0.2 * np.sin(3 * velocity * k / RATE)
        sample = tracker.update(k / RATE, None if lost else moving)
        statuses.add(sample.status)
        here = sample.landmarks
        if here is not None and before is not None:
            # The offset fades by at most 1.5/fade of its length a second, and is no longer than
            # the way out and what the hand may have moved meanwhile.
            assert np.linalg.norm(here - before, axis=1).max() < (0.5 + 0.7) * 1.5 / 0.2 / RATE
        elif (here is None) != (before is None) and k:
            shown = here if here is not None else before
            assert shown is not None
            assert np.linalg.norm(shown - moving, axis=1).min() > 0.2
        before = here
    assert statuses == {"tracked", "held", "leaving", "absent", "returning"}


def test_without_a_way_out_hands_vanish() -> None:
    tracker = HandFilter(False, hold=0.1, retreat=None)
    tracker.update(0.0, random_hand(1))
    assert tracker.update(0.2, None).status == "absent"
    again = tracker.update(0.3, random_hand(2))
    assert again.status == "tracked"
    np.testing.assert_array_equal(again.landmarks, random_hand(2))


def test_silence_is_a_gap() -> None:
    """No frames at all for longer than ``hold``: the hand comes from where it was shown."""
    tracker = HandFilter(False, hold=0.1, fade=0.2)
    tracker.update(0.0, random_hand(1))
    back = tracker.update(5.0, random_hand(2))
    assert back.status == "returning"
    np.testing.assert_allclose(back.landmarks, random_hand(1), atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_single_joints_that_are_missing_move_with_the_palm(seed: int) -> None:
    rng = np.random.default_rng(seed)
    hand, turn, shift = random_hand(seed), random_rotation(rng), rng.normal(size=3)
    tracker = HandFilter(False)
    tracker.update(0.0, hand)
    moved = hand @ turn.T + shift
    palm = rng.permutation(PALM)
    hidden = [*palm[: rng.integers(0, 4)], *rng.choice([4, 8, 12, 16, 20], 3, replace=False)]
    seen = moved.copy()
    seen[hidden] = np.nan
    sample = tracker.update(0.1, seen)
    assert sample.status == "tracked"
    np.testing.assert_allclose(sample.landmarks, moved, atol=1e-9)
    seen[list(palm[:4])] = np.nan
    assert tracker.update(0.2, seen).status == "held"


@pytest.mark.parametrize("value", [3.0, -1e5, 1e300, math.inf])
def test_glitches_leave_no_trace(value: float) -> None:
    """A landmark that is metres away is missing; a frame of such is missed."""
    hand = random_hand(1)
    tracker = HandFilter()
    for k in range(10):
        tracker.update(k / RATE, hand)
    glitch = hand.copy()
    glitch[8] = value
    np.testing.assert_allclose(tracker.update(10 / RATE, glitch).landmarks, hand, atol=1e-9)
    assert tracker.update(11 / RATE, np.full((21, 3), 1e300)).status == "held"
    for k in range(12, 40):
        sample = tracker.update(k / RATE, hand)
    assert sample.status == "tracked"
    np.testing.assert_allclose(sample.landmarks, hand, atol=1e-9)


def test_frames_that_do_not_count() -> None:
    """Late ones are dropped, unsure and incomplete ones missed; after a reset time begins anew."""
    hand = random_hand(1)
    tracker = HandFilter(min_confidence=0.6)
    part = hand.copy()
    part[8] = np.inf
    assert tracker.update(0.0, part).status == "absent"  # this tip was never seen
    first = tracker.update(1.0, hand)
    for late in (1.0, 0.5, -3.0):
        assert tracker.update(late, random_hand(2)) is first
    assert tracker.dropped == 3
    assert tracker.update(1.1, hand, confidence=0.59).status == "held"
    assert tracker.update(1.15, hand, confidence=math.nan).status == "held"
    assert tracker.update(1.2, hand, confidence=0.6).status != "held"
    tracker.reset()
    assert tracker.update(0.0, hand).status == "tracked"


def test_bad_frames_and_options() -> None:
    tracker = HandFilter()
    with pytest.raises(SceneError, match="time is nan"):
        tracker.update(math.nan, None)
    with pytest.raises(SceneError, match=r"\(26, 3\); give \(21, 3\)"):
        tracker.update(0.0, np.zeros((26, 3)))
    with pytest.raises(SceneError, match="no position"):
        tracker.update(0.0, [["here", 0, 0]] * 21)  # type: ignore[arg-type]
    for words, match in (
        ({"hold": 0}, "hold is 0"), ({"fade": -1}, "fade is -1"),
        ({"retreat": (0, 1)}, "retreat is"), ({"min_confidence": 2}, "from 0 to 1"),
        ({"smooth": 3}, "OneEuroFilter"),
    ):  # fmt: skip
        with pytest.raises(SceneError, match=match):
            HandFilter(**words)  # type: ignore[arg-type]


# -- files ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["npz", "json", "csv"])
def test_files_of_all_formats(tmp_path: Path, form: str) -> None:
    rng = np.random.default_rng(3)
    joints = rng.normal(size=(4, 21, 3)).astype(np.float32).astype(float)
    joints[1, 4], joints[2] = np.nan, np.nan
    made = HandRecording(
        np.arange(4) / 30, joints, np.array([1.0, 0.5, 0.0, 1.0]), "left", "mediapipe"
    )
    assert not made.joints.flags.writeable
    file = tmp_path / f"hand.{form}"
    if form == "npz":
        made.save(file)
    elif form == "json":
        listed = [
            None if np.isnan(f).all() else [None if np.isnan(p).any() else p.tolist() for p in f]
            for f in joints
        ]
        words = {"time": made.time.tolist(), "joints": listed, "side": "left",
                 "confidence": made.confidence.tolist(), "convention": "mediapipe"}  # fmt: skip
        file.write_text(json.dumps(words))
    else:
        head = ["time", "confidence", *(f"{a}{k}" for k in range(21) for a in "xyz")]
        rows = [
            [t, c, *("" if math.isnan(x) else repr(x) for x in f.ravel().tolist())]
            for t, f, c in made
        ]
        file.write_text("\n".join(",".join(map(str, row)) for row in [head, *rows]))
    words = {"side": "left", "convention": "mediapipe"} if form == "csv" else {}
    found = HandRecording.load(file, **words)  # type: ignore[arg-type]
    assert (found.side, found.convention, len(found)) == ("left", "mediapipe", 4)
    for name in ("time", "joints", "confidence"):
        np.testing.assert_array_equal(getattr(found, name), getattr(made, name))


@pytest.mark.parametrize(
    ("name", "text", "match"),
    [
        ("none.csv", None, "no file"),
        ("a.txt", "x", "no known format"),
        ("a.npz", "x", "cannot be read"),
        ("a.json", "[1]", "give an object"),
        ("a.json", "{", "cannot be read"),
        ("a.json", '{"time": [0]}', "'joints' is missing"),
        ("a.json", '{"time": [0], "joints": [null], "more": 1}', "unknown key 'more'"),
        ("a.json", '{"time": [0], "joints": [[[0,0,0]]]}', r"need \(1, 21, 3\)"),
        ("a.csv", "t,x0\n", "header must be time"),
        ("a.csv", "time,x0,y0,z0\n0,1,2\n", "line 2 has 3 cells"),
        ("a.csv", "time,x0,y0,z0\n0,1,2,word\n", "cannot be read"),
    ],
)
def test_bad_files(tmp_path: Path, name: str, text: str | None, match: str) -> None:
    file = tmp_path / name
    if text is not None:
        file.write_text(text)
    with pytest.raises(SceneError, match=match) as caught:
        HandRecording.load(file, side="right", convention="mediapipe")
    assert name in str(caught.value)


def test_bad_recordings(tmp_path: Path) -> None:
    time, joints, sure = np.array([0.0, 1.0]), np.zeros((2, 21, 3)), np.ones(2)
    for words, match in (
        ((time[::-1], joints, sure, "left", "mediapipe"), "does not increase"),
        ((time, joints, sure, "both", "mediapipe"), "side is 'both'"),
        ((time, joints, sure, "left", "kinect"), "convention is 'kinect'"),
        ((time, joints, sure[:1], "left", "mediapipe"), "confidence has shape"),
    ):
        with pytest.raises(SceneError, match=match):
            HandRecording(*words)  # type: ignore[arg-type]
    file = tmp_path / "a.csv"
    file.write_text("time,x0,y0,z0\n0,1,2,3\n")
    with pytest.raises(SceneError, match="does not say side"):
        HandRecording.load(file)
    with pytest.raises(SceneError, match=r"ends in \.npz"):
        HandRecording(time, joints, sure, "left", "mediapipe").save("a.csv")
