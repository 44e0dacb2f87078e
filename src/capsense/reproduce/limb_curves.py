"""What one electrode reads while it comes down onto a forearm.

The limb is a capsule that lies across the electrode's middle. Distance is that between the
electrode's plane and the nearest skin. Readings are tared at a stated pose, as capacitive
distance sensors are: :data:`RETREAT`, to the side of the limb and along it.

One electrode is fitted to the slopes of public data above a human arm. The data's electrode, its
mounting and the zero of its distance are not described. So three figures are fitted to four slopes:
the electrode's edge, an offset of its distance, and the tare.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import RectBivariateSpline
from scipy.optimize import least_squares

import capsense as cs
from capsense._style import COLOURS, DASHES, INK, LEGEND, dress
from capsense.design import parse_design
from capsense.field.background import BuildSettings
from capsense.reproduce.harness import Store
from capsense.scene.materials import Grounding

if TYPE_CHECKING:
    from capsense.design.model import Design
    from capsense.simulator import PresetName


Array = NDArray[np.float64]

RANGES = ((0.01, 0.03), (0.03, 0.06), (0.06, 0.10), (0.10, 0.15))
"""Distances [m] between which slopes are taken."""
NEAR = (0.001, 0.002, 0.003, 0.005, 0.007)
"""Distances below the ranges [m]; at zero a bare electrode would touch the skin."""
DRAWN = (0.005, 0.15)
"""Distances that are drawn [m]: gaps for which an accuracy is stated."""
SIZES = (0.03, 0.06, 0.10)
"""Edges of the square electrodes [m]."""
RADII = (0.025, 0.04, 0.055)
"""Radii of the limbs [m]: a wrist, a forearm, a strong upper arm."""
MAIN = RADII[1]
"""The limb's radius [m] where only one is looked at."""
GROUNDINGS: dict[str, Grounding] = {"grounded": "grounded", "100 pF": 1e-10, "floating": "floating"}
BACKINGS = ("free", "ground plane")
"""What is behind the electrode: nothing up to the middle of the box, or a plane 10 mm away."""
PLANE = 0.01
"""Distance of the ground plane behind the electrode [m]."""
LIMB_LENGTH = 0.30
"""Of the limb without its round ends [m]."""
BOX = 1.5
"""Edge of the grounded box around it all [m]."""
BOXES = (0.5, 1.0, 1.5, 2.0)
"""Boxes that are compared [m]."""
PRESET: PresetName = "fine"
"""Slopes ask for more than single readings do: ``"standard"`` has some of them 0.08 off."""
RETREAT = (0.20, 0.20, 0.15)
"""The limb at the tare [m]: along itself, to the side, and its distance above the electrode."""
ACROSS = (0.0, float(np.sqrt(0.5)), 0.0, float(np.sqrt(0.5)))
"""Turns a capsule's axis from z to x."""

FITS = {"board": (0.9966, 6.714), "first holder": (0.7825, 7.513), "second holder": (0.8438, 4.681)}
"""(k, b) of readings k/d − b, d in metres, fitted to a sensor on a PR2 above a person's forearm.

From the source code published with Z. Erickson et al., "Tracking Human Pose During Robot-Assisted
Dressing using Single-Axis Capacitive Proximity Sensing", IEEE RA-L 2018 (arXiv 1709.07957):
``hrl_dressing/src/hrl_dressing/capacitivepr2.py`` of github.com/gt-ros-pkg/hrl-assistive. The scan
there rises from touch to 15 cm at 1 cm/s, tared 20 cm along the arm and 20 cm to its side."""


