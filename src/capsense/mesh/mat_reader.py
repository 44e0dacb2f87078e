"""Read arrays of numbers, and cells of them, from MATLAB's files of version 5 (``-v6``, ``-v7``).

SciPy's reader is not used: a damaged file may end the process there.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capsense.errors import MeshError

Numbers = NDArray[Any]

_HEAD = 128
_TYPES = {
    1: "<i1", 2: "<u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 9: "<f8", 12: "<i8",
    13: "<u8",
}  # fmt: skip
_MATRIX, _COMPRESSED = 14, 15
_CELLS, _NUMBERS = 1, range(6, 16)
"""Classes of arrays."""
_MOST = 1_000_000_000
"""A compressed array may become so large [bytes]: small files may hold very large ones."""


def parse_mat(content: bytes) -> dict[str, Numbers | list[Numbers]]:
    """Arrays of numbers by name, those of cells as lists; what is neither is left out.

    After *MAT-File Format*, MathWorks, version R2024a.

    Raises:
        MeshError: The file is of another version, damaged, or inflates beyond 1 GB.
    """
    if content[124:128] != b"\x00\x01IM":
        raise MeshError("it is no MAT-file of version 5, little-endian; save it with '-v7'")
    found = {}
    for kind, data in _elements(memoryview(content)[_HEAD:]):
        if kind == _COMPRESSED:
            kind, data = next(_elements(_inflated(data)), (0, data))
        if kind == _MATRIX:
            name, value = _matrix(data)
            if value is not None:
                found[name] = value
    return found


def _elements(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Type and content of the elements in a row."""
    at = 0
    while at < len(data):
        kind, size = struct.unpack_from("<II", data, at)
        start = at + 8
        after = start + size if kind == _COMPRESSED else start + -(-size // 8) * 8
        if kind >> 16:  # up to four bytes, packed with their type
            kind, size, start, after = kind & 0xFFFF, kind >> 16, at + 4, start
        if start + size > len(data):
            raise MeshError("an array is cut off")
        yield kind, data[start : start + size]
        at = after


def _inflated(data: memoryview) -> memoryview:
    out = zlib.decompressobj().decompress(data, _MOST + 1)
    if len(out) > _MOST:
        raise MeshError(f"an array inflates to more than {_MOST:,} bytes; save it uncompressed")
    return memoryview(out)


def _matrix(data: memoryview) -> tuple[str, Numbers | list[Numbers] | None]:
    """Name and content of an array; no content where it holds something else."""
    parts = _elements(data)
    flags, shape, name = (next(parts, (0, memoryview(b"")))[1] for _ in range(3))
    kind = struct.unpack_from("<I", flags)[0] & 0xFF
    label = bytes(name).decode("latin-1")
    if kind == _CELLS:
        cells = [_matrix(part)[1] for sort, part in parts if sort == _MATRIX]
        return label, [c for c in cells if isinstance(c, np.ndarray)]
    if kind not in _NUMBERS:
        return label, None
    sort, values = next(parts)
    if sort not in _TYPES:
        raise MeshError(f"array {label!r} has numbers of an unknown type, {sort}")
    size = np.frombuffer(shape, "<i4").tolist()
    return label, np.frombuffer(values, _TYPES[sort]).reshape(size, order="F")
