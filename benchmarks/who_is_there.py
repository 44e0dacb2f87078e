"""WhoIsThere-v0: policies trained on the field or on three distance models, judged on the field.

``python benchmarks/who_is_there.py OUT`` trains five policies for each of five kinds of readings
and three variants of the task, judges them in the environment, and writes ``who_is_there.json``
and ``who_is_there.md``. Needs PyTorch (``pip install "capsense[train]"``).

Readings that policies are trained on:

- ``field``: a bank of scenes that the environment draws, each solved at 24 gaps, and interpolated
  along the approach;
- ``field, self``: the same without the mutual channels;
- ``plates``: ε₀A/d of each electrode, d the distance from its centre to the body, scaled to the
  field's mean at 5 cm; it has no mutual capacitances, so policies get the self channels alone;
- ``fitted``: every channel, mutual ones too, is the bank's mean at that gap: of all functions of
  the distance the one with the least squared error;
- ``range``: the gap itself with noise of 1 mm rms, in training and when judged: what an ideal
  range sensor gives.

Protocol: the gap follows from actions by the environment's own rule, so gradients of the return are
propagated through an episode of 30 steps (Adam, the same steps and networks for all). White noise
of the chip and its gain are added in training. Judged are the means over five trainings of episodes
that no training saw, in ``WhoIsThereVector`` with its chips; intervals are those of Student's t
over the trainings.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from machine import describe_machine
from scipy.stats import t as student

from capsense.constants import EPS0
from capsense.learning.envs.scale import LIMIT, UNIT, compressed
from capsense.learning.envs.who import (
    COST,
    FURTHEST,
    NEAREST,
    SPEED,
    STEP,
    TARGETS,
    WhoIsThereVector,
)  # fmt: skip

STEPS = 30
"""Of an episode."""
KINDS = ("field", "field, self", "plates", "fitted", "range")
SELF = 6
"""Self channels, the first; of ``plates`` and ``field, self``."""
VARIANTS: dict[str, dict[str, Any]] = {
    "drawn class, gap 3 to 9 cm": {},
    "grounded metal, gap 3 to 9 cm": {"classes": ["metal grounded"]},
    "grounded metal, gap 6 cm": {"classes": ["metal grounded"], "gap": (0.06, 0.06)},
}
GRID = np.geomspace(NEAREST, FURTHEST, 24)
"""Gaps that the bank is solved at [m]."""
NOISE = 0.2e-15
"""Rms of a reading less its tare, the chip's own [F]; of the environment: 0.21 fF."""
GAIN, RANGE = 0.05, 1e-3
"""Largest error of a chip's gain; rms of the ideal range sensor [m]."""
SEEDS, TRAINED_WITH, JUDGED_WITH = 5, 0, 90_000


def bank(scenes: int, options: dict[str, Any]) -> dict[str, np.ndarray]:
    """Scenes: field and plates' changes at every gap, (scenes, gaps, K) [F]; class; first gap."""
    envs = WhoIsThereVector(scenes, **options)
    envs.reset(seed=TRAINED_WITH)
    first, kind = envs.gap.copy(), envs.kind.copy()
    readout, empty = envs.fleet.readout, envs.fleet.empty
    assert readout is not None
    zero = readout.bank.values(empty.capacitance, empty.shield_coupling)
    electrodes = envs.fleet.design.electrodes
    centres = np.array([e.surface.triangles.mean(axis=(0, 1)) for e in electrodes])
    areas = np.array([e.surface.area for e in electrodes])
    field, plates = [], []
    for gap in GRID:
        envs.gap[:] = gap
        told = envs.fleet.solved(envs._poses())
        field.append(readout.bank.values(told.capacitance, told.shield_coupling)[:, 0] - zero)
        far = [b.shape.signed_distance(b.pose.inverse().apply(centres)) for b in envs.bodies()]
        plates.append(EPS0 * areas / np.maximum(far, 1e-3))
    out = {"field": np.stack(field, 1), "plates": np.stack(plates, 1), "kind": kind, "first": first}
    at = int(np.argmin(np.abs(GRID - 0.05)))
    out["field, self"] = out["field"][..., :SELF]
    out["plates"] *= out["field, self"][:, at].mean() / out["plates"][:, at].mean()
    out["fitted"] = np.broadcast_to(out["field"].mean(axis=0), out["field"].shape)
    return out


