"""Fields that come with the package: current, small, and used."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_field import SETTINGS, digest, few_sources, tiny_design

from capsense.design import Design
from capsense.field import cache
from capsense.field.background import build_background
from capsense.field.boundary import BoundarySolution
from capsense.field.cache import cache_key, load_or_build


@pytest.fixture(scope="module")
def ship() -> Iterator[Any]:
    """The script that builds them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parents[3] / "benchmarks"))
        yield import_module("ship_fields")


@pytest.fixture
def only_tiny(ship: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[Design]:
    """A package with one design, the tiny one."""
    design = tiny_design()
    monkeypatch.setattr(ship, "available_designs", lambda: ("tiny",))
    monkeypatch.setattr(ship, "load_design", lambda name: design)
    monkeypatch.setattr(ship, "fingerprint", lambda: [1.0, 2.0e-12, *[1.0] * 9])
    with few_sources():
        yield design


def test_shipped_fields_are_current(ship: Any) -> None:
    if not any(ship.FOLDER.glob("*.npz")):
        pytest.skip(f"no fields are shipped; build them with: {ship.COMMAND}")
    wrong = "\n".join(ship.stale())
    assert not wrong, f"{wrong}\nmend with: {ship.COMMAND}"


def test_shipping(
    ship: Any, only_tiny: Design, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    folder, work = tmp_path / "shipped", tmp_path / "work"
    folder.mkdir()
    for old in (f"tiny-{'0' * 32}.npz", f"gone-{'1' * 32}.npz"):
        (folder / old).write_bytes(b"")
    caplog.set_level(logging.INFO)
    (made,) = ship.ship(["tiny"], folder, settings=SETTINGS, cache_dir=work)
    key = cache_key(only_tiny, SETTINGS)
    assert [p.name for p in folder.iterdir()] == [f"tiny-{key}.npz"]
    assert made.size == made.path.stat().st_size < 120_000
    assert f"tiny-{key}.npz" in caplog.text
    assert not work.exists()
    assert ship.stale(folder, SETTINGS) == []

    monkeypatch.setattr(cache, "shipped_dir", lambda: folder)
    used = []
    field = load_or_build(
        only_tiny, SETTINGS, cache_dir=tmp_path / "none", progress=lambda *a: used.append(a)
    )
    assert used == []
    assert not (tmp_path / "none").exists()
    exact = build_background(only_tiny, SETTINGS)
    assert digest(field) == digest(exact)


def test_what_is_stale_is_named(
    ship: Any, only_tiny: Design, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert ship.stale(tmp_path, SETTINGS) == ["tiny: not shipped"]
    (made,) = ship.ship(["tiny"], tmp_path, settings=SETTINGS, cache_dir=tmp_path / "work")
    with monkeypatch.context() as patch:
        patch.setattr(ship, "load_design", lambda name: tiny_design(electrode=[
            {"name": "A", "shape": "rectangle", "size": [0.02, 0.021]}
        ]))  # fmt: skip
        assert ship.stale(tmp_path, SETTINGS) == [
            "tiny: not shipped", f"{made.path.name}: of no packaged design"
        ]  # fmt: skip
    with monkeypatch.context() as patch:
        for other in ([1.0, 2.0001e-12, *[1.0] * 9], [1.0, 2e-12, 1.01, *[1.0] * 8], [1.0]):
            patch.setattr(ship, "fingerprint", lambda other=other: other)
            (line,) = ship.stale(tmp_path, SETTINGS)
            assert "raise NUMERICS" in line
        patch.setattr(ship, "fingerprint", lambda: [1.0, 2e-12, 1.0001, *[1.0] * 8])
        assert ship.stale(tmp_path, SETTINGS) == []
    with monkeypatch.context() as patch:
        patch.setattr(ship, "SIZE_LIMIT", 1000)
        (line,) = ship.stale(tmp_path, SETTINGS)
        assert "MB in total" in line
    made.path.write_bytes(made.path.read_bytes()[:-1])
    (line,) = ship.stale(tmp_path, SETTINGS)
    assert "damaged" in line


def test_a_damaged_shipped_field_is_reported_and_passed_over(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "tiny-key.npz").write_bytes(b"nonsense")
    assert cache.load_shipped("key", tmp_path) is None
    assert "tiny-key.npz" in caplog.text
    assert cache.load_shipped("other", tmp_path) is None
    assert cache.load_shipped("key", tmp_path / "none") is None


def test_the_fingerprint_sees_the_numerics(ship: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def shifted(name: str, part: float) -> object:
        return lambda *args: part * original(*args)

    with few_sources():
        first = np.array(ship.fingerprint())
        assert np.isfinite(first).all()
        for name, part, tolerance in (
            ("terminal_charges", 1.0001, 1e-5), ("_potentials", 1.01, 1e-3),
        ):  # fmt: skip
            with monkeypatch.context() as patch:
                original = getattr(BoundarySolution, name)
                patch.setattr(BoundarySolution, name, shifted(name, part))
                now = np.array(ship.fingerprint())
            assert not np.allclose(first, now, rtol=tolerance, atol=0.0), name
