"""Fields as files: written whole or not at all, damage is detected.

A file is an ``.npz`` archive followed by the SHA-256 of its bytes, so that whatever is read was
written by this module and is complete. ``meta`` inside it says what the file is and for which key.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import uuid
import zipfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capsense.errors import FieldError
from capsense.field.background import BackgroundField
from capsense.field.green import TABLES, from_arrays, to_arrays

FORMAT = 5
"""Version of the stored form; part of the cache key."""

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
