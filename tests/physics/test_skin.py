"""Many sensors in one call: the same readings as one by one, whatever the number of threads."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from approximate import approx
from tiny_field import SETTINGS, tiny_design

import capsense as cs
from capsense.errors import FieldError, SceneError, SkinError
from capsense.readout import SEED_STRIDE
from capsense.skin import make_simulators

Array = np.ndarray

POSES = {
    "left": cs.Pose((-0.10, 0.0, 0.0)),
    "middle": cs.Pose((0.0, 0.01, 0.02), (0.3, -0.1, 0.2, 0.9)),
    "right": cs.Pose((0.10, 0.0, 0.0), (0.0, 0.0, 0.7071, 0.7071)),
    "far": cs.Pose((5.0, 0.0, 0.0)),
}


@pytest.fixture(scope="module")
def tiny(field_cache: Path) -> cs.Simulator:
    """A square and a disc in a 0.1 m box."""
    return cs.Simulator(tiny_design(), settings=SETTINGS, cache_dir=field_cache)


def skin_of(tiny: cs.Simulator, **options: object) -> cs.Skin:
    """Four sensors, all fresh."""
    return cs.Skin({n: (tiny.copy(), p) for n, p in POSES.items()}, **options)


def scenes(count: int = 12) -> list[cs.Scene]:
    """A ball and a loose box that go by, in the world."""
    out = []
    for k in range(count):
        x = -0.12 + 0.24 * k / count
        out.append(
            cs.Scene(
                [
                    cs.Body(cs.Sphere(0.02), cs.Pose((x, 0.0, 0.05)), "human", 100e-12, "ball"),
                    cs.Body(
                        cs.Box((0.03, 0.02, 0.01)), cs.Pose((-x, 0.02, 0.04), (0.1, 0.2, 0.3, 0.9)),
                        "steel", "floating", "box",
                    ),
                ]
            )
        )  # fmt: skip
    return out


def same(a: cs.Reading, b: cs.Reading) -> bool:
    """Whether two readings agree to the last bit."""
    return (
        np.array_equal(a.delta, b.delta)
        and np.array_equal(a.self_capacitance, b.self_capacitance)
        and a.stats.unknowns == b.stats.unknowns
    )


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_the_same_as_one_by_one_to_the_last_bit(tiny: cs.Simulator, threads: int) -> None:
    """Differential: a walk of scenes, against single sensors that are given the same views."""
    skin = skin_of(tiny, threads=threads)
    alone = {name: tiny.copy() for name in POSES}
    for scene in scenes():
        together = skin.step(scene)
        assert list(together) == list(POSES)
        for name, view in skin.views(scene).items():
            assert same(together[name], alone[name].step(view))


def test_every_sensor_sees_the_world_from_its_own_frame(tiny: cs.Simulator) -> None:
    """Differential: against all bodies moved to the sensor's frame, none left out."""
    skin = skin_of(tiny)
    for scene in scenes(5):
        readings = skin.step(scene)
        for name, pose in POSES.items():
            inverse = pose.inverse()
            whole = cs.Scene([b.moved(inverse @ b.pose) for b in scene])
            expected = tiny.copy().step(whole).delta
            assert readings[name].delta == approx(expected, rel=1e-4, abs=1e-19)
        assert not readings["far"].delta.any()


def test_only_what_reaches_into_a_domain_is_solved(tiny: cs.Simulator) -> None:
    """Bodies far away are culled before anything else is done with them."""
    skin = skin_of(tiny)
    crowd = [cs.Body(cs.Sphere(0.1), cs.Pose((k, 3.0, 1.0)), name=f"b{k}") for k in range(50)]
    ball = cs.Body(cs.Sphere(0.02), cs.Pose((-0.1, 0.0, 0.05)), name="ball")
    views = skin.views(cs.Scene([*crowd, ball]))
    assert [[b.name for b in views[n]] for n in POSES] == [["ball"], [], [], []]
    readings = skin.step_views(views)
    assert [r.stats.unknowns > 0 for r in readings.values()] == [True, False, False, False]


