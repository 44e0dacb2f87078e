"""Fields as files: exact, whole, and never silently wrong."""

from __future__ import annotations

import errno
import logging
import os
import warnings
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_field import SETTINGS, arrays, digest, tiny_design

from capsense.errors import FieldError
from capsense.field import cache
from capsense.field.background import BackgroundField
from capsense.field.cache import (
    cache_key,
    exclusive,
    load_background,
    load_or_build,
    read_arrays,
    save_background,
    write_arrays,
)


def test_a_field_comes_back_to_the_last_bit(built: BackgroundField, tmp_path: Path) -> None:
    save_background(built, tmp_path / "a.npz", "key")
    back = load_background(tmp_path / "a.npz", "key")
    assert digest(back) == digest(built)
    assert (back.terminals, back.n_panels) == (built.terminals, built.n_panels)
    for name, array in arrays(back).items():
        assert array.flags.c_contiguous or name.endswith("gap_change"), name
    assert os.listdir(tmp_path) == ["a.npz"]


def test_a_compact_field_is_the_same_and_smaller(built: BackgroundField, tmp_path: Path) -> None:
    save_background(built, tmp_path / "exact.npz", "key")
    save_background(built, tmp_path / "compact.npz", "key", compact=True)
    back = load_background(tmp_path / "compact.npz", "key")
    assert digest(back) == digest(built)
    sizes = [(tmp_path / f"{name}.npz").stat().st_size for name in ("compact", "exact")]
    assert sizes[0] < 0.95 * sizes[1]  # measured: 0.93


def test_numpy_reads_the_file(built: BackgroundField, tmp_path: Path) -> None:
    save_background(built, tmp_path / "a.npz", "key")
    with np.load(tmp_path / "a.npz") as archive:
        assert np.array_equal(archive["capacitance"], built.capacitance)


