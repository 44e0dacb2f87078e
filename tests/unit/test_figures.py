"""Pages take their headline figures from ``docs/figures.json``, and texts state none besides."""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "benchmarks"))

import headline  # noqa: E402
import headline_tables  # noqa: E402
import pages  # noqa: E402

FIGURES = headline_tables.load()
UPDATE = "run python benchmarks/headline.py --write"
MEASURED = re.compile(r"\d ?%|\d ?ms\b")


def test_pages_have_the_tables_of_the_file() -> None:
    used = set()
    for path in headline.pages():
        text = path.read_text(encoding="utf-8")
        assert headline.filled(text, FIGURES) == text, f"{path.name}: {UPDATE}"
        used |= headline.blocks(text).keys()
    assert used == headline_tables.TABLES.keys()


def test_all_parts_are_of_one_code() -> None:
    """Every part is there, of the command that measures it; none was left from other code."""
    assert list(FIGURES) == list(headline.PARTS)
    assert len({entry["code"] for entry in FIGURES.values()}) == 1
    for name, entry in FIGURES.items():
        assert entry["command"] == headline.PARTS[name].command
        assert re.fullmatch(r"\d{4}-\d\d-\d\d", entry["date"])
        for figure in entry["figures"].values():
            assert figure["value"] >= 0.0
            assert figure["unit"] in ("%", "ms", "s", "1", "scenes/s", "solves/s")


def test_the_readme_states_no_figure_of_its_own() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    for block in headline.blocks(text).values():
        text = text.replace(block, "")
    assert not MEASURED.findall(text)


def docstrings() -> list[tuple[str, str]]:
    """Docstrings of the package, and strings below names."""
    found = []
    for path in sorted((ROOT / "src" / "capsense").rglob("*.py")):
        if path.parts[-2] == "reproduce":  # figures of the paper
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
                found.append((path.name, str(node.value.value)))
    return found


def test_docstrings_refer_to_the_pages_for_errors_and_times() -> None:
    """No docstring says how exact a preset is, or how many milliseconds anything takes."""
    preset = re.compile(r"\b(fast|standard|fine|learning)\"[^.;]{0,30}\d ?%|\d ?% rms|\d ms\b")
    texts = docstrings()
    assert len(texts) > 3000
    assert not [found for found in texts if preset.search(found[1])]


def test_messages_agree_with_the_figures() -> None:
    """Warnings say that compiling takes about a minute, and so does the measurement."""
    found = FIGURES["steps"]["figures"]["first reading/cold"]
    assert found["unit"] == "s"
    assert 30.0 < found["value"] < 90.0
    for name in ("_jit.py", "_kernel_cache.py"):
        text = (ROOT / "src" / "capsense" / name).read_text(encoding="utf-8")
        assert "about a minute" in text


def test_text_between_markers(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("a\n<!-- x -->\nold\n<!-- end -->\nb <!-- end -->\n", encoding="utf-8")
    pages.write_between(page, ("<!-- x -->", "<!-- end -->"), "new\nlines")
    text = page.read_text(encoding="utf-8")
    assert text == "a\n<!-- x -->\nnew\nlines\n<!-- end -->\nb <!-- end -->\n"
    assert pages.between(text, ("<!-- x -->", "<!-- end -->")) == "new\nlines"
    with pytest.raises(ValueError, match="has no lines '<!-- y -->'"):
        pages.write_between(page, ("<!-- y -->", "<!-- end -->"), "new")


def test_a_changed_figure_and_an_unknown_table_are_noticed() -> None:
    page = f"<!-- figures: presets -->\n{headline_tables.presets(FIGURES)}\n{headline.END}\n"
    assert headline.filled(page, FIGURES) == page
    entry = FIGURES["presets"]
    other = {**entry, "figures": {**entry["figures"], "fine/worst": {"value": 7.7, "unit": "%"}}}
    assert "| 7.7 % |" in headline.filled(page, {**FIGURES, "presets": other})
    with pytest.raises(SystemExit, match="no table 'speed'; choose from presets, near"):
        headline.filled(f"<!-- figures: speed -->\n{headline.END}", FIGURES)


def test_the_file_is_kept_as_it_was_read(tmp_path: Path) -> None:
    headline.save(FIGURES, tmp_path / "figures.json")
    assert headline_tables.load(tmp_path / "figures.json") == FIGURES
    assert (tmp_path / "figures.json").read_bytes() == headline_tables.FIGURES.read_bytes()


def test_a_part_of_this_code_is_not_measured_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its program may fail; of other code, or asked for again, it does."""
    part = headline.Part("python -c raise(SystemExit(3))", headline.of_skin)
    monkeypatch.setitem(headline.PARTS, "skin", part)
    monkeypatch.setattr(headline, "OUT", tmp_path)
    entry = {**FIGURES["skin"], "command": part.command, "code": headline.code()}
    headline.save({"skin": entry}, tmp_path / "all.json")
    (tmp_path / "skin.entry.json").write_text(
        (tmp_path / "all.json").read_text(encoding="utf-8").partition(":")[2].rpartition("}")[0],
        encoding="utf-8",
    )
    assert headline.measure("skin", again=False) == entry
    with pytest.raises(SystemExit, match="failed with 3"):
        headline.measure("skin", again=True)
    monkeypatch.setattr(headline, "code", lambda: "other")
    with pytest.raises(SystemExit, match="failed with 3"):
        headline.measure("skin", again=False)
