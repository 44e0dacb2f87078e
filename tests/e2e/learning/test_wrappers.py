"""Environments in training libraries, pictures, autoreset, and WhoIsThere."""

from __future__ import annotations

import importlib.metadata
import subprocess
import sys
import tomllib
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import capsense as cs

gymnasium = pytest.importorskip("gymnasium")
pytest.importorskip("mujoco")

from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.vector import AutoresetMode  # noqa: E402

from capsense.learning.envs import IDS  # noqa: E402
from capsense.learning.envs.scale import LIMIT, compressed  # noqa: E402
from capsense.learning.envs.who import TARGETS, WhoIsThereVector  # noqa: E402

FOLLOW, STOP, WHO = "capsense/LimbFollow-v0", "capsense/ApproachStop-v0", "capsense/WhoIsThere-v0"


def together(name: str, count: int, **options: Any) -> Any:
    return gymnasium.make_vec(
        name, num_envs=count, vectorization_mode="vector_entry_point", **options
    )


@pytest.mark.parametrize("name", IDS)
def test_pictures(name: str) -> None:
    """Gymnasium's checks with rendering; a picture has several colours, and changes."""
    env = gymnasium.make(name, render_mode="rgb_array")
    check_env(env.unwrapped)
    env.reset(seed=1)
    first = env.render()
    assert first.shape == (240, 320, 3)
    assert first.dtype == np.uint8
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 2
    for _ in range(5):
        env.step(np.full(env.action_space.shape, -1.0, np.float32))
    assert (env.render() != first).any()
    assert gymnasium.make(name).unwrapped.render() is None


