"""Tolerances: distributions, contributions, yield and ranking against exact values."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from approximate import approx

from capsense.errors import DesignError, ReadoutError, ScenarioError
from capsense.studies.points import StudyRow
from capsense.studies.tolerances import (
    Distribution,
    Specification,
    ToleranceStudy,
    analyse,
    load_study,
    narrowed,
    tolerance,
    tornado,
)

STUDY = """
name = "pads"
samples = 8
[parameters]
side = { distribution = "normal", mean = 0.010, sigma = 0.0001 }
[specifications]
C0_E_E = { min = 1e-13 }
[design]
name = "pad"
domain = { size = [0.2, 0.2, 0.2], backplane = 0.01 }
electrode = [{ name = "E", shape = "rectangle", size = ["=side", "=side"] }]
"""
SCATTER = {
    "a": Distribution("normal", 1.0, 0.1),
    "b": Distribution("uniform", 0.0, 1.0),
    "c": Distribution("triangular", 0.0, 2.0, 0.5),
}


class Line:
    """3 a - b + 0 c, and b alone."""

    outputs = ("line", "b")

    def key(self, point: Mapping[str, float]) -> str:
        return repr(point)

    def group(self, point: Mapping[str, float]) -> str:
        return ""

    def __call__(self, point: Mapping[str, float]) -> tuple[float, float]:
        return 3 * point["a"] - point["b"], point["b"]


def test_distributions() -> None:
    """Means and variances of the samples are those of the distributions."""
    points = ToleranceStudy(SCATTER, {}, 4096).points
    x = np.array([list(p.values()) for p in points])
    assert x.mean(axis=0) == approx([1.0, 0.5, 2.5 / 3], abs=1e-3)
    assert x.var(axis=0) == approx([0.01, 1 / 12, (4 + 0.25 - 1.0) / 18], rel=5e-3)
    assert points == ToleranceStudy(SCATTER, {}, 4096).points
    assert points != ToleranceStudy(SCATTER, {}, 4096, seed=1).points


def test_a_line(tmp_path: Path) -> None:
    """Of a linear function, effects, contributions and ranking are exact; so is the yield."""
    study = ToleranceStudy(
        SCATTER, {"b": Specification(0.25, 0.5), "line": Specification(-9, 9)}, 1024
    )
    found = tolerance(study, Line(), tmp_path / "t.csv")
    line = found.outputs["line"]
    assert list(line.effects) == ["a", "b", "c"]
    assert list(line.effects.values()) == approx([0.3, -(12**-0.5), 0.0], rel=1e-2, abs=1e-6)
    total = 0.09 + 1 / 12
    shares = [0.09 / total, 1 / 12 / total, 0.0]
    assert list(line.contributions.values()) == approx(shares, rel=1e-2, abs=1e-6)
    assert line.explained == approx(1.0, rel=1e-12)
    assert line.deviation**2 == approx(total, rel=2e-2)
    assert next(iter(found.outputs["b"].effects)) == "b"
    assert found.yields["b"].passed == 256  # a net: each dyadic interval has its share
    assert found.yields["all"] == found.yields["b"]
    assert found.yields["line"].share == 1.0
    figure = tornado(found, ["line", "b"])
    assert [t.get_text() for t in figure.axes[0].get_yticklabels()] == ["a", "b", "c"]


def test_narrowed() -> None:
    """Of a linear function, the yields of samples with the tighter tolerance itself."""
    limits = {"line": Specification(2.3, 2.9)}
    study = ToleranceStudy(SCATTER, limits, 512)
    rows = [StudyRow(p, Line()(p)) for p in study.points]
    found = analyse(rows, Line.outputs, limits)
    held = narrowed(found, limits, {"b": 0.25, "c": 0.0})
    tight = {**SCATTER, "b": Distribution("uniform", 0.375, 0.625)}
    rows = [StudyRow(p, Line()(p)) for p in ToleranceStudy(tight, limits, 512).points]
    expected = analyse(rows, Line.outputs, limits).yields
    assert abs(held["all"].passed - expected["all"].passed) <= 3
    assert held["all"].passed > found.yields["all"].passed + 50
    assert narrowed(found, limits, {}) == found.yields
    x = np.array([list(p.values()) for p in study.points])
    deviations = [d.deviation for d in SCATTER.values()]
    assert x.std(axis=0) == approx(deviations, rel=1e-2)


def test_files_beside_a_study(tmp_path: Path) -> None:
    """A design by its name, a scenario and a readout by their paths or as tables, dotted keys of
    them, and limits of counts."""
    body = """[[{}body]]
