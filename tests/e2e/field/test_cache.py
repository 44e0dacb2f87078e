"""The cache of fields: found by content, built once, and never in the way."""

from __future__ import annotations

import errno
import logging
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny_field
from tiny_field import FIT, SETTINGS, digest, few_sources, tiny_data, tiny_design

from capsense.design import parse_design
from capsense.field import background, cache
from capsense.field.background import BackgroundField, BuildSettings, MeshSettings
from capsense.field.boundary import BoundarySolution
from capsense.field.cache import (
    cache_key,
    default_cache_dir,
    default_settings,
    exclusive,
    load_or_build,
    read_arrays,
    write_arrays,
)

DENSE = "boundary elements: factorising"
KEY = cache_key(tiny_design(), SETTINGS)


@pytest.fixture(scope="module", autouse=True)
def rough() -> Iterator[None]:
    """What is in a field does not matter here, so that it is built quickly."""
    with few_sources():
        yield


@pytest.fixture(scope="module")
def tiny() -> BackgroundField:
    """The field built without a cache."""
    return background.build_background(tiny_design(), SETTINGS)


@pytest.fixture(scope="module")
def reference(tiny: BackgroundField) -> str:
    """Its digest."""
    return digest(tiny)


@pytest.fixture
def no_wait(tiny: BackgroundField, monkeypatch: pytest.MonkeyPatch) -> None:
    """Builds of the tiny field take no time: what they return has been built before."""
    monkeypatch.setattr(cache, "build_background", lambda *_: tiny)


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache that holds the tiny field; not to be written to."""
    folder = tmp_path_factory.mktemp("filled")
    load_or_build(tiny_design(), SETTINGS, cache_dir=folder)
    return folder


class Stages(list[tuple[str, float]]):
    """Records progress; raises ``error`` at the ``at``-th call of a stage."""

    def __init__(self, stage: str = "", at: int = 0, error: BaseException | None = None) -> None:
        super().__init__()
        self._stop, self._error = (stage, at), error

    def __call__(self, stage: str, fraction: float) -> None:
        self.append((stage, fraction))
        if self._error is not None and (stage, self.count(stage)) == self._stop:
            raise self._error

    def count(self, stage: object) -> int:
        return sum(name == stage for name, _ in self)


def files(folder: Path) -> list[str]:
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*"))


# -- key ------------------------------------------------------------------------------------


def _electrode(index: int, **changes: Any) -> dict[str, Any]:
    items = tiny_data()["electrode"]
    items[index] = {**items[index], **changes}
    return {"electrode": items}


PLATE = {"name": "plate", "eps_r": 3.0, "size": [0.06, 0.04], "z": [-0.002, 0.0]}
BACK = {
    "name": "back", "role": "shield", "shape": "rectangle", "size": [0.05, 0.03], "z": -0.004,
}  # fmt: skip


@pytest.mark.parametrize(
    "changes",
    [
        _electrode(0, size=[0.020001, 0.02]),
        _electrode(0, center=[-0.015, 0.000001]),
        _electrode(1, radius=0.0101),
        _electrode(1, center=[0.015, 0.0, 0.001]),
        {"electrode": tiny_data()["electrode"][::-1]},
        {"electrode": tiny_data()["electrode"][:1]},
        {"domain": {"size": [0.1, 0.1, 0.101], "backplane": 0.01}},
        {"domain": {"size": [0.1, 0.1, 0.1], "backplane": 0.011}},
        {"layer": [PLATE]},
        {"layer": [{**PLATE, "eps_r": 3.1}]},
        {"layer": [{**PLATE, "z": [-0.003, 0.0]}]},
        {"conductor": [BACK]},
        {"conductor": [{**BACK, "role": "floating"}]},
        {"conductor": [{**BACK, "role": "ground"}]},
        {"conductor": [{**BACK, "z": -0.005}]},
    ],
)
def test_every_change_of_the_sensor_changes_the_key(changes: dict[str, Any]) -> None:
    seen = {cache_key(tiny_design(**c), SETTINGS) for c in ({}, {"layer": [PLATE]}, changes)}
    expected = 2 if changes == {"layer": [PLATE]} else 3
    assert len(seen) == expected


def test_names_and_descriptions_do_not_change_the_key() -> None:
    renamed = tiny_data(name="other", description="x")
    renamed["electrode"][0]["name"] = "Z"
    assert cache_key(parse_design(renamed), SETTINGS) == KEY


@pytest.mark.parametrize("settings", [BuildSettings(), replace(SETTINGS, panel_scale=8.1)])
def test_settings_change_the_key(settings: BuildSettings) -> None:
    assert cache_key(tiny_design(), settings) != KEY


def test_the_mesh_of_the_masked_scheme_does_not_change_the_key() -> None:
    other = replace(SETTINGS, mesh=MeshSettings(edge=1e-3))
    assert cache_key(tiny_design(), other) == KEY


@pytest.mark.parametrize("resolution", [0.5, 1.0, 2.0])
def test_resolution_refines_panels_and_mesh(resolution: float) -> None:
    chosen = default_settings(tiny_design(build={"resolution": resolution}))
    assert chosen.panel_scale == 1 / resolution
    assert chosen.mesh == MeshSettings().refined(resolution)
    if resolution == 1.0:
        assert chosen == BuildSettings()


@pytest.mark.parametrize("name", ["FORMAT", "NUMERICS"])
def test_versions_change_the_key(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, name, getattr(cache, name) + 1)
    assert cache_key(tiny_design(), SETTINGS) != KEY


def test_the_order_of_shields_changes_the_key() -> None:
    """Columns of a field come in the order of the conductors in the file."""
    other = {**BACK, "name": "front", "size": [0.01, 0.01], "z": 0.005}
    one, two = (tiny_design(conductor=c) for c in ([BACK, other], [other, BACK]))
    assert one.content_hash() == two.content_hash()
    assert cache_key(one, SETTINGS) != cache_key(two, SETTINGS)


# -- build and load ---------------------------------------------------------------------------


def test_build_then_load(tmp_path: Path, reference: str) -> None:
    stages = Stages()
    folder = tmp_path / "not" / "there yet"
    built = load_or_build(tiny_design(), SETTINGS, cache_dir=folder, progress=stages)
    assert digest(built) == reference
    fractions = [fraction for _, fraction in stages]
    assert fractions == sorted(fractions)
    assert fractions[0] == 0.0
    assert fractions[-1] == 1.0
    assert stages.count(DENSE) == 1
    assert stages.count(FIT) == 1
    assert files(folder) == [f"{KEY}.npz"]
    again = Stages()
    loaded = load_or_build(tiny_design(), SETTINGS, cache_dir=str(folder), progress=again)
    assert digest(loaded) == reference
    assert again == []


def test_terminals_have_the_names_of_the_design_at_hand(filled: Path) -> None:
    renamed = tiny_data(name="other")
    renamed["electrode"][0]["name"] = "Z"
    stages = Stages()
    field = load_or_build(parse_design(renamed), SETTINGS, cache_dir=filled, progress=stages)
    assert stages == []
    assert field.terminals == ("Z", "B")


def test_where_fields_live(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, filled: Path) -> None:
    monkeypatch.setenv("CAPSENSE_CACHE_DIR", str(filled))
    assert default_cache_dir() == filled
    stages = Stages()
    load_or_build(tiny_design(), SETTINGS, progress=stages)
    assert stages == []
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("CAPSENSE_CACHE_DIR", "~/fields")
    assert default_cache_dir() == tmp_path / "fields"
    monkeypatch.setenv("CAPSENSE_CACHE_DIR", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    if sys.platform == "linux":
        assert default_cache_dir() == tmp_path / "xdg" / "capsense"


def _flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def _foreign(path: Path) -> None:
    arrays, meta = read_arrays(path)
    write_arrays(path, arrays, {**meta, "key": "0" * 32})


@pytest.mark.parametrize(
    "harm",
    [
        _flip,
        _foreign,
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(path.read_bytes()[:-100]),
        lambda path: np.savez(path, x=np.zeros(3)),
    ],
    ids=["flipped bit", "other key", "empty", "cut off", "old format"],
)
def test_a_bad_file_is_reported_and_replaced(
    harm: Callable[[Path], None],
    filled: Path,
    tmp_path: Path,
    reference: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    path = tmp_path / f"{KEY}.npz"
    shutil.copy(filled / path.name, path)
    harm(path)
    field = load_or_build(tiny_design(), SETTINGS, cache_dir=tmp_path)
    assert digest(field) == reference
    assert [r.levelname for r in caplog.records] == ["WARNING"]
    assert str(path) in caplog.text
    caplog.clear()
    stages = Stages()
    load_or_build(tiny_design(), SETTINGS, cache_dir=tmp_path, progress=stages)
    assert stages == []
    assert not caplog.records


def test_a_field_that_is_not_finite_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def bad(self: BoundarySolution, densities: np.ndarray) -> np.ndarray:
        return np.full((2, 2), np.nan)

    monkeypatch.setattr(BoundarySolution, "terminal_charges", bad)
    with pytest.raises(background.FieldError, match="design 'tiny' is not finite"):
        load_or_build(tiny_design(), SETTINGS, cache_dir=tmp_path)
    assert files(tmp_path) == []


# -- interrupted builds ---------------------------------------------------------------------


@pytest.mark.parametrize("stage", [DENSE, FIT, "done"])
def test_an_interrupted_build_leaves_nothing(stage: str, tmp_path: Path, reference: str) -> None:
    with pytest.raises(KeyboardInterrupt):
        load_or_build(
            tiny_design(), SETTINGS, cache_dir=tmp_path,
            progress=Stages(stage, 1, KeyboardInterrupt()),
        )  # fmt: skip
    assert files(tmp_path) == []
    field = load_or_build(tiny_design(), SETTINGS, cache_dir=tmp_path)
    assert digest(field) == reference
    assert files(tmp_path) == [f"{KEY}.npz"]


# -- processes and threads --------------------------------------------------------------------


def _start(folder: Path, log: Path, delay: float, *prefix: str) -> subprocess.Popen[str]:
    command = [*prefix, sys.executable, tiny_field.__file__, str(folder), str(log), str(delay)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def _wait_for(log: Path, text: str, count: int = 1, limit: float = 120.0) -> None:
    end = time.monotonic() + limit
    while not (log.exists() and log.read_text().count(text) >= count):
        assert time.monotonic() < end, f"no {text!r} in {limit} s"
        time.sleep(0.02)


def test_two_processes_build_once(tmp_path: Path, reference: str) -> None:
    log = tmp_path / "log"
    processes = [_start(tmp_path / "cache", log, 1.0) for _ in range(2)]
    for process in processes:
        out, err = process.communicate(timeout=120)
        assert process.returncode == 0, err
        assert out.strip() == reference
    assert log.read_text().count(DENSE) == 1
    assert files(tmp_path / "cache") == [f"{KEY}.npz"]


def test_a_killed_builder_frees_the_lock(tmp_path: Path, reference: str) -> None:
    log = tmp_path / "log"
    builder = _start(tmp_path, log, 60.0)
    _wait_for(log, f"{builder.pid} {FIT}")
    builder.send_signal(signal.SIGSTOP)  # on a busy machine it would end before the other begins
    waiter = _start(tmp_path, log, 0.0)
    _wait_for(log, f"{waiter.pid} waiting for another process")
    builder.send_signal(signal.SIGKILL)
    builder.communicate(timeout=60)
    out, err = waiter.communicate(timeout=120)
    assert waiter.returncode == 0, err
    assert out.strip() == reference
    lines = log.read_text().splitlines()
    assert sum(line == f"{waiter.pid} {DENSE}" for line in lines) == 1
    assert files(tmp_path) == [f"{KEY}.npz", "log"]


def test_ctrl_c_ends_a_build_at_once(tmp_path: Path) -> None:
    log = tmp_path / "log"
    folder = tmp_path / "cache"
    builder = _start(folder, log, 60.0)
    _wait_for(log, FIT)
    builder.send_signal(signal.SIGINT)
    _, err = builder.communicate(timeout=120)
    assert log.read_text().splitlines()[-1].endswith(FIT)
    assert builder.returncode != 0
    assert "KeyboardInterrupt" in err
    assert files(folder) == []


def test_threads_build_once(tmp_path: Path, reference: str) -> None:
    found, stages = [], Stages()

    def work() -> None:
        field = load_or_build(tiny_design(), SETTINGS, cache_dir=tmp_path, progress=stages)
        found.append(digest(field))

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=120)
    assert found == [reference] * 4
    assert stages.count(DENSE) == 1
    assert files(tmp_path) == [f"{KEY}.npz"]


def test_what_a_killed_process_was_writing_is_removed(tmp_path: Path) -> None:
    (tmp_path / f"{KEY}.0123.part").write_bytes(b"half a file")
    (tmp_path / "somebody_else.part").write_bytes(b"")
    load_or_build(tiny_design(), SETTINGS, cache_dir=tmp_path)
    assert files(tmp_path) == [f"{KEY}.npz", "somebody_else.part"]


def test_the_lock_excludes_also_where_its_file_is_removed_meanwhile(tmp_path: Path) -> None:
    inside, most = 0, 0

    def work() -> None:
        nonlocal inside, most
        for _ in range(15):
            with exclusive(tmp_path / "a.lock") as held:
                assert held
                inside += 1
                most = max(most, inside)
                time.sleep(0.001)
                inside -= 1

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cache, "_POLL", 0.0005)
        threads = [threading.Thread(target=work) for _ in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(timeout=60)
    assert most == 1
    assert files(tmp_path) == []


def test_without_locks_a_field_is_built_all_the_same(
    tmp_path: Path, reference: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.ENOLCK, "no locks available")

    monkeypatch.setattr(cache.FileLock, "acquire", refuse)
    assert digest(load_or_build(tiny_design(), SETTINGS, cache_dir=tmp_path)) == reference
    assert (tmp_path / f"{KEY}.npz").exists()


# -- a cache that cannot be used ----------------------------------------------------------------


def _one_warning(caplog: pytest.LogCaptureFixture, folder: Path) -> None:
    warnings = [r for r in caplog.records if r.levelno >= logging.WARNING]
    assert len(warnings) == 1
    text = warnings[0].getMessage()
    assert str(folder) in text
    assert "CAPSENSE_CACHE_DIR" in text


@pytest.mark.usefixtures("no_wait")
@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS, errno.EACCES, errno.EDQUOT])
@pytest.mark.parametrize("call", ["write", "rename", "mkdir"])
def test_a_field_that_cannot_be_kept_is_built_and_returned(
    call: str,
    code: int,
    tmp_path: Path,
    reference: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(code, os.strerror(code))

    folder = tmp_path / "cache"
    if call == "write":
        monkeypatch.setattr(Path, "write_bytes", refuse)
    elif call == "rename":
        monkeypatch.setattr(os, "replace", refuse)
    else:
        monkeypatch.setattr(Path, "mkdir", refuse)
    field = load_or_build(tiny_design(), SETTINGS, cache_dir=folder)
    assert digest(field) == reference
    _one_warning(caplog, folder)
    assert os.strerror(code) in caplog.text
    assert files(tmp_path) in ([], ["cache"])


@pytest.mark.usefixtures("no_wait")
@pytest.mark.parametrize("place", ["below a file", "read-only"])
def test_a_folder_that_cannot_be_written(
    place: str, tmp_path: Path, reference: str, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "cache"
    if place == "below a file":
        folder.write_text("")
        folder = folder / "fields"
    else:
        folder.mkdir(mode=0o555)
        if os.access(folder, os.W_OK):
            pytest.skip("this user may write anywhere")
    assert digest(load_or_build(tiny_design(), SETTINGS, cache_dir=folder)) == reference
    _one_warning(caplog, folder)


@pytest.mark.parametrize(
    ("options", "error"),
    [("size=8k", "No space left on device"), ("ro", "Read-only file system")],
)
def test_a_real_file_system_that_is_full_or_read_only(
    options: str, error: str, tmp_path: Path, reference: str
) -> None:
    """On a small tmpfs in a mount namespace of its own, where that is allowed."""
    folder = tmp_path / "cache"
    folder.mkdir()
    script = 'mount -t tmpfs -o "$1" none "$2" || exit 77; shift 2; "$@"; s=$?; ls -A "$3"; exit $s'
    prefix = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", script, "sh"]
    try:
        process = _start(folder, tmp_path / "log", 0.0, *prefix, options, str(folder))
    except FileNotFoundError:
        pytest.skip("there is no unshare")
    out, err = process.communicate(timeout=120)
    if process.returncode == 77 or "unshare" in err:
        pytest.skip(f"mounting is not allowed: {err.strip()}")
    assert process.returncode == 0, err
    assert out.split() == [reference]
    assert err.count("cannot be kept") == 1
    assert error in err
    assert str(folder) in err
