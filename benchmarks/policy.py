"""Policies for LimbFollow-v0, trained on the field or on the distance model, judged on the field.

``python benchmarks/policy.py OUT`` trains by soft actor-critic (SAC of Stable-Baselines3), one
training after the other, each for so many steps of the environment, on one core: some on the field
and as many on the distance model, which differ in their seeds. It writes ``policy.json``,
``policy.md`` and ``policy.png``. What was trained already for so many steps is not trained again.
Needs ``pip install "capsense[train]"``, which brings PyTorch: too much for the extra ``test``, so
that the tests of trainings are skipped without it.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np
from distance_model import DistanceModel
from machine import describe_machine, on_one_core

import capsense as cs
from capsense._style import COLOURS, LEGEND, dress
from capsense.learning.envs import LimbFollow
from capsense.learning.envs.vector import LimbFollowVector
from capsense.learning.servo import Belief, LimbPose, PoseEstimator

STEPS = 250
"""Of an episode."""
KINDS = ("field", "distance")
"""What policies are trained on."""
DRAWS = 4000
"""Of the bootstrap."""
SEEDS = range(10_000, 10_020)
"""Of the episodes that policies are judged on; training does not see them."""


class DistanceSkin:
    """In place of a skin's field: the distance model, of the person alone."""

    def __init__(self, skin: Any, scale: float) -> None:
        self.skin, self.scale = skin, scale

    def read(self) -> Mapping[str, cs.Reading]:
        out = {}
        for name, sensor in self.skin.sensors.items():
            plates = DistanceModel(sensor.simulator.design, self.scale)
            change = np.diag(plates.read(b for b in sensor.scene() if "limb" in str(b.name)))
            empty = sensor.simulator.empty
            out[name] = replace(empty, capacitance=empty.capacitance + change, delta=change)
        return out


class DistanceFollow(LimbFollow):
    """LimbFollow as it is without a field: eps A / d, scaled to be right at the set distance."""

    def attach(self) -> None:
        super().attach()
        usual = PoseEstimator(self.simulator).scene(LimbPose(), Belief().radius)
        right = self.simulator.step(usual).delta.trace()
        scale = float(right / DistanceModel(self.simulator.design).read(usual).sum())
        self.skin = DistanceSkin(self.skin, scale)  # type: ignore[assignment]


