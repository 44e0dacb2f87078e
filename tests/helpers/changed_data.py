"""Copies of nested data with values replaced, for tests of files with one thing wrong."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

DROP = object()
"""In place of a value: remove the key."""


def changed_copy(base: Mapping[str, Any], *changes: tuple[str, Any]) -> dict[str, Any]:
    """Copy ``base`` with values replaced, dropped, or appended (``path.+``), at dotted paths."""
    data = copy.deepcopy(dict(base))
    for path, value in changes:
        *parents, last = path.split(".")
        node: Any = data
        for key in parents:
            node = node[int(key)] if key.isdigit() else node.setdefault(key, {})
        if value is DROP:
            del node[last]
        elif last == "+":
            node.append(value)
        else:
            node[int(last) if last.isdigit() else last] = value
    return data
