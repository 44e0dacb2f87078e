"""Background fields as files, and built ones found by the content of the design and the settings.

A file is an ``.npz`` archive followed by the SHA-256 of its bytes, so that whatever is read was
written by this module and is complete. ``meta`` inside it says what the file is and for which key.

A field is taken from the files that come with the package, else from the user's cache directory,
else it is built and put there. Nothing that happens to the cache keeps a field from being built.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
import os
import time
import uuid
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs
from filelock import FileLock, Timeout
from numpy.typing import NDArray

from capsense.design.model import Design
from capsense.errors import FieldError
from capsense.field.background import (
    NUMERICS,
    BackgroundField,
    BuildSettings,
    Progress,
    build_background,
    warn_of_signs,
)
from capsense.field.boundary import terminals
from capsense.field.green import TABLES, from_arrays, to_arrays

_log = logging.getLogger(__name__)

FORMAT = 5
"""Version of the stored form; part of the cache key."""

EVERY = 10.0
"""Seconds of a build between messages that tell how far it is."""

_DIGEST = hashlib.sha256().digest_size

Arrays = dict[str, NDArray[Any]]


# -- files ----------------------------------------------------------------------------------


def write_arrays(
    path: Path,
    arrays: Mapping[str, NDArray[Any]],
    meta: Mapping[str, Any],
    compression: int = zipfile.ZIP_STORED,
) -> None:
    """Write arrays and ``meta`` to a file that appears only when it is complete.

    Raises:
        OSError: The file could not be written; nothing is left behind.
        FieldError: An array holds a number that is not finite.
    """
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise FieldError(f"{name} is not finite; it is not stored in {path}")
    text = json.dumps({"format": FORMAT, **meta}).encode()
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as archive:
        for name, array in {"meta": np.frombuffer(text, dtype=np.uint8), **arrays}.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asanyarray(array), allow_pickle=False)
    content = buffer.getvalue()
    write_whole(path, content + hashlib.sha256(content).digest())


def write_whole(path: Path, content: bytes) -> None:
    """Put ``content`` at ``path`` in one step; no other process sees part of it."""
    part = path.with_name(f"{path.stem}.{uuid.uuid4().hex}.part")
    try:
        part.write_bytes(content)
        os.replace(part, path)
    except BaseException:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        raise


def parse_arrays(content: bytes, source: str, **expected: str) -> tuple[Arrays, dict[str, Any]]:
    """Return the arrays and the meta of what :func:`write_arrays` wrote.

    ``expected`` are entries of the meta, such as the key, that must have these values.

    Raises:
        FieldError: The content is damaged, of another format, or not what was expected.
    """
    body, digest = content[:-_DIGEST], content[-_DIGEST:]
    if hashlib.sha256(body).digest() != digest:
        raise FieldError(f"{source} is damaged, or not a file of this version")
    try:
        with np.load(io.BytesIO(body), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        meta = json.loads(arrays.pop("meta").tobytes())
    except (ValueError, KeyError, zipfile.BadZipFile, RuntimeError) as error:
        raise FieldError(f"{source} cannot be read: {error}") from error
    for name, value in {"format": FORMAT, **expected}.items():
        if meta.get(name) != value:
            raise FieldError(f"{source} has {name} {meta.get(name)!r}, expected {value!r}")
    return arrays, meta


def read_arrays(path: Path, **expected: str) -> tuple[Arrays, dict[str, Any]]:
    """Read a file of :func:`write_arrays`.

    Raises:
        FileNotFoundError: There is no such file.
        FieldError: The file is unreadable, damaged or not what was expected.
    """
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise
    except NotADirectoryError as error:
        raise FileNotFoundError(*error.args) from error
    except OSError as error:
        raise FieldError(f"{path} cannot be read: {error}") from error
    return parse_arrays(content, str(path), **expected)


# -- background fields ----------------------------------------------------------------------


def save_background(
    field: BackgroundField,
    path: Path,
    key: str = "",
    *,
    compact: bool = False,
    note: Mapping[str, Any] | None = None,
) -> None:
    """Write a field.

    Exactly: its tables are in single precision to begin with. ``compact`` packs harder, which takes
    longer. ``note`` is kept in the file's meta.

    Raises:
        OSError: The file could not be written; nothing is left behind.
        FieldError: The field is not finite.
    """
    arrays = {
        "capacitance": field.capacitance,
        **{
            f"green_{name}": _byte_planes(values.T) if name in TABLES else values
            for name, values in to_arrays(field.green).items()
        },
    }
    if not all(np.isfinite(values).all() for values in to_arrays(field.green).values()):
        raise FieldError(f"the field is not finite; it is not stored in {path}")
    meta = {
        **(note or {}),
        "kind": "field", "key": key, "terminals": field.terminals, "n_panels": field.n_panels,
    }  # fmt: skip
    write_arrays(path, arrays, meta, zipfile.ZIP_LZMA if compact else zipfile.ZIP_DEFLATED)


def load_background(path: Path, key: str = "") -> BackgroundField:
    """Read a field written by :func:`save_background` with the same key.

    Raises:
        FileNotFoundError: There is no such file.
        FieldError: The file is damaged, of another format version or for another key.
    """
    return to_background(*read_arrays(path, kind="field", key=key))


def to_background(arrays: Arrays, meta: Mapping[str, Any]) -> BackgroundField:
    """Put a field together from the content of its file."""
    green = {
        name.removeprefix("green_"): values
        for name, values in arrays.items()
        if name.startswith("green_")
    }
    green.update({name: _from_byte_planes(green[name]).T for name in TABLES})
    return BackgroundField(
        arrays["capacitance"], tuple(meta["terminals"]), int(meta["n_panels"]), from_arrays(green)
    )


def _byte_planes(values: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    """All first bytes, then all second bytes, and so on: exponents pack well, digits do not."""
    split = np.ascontiguousarray(values)[..., None].view(np.uint8)
    return np.ascontiguousarray(np.moveaxis(split, -1, 0))


def _from_byte_planes(planes: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Undo :func:`_byte_planes`; the number of planes is the size of a number."""
    split = np.ascontiguousarray(np.moveaxis(planes, 0, -1))
    return split.view(f"<f{len(planes)}")[..., 0].astype(np.float64)


