"""The laboratory experiment: its files agree, and the comparison finds what it is to find."""

from __future__ import annotations

import csv
import dataclasses
import importlib
import math
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import capsense as cs
from capsense.__main__ import main as command
from capsense.errors import ReadoutError

FOLDER = Path(__file__).parents[2] / "examples" / "experiment"
NOISE = 0.15e-15
HEIGHTS = (0.5, 1, 2, 5, 10, 20)


@pytest.fixture(scope="module")
def files() -> Iterator[ModuleType]:
    """``make_files``, with a coarser board, whose field is built sooner."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(FOLDER))
        module = importlib.import_module("make_files")
        exact = module.compare.board

        def coarse(*args: float) -> cs.design.Design:
            return dataclasses.replace(exact(*args), build={"resolution": 0.7})

        patch.setattr(module.compare, "board", coarse)
        yield module


@pytest.fixture(scope="module")
def rows(files: ModuleType) -> list:
    still = [p for p in files.positions() if p.cover == 0]
    empty = next(p for p in still if p.body == "empty")
    loose = next(p for p in still if p.body == "open")
    moves = [("plate", "grounded"), ("plate", "floating"), ("disc", "grounded")]
    out = [loose] * 3 + [empty] * 6
    for body, grounding in moves:
        out += [*files.approach(body, HEIGHTS, grounding), *[empty] * 3]
    return out


def fitted(files: ModuleType, rows: list, **faults: float):  # type: ignore[no-untyped-def]
    measured = files.synthetic(rows, noise=NOISE, seed=5, preset="fast", **faults)
    return files.compare.fit(rows, measured, preset="fast")


@pytest.fixture(scope="module")
def found(files: ModuleType, rows: list):  # type: ignore[no-untyped-def]
    return fitted(files, rows)


def test_known_faults_are_found(files: ModuleType, found) -> None:  # type: ignore[no-untyped-def]
    """Gains to 0.3 %, strays to 0.05 pF, zeros to 2 µm, and within their uncertainties."""
    gain, stray = (np.array(files.FAULTS[k]) for k in ("gain", "stray"))
    np.testing.assert_allclose(found.gain, gain, rtol=3e-3)
    np.testing.assert_allclose(found.stray, stray, atol=5e-14)
    assert (np.abs(found.gain - gain) < 4 * found.uncertainty["gain"]).all()
    assert (np.abs(found.stray - stray) < 4 * found.uncertainty["stray"]).all()
    for body in ("plate", "disc"):
        error = abs(found.zero[body] - files.ZEROS[body])
        assert error < min(2e-6, 4 * found.uncertainty["zero"][body])
    np.testing.assert_array_less(found.noise, 2 * NOISE)
    np.testing.assert_array_less(0.5 * NOISE, found.noise)


def test_verdicts_on_agreeing_data(found) -> None:  # type: ignore[no-untyped-def]
    verdicts = {key: verdict for key, (_, _, verdict) in found.verdicts.items()}
    absent = {"tied", "cover"}
    assert {k for k, v in verdicts.items() if v == "not measured"} == absent
    assert {k for k, v in verdicts.items() if v == "confirmed"} == set(verdicts) - absent


def test_wrong_permittivity_is_flagged(files: ModuleType, rows: list) -> None:
    """A board of 4.95 in place of 4.5 is told by its empty capacitance; gains stay."""
    wrong = fitted(files, rows, permittivity=4.95)
    value, unsure = wrong.permittivity
    assert abs(value - 4.95) < min(0.1, 4 * unsure)
    assert wrong.verdicts["permittivity"][2] == "REFUTED"


def test_wrong_distances_are_refuted(files: ModuleType, rows: list) -> None:
    """Errors of 10 % that grow towards the board are no gain and no zero."""
    measured = files.synthetic(rows, noise=NOISE, seed=5, preset="fast")
    height = np.array([p.height for p in rows])
    held = np.array([p.body in files.compare.BODIES for p in rows])
    level = measured[[p.body == "empty" for p in rows]].mean(axis=0)
    bend = 1 + 0.2 * np.exp(-np.where(held, height, 1.0) / 1e-3)
    measured = level + (measured - level) * np.where(held, bend, 1.0)[:, None]
    result = files.compare.fit(rows, measured, preset="fast")
    assert result.verdicts["near"][2] == "REFUTED"


def test_tilt(files: ModuleType, rows: list) -> None:
    """A tilted plate is found out where tilt is fitted."""
    compare = files.compare
    plate = [p for p in rows if p.body in ("plate", "empty") and p.grounding != "floating"]
    true = compare.changes(plate, {"plate": 5e-6}, {"plate": (2e-3, -1e-3)}, "fast")
    noise = NOISE * np.random.default_rng(2).standard_normal(true.shape)
    result = compare.fit(plate, true + 5e-12 + noise, preset="fast", tilted=True)
    np.testing.assert_allclose(result.tilt["plate"], (2e-3, -1e-3), atol=2e-4)
    assert abs(result.zero["plate"] - 5e-6) < 3e-6


def test_drawing_gives_the_same_areas(files: ModuleType, tmp_path: Path) -> None:
    """`capsense layout` reads the drawing that lies there, which is that of the design."""
    text = (FOLDER / "board.svg").read_text(encoding="utf-8")
    assert text == files.drawing(files.compare.board())
    names, target = ("L", "M", "S", "T", "R"), tmp_path / "board.toml"
    options = ["--electrode", *names, "--shield", "GUARD", "-o", str(target)]
    assert not command(["layout", str(FOLDER / "board.svg"), *options])
    read, own = cs.load_design(target), cs.load_design(FOLDER / "board.toml")
    areas = {s.name: s.surface.area for s in own.sheets}
    for sheet in read.sheets:
        np.testing.assert_allclose(sheet.surface.area, areas[sheet.name], rtol=1e-3)
    assert {s.name for s in read.sheets} == {*names, "GUARD"}
    layout = cs.load_layout(FOLDER / "board.svg")
    (plane,) = layout.nets["PLANE"].values()
    np.testing.assert_allclose(plane.area, areas["PLANE"], rtol=1e-3)
    assert layout.outline is not None
    np.testing.assert_allclose(layout.outline.area, 0.1 * 0.08, rtol=1e-5)


def test_files_fit_each_other(files: ModuleType) -> None:
    """The tables are what the script writes, and none claims to be evidence."""
    planned = list(files.positions())
    text = (FOLDER / "positions.csv").read_text(encoding="utf-8")
    assert text.splitlines()[1:] == files.table(planned, None, [""]).splitlines()[1:]
    template = (FOLDER / "measured.csv").read_text(encoding="utf-8")
    assert "nobody has run" in template
    with pytest.raises(ReadoutError, match="holds no rows"):
        files.compare.read_rows(FOLDER / "measured.csv")
    made = FOLDER / "synthetic.csv"
    assert made.read_text(encoding="utf-8").startswith("# SYNTHETIC")
    read, values = files.compare.read_rows(made)
    assert values.shape == (len(planned), 5)
    for one, other in zip(read, planned, strict=True):
        assert (one.body, one.grounding, one.direction) == (
            other.body, other.grounding, other.direction,
        )  # fmt: skip
        assert math.isclose(one.height, other.height, abs_tol=1e-12)
    heights = {p.height for p in planned if p.body == "plate"}
    assert (min(heights), max(heights)) == (2e-4, 0.15)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("height_mm,", "", "lacks height_mm"),
        ("height_mm", "z_mm", "lacks height_mm"),
        ("L_pF", "L_pF,Q_pF", "unknown Q_pF"),
        ("L_pF", "L_pF,L_pF", "twice L_pF"),
        ("plate,0", "plaat,0", r"line 3: body = 'plaat'"),
        ("grounded", "earthed", r"line 3: grounding = 'earthed'"),
        (",12.5", ",n/a", r"line 3: L_pF = 'n/a'"),
        (",12.5", "", "10|11|12"),
        (",5,grounded", ",0,grounded", "height_mm = 0"),
    ],
)
def test_wrong_files_are_told(
    files: ModuleType, tmp_path: Path, old: str, new: str, told: str
) -> None:
    good = (
        f"# a comment\n{','.join(files.compare.COLUMNS)}\n"
        "plate,0,0,5,grounded,0,down,12.5,3.4,0.5,6.2,0.2\n"
    )
    path = tmp_path / "measured.csv"
    path.write_text(good, encoding="utf-8")
    positions, values = files.compare.read_rows(path)
    assert positions[0].height == 5e-3
    np.testing.assert_allclose(values, [[12.5e-12, 3.4e-12, 0.5e-12, 6.2e-12, 0.2e-12]])
    path.write_text(good.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ReadoutError, match=told):
        files.compare.read_rows(path)


def test_whole_run(
    files: ModuleType, rows: list, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """From a file to table, verdicts and plot; an error is one line."""
    values = files.synthetic(rows, noise=NOISE, seed=5, preset="fast")
    path = tmp_path / "m.csv"
    path.write_text(files.table(rows, values, ["synthetic"]), encoding="utf-8")
    assert len(list(csv.reader(path.open(encoding="utf-8")))) == len(rows) + 2
    files.compare.main([str(path), "-o", str(tmp_path), "--preset", "fast"])
    text = capsys.readouterr().out
    assert re.search(r"^zero of plate: \+1[0-4]\.\d ± ", text, flags=re.MULTILINE)
    assert text.count("confirmed") == 8
    assert (tmp_path / "experiment.png").stat().st_size > 20_000
    with pytest.raises(SystemExit, match=r"^error: there is no file"):
        files.compare.main([str(tmp_path / "none.csv")])