@dataclass(frozen=True)
class LimbSetup:
    """An electrode and the box around it."""

    size: float = 0.03
    """Edge of the electrode [m]."""
    backing: str = "free"
    box: float = BOX
    """Edge of the box [m]."""
    fine: bool = False
    """Panels as by default, and not coarser."""

    @property
    def design(self) -> Design:
        """One square electrode in the box."""
        back = PLANE if self.backing == "ground plane" else 0.5 * self.box
        return parse_design(
            {
                "name": f"approach_{self.size * 1e3:.0f}mm",
                "domain": {"size": [self.box] * 3, "backplane": back},
                "electrode": [{"name": "E1", "shape": "rectangle", "size": [self.size] * 2}],
            }
        )

    @property
    def settings(self) -> BuildSettings:
        """Large boxes have large walls: coarser panels keep their number down."""
        if self.fine:
            return BuildSettings()
        return BuildSettings(panel_scale=1.7 if self.box <= 1.0 else 2.0)


CHECK = LimbSetup(box=0.5, fine=True)
"""Tells what the coarser panels cost."""


@dataclass(frozen=True, eq=False)
class LimbCurves:
    """What one electrode reads, for each limb radius and grounding."""

    radii: tuple[float, ...]
    """Of the limbs [m]."""
    groundings: tuple[str, ...]
    distance: Array
    """[m], rising, shape (n,)."""
    away: Array
    """Without a limb [F]."""
    value: Array
    """At each distance [F], shape (radii, groundings, n)."""
    retreat: Array
    """At the tare [F], shape (radii, groundings)."""

    def readings(self, radius: float = MAIN, grounding: str = "grounded") -> tuple[Array, float]:
        """Readings at each distance [F], shape (n,), and at the tare [F]."""
        case = self.radii.index(radius), self.groundings.index(grounding)
        return self.value[case], float(self.retreat[case])

    def change(
        self, radius: float = MAIN, grounding: str = "grounded", *, tared: bool = True
    ) -> Array:
        """Readings less the tare, or less the reading without a limb [F], shape (n,)."""
        values, retreat = self.readings(radius, grounding)
        return values - (retreat if tared else self.away)


def distances(per_range: int) -> Array:
    """Distances to be read at [m]; those of a range are even on a log scale."""
    parts = [np.geomspace(low, high, per_range) for low, high in RANGES]
    return np.unique(np.round(np.concatenate([NEAR, *parts]), 9))


def slopes(distance: Array, change: Array) -> list[float]:
    """Log–log slope in each of :data:`RANGES`, by least squares; NaN where nothing is left."""
    out = []
    for low, high in RANGES:
        part = (distance > low - 1e-9) & (distance < high + 1e-9)
        d, c = distance[part], change[part]
        out.append(float(np.polyfit(np.log(d), np.log(c), 1)[0]) if (c > 0).all() else np.nan)
    return out


def zero_distance(distance: Array, change: Array) -> float:
    """k/b of the best fit k/d − b from 1 to 15 cm, even in distance: where it reads zero [m]."""
    even = np.linspace(RANGES[0][0], RANGES[-1][1], 57)
    k, minus_b = np.polyfit(1 / even, np.interp(even, distance, change), 1)
    return float(-k / minus_b)


def read_curves(
    store: Store,
    setup: LimbSetup,
    radii: tuple[float, ...],
    names: tuple[str, ...],
    per_range: int,
    far: tuple[float, ...] = (),
) -> LimbCurves:
    """The curves of one electrode over limbs of these radii [m] and groundings.

    They come from disk if they are there. ``far`` adds distances [m] beyond the ranges.
    """
    design, z = setup.design, np.append(distances(per_range), far)

    def compute() -> dict[str, Array]:
        sim = cs.Simulator(design, settings=setup.settings, preset=PRESET)
        values = np.empty((len(radii), len(names), len(z)))
        retreat = np.empty(values.shape[:2])
        for i, k in np.ndindex(retreat.shape):
            x, y, height = RETREAT
            retreat[i, k] = _read(sim, radii[i], names[k], (x, y, height))
            for n in reversed(range(len(z))):
                values[i, k, n] = _read(sim, radii[i], names[k], (0.0, 0.0, z[n]))
        return {"away": sim.baseline[0, 0], "value": values, "retreat": retreat}

    inputs = {
        "design": design.content_hash(), "preset": PRESET, "settings": repr(setup.settings),
        "radii": list(radii), "groundings": list(names), "distance": z,
        "retreat": list(RETREAT), "length": LIMB_LENGTH,
    }  # fmt: skip
    label = f"{setup.size * 1e3:.0f}mm-{setup.backing.replace(' ', '-')}-{setup.box:g}m"
    label = f"far-{label}" if far else label
    found = store.get(label, inputs, compute)
    return LimbCurves(radii, names, z, found["away"], found["value"], found["retreat"])


