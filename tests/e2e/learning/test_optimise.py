"""``capsense optimise``: tasks, expressions, the search and what it writes."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
import tiny_field
from approximate import approx

import capsense as cs
from capsense.__main__ import BAD_INPUT, OK, main
from capsense.errors import DesignError, ScenarioError
from capsense.learning import optimise
from capsense.learning.optimise import (
    Bound,
    Constraints,
    DesignTask,
    at_bounds,
    load_task,
    search,
    to_toml,
)
from capsense.learning.servo import LimbPose
from capsense.studies.template import evaluate

EXAMPLE = Path(__file__).parents[3] / "examples" / "designs" / "forearm_pads.toml"
TASK = """
name = "two pads"
noise = 1e-16
evaluations = 3
[limb]
radius = 0.012
[poses]
vertical = [0.02, 0.03]
[one]
lateral = 1.0
pitch = 180
yaw = 180
[parameters]
side = { from = 0.003, to = 0.022, start = 0.005 }
[design]
name = "pads"
domain = { size = [0.2, 0.2, 0.2], backplane = 0.01 }
electrode = [
  { name = "A", shape = "rectangle", size = ["=side", "=side"], center = ["=-0.03 + side/2", 0.0] },
  { name = "B", shape = "rectangle", size = ["=side", "=side"], center = ["=0.03-side/2", 0.0] },
]
"""


@pytest.fixture
def task_file(tmp_path: Path) -> Path:
    file = tmp_path / "task.toml"
    file.write_text(TASK)
    return file


@pytest.fixture
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fields that are built in a fraction of a second."""

    class Coarse(optimise.BuildSettings):
        def refined(self, factor: float) -> Any:
            return tiny_field.SETTINGS

    monkeypatch.setattr(optimise, "BuildSettings", Coarse)


def test_expressions() -> None:
    named = {"a": 0.03, "b": 2.0}
    assert evaluate(" -(a + 1) * b / 4 - 0.5", named) == approx(-1.015)
    for wrong, why in (
        ("a ** 2", "more than"), ("__import__('os')", "more than"), ("a +", "worked out"),
        ("1/(b-2)", "worked out"), ("c", "no parameter"), ("1e999", "finite"),
        ("True", "more than"), ("(" * 500 + "a" + ")" * 500, "worked out"),
        ("-" * 5000 + "a", "worked out"),
    ):  # fmt: skip
        with pytest.raises(DesignError, match=why):
            evaluate(wrong, named)


def test_example_starts_from_the_packaged_design() -> None:
    """Its start has the geometry of ``six_patch_bare``; what it writes is read back the same."""
    import tomllib

    task = load_task(EXAMPLE)
    design = task.design(task.start)
    assert design.content_hash() == cs.load_design("six_patch_bare").content_hash()
    assert len(task.poses) == 8
    assert task.poses[-1] == approx((0.02, 0.05, math.radians(10), math.radians(10)))
    content = task.content(task.start)
    assert tomllib.loads(to_toml(content)) == content
    nested = {"a": 1, "t": True, "s": 'x"ü', "b": {"c": [1.5, [2, {"d": 1e-9}]], "e": {"f": "g"}},
              "l": [{"n": 1, "m": {"o": 2}}, {"n": 2, "p": [{"q": 3}]}]}  # fmt: skip
    assert tomllib.loads(to_toml(nested)) == nested


def test_the_page_s_task(tmp_path: Path) -> None:
    page = (EXAMPLE.parents[2] / "docs" / "optimise.md").read_text(encoding="utf-8")
    (tmp_path / "task.toml").write_text(page.split("```toml\n")[1].split("```")[0])
    task = load_task(tmp_path / "task.toml")
    assert len(task.poses) == 4
    assert task.start == approx([0.02])


