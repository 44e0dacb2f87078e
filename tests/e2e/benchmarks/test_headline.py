"""The headline figures are taken from what the benchmarks really write: reduced runs of them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
from benchmark_modules import imported


@pytest.fixture(scope="module")
def headline() -> Iterator[ModuleType]:
    """The script."""
    with imported("headline") as found:
        yield found["headline"]


@pytest.mark.parametrize(
    ("part", "extra", "names"),
    [
        ("presets", ("--category", "ball grounded"), {"fast/rms", "standard/step", "fine/worst"}),
        ("near", ("--designs", "six_patch_bare", "--limit", "2"),
         {"six_patch_bare/fast/worst", "near/standard/rms", "near/fine/ratio"}),
        ("steps", ("--only", "finger at 15 mm", "--steps", "10", "--no-masked", "--no-set-up"),
         {"finger at 15 mm/fast/step", "finger at 15 mm/standard/off",
          "finger at 15 mm/unknowns"}),
    ],
)  # fmt: skip
def test_a_reduced_run(
    headline: ModuleType, part: str, extra: tuple[str, ...], names: set[str], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, field_cache: Path,
) -> None:  # fmt: skip
    """Every figure is a number with a unit; errors are of the size that the pages tell."""
    monkeypatch.setattr(headline, "OUT", tmp_path)
    monkeypatch.setenv("CAPSENSE_CACHE_DIR", str(field_cache))
    entry = headline.measure(part, again=True, extra=extra)
    figures = entry["figures"]
    assert names <= figures.keys()
    assert entry["code"] == headline.code()
    errors = [f["value"] for name, f in figures.items() if name.endswith(("rms", "worst"))]
    assert all(0.0 <= error < 40.0 for error in errors)
    assert any(error > 0.1 for error in errors) == (part != "steps")
    assert all(f["unit"] in ("%", "ms", "1") for f in figures.values())
