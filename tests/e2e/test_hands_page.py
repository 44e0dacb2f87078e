"""The section on hands from tracking data: its code runs, its defaults are those of the code."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import numpy as np
import pytest

from capsense.humans import HandFilter, OneEuroFilter
from capsense.humans.tracking import CONVENTIONS

ROOT = Path(__file__).parents[2]
SECTION = re.search(
    r"^## Hands from tracking data$(.*?)^## ",
    (ROOT / "docs" / "humans.md").read_text(encoding="utf-8"),
    flags=re.MULTILINE | re.DOTALL,
)


def test_the_code_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the end of the recording the hand is tracked, and has left the sensor."""
    assert SECTION is not None
    (code,) = re.findall(r"```python\n(.*?)```", SECTION[1], flags=re.DOTALL)
    monkeypatch.chdir(ROOT)
    scope: dict = {}
    exec(code, scope)
    assert scope["sample"].status == "tracked"
    assert 0 < np.diag(scope["reading"].delta).max() < 1e-15


def test_defaults() -> None:
    """Arguments as the page says them, and how many joints conventions have."""
    assert SECTION is not None
    for what in (HandFilter, OneEuroFilter):
        (given,) = re.findall(rf"`{what.__name__}\(([^`]*)\)`", SECTION[1])
        told = dict(re.findall(r"(\w+)=(\([^)]*\)|[\d.]+)", given))
        known = inspect.signature(what).parameters
        assert {k: eval(v) for k, v in told.items()} == {k: known[k].default for k in told}
        assert set(known) - {"smooth"} == set(told)
    for name, form in CONVENTIONS.items():
        assert re.search(rf'^\| `"{name}"` \| {form.count}[ ,:]', SECTION[1], flags=re.MULTILINE)