class Policies(torch.nn.Module):
    """As many networks side by side as there are seeds: 64 and 64 units, tanh."""

    def __init__(self, size: int) -> None:
        super().__init__()
        torch.manual_seed(0)
        shapes = [(size, 64), (64, 64), (64, 1)]
        self.weights = torch.nn.ParameterList(
            torch.randn(SEEDS, a, b) * (1.0 / a) ** 0.5 * (0.1 if b == 1 else 1.0)
            for a, b in shapes
        )
        self.biases = torch.nn.ParameterList(torch.zeros(SEEDS, 1, b) for _, b in shapes)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Actions, (seeds, batch), of observations, (seeds, batch, size)."""
        for w, b in zip(self.weights, self.biases, strict=True):
            x = torch.tanh(torch.baddbmm(b, x, w))
        return x[..., 0]


def observed(felt: Any, moved: Any, last: Any) -> Any:
    """What policies get: compressed changes, distance moved [10 cm], last action."""
    return torch.cat([felt, 10.0 * moved[..., None], last[..., None]], dim=-1)


def squeezed(change: torch.Tensor) -> torch.Tensor:
    """As the environment's normalised observations, of changes [F], with gradients."""
    x = torch.clamp(change / UNIT, -LIMIT, LIMIT)
    return torch.asinh(x / 0.1) / float(np.arcsinh(LIMIT / 0.1))


def of_range(gap: torch.Tensor) -> torch.Tensor:
    """What the range sensor tells, within ±1."""
    return (torch.log(torch.clamp(gap, NEAREST, FURTHEST) / NEAREST) / np.log(30.0))[..., None]


def train(kind: str, known: dict[str, np.ndarray], updates: int, batch: int) -> Policies:
    """Policies of all seeds, which see different draws."""
    readings = None if kind == "range" else torch.tensor(known[kind] / UNIT, dtype=torch.float32)
    size = 1 if readings is None else readings.shape[-1]
    policies, rng = Policies(size + 2), torch.Generator().manual_seed(1)
    optimiser = torch.optim.Adam(policies.parameters(), 3e-3)
    plan = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, updates)
    right = torch.tensor(np.array(list(TARGETS.values()))[known["kind"]], dtype=torch.float32)
    lows, highs = known["first"].min(), known["first"].max()
    grid = torch.tensor(np.log(GRID), dtype=torch.float32)
    for _ in range(updates):
        scene = torch.randint(len(right), (SEEDS, batch), generator=rng)
        gap = lows + (highs - lows) * torch.rand(SEEDS, batch, generator=rng)
        gain = 1 + GAIN * (2 * torch.rand(SEEDS, batch, size, generator=rng) - 1)
        target, begun = right[scene], gap
        last, lost = torch.zeros_like(gap), torch.zeros(())
        for _ in range(STEPS):
            if readings is None:
                felt = of_range(gap + RANGE * torch.randn(gap.shape, generator=rng))
            else:
                place = torch.clamp((torch.log(gap) - grid[0]) / (grid[1] - grid[0]), 0, 22.999)
                low = place.detach().long()
                share = (place - low)[..., None]
                value = (1 - share) * readings[scene, low] + share * readings[scene, low + 1]
                noise = NOISE / UNIT * torch.randn(value.shape, generator=rng)
                felt = squeezed((gain * value + noise) * UNIT)
            last = policies(observed(felt, begun - gap, last))
            gap = torch.clamp(gap - SPEED * STEP * last, NEAREST, FURTHEST)
            lost = lost + torch.clamp((gap - target).abs() / COST, max=2.0).mean(dim=1).sum()
        optimiser.zero_grad()
        lost.backward()
        torch.nn.utils.clip_grad_norm_(policies.parameters(), 10.0)
        optimiser.step()
        plan.step()
    return policies


