"""Scenario 1: its set-up, its signals, its fit, and its targets in reduced form."""

from __future__ import annotations

import copy
import csv
import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import capsense as cs
from capsense.cli.main import main
from capsense.errors import ScenarioError
from capsense.reproduce import scenario1
from capsense.reproduce.scenario1_fit import fit, predicted, tabulate
from capsense.reproduce.scenario1_setup import DATA, FILE, load_panel, load_setup, parse_setup
from capsense.reproduce.scenario1_signal import normalised

SETUP = load_setup()
STRIPE = SETUP.boards["stripe"]


def test_way_of_the_bar() -> None:
    """The triangle has its sides' length, rests first, and is nearest in the middle of the line."""
    path = SETUP.path("stripe", "T2", SETUP.panel_speed)
    around = 2 * SETUP.half_line + 2 * np.hypot(SETUP.half_line, STRIPE.depth)
    assert path.duration * SETUP.panel_speed == pytest.approx(around, rel=1e-12)
    times = np.array([0.0, SETUP.rest, SETUP.rest + path.duration])
    places = [pose.position for pose in SETUP.poses("stripe", "T2", SETUP.panel_speed, times)]
    np.testing.assert_allclose(places[1:], [places[0]] * 2, atol=1e-12)
    slope = np.tan(np.radians(SETUP.tilt))
    cosine = np.cos(np.radians(SETUP.tilt))
    assert places[0][0] == pytest.approx(SETUP.offset + SETUP.half_line * cosine, abs=1e-12)
    lower = places[0][2] - SETUP.size[2] / 2
    assert lower == pytest.approx(SETUP.gap + SETUP.half_line * cosine * slope, abs=1e-12)


def test_figures_by_name() -> None:
    """What is changed is changed, and nothing else."""
    other = SETUP.changed({"gap": 0.02, "stripe.level": 0.9})
    assert (other.value("gap"), other.value("stripe.level")) == (0.02, 0.9)
    assert other.changed({k: SETUP.value(k) for k in ("gap", "stripe.level")}) == SETUP


def test_file_is_checked() -> None:
    """Unknown keys and figures are refused by name."""
    data = tomllib.loads((DATA / FILE).read_text(encoding="utf-8"))

    def changed(change: Any) -> dict[str, Any]:
        out = copy.deepcopy(data)
        change(out)
        return out

    cases = {
        "pour = 'shield' is not known": lambda d: d.update(pour="shield"),
        "pair = .*two electrodes": lambda d: d["board"][1].update(pair=["E1"]),
        "unknown key 'spede'": lambda d: d.update(spede=1),
        "missing key 'gap'": lambda d: d["path"].pop("gap"),
        "no figure 'stripe.gap'": lambda d: d["uncertainty"].update({"stripe.gap": 1.0}),
        "sample_rate = 0": lambda d: d["board"][0].update(sample_rate=0),
    }
    for message, change in cases.items():
        with pytest.raises(ScenarioError, match=message):
            parse_setup(changed(change))


def test_pours() -> None:
    """Grounded pours are those of the packaged board; floating ones are another sensor."""
    packaged = cs.load_design("stripe")
    assert STRIPE.sensor(SETUP.pour).content_hash() == packaged.content_hash()
    floating = STRIPE.sensor("floating")
    assert floating.content_hash() != packaged.content_hash()
    assert {part.role for part in floating.conductors} == {"floating"}


def test_panels() -> None:
    """The figures of the paper's own simulation are those that were read off."""
    panel = load_panel("fig9_a_stripe_triangular.csv")
    assert panel.measured.shape == panel.simulated.shape == (250,)
    assert panel.measured.min() == pytest.approx(0.755, abs=1e-3)
    assert panel.simulated.max() == pytest.approx(0.950, abs=1e-3)


def test_front_end_dilutes_by_the_stray_capacitance() -> None:
    """Half the coupling gone shows as half of its share in coupling and stray together."""
    empty = 4e-15
    values = np.array([empty, 0.5 * empty, 0.0])
    reading = normalised(SETUP, STRIPE, values, empty, noise=False)
    share = empty / (empty + SETUP.stray)
    expected = STRIPE.level * (1 - share * np.array([0.0, 0.5, 1.0]))
    np.testing.assert_allclose(reading, expected, atol=3e-4)  # one code is 5 aF of 16 fF
    noisy = normalised(SETUP, STRIPE, np.full(2000, empty), empty, noise=True)
    rms = STRIPE.level * SETUP.noise / (empty + SETUP.stray)
    assert noisy.std() == pytest.approx(rms, rel=0.1)
    again = normalised(SETUP, STRIPE, np.full(2000, empty), empty, noise=True)
    np.testing.assert_array_equal(noisy, again)


def test_stored_figures_are_those_of_the_fit() -> None:
    """Fitted again on a coarser table, from another gap: within its own error, every figure."""
    tables = {}
    for name in ("stripe", "patch"):
        grid = tabulate(cs.Simulator(name, frequency=SETUP.frequency), SETUP, coarser=2.0)
        tables[name] = grid.table(SETUP.boards[name].pair)
    found = fit(SETUP, tables, starts=(1.3,))
    for key, uncertainty in SETUP.uncertainty.items():
        apart = abs(found.setup.value(key) - SETUP.value(key))
        assert apart < 1.5 * uncertainty, key  # by the coarser table
        assert found.setup.uncertainty[key] == pytest.approx(uncertainty, rel=0.3)
    drawn = found.drawn(400)
    for key, uncertainty in found.setup.uncertainty.items():
        assert np.std([one.value(key) for one in drawn]) == pytest.approx(uncertainty, rel=0.15)
    for name, table in tables.items():
        measured = load_panel(SETUP.boards[name].panel).measured
        assert np.abs(predicted(found.setup, name, table) - measured).mean() < 0.005


def test_cases() -> None:
    """Everything in full; the panels' numbers of samples at the panels' speed."""
    full = scenario1.cases_of(SETUP, reduced=False)
    assert len({case.name for case in full}) == len(full) == 3 * 4 * 2
    counts = {case.name: case.samples for case in full}
    assert counts["stripe_T2_0.116"] == counts["patch_T2_0.116"] == 250
    assert counts["meander_T4_0.116"] == 474
    once = SETUP.rest + SETUP.path("stripe", "T3", 0.0166).duration
    assert counts["stripe_T3_0.0166"] == pytest.approx(once * STRIPE.sample_rate, abs=2)


def test_reduced_run_meets_the_targets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Better than the paper's simulation on both panels; a second run simulates nothing."""
    arguments = ["reproduce", "scenario1", "--reduced", "-o", str(tmp_path)]
    assert main(arguments) == 0
    folder = tmp_path / "scenario1"
    rows = {r["what"]: r for r in json.loads((folder / "rows.json").read_text())["rows"]}
    for name, correlation, error in (("stripe", 0.976, 0.017), ("patch", 0.975, 0.016)):
        assert rows[f"{name}, triangle: zero-mean correlation"]["value"] > correlation
        assert rows[f"{name}, triangle: rms error"]["value"] < error
        with (folder / f"{name}_T4_0.116.csv").open() as file:
            readings = [float(row["reading"]) for row in csv.DictReader(file)]
        assert len(readings) == 474
        assert 0.7 < min(readings) < 0.85 < max(readings) <= SETUP.boards[name].level * 1.001

    def refuse(*_: object) -> None:
        raise AssertionError("nothing was to be simulated")

    monkeypatch.setattr(scenario1, "_simulator", refuse)
    before = (folder / "rows.json").read_bytes()
    assert main(arguments) == 0
    assert (folder / "rows.json").read_bytes() == before
