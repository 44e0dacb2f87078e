"""Environments: Gymnasium's own checks, the same episode for the same seed, rewards that fit."""

from __future__ import annotations

import dataclasses
import math
import runpy
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from approximate import approx

import capsense as cs
from capsense.errors import MissingDependencyError

gymnasium = pytest.importorskip("gymnasium")
pytest.importorskip("mujoco")

from gymnasium.utils.env_checker import check_env  # noqa: E402

from capsense.learning.envs import (  # noqa: E402
    GAP,
    IDS,
    across,
)
from capsense.learning.envs.base import Randomisation  # noqa: E402
from capsense.learning.envs.signals import (  # noqa: E402
    KEY,
    CapacitiveObservation,
    write_model,
)

scripted = SimpleNamespace(
    **runpy.run_path(str(Path(__file__).parents[3] / "examples" / "policies.py"))
)
FOLLOW, DRESS, STOP, _ = IDS
TIP = cs.Pose((0.0, 0.0, 0.03))
"""A sensor on the fingertip of Gymnasium's Reacher, looking up."""


@pytest.mark.parametrize("name", IDS)
def test_gymnasium_checks(name: str) -> None:
    env = gymnasium.make(name)
    check_env(env.unwrapped, skip_render_check=True)
    observation, _ = env.reset(seed=3)
    policy = scripted.at_random(env, 3)
    for _ in range(20):
        assert env.observation_space.contains(observation)
        observation, reward, over, _, _ = env.step(policy(observation))
        assert math.isfinite(reward)
        if over:
            break


def episode(env: Any, seed: int, steps: int = 6) -> list[Any]:
    """Observations and rewards of the same actions."""
    observation, _ = env.reset(seed=seed)
    out = [observation]
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, *env.action_space.shape))
    for action in actions:
        observation, reward, *_ = env.step(action)
        out += [observation, reward]
    return out


@pytest.mark.parametrize("name", IDS)
def test_same_seed_same_episode(name: str) -> None:
    """To the last bit, in another environment and after other episodes."""
    one, other = gymnasium.make(name).unwrapped, gymnasium.make(name).unwrapped
    first = episode(one, 7)
    different = episode(other, 8)
    assert not np.array_equal(first[0], different[0])
    for a, b, c in zip(first, episode(other, 7), episode(one, 7), strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a, c)


def test_scripted_follower_earns_more() -> None:
    """Than random actions, and than one that stands still."""
    env = gymnasium.make(FOLLOW)
    still = np.zeros(5, np.float32)
    for seed in range(2):
        felt, *_ = scripted.play(env, scripted.follow, seed, 150)
        idle, *_ = scripted.play(env, lambda _: still, seed, 150)
        wild, *_ = scripted.play(env, scripted.at_random(env, seed), seed, 150)
        assert felt > 1.2 * idle
        assert felt > 1.5 * wild


def test_scripted_dresser_arrives() -> None:
    env = gymnasium.make(DRESS)
    total, facts, _ = scripted.play(env, scripted.dress, 0, 400)
    assert facts["success"]
    assert facts["error"] < 0.03
    assert 15.0 < total <= 25.0
    wild, *_ = scripted.play(env, scripted.at_random(env, 0), 0, 100)
    assert wild < 0


def test_skin_that_is_heeded_keeps_off() -> None:
    """The arm that ignores its skin hits the person; the one that heeds it arrives."""
    env = gymnasium.make(STOP)
    ahead = np.array([-1.0, 0.0, 0.0], np.float32)
    blind, facts, _ = scripted.play(env, lambda _: ahead, 2, 300)
    assert facts["force"] > 50.0
    assert not facts["success"]
    felt, facts, _ = scripted.play(env, scripted.stop, 2, 300)
    assert facts["success"]
    assert felt > 2 * blind


def test_reward_where_the_pad_should_be() -> None:
    """Zero error over a round limb, and errors that can be told by hand."""
    down = np.diag([1.0, -1.0, -1.0])
    middle, along = np.array([0.3, 0.0, 0.0]), np.array([1.0, 0.0, 0.0])
    error, angle = across(np.array([0.0, 0.0, 0.04 + GAP]), down, middle, along, 0.04)
    assert (error, angle) == approx((0.0, 0.0), abs=1e-12)
    error, _ = across(np.array([0.1, 0.03, 0.08 + GAP]), down, middle, along, 0.04)
    assert error == approx(0.05)
    skew = np.array([math.cos(0.2), math.sin(0.2), 0.0])
    assert across(np.array([0.3, 0.0, 0.09]), down, middle, skew, 0.04) == (
        approx((0.0, 0.2), abs=1e-12)
    )


