"""Scenario 1: its set-up, its signals, its fit, and its targets in reduced form."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from approximate import approx

import capsense as cs
from capsense.__main__ import main
from capsense.reproduce import scenario1
from capsense.reproduce.scenario1_setup import (
    load_curves,
    load_setup,
    normalised,
)

sys.path.append(str(Path(__file__).parents[3] / "benchmarks"))
from scenario1_fit import changed, fit, fit_without, own_figures, predicted, tabulate

SETUP = load_setup()
STRIPE = SETUP.boards["stripe"]


def test_way_of_the_bar() -> None:
    """The triangle has its sides' length, rests first, and is nearest in the middle of the line."""
    path = SETUP.path("stripe", "T2", SETUP.panel_speed)
    around = 2 * SETUP.half_line + 2 * np.hypot(SETUP.half_line, STRIPE.depth)
    assert path.duration * SETUP.panel_speed == approx(around, rel=1e-12)
    times = np.array([0.0, SETUP.rest, SETUP.rest + path.duration])
    places = [pose.position for pose in SETUP.poses("stripe", "T2", SETUP.panel_speed, times)]
    np.testing.assert_allclose(places[1:], [places[0]] * 2, atol=1e-12)
    slope = np.tan(np.radians(SETUP.tilt))
    cosine = np.cos(np.radians(SETUP.tilt))
    assert places[0][0] == approx(SETUP.offset + SETUP.half_line * cosine, abs=1e-12)
    lower = places[0][2] - SETUP.size[2] / 2
    assert lower == approx(SETUP.gap + SETUP.half_line * cosine * slope, abs=1e-12)


def test_zig_zag() -> None:
    """Eight teeth, evenly spaced in time and centred on the board, nearest at their tips."""
    teeth = SETUP.zigzag
    panel = SETUP.panels["stripe_T4"]
    times = SETUP.times(panel)
    poses = SETUP.poses("stripe", "T4", SETUP.panel_speed, times)
    place = np.array([pose.position for pose in poses])
    inner = np.arange(1, panel.samples - 1)
    z = place[:, 2]
    tips = inner[(z[inner] < z[inner - 1]) & (z[inner] <= z[inner + 1])][: teeth.teeth]
    np.testing.assert_allclose(tips + 1, 74 + 48.07 * np.arange(8), atol=1.5)
    way = 2 * np.hypot(teeth.depth, teeth.pitch / 2)
    period = way / SETUP.panel_speed * SETUP.sample_rate
    assert np.diff(tips) == approx(np.full(7, period), abs=1.01)
    assert place[tips, 0].mean() == approx(0, abs=0.003)
    assert np.diff(place[tips, 0]) == approx(np.full(7, teeth.pitch), abs=0.004)
    near = SETUP.gap + teeth.lift + SETUP.size[2] / 2
    assert z[tips].mean() == approx(near, abs=0.004)  # sampled, and the tilt
    other = SETUP.poses("patch", "T4", SETUP.panel_speed, times)
    nearer = place[:, 2] - np.array([pose.position[2] for pose in other])
    np.testing.assert_allclose(nearer, SETUP.boards["patch"].height, atol=1e-12)


def test_figures_by_name() -> None:
    """What is changed is changed, and nothing else."""
    values = {"gap": 0.02, "stripe_T2.level": 0.9, "patch.depth": 0.1, "zigzag.pitch": 0.02}
    other = changed(SETUP, values)
    assert {key: other.value(key) for key in values} == values
    assert changed(other, {key: SETUP.value(key) for key in values}) == SETUP


def test_uncertainties_are_those_of_figures() -> None:
    assert all(SETUP.value(key) > 0 for key in SETUP.uncertainty)
    with pytest.raises(KeyError):
        SETUP.value("stripe.gap")


def test_pours() -> None:
    """Grounded pours are those of the packaged board; floating ones are another sensor."""
    packaged = cs.load_design("stripe")
    assert STRIPE.sensor(SETUP.pour).content_hash() == packaged.content_hash()
    floating = STRIPE.sensor("floating")
    assert floating.content_hash() != packaged.content_hash()
    assert {part.role for part in floating.conductors} == {"floating"}


def test_panels() -> None:
    """The figures of the paper's own simulation are those that were read off."""
    panel = load_curves(SETUP.panels["stripe_T2"])
    assert panel.measured.shape == panel.simulated.shape == (250,)
    assert panel.measured.min() == approx(0.755, abs=1e-3)
    assert panel.simulated.max() == approx(0.950, abs=1e-3)
    assert load_curves(SETUP.panels["stripe_T4"]).measured.shape == (474,)
    assert [name for name, panel in SETUP.panels.items() if not panel.file] == ["patch_T4"]