def test_sensors_move(tiny: cs.Simulator) -> None:
    """A pose given at a step is remembered; moving the sensor is moving the world."""
    ball = cs.Body(cs.Sphere(0.02), cs.Pose((0.0, 0.0, 0.05)))
    pose = cs.Pose((0.01, 0.0, 0.01), (0.0, 0.1, 0.0, 0.99))
    skin = skin_of(tiny)
    there = skin.step(cs.Scene([ball]), {"far": pose})["far"].delta
    assert skin.poses["far"] == pose
    expected = tiny.copy().step(cs.Scene([ball.moved(pose.inverse() @ ball.pose)])).delta
    assert np.array_equal(there, expected)
    skin.reset()
    assert np.array_equal(skin.step(cs.Scene([ball]))["far"].delta, expected)


def test_many_sensors_are_read_as_one_by_one(tiny: cs.Simulator) -> None:
    """Differential, to the last bit, where several are solved in one call; each counts a step."""
    poses = {f"{n}{k}": p @ cs.Pose((0, 0, 0.003 * k)) for k in range(4) for n, p in POSES.items()}
    skin = cs.Skin({name: (tiny.copy(), pose) for name, pose in poses.items()}, threads=1)
    alone = tiny.copy()
    for scene in scenes(3):
        views = skin.views(scene)
        for name, reading in skin.step(scene).items():
            assert same(reading, alone.step(views[name]))
    assert [simulator.steps for simulator in skin.simulators.values()] == [3] * len(poses)


def test_sensors_of_one_design_share_its_field(tiny: cs.Simulator) -> None:
    """A given simulator is used once; copies have its field and settings, not its state."""
    made = make_simulators({"a": tiny, "b": tiny, "c": "arm_segment", "d": "arm_segment"})
    assert made["a"] is tiny
    assert made["b"] is not tiny
    assert made["b"].background is tiny.background
    assert made["c"].background is made["d"].background
    for name in ("method", "preset", "excitation_frequency", "settings", "design"):
        assert getattr(made["b"], name) == getattr(tiny, name)
    assert made["b"].steps == 0


