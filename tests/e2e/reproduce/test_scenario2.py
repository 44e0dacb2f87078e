"""Scenario 2: the rides, the worlds, and what must hold of a run."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from approximate import approx

import capsense as cs
from capsense.reproduce import limb_worlds, scenario2
from capsense.reproduce.harness import Outcome
from capsense.reproduce.limb_worlds import PARTICIPANTS, clearance, course, rides, sensor_pose


def test_rides_are_the_same_at_every_call_and_within_their_bounds() -> None:
    ways = rides("3")
    assert len(ways) == 20
    assert [w.which for w in ways[:3]] == ["arm", "leg", "arm"]
    for one, other in zip(ways, rides("3", 4), strict=False):
        assert np.array_equal(one.offsets, other.offsets)
        assert one.poses == other.poses
    offsets = np.array([w.offsets for w in ways]).reshape(-1, 4)
    low, high = offsets.min(axis=0), offsets.max(axis=0)
    limits = [(-0.08, 0.08), (0.015, 0.12), *2 * [(-math.pi / 8, math.pi / 8)]]
    for (a, b), x, y in zip(limits, low, high, strict=True):
        assert a <= x < a + 0.3 * (b - a)
        assert b - 0.3 * (b - a) < y <= b
    for way in ways:
        assert way.time == approx(np.linspace(0.0, 4.0, 21))
        assert clearance(course(PARTICIPANTS["3"], way.which), way.poses) > limb_worlds.CLEARANCE
        x = np.array([p.position[0] for p in way.poses])
        assert np.sort(x) == approx(np.linspace(-0.1, 0.1, 21))


def test_participants_differ() -> None:
    offsets = {rides(p, 1)[0].offsets.tobytes() for p in PARTICIPANTS}
    assert len(offsets) == len(PARTICIPANTS) == 5


def test_sensor_pose() -> None:
    """It looks down; pitch raises its far end in x, yaw turns counterclockwise from above."""
    level = sensor_pose(0.1, 0.2, 0.3, 0.0, 0.0)
    assert level.apply([0.0, 0.0, 0.05]) == approx([0.1, 0.2, 0.25])
    raised = sensor_pose(0.0, 0.0, 0.0, 0.2, 0.0).apply([0.05, 0.0, 0.0])
    assert raised == approx([0.05 * math.cos(0.2), 0.0, 0.05 * math.sin(0.2)])
    turned = sensor_pose(0.0, 0.0, 0.0, 0.2, 0.3).apply([0.05, 0.0, 0.0])
    flat = 0.05 * math.cos(0.2)
    assert turned == approx([flat * math.cos(0.3), flat * math.sin(0.3), 0.05 * math.sin(0.2)])


@pytest.mark.parametrize(
    ("which", "upper", "lower"), [("arm", "forearm", "hand"), ("leg", "shank", "foot")]
)
def test_course_lies_along_x(which: limb_worlds.Which, upper: str, lower: str) -> None:
    place = course(PARTICIPANTS["2"], which)
    poses = place.limb.forward()
    near, far = (place.frame.apply(poses[name].position) for name in (upper, lower))
    assert near == approx(-far, abs=1e-12)
    assert near[0] > 0.1
    assert near[1:] == approx([0, 0], abs=1e-12)


@pytest.mark.filterwarnings("error:sensor:UserWarning")
@pytest.mark.parametrize("simulator", ["mujoco", "pybullet"])
def test_worlds_show_the_limb(simulator: str, simulators: object) -> None:
    """What a world's sensor reads is what the limb's own bodies give at that pose.

    But for the way in which capsules are turned about their axes, and so their panels: measured, up
    to 0.7 % of the largest change.
    """
    pytest.importorskip(simulator)
    sim: cs.Simulator = simulators("six_patch")  # type: ignore[operator]
    ride = rides("1", 2)[1]
    place = course(PARTICIPANTS["1"], ride.which)
    poses = ride.poses[::10]
    empty = sim.step(cs.Scene()).self_capacitance
    with limb_worlds.opened(simulator, place, sim, "geometry", 1e-10) as world:
        seen = limb_worlds.read_poses(world, poses)
    for pose, found in zip(poses, seen, strict=True):
        bodies = place.limb.bodies(pose.inverse() @ place.frame, grounding=1e-10)
        expected = sim.step(cs.Scene(bodies))
        tolerance = 1.5e-2 * np.abs(expected.self_capacitance - empty).max()
        assert found == approx(expected.self_capacitance, abs=tolerance)


def test_codes_follow_the_capacitance() -> None:
    """Tared codes are changes over 0.244 fF, but for noise; every run has noise of its own."""
    ways = rides("1", 2)
    changes = np.linspace(0.0, 50e-15, 2 * 21 * 6).reshape(2, 21, 6)
    codes = scenario2.tared_codes(changes, ways, "1", "depth")
    apart = codes - changes / (16e-12 / 2**16)
    assert np.abs(apart).max() < 7
    assert 0.3 < apart.std() < 1.6
    assert np.array_equal(codes, scenario2.tared_codes(changes, ways, "1", "depth"))
    assert not np.array_equal(codes, scenario2.tared_codes(changes, ways, "1", "paper"))


@pytest.fixture(scope="module")
def reduced(
    tmp_path_factory: pytest.TempPathFactory, field_cache: Path
) -> Iterator[tuple[Outcome, Path]]:
    pytest.importorskip("mujoco")
    pytest.importorskip("pybullet")
    folder = tmp_path_factory.mktemp("scenario2")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CAPSENSE_CACHE_DIR", str(field_cache))
        yield scenario2.run(folder, reduced=True, report=lambda stage, fraction: None), folder


def test_reduced_run(reduced: tuple[Outcome, Path]) -> None:
    """Own targets are met; the staircase shows in the scale, not in Eq. 12."""
    outcome, _ = reduced
    assert not outcome.missed
    values = {row.what: row.value for row in outcome.rows}
    assert values["the same: scale"] > 1.5
    assert values["the paper's scheme against the accurate method: Eq. 12, mean"] > 0.95
    table = outcome.tables["paper_scheme_eq12"]
    assert table.columns == ("participant", "E1", "E2", "E3", "E4", "E5", "E6")
    assert [row[0] for row in table.rows] == ["1", "2", "average"]
    hardware = outcome.tables["hardware_of_the_paper_eq12"]
    assert hardware.rows[0][1] == "0.874"


def test_an_interrupted_run_goes_on(reduced: tuple[Outcome, Path]) -> None:
    """Only what is missing is computed again, and the figures are the same."""
    outcome, folder = reduced
    parts = sorted((folder / "parts").iterdir())
    lost = next(p for p in parts if "pybullet-geometry" in p.name)
    lost.unlink()
    before = {p: p.stat().st_mtime_ns for p in parts if p != lost}
    again = scenario2.run(folder, reduced=True, report=lambda stage, fraction: None)
    assert {p: p.stat().st_mtime_ns for p in before} == before
    assert lost.exists()
    assert again.rows == outcome.rows
