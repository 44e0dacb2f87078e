"""A chip fitted to hardware, as in the tutorial, in fleets on Warp."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fleet_scenes import poses

import capsense as cs
from capsense.readout.calibration import LinearSensor, calibrate
from capsense.readout.randomisation import Distribution, ReadoutRandomisation
from capsense.readout.side_by_side import SideBySide


def fitted(names: tuple[str, ...], folder: Path) -> Path:
    """The readout file of a chip with a gain, an offset and a drift of each channel."""
    rng = np.random.default_rng(1)
    gain, offset = rng.uniform(0.95, 1.05, 6), rng.uniform(1e-13, 3e-13, 6)
    lab = cs.Readout.preset(
        "fdc1004", names, rate=400, stages=[LinearSensor(gain, offset, np.array(2e-17), 0.0)],
        capdac_errors=[0.0],
    )  # fmt: skip
    times = 0.02 * np.arange(500)
    true = 5e-12 + 1e-12 * np.sin(times[:, None] + np.arange(6))
    stamps, measured = lab(times, true).table()
    instants = stamps - lab.schedule.lag
    seen = np.stack([np.interp(t, times, v) for t, v in zip(instants.T, true.T, strict=True)], 1)
    fit = calibrate(seen, measured, instants, floor=0.15e-15)
    np.testing.assert_allclose(fit.gain, gain, rtol=1e-3)
    path = folder / "mine.toml"
    path.write_text(
        'chip = "fdc1004"\nrate = 400.0\ncapdac_errors = [0.0]\n\n' + fit.toml(), encoding="utf-8"
    )
    return path


@pytest.mark.parametrize("count", [6, pytest.param(4096, marks=pytest.mark.e2e)])  # a minute
def test_a_fitted_chip_on_warp(tmp_path: Path, count: int) -> None:
    """Differential: codes on Warp are those of the CPU for the same matrices, to one code in a
    thousand where rounding decides, with noise, randomisation and restarts."""
    pytest.importorskip("warp")
    body = cs.Body(cs.Sphere(0.03), material="steel")
    fleet = cs.Fleet("six_patch", [body], count, device="warp:cpu", budget=32)
    path = fitted(fleet.electrode_names, tmp_path)
    scatter = ReadoutRandomisation(
        gain=Distribution("normal", 1.0, 0.02), delay=Distribution("uniform", 0.0, 0.02), dead=0.01
    )
    fleet.use_readout(path, seed=7, randomisation=scatter)
    chip = cs.load_readout(path, fleet.electrode_names)
    many = SideBySide(chip, count, seed=7, randomisation=scatter)
    rng, clocks = np.random.default_rng(2), np.zeros(count)
    for _ in range(3):
        reading = fleet.step(poses(rng, count, 1), time=clocks)
        matrix = fleet.baseline + reading.delta.numpy().astype(float)
        truth = many.sample(clocks, matrix, reading.shield_coupling.numpy())
        off = np.abs(reading.held.code.numpy() - truth.code)
        assert off.max() <= 1
        assert np.count_nonzero(off) <= 1e-3 * off.size
        clocks += rng.uniform(0.0, 0.06, count)
        again = rng.random(count) < 0.1
        clocks[again] = 0.0
        fleet.reset(again)
        many.reset(again)
    assert len(np.unique(truth.code)) > count
