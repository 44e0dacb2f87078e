"""CONTRIBUTING.md and docs/dev: the files that they name are there, and what they hold is so."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs" / "dev").glob("*.md"))
TEXT = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)


def test_named_files_are_there() -> None:
    named = set(re.findall(r"`((?:src|tests|docs|examples)/[\w./-]+)`", TEXT))
    assert len(named) > 30
    missing = {name for name in named if not (ROOT / name).exists()}
    assert missing == {"src/capsense/adapters/NAME.py"}


def test_mutations_are_of_the_code_as_it_is() -> None:
    """Modules and tests that ``mutations.toml`` names are there, and so is every line, or few lines
    in a row, whose change it calls harmless."""
    path = ROOT / "benchmarks" / "mutations.toml"
    table = tomllib.loads(path.read_text(encoding="utf-8"))
    sources = ROOT / "src" / "capsense"
    for module, entry in table["module"].items():
        assert (sources / module).is_file(), module
        named = re.findall(r"tests/[\w/.]+", entry["tests"])
        assert named
        assert not [name for name in named if not (ROOT / name).exists()], module
    stale = []
    for modules in table["harmless"].values():
        for module, changes in modules.items():
            source = (sources / module).read_text(encoding="utf-8")
            lines = f" {' '.join(line.strip() for line in source.splitlines())} "
            stale += [(module, c) for c in changes if f" {c.split(' => ')[0]} " not in lines]
    assert not stale, "text that no longer occurs; correct these entries, or take them out"