def _read(
    sim: cs.Simulator, radius: float, grounding: str, place: tuple[float, float, float]
) -> float:
    x, y, distance = place
    limb = cs.Body(
        cs.Capsule(radius, LIMB_LENGTH), cs.Pose((x, y, distance + radius), ACROSS), "human",
        GROUNDINGS[grounding],
    )  # fmt: skip
    return float(sim.step(cs.Scene([limb])).self_capacitance[0])


def counts(values: Array, tare: float) -> Array:
    """Tared codes of an AD7147 that rests half a second at each reading [F], averaged, (n,)."""
    readout = cs.Readout.preset("ad7147", ["E1"], seed=1)
    held = np.concatenate([[tare], values])
    start = 0.5 * np.arange(len(held))
    times = np.stack([start, start + 0.499], axis=1).ravel()
    found = readout(times, np.repeat(held, 2)[:, None])
    pose, within = np.divmod(found.time, 0.5)
    rests = (within > 0.01) & (within < 0.49)  # no conversion on the way to the next
    pose = pose[rests].astype(int)
    mean = np.bincount(pose, found.code[rests]) / np.bincount(pose)
    return mean[1:] - mean[0]


ARM = (-0.87, -1.31, -1.88, -2.64)
"""Slopes of the public human-arm data over the ranges of
:data:`~capsense.reproduce.limb_curves.RANGES`; their uncertainties are not known."""
WITHIN = 0.15
"""How near each slope is to be."""
EDGES = (0.02, 0.03, 0.06, 0.10, 0.15)
"""Edges of the square electrodes [m] between which the fit interpolates."""
FAR = (0.18, 0.21, 0.25)
"""Distances [m] beyond the ranges, for the offset."""
SPAN = ((EDGES[0], -0.005, -1.0), (EDGES[-1], 0.08, 0.95))
"""Between which edge [m], offset [m] and tare, see :class:`ArmFit`, are sought; readings nearer
than 5 mm, where large electrodes are less sure, are left out."""
STEPS = (13, 30, 27)
"""Of the search over these."""


@dataclass(frozen=True)
class ArmFit:
    """What a fit to the arm found."""

    figures: tuple[float, float, float]
    """The electrode's edge [m], the offset [m] that is added to the data's distances, and the
    tare, as a share of the reading at 15 cm."""
    slopes: tuple[float, ...]
    ranges: tuple[tuple[float, float], ...]
    """Of each figure, where all slopes are near enough with some values of the others; empty if
    nowhere."""

    @property
    def apart(self) -> float:
        """The largest difference of a slope from the data's."""
        return float(np.abs(np.subtract(self.slopes, ARM)).max())


def fit_arm(edges: ArrayLike, distance: Array, change: Array) -> ArmFit:
    """Fit edge, offset and tare by least squares, and look where else all slopes are near enough.

    Args:
        edges: Of the electrodes [m], shape (e,).
        distance: From the electrode to the skin [m], rising, shape (n,).
        change: Readings less those without a limb [F], shape (e, n).
    """
    spline = RectBivariateSpline(np.log(edges), np.log(distance), np.log(change))
    z = distances(6)
    z = z[z > 0.009]

    def apart_at(figures: Array) -> Array:
        """Differences of the slopes from the data's; NaN where all is tared."""
        edge, offset, tare = figures
        at = np.clip(np.append(z, 0.15) + offset, distance[0], distance[-1])
        reading = np.exp(spline.ev(np.log(edge), np.log(at)))
        return np.array(slopes(z, reading[:-1] - tare * reading[-1])) - ARM

    low, high = np.array(SPAN)
    axes = [np.linspace(a, b, n) for a, b, n in zip(low, high, STEPS, strict=True)]
    tried = np.array(list(product(*axes)))
    apart = np.abs([apart_at(figures) for figures in tried])
    near = tried[apart.max(axis=1) < WITHIN]
    start = tried[np.nanargmin((apart**2).sum(axis=1))]
    best = least_squares(apart_at, start, x_scale=(0.02, 0.005, 0.1), bounds=(low, high)).x
    ranges = [(float(c.min()), float(c.max())) for c in near.T] if len(near) else []
    a, b, c = best.tolist()
    return ArmFit((a, b, c), tuple((apart_at(best) + ARM).tolist()), tuple(ranges))


