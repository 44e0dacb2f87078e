"""Steps a second of the environments: one alone, and many side by side read by one fleet.

``python benchmarks/environments.py [--seconds 4] [--counts 8 64]`` prints a table: steps a
second by the clock, and in one second of the processor's time, which other programs disturb less.
Actions are zero. The first resets are not counted; environments side by side begin anew where an
episode ends.
"""

from __future__ import annotations

import argparse
from time import perf_counter, process_time
from typing import Any

import gymnasium
import numpy as np
from machine import describe_machine

import capsense.learning.envs

Rate = tuple[float, float]


def _rate(env: Any, action: Any, count: int, seconds: float) -> Rate:
    start, begun, steps = perf_counter(), process_time(), 0
    while perf_counter() - start < seconds:
        env.step(action)
        steps += count
    return steps / (perf_counter() - start), steps / (process_time() - begun)


def alone(name: str, seconds: float) -> Rate:
    """Steps a second of a single environment: by the clock, and of the processor."""
    env = gymnasium.make(name, max_episode_steps=10**9)
    action = np.zeros(env.action_space.shape, np.float32)
    env.reset(seed=0)
    for _ in range(5):
        env.step(action)
    return _rate(env, action, 1, seconds)


def together(name: str, count: int, seconds: float) -> Rate:
    """The same of many side by side, each step of each of them counted."""
    envs = gymnasium.make_vec(
        name, num_envs=count, vectorization_mode="vector_entry_point", max_episode_steps=10**9
    )
    actions = np.zeros(envs.action_space.shape, np.float32)
    envs.reset(seed=0)
    for _ in range(2):
        envs.step(actions)
    return _rate(envs, actions, count, seconds)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=4.0, help="of each measurement")
    parser.add_argument("--counts", type=int, nargs="+", default=[8, 64])
    options = parser.parse_args()
    print(describe_machine(("capsense", "mujoco", "gymnasium")))
    heads = ["alone", *(f"{count} side by side" for count in options.counts)]
    print(f"| | {' | '.join(heads)} |\n|---|{'---|' * len(heads)}")
    for name in capsense.learning.envs.IDS:
        rates = [alone(name, options.seconds)]
        rates += [together(name, count, options.seconds) for count in options.counts]
        cells = [f"{clock:.0f} (processor: {own:.0f})" for clock, own in rates]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
