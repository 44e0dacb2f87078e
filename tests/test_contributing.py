"""CONTRIBUTING.md: the files that it sends people to are there."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")


def test_named_files_are_there() -> None:
    named = set(re.findall(r"`((?:src|tests|docs|examples)/[\w./-]+)`", TEXT))
    assert len(named) > 30
    missing = {name for name in named if not (ROOT / name).exists()}
    assert missing == {"src/capsense/adapters/NAME.py"}
