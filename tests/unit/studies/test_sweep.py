"""Sweeps: grids, tables that are kept, and what is refused; results are an analytic function."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from approximate import approx

import capsense as cs
from capsense.errors import DesignError, FieldError, ReadoutError, ScenarioError
from capsense.reading import StepStats
from capsense.studies import Capacitances, StudyRow
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


class Deadly(Product):
    """Ends its process where b is large."""

    def __call__(self, point: Mapping[str, float]) -> tuple[float, float]:
        if point["b"] > 0.2:
            os._exit(1)
        return super().__call__(point)


def test_a_process_that_dies(tmp_path: Path) -> None:
    """It is reported, and what was found before is kept."""
    path = tmp_path / "t.csv"
    with pytest.raises(ChildProcessError, match="fewer --jobs"):
        sweep(VARY, path, Deadly(), jobs=2)
    whole = Product()
    sweep(VARY, path, whole)
    assert {"a": 1.0, "b": 0.3} in whole.calls


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


FINGER = """
name = "finger"
design = "patch"
sample_rate = 1
[[body]]
name = "finger"
shape = "sphere"
radius = "=thick / 2"
material = "steel"
pose = { position = [0.0, 0.0, 0.03] }
"""


def files(folder: Path) -> tuple[Template, Template]:
    (folder / "pads.toml").write_text(DESIGN)
    (folder / "finger.toml").write_text(FINGER)
    design = load_design_template(folder / "pads.toml")
    return design, load_scenario_template(folder / "finger.toml")


def test_dotted_keys(tmp_path: Path) -> None:
    """A key changes its one entry, of lists by number or axis, of tables by name, and whole numbers
    and switches become such; tables on the way are made."""
    content = {"electrode": [{"name": "A", "size": [1.0, 2.0]}, {"name": "B"}], "n": 3, "e": "=a"}
    keys = ("electrode.A.size.y", "electrode.1.z", "n", "build.resolution", "open")
    point = {"electrode.A.size.y": 0.5, "electrode.1.z": "=b", "n": 4.0, "build.resolution": 0.25,
             "open": "true", "a": 7.5}  # fmt: skip
    found = Template("f", content, tmp_path, keys=keys).filled(point)
    assert found == {
        "electrode": [{"name": "A", "size": [1.0, 0.5]}, {"name": "B", "z": "=b"}], "n": 4,
        "e": 7.5, "build": {"resolution": 0.25}, "open": True,
    }  # fmt: skip
    assert type(found["n"]) is int
    assert content["electrode"] == [{"name": "A", "size": [1.0, 2.0]}, {"name": "B"}]
    for key, why in (
        ("electrode.C.size.x", "no entry 'C'; .* A, B"), ("electrode.A.size.z", "no entry 'z'"),
        ("electrode.A.size", "as in electrode.A.size.0"), ("n.x", "end the key before it"),
        ("electrode", "name one of its entries"),
    ):  # fmt: skip
        with pytest.raises(ScenarioError, match=why):
            Template("f", content, tmp_path, ScenarioError, (key,)).filled({key: 1.0, "a": 1.0})


def test_parameters_of_all_files(tmp_path: Path) -> None:
    """Names in any file's expressions, and keys of any; a field is shared by what does not change
    it, and results are by what changes any of them."""
    design, finger = files(tmp_path)
    point = {"side": 0.005, "thick": 0.02, "body.finger.grounding": "floating", "wiring.trace": 0.0}
    other = {**point, "thick": 0.01, "body.finger.grounding": 1e-10}
    chip = {**point, "wiring.trace": 1e-12}
    found = Capacitances.of(design, [point, other, chip], finger, "fdc1004")
    assert found.outputs[-4:] == ("code0_A", "code0_B", "dcode_A", "dcode_B")
    assert found.outputs[:6] == ("C0_A_A", "C0_A_B", "C0_B_B", "dC_A_A", "dC_A_B", "dC_B_B")
    assert len({found.key(p) for p in (point, other, chip)}) == 3
    assert len({found.group(p) for p in (point, other, chip)}) == 1
    assert found.group({**point, "side": 0.006}) != found.group(point)
    (body,) = found._scene(other).bodies
    assert (body.shape.radius, body.grounding) == (0.005, 1e-10)
    assert Capacitances.of(load_design_template("patch"), [{"thick": 0.02}], finger).group(
        {"thick": 0.02}
    ) == ""  # fmt: skip


@pytest.mark.parametrize(
    ("extra", "scenario", "readout", "error", "why"),
    [
        ({"body.finger.pose.position.z": 0.1}, False, None, DesignError, "give --scenario"),
        ({"wiring.trace": 0.1}, True, None, DesignError, "give --readout"),
        ({"noise.white": 0.1}, True, "fdc1004", ReadoutError, "leave noise out"),
        ({"wirng.trace": 0.1}, True, "fdc1004", DesignError, "it is no key"),
        ({"wiring.trac": 0.1}, True, "fdc1004", ReadoutError, "did you mean 'trace'"),
        ({"body.finger.radius": -1.0}, True, None, ScenarioError, "positive"),
        ({"body.finger.material": "steal"}, True, None, ScenarioError, "did you mean 'steel'"),
        ({"side": "steel"}, True, None, DesignError, "side is 'steel'; give numbers"),
        ({}, True, "fdc1005", ReadoutError, "fdc1004"),
    ],
)
def test_parameters_that_are_wrong(
    tmp_path: Path, extra: dict[str, Any], scenario: bool, readout: str, error: Any, why: str
) -> None:
    design, finger = files(tmp_path)
    point = {"side": 0.005, **({"thick": 0.02} if scenario else {}), **extra}
    with pytest.raises(error, match=why):
        Capacitances.of(design, [point], finger if scenario else None, readout)


def test_texts_and_steps_from_the_command_line() -> None:
    assert parse_vary("body.a.material=steel, human") == ("body.a.material", ["steel", "human"])
    assert parse_vary("wiring.trace=1pF:3pF:2")[1] == approx([1e-12, 3e-12])
    assert parse_steps(["side", "gap=0.5mm"]) == {"side": None, "gap": 0.0005}
    for wrong in (["a", "a=1"], ["a="], ["a=x"]):
        with pytest.raises(ScenarioError, match=r"twice|is no number"):
            parse_steps(wrong)


def test_parquet(tmp_path: Path) -> None:
    """The same numbers as in CSV; an interrupted table goes on, also with texts among its values,
    and its journal is gone in the end."""
    parquet = pytest.importorskip("pyarrow.parquet", reason='needs pip install "capsense[record]"')
    vary = {"a": [1.0, 2.0, 3.0], "b": [0.1, 0.3], "m": ["steel", "glass"]}

    class Both(Product):
        def key(self, point: Mapping[str, Any]) -> str:
            return f"{super().key(point)} {point['m']}"

    path = tmp_path / "t.parquet"
    with pytest.raises(KeyboardInterrupt):
        sweep(vary, path, Both(3))
    assert [p.name for p in tmp_path.iterdir()] == ["t.parquet.csv"] == [journal_of(path).name]
    rest = Both()
    rows = sweep(vary, path, rest)
    assert len(rest.calls) == 7
    assert [p.name for p in tmp_path.iterdir()] == ["t.parquet"]
    table = parquet.read_table(path).to_pylist()
    assert [r["m"] for r in table] == ["steel", "glass"] * 6
    for line, row in zip(table, rows, strict=True):
        numbers = [math.nan if line[n] is None else line[n] for n in ("product", "ratio")]
        assert list(map(repr, numbers)) == list(map(repr, row.results))
        assert (line["error"], line["a"]) == (row.error, row.point["a"])
    more = Both()
    sweep({**vary, "a": [1.0, 2.0, 3.0, 4.0]}, path, more)
    assert len(more.calls) == 4
    path.write_bytes(b"PAR1")
    with pytest.raises(ScenarioError, match="cannot be read"):
        sweep(vary, path, Both())


def test_extrapolation() -> None:
    """Of a polynomial of fifth degree the derivative is exact; errors are estimated without noise
    from above, and with noise two times in three."""
    assert extrapolate([np.array([3.0 + 5 * h**2 + h**4]) for h in (0.4, 0.2, 0.1)])[0] == approx(
        [3.0], rel=1e-12
    )
    random = np.random.default_rng(1)
    for noise in (0.0, 1e-6, 1e-4):
        at = np.linspace(0.5, 3.0, 400)
        ladder = [
            (np.exp(at + h) - np.exp(at - h) + noise * random.normal(size=400)) / (2 * h)
            for h in 0.05 * at / np.array([[1.0], [2.0], [4.0]])
        ]
        value, error = extrapolate(ladder)
        true = np.abs(value - np.exp(at))
        assert np.mean(true <= error + 1e-12) > (0.55 if noise else 0.999)
        assert np.mean(true <= 2 * error + 1e-12) > 0.85
        assert np.median(true / np.exp(at)) < 1e-8 + 20 * noise


def test_derivatives_beside_results(tmp_path: Path) -> None:
    """Columns for each output and parameter; a step that cannot be made says which."""

    @dataclass
    class Smooth(Product):
        outputs: tuple[str, ...] = ("C0_E_E", "code0_E")

    point = {"a": 1.0, "b": 0.2}
    found = differentiate(Smooth(), point, {"a": None, "b": 0.01})
    assert (found.outputs, found.parameters) == (("C0_E_E",), ("a", "b"))
    assert found.values == approx(np.array([[0.2, 1.0]]), rel=1e-12)
    slow = WithDerivatives.of(Smooth(), {"b": None}, [point])
    assert slow.outputs[2:] == ("d(C0_E_E)/d(b)", "error of d(C0_E_E)/d(b)")
    (row,) = sweep({"a": [1.0], "b": [0.2]}, tmp_path / "t.csv", slow)
    assert row.results == approx((0.2, 5.0, 1.0, 0.0), abs=1e-12)
    assert slow.key(point) != WithDerivatives.of(Smooth(), {"b": 0.1}, [point]).key(point)

    class Walled(Smooth):
        def __call__(self, point: Mapping[str, float]) -> tuple[float, float]:
            if point["a"] > 1.04:
                raise DesignError("electrodes touch")
            return super().__call__(point)

    with pytest.raises(DesignError, match=r"at a = 1.05: electrodes touch; give a smaller step"):
        differentiate(Walled(), point, {"a": None})
    for steps, points, why in (
        ({"c": None}, [point], "not varied"), ({"a": None}, [{"a": 0.0}], "give a=STEP"),
        ({"a": -1.0}, [point], "above 0"), ({"m": None}, [{"m": "steel"}], "texts"),
    ):  # fmt: skip
        with pytest.raises(ScenarioError, match=why):
            WithDerivatives.of(Smooth(), steps, points)


@pytest.mark.parametrize("chip", ["fdc1004", "ad7746", "mpr121", "sdr"])
def test_codes_of_a_chip(chip: str) -> None:
    """First the empty domain's code, then the change: what two recordings at rest give."""
    electrodes = ("A", "B", "C")
    empty, near = (
        cs.Reading(
            m, m - m, StepStats(0.0, 0.0), electrodes, np.zeros(3)
        ) for m in (1e-12 * (4 * np.eye(3) - 1) * k for k in (1.0, 1.02))
    )  # fmt: skip
    readout = cs.Readout.preset(
        chip, electrodes, noise=False, period=0.5, latency=0.01, expected=3e-12
    )
    rest, moved = (
        np.array([readout(np.linspace(0, 3, 4), [empty] * 2 + [r] * 2).of(n).code[-1]
                  for n in readout.channel_names]) for r in (empty, near)
    )  # fmt: skip
    assert (moved != rest).all()
    np.testing.assert_array_equal(codes_at(readout, empty), rest)
    np.testing.assert_array_equal(codes_at(readout, empty, near), [*rest, *(moved - rest)])


