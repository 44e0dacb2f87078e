"""The validation page: what it computes itself, and what it says of what has not been run."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
from approximate import approx
from benchmark_modules import imported

from capsense.reproduce import STUDIES

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "validation.md").read_text(encoding="utf-8")
MODULES = ("validation", "validation_results")


@pytest.fixture(scope="module")
def parts() -> Iterator[dict[str, ModuleType]]:
    """The benchmark's modules."""
    with imported(*MODULES) as found:
        yield found


@pytest.fixture(scope="module")
def validation(parts: dict[str, ModuleType], field_cache: Path) -> Iterator[ModuleType]:
    """The script that writes the page, with the tests' fields."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CAPSENSE_CACHE_DIR", str(field_cache))
        yield parts["validation"]


def cells(line: str) -> list[str]:
    """The cells of a line of a table."""
    return [cell.strip() for cell in line.strip("|").split("|")]


def rows(text: str) -> dict[str, list[str]]:
    """Lines of a table by their first cells."""
    return {line[0]: line[1:] for line in map(cells, text.splitlines()[2:])}


def numbers(text: str) -> list[float]:
    """All numbers of a text, in order."""
    return [float(n) for n in re.findall(r"[-+]?\d+(?:\.\d+)?(?:e[-+]\d+)?", text)]


def assert_on_page(computed: str, absolute: float, relative: float = 0.02) -> None:
    """Every line of a computed table stands on the page, with the same figures to within bounds."""
    lines = {cells(line)[0]: line for line in PAGE.splitlines() if line.startswith("|")}
    by_two = {tuple(cells(line)[:2]): line for line in PAGE.splitlines() if line.startswith("|")}
    for line in computed.splitlines()[2:]:
        own = cells(line)
        there = by_two.get((own[0], own[1])) or lines.get(own[0])
        assert there is not None, f"the page lacks {line}"
        assert numbers(there) == approx(numbers(line), abs=absolute, rel=relative), line


def test_disc_between_planes(validation: ModuleType) -> None:
    """Analytic: half-plane edges; the online solver 5 mm from the electrode."""
    for _, formula, found, _ in validation.disc_between_planes([0.005]):
        assert float(found) == approx(float(formula), rel=0.02)


def test_references(validation: ModuleType) -> None:
    """Every packaged case has a figure; errors stay within bounds, and the page tells them."""
    found = validation.errors_of_references()
    curved = {body: cases for (design, body), cases in found.items() if design == "arm_segment"}
    assert sum(map(len, curved.values())) >= 4
    flat = sum(len(cases) for (design, _), cases in found.items() if design != "arm_segment")
    assert flat == 13 + 10 + 5
    errors = {
        (*key, case): 100 * e for key, cases in found.items() for case, (e, _) in cases.items()
    }
    near = {key for key in errors if key[1] == "bar" and key[2] in ("1", "2")}
    assert len(near) == 2
    assert max(errors[key] for key in near) < 2
    assert max(error for key, error in errors.items() if key not in near) < 3
    by_body = {tuple(cells(x)[:2]): x for x in PAGE.splitlines() if x.startswith("|")}
    for line in validation.references().splitlines()[2:]:
        there, own = cells(by_body[tuple(cells(line)[:2])]), cells(line)
        assert there[2] == own[2]
        assert numbers(there[3]) == approx(numbers(own[3]), abs=0.051, rel=0.02)
        if "empty" not in own[1]:
            assert numbers(own[4])[0] < 1.5, line


def test_maps(validation: ModuleType) -> None:
    """The standard preset over 209 scenes: within bounds, and as the page says."""
    text = validation.presets(["standard"])
    found = [cells(line) for line in text.splitlines()[2:]]
    assert [int(row[1]) for row in found] == [89, 96, 24]
    for row, (rms, worst) in zip(found, ((0.55, 2.5), (1.0, 5.5), (1.6, 12.0)), strict=True):
        assert float(row[2]) < rms
        assert float(row[4]) < worst
        (there,) = (cells(x) for x in PAGE.splitlines() if x.startswith(f"| {row[0]} "))
        standard = [float(cell.split("/")[1]) for cell in there[2:]]
        assert standard == approx([float(value) for value in row[2:]], abs=0.05, rel=0.02)


@pytest.mark.parametrize(
    ("only", "count"),
    [("cover", 4), ("FR4, plate", 3), pytest.param("", 11, marks=pytest.mark.slow)],
)
def test_designs(validation: ModuleType, only: str, count: int) -> None:
    """Each reference is good to 0.5 %; what self mode reads, and the page says so."""
    text = validation.designs(only)
    found = rows(text)
    assert sum(len(numbers(line[1])) for line in found.values()) == count
    for name, (gaps, pad, _, own, error) in found.items():
        assert len(numbers(gaps)) == len(numbers(own)) == len(numbers(error)), name
        assert max(map(abs, numbers(pad) + numbers(own))) < 3.0, name
        assert max(numbers(error)) < 0.5, name
    assert_on_page(text, 0.05)


@pytest.mark.parametrize(
    ("part", "lines", "count", "bound"),
    [
        ("wide", 1, 9, 70), ("images", 6, 4, 20),
        pytest.param("wide", 3, 9, 70, marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_limits(validation: ModuleType, part: str, lines: int, count: int, bound: float) -> None:
    """Limits are those on the page."""
    if part == "wide":
        text = validation.wide(lines)
    else:
        text = validation.limited(part, *validation.GAPS, lines=lines)
    assert len(rows(text)) == lines
    for values in rows(text).values():
        assert len(found := numbers(" ".join(values))) == count
        assert max(found) < bound
    assert_on_page(text, 0.3)


def test_inside(validation: ModuleType) -> None:
    """What the error estimate tells of bodies in the sensor is what the page says."""
    text = validation.inside()
    assert numbers(text)[1] > 90.0
    there = PAGE.partition("readings mean little. ")[2].partition("\n")[0]
    assert numbers(there) == approx(numbers(text), abs=1.0)
    assert there.partition("of: ")[2] == text.partition("of: ")[2]


def test_what_was_not_run_is_said(parts: dict[str, ModuleType], tmp_path: Path) -> None:
    results = parts["validation_results"]
    found = results.smoothness(tmp_path / "none.json")
    assert "Not measured in this edition: `python benchmarks/" in found
    found = results.studies(tmp_path)
    for name in STUDIES:
        assert f"| {name} | not run in this edition: `capsense reproduce {name}` |" in found


def test_smoothness(parts: dict[str, ModuleType], tmp_path: Path) -> None:
    """The largest value of all bodies, with its body; counts are sums."""
    even = {"approach": 1e-5, "slide": 2e-5, "turn z": 0.0, "turn y": 0.0, "wall": 3e-4,
            "contact": [0.01, 0.02], "falls": [0, 1], "wrong": [1, 0], "memory": 0.0}  # fmt: skip
    rough = {**even, "turn y": 5e-5, "wall": 1e-4, "contact": [0.04, 0.0], "memory": 1e-9}
    path = tmp_path / "smoothness.json"
    path.write_text(json.dumps({"preset": {"ball": even, "box": rough}}), encoding="utf-8")
    found = [cells(line)[1:] for line in parts["validation_results"].smoothness(path).splitlines()]
    assert found[2:] == [
        ["5.0e-05", "box"], ["3.0e-04", "ball"], ["4.00", "box"], ["2", ""], ["2", ""],
        ["1e-09", ""],
    ]  # fmt: skip


def test_rows_of_a_study(parts: dict[str, ModuleType], tmp_path: Path) -> None:
    studies = parts["validation_results"].studies
    name = next(iter(STUDIES))
    (tmp_path / name).mkdir()
    row = {"what": "r", "value": 0.5, "unit": "%", "target": "> 0.4", "verdict": "met"}
    other = {**row, "what": "s", "verdict": "for information"}
    missed = {**row, "what": "t", "verdict": "missed"}
    content = {"title": "A title", "reduced": False, "rows": [row, other, missed]}
    (tmp_path / name / "rows.json").write_text(json.dumps(content), encoding="utf-8")
    found = studies(tmp_path)
    assert f"| {name} | 1 of 2 | t: 0.5 %, target > 0.4 |" in found
    content["reduced"] = True
    (tmp_path / name / "rows.json").write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(SystemExit, match="reduced form"):
        studies(tmp_path)


def test_page_is_of_the_present_studies(validation: ModuleType) -> None:
    """The page was written after the last study was added, from the present template."""
    for name in STUDIES:
        assert f"\n| {name} | " in PAGE, f"{name} is missing: run it anew"
    assert "this edition: `" not in PAGE
    template = validation.TEMPLATE.read_text(encoding="utf-8")
    at = 0
    for text in re.split(r"\{\w+\}", template):
        at = PAGE.find(text, at)
        assert at >= 0, f"the page lacks, or has elsewhere: {text[:60]!r}"
        at += len(text)


def test_named_commands_are_there() -> None:
    """Every benchmark that validation and performance name is a file."""
    performance = (ROOT / "docs" / "performance.md").read_text(encoding="utf-8")
    for name in re.findall(r"benchmarks/(\w+\.py)", PAGE + performance):
        assert (ROOT / "benchmarks" / name).is_file(), name