@pytest.mark.parametrize("name", IDS)
def test_no_warnings(name: str) -> None:
    """ApproachStop warned of all eight sensors at each reset, LimbFollow at some seeds."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(name)
        env.reset(seed=0)
        for _ in range(5):
            env.step(np.zeros(env.action_space.shape, np.float32))


def test_registered_by_the_module_before_the_colon() -> None:
    """In a process of its own that imports Gymnasium alone."""
    text = (
        f"import gymnasium; env = gymnasium.make('capsense.learning.envs:{WHO}'); "
        "print(env.reset(seed=1)[0].shape)"
    )
    found = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "(23,)"


def test_entry_point_registers() -> None:
    """What the package declares registers all environments, as tools do that call the group."""
    project = Path(__file__).parents[3] / "pyproject.toml"
    group = "gymnasium.envs"
    declared = tomllib.loads(project.read_text())["project"]["entry-points"][group]
    point = importlib.metadata.EntryPoint("__root__", declared["__root__"], group)
    from gymnasium.envs.registration import registry

    taken = {name: registry.pop(name) for name in IDS}
    point.load()()
    assert {name: registry[name].entry_point for name in IDS} == {
        name: spec.entry_point for name, spec in taken.items()
    }


@pytest.mark.parametrize(("name", "size"), [(FOLLOW, 5), (WHO, 1)])
def test_same_step(name: str, size: int) -> None:
    """As next-step, but the first observation of a new episode comes with the last step's reward.

    Noise of chips is random; rewards and final facts are not.
    """
    same = together(name, 2, max_episode_steps=3, autoreset_mode="SameStep")
    late = together(name, 2, max_episode_steps=3)
    assert same.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    np.testing.assert_array_equal(same.reset(seed=[4, 9])[0], late.reset(seed=[4, 9])[0])
    still = np.zeros((2, size), np.float32)
    for step in range(3):
        one, other = same.step(still), late.step(still)
        np.testing.assert_array_equal(one[1], other[1])
        np.testing.assert_array_equal(one[3], [step == 2, step == 2])
    assert "final_obs" in one[4]
    for k in range(2):
        np.testing.assert_array_equal(one[4]["final_obs"][k], other[0][k])
    for key, values in other[4].items():
        np.testing.assert_array_equal(one[4]["final_info"][key], values)
    begun = late.step(still)
    np.testing.assert_array_equal(one[0], begun[0])
    assert not (one[0] == other[0]).all()
    _, rewards, _, cut, facts = same.step(still)
    assert rewards.all()
    assert not cut.any()
    assert "final_obs" not in facts


def test_unknown_autoreset() -> None:
    for name in (FOLLOW, WHO):
        with pytest.raises(ValueError, match="autoreset_mode is 'Disabled'"):
            together(name, 1, autoreset_mode="Disabled")


def test_normalised() -> None:
    """The same numbers, compressed to ±1: straight near zero, logarithmic far from it."""
    plain, scaled = (gymnasium.make(FOLLOW, normalise=on).unwrapped for on in (False, True))
    first, second = plain.reset(seed=2)[0], scaled.reset(seed=2)[0]
    np.testing.assert_allclose(second[:6], compressed(first[:6]), rtol=1e-6)
    np.testing.assert_array_equal(second[6:], first[6:])
    assert scaled.observation_space.high[:6].tolist() == [1.0] * 6
    ends = compressed(np.array([-LIMIT, 0.0, LIMIT]))
    np.testing.assert_allclose(ends, [-1.0, 0.0, 1.0], atol=1e-12)
    ratio = compressed(np.array([1e-3, 2e-3, 10.0, 20.0, 40.0]))
    np.testing.assert_allclose(ratio[1] / ratio[0], 2.0, rtol=1e-3)
    np.testing.assert_allclose(ratio[4] - ratio[3], ratio[3] - ratio[2], rtol=1e-3)


def test_who_mutual_channels_tell_the_grounding() -> None:
    """Of metal at 3 to 9 cm, by a linear rule; self channels alone hardly do better than chance."""
    envs = WhoIsThereVector(240, classes=["metal grounded", "metal floating"])
    envs.reset(seed=3)
    changes = 1e14 * envs.changes()
    floats = np.where(envs.kind == list(TARGETS).index("metal floating"), 1.0, -1.0)
    own = changes[:, :6].sum(axis=1, keepdims=True)
    right = []
    for channels in (21, 6):
        x = np.column_stack([changes[:, :channels] / own, np.log(own), np.ones(240)])
        rule = np.linalg.lstsq(x[:160], floats[:160], rcond=1e-3)[0]
        right.append(np.mean(np.sign(x[160:] @ rule) == floats[160:]))
    assert right[0] > 0.95
    assert right[1] < 0.75


def test_who_rewards_the_gap_of_the_class() -> None:
    """Going straight to the right gap reaches it; the reward is 1 there."""
    envs = together(WHO, 12)
    world = envs.unwrapped
    envs.reset(seed=1)
    assert len(set(world.kind.tolist())) == 4
    for _ in range(29):
        action = np.clip((world.gap - world.target) / 0.008, -1, 1)[:, None]
        _, rewards, over, _, facts = envs.step(action.astype(np.float32))
        assert not over.any()
    assert facts["success"].all()
    np.testing.assert_allclose(rewards, 1.0, atol=1e-6)


def test_who_same_seed_same_episode() -> None:
    one, other = gymnasium.make(WHO).unwrapped, gymnasium.make(WHO).unwrapped
    first, _ = one.reset(seed=7)
    other.reset(seed=8)
    other.step(np.ones(1, np.float32))
    np.testing.assert_array_equal(first, other.reset(seed=7)[0])
    action = np.array([0.5], np.float32)
    np.testing.assert_array_equal(one.step(action)[0], other.step(action)[0])
    assert not np.array_equal(first, other.reset(seed=8)[0])


def test_who_resets_some() -> None:
    """Of the others, the place stays; the chips go on."""
    envs = together(WHO, 3).unwrapped
    envs.reset(seed=5)
    envs.step(np.ones((3, 1), np.float32))
    gap, kind = envs.gap.copy(), envs.kind.copy()
    envs.reset(seed=11, options={"reset_mask": np.array([False, True, False])})
    assert envs.gap[1] != gap[1]
    np.testing.assert_array_equal(envs.gap[[0, 2]], gap[[0, 2]])
    np.testing.assert_array_equal(envs.kind[[0, 2]], kind[[0, 2]])


def test_who_takes_readout_files(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text('chip = "ad7746"\n')
    env = gymnasium.make(WHO, chip=str(file)).unwrapped
    assert env.reset(seed=1)[0].shape == (17,)
    assert env.observation_names[0] == "E1-E2"


def test_who_refuses() -> None:
    with pytest.raises(cs.SceneError, match="no class 'metal floting'; did you mean 'metal float"):
        WhoIsThereVector(1, classes=["metal floting"])
    with pytest.raises(cs.SceneError, match="gap is"):
        WhoIsThereVector(1, gap=(0.09, 0.03))
    with pytest.raises(ValueError, match="num_envs is 0"):
        WhoIsThereVector(0)
    envs = WhoIsThereVector(2)
    envs.reset(seed=1)
    for actions in (np.zeros((2, 2)), np.full((2, 1), np.nan)):
        with pytest.raises(cs.SceneError, match=r"give \(2, 1\)"):
            envs.step(actions)


@pytest.mark.parametrize("name", [FOLLOW, WHO])
def test_stable_baselines(name: str) -> None:
    """PPO learns for two batches; the last observation of an episode is told."""
    pytest.importorskip("stable_baselines3")
    from stable_baselines3 import PPO

    from capsense.learning.envs.sb3 import SB3VecEnv

    with pytest.raises(ValueError, match="autoreset_mode='SameStep'"):
        SB3VecEnv(together(name, 2))
    envs = SB3VecEnv(
        together(name, 2, max_episode_steps=4, autoreset_mode="SameStep", render_mode="rgb_array")
    )
    assert len(envs.get_images()) == 2
    envs.seed(3)
    first = envs.reset()
    assert first.shape == (2, *envs.observation_space.shape)
    still = np.zeros((2, *envs.action_space.shape), np.float32)
    told = [envs.step(still) for _ in range(4)]
    assert [ended.all() for _, _, ended, _ in told] == [False, False, False, True]
    for k, facts in enumerate(told[-1][3]):
        assert facts["TimeLimit.truncated"]
        assert not np.array_equal(facts["terminal_observation"], told[-1][0][k])
    envs.seed(3)
    np.testing.assert_array_equal(envs.reset(), first)
    model = PPO("MlpPolicy", envs, n_steps=8, batch_size=16, n_epochs=1, seed=0)
    before = [p.clone() for p in model.policy.parameters()]
    model.learn(32)
    after = list(model.policy.parameters())
    assert any((a != b).any() for a, b in zip(after, before, strict=True))


@pytest.mark.parametrize("name", [FOLLOW, WHO])
def test_rsl_rl(name: str, tmp_path: Path) -> None:
    """Its runner of PPO learns for two iterations."""
    pytest.importorskip("rsl_rl")
    from rsl_rl.runners import OnPolicyRunner

    from capsense.learning.envs.rsl import RslVecEnv

    with pytest.raises(ValueError, match="autoreset_mode='SameStep'"):
        RslVecEnv(together(name, 2))
    envs = RslVecEnv(
        together(name, 2, max_episode_steps=5, autoreset_mode="SameStep"),
        max_episode_length=5, seed=1,
    )  # fmt: skip
    import torch

    size = envs.envs.single_observation_space.shape[0]
    assert envs.get_observations()["policy"].shape == (2, size)
    outs = [envs.step(torch.zeros(2, envs.num_actions)) for _ in range(5)]
    assert [bool(o[2].all()) for o in outs] == [False] * 4 + [True]
    assert outs[-1][3]["time_outs"].all()
    assert envs.episode_length_buf.tolist() == [0, 0]
    net = {"class_name": "MLPModel", "hidden_dims": [16], "activation": "elu"}
    config = {
        "num_steps_per_env": 6, "save_interval": 100, "obs_groups": {"actor": ["policy"],
        "critic": ["policy"]},
        "actor": {**net, "distribution_cfg": {"class_name": "GaussianDistribution",
                                              "init_std": 1.0}},
        "critic": net,
        "algorithm": {"class_name": "PPO", "num_learning_epochs": 1, "num_mini_batches": 2},
    }  # fmt: skip
    runner = OnPolicyRunner(envs, config, log_dir=str(tmp_path), device="cpu")
    runner.learn(2)
    action = runner.get_inference_policy()(envs.get_observations())
    assert action.shape == (2, envs.num_actions)