@pytest.mark.parametrize("name", [f.name for f in dataclasses.fields(Randomisation)])
def test_every_range_has_an_effect(name: str) -> None:
    """The sensor, or what it feels, differs between the ends of each range alone."""
    middle = Randomisation().held()
    low, high = getattr(Randomisation(), name)
    seen = [
        episode(
            gymnasium.make(
                FOLLOW, randomisation=dataclasses.replace(middle, **{name: (end, end)})
            ).unwrapped, 5, 2,
        )
        for end in (low, high)
    ]  # fmt: skip
    assert not np.array_equal(seen[0][-2][:12], seen[1][-2][:12])


def test_latency_and_noise_are_as_set() -> None:
    """Ages count from the latency on; without noise and motion, the chip's numbers rest."""
    middle = Randomisation().held()
    late = dataclasses.replace(middle, latency=(0.02, 0.02))
    env = gymnasium.make(FOLLOW, randomisation=late).unwrapped
    env.reset(seed=0)
    chip = env.signals.readouts["pad"]
    assert chip.schedule.latency == 0.02
    shape = dataclasses.replace(middle, noise=(0.0, 0.0), drift=(0.0, 0.0), gain=(0.0, 0.0))
    env = gymnasium.make(FOLLOW, randomisation=shape, chip="fdc2214").unwrapped
    observation, _ = env.reset(seed=0)
    truth = np.diag(env.skin.read()["pad"].delta) * 1e14
    tare = 1e14 * env.signals.tare["pad"] - 1e14 * np.diag(env.simulator.baseline)
    assert observation[:6] == approx(truth - tare, abs=0.15)


def test_files_and_readouts_in_place_of_a_chip(tmp_path: Path) -> None:
    """They keep their rate, noise and calibration; gain, drift and latency come on top."""
    path = tmp_path / "mine.toml"
    path.write_text(
        'chip = "fdc1004"\nrate = 200\nlatency = 0.001\n[calibration]\ngain = 1.25\n', "utf-8"
    )
    names = cs.Simulator("six_patch").electrode_names
    middle = dataclasses.replace(Randomisation().held(), latency=(0.02, 0.02))
    for chip in (str(path), path, cs.load_readout(path, names)):
        env = gymnasium.make(FOLLOW, randomisation=middle, chip=chip).unwrapped
        env.reset(seed=0)
        found = env.signals.readouts["pad"]
        assert found.schedule.latency == approx(0.021, rel=1e-12)
        assert found.schedule.conversion == approx(5e-3, rel=1e-12)
        assert [type(stage).__name__ for stage in found.stages] == [
            "LinearSensor", "LinearSensor", "Flicker", "White", "RandomWalk"
        ]  # fmt: skip
        assert found.stages[1].gain == 1.25
    with pytest.raises(cs.ReadoutError, match="there is no readout file"):
        gymnasium.make(FOLLOW, chip="none.toml")


def test_ranges_by_name() -> None:
    env = gymnasium.make(FOLLOW, randomisation={"girth": [0.9, 1.0]}).unwrapped
    assert env.randomisation == Randomisation(girth=(0.9, 1.0))
    with pytest.raises(cs.SceneError, match="no range 'grith'; did you mean 'girth'"):
        gymnasium.make(FOLLOW, randomisation={"grith": [0.9, 1.0]})


def test_ranges_that_are_not() -> None:
    with pytest.raises(cs.SceneError, match="girth is"):
        Randomisation(girth=(1.2, 0.8))
    with pytest.raises(cs.SceneError, match="noise is"):
        Randomisation(noise=(0.0, math.nan))


def test_bad_action() -> None:
    env = gymnasium.make(FOLLOW).unwrapped
    env.reset(seed=0)
    for action in (np.zeros(4), np.full(5, np.nan)):
        with pytest.raises(cs.SceneError, match="give 5 finite numbers"):
            env.step(action)


def test_vectorised() -> None:
    envs = gymnasium.make_vec(FOLLOW, num_envs=2, vectorization_mode="sync")
    observation, _ = envs.reset(seed=[1, 2])
    single = gymnasium.make(f"capsense.learning.envs:{FOLLOW}")
    np.testing.assert_array_equal(observation[1], single.reset(seed=2)[0])
    assert envs.step(envs.action_space.sample())[0].shape == (2, *single.observation_space.shape)


def together(name: str, count: int, **options: Any) -> Any:
    return gymnasium.make_vec(
        name, num_envs=count, vectorization_mode="vector_entry_point", **options
    )