def quadratic(best: np.ndarray, calls: list[np.ndarray]) -> Any:
    def bound(self: DesignTask, values: np.ndarray, *_: Any) -> Bound:
        calls.append(values)
        if values[0] > 0.035:
            raise DesignError("pads touch")
        return Bound(float(np.sum(((values - best) / 0.01) ** 2)), LimbPose())

    return bound


def test_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """It finds a minimum that is known, within its allowance, past what cannot be made."""
    task = dataclasses.replace(load_task(EXAMPLE), evaluations=120)
    best, calls = np.array([0.021, 0.035, 0.05, 0.03]), []
    monkeypatch.setattr(DesignTask, "bound", quadratic(best, calls))
    told: list[float] = []
    values, bound = search(task, lambda v, b: told.append(b.cost))
    assert values == approx(best, abs=5e-4)
    assert len(told) == len(calls) <= 121
    np.testing.assert_array_equal(calls[0], task.start)
    assert bound.cost == min(told)
    assert math.inf in told
    again, _ = search(task)
    np.testing.assert_array_equal(values, again)
    spans = np.array([p[:2] for p in task.parameters.values()])
    assert (np.array(calls) >= spans[:, 0] - 1e-9).all()
    assert (np.array(calls) <= spans[:, 1] + 1e-9).all()
    few = dataclasses.replace(task, evaluations=1)
    np.testing.assert_array_equal(search(few)[0], task.start)


@pytest.mark.parametrize("limit", ["area = { all = { max = 5.0e-5 } }", "outline = [0.062, 0.005]"])
def test_constraints(task_file: Path, monkeypatch: pytest.MonkeyPatch, limit: str) -> None:
    """The best of a cost that falls with the side lies on the limit: 5 mm; nothing beyond it is
    built, or counts."""
    start = TASK.replace("start = 0.005", "start = 0.0035").replace(
        "evaluations = 3", "evaluations = 30"
    )
    task_file.write_text(f"{start}\n[constraints]\n{limit}\n")
    task = load_task(task_file)
    built: list[float] = []

    def bound(self: DesignTask, values: np.ndarray, *_: Any) -> Bound:
        built.append(float(values[0]))
        return Bound(1.0 - float(values[0]), LimbPose())

    monkeypatch.setattr(DesignTask, "bound", bound)
    values, _ = search(task)
    assert max(built) <= 0.005 + 1e-6
    assert values[0] == approx(0.005, abs=3e-5)
    assert 10 < len(built) <= 30
    np.testing.assert_array_equal(search(task)[0], values)


def test_constraints_of_shapes(task_file: Path) -> None:
    """Areas of one electrode and of all; outlines as points, with a clearance and a notch."""
    design = load_task(task_file).design(np.array([0.005]))
    area, both = 25e-6, 50e-6
    box = shapely.box(-0.03, -0.0025, 0.03, 0.0025)
    notch = box.difference(shapely.box(0.0271, -1.0, 0.0279, 0.0))
    for areas, outline, why in (
        ({"A": (area, area), "all": (both, both)}, box, ""),
        ({"B": (1.01 * area, 1.0)}, None, "area of B is 2.5e-05 m², below its limit of 2.525e-05"),
        ({"all": (0.0, 0.9 * both)}, None, "area of all is 5e-05 m², above"),
        ({}, box.buffer(-0.001, join_style="mitre"), "'A' has 13 mm² outside"),
        ({}, notch, "'B' has 2 mm² outside"),
    ):
        found = Constraints(areas, outline).violation(design)
        assert why in found
        assert bool(why) == bool(found)


def test_start_that_cannot_be_made(monkeypatch: pytest.MonkeyPatch) -> None:
    task = load_task(EXAMPLE)
    monkeypatch.setattr(DesignTask, "bound", quadratic(np.full(4, 0.04) - 0.02, []))
    parameters = {k: p._replace(start=p.high) for k, p in task.parameters.items()}
    with pytest.raises(DesignError, match="touch"):
        search(dataclasses.replace(task, parameters=parameters))