def train(kind: str, seed: int, steps: int, folder: Path) -> dict[str, Any]:
    """Train one policy; its learning curve: steps made and the return at each episode's end."""
    from gymnasium.wrappers import TimeLimit
    from stable_baselines3 import SAC
    from stable_baselines3.common.monitor import Monitor

    curve = folder / f"{kind}-{seed}.json"
    if curve.is_file():
        known = json.loads(curve.read_text())
        if steps - STEPS < known["steps"][-1] <= steps:
            return known
    world = {"field": LimbFollow, "distance": DistanceFollow}[kind]
    env = Monitor(TimeLimit(world(), STEPS))
    model = SAC(
        "MlpPolicy", env, seed=seed, policy_kwargs={"net_arch": [64, 64]}, batch_size=128,
        learning_starts=min(1000, steps // 2), gamma=0.98, learning_rate=1e-3, train_freq=2,
        gradient_steps=1,
    )  # fmt: skip
    start, begun = perf_counter(), process_time()
    model.learn(steps)
    out = {"steps": np.cumsum(env.get_episode_lengths()).tolist(),
           "returns": env.get_episode_rewards(), "seconds": perf_counter() - start,
           "processor": process_time() - begun}  # fmt: skip
    model.save(folder / f"{kind}-{seed}.zip")
    curve.write_text(json.dumps(out))
    return out


def judged(policy: Callable[[np.ndarray], np.ndarray]) -> dict[str, list[float]]:
    """Return and errors of a policy on the field, of every episode; all go side by side."""
    n = len(SEEDS)
    envs = LimbFollowVector(n)
    observation, _ = envs.reset(seed=list(SEEDS))
    going, steps = np.ones(n, bool), np.zeros(n)
    sums = {name: np.zeros(n) for name in ("return", "error", "angle", "lost", "touched")}
    for _ in range(STEPS):
        observation, reward, over, _, facts = envs.step(policy(observation))
        steps += going
        for name, value in (("return", reward), ("error", 100 * facts["error"]),
                            ("angle", np.degrees(facts["angle"])), ("lost", over)):  # fmt: skip
            sums[name] += np.where(going, value, 0.0)
        sums["touched"] = np.where(going & (facts["force"] > 0), 1.0, sums["touched"])
        going &= ~over
    for name in ("error", "angle"):
        sums[name] /= steps
    return {name: values.tolist() for name, values in sums.items()}


def policies(
    folder: Path, trainings: Sequence[int]
) -> dict[str, list[Callable[[np.ndarray], np.ndarray]]]:
    """Those that were trained, one by hand-set gains, and none; of batches of observations."""
    import sys

    from stable_baselines3 import SAC

    sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
    from policies import follow

    out: dict[str, list[Callable[[np.ndarray], np.ndarray]]] = {}
    for kind in KINDS:
        models = [SAC.load(folder / f"{kind}-{seed}.zip") for seed in trainings]
        out[f"trained on the {kind}"] = [
            lambda x, m=model: m.predict(x, deterministic=True)[0] for model in models
        ]
    return {
        **out,
        "hand-set gains": [lambda x: np.array([follow(one) for one in x])],
        "idle": [lambda x: np.zeros((len(x), 5), np.float32)],
    }


def means(values: list[list[float]]) -> np.ndarray:
    """Means of draws with replacement (the bootstrap) of trainings, and of episodes in each."""
    data, rng = np.array(values), np.random.default_rng(0)
    trainings, episodes = data.shape
    rows = rng.integers(trainings, size=(DRAWS, trainings, 1))
    columns = rng.integers(episodes, size=(DRAWS, trainings, episodes))
    return data[rows, columns].mean(axis=(1, 2))


def told(mean: float, draws: np.ndarray) -> str:
    """A mean and its 95 % interval."""
    low, high = np.percentile(draws, (2.5, 97.5))
    return f"{mean:.1f} ({low:.1f} to {high:.1f})"


def loss(results: Mapping[str, list[Mapping[str, list[float]]]]) -> str:
    """What training on the distance model loses: the difference of returns on the field.

    Its interval is Welch's, of the trainings' means: with so few, the bootstrap's is too narrow.
    """
    from scipy.stats import ttest_ind

    field, distance = (
        [float(np.mean(f["return"])) for f in results[f"trained on the {kind}"]] for kind in KINDS
    )
    lost = np.mean(field) - np.mean(distance)
    if len(field) < 2:
        return f"Lost by training on the distance: {lost:.1f}\n"
    low, high = ttest_ind(field, distance, equal_var=False).confidence_interval()
    return f"Lost by training on the distance: {lost:.1f} ({low:.1f} to {high:.1f})\n"


def table(results: Mapping[str, list[Mapping[str, list[float]]]]) -> str:
    """Markdown: means with 95 % intervals, and the return of each training."""
    lines = ["| | return | of each training | error of place [cm] | angle [°] | lost | touched |",
             "|---|---|---|---|---|---|---|"]  # fmt: skip
    for name, found in results.items():
        values = {k: [f[k] for f in found] for k in ("return", "error", "angle")}
        cells = {k: told(float(np.mean(v)), means(v)) for k, v in values.items()}
        each = ", ".join(f"{np.mean(f['return']):.0f}" for f in found) if len(found) > 1 else ""
        counts = [f"{sum(sum(f[k]) for f in found):.0f} of {sum(len(f[k]) for f in found)}"
                  for k in ("lost", "touched")]  # fmt: skip
        row = [cells["return"], each, cells["error"], cells["angle"], *counts]
        lines.append(f"| {name} | {' | '.join(row)} |")
    return "\n".join(lines) + "\n"


def plot(curves: Mapping[str, list[Mapping[str, Any]]], file: Path) -> None:
    """Return of the training episodes against steps, mean of ten."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 3.2), layout="constrained")
    axis = figure.subplots()
    for n, (kind, trainings) in enumerate(curves.items()):
        for k, curve in enumerate(trainings):
            steps, returns = np.array(curve["steps"]), np.array(curve["returns"])
            axis.plot(steps, returns, ".", color=COLOURS[n], ms=3, alpha=0.2)
            smooth = np.convolve(returns, np.ones(10) / 10, "valid")
            label = None if k else f"trained and read on the {kind}"
            axis.plot(steps[9:], smooth, color=COLOURS[n], label=label)
    dress(axis, "steps of the environment", "return of an episode")
    axis.legend(**LEGEND)
    figure.savefig(file, dpi=130)


def main() -> None:
    """Train, judge, and write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--steps", type=int, default=40_000)
    parser.add_argument("--trainings", type=int, default=3, help="of each kind")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    import torch

    torch.set_num_threads(1)
    curves: dict[str, list[dict[str, Any]]] = {kind: [] for kind in KINDS}
    seeds = range(1, options.trainings + 1)
    for seed in seeds:
        for kind, trained in curves.items():
            trained.append(train(kind, seed, options.steps, options.folder))
            one = trained[-1]
            print(f"{kind}, seed {seed}: {one['steps'][-1]} steps in {one['seconds']:.0f} s, "
                  f"{one['processor']:.0f} s of the processor", flush=True)  # fmt: skip
    found = policies(options.folder, seeds)
    results = {name: [judged(policy) for policy in some] for name, some in found.items()}
    text = f"{table(results)}\n{loss(results)}"
    times = {k: [(c["seconds"], c["processor"]) for c in some] for k, some in curves.items()}
    machine = describe_machine(("capsense", "stable-baselines3", "torch"))
    facts = {"machine": machine, "results": results, "seconds": times}
    (options.folder / "policy.json").write_text(json.dumps(facts, indent=1))
    (options.folder / "policy.md").write_text(text)
    plot(curves, options.folder / "policy.png")
    print(text)


if __name__ == "__main__":
    on_one_core()
    main()
