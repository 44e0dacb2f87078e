"""Scenario 2: six electrodes in self mode along the limbs of five people.

There are no public measurements along these ways, so simulations are compared with each other:
the paper's scheme, and depth cameras, against the accurate method on the limbs' exact geometry.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import capsense as cs
from capsense._style import COLOURS, DASHES, INK, LEGEND, dress
from capsense.field.background import BuildSettings, MeshSettings
from capsense.readout.calibration import cross_correlation
from capsense.reproduce.harness import (
    Cell,
    Outcome,
    Report,
    ReportTable,
    Row,
    Store,
    correlations,
    judged,
    notes,
    raw_correlation,
)
from capsense.reproduce.limb_worlds import (
    PARTICIPANTS,
    PIXELS,
    RIDES,
    SEED,
    Ride,
    View,
    course,
    opened,
    read_poses,
    rides,
)
from capsense.scene.materials import Grounding
from capsense.simulator import Method

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

DESIGN = "six_patch"
CHIP_RATE = 1 / 3.072e-3
"""Conversions per second of the AD7147 at its quietest."""
REST = 1.0
"""Time before a ride with nothing near, of which the tare is the mean [s]."""
COARSE = 0.43
"""Refinement of the mesh at which the paper's scheme has about 30,000 tetrahedra, for which its
authors give 107 ms a step."""


@dataclass(frozen=True)
class Variant:
    """How all rides are simulated."""

    title: str
    simulator: str = "mujoco"
    view: View = "geometry"
    method: Method = "surface"
    resolution: float = 1.0
    grounding: Grounding = "grounded"
    rides: int = RIDES
    """How many of each participant's rides."""


REFERENCE, DEPTH, PAPER = "reference", "depth", "paper"
LINES: tuple[dict[str, Any], ...] = (
    {"color": COLOURS[0], "lw": 2.4},
    {"color": INK, "ls": DASHES[1], "lw": 1.0},
    {"color": COLOURS[1], "lw": 1.4},
)
"""Of reference, depth camera and the paper's scheme: the first two nearly coincide."""
AGAIN = "again"
"""The reference read by a second chip: what its noise leaves of a correlation."""
RUNS: dict[str, Variant] = {
    REFERENCE: Variant("accurate, geometry, MuJoCo"),
    DEPTH: Variant("accurate, depth camera, MuJoCo", view="depth_camera"),
    PAPER: Variant(
        "the paper's scheme, depth camera, MuJoCo", view="depth_camera", method="fem_masked",
        resolution=COARSE,
    ),
    "fine": Variant(
        "the paper's scheme, mesh seven times as fine", view="depth_camera", method="fem_masked",
        rides=1,
    ),
    "person": Variant("accurate, geometry, person on 100 pF", grounding=1e-10),
    "bullet": Variant("accurate, geometry, PyBullet", simulator="pybullet"),
    "bullet_depth": Variant(
        "accurate, depth camera, PyBullet", simulator="pybullet", view="depth_camera"
    ),
}  # fmt: skip

Changes = dict[str, Array]
"""Change of the six self-capacitances [F] by participant, shape (rides, samples, 6)."""


def run(folder: Path, *, reduced: bool, report: Report) -> Outcome:
    """Carry the study out; see :class:`capsense.reproduce.harness.Study`."""
    store = Store(folder)
    people = list(PARTICIPANTS)[: 2 if reduced else None]
    count = 2 if reduced else RIDES
    names = [n for n in RUNS if not (reduced and n == "fine")]
    ways = {p: rides(p, count) for p in people}
    found: dict[str, Changes] = {}
    for k, name in enumerate(names):
        found[name] = {}
        for i, person in enumerate(people):
            report(RUNS[name].title, (k + i / len(people)) / len(names))
            found[name][person] = _changes(store, RUNS[name], person, ways[person])
    report("done", 1.0)
    codes = {n: {p: tared_codes(found[n][p], ways[p], p, n) for p in people} for n in names}
    codes[AGAIN] = {p: tared_codes(found[REFERENCE][p], ways[p], p, AGAIN) for p in people}
    return Outcome(
        "Scenario 2: six electrodes along human limbs",
        tuple(_rows(found, codes)),
        _tables(found, codes),
        {"scenario2_ride": _ride_plot(codes, ways), "scenario2_scale": _scale_plot(codes)},
        notes("scenario2").format(pixels=PIXELS),
        store.told(),
    )


