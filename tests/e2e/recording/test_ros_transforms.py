"""The tree of transforms, against poses that are chained by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

import capsense as cs
from capsense.recording import ros
from capsense.recording.transforms import KEPT, TransformTree

S = 10**9
Given = tuple[str, str, float, cs.Pose]


def message(*given: Given) -> object:
    """A TFMessage of parent, child, time [s], pose."""
    return ros.make(
        "tf2_msgs/msg/TFMessage",
        transforms=[
            ((divmod(round(t * S), S), parent), child, (pose.position, pose.quaternion))
            for parent, child, t, pose in given
        ],
    )


def tree_of(moving: list[Given], fixed: tuple[Given, ...] = ()) -> TransformTree:
    tree = TransformTree()
    for one in moving:
        tree.add(message(one), fixed=False)
    tree.add(message(*fixed), fixed=True)
    return tree


def pose(seed: int) -> cs.Pose:
    rng = np.random.default_rng(seed)
    return cs.Pose(rng.uniform(-1, 1, 3), rng.standard_normal(4))


def close(one: cs.Pose, other: cs.Pose) -> None:
    np.testing.assert_allclose(one.matrix, other.matrix, rtol=0, atol=1e-12)


def test_two_branches() -> None:
    """world → base → pad and world → person → hand; one link is fixed."""
    a, b, c, d = map(pose, range(4))
    tree = tree_of(
        [("world", "base", 1.0, a), ("world", "person", 2.0, c), ("person", "hand", 3.0, d)],
        (("base", "/pad", 0.0, b),),
    )
    assert tree.frames == ["base", "hand", "pad", "person", "world"]
    with pytest.raises(LookupError, match="known only from 2 s after"):
        tree.find("pad", "hand")
    for frame, one, later in (("base", a, 3.0), ("person", c, 1.0)):
        tree.add(message(("world", frame, later, one)), fixed=False)
    tree.add(message(("person", "hand", 1.0, d)), fixed=False)
    found = tree.find("pad", "hand")
    close(found.pose, (a @ b).inverse() @ c @ d)
    assert found.stamp == 2 * S
    close(tree.find("hand", "pad").pose, found.pose.inverse())
    assert tree.find("base", "pad").stamp is None
    assert tree.find("base", "pad").pose == b
    assert tree.find("pad", "pad").pose == cs.Pose()


def test_between_two_times() -> None:
    """A frame is taken at the last time of the others: half-way along a line and a turn."""
    turn = cs.Pose.from_euler((0.2, 0, 0), (0, 0, 90), degrees=True)
    tree = tree_of(
        [("w", "a", 0.0, cs.Pose()), ("w", "a", 1.0, turn), ("w", "b", 0.5, cs.Pose((0, 0, 1)))]
    )
    found = tree.find("b", "a")
    assert found.stamp == S // 2
    close(found.pose, cs.Pose.from_euler((0.1, 0, -1), (0, 0, 45), degrees=True))


def test_direct_child_keeps_its_bits() -> None:
    one = pose(5)
    assert tree_of([("sensor", "hand", 0.0, one)]).find("sensor", "hand").pose == one


def test_what_is_forgotten() -> None:
    """Old times, times out of order, a frame that gets another parent, a clock set back."""
    tree = tree_of([("w", "a", t, cs.Pose((t, 0, 0))) for t in (0.0, 2.0, 1.0, 2.0, 15.0)])
    assert [t.stamp // S for t in tree._moving["a"]] == [15]
    assert KEPT == 10 * S
    tree.add(message(("w", "a", 12.0, cs.Pose())), fixed=False)
    assert [t.stamp // S for t in tree._moving["a"]] == [12, 15]
    tree.add(message(("other", "a", 16.0, cs.Pose((0, 0, 3)))), fixed=False)
    with pytest.raises(LookupError, match="nobody tells where frame 'w' is"):
        tree.find("w", "a")
    assert tree.find("other", "a").pose.position == (0, 0, 3)
    tree.forget()
    assert tree.frames == []


def test_what_cannot_be_found() -> None:
    tree = tree_of([("w", "a", 0.0, cs.Pose()), ("v", "b", 0.0, cs.Pose())])
    with pytest.raises(LookupError, match="nobody tells where frame 'x' is"):
        tree.find("w", "x")
    with pytest.raises(LookupError, match="hang on different roots, 'w' and 'v'"):
        tree.find("b", "a")
    with pytest.raises(LookupError, match="round in a loop"):
        tree_of([("a", "b", 0.0, cs.Pose()), ("b", "a", 0.0, cs.Pose())]).find("a", "b")


@pytest.mark.parametrize(
    ("place", "turn"),
    [((math.nan, 0, 0), (0, 0, 0, 1)), ((0, 0, 0), (0, 0, 0, 0)), ((0, 0, 0), (0, 0, 1, 1))],
)
def test_no_transforms(place: tuple[float, ...], turn: tuple[float, ...]) -> None:
    bad = ros.make("tf2_msgs/msg/TFMessage", transforms=[(((0, 0), "w"), "a", (place, turn))])
    tree = TransformTree()
    with pytest.raises(ValueError, match="frame 'a' is none"):
        tree.add(bad, fixed=False)
    with pytest.raises(ValueError, match="leads from 'a' to 'a'"):
        tree.add(message(("a", "/a", 0.0, cs.Pose())), fixed=True)
    assert tree.frames == []
