"""The troubleshooting page quotes messages that the package really gives."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

import capsense

PAGE = Path(__file__).parents[2] / "docs" / "troubleshooting.md"
QUOTED = re.findall(r"^### ([a-z].*)$", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
MESSAGES = [
    node.value
    for path in Path(capsense.__file__).parent.rglob("*.py")
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    if isinstance(node, ast.Constant) and isinstance(node.value, str)
]


@pytest.mark.parametrize("words", QUOTED)
def test_message_is_in_the_sources(words: str) -> None:
    assert any(words in message for message in MESSAGES)