# -- cache -----------------------------------------------------------------------------------


def cache_key(design: Design, settings: BuildSettings) -> str:
    """Hash of everything a background field depends on; the mesh of ``"fem_masked"`` is not of it.

    The content hash of a design leaves the order of shields and floating conductors out, but their
    columns of a field come in that order, so it enters here.
    """
    by_name = {c.name: c for c in design.conductors}
    extra = [name for name in terminals(design)[len(design.electrodes) :] if name in by_name]
    order = [
        Design("", design.domain, (), conductors=(by_name[name],)).content_hash() for name in extra
    ]
    parts = [FORMAT, NUMERICS, design.as_built.content_hash(), order, settings.panel_scale]
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
    return BuildSettings().refined(design.resolution)


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
            when nothing is built. Without one, a build that takes longer than :data:`EVERY` says so
            as a warning of the logger, and again after as much time.

    Warns:
        UserWarning: The panels are too coarse for the capacitances (:func:`warn_of_signs`).

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
    warn_of_signs(design, field.capacitance)
    return replace(field, terminals=tuple(terminals(design)))


def is_at_hand(key: str) -> bool:
    """Whether the field of a key comes with the package, or is in the user's cache."""
    return bool(_shipped(key, shipped_dir())) or (default_cache_dir() / f"{key}.npz").is_file()


def _shipped(key: str, folder: Traversable) -> list[Traversable]:
    """The files of a key among those that come with the package."""
    if not folder.is_dir():
        return []
    return [file for file in folder.iterdir() if file.name.endswith(f"-{key}.npz")]


def load_shipped(key: str, folder: Traversable | None = None) -> BackgroundField | None:
    """Return the field that comes with the package for a key, if there is one."""
    for file in _shipped(key, folder or shipped_dir()):
        try:
            return to_background(*parse_arrays(file.read_bytes(), str(file), kind="field", key=key))
        except (FieldError, OSError) as error:
            _log.warning("a field that came with the package is not used: %s", error)
    return None


def _wait_or_build(
    design: Design, settings: BuildSettings, folder: Path, key: str, progress: Progress | None
) -> BackgroundField:
    if progress is None:
        progress = _told_slowly(design.name)

    def waiting() -> None:
        progress("waiting for another process that builds the same field", 0.0)

    with exclusive(folder / f"{key}.lock", waiting) as locked:
        field = _cached(folder, key, warn=True)
        if field is None:
            if locked:
                _sweep(folder, key)
            field = build_background(design, settings, progress)
            _keep(field, folder, key)
        return field


def _told_slowly(name: str) -> Progress:
    """A progress callback that logs how far the field of a design is, every ten seconds."""
    started = told = time.monotonic()

    def tell(stage: str, fraction: float) -> None:
        nonlocal told
        now = time.monotonic()
        if now - told >= EVERY:
            told = now
            _log.warning(
                "building the field of %s, once: %s, %.0f %% done after %.0f s",
                name, stage, 100.0 * fraction, now - started,
            )  # fmt: skip

    return tell


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
