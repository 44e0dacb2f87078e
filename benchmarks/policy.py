"""A policy for LimbFollow-v0, trained on the field or on the distance model, judged on the field.

``python benchmarks/policy.py OUT`` trains two policies by soft actor-critic (SAC of
Stable-Baselines3), one after the other, each for so many steps of the environment, on one core,
and writes ``policy.json``, ``policy.md`` and ``policy.png``. A policy that is there already is not
trained again. Needs ``pip install "capsense[train]"``.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from distance_model import DistanceModel
from machine import describe_machine, on_one_core
from servoing import mean

import capsense as cs
from capsense._style import COLOURS, LEGEND, dress
from capsense.learning.envs.follow import LimbFollow
from capsense.learning.servo import Belief, LimbPose, PoseEstimator

STEPS = 250
"""Of an episode."""
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


def train(kind: str, steps: int, folder: Path) -> dict[str, Any]:
    """Train one policy; its learning curve: steps made and the return at each episode's end."""
    from gymnasium.wrappers import TimeLimit
    from stable_baselines3 import SAC
    from stable_baselines3.common.monitor import Monitor

    curve = folder / f"{kind}.json"
    if curve.is_file():
        return json.loads(curve.read_text())
    world = {"field": LimbFollow, "distance": DistanceFollow}[kind]
    env = Monitor(TimeLimit(world(), STEPS))
    model = SAC(
        "MlpPolicy", env, seed=1, policy_kwargs={"net_arch": [64, 64]}, learning_starts=1000,
        batch_size=128, gamma=0.98, learning_rate=1e-3, train_freq=2, gradient_steps=1,
    )  # fmt: skip
    start = perf_counter()
    model.learn(steps)
    out = {"steps": np.cumsum(env.get_episode_lengths()).tolist(),
           "returns": env.get_episode_rewards(), "seconds": perf_counter() - start}  # fmt: skip
    model.save(folder / f"{kind}.zip")
    curve.write_text(json.dumps(out))
    return out


def judged(policy: Callable[[np.ndarray], np.ndarray]) -> dict[str, Any]:
    """Return and errors of a policy on the field, of every episode."""
    env, rows = LimbFollow(), []
    for seed in SEEDS:
        observation, _ = env.reset(seed=seed)
        total, errors, angles, touched = 0.0, [], [], False
        for _ in range(STEPS):
            observation, reward, over, _, facts = env.step(policy(observation))
            total += float(reward)
            errors.append(100 * facts["error"])
            angles.append(np.degrees(facts["angle"]))
            touched |= facts["force"] > 0
            if over:
                break
        rows.append((total, np.mean(errors), np.mean(angles), over, touched))
    names = ("return", "error", "angle", "lost", "touched")
    return dict(zip(names, np.array(rows, dtype=float).T.tolist(), strict=True))


def policies(folder: Path) -> dict[str, Callable[[np.ndarray], np.ndarray]]:
    """Those that were trained, one by hand-set gains, and none."""
    import sys

    from stable_baselines3 import SAC

    sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
    from policies import follow

    out: dict[str, Callable[[np.ndarray], np.ndarray]] = {}
    for kind in ("field", "distance"):
        model = SAC.load(folder / f"{kind}.zip")
        out[f"trained on the {kind}"] = lambda x, m=model: m.predict(x, deterministic=True)[0]
    return {**out, "hand-set gains": follow, "idle": lambda _: np.zeros(5, np.float32)}


def table(results: Mapping[str, Mapping[str, list[float]]]) -> str:
    """Markdown: means with 95 % intervals by the bootstrap over episodes."""
    lines = ["| | return | error of place [cm] | angle [°] | lost | touched |",
             "|---|---|---|---|---|---|"]  # fmt: skip
    for name, found in results.items():
        cells = ["{:.1f} ({:.1f}–{:.1f})".format(*mean(found[k])) for k in
                 ("return", "error", "angle")]  # fmt: skip
        counts = [f"{sum(found[k]):.0f} of {len(found[k])}" for k in ("lost", "touched")]
        lines.append(f"| {name} | {' | '.join(cells + counts)} |")
    return "\n".join(lines) + "\n"


def plot(curves: Mapping[str, Mapping[str, Any]], file: Path) -> None:
    """Return of the training episodes against steps, mean of ten."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 3.2), layout="constrained")
    axis = figure.subplots()
    for n, (kind, curve) in enumerate(curves.items()):
        steps, returns = np.array(curve["steps"]), np.array(curve["returns"])
        axis.plot(steps, returns, ".", color=COLOURS[n], ms=3, alpha=0.3)
        smooth = np.convolve(returns, np.ones(10) / 10, "valid")
        label = f"trained and read on the {kind}"
        axis.plot(steps[9:], smooth, color=COLOURS[n], label=label)
    dress(axis, "steps of the environment", "return of an episode")
    axis.legend(**LEGEND)
    figure.savefig(file, dpi=130)


def main() -> None:
    """Train, judge, and write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--steps", type=int, default=32_000)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    import torch

    torch.set_num_threads(1)
    curves = {k: train(k, options.steps, options.folder) for k in ("field", "distance")}
    for kind, curve in curves.items():
        print(f"{kind}: {curve['steps'][-1]} steps in {curve['seconds']:.0f} s")
    results = {name: judged(policy) for name, policy in policies(options.folder).items()}
    text = table(results)
    seconds = {kind: curve["seconds"] for kind, curve in curves.items()}
    machine = describe_machine(("capsense", "stable-baselines3", "torch"))
    facts = {"machine": machine, "results": results, "seconds": seconds}
    (options.folder / "policy.json").write_text(json.dumps(facts, indent=1))
    (options.folder / "policy.md").write_text(text)
    plot(curves, options.folder / "policy.png")
    print(text)


if __name__ == "__main__":
    on_one_core()
    main()
