"""What limits a foretold curve: sources of error, tolerances and ceilings of made recordings."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from capsense.readout.calibration import cross_correlation
from capsense.reproduce.scenario1_setup import DATA, load_curves, load_setup

sys.path.append(str(Path(__file__).parents[3] / "benchmarks"))
from fit_scenario1 import load_recording
from scenario1_explain import (
    Eased,
    ceilings,
    eased,
    expected,
    lasting,
    noise_ceiling,
    sample_noise,
    tolerance,
)

SAMPLES = np.arange(474.0)


def dips(values: Mapping[str, float]) -> np.ndarray:
    """Narrow dips every 48 samples, moved by ``shift``, on a ``level``, scaled by ``gain``."""
    phase = (SAMPLES - values.get("shift", 0.0) + 24) % 48 - 24
    deep = values.get("gain", 1.0) * 0.08 / (1 + (phase / 4) ** 2)
    return np.asarray(values.get("level", 1.0) - deep)


def test_noise_is_told_from_dips() -> None:
    noise = np.random.default_rng(0).normal(scale=1.3e-3, size=len(SAMPLES))
    assert 1.15e-3 < sample_noise(dips({}) + noise) < 1.5e-3
    ceiling = noise_ceiling(dips({}) + noise)
    assert abs(ceiling - cross_correlation(dips({}), dips({}) + noise)) < 1.5e-3


def test_sources_alone_and_removed() -> None:
    """White noise by its formula; a gain costs nothing; what is removed no longer counts."""
    curve, noise = dips({}), 2e-3
    found = expected(
        curve,
        {
            "noise": lambda random: random.normal(scale=noise, size=len(curve)),
            "gain": lambda random: dips({"gain": random.uniform(0.8, 1.2)}) - curve,
            "shift": lambda random: dips({"shift": random.uniform(-0.5, 0.5)}) - curve,
        },
    )
    formula = 1 / np.sqrt(1 + noise**2 / np.var(curve))
    assert abs(found.alone["noise"].median - formula) < 3e-4
    assert found.alone["gain"].low > 1 - 1e-9
    assert found.alone["shift"].low < found.alone["shift"].median < 1 - 1e-4
    assert found.total.median < min(one.median for one in found.alone.values())
    assert found.removed["noise"].median > found.total.median + 1e-3
    assert abs(found.removed["gain"].median - found.total.median) < 1e-3


def test_what_lasts_has_the_strength_beyond_noise() -> None:
    random = np.random.default_rng(1)
    slow = 1.5e-3 * np.sin(SAMPLES / 20)
    white = random.normal(size=len(SAMPLES))
    draw = lasting(slow + 1e-3 * (white - white.mean()) / white.std(), 1e-3)
    strength = [draw(random).std() for _ in range(5)]
    np.testing.assert_allclose(strength, slow.std(), rtol=0.08)
    assert np.abs(lasting(slow, 1.0)(random)).max() == 0.0, "all of it is noise"


def test_tolerances() -> None:
    """The change found lowers the correlation to the least; a gain never does."""
    size = tolerance(lambda change: dips({"shift": 4 * change}), 0.985)
    assert size is not None
    either = [cross_correlation(dips({"shift": s * 4 * size}), dips({})) for s in (1, -1)]
    np.testing.assert_allclose(min(either), 0.985, atol=1e-9)
    assert tolerance(lambda change: dips({"gain": 1 + change}), 0.985, largest=0.5) is None
    one_sided = tolerance(lambda change: dips({"shift": min(0.0, 4 * change)}), 0.985)
    assert one_sided is not None
    np.testing.assert_allclose(one_sided, size, rtol=0.1)


def test_ceilings_name_the_group_that_is_off() -> None:
    """A recording that is late, smaller and lower: time alone mends the correlation."""
    noise = np.random.default_rng(2).normal(scale=1e-3, size=len(SAMPLES))
    measured = dips({"shift": 1.5, "gain": 0.7, "level": 0.995}) + noise
    groups = {
        "time": {"shift": (0.0, 0.3)},
        "size": {"gain": (1.0, 0.05), "level": (1.0, 0.002)},
    }
    found = ceilings(dips, measured, groups)
    assert list(found) == ["as foretold", "time", "size", "all of these"]
    start, time, size, whole = found.values()
    assert start.values == {}
    assert start.correlation < 0.97
    assert abs(time.values["shift"] - 1.5) < 0.1
    assert time.correlation > noise_ceiling(measured) - 2e-3
    assert abs(size.correlation - start.correlation) < 1e-6
    assert size.error < start.error
    assert whole.error < 1.05e-3
    np.testing.assert_allclose(
        [whole.values[key] for key in ("shift", "gain", "level")], [1.5, 0.7, 0.995], atol=0.06
    )


def test_limited_acceleration() -> None:
    """Half the ramp is lost at either end of a leg; short legs never reach full speed."""
    legs, settle = [1.0, 0.05], 0.2
    full = [1.2, 2 * np.sqrt(0.05 * 0.2)]
    times = np.array([-1.0, 0.0, 0.1, 0.2, 0.6, 1.1, 1.2, 1.2 + full[1] / 2, sum(full) + 0.1])
    want = [0.0, 0.0, 0.025, 0.1, 0.5, 0.975, 1.0, 1.025, 0.025]
    np.testing.assert_allclose(eased(times, legs, settle), want, atol=1e-12)
    np.testing.assert_array_equal(eased(times, legs, 0.0), times)


def test_limited_acceleration_of_the_bar() -> None:
    """Without a ramp the same way; with one the bar is at the corners all the same, later."""
    setup = load_setup()
    times = setup.times(setup.panels["patch_T4"])
    way = ("patch", "T4", setup.panel_speed)
    same = Eased(**vars(setup)).poses(*way, times)
    assert [pose.position for pose in same] == [pose.position for pose in setup.poses(*way, times)]
    path = setup.path(*way)
    first = float(np.linalg.norm(np.subtract(*(path.waypoints[k].position for k in (0, 1)))))
    late = setup.rest + first / setup.panel_speed + 0.05
    (corner,) = Eased(**{**vars(setup), "settle": 0.05}).poses(*way, [late])
    np.testing.assert_allclose(corner.position, path.waypoints[1].position, atol=1e-9)


def test_recordings_are_read_like_panels(tmp_path: Path) -> None:
    panel = load_setup().panels["stripe_T4"]
    packaged = tmp_path / "same.csv"
    packaged.write_text((DATA / panel.file).read_text(encoding="utf-8"), encoding="utf-8")
    np.testing.assert_array_equal(
        load_recording(packaged, panel.samples), load_curves(panel).measured
    )


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (None, "cannot be read"),
        ("sample,value\n1,2\n", "no column 'norm_capacitance'"),
        ("sample,norm_capacitance\n1,x\n", "no numbers"),
        ("sample,norm_capacitance\n", "does not measure samples 1 to 3"),
        ("sample,norm_capacitance\n1,1\n2,1\n", "does not measure samples 1 to 3"),
        ("sample,norm_capacitance\n1,1\n2,nan\n3,1\n", "not finite"),
        ("sample,norm_capacitance\n1,1\n3,1\n2,1\n3,1\n", "in order"),
    ],
)
def test_bad_recordings(tmp_path: Path, text: str | None, told: str) -> None:
    path = tmp_path / "recording.csv"
    if text is not None:
        path.write_text(text, encoding="utf-8")
    with pytest.raises(SystemExit, match=told):
        load_recording(path, 3)
