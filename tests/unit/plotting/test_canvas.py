"""All of every figure is on its canvas; legends are complete; quantities have their names."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from whole_figures import cut_off, unnamed, words

import capsense as cs
from capsense.plotting import MAX_LINES
from capsense.plotting.designs import plot_chips
from capsense.readout.recording import CapacitanceRecord
from capsense.reproduce.limb_curves import (
    BOXES,
    DRAWN,
    GROUNDINGS,
    MAIN,
    LimbCurves,
    LimbSetup,
    distances,
    plot_approach,
)
from capsense.reproduce.scenario1 import plot_panels, plot_trajectories
from capsense.reproduce.scenario1_setup import PaperCurves, load_setup

DESIGNS = ("six_patch", "patch", "stripe", "meander", "dual_pad", "arm_segment")


def check(figure: Figure) -> None:
    assert cut_off(figure) < 0.02
    assert not unnamed(figure)
    assert "diagonal" not in words(figure)


@pytest.mark.parametrize("name", DESIGNS)
def test_designs(name: str) -> None:
    check(cs.plot(cs.load_design(name)))


@pytest.mark.parametrize("excitation", ["matrix", "self", "mutual"])
def test_runs(excitation: str, simulators: Callable[..., cs.Simulator]) -> None:
    """Two panels of signals, or one; each of the eight strongest has a name, others together."""
    sim = simulators("six_patch")
    scenes = [
        cs.Scene([cs.Body(cs.Sphere(0.03), cs.Pose((x, 0, 0.06)), "human", name="a long name")])
        for x in (-0.05, 0.0, 0.05)
    ]
    readings = [sim.step(scene) for scene in scenes]
    figure = cs.plot(readings, sim, scenes=scenes, excitation=excitation)
    assert cut_off(figure) < 0.02
    names = [axes.get_legend().get_title().get_text() for axes in figure.axes[:-2]]
    kinds = {"self": ["self capacitance"], "mutual": ["mutual capacitance"]}
    assert names == kinds.get(excitation, ["self capacitance", "mutual capacitance"])
    assert "diagonal" not in words(figure)
    pairs = 15
    if excitation != "self":
        assert f"{pairs - MAX_LINES} others" in words(figure)
        assert len(unnamed(figure)) == pairs - MAX_LINES
    else:
        assert not unnamed(figure)


def test_runs_with_touch(simulators: Callable[..., cs.Simulator]) -> None:
    """Force and compression have a panel each, beside those of the capacitances."""
    sim = simulators("dual_pad")
    assert sim.design.cover is not None
    face = sim.design.cover.upper[2]
    fist = cs.Body(cs.Sphere(0.04), cs.Pose((0, 0, face + 0.04)), "human", name="fist")
    readings = [sim.step(cs.Scene([fist.pressed(force)])) for force in (0.0, 1.0, 2.0)]
    figure = cs.plot(readings, sim)
    check(figure)
    labels = [axes.get_ylabel() for axes in figure.axes[:4]]
    assert [label.partition(" ")[0] for label in labels] == [
        "change", "change", "force", "compression",
    ]  # fmt: skip


def test_panels_of_scenario_1() -> None:
    """Labels of all boards fit their panels; hardware, simulation and ours are named."""
    ours = np.linspace(0.75, 1.0, 200)
    names = ("stripe_T2", "stripe_T4", "patch_T2", "patch_T4")
    paper = PaperCurves(ours, ours)
    panels = {n: (ours, paper if n != "patch_T4" else None) for n in names}
    figure = plot_panels(panels)
    check(figure)
    for axes in figure.axes:
        box = axes.yaxis.label.get_window_extent()
        assert box.height < axes.get_window_extent().height
    assert [a.get_title(loc="left") for a in figure.axes] == [
        "stripe, T2", "stripe, T4", "patch, T2", "patch, T4, predicted",
    ]  # fmt: skip


def test_trajectories_of_scenario_1() -> None:
    setup = load_setup()
    time = np.linspace(0.0, 5.0, 20)
    boards, ways = ("stripe", "patch", "meander"), ("T2", "T4", "T1", "T3")
    check(plot_trajectories(setup, {(b, w): (time, time) for b in boards for w in ways}))


def test_approach_of_a_limb() -> None:
    """Curves begin and end with the gaps that the solver is good for."""
    z = distances(4)
    value = 1e-12 + np.tile(1e-14 / z, (1, len(GROUNDINGS), 1))
    curves = LimbCurves((MAIN,), tuple(GROUNDINGS), z, np.array(1e-12), value, value[..., -1] / 2)
    setups = [LimbSetup(size=0.03), LimbSetup(size=0.06, backing="ground plane")]
    boxes = {LimbSetup(box=box): curves for box in BOXES}
    figure = plot_approach(dict.fromkeys(setups, curves), boxes)
    check(figure)
    for axes in figure.axes:
        ends = np.array([line.get_xdata()[[0, -1]] for line in axes.get_lines()])
        np.testing.assert_allclose(ends, np.tile(1e2 * np.array(DRAWN), (len(ends), 1)))


def test_chips() -> None:
    """Also what is grey and what is a dot has a name."""
    names, time = ("E1", "E2"), np.linspace(0.0, 1.0, 40)
    rise = 1.0 + 0.05 * np.sin(3.0 * time)
    empty = {"C_E1_E1": 2e-12, "C_E1_E2": -1e-13, "C_E2_E1": -1e-13, "C_E2_E2": 2e-12}
    columns = {name: value * rise for name, value in empty.items()}
    record = CapacitanceRecord(Path("readings.csv"), time, names, columns, empty)
    chips = {n: cs.Readout.preset(n, names, seed=1) for n in ("fdc1004", "ad7147", "mpr121")}
    figure = plot_chips(record, chips)
    check(figure)
    assert {"true, in the other panels", "reported by the chip"} <= set(words(figure).split("\n"))
