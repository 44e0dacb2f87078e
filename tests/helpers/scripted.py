"""Policies for the environments that follow the sensors by hand-set gains, and random ones."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np

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


def play(env: gymnasium.Env[Any, Any], policy: Policy, seed: int, steps: int) -> tuple[float, Any]:
    """Sum of the rewards of an episode, and the last facts."""
    observation, facts = env.reset(seed=seed)
    total = 0.0
    for _ in range(steps):
        observation, reward, over, cut, facts = env.step(policy(observation))
        total += float(reward)
        if over or cut:
            break
    return total, facts


def at_random(env: gymnasium.Env[Any, Any], seed: int) -> Policy:
    """Actions drawn from the space."""
    env.action_space.seed(seed)
    return lambda _: env.action_space.sample()
