"""The page for users of the published code: its snippets run, on the published mesh."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs/from_the_paper.md").read_text(encoding="utf-8")


def test_snippets(field_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Measured: what the page prints; the ceiling's -2 V adds to the charge of E1."""
    monkeypatch.chdir(ROOT / "tests/data/published_meshes")
    monkeypatch.setenv("CAPSENSE_CACHE_DIR", str(field_cache))
    scope: dict = {}
    found = []
    for code in re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL):
        for block in re.split(r"^(print\(.*)$", code, flags=re.MULTILINE):
            if not block.startswith("print("):
                exec(block, scope)
                continue
            call, _, told = block.partition("# ")
            values = eval(call.strip().removeprefix("print"), scope)
            printed = [float(v) for v in re.findall(r"\d+\.\d", told)]
            np.testing.assert_allclose(values, printed, atol=0.051)
            found.append(printed)
    assert len(found) == 2
    assert scope["charges"].shape == (4,)
    assert scope["reading"].delta.shape == (4, 4)
    assert (np.diag(scope["reading"].delta)[:3] > 0).all()
