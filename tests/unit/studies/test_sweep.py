"""Sweeps: grids, tables that are kept, and what is refused; results are an analytic function."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from capsense.errors import DesignError, FieldError, ScenarioError
from capsense.studies import Capacitances, StudyRow, derivatives
from capsense.studies.capacitances import (
    codes_at,
    load_design_template,
    load_readout_template,
    load_scenario_template,
)
from capsense.studies.plots import plot_sweep
from capsense.studies.points import fill_table, jobs_within, journal_of
from capsense.studies.slopes import WithDerivatives, differentiate, extrapolate
from capsense.studies.sweeps import grid, parse_steps, parse_vary
from capsense.studies.template import Template, fill, names_in

VARY = {"a": [1.0, 2.0, 3.0], "b": [0.1, 0.3]}
DESIGN = """
name = "pads"
domain = { size = [0.2, 0.2, 0.2], backplane = 0.01 }
electrode = [
  { name = "A", shape = "rectangle", size = ["=side", "=side"], center = ["=side/2 - 0.03", 0.0] },
  { name = "B", shape = "rectangle", size = ["=side", "=side"], center = ["=0.03 - side/2", 0.0] },
]
"""


@dataclass
class Product:
    """a · b and a / b; after ``allowed`` calls the process is interrupted."""

    allowed: float = math.inf
    calls: list[dict[str, float]] = field(default_factory=list)
    outputs: tuple[str, ...] = ("product", "ratio")

    def key(self, point: Mapping[str, float]) -> str:
        if point["a"] == 2.0 and point["b"] == 0.3:
            raise DesignError("electrodes\ntouch")
        return f"{point['a']} {point['b']}"

    def group(self, point: Mapping[str, float]) -> str:
        return str(point["a"])

    def __call__(self, point: Mapping[str, float]) -> tuple[float, float]:
        if len(self.calls) >= self.allowed:
            raise KeyboardInterrupt
        self.calls.append(dict(point))
        if point["a"] == 3.0 and point["b"] == 0.1:
            raise FieldError('too many, "panels"')
        return point["a"] * point["b"], point["a"] / point["b"]


def sweep(vary: Any, path: Path, evaluation: Any, **options: Any) -> list[StudyRow]:
    return fill_table(grid(vary), evaluation, path, **options)


def test_rows_are_exact_and_in_order(tmp_path: Path) -> None:
    """Every combination, the last parameter fastest; what cannot be made says why."""
    counted: list[int] = []
    rows = sweep(VARY, tmp_path / "t.csv", Product(), each=counted.append)
    assert [r.point for r in rows] == [{"a": a, "b": b} for a in VARY["a"] for b in VARY["b"]]
    assert len(counted) == 5
    for k, row in enumerate(rows):
        if k in (3, 4):
            assert all(map(math.isnan, row.results))
            assert row.error == ("electrodes touch" if k == 3 else 'too many, "panels"')
        else:
            a, b = row.point.values()
            assert row.results == (a * b, a / b)
    with (tmp_path / "t.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert list(lines[0]) == ["a", "b", "product", "ratio", "error", "key"]
    for line, row in zip(lines, rows, strict=True):
        assert [float(line[n]) for n in ("a", "b")] == list(row.point.values())
        told = [float(line[n] or "nan") for n in ("product", "ratio")]
        assert list(map(repr, told)) == list(map(repr, row.results))
        assert line["error"] == row.error


@pytest.mark.parametrize("allowed", range(5))
@pytest.mark.parametrize("torn", [b"", b"2.0,0.1,0.2"])
def test_it_goes_on_where_it_stopped(tmp_path: Path, allowed: int, torn: bytes) -> None:
    """After an interruption, even in the middle of a line, the table is the same to the byte."""
    whole, path = tmp_path / "whole.csv", tmp_path / "t.csv"
    sweep(VARY, whole, Product())
    first = Product(allowed)
    with pytest.raises(KeyboardInterrupt):
        sweep(VARY, path, first)
    assert path.read_bytes().count(b"\n") == 1 + allowed
    path.write_bytes(path.read_bytes() + torn)
    second = Product()
    sweep(VARY, path, second)
    assert len(second.calls) == 5 - allowed
    assert not [c for c in second.calls if c in first.calls]
    assert path.read_bytes() == whole.read_bytes()
    third = Product(0)
    sweep(VARY, path, third)
    assert path.read_bytes() == whole.read_bytes()


def test_processes_make_the_same_table(tmp_path: Path) -> None:
    sweep(VARY, tmp_path / "one.csv", Product())
    sweep(VARY, tmp_path / "two.csv", Product(), jobs=2)
    assert (tmp_path / "one.csv").read_bytes() == (tmp_path / "two.csv").read_bytes()


def test_more_values_may_be_added(tmp_path: Path) -> None:
    """Of a larger grid, only what is new is computed; of a smaller one, nothing is lost."""
    path = tmp_path / "t.csv"
    sweep({"a": [1.0], "b": [0.1, 0.3]}, path, Product())
    more = Product()
    sweep(VARY, path, more)
    assert len(more.calls) == 3
    content = path.read_bytes()
    with pytest.raises(ScenarioError, match="3 results of another study"):
        sweep({"a": [1.0], "b": [0.1, 0.3]}, path, Product())
    assert path.read_bytes() == content


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"x,y\n1,2\n", "other columns, x, y"),
        (b"a,b,product,ratio,error,key\n1.0,0.1,zero,0,,1.0 0.1\n", "line 2 is damaged"),
        (b"a,b,product,ratio,error,key\n1.0,0.1\n", "line 2 is damaged"),
        (b"\xff\xfe\n", "cannot be read"),
    ],
)
def test_files_that_are_no_such_table(tmp_path: Path, content: bytes, why: str) -> None:
    path = tmp_path / "t.csv"
    path.write_bytes(content)
    with pytest.raises(ScenarioError, match=why):
        sweep(VARY, path, Product())
    assert path.read_bytes() == content


def test_nothing_can_be_made(tmp_path: Path) -> None:
    with pytest.raises(DesignError, match="touch"):
        sweep({"a": [2.0], "b": [0.3]}, tmp_path / "t.csv", Product())
    for vary in ({}, {"a": []}, {"a": [1.0] * 400, "b": [1.0] * 400}):
        with pytest.raises(ValueError, match="points"):
            grid(vary)
    assert not list(tmp_path.iterdir())


def test_values_from_the_command_line() -> None:
    name, values = parse_vary("side=5mm:15mm:3")
    assert name == "side"
    assert [round(v, 12) for v in values] == [0.005, 0.01, 0.015]
    assert parse_vary("eps=3,-4.5e0, 6") == ("eps", [3.0, -4.5, 6.0])
    assert parse_vary("w=1in") == ("w", [0.0254])
    for wrong in ("side", "side=", "1a=3", "a=1:2", "a=1:2:1", "a=1:2:3:4", "a=1:2:x", "a=1km",
                  "a=nan", "a=1e999", "a=,", "a=mm"):  # fmt: skip
        with pytest.raises(ScenarioError, match="write"):
            parse_vary(wrong)


def test_templates() -> None:
    """Expressions anywhere are worked out, other texts stay; rounding is on demand."""
    template = {"n": "a", "s": ["=a", {"t": "= b/2 + a"}], "k": 3}
    assert names_in(template) == {"a", "b"}
    assert names_in({"x": ["=)", "=1"]}) == set()
    named = {"a": 0.1234567, "b": 2.0}
    assert fill(template, named) == {"n": "a", "s": [0.1234567, {"t": 1.1234567}], "k": 3}
    assert fill(template, named, 3)["s"][0] == 0.123


def test_keys_of_a_design(tmp_path: Path) -> None:
    """Keys differ where designs or scenarios do, and only there; outputs are the upper triangle."""
    file = tmp_path / "pads.toml"
    file.write_text(DESIGN)
    points = [{"side": 0.005}, {"side": 0.05}, {"side": 0.006}]
    found = Capacitances.of(load_design_template(file), points)
    assert found.outputs == ("C0_A_A", "C0_A_B", "C0_B_B")
    assert found.key(points[0]) == found.key({"side": 0.005})
    assert found.key(points[0]) != found.key(points[2])
    with pytest.raises(DesignError):
        found.key(points[1])
    with pytest.raises(
        DesignError, match="no expression uses 'sied', and it is no key; did you mean 'side'"
    ):
        Capacitances.of(load_design_template(file), [{"sied": 0.005}])
    with pytest.raises(DesignError, match="no design file"):
        load_design_template(tmp_path / "none.toml")
