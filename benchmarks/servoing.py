"""Following arms and legs by six electrodes: gradients, networks, and simpler models of the sensor.

``python benchmarks/servoing.py OUT`` trains the networks, carries out the rides of
``servoing_world.py`` and writes ``servoing.json``, ``servoing.md`` and ``servoing.png``. Samples
and rides that are there already are not made again. Every controller is judged on the field,
through a chip with noise, drift, gain error and latency; they differ in the model that they were
made with.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from distance_model import DistanceModel
from machine import on_one_core
from numpy.typing import NDArray
from scipy.stats import bootstrap, norm
from servoing_world import GAPS, Estimator, LimbRide, ride

import capsense as cs
from capsense._style import COLOURS, INK, LEGEND, dress
from capsense.field.background import BuildSettings, MeshSettings
from capsense.learning.envs.base import Randomisation
from capsense.learning.labels import limb_pose
from capsense.learning.scenes import load_spec
from capsense.learning.servo import Belief, LimbPose, PoseEstimator, PoseNetwork

Array = NDArray[np.float64]

SPEC = Path(__file__).with_name("servoing.toml")
COARSE = 0.43
"""Refinement of the mesh of the paper's scheme, some 30,000 tetrahedra as its authors used."""
NOISE, GAIN = 0.5e-15, 0.05
"""Of the samples that networks are trained on: rms after the low-pass filter, with drift [F]; and
the largest error of the gain, which a chip's channels share."""


def belief(gap: float) -> Belief:
    """What least squares start from at a set distance [m]."""
    return Belief(LimbPose(vertical=gap), taper=0.06)


RANGE = np.array([0.08, 0.14, 0.45, 0.5])
"""Samples are left out where lateral, vertical, pitch or yaw is larger."""
GROUPS = {
    "as trained": {"percentile": (25.0, 75.0), "girth": (0.96, 1.04)},
    "smaller": {"percentile": (2.0, 15.0), "girth": (0.85, 0.92)},
    "larger": {"percentile": (85.0, 98.0), "girth": (1.08, 1.2)},
}
"""Sizes of the persons: those of the networks' samples, and others."""
PLOTTED = ("gradients", "network", "distance, scaled, least squares", "paper's scheme, scaled")


class DistanceEstimator(PoseEstimator):
    """The same least squares on the distance model, its slopes by differences."""

    def __init__(self, simulator: cs.Simulator, plates: DistanceModel, **options: Any) -> None:
        self.plates = plates
        super().__init__(simulator, **options)

    def model(self, pose: LimbPose, radius: float | None = None) -> tuple[Array, Array]:
        def values(x: Array) -> Array:
            return self.plates.read(self.scene(LimbPose(*x[:4]), float(np.exp(x[4]))))

        here = np.array([*pose, np.log(radius or self.belief.radius)])
        steps = 1e-4 * np.eye(5)
        return values(here), np.transpose(
            [(values(here + h) - values(here - h)) / 2e-4 for h in steps]
        )


# -- training ------------------------------------------------------------------------------------


def samples(count: int, file: Path) -> dict[str, Array]:
    """Poses of random limbs, (n, 4), and what the three models of the sensor read [F], (n, 6)."""
    if file.is_file():
        with np.load(file) as kept:
            return {k: kept[k] for k in kept.files}
    spec = load_spec(SPEC)
    field = cs.Simulator(spec.design, preset=spec.preset)
    paper, plates = paper_scheme(), DistanceModel(spec.design)
    nothing = paper.step(cs.Scene([])).self_capacitance
    rows: dict[str, list[Any]] = {"pose": [], "field": [], "distance": [], "paper": []}
    for number in range(count):
        scene, _, _ = spec.scene(number)
        limb = [b for b in scene if not any(p in str(b.name) for p in ("_hand_", "_foot_"))]
        try:
            pose = limb_pose(limb)
        except cs.SceneError:
            continue
        if (np.abs(pose) > RANGE).any():
            continue
        grounded = [cs.Body(b.shape, b.pose, b.material, name=b.name) for b in scene]
        rows["pose"].append(pose)
        rows["field"].append(field.step(scene).delta.diagonal())
        rows["distance"].append(plates.read(scene))
        rows["paper"].append(paper.step(cs.Scene(grounded)).self_capacitance - nothing)
    out = {name: np.array(values) for name, values in rows.items()}
    np.savez(file, **out)
    return out


def paper_scheme() -> cs.Simulator:
    """The scheme of Schöffmann et al. 2022, on a mesh of their size."""
    settings = BuildSettings(mesh=MeshSettings().refined(COARSE))
    return cs.Simulator("six_patch", method="fem_masked", settings=settings)


def network(values: Array, poses: Array, seed: int = 0) -> PoseNetwork:
    """A network trained on readings with gain errors and noise."""
    rng = np.random.default_rng(seed)
    gain = 1 + GAIN * rng.uniform(-1, 1, (len(values), 1))
    return PoseNetwork.fit(
        gain * values + NOISE * rng.standard_normal(values.shape), poses, seed=seed
    )