def _changes(store: Store, how: Variant, person: str, ways: list[Ride]) -> Array:
    """Change of the self-capacitances over a participant's rides [F]."""
    ways = ways[: how.rides]

    def compute() -> dict[str, Array]:
        sim = _simulator(how.method, how.resolution)
        empty = sim.step(cs.Scene([])).self_capacitance
        out: list[Array] = [np.empty(0)] * len(ways)
        for which in ("arm", "leg"):
            place = course(PARTICIPANTS[person], which)
            with opened(how.simulator, place, sim, how.view, how.grounding) as world:
                for k, ride in enumerate(ways):
                    if ride.which == which:
                        out[k] = read_poses(world, ride.poses) - empty
        return {"change": np.array(out)}

    inputs = {
        "design": cs.load_design(DESIGN).content_hash(), "simulator": how.simulator,
        "view": how.view, "method": how.method, "resolution": how.resolution,
        "grounding": how.grounding, "pixels": PIXELS, "person": person, "seed": SEED,
        "offsets": np.array([ride.offsets for ride in ways]),
    }  # fmt: skip
    label = f"{how.method}-{how.simulator}-{how.view}-{person}"
    return store.get(label, inputs, compute)["change"]


@lru_cache(maxsize=4)
def _simulator(method: Method, resolution: float) -> cs.Simulator:
    settings = BuildSettings(mesh=MeshSettings().refined(resolution))
    return cs.Simulator(DESIGN, method=method, settings=settings)


def tared_codes(changes: Array, ways: list[Ride], person: str, run_name: str) -> Array:
    """Tared codes of an AD7147 at the samples' times, shape (rides, samples, 6).

    The chip rests for a second with nothing near, then a moment at the ride's beginning; at each
    sample it has the last finished conversion of each channel. Every ride of every run has noise
    of its own.
    """
    sim = _simulator("surface", 1.0)
    level = sim.baseline.diagonal()
    names = (*RUNS, AGAIN)
    out = np.empty_like(changes)
    for number, (change, ride) in enumerate(zip(changes, ways, strict=False)):
        seed = [SEED, int(person), number, names.index(run_name)]
        chip = cs.Readout.preset(
            "ad7147", sim.electrode_names, rate=CHIP_RATE,
            seed=int(np.random.SeedSequence(seed).generate_state(1)[0]),
        )  # fmt: skip
        times = np.concatenate([[0.0, REST, REST + 0.01], REST + 0.1 + ride.time])
        still = np.zeros((2, change.shape[1]))
        counts = chip(times, level + np.concatenate([still, change[:1], change]))
        for k, name in enumerate(counts.channel_names):
            one = counts.of(name)
            tare = one.code[one.time < REST].mean()
            last = np.searchsorted(one.time, times[3:], "right") - 1
            out[number, :, k] = one.code[last] - tare
    return out


# -- figures -------------------------------------------------------------------------------------


def _scores(signals: Mapping[str, Changes], name: str) -> Array:
    """Eq. 12, zero-mean correlation and scale of a run against the reference.

    Correlations are means over rides; the scale is the regression through zero over all of them.

    Returns:
        Shape (participants, 6, 3).
    """
    out = np.empty((len(signals[name]), 6, 3))
    for i, person in enumerate(signals[name]):
        for k in range(6):
            pairs = [
                (a[:, k], b[:, k])
                for a, b in zip(signals[REFERENCE][person], signals[name][person], strict=False)
            ]
            scale = sum(float(a @ b) for a, b in pairs) / sum(float(a @ a) for a, _ in pairs)
            raw = np.mean([raw_correlation(a, b) for a, b in pairs])
            out[i, k] = raw, np.mean([cross_correlation(a, b) for a, b in pairs]), scale
    return out


def _apart(found: Mapping[str, Changes], name: str) -> float:
    """Rms difference of changes from the reference's, over their own rms; without the chip."""
    other = np.concatenate(list(found[name].values()))
    ours = np.concatenate([found[REFERENCE][p][: len(v)] for p, v in found[name].items()])
    return float(np.sqrt(((other - ours) ** 2).sum() / (ours**2).sum()))


def _rows(found: Mapping[str, Changes], codes: Mapping[str, Changes]) -> list[Row]:
    paper, plain = _scores(codes, PAPER), _scores(found, PAPER)
    ceiling, depth = _scores(codes, AGAIN), _scores(found, DEPTH)
    rows = [
        Row("the paper's scheme against the accurate method: Eq. 12, mean", paper[..., 0].mean()),
        Row("the same: zero-mean correlation, mean", paper[..., 1].mean()),
        Row("the accurate method read twice: zero-mean correlation, mean", ceiling[..., 1].mean()),
        Row("the paper's scheme, without the chip: zero-mean correlation, mean",
            plain[..., 1].mean()),
        Row("the same: lowest electrode", plain[..., 1].min()),
        Row("the same: scale", plain[..., 2].mean(), "times"),
    ]  # fmt: skip
    if "fine" in found:
        fine = _scores(found, "fine")
        rows += [
            Row("the same, mesh seven times as fine: zero-mean correlation", fine[..., 1].mean()),
            Row("the same, mesh seven times as fine: scale", fine[..., 2].mean(), "times"),
        ]
    per_cent = {name: 1e2 * _apart(found, name) for name in found}
    own = "our own"
    return [
        *rows,
        judged("depth camera against geometry, MuJoCo: zero-mean correlation, lowest electrode",
               float(depth[..., 1].min()), above=0.99, source=own),
        judged("depth camera against geometry, MuJoCo: rms difference", per_cent[DEPTH], "%",
               below=3.0, source=own),
        judged("PyBullet against MuJoCo, geometry: rms difference", per_cent["bullet"], "%",
               below=3.0, source=own),
        Row("depth camera of PyBullet against geometry: rms difference",
            per_cent["bullet_depth"], "%"),
        Row("person on 100 pF against grounded: rms difference", per_cent["person"], "%"),
    ]  # fmt: skip