@pytest.mark.parametrize(("name", "near"), [(FOLLOW, 0.0), (DRESS, 1e-6), (STOP, 1e-3)])
def test_side_by_side_as_alone(name: str, near: float) -> None:
    """Seeds and actions of single environments; ApproachStop differs by some codes (2e-4)."""
    envs, alone = together(name, 2), [gymnasium.make(name) for _ in range(2)]
    assert envs.single_observation_space == alone[0].observation_space
    observation, facts = envs.reset(seed=5)
    one = [env.reset(seed=5 + k) for k, env in enumerate(alone)]
    rng = np.random.default_rng(0)
    for _ in range(5):
        np.testing.assert_allclose(observation, [o[0] for o in one], rtol=0, atol=near)
        actions = rng.uniform(-1, 1, envs.action_space.shape).astype(np.float32)
        observation, rewards, over, cut, facts = envs.step(actions)
        one = [env.step(a) for env, a in zip(alone, actions, strict=True)]
        assert rewards.tolist() == [o[1] for o in one]
        assert not (over | cut).any()
        for key, values in facts.items():
            if not key.startswith("_"):
                assert values.tolist() == [o[4][key] for o in one]


def test_side_by_side_on_warp() -> None:
    """Differential: to the compiled core, at the errors of 64 clusters a body."""
    pytest.importorskip("warp")
    calm = dataclasses.replace(Randomisation().held(), noise=(0.0, 0.0), drift=(0.0, 0.0))
    both = [
        together(FOLLOW, 2, device=device, randomisation=calm, preset="standard")
        for device in ("cpu", "warp:cpu")
    ]
    truth, found = (envs.reset(seed=5)[0] for envs in both)
    actions, seen = np.random.default_rng(0).uniform(-1, 1, (3, *both[0].action_space.shape)), []
    for action in actions.astype(np.float32):
        np.testing.assert_allclose(found, truth, rtol=0, atol=0.05)
        (truth, rewards, *_), (found, others, *_) = (envs.step(action) for envs in both)
        np.testing.assert_allclose(others, rewards, rtol=0, atol=1e-12)
        seen.append(found)
    assert np.ptp(seen, axis=0).max() > 0.1


def test_side_by_side_on_warp_readings_stay() -> None:
    """Regression: what shields couple to was written over by the next reading, a tare's too."""
    pytest.importorskip("warp")
    envs = together(FOLLOW, 1, device="warp:cpu", design="arm_segment")
    envs.reset(seed=5)
    reading = envs.skin.read([0])[0]["pad"]
    before = reading.self_capacitance.copy()
    envs.step(envs.action_space.sample())
    assert (envs.skin.read([0])[0]["pad"].self_capacitance != before).any()
    np.testing.assert_array_equal(reading.self_capacitance, before)


def test_side_by_side_begin_again() -> None:
    """At the step after an episode's end, with the numbers that a single environment would draw."""
    envs, env = together(FOLLOW, 2, max_episode_steps=3), gymnasium.make(FOLLOW).unwrapped
    assert envs.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.NEXT_STEP
    envs.reset(seed=[1, 2])
    still = np.zeros((2, 5), np.float32)
    cuts = [envs.step(still)[3].tolist() for _ in range(3)]
    assert cuts == [[False, False], [False, False], [True, True]]
    observation, rewards, over, cut, _ = envs.step(still)
    assert rewards.tolist() == [0.0, 0.0]
    assert not (over | cut).any()
    env.reset(seed=2)
    np.testing.assert_array_equal(observation[1], env.reset()[0])
    before = observation
    observation, _ = envs.reset(seed=7, options={"reset_mask": np.array([True, False])})
    np.testing.assert_array_equal(observation[0], env.reset(seed=7)[0])
    np.testing.assert_array_equal(observation[1], before[1])
    lost = np.zeros((2, 5), np.float32)
    lost[0, 2] = 1.0
    over = []
    envs = together(FOLLOW, 2)
    envs.reset(seed=1)
    while not over or not over[-1].any():
        over.append(envs.step(lost)[2])
    assert over[-1].tolist() == [True, False]
    _, rewards, *_ = envs.step(lost)
    assert rewards[0] == 0.0
    assert rewards[1] > 0.0


def test_side_by_side_refuses() -> None:
    for count in (0, True):
        with pytest.raises(ValueError, match="num_envs is"):
            together(FOLLOW, count)
    envs = together(FOLLOW, np.int64(2))
    with pytest.raises(cs.SceneError, match="give 2 seeds"):
        envs.reset(seed=[1, 2, 3])
    first = envs.reset(seed=np.int64(1))[0]
    assert np.array_equal(first, envs.reset(seed=1)[0])
    envs.reset(seed=1)
    with pytest.raises(cs.SceneError, match=r"actions have shape \(2, 4\); give \(2, 5\)"):
        envs.step(np.zeros((2, 4)))