def controllers(made: dict[str, Array]) -> dict[str, Callable[[float], Estimator | None]]:
    """Every controller by name, to be made anew for each ride from its set distance [m].

    The simpler models are also scaled by one factor, to be right 5 cm over a limb of middling
    size, as one measures it in a laboratory.
    """
    sim = cs.Simulator("six_patch", preset="fast")
    options: dict[str, Any] = {"noise": NOISE, "relative": GAIN}
    usual = PoseEstimator(sim).scene(LimbPose(vertical=0.05), Belief().radius)
    right = sim.step(usual).delta.trace()
    grounded = cs.Scene([cs.Body(b.shape, b.pose, b.material) for b in usual])
    paper = paper_scheme()
    nothing = paper.step(cs.Scene([])).self_capacitance
    scales = {
        "distance": right / DistanceModel(sim.design).read(usual).sum(),
        "paper": right / (paper.step(grounded).self_capacitance - nothing).sum(),
    }
    print("factors 5 cm over a limb:", {k: round(float(v), 4) for k, v in scales.items()})
    readings = {"network": ("field", 1.0)}
    for name, title in (("distance", "distance"), ("paper", "paper's scheme")):
        readings[f"network of {title}"] = (name, 1.0)
        readings[f"{title}, scaled"] = (name, scales[name])

    @cache
    def trained(title: str) -> PoseNetwork:
        name, scale = readings[title]
        return network(scale * made[name], made["pose"])

    plates = DistanceModel(sim.design, scales["distance"])
    return {
        "true pose": lambda gap: None,
        "gradients": lambda gap: PoseEstimator(sim, belief(gap), **options),
        **{title: (lambda gap, title=title: trained(title)) for title in readings},
        "distance, scaled, least squares": lambda gap: DistanceEstimator(
            sim, plates, belief=belief(gap), **options
        ),
    }


# -- rides ---------------------------------------------------------------------------------------


def carry_out(
    made: dict[str, Array], count: int, file: Path, only: str | None, **chip: Any
) -> list[dict[str, Any]]:
    """All rides as rows of figures; those that are in the file are not made again."""
    rows = [json.loads(line) for line in file.read_text().splitlines()] if file.is_file() else []
    done = {(r["controller"], r["limb"], r["group"], r["seed"]) for r in rows}
    every = {n: make for n, make in controllers(made).items() if only in (None, n)}
    with file.open("a") as out:
        for seed in range(count):
            gap = GAPS[seed % len(GAPS)]
            for limb, which in enumerate(("arm", "leg")):
                for size, (group, sizes) in enumerate(GROUPS.items()):
                    env, episode = None, 1000 * seed + 10 * size + limb
                    for name, make in every.items():
                        if (name, which, group, seed) in done:
                            continue
                        env = env or LimbRide(which, gap, Randomisation(**sizes, **chip))  # type: ignore[arg-type]
                        found = ride(env, make(gap), episode)
                        row = {"controller": name, "limb": which, "group": group, "seed": seed,
                               "gap": gap, **figures(found)}  # fmt: skip
                        rows.append(row)
                        print(json.dumps(row), file=out, flush=True)
    return [r for r in rows if r["seed"] < count]


def figures(found: Any) -> dict[str, Any]:
    """Rms errors of a ride in cm and degrees, and what else counts."""
    units = np.array([100.0, 100.0, 180 / np.pi, 180 / np.pi])

    def rms(values: list[Array]) -> list[float] | None:
        return (np.sqrt(np.mean(np.square(values), axis=0)) * units).tolist() if values else None

    return {"estimated": rms(found.estimated), "kept": rms(found.kept), "force": found.force,
            "way": found.way, "lost": found.lost, "success": found.success}  # fmt: skip


def mean(values: Iterable[float]) -> tuple[float, float, float]:
    """Mean and its 95 % interval by the bootstrap over rides."""
    data = np.array(list(values))
    if not len(data):
        return (np.nan,) * 3
    if len(data) < 2 or np.ptp(data) == 0.0:
        return float(data.mean()), float(data.mean()), float(data.mean())
    low, high = bootstrap((data,), np.mean, rng=np.random.default_rng(0)).confidence_interval
    return float(data.mean()), float(low), float(high)


def wilson(successes: int, count: int) -> tuple[float, float]:
    """95 % interval of a rate (E. B. Wilson, J. Am. Stat. Assoc. 22, 1927)."""
    z = float(norm.ppf(0.975))
    p, w = successes / count, z * z / count
    half = z * np.sqrt(p * (1 - p) / count + w / (4 * count)) / (1 + w)
    middle = (p + w / 2) / (1 + w)
    return max(0.0, float(middle - half)), min(1.0, float(middle + half))


# -- results -------------------------------------------------------------------------------------

ERRORS = ("lateral [cm]", "vertical [cm]", "pitch [°]", "yaw [°]")