def test_plots() -> None:
    """One parameter: a line for each output; two: a map for each, with gaps where errors are."""
    rows = [StudyRow({"a": a, "b": 1.0}, (1e-15 * a, 2e-15 * a, 5.0)) for a in (3.0, 1.0, 2.0)]
    outputs = ("C0_E_E", "C0_E_F", "code0_E")
    lines = plot_sweep(rows, outputs).axes
    assert [len(axes.lines) for axes in lines] == [2, 1]
    np.testing.assert_allclose(lines[0].lines[1].get_xydata(), [[1, 2], [2, 4], [3, 6]])
    assert lines[0].get_ylabel() == "[fF]"
    rows = [
        StudyRow({"a": a, "m": m}, (math.nan,) * 3 if (a, m) == (1.0, "x") else (a, a, a))
        for a in (1.0, 2.0) for m in ("y", "x")
    ]  # fmt: skip
    maps = [axes for axes in plot_sweep(rows, outputs, ["C0"]).axes if axes.get_title("left")]
    assert len(maps) == 2
    grid = np.ma.filled(maps[0].collections[0].get_array(), math.nan).reshape(2, 2)
    np.testing.assert_allclose(grid, 1e12 * np.array([[1, 2], [math.nan, 2]]))
    assert [t.get_text() for t in maps[0].get_yticklabels()] == ["y", "x"]
    for wrong, chosen, why in (
        (rows[:1], [], "0 change"), (rows, ["dC"], "no output"),
        ([StudyRow({"a": k, "b": k, "c": k}, (1.0,) * 3) for k in (1.0, 2.0)], [], "3 change"),
    ):  # fmt: skip
        with pytest.raises(ScenarioError, match=why):
            plot_sweep(wrong, outputs, chosen)
    many = tuple(f"C0_{k}_{k}" for k in range(13))
    with pytest.raises(ScenarioError, match="12 outputs at most"):
        plot_sweep([StudyRow(r.point, (1.0,) * 13) for r in rows], many)


def test_processes_fit_into_memory() -> None:
    assert jobs_within(1e18) == 1
    assert jobs_within(1.0) >= 1


def test_parts_of_a_readout(tmp_path: Path) -> None:
    """Noise is not varied; chips are named or described by files."""
    design, _ = files(tmp_path)
    assert load_readout_template("fdc1004") == "fdc1004"
    file = tmp_path / "chip.toml"
    file.write_text('chip = "fdc1004"\n[noise]\nwhite = "=w"\n')
    with pytest.raises(ReadoutError, match=r"chip.toml: noise: .* \[calibration\]"):
        Capacitances.of(design, [{"side": 0.005, "w": 1.0}], None, load_readout_template(file))
    empty = Template("empty.toml", {"name": "none"}, tmp_path, ScenarioError)
    with pytest.raises(ScenarioError, match="has no body"):
        Capacitances.of(design, [{"side": 0.005}], empty)
