"""How to cite CapSense: the files agree with the package and with each other."""

from __future__ import annotations

import datetime
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

import capsense as cs

ROOT = Path(__file__).parents[2]
BIBTEX = (ROOT / "docs" / "assets" / "CITATION.bib").read_text(encoding="utf-8")
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]


@pytest.fixture
def cff() -> dict[str, Any]:
    yaml = pytest.importorskip("yaml")
    found: dict[str, Any] = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    return found


def fields(kind: str) -> dict[str, str]:
    """Of the BibTeX entry of a kind."""
    (entry,) = re.findall(rf"^@{kind}{{\w+,\n(.*?)^}}", BIBTEX, flags=re.MULTILINE | re.DOTALL)
    return {
        name: re.sub(r"[{}]", "", value)
        for name, value in re.findall(r"^  (\w+) *= \{(.*?)\},?$", entry, flags=re.MULTILINE)
    }


def test_form(cff: dict[str, Any]) -> None:
    """What Citation File Format 1.2.0 requires, and only keys that it has."""
    assert cff["cff-version"] == "1.2.0"
    assert {"message", "title", "authors"} <= set(cff) <= {
        "cff-version", "message", "title", "type", "abstract", "authors", "version",
        "date-released", "license", "keywords", "preferred-citation",
    }  # fmt: skip
    paper = cff["preferred-citation"]
    assert {"type", "title", "authors"} <= set(paper) <= {
        "type", "title", "authors", "journal", "year", "doi", "volume", "issue", "start", "end",
    }  # fmt: skip
    for author in cff["authors"] + paper["authors"]:
        assert set(author) in ({"name"}, {"family-names", "given-names"})
        assert all(author.values())


def test_version_and_date(cff: dict[str, Any]) -> None:
    """Version and date of the release, in all of them."""
    software = fields("software")
    assert cs.__version__ == VERSION == cff["version"] == software["version"]
    released = cff["date-released"]
    assert isinstance(released, datetime.date)
    assert f"## [{VERSION}] - {released}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert software["year"] == str(released.year)


def test_the_paper_is_the_same(cff: dict[str, Any]) -> None:
    paper, bibtex = cff["preferred-citation"], fields("article")
    for key in ("title", "journal", "year"):
        assert str(paper[key]) == bibtex[key]
