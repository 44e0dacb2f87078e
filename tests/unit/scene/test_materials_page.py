"""The page on materials has the packaged materials, as ``materials.toml`` has them."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from benchmark_modules import imported

from capsense.scene.materials import DATA, MATERIALS

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "materials.md").read_text(encoding="utf-8")


def test_the_page_is_up_to_date() -> None:
    write = "run python benchmarks/materials.py --write docs/materials.md"
    with imported("materials", "pages") as found:
        materials = found["materials"]
        assert found["pages"].replaced(PAGE, materials.MARKERS, materials.table()) == PAGE, write


@pytest.mark.parametrize("name", MATERIALS)
def test_a_row_has_the_numbers_of_the_file(name: str) -> None:
    """Read back from the text of the page, not by the script that wrote it."""
    (row,) = re.findall(rf"^\| {re.escape(name)} \| (.*) \|$", PAGE, flags=re.MULTILINE)
    eps_r, sigma, source = row.split(" | ")
    given = DATA["materials"][name]
    assert float(eps_r) == given["eps_r"]
    assert float(sigma.replace("–", "0")) == given.get("sigma", 0.0)
    (conductors, lost) = re.findall(
        r"^Conductors at 250 kHz: (.*); at 1 MHz not: (.*)\.$", PAGE, re.M
    )[0]
    assert (name in conductors.split(", ")) == MATERIALS[name].is_conductor()
    only_below = MATERIALS[name].is_conductor() and not MATERIALS[name].is_conductor(1e6)
    assert (name in lost.split(", ")) == only_below
    assert MATERIALS[name].source == given["source"] == source != ""