def test_follower_begins_clear_of_the_arm() -> None:
    """Whatever is drawn: seeds 10014 and 10018 began in touch when nothing raised the pad."""
    env = gymnasium.make(FOLLOW).unwrapped
    for seed in range(10_000, 10_020):
        env.prepare(seed)
        env.present()
        assert env.clearance() > 0.015
        assert env.data.ncon == 0


def test_tare_is_a_mean() -> None:
    """Of sixteen conversions: a quarter of the white noise of one is left, beside slow noise."""
    tares = []
    for noise in (0.0, 2e-15):
        middle = Randomisation().held()
        rough = dataclasses.replace(middle, noise=(noise, noise), drift=(0.0, 0.0), gain=(0.0, 0.0))
        env = gymnasium.make(FOLLOW, randomisation=rough).unwrapped
        env.prepare(0)
        env.attach()
        away = env.skin.read()
        for seed in range(40):
            env.signals.reset(0.0, seed, away, away)
            tares.append(env.signals.tare["pad"])
    slow, both = np.split(np.array(tares), 2)
    assert np.std(both - slow) == approx(0.5e-15, rel=0.15)


def test_wrapper_adds_and_changes_nothing(tmp_path: Path) -> None:
    """Reacher: its own observations and rewards are those that it has without the sensor."""
    model = tmp_path / "reacher.xml"
    site = write_model("Reacher-v5", "fingertip", TIP, model)
    reacher = gymnasium.make("Reacher-v5", xml_file=str(model))
    env = CapacitiveObservation(reacher, [site], exclude=["sideN"])
    check_env(env, skip_render_check=True)
    plain = gymnasium.make("Reacher-v5")
    before, after = plain.reset(seed=4)[0], env.reset(seed=4)[0]
    felt = [after[KEY]]
    for action in np.random.default_rng(1).uniform(-1, 1, (10, 2)).astype(np.float32):
        np.testing.assert_allclose(after["observation"], before, atol=1e-12)
        before, expected, *_ = plain.step(action)
        after, reward, *_ = env.step(action)
        assert reward == approx(expected, abs=1e-12)
        felt.append(after[KEY])
    assert all(len(f) == 12 for f in felt)
    assert np.ptp(np.array(felt)[:, :6], axis=0).max() > 0.1
    np.testing.assert_array_equal(env.reset(seed=4)[0][KEY], felt[0])


@pytest.mark.parametrize(
    ("name", "body"),
    [("Ant-v5", "torso"), ("Humanoid-v5", "torso"), ("Pusher-v5", "r_wrist_roll_link")],
)
def test_wrapper_on_other_models(tmp_path: Path, name: str, body: str) -> None:
    """They pass Gymnasium's checks, and move as before but for the six digits of MuJoCo's XML."""
    model = tmp_path / "model.xml"
    site = write_model(name, body, cs.Pose((0.0, 0.0, 0.1)), model)
    env = CapacitiveObservation(gymnasium.make(name, xml_file=str(model)), [site])
    check_env(env, skip_render_check=True)
    plain = gymnasium.make(name)
    plain.reset(seed=1)
    env.reset(seed=1)
    action = np.random.default_rng(1).uniform(-0.4, 0.4, plain.action_space.shape)
    before, expected, *_ = plain.step(action)
    after, reward, *_ = env.step(action)
    np.testing.assert_allclose(after["observation"], before, rtol=1e-4, atol=1e-4)
    assert reward == approx(expected, abs=1e-4)
    assert after[KEY].shape == (12,)


def test_wrapper_refuses_what_has_no_model() -> None:
    with pytest.raises(TypeError, match="no MuJoCo model"):
        CapacitiveObservation(gymnasium.make("CartPole-v1"), ["pad"])
    with pytest.raises(cs.SceneError, match="no model file"):
        write_model("CartPole-v1", "cart", TIP, "cart.xml")
    with pytest.raises(cs.SceneError, match="fingertop"):
        write_model("Reacher-v5", "fingertop", TIP, "reacher.xml")


def test_missing_gymnasium_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gymnasium.envs.registration", None)
    monkeypatch.delitem(sys.modules, "capsense.learning.envs")
    with pytest.raises(MissingDependencyError, match=r"capsense\[gym\]"):
        import capsense.learning.envs  # noqa: F401


def test_pressing_costs() -> None:
    """A pad driven into the arm: force, readings within bounds, less reward than touch alone."""
    env = gymnasium.make(FOLLOW).unwrapped
    env.reset(seed=0)
    for _ in range(30):
        observation, reward, _, _, facts = env.step(np.array([0, 0, -1, 0, 0]))
    assert facts["force"] > 5.0
    assert reward < 1 - 0.01 - 0.02 * facts["force"]
    assert env.observation_space.contains(observation)
    assert observation[:6].max() == 100.0  # beyond what the numbers tell
