"""Built background fields, found by the content of the design and the settings.

A field is taken from the files that come with the package, else from the user's cache directory,
else it is built and put there. Nothing that happens to the cache keeps a field from being built.
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path

import platformdirs
from filelock import FileLock, Timeout

from capsense.design.model import Design
from capsense.errors import FieldError
from capsense.field.background import (
    NUMERICS,
    BackgroundField,
    BuildSettings,
    build_background,
)
from capsense.field.boundary import terminals
from capsense.field.store import (
    FORMAT,
    load_background,
    parse_arrays,
    save_background,
    to_background,
)

_log = logging.getLogger(__name__)

Progress = Callable[[str, float], None]


def cache_key(design: Design, settings: BuildSettings) -> str:
    """Hash of everything a background field depends on; the mesh of ``"fem_masked"`` is not of it.

    The content hash of a design leaves the order of shields and floating conductors out, but their
    columns of a field come in that order, so it enters here.
    """
    extra = terminals(design)[len(design.electrodes) :]
    by_name = {c.name: c for c in design.conductors}
    order = [
        Design("", design.domain, (), conductors=(by_name[name],)).content_hash() for name in extra
    ]
    parts = [FORMAT, NUMERICS, design.content_hash(), order, settings.panel_scale]
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:32]


def default_cache_dir() -> Path:
    """The user's cache directory, or ``CAPSENSE_CACHE_DIR``."""
    chosen = os.environ.get("CAPSENSE_CACHE_DIR")
    return Path(chosen).expanduser() if chosen else Path(platformdirs.user_cache_dir("capsense"))


def shipped_dir() -> Traversable:
    """Where the fields that come with the package lie."""
    return resources.files("capsense.field") / "shipped"


def default_settings(design: Design) -> BuildSettings:
    """Settings that a design's ``[build]`` table asks for."""
    return BuildSettings().refined(float(design.build.get("resolution", 1.0)))


def load_or_build(
    design: Design,
    settings: BuildSettings | None = None,
    *,
    cache_dir: str | Path | None = None,
    shipped: bool = True,
    progress: Progress | None = None,
) -> BackgroundField:
    """Return a design's background field: shipped, from the cache, or built and cached.

    While another process builds the same field, this one waits for it. A cache that is damaged or
    cannot be written is reported by a warning of the logger ``capsense.field.cache``, and the field
    is built.

    Args:
        design: The design.
        settings: Numerical settings; default from the design's ``[build]`` table.
        cache_dir: Where built fields are kept; default :func:`default_cache_dir`.
        shipped: Whether to look among the fields that come with the package.
        progress: Called with a stage's name and the fraction done, which never falls; not called
            when nothing is built.

    Raises:
        FieldError: The field could not be built.
    """
    settings = settings or default_settings(design)
    folder = default_cache_dir() if cache_dir is None else Path(cache_dir)
    key = cache_key(design, settings)
    field = load_shipped(key) if shipped else None
    if field is None:
        field = _cached(folder, key, warn=False)
    if field is None:
        field = _wait_or_build(design, settings, folder, key, progress)
    return replace(field, terminals=tuple(terminals(design)))


def load_shipped(key: str, folder: Traversable | None = None) -> BackgroundField | None:
    """Return the field that comes with the package for a key, if there is one."""
    folder = folder or shipped_dir()
    if folder.is_dir():
        for file in folder.iterdir():
            if file.name.endswith(f"-{key}.npz"):
                try:
                    return to_background(
                        *parse_arrays(file.read_bytes(), str(file), kind="field", key=key)
                    )
                except (FieldError, OSError) as error:
                    _log.warning("a field that came with the package is not used: %s", error)
    return None


def _wait_or_build(
    design: Design, settings: BuildSettings, folder: Path, key: str, progress: Progress | None
) -> BackgroundField:
    def waiting() -> None:
        if progress is not None:
            progress("waiting for another process that builds the same field", 0.0)

    with exclusive(folder / f"{key}.lock", waiting) as locked:
        field = _cached(folder, key, warn=True)
        if field is None:
            if locked:
                _sweep(folder, key)
            field = build_background(design, settings, progress)
            _keep(field, folder, key)
        return field


def _cached(folder: Path, key: str, *, warn: bool) -> BackgroundField | None:
    try:
        return load_background(folder / f"{key}.npz", key)
    except FileNotFoundError:
        return None
    except FieldError as error:
        if warn:
            _log.warning("a cached field is not used, it is built again: %s", error)
        return None


def _keep(field: BackgroundField, folder: Path, key: str) -> None:
    """Put a field into the cache, if that can be done."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        save_background(field, folder / f"{key}.npz", key)
    except OSError as error:
        _log.warning(
            "the field was built but cannot be kept in %s (%s), so the next start builds it again; "
            "make room there, allow writing, or set CAPSENSE_CACHE_DIR to another folder",
            folder,
            error,
        )


def _sweep(folder: Path, key: str) -> None:
    """Remove the unfinished files of processes that were killed while they wrote."""
    with suppress(OSError):
        for part in folder.glob(f"{key}*.part"):
            part.unlink(missing_ok=True)


_POLL = 0.1
"""Time between two attempts to take a lock [s]."""


@contextmanager
def exclusive(path: Path, waiting: Callable[[], None] = lambda: None) -> Iterator[bool]:
    """Hold the lock ``path``; ``waiting`` is called now and then while somebody else holds it.

    Yields whether it is held: where files cannot be locked or written, work goes on without. The
    file is removed in the end.
    """
    lock = FileLock(path)
    held = _acquire(lock, path, waiting)
    try:
        yield held
    finally:
        if held:
            with suppress(OSError):
                path.unlink()  # before others can have it; those who wait see that it is gone
            with suppress(OSError):
                lock.release()


def _acquire(lock: FileLock, path: Path, waiting: Callable[[], None]) -> bool:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        while True:
            try:
                lock.acquire(timeout=_POLL, poll_interval=_POLL)
                return True
            except Timeout:
                waiting()
    except OSError as error:
        _log.info("builds of the same field are not kept apart: %s", error)
        return False
