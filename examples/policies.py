"""Gymnasium: policies that follow the sensors by hand-set gains, against idle and random ones.

Run it: ``python examples/policies.py [EPISODES]``. It prints the mean sum of the rewards of an
episode for each policy, and how many steps a second the environment makes. Needs
``pip install "capsense[gym]"``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from time import perf_counter
from typing import Any

import gymnasium
import numpy as np

import capsense.learning.envs  # noqa: F401, it registers them

Policy = Callable[[np.ndarray], np.ndarray]
LEVEL = 1.1
"""Mean change of the electrodes 5 cm over a forearm [10 fF]."""


TAPER = 0.2
"""What the electrodes nearer to the elbow feel more, of all that is felt."""


def servo(felt: np.ndarray) -> tuple[float, float, float, float]:
    """Sideways, up, yaw and pitch, each from -1 to 1, from six patches over a limb.

    E1 to E3 are on the left in the direction of x, E4 to E6 on the right.
    """
    e = np.maximum(felt[:6], 0.05)
    total = e.sum()
    side = (e[:3].sum() - e[3:].sum()) / total
    up = np.log(total / 6 / LEVEL)
    turn = ((e[2] - e[5]) - (e[0] - e[3])) / total
    nose = ((e[2] + e[5]) - (e[0] + e[3])) / total
    sideways, upwards, yaw, pitch = np.clip(
        [1.5 * side, 0.7 * up, 2.0 * turn, -0.7 * (nose - TAPER)], -1.0, 1.0
    )
    return sideways, upwards, yaw, pitch


def follow(observation: np.ndarray) -> np.ndarray:
    """For LimbFollow."""
    side, up, yaw, pitch = servo(observation)
    return np.array([0.0, side, up, yaw, pitch], np.float32)


def dress(observation: np.ndarray) -> np.ndarray:
    """For Dressing: the same, and ahead in the direction of the pad."""
    side, up, yaw, pitch = servo(observation)
    heading = observation[15]
    c, s, ahead = np.cos(heading), np.sin(heading), 0.4
    return np.array([ahead * c - side * s, ahead * s + side * c, up, yaw, pitch], np.float32)


def stop(observation: np.ndarray) -> np.ndarray:
    """For ApproachStop: turn the slower, the more the skin feels, and wait."""
    felt = observation[:96].reshape(8, 2, 6)[:, 0]
    loudest = np.sort(felt.ravel())[-2]
    speed = np.clip((1.2 - loudest) / 0.8, 0.0, 1.0)
    return np.array([-speed, 0.0, 0.0], np.float32)


def play(
    env: gymnasium.Env[Any, Any], policy: Policy, seed: int, most: int = 1000
) -> tuple[float, dict[str, Any], int]:
    """Sum of the rewards of an episode, the last facts, and how many steps it took."""
    observation, facts = env.reset(seed=seed)
    total, step = 0.0, 0
    for _ in range(most):
        observation, reward, over, cut, facts = env.step(policy(observation))
        total, step = total + float(reward), step + 1
        if over or cut:
            break
    return total, facts, step


def at_random(env: gymnasium.Env[Any, Any], seed: int) -> Policy:
    """Actions drawn from the space."""
    env.action_space.seed(seed)
    return lambda _: env.action_space.sample()


SCRIPTED = {
    "capsense/LimbFollow-v0": follow,
    "capsense/Dressing-v0": dress,
    "capsense/ApproachStop-v0": stop,
}


def main(episodes: int = 5) -> None:
    """Print the table."""
    print("environment                scripted     idle   random   steps a second")
    for name in SCRIPTED:
        env = gymnasium.make(name)
        idle = np.zeros(env.action_space.shape, np.float32)
        policies = (SCRIPTED[name], lambda _, idle=idle: idle, at_random(env, 0))
        start, steps, sums = perf_counter(), 0, []
        for policy in policies:
            found = [play(env, policy, seed) for seed in range(episodes)]
            sums.append(np.mean([total for total, _, _ in found]))
            steps += sum(count for _, _, count in found)
        rate = steps / (perf_counter() - start)
        print(f"{name:26}" + "".join(f"{s:9.1f}" for s in sums) + f"{rate:12.0f}", flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