def test_a_failing_sensor_does_not_lose_the_others(
    tiny: cs.Simulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error names it and holds the readings of the others."""
    skin = skin_of(tiny)
    good = scenes(1)[0]
    views = skin.views(good)

    def fail(*_: object, **__: object) -> cs.Reading:
        raise SceneError("nothing to see")

    for name in ("middle", "right"):
        monkeypatch.setattr(skin.simulators[name], "sampled", fail)
    only = {name: view for name, view in views.items() if name != "right"}
    with pytest.raises(SkinError, match=r"1 of 3 sensors failed; 'middle': nothing") as caught:
        skin.step_views(only)
    assert list(caught.value.readings) == ["left", "far"]
    assert list(caught.value.failures) == ["middle"]
    assert isinstance(caught.value.failures["middle"], SceneError)
    expected = tiny.copy().step(skin.views(good)["left"])
    assert same(caught.value.readings["left"], expected)
    with pytest.raises(SkinError, match=r"2 of 4 sensors failed; 'middle': .*so did 'right'"):
        skin.step_views(views)
    monkeypatch.undo()
    assert set(skin.step(good)) == set(POSES), "and the next step is sound"


def test_refused(tiny: cs.Simulator) -> None:
    """Refused by name, with the fix."""
    ball = cs.Body(cs.Sphere(0.02))
    skin = skin_of(tiny)
    with pytest.raises(SceneError, match="give at least one"):
        cs.Skin({})
    for wrong in (3, [("a", cs.Pose())], "six_patch"):
        with pytest.raises(TypeError, match=r"sensors is .*; give a dict such as"):
            cs.Skin(wrong)
    with pytest.raises(TypeError, match=r"sensor 'a' is .*give a pair \(design, Pose"):
        cs.Skin({"a": "six_patch"})  # type: ignore[dict-item]
    with pytest.raises(ValueError, match="threads is 0"):
        skin_of(tiny, threads=0)
    with pytest.raises(SceneError, match=r"poses: no sensor is named 'lefd'.*'left'"):
        skin.step(cs.Scene([ball]), {"lefd": cs.Pose()})
    with pytest.raises(SceneError, match="views: no sensor is named"):
        skin.step_views({"elsewhere": cs.Scene()})
    with pytest.raises(TypeError, match=r"write Scene\(\[...\]\)"):
        skin.step([ball])  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"views\['left'\]: step takes a Scene .*, not list"):
        skin.step_views({"left": []})  # type: ignore[dict-item]


def test_every_sensor_has_a_chip_of_its_own(tiny: cs.Simulator) -> None:
    """Differential: against simulators with chips of the seeds that the manual tells."""
    skin, alone = skin_of(tiny), {name: tiny.copy() for name in POSES}
    given = cs.Readout.preset("teensy", tiny.electrode_names, seed=3)
    for choice, first in ((given, 3), ("teensy", 0)):
        for start, seed in ((None, None), (2.0, 7)):
            skin.use_readout(choice, start=start, seed=seed)
            for _ in range(2):
                for number, sim in enumerate(alone.values()):
                    own = (first if seed is None else seed) + number * SEED_STRIDE
                    sim.use_readout("teensy", start=start, seed=own)
                for k, scene in enumerate(scenes(4)):
                    time = (start or 0.0) + 0.02 * k
                    found = skin.step(scene, time=time)
                    for name, view in skin.views(scene).items():
                        counts = alone[name].step(view, time=time).counts
                        assert np.array_equal(found[name].counts.code, counts.code)
                assert len(counts)
                skin.reset(start=start)
    codes = {
        tuple(reading.counts.code.tolist())
        for reading in skin.step(scenes(1)[0], time=9.0).values()
    }
    assert len(codes) == len(POSES)
    with pytest.raises(SkinError, match="readout needs the time"):
        skin.step(scenes(1)[0])
    skin.use_readout(None)
    assert skin.step(scenes(1)[0])["left"].counts is None
    assert given.seed == 3


def test_copies_of_a_simulator_have_chips_of_their_own(tiny: cs.Simulator) -> None:
    """A simulator that is given twice is used once, and then a copy with other noise."""
    sim = tiny.copy()
    sim.use_readout("teensy")
    made = make_simulators({"a": sim, "b": sim, "c": sim})
    chips = [s.readout for s in made.values()]
    assert chips[0] is sim.readout
    assert [chip.seed for chip in chips] == [0, SEED_STRIDE, 2 * SEED_STRIDE]


def test_a_field_of_another_design_is_refused(tiny: cs.Simulator) -> None:
    """A simulator does not take the field of other terminals."""
    with pytest.raises(FieldError, match="leave it out"):
        cs.Simulator("six_patch", background=tiny.background)


def test_one_warning_tells_of_all_large_estimated_errors() -> None:
    """Sensors that look away change little, so that their estimated errors are large."""
    turn = np.pi / 4
    poses = {
        f"s{n}": cs.Pose((0.0, 0.0, 0.0), (0.0, 0.0, np.sin(n * turn), np.cos(n * turn)))
        @ cs.Pose((0.048, 0.0, 0.0), (0.5, 0.5, 0.5, 0.5))
        for n in range(4)
    }
    one = cs.Simulator("arm_segment")
    skin = cs.Skin({name: (one.copy(), pose) for name, pose in poses.items()}, threads=1)
    person = [
        cs.Body(
            cs.Capsule(0.05, 0.25),
            cs.Pose((0.12 * (n % 4) - 0.2, 0.16 + 0.02 * (n // 4), 0.2 * (n // 4) - 0.2)),
            material="human",
        )
        for n in range(12)
    ]
    with pytest.warns(UserWarning, match="sensors have large estimated errors") as told:
        skin.step(cs.Scene(person))
    assert len(told) == 1
    doubts = {name: s.doubt for name, s in skin.simulators.items() if s.doubt is not None}
    assert len(doubts) >= 2
    worst = max(doubts, key=lambda name: doubts[name].share)
    text = str(told[0].message)
    assert text.startswith(f"{len(doubts)} of 4 sensors")
    assert f"the worst is {worst!r}" in text
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        skin.step(cs.Scene(person))