def test_every_damaged_byte_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    write_arrays(path, {"values": np.arange(5.0)}, {"kind": "test", "key": "k"})
    good = path.read_bytes()
    assert np.array_equal(read_arrays(path, kind="test", key="k")[0]["values"], np.arange(5.0))
    for position in range(len(good)):
        path.write_bytes(good[:position] + bytes([good[position] ^ 4]) + good[position + 1 :])
        with pytest.raises(FieldError, match="damaged"):
            read_arrays(path, kind="test", key="k")
    for length in (0, 1, 31, 32, 33, len(good) // 2, len(good) - 1):
        path.write_bytes(good[:length])
        with pytest.raises(FieldError, match="damaged"):
            read_arrays(path, kind="test", key="k")


def test_files_of_others_are_refused(
    built: BackgroundField, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.npz"
    save_background(built, path, "one key")
    with pytest.raises(FieldError, match="has key 'one key', expected 'another'"):
        load_background(path, "another")
    with pytest.raises(FieldError, match="has kind 'field', expected 'charges'"):
        read_arrays(path, kind="charges", key="one key")
    monkeypatch.setattr(cache, "FORMAT", cache.FORMAT + 1)
    with pytest.raises(FieldError, match="has format"):
        load_background(path, "one key")
    np.savez(path, x=np.zeros(3))
    with pytest.raises(FieldError, match="not a file of this version"):
        load_background(path, "one key")
    with pytest.raises(FileNotFoundError):
        load_background(tmp_path / "none.npz", "one key")
    with pytest.raises(FieldError, match="cannot be read"):
        load_background(tmp_path, "one key")


@pytest.mark.parametrize("name", ["capacitance", "near_sources", "near_modes", "far_phi"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_not_finite_is_never_stored(
    built: BackgroundField, tmp_path: Path, name: str, value: float
) -> None:
    part = built if name == "capacitance" else built.green
    bad = getattr(part, name).copy()
    bad.flat[1] = value
    wrong = replace(part, **{name: bad})
    if name != "capacitance":
        wrong = replace(built, green=wrong)
    for compact in (False, True):
        with pytest.raises(FieldError, match="not finite"):
            save_background(wrong, tmp_path / "a.npz", compact=compact)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("stage", ["write", "rename"])
@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "full"), KeyboardInterrupt()])
def test_a_failed_write_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stage: str, error: BaseException
) -> None:
    path = tmp_path / "a.npz"
    write_arrays(path, {"values": np.zeros(3)}, {"kind": "old"})

    def half(self: Path, content: bytes) -> int:
        with open(self, "wb") as stream:
            stream.write(content[: len(content) // 2])
        raise error

    def refuse(*_: object) -> None:
        raise error

    if stage == "write":
        monkeypatch.setattr(Path, "write_bytes", half)
    else:
        monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(type(error)):
        write_arrays(path, {"values": np.ones(3)}, {"kind": "new"})
    monkeypatch.undo()
    assert os.listdir(tmp_path) == ["a.npz"]
    assert not read_arrays(path, kind="old")[0]["values"].any()


@pytest.mark.parametrize(("every", "told"), [(0.0, True), (1e6, False)])
def test_a_long_build_says_how_far_it_is(
    built: BackgroundField,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    every: float,
    told: bool,
) -> None:
    """Who gives no ``progress`` hears of builds that take long, and of no others."""

    def build(_: object, __: object, progress: cache.Progress) -> BackgroundField:
        progress("panels", 0.25)
        return built

    monkeypatch.setattr(cache, "build_background", build)
    monkeypatch.setattr(cache, "EVERY", every)
    load_or_build(tiny_design(), SETTINGS, cache_dir=tmp_path)
    name = tiny_design().name
    wanted = [f"building the field of {name}, once: panels, 25 % done after 0 s"] * told
    assert [record.getMessage() for record in caplog.records] == wanted


@pytest.mark.parametrize("mended", [False, True])
def test_an_unusable_field_is_told_once_by_who_builds_it_again(
    built: BackgroundField,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    mended: bool,
) -> None:
    """Invariant: one warning, and none where another process has built it meanwhile."""
    monkeypatch.setattr(cache, "build_background", lambda *_: built)
    key = cache_key(tiny_design(), SETTINGS)
    path = tmp_path / f"{key}.npz"
    path.write_bytes(b"not a field")
    with ExitStack() as other:
        other.enter_context(exclusive(tmp_path / f"{key}.lock"))
        waits: list[int] = []

        def waiting(*_: object) -> None:
            """While this process waits for the other, which ends then."""
            waits.append(len(caplog.records))
            if mended:
                save_background(built, path, key)
            other.close()

        field = load_or_build(tiny_design(), SETTINGS, cache_dir=tmp_path, progress=waiting)
    assert waits == [0]
    assert digest(field) == digest(built)
    assert [r.levelno for r in caplog.records] == ([] if mended else [logging.WARNING])
    assert digest(load_background(path, key)) == digest(built)


@pytest.mark.parametrize(
    ("mutual", "told"), [(-0.2, False), (-1e-9, False), (5e-5, False), (2e-4, True), (0.2, True)]
)
def test_a_mutual_capacitance_of_the_wrong_sign_is_warned_of(
    built: BackgroundField, tmp_path: Path, mutual: float, told: bool
) -> None:
    """Invariant: it may not be positive in a Maxwell matrix, but for rounding; the warning names
    conductors, size and fix, also where the field comes from the cache."""
    design, own = tiny_design(), np.sqrt(built.capacitance.diagonal())
    capacitance = built.capacitance.copy()
    capacitance[0, 1] = capacitance[1, 0] = mutual * own[0] * own[1]
    field = replace(built, capacitance=capacitance)
    key = cache_key(design, SETTINGS)
    save_background(field, tmp_path / f"{key}.npz", key)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        load_or_build(design, SETTINGS, cache_dir=tmp_path)
    assert len(found) == told
    if told:
        text = str(found[0].message)
        size = f"{1e12 * capacitance[0, 1]:.2g} pF"
        for part in ("A and B", size, "[build] resolution above 1", "--tolerance 1%"):
            assert part in text
