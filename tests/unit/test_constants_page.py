"""The constants of the solver: each is described, and the page on the theory counts them."""

from __future__ import annotations

import re
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "benchmarks"))

import constants  # noqa: E402
import pages  # noqa: E402

PAGE = (ROOT / "docs" / "theory.md").read_text(encoding="utf-8")
UPDATE = "run python benchmarks/constants.py --write docs/theory.md"


def test_every_constant_is_described() -> None:
    """``constants.toml`` describes the constants of the code, and no others."""
    found, notes = constants.constants(), constants.notes()
    assert len({c.key for c in found}) == len(found)
    assert {c.key for c in found} == set(notes), "benchmarks/constants.toml and the code differ"
    for key, note in notes.items():
        if note["kind"] == "tuned":
            assert note["origin"] in constants.ORIGINS, key
            assert {*note} <= {"kind", "unit", "meaning", "origin", "sensitivity"}, key
        else:
            assert set(note) == {"kind"}, key
            assert note["kind"] in constants.OTHERS, key


def test_the_table_lists_the_tuned_ones() -> None:
    """Name, value, unit and meaning of every one, and no others."""
    rows = re.findall(
        r"^\| `([\w.]+)` \| (.*?) \| (.+?) \| (.+?) \|", constants.table(), re.MULTILINE
    )
    notes = constants.notes()
    tuned = [c for c in constants.constants() if notes[c.key]["kind"] == "tuned"]
    assert [row[:2] for row in rows] == [(c.key, c.value) for c in tuned]
    assert [row[3] for row in rows] == [notes[c.key]["meaning"] for c in tuned]


def test_the_page_counts_them() -> None:
    """By origin, and those that are not tuned by kind."""
    text = pages.between(PAGE, (constants.START, constants.END))
    assert text == constants.summary(), UPDATE
    notes = list(constants.notes().values())
    for words, kind, key in (
        *((words, kind, "kind") for kind, words in constants.OTHERS.items()),
        *((words, origin, "origin") for origin, words in constants.ORIGINS.items()),
    ):
        assert f" {sum(note.get(key) == kind for note in notes)} {words}" in text


def test_what_counts_as_a_constant(tmp_path: Path, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    """Numbers, tuples and formulas of numbers are listed; names, texts and functions are not."""
    for package in constants.PACKAGES:
        (tmp_path / package).mkdir()
    (tmp_path / "field" / "some.py").write_text(
        "import math\nA = 1.5\n'''What\nit is.'''\n_B, C = (1, 2.0), -3\nD = 2 * math.pi\n"
        "E = 'text'\nF = A\ng = 1.0\nH: int = 4\nI = True\n"
        "SETS = {'fine': Preset(panels=9, x=None)}\n"
        "class Preset:\n    panels: int = 7\n    name: str = 'a'\nclass Other:\n    size = 1.0\n",
        encoding="utf-8",
    )
    monkeypatch.setattr(constants, "SOURCE", tmp_path)
    found = constants.constants()
    assert {c.name: c.value for c in found} == {
        "A": "1.5", "_B": "1; 2.0", "C": "-3", "D": "2 · π", "H": "4", "SETS.fine.panels": "9",
        "Preset.panels": "7",
    }  # fmt: skip
    assert found[0].text == "What it is."