def _tables(found: Mapping[str, Changes], codes: Mapping[str, Changes]) -> dict[str, ReportTable]:
    people, electrodes = list(found[REFERENCE]), tuple(f"E{k + 1}" for k in range(6))
    tables = {}
    for name, what in ((PAPER, "paper_scheme"), (DEPTH, "depth_camera")):
        read, plain = _scores(codes, name), _scores(found, name)
        for label, values in (
            ("eq12", read[..., 0]), ("zero_mean", read[..., 1]),
            ("zero_mean_without_chip", plain[..., 1]), ("scale", plain[..., 2]),
        ):  # fmt: skip
            tables[f"{what}_{label}"] = _grid(people, values, electrodes)
    again = _scores(codes, AGAIN)[..., 1]
    tables["accurate_method_read_twice_zero_mean"] = _grid(people, again, electrodes)
    hardware = np.array([correlations(2)[f"participant_{p}"] for p in PARTICIPANTS])
    tables["hardware_of_the_paper_eq12"] = _grid(list(PARTICIPANTS), hardware, electrodes)
    sizes: list[tuple[Cell, ...]] = []
    for name, build in PARTICIPANTS.items():
        radii = (1e3 * build.radius(n) for n in ("forearm", "wrist", "calf", "ankle"))
        lengths = (1e3 * build.length(n) for n in ("forearm", "shank"))
        numbers = (round(v, 1) for v in (1e2 * build.height, *lengths, *radii))
        sizes.append((name, build.sex, build.percentile, build.girth, *numbers))
    tables["participants"] = ReportTable(
        ("participant", "sex", "percentile", "girth", "stature [cm]", "forearm [mm]",
         "lower leg [mm]", "radius of forearm [mm]", "wrist [mm]", "calf [mm]", "ankle [mm]"),
        tuple(sizes),
    )  # fmt: skip
    return tables


def _grid(people: list[str], values: Array, electrodes: tuple[str, ...]) -> ReportTable:
    """Participants by electrodes, and their mean, as the paper's Table II."""
    lines = [*zip(people, values, strict=True), ("average", values.mean(axis=0))]
    return ReportTable(
        ("participant", *electrodes), tuple((p, *(f"{v:.3f}" for v in line)) for p, line in lines)
    )


def _ride_plot(codes: Mapping[str, Changes], ways: Mapping[str, list[Ride]]) -> Figure:
    """The ride with the median greatest reading, all electrodes."""
    from matplotlib.figure import Figure

    peaks = {(p, k): float(r.max()) for p, v in codes[REFERENCE].items() for k, r in enumerate(v)}
    person, number = sorted(peaks, key=lambda key: peaks[key])[len(peaks) // 2]
    time = ways[person][number].time
    figure = Figure(figsize=(9, 5), layout="constrained")
    for k, axis in enumerate(figure.subplots(2, 3, sharex=True, sharey=True).ravel()):
        for name, style in ((REFERENCE, LINES[0]), (DEPTH, LINES[1]), (PAPER, LINES[2])):
            axis.plot(time, codes[name][person][number][:, k], **style, label=RUNS[name].title)
        dress(axis, "time [s]" if k >= 3 else "", "" if k % 3 else "tared codes", f"E{k + 1}")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, **LEGEND)
    figure.suptitle(f"participant {person}, ride {number + 1}", fontsize=10, color=INK)
    return figure


def _scale_plot(codes: Mapping[str, Changes]) -> Figure:
    """Codes of both schemes against those of the reference, all samples."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.2, 4.6), layout="constrained")
    axis = figure.subplots()
    ours = np.concatenate([v.ravel() for v in codes[REFERENCE].values()])
    for name, colour in ((PAPER, COLOURS[1]), (DEPTH, COLOURS[0])):
        other = np.concatenate([v.ravel() for v in codes[name].values()])
        axis.plot(ours, other, ".", color=colour, ms=1.5, alpha=0.5, label=RUNS[name].title)
    ends = np.array([0.5, max(2.0, float(ours.max()))])
    axis.plot(ends, ends, color=INK, lw=0.8)
    axis.set(xscale="log", yscale="log", xlim=ends, ylim=(0.5, None))
    dress(axis, "tared codes, accurate method on geometry", "tared codes")
    axis.legend(markerscale=6, **LEGEND)
    return figure