def judge(kind: str, policies: Policies | None, options: dict[str, Any], count: int) -> Any:
    """Final error [cm], success and return, shape (seeds, episodes) each; and the classes.

    ``policies`` None: no action.
    """
    envs = WhoIsThereVector(SEEDS * count, **options)
    seeds = [JUDGED_WITH + k for k in range(count)] * SEEDS
    envs.reset(seed=seeds)
    rng, shape = torch.Generator().manual_seed(2), (SEEDS, count)
    begun, last, total = envs.gap.copy(), torch.zeros(shape), np.zeros(shape)
    felt = torch.tensor(compressed(np.clip(envs.changes() / UNIT, -LIMIT, LIMIT)))
    facts: dict[str, Any] = {}
    for _ in range(STEPS):
        moved = torch.tensor(begun - envs.gap, dtype=torch.float32).reshape(shape)
        if policies is not None:
            if kind == "range":
                gap = torch.tensor(envs.gap, dtype=torch.float32).reshape(shape)
                sensed = of_range(gap + RANGE * torch.randn(shape, generator=rng))
            else:
                sensed = felt.float().reshape(*shape, -1)
                if kind in ("field, self", "plates"):
                    sensed = sensed[..., :SELF]
            with torch.no_grad():
                last = policies(observed(sensed, moved, last))
        observation, reward, _, _, facts = envs.step(last.numpy().reshape(-1, 1))
        total += reward.reshape(shape)
        channels = len(envs.channel_names)
        felt = torch.tensor(compressed(observation[:, :channels]))
    out = {"error": 100 * facts["error"], "success": 100.0 * facts["success"], "return": total}
    return {k: v.reshape(shape) for k, v in out.items()}, facts["kind"].reshape(shape)


def told(values: np.ndarray, digits: int = 1) -> str:
    """Mean over trainings and its 95 % interval, Student's, of values (seeds,)."""
    half = student.ppf(0.975, len(values) - 1) * values.std(ddof=1) / len(values) ** 0.5
    mean = values.mean()
    return f"{mean:.{digits}f} ± {half:.{digits}f}"


def main() -> None:
    """Train, judge, and write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--updates", type=int, default=250)
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--scenes", type=int, default=600)
    parser.add_argument("--episodes", type=int, default=60, help="of each training")
    parser.add_argument("--kinds", nargs="+", default=[*KINDS, "idle"], help="of readings")
    parser.add_argument("--variants", type=int, default=len(VARIANTS), help="the first so many")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    head = "| task | trained on | return | error of the gap [cm] | within 1 cm [%] | by class [%] |"
    lines, results = [head, "|---|---|---|---|---|---|"], {}
    for variant, how in list(VARIANTS.items())[: options.variants]:
        known = bank(options.scenes, how)
        for kind in options.kinds:
            start, policies = perf_counter(), None
            if kind != "idle":
                policies = train(kind, known, options.updates, options.batch)
            found, classes = judge(kind, policies, how, options.episodes)
            each = [found["success"][classes == k] for k in range(len(TARGETS))]
            by_class = ", ".join(f"{e.mean():.0f}" for e in each if len(e)) if not how else ""
            means = {k: v.mean(axis=1) for k, v in found.items()}
            row = [variant, kind, told(means["return"]), told(means["error"], 2),
                   told(means["success"], 0), by_class]  # fmt: skip
            lines.append(f"| {' | '.join(row)} |")
            results[f"{variant}: {kind}"] = {k: v.tolist() for k, v in means.items()} | {
                "seconds": perf_counter() - start,
                "by_class": by_class,
            }
            print(lines[-1], f"{perf_counter() - start:.0f} s", flush=True)
            facts = {"machine": describe_machine(("capsense", "torch")), "results": results,
                     "options": {k: str(v) for k, v in vars(options).items() if k != "folder"},
                     "classes": list(TARGETS)}  # fmt: skip
            (options.folder / "who_is_there.json").write_text(json.dumps(facts, indent=1))
            (options.folder / "who_is_there.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
