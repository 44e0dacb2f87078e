"""Every example in the reference page of designs loads."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

from capsense.design import LAYER_EPS_R, parse_design

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "designs.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```toml\n(.*?)```", PAGE, flags=re.DOTALL)


@pytest.mark.parametrize("text", EXAMPLES)
def test_example_loads(text: str, tmp_path: Path) -> None:
    """Examples are whole designs, items, or the keys of one electrode."""
    data: dict[str, Any] = tomllib.loads(text)
    if "shape" in data:
        data = {"electrode": [{"name": "E", **data}]}
    data.setdefault("name", "example")
    data.setdefault("domain", {"size": [0.5, 0.5, 0.5], "backplane": 0.1})
    if not {"electrode", "electrodes_from_stl"} & set(data):
        data["electrode"] = [{"name": "E", "shape": "disc", "radius": 0.01}]
    folder = ROOT / "tests" / "data" / "original_meshes"
    if data.get("electrode", [{}])[0].get("file") == "skin.stl":
        (tmp_path / "skin.stl").write_text("solid\nvertex 0 0 0\nvertex 9 0 0\nvertex 0 9 0\n")
        folder = tmp_path
    assert parse_design(data, folder=folder).electrodes


def test_page_lists_every_material() -> None:
    """The page names all materials that layers may have, with their permittivity."""
    listed = " ".join(PAGE.split()).lower()
    for name, eps_r in LAYER_EPS_R.items():
        assert re.search(rf"\b{re.escape(name)} \({eps_r:g}\)", listed), name