name = "b"
shape = "sphere"
radius = 0.01
material = "steel"
pose = {{ position = [0, 0, "=height"] }}
"""
    head = "name = 'n'\nsamples = 8\ndesign = 'patch'\n"
    scatter = """[parameters]
height = { distribution = "uniform", from = 0.02, to = 0.03 }
"calibration.gain" = { distribution = "normal", mean = 1.0, sigma = 0.01 }
[specifications]
dcode_E1 = { min = 100 }
"""
    (tmp_path / "b.toml").write_text("name = 'b'\ndesign = 'patch'\n" + body.format(""))
    (tmp_path / "c.toml").write_text('chip = "fdc1004"\n')
    file = tmp_path / "study.toml"
    keys = []
    for content in (
        head + "scenario = 'b.toml'\nreadout = 'c.toml'\n" + scatter,
        head + "readout = 'fdc1004'\n" + scatter + body.format("scenario."),
    ):
        file.write_text(content)
        study, evaluation = load_study(file)
        assert study.specifications == {"dcode_E1": Specification(100.0, np.inf)}
        assert evaluation.outputs[-1] == "dcode_E4"
        keys.append(evaluation.key(study.points[0]))
    assert keys[0] == keys[1]
    for before, after, why in (
        ('"calibration.gain"', "calibration.gain", "put dotted keys in quotes"),
        ("dcode_E1", "dcode_E9", "no output"), ("'patch'", "'patsh'", "patch"),
        ("'fdc1004'", "'fdc1005'", "fdc1004"), ("design = 'patch'\n", "", "missing key 'design'"),
    ):  # fmt: skip
        assert before in content
        file.write_text(content.replace(before, after))
        with pytest.raises((ScenarioError, DesignError, ReadoutError), match=why):
            load_study(file)


def test_wilson() -> None:
    """The interval solves (p - s)² = z² p (1 - p) / n; samples without results fail."""
    rows = [StudyRow({"a": float(k)}, (float(k),), "touch" if k < 2 else "") for k in range(20)]
    found = analyse(rows, ["y"], {"y": Specification(-np.inf, 16.0)})
    one = found.yields["y"]
    assert (one.passed, one.samples, found.without_results) == (15, 20, 2)
    for end in (one.low, one.high):
        assert (end - 0.75) ** 2 == approx(1.959964**2 * end * (1 - end) / 20, rel=1e-5)
    with pytest.raises(ScenarioError, match="2 samples have results"):
        analyse(rows[:4], ["y"], {})


def test_a_parabola_is_no_line() -> None:
    """What a line does not explain is told."""
    rows = [StudyRow({"a": x}, (x * x,)) for x in np.linspace(-1, 1, 21).tolist()]
    assert analyse(rows, ["y"], {}).outputs["y"].explained == approx(0.0, abs=1e-12)
    flat = analyse([StudyRow({"a": x}, (1.0,)) for x in (1.0, 2.0, 3.0)], ["y"], {}).outputs["y"]
    assert (flat.explained, flat.contributions["a"]) == (1.0, 0.0)


def test_files(tmp_path: Path) -> None:
    file = tmp_path / "study.toml"
    file.write_text(STUDY)
    study, evaluation = load_study(file)
    assert study.parameters == {"side": Distribution("normal", 0.01, 0.0001)}
    assert study.specifications == {"C0_E_E": Specification(1e-13, np.inf)}
    assert len(study.points) == 8
    assert evaluation.outputs == ("C0_E_E",)
    for before, after, why in (
        ("samples = 8", "samples = 9", "power of two"),
        ('"normal"', '"gauss"', "gauss"),
        ("sigma = 0.0001", "sigma = 0", "sigma"),
        ("sigma = 0.0001", "sigm = 0.0001", "sigm"),
        ("C0_E_E =", "C0_E_F =", "C0_E_F"),
        ("min = 1e-13", "min = 2e-13, max = 1e-13", "exchange"),
        ("{ min = 1e-13 }", "{}", "neither"),
        ("side = {", "edge = {", "no expression uses 'edge'"),
        ("samples = 8", "sample = 8", "samples"),
    ):
        assert before in STUDY
        file.write_text(STUDY.replace(before, after))
        with pytest.raises((ScenarioError, DesignError), match=why):
            load_study(file)
