"""The validation page: what it computes itself, and what it says of what has not been run."""

from __future__ import annotations

import json
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

from capsense.reproduce.registry import STUDIES

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def validation() -> ModuleType:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "benchmarks"))
        module = import_module("validation")
    sys.modules.pop("validation")
    return module


def test_disc_between_planes(
    validation: ModuleType, field_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Analytic: half-plane edges; the online solver 5 mm from the electrode, measured 1.1 %."""
    monkeypatch.setenv("CAPSENSE_CACHE_DIR", str(field_cache))
    for _, formula, found, _ in validation.disc_between_planes([0.005]):
        assert float(found) == pytest.approx(float(formula), rel=0.02)


def test_references(validation: ModuleType) -> None:
    """Every packaged case has a line."""
    lines = validation.references().splitlines()
    curved = sum("arm_segment" in line for line in lines)
    assert curved >= 4
    assert len(lines) == 2 + 13 + 10 + 5 + curved
    errors = [float(line.split("|")[3].strip().rstrip(" %")) for line in lines[2:]]
    assert max(errors[:-curved]) < 6
    assert max(errors) < 10


def test_what_was_not_run_is_said(validation: ModuleType, tmp_path: Path) -> None:
    assert "not measured" in validation.peers(tmp_path / "peers.json")
    assert "Not measured" in validation.boards(tmp_path / "boards.txt")
    found = validation.studies(tmp_path)
    for name in STUDIES:
        assert f"Not run in this edition: `capsense reproduce {name}`" in found


def test_rows_of_a_study(validation: ModuleType, tmp_path: Path) -> None:
    name = next(iter(STUDIES))
    (tmp_path / name).mkdir()
    row = {"what": "r", "value": 0.5, "unit": "%", "target": "> 0.4", "verdict": "met"}
    content = {"title": "A title", "reduced": False, "rows": [row]}
    (tmp_path / name / "rows.json").write_text(json.dumps(content), encoding="utf-8")
    found = validation.studies(tmp_path)
    assert "### A title" in found
    assert "| r | 0.5 % | > 0.4 | met |" in found
    content["reduced"] = True
    (tmp_path / name / "rows.json").write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(SystemExit, match="reduced form"):
        validation.studies(tmp_path)


def test_page_is_of_the_present_studies() -> None:
    """The page in the docs was written after the last study was added."""
    page = (ROOT / "docs" / "validation.md").read_text(encoding="utf-8")
    for name in STUDIES:
        assert f"`capsense reproduce {name}`\n\n| what" in page, f"{name} is missing: run it anew"
    assert "What is not validated" in page