@pytest.mark.usefixtures("coarse")
def test_command(task_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A whole search on a small sensor: larger pads are found, and written as a design."""
    output = task_file.with_name("found.toml")
    assert main(["optimise", str(task_file), "-o", str(output)]) == OK
    text, told = capsys.readouterr()
    assert told.count("cost") == 3
    rows = {line.split()[0]: line.split() for line in text.splitlines() if line}
    assert float(rows["found"][-1]) < float(rows["start"][-1])
    assert float(rows["found"][1]) > 5.0
    design = cs.load_design(output)
    size = float(rows["found"][1]) * 1e-3
    assert design.electrodes[0].surface.area == approx(size**2, rel=2e-3)
    assert main(["optimize", str(task_file), "-o", "found.txt"]) == BAD_INPUT
    assert main(["optimise", str(task_file), "-o", str(output), "--evaluations", "0"]) == BAD_INPUT


def test_what_lies_at_its_bounds() -> None:
    """Within a hundredth of the range; the middle does not."""
    task = load_task(EXAMPLE)
    spans = np.array([p[:2] for p in task.parameters.values()])
    low, width = spans[:, 0], np.diff(spans)[:, 0]
    names = list(task.parameters)
    assert at_bounds(task, low + 0.5 * width) == {}
    assert at_bounds(task, low + width * [0.995, 0.5, 0.005, 0.02]) == {
        names[0]: ("upper", spans[0, 1]), names[2]: ("lower", spans[2, 0])
    }  # fmt: skip


@pytest.mark.usefixtures("coarse")
def test_bounds_of_a_task(task_file: Path) -> None:
    """Less noise, finer bounds; the cost is the rms in the units of ``[one]``."""
    task = load_task(task_file)
    task = dataclasses.replace(task, poses=(LimbPose(0.0, 0.02),))
    loud, quiet = (dataclasses.replace(task, noise=n).bound(task.start) for n in (1e-16, 1e-17))
    assert (np.array(quiet.pose) < loud.pose).all()
    assert loud.cost == approx(math.sqrt(np.mean(np.square(np.divide(loud.pose, task.one)))))


@pytest.mark.parametrize(
    ("before", "after", "why"),
    [
        ("noise = 1e-16", "noise = 0", "noise"),
        ("evaluations", "evalutions", "evaluations"),
        ("vertical = [0.02, 0.03]", "verticle = 0.02", "vertical"),
        ("to = 0.022", "to = 0.004", "range|from"),
        ("start = 0.005", "start = 0.08", "start"),
        ("[parameters]\nside", "[other]\nside", "other"),
        ('"=side/2', '"=sied/2', "sied"),
        ("0.03-side/2", "-0.03+side/2", "touch|overlap|short"),
        (
            "[design]",
            "[constraints]\narea = { all = { max = 49e-6 } }\n[design]",
            "start breaks a constraint: area of all is 5e-05",
        ),
        ("[design]", "[constraints]\noutline = [0.05, 0.01]\n[design]", "'A' has 25 mm² outside"),
        ("[design]", "[constraints]\nclearance = 0.01\n[design]", "add outline"),
        ("[design]", "[constraints]\nclearance = 0.01\noutline = [0.1, 0.02]\n[design]", "nothing"),
        ("[design]", "[constraints]\narea = { C = { max = 1 } }\n[design]", "no electrode"),
        ("[design]", "[constraints]\narea = { A = { min = 2, max = 1 } }\n[design]", "max"),
        (
            "[design]",
            "[constraints]\noutline = [[0, 0], [1, 1], [1, 0], [0, 1]]\n[design]",
            "crosses itself",
        ),
    ],
)
def test_wrong_tasks(task_file: Path, before: str, after: str, why: str) -> None:
    text = TASK.replace("=-0.03 + side/2", "=side/2 - 0.03").replace(before, after)
    assert text != TASK
    task_file.write_text(text)
    with pytest.raises((ScenarioError, DesignError), match=why):
        load_task(task_file)