def plot_approach(
    cases: Mapping[LimbSetup, LimbCurves], boxes: Mapping[LimbSetup, LimbCurves]
) -> Figure:
    """Curves against distance: by electrode, as counts and as capacitance; by grounding; by box."""
    figure = Figure(figsize=(9.6, 8.0), layout="constrained")
    axes = figure.subplots(2, 2, sharex=True).ravel()
    for setup, found in cases.items():
        style = {"ls": _line(setup), "color": COLOURS[SIZES.index(setup.size)]}
        label = f"{setup.size * 1e3:.0f} mm, {setup.backing}"
        code, d = counts(*found.readings()), found.distance
        shown = d > DRAWN[0] - 1e-9
        axes[0].plot(1e2 * d[shown], np.where(code > 0, code, np.nan)[shown], label=label, **style)
        axes[1].plot(1e2 * d[shown], 1e15 * found.change()[shown], label=label, **style)
    _groundings(axes[2], next(iter(cases.values())))
    for setup, found in boxes.items():
        shown = found.distance > DRAWN[0] - 1e-9
        axes[3].plot(
            1e2 * found.distance[shown], 1e15 * found.change(tared=False)[shown], ls=_line(setup),
            color=COLOURS[BOXES.index(setup.box)], label=f"{setup.box:g} m, {setup.backing}",
        )  # fmt: skip
    titles = (
        "counts of an AD7147; limb grounded, 40 mm", "electrode; limb grounded, 40 mm",
        "path to ground; 30 mm free", "box; 30 mm, limb away as tare",
    )  # fmt: skip
    for k, (axis, title) in enumerate(zip(axes, titles, strict=True)):
        axis.set(xscale="log", yscale="log", xlim=(1e2 * DRAWN[0], 1e2 * DRAWN[1]))
        upwards = "change of capacitance [fF]" if k else "tared counts"
        dress(axis, "distance [cm]" if k > 1 else "", upwards, title)
        axis.set_xticks([0.5, 1, 3, 6, 15], labels=["0.5", "1", "3", "6", "15"])
        axis.minorticks_off()
        axis.legend(loc="lower left", **LEGEND)
    return figure


def _groundings(axis: Axes, found: LimbCurves) -> None:
    """Limbs tied to ground in several ways; the hardware's fits, laid on the grounded one."""
    shown = found.distance > DRAWN[0] - 1e-9
    z, change = found.distance[shown], found.change()[shown]
    for name, colour in zip(GROUNDINGS, COLOURS, strict=False):
        axis.plot(1e2 * z, 1e15 * found.change(MAIN, name)[shown], color=colour, label=name)
    meet = 0.03  # where the hardware's curves are laid on ours
    scale = float(np.interp(meet, z, change))
    for (name, (k, b)), line in zip(FITS.items(), (":", "--", "-."), strict=True):
        fit = k / z - b
        seen = np.where((fit > 0) & (z > 0.009), fit * scale / (k / meet - b), np.nan)
        axis.plot(1e2 * z, 1e15 * seen, color=INK, lw=1, ls=line, label=f"hardware, {name}")


def _line(setup: LimbSetup) -> Any:
    return DASHES[setup.backing != "free"]