def tables(rows: list[dict[str, Any]]) -> str:
    """Markdown: errors of estimates and of the motion, success and forces, and by size."""
    names = list(dict.fromkeys(r["controller"] for r in rows))
    parts = []
    usual = [r for r in rows if r["gap"] == GAPS[0]]
    for key, title in (("estimated", "estimates at 5 cm"), ("kept", "pose kept at 5 cm")):
        lines = [f"| {title} | {' | '.join(ERRORS)} |", "|---|" + "---|" * 4]
        for name in names:
            mine = [r[key] for r in usual if r["controller"] == name and r[key]]
            cells = [_told(*mean(e[k] for e in mine)) for k in range(4)] if mine else ["–"] * 4
            lines.append(f"| {name} | {' | '.join(cells)} |")
        parts.append("\n".join(lines))
    lines = ["| | success | touched | largest force, mean [N] | way made [cm] |",
             "|---|---|---|---|---|"]  # fmt: skip
    for name in names:
        mine = [r for r in rows if r["controller"] == name]
        low, high = wilson(sum(r["success"] for r in mine), len(mine))
        done = f"{sum(r['success'] for r in mine)} of {len(mine)} ({low:.0%} to {high:.0%})"
        touched = sum(r["force"] > 0 for r in mine)
        force, way = mean(r["force"] for r in mine), mean(100 * r["way"] for r in mine)
        lines.append(f"| {name} | {done} | {touched} | {_told(*force)} | {_told(*way)} |")
    parts.append("\n".join(lines))
    for key, values in (("gap", GAPS), ("limb", ("arm", "leg")), ("group", tuple(GROUPS))):
        heads = [f"{100 * v:.0f} cm" if key == "gap" else v for v in values]  # type: ignore[operator]
        lines = [f"| success; error of place kept [cm] | {' | '.join(heads)} |",
                 "|---|" + "---|" * len(values)]  # fmt: skip
        for name in names:
            cells = []
            for value in values:
                some = [r for r in rows if r["controller"] == name and r[key] == value]
                off = mean(np.hypot(*r["kept"][:2]) for r in some if r["kept"])
                cells.append(f"{sum(r['success'] for r in some)}/{len(some)}; {_told(*off)}")
            lines.append(f"| {name} | {' | '.join(cells)} |")
        parts.append("\n".join(lines))
    return "\n\n".join(parts) + "\n"


def _told(value: float, low: float, high: float) -> str:
    if np.isnan(value):
        return "–"
    digits = 2 if high < 1 else 1
    return f"{value:.{digits}f} ({low:.{digits}f}–{high:.{digits}f})"


def plot(rows: list[dict[str, Any]], file: Path) -> None:
    """Errors of the pose that was kept, every ride a dot, by set distance."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.2), layout="constrained")
    for k, axis in enumerate(figure.subplots(1, 4)):
        for n, name in enumerate(PLOTTED):
            for g, gap in enumerate(sorted(GAPS)):
                some = [r["kept"][k] for r in rows
                        if r["controller"] == name and r["gap"] == gap and r["kept"]]  # fmt: skip
                x = g + 0.2 * (n - 1.5)
                axis.plot([x] * len(some), some, ".", color=COLOURS[n], ms=4, alpha=0.4)
                label = name if g == 0 and k == 0 else None
                if some:
                    axis.plot(x, np.mean(some), "_", color=COLOURS[n], ms=12, mew=2, label=label)
        axis.set_xticks(range(len(GAPS)), [f"{100 * g:.0f} cm" for g in sorted(GAPS)], color=INK)
        axis.set_yscale("log")
        for ticks in (axis.yaxis.set_major_formatter, axis.yaxis.set_minor_formatter):
            ticks(lambda value, _: f"{value:g}" if f"{value:g}".strip("0.")[0] in "125" else "")
        dress(axis, "set distance", title=f"{ERRORS[k]}, rms")
        axis.tick_params(axis="y", which="minor", labelsize=8)
    figure.legend(loc="outside lower center", ncols=4, **LEGEND)
    figure.savefig(file, dpi=130)


def main() -> None:
    """Make what is missing, and write the results."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", type=int, default=8000, help="scenes that samples come of")
    parser.add_argument(
        "--rides",
        type=int,
        default=6,
        help="rides along each limb, each size, by turns at each distance",
    )
    parser.add_argument("--only", help="one controller")
    parser.add_argument("--quiet", action="store_true", help="chips with no white noise or drift")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    made = samples(options.scenes, options.folder / "samples.npz")
    print(f"{len(made['pose'])} samples")
    file = options.folder / ("servoing_quiet" if options.quiet else "servoing")
    chip = {"noise": (0.0, 0.0), "drift": (0.0, 0.0)} if options.quiet else {}
    rows = carry_out(made, options.rides, file.with_suffix(".jsonl"), options.only, **chip)
    text = tables(rows)
    file.with_suffix(".json").write_text(json.dumps(rows, indent=1))
    file.with_suffix(".md").write_text(text)
    plot(rows, file.with_suffix(".png"))
    print(text)


if __name__ == "__main__":
    on_one_core()
    main()