def test_front_end_dilutes_by_the_stray_capacitance() -> None:
    """Half the coupling gone shows as half of its share in coupling and stray together."""
    empty = 4e-15
    values = np.array([empty, 0.5 * empty, 0.0])
    reading = normalised(SETUP, STRIPE, values, empty, noise=False)
    share = empty / (empty + SETUP.stray)
    expected = 1 - share * np.array([0.0, 0.5, 1.0])
    np.testing.assert_allclose(reading, expected, atol=3e-4)  # one code is 5 aF of 16 fF
    noisy = normalised(SETUP, STRIPE, np.full(2000, empty), empty, noise=True)
    rms = SETUP.noise / (empty + SETUP.stray)
    assert noisy.std() == approx(rms, rel=0.1)
    again = normalised(SETUP, STRIPE, np.full(2000, empty), empty, noise=True)
    np.testing.assert_array_equal(noisy, again)


@pytest.fixture(scope="module")
def tables() -> dict[str, Any]:
    """Of both boards' pairs, coarser than the stored figures were fitted with."""
    sims = {
        name: cs.Simulator(name, excitation_frequency=SETUP.excitation_frequency)
        for name in ("stripe", "patch")
    }
    return {
        name: tabulate(sim, SETUP, coarser=2.0).table(SETUP.boards[name].pair)
        for name, sim in sims.items()
    }


def test_stored_figures_are_those_of_the_fit(tables: dict[str, Any]) -> None:
    """Fitted again on a coarser table, from another gap: within its own error, every figure."""
    found = fit(SETUP, tables, starts=(1.3,))
    for key, uncertainty in SETUP.uncertainty.items():
        apart = abs(found.setup.value(key) - SETUP.value(key))
        assert apart < 1.5 * uncertainty, key  # by the coarser table
        assert found.setup.uncertainty[key] == approx(uncertainty, rel=0.3)
    drawn = found.drawn(400)
    for key, uncertainty in found.setup.uncertainty.items():
        assert np.std([one.value(key) for one in drawn]) == approx(uncertainty, rel=0.15)
    for name, panel in SETUP.panels.items():
        if panel.file:
            apart = predicted(found.setup, name, tables[panel.board]) - load_curves(panel).measured
            assert np.sqrt(np.mean(apart**2)) < 0.0025


def test_a_panel_held_out(tables: dict[str, Any]) -> None:
    """Only a panel's own figures are fitted to it, and it is followed all the same."""
    own = own_figures(SETUP, tables, "patch_T2")
    assert own == ["patch.depth", "patch.height", "patch_T2.pace"]
    assert own_figures(SETUP, tables, "stripe_T4") == [
        "zigzag.depth", "zigzag.pitch", "zigzag.lift", "zigzag.start"
    ]  # fmt: skip
    found = fit_without(SETUP, tables, "patch_T2")
    measured = load_curves(SETUP.panels["patch_T2"]).measured
    apart = predicted(found, "patch_T2", tables["patch"]) - measured
    assert np.sqrt(np.mean(apart**2)) < 0.004


def test_cases() -> None:
    """Everything in full; the panels' numbers of samples at the panels' speed."""
    full = scenario1.cases_of(SETUP, reduced=False)
    assert len({case.name for case in full}) == len(full) == 3 * 4 * 2
    counts = {case.name: case.panel.samples for case in full}
    assert counts["stripe_T2_0.116"] == counts["patch_T2_0.116"] == 250
    assert counts["stripe_T4_0.116"] == counts["patch_T4_0.116"] == 474
    once = SETUP.rest + SETUP.path("stripe", "T3", 0.0166).duration
    assert counts["stripe_T3_0.0166"] == approx(once * SETUP.sample_rate, abs=2)
    assert [case.name for case in scenario1.cases_of(SETUP, reduced=True)] == [
        "stripe_T2_0.116", "stripe_T4_0.116", "patch_T2_0.116", "patch_T4_0.116"
    ]  # fmt: skip


def test_reduced_run_meets_the_targets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Better than the paper's simulation on all panels; a second run simulates nothing."""
    arguments = ["reproduce", "scenario1", "--reduced", "-o", str(tmp_path)]
    assert main(arguments) == 0
    folder = tmp_path / "scenario1"
    rows = {r["what"]: r for r in json.loads((folder / "rows.json").read_text())["rows"]}
    for name in ("stripe, triangle", "stripe, zig-zag", "patch, triangle"):
        assert rows[f"{name}: zero-mean correlation"]["value"] > 0.99
        assert rows[f"{name}: rms error"]["value"] < 0.0025
    with (folder / "patch_T4_0.116.csv").open() as file:
        readings = np.array([float(row["reading"]) for row in csv.DictReader(file)])
    assert len(readings) == 474
    tips = np.round(73 + 48.07 * np.arange(8)).astype(int)  # from nought
    dips = np.array([readings[tip - 3 : tip + 4].argmin() - 3 for tip in tips])
    assert np.abs(dips).max() <= 1
    lowest = readings[tips + dips]
    assert 0.85 < lowest.min() < 0.93
    assert lowest[[0, -1]].min() > 0.95, "the first and last are weak"
    assert readings.max() <= SETUP.level * 1.001

    def refuse(*_: object) -> None:
        raise AssertionError("nothing was to be simulated")

    monkeypatch.setattr(scenario1, "matrices", refuse)
    before = (folder / "rows.json").read_bytes()
    assert main(arguments) == 0
    assert (folder / "rows.json").read_bytes() == before
