"""Sensors in Assistive Gym itself: a Jaco's tool, and a person's wrist; and how long a read takes.

Needs a checkout that ``assistive_gym_patch.py`` has patched, on ``PYTHONPATH``.
"""

from __future__ import annotations

import sys
import time

import assistive_gym  # noqa: F401, registers its environments
import gym
import numpy as np

import capsense as cs

STEPS = 100


def ride(env: object, sensor: cs.assistive_gym.AssistiveGymSensor, name: str) -> None:
    """Step an environment and read after every step; print what was felt and how long it took.

    Times are those of the processor. A scene is also solved by itself, once more.
    """
    times, bare, felt = [], [], []
    for _ in range(STEPS):
        env.step(env.action_space.sample())  # type: ignore[attr-defined]
        start = time.process_time()
        reading = sensor.read()
        times.append(time.process_time() - start)
        scene = sensor.scene()
        start = time.process_time()
        sensor.simulator.step(scene)
        bare.append(time.process_time() - start)
        felt.append(float(reading.delta.diagonal().max()))
        assert np.isfinite(reading.delta).all()
    ms = 1e3 * np.array(times[5:])
    print(
        f"{name}: largest change {1e15 * max(felt):.3g} fF; a read takes {np.median(ms):.2f} ms, "
        f"95 % below {np.percentile(ms, 95):.2f} ms; a step alone "
        f"{1e3 * np.median(bare[5:]):.2f} ms, {reading.stats.unknowns} unknowns"
    )


def main() -> None:
    """Both examples of the page, twice, with a reset between them."""
    env = gym.make("BedBathingJaco-v1", disable_env_checker=True).unwrapped
    seed = int(sys.argv[1]) if len(sys.argv) > 1 else 1
    env.seed(seed)
    env.action_space.seed(seed)
    env.reset()
    tool = cs.assistive_gym.attach(
        env, pose_in_link=cs.Pose((0, 0, 0.05)), exclude=["tool", "*finger*"],
        materials={"furniture": "wood"},
    )  # fmt: skip
    ride(env, tool, "Jaco's tool")
    wrist = cs.assistive_gym.attach(
        env, "human", "right_wrist", pose_in_link=cs.Pose((0, 0, -0.06), (1, 0, 0, 0)),
        exclude=["right_hand", "right_forearm"], materials={"furniture": "wood"},
    )  # fmt: skip
    ride(env, wrist, "the person's right wrist")
    env.reset()
    ride(env, tool, "Jaco's tool, after a reset")
    fast = cs.Simulator("six_patch", preset="fast")
    place = cs.Pose((0, 0, 0.05))
    bare = ["tool", "*finger*", "furniture"]
    for name, design, exclude, materials in (
        ("preset fast", fast, bare[:2], {"furniture": "wood"}),
        ("without the bed", "six_patch", bare, None),
    ):
        options = {"pose_in_link": place, "exclude": exclude, "materials": materials}
        ride(env, cs.assistive_gym.attach(env, design=design, **options), f"Jaco's tool, {name}")


if __name__ == "__main__":
    main()
