"""The tutorials, run as they stand on their pages.

A line such as ``EPISODES = 20  # the tests use 2`` is run with the smaller number. Pages whose code
has none must print what they show.
"""

from __future__ import annotations

import re
import runpy
from contextlib import chdir
from pathlib import Path

import pytest
from approximate import approx

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = [
    *(DOCS / f"{name}.md" for name in ("getting_started", "own_design")),
    *sorted(DOCS.glob("tutorials/*.md")),
]
REDUCED = re.compile(r"^(\w+ = ).*?#.*the tests use (.*)$", flags=re.MULTILINE)
NUMBER = re.compile(r"-?\d+(?:\.\d*)?(?:e[-+]?\d+)?")


def blocks(page: Path, language: str) -> str:
    """All fenced code of a language, one after another."""
    text = page.read_text(encoding="utf-8")
    return "\n".join(re.findall(rf"```{language}\n(.*?)```", text, flags=re.DOTALL))


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_a_page_runs(
    page: Path,
    tmp_path: Path,
    field_cache: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Every block, in one namespace, beside the examples; shown numbers hold to 3 % or a digit."""
    monkeypatch.setenv("CAPSENSE_CACHE_DIR", str(field_cache))
    monkeypatch.setenv("MPLBACKEND", "agg")
    code = blocks(page, "python")
    reduced = REDUCED.sub(r"\1\2", code)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    with chdir(tmp_path):
        for name, text in files(page).items():
            Path(name).write_text(REDUCED.sub(r"\1\2", text), encoding="utf-8")
        exec(compile(reduced, page.name, "exec"), {"__name__": "tutorial"})
    if reduced == code:
        assert_same(capsys.readouterr().out, blocks(page, "text"))


def test_the_page_on_distance_models(capsys: pytest.CaptureFixture[str]) -> None:
    """It shows what its example prints."""
    runpy.run_path(str(ROOT / "examples" / "distance_models.py"), run_name="__main__")
    assert_same(capsys.readouterr().out, blocks(DOCS / "distance_models.md", "text"))


def assert_same(found: str, shown: str) -> None:
    """The same words, and numbers to 3 % or a digit."""
    assert NUMBER.sub("#", found).split() == NUMBER.sub("#", shown).split()
    numbers = [[float(n) for n in NUMBER.findall(text)] for text in (found, shown)]
    assert numbers[0] == approx(numbers[1], rel=0.03, abs=0.0101)  # a last digit


def files(page: Path) -> dict[str, str]:
    """Files that a page shows, by the titles of their blocks."""
    text = page.read_text(encoding="utf-8")
    return dict(re.findall(r'```toml title="([^"]+)"\n(.*?)```', text, flags=re.DOTALL))
