"""Binary messages: a header of 40 bytes and a payload, little-endian.

The protocol is described in ``docs/protocol.md``.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import IntEnum, IntFlag

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense.errors import ProtocolError
from capsense.reading import Touch

MAGIC = b"CSNS"
PROTOCOL = 1
"""Version of the protocol."""
HEADER = struct.Struct("<4sBBHIIIIQd")
"""Magic, version, kind, flags, sensor, rows, columns, size, sequence, time."""
_SUMMARY = struct.Struct("<IIdd")
"""Iterations, frames dropped, error estimate [F], time of the step [s]."""
CONVERSION = np.dtype(
    [
        ("time", "<f8"), ("code", "<i8"), ("capacitance", "<f8"), ("baseline", "<f8"),
        ("channel", "<u2"), ("flags", "u1"), ("state", "u1"), ("reserved", "<u4"),
    ]
)  # fmt: skip
"""What a chip reports of one channel; ``state`` is 0 released, 1 touched, 255 no detector."""
NO_DETECTOR = 255
MAX_SEQUENCE = 2**53 - 1
"""Largest sequence number: the largest integer that JSON carries everywhere."""
MAX_SENSOR = 2**32 - 1


class Kind(IntEnum):
    """What a binary message is."""

    DEPTH = 1
    READING = 2


class Flag(IntFlag):
    """What a depth frame holds beside depths."""

    NONE = 0
    CODES = 1
    """Permittivity codes, one byte a pixel."""
    FLOATS = 2
    """Relative permittivities, float32."""


class ReadingFlag(IntFlag):
    """What a reading holds beside capacitances."""

    NONE = 0
    TOUCH = 1
    """Forces [N] and compressions [m] of the cover above the electrodes, and the total force."""


@dataclass(frozen=True, eq=False)
class DepthMessage:
    """A depth image on its way to the server."""

    sensor: int
    sequence: int
    time: float
    """Of the image, by the client's clock [s]."""
    depth: NDArray[np.float32]
    """Depths [m], shape (rows, columns)."""
    eps_r: NDArray[np.uint8] | NDArray[np.float32] | None = None
    """Codes or relative permittivities, same shape; None where the sensor's material is seen."""


@dataclass(frozen=True, eq=False)
class ReadingMessage:
    """A reading on its way to the client."""

    sensor: int
    sequence: int
    """Of the frame that it answers."""
    time: float
    """Of that frame [s]."""
    capacitance: NDArray[np.float64]
    """Maxwell matrix [F], shape (M, M)."""
    delta: NDArray[np.float64]
    """Change from the empty scene [F], shape (M, M)."""
    self_capacitance: NDArray[np.float64]
    """What self-mode channels measure [F], shape (M,)."""
    iterations: int
    dropped: int
    """Frames of this sensor so far that newer ones replaced before they were solved."""
    solver_error: float
    """[F]."""
    wall_time: float
    """Time the step took [s]."""
    conversions: NDArray[np.void]
    """What the readout has reported since the last reading, type :data:`CONVERSION`."""
    touch: Touch | None = None
    """What is pressed onto the design's cover, where the sensor was opened with ``touch``."""


def pack_depth(
    sensor: int, sequence: int, time: float, depth: ArrayLike, eps_r: ArrayLike | None = None
) -> bytes:
    """The message of a depth image.

    Args:
        sensor: Number of the sensor, from 0 on.
        sequence: Number of the frame, larger than that of the frame before.
        time: [s].
        depth: [m], shape (rows, columns); NaN, infinity and 0 are air.
        eps_r: Type uint8: permittivity codes; else relative permittivities. Same shape.

    Raises:
        ProtocolError: Shapes do not fit, or a number is out of range.
    """
    d = np.ascontiguousarray(depth, dtype="<f4")
    if d.ndim != 2 or not d.size:
        raise ProtocolError(f"depth has shape {d.shape}; give (rows, columns)")
    flag, extra = Flag.NONE, b""
    if eps_r is not None:
        e = np.asarray(eps_r)
        if e.shape != d.shape:
            raise ProtocolError(f"eps_r has shape {e.shape}, but depth has {d.shape}")
        flag = Flag.CODES if e.dtype == np.uint8 else Flag.FLOATS
        extra = np.ascontiguousarray(e, dtype=_EXTRA[flag]).tobytes()
    _check_numbers(sensor, sequence, time)
    rows, columns = d.shape
    header = HEADER.pack(
        MAGIC, PROTOCOL, Kind.DEPTH, flag, sensor, rows, columns, d.nbytes + len(extra),
        sequence, time,
    )  # fmt: skip
    return b"".join((header, d.data, extra))


_EXTRA: dict[Flag, np.dtype] = {Flag.CODES: np.dtype("u1"), Flag.FLOATS: np.dtype("<f4")}


def is_depth(message: bytes) -> bool:
    """Whether a binary message claims to be a depth image."""
    return len(message) >= HEADER.size and HEADER.unpack_from(message)[2] == Kind.DEPTH


def unpack_depth(message: bytes, max_pixels: int = 2**32) -> DepthMessage:
    """The depth image in a message; its arrays look into ``message``.

    Raises:
        ProtocolError: The message is not one of this protocol and version, is cut or padded, holds
            more than ``max_pixels`` pixels, or a number is out of range.
    """
    flags, sensor, rows, columns, sequence, time = _open(message, Kind.DEPTH)
    if not rows or not columns:
        raise ProtocolError(
            f"the image has {rows} rows and {columns} columns; both must be above 0"
        )
    pixels = rows * columns
    if pixels > max_pixels:
        raise ProtocolError(
            f"the image has {rows} x {columns} pixels; this server takes up to {max_pixels}",
            "limit",
        )
    try:
        extra = None if flags == 0 else _EXTRA[Flag(flags)]
    except (KeyError, ValueError):
        raise ProtocolError(f"flags are {flags:#x}; 0, 1 and 2 are known") from None
    expected = pixels * (4 + (extra.itemsize if extra else 0))
    _check_size(message, expected)
    depth = np.frombuffer(message, "<f4", pixels, HEADER.size).reshape(rows, columns)
    if extra is None:
        return DepthMessage(sensor, sequence, time, depth)
    eps_r = np.frombuffer(message, extra, pixels, HEADER.size + 4 * pixels)
    return DepthMessage(sensor, sequence, time, depth, eps_r.reshape(rows, columns))


def pack_reading(reading: ReadingMessage) -> bytes:
    """The message of a reading."""
    touch, flag = b"", ReadingFlag.NONE
    if reading.touch is not None:
        flag, t = ReadingFlag.TOUCH, reading.touch
        touch = np.hstack([t.force, t.compression, t.total]).astype("<f8").tobytes()
    parts = (
        _SUMMARY.pack(
            reading.iterations, reading.dropped & 0xFFFFFFFF, reading.solver_error,
            reading.wall_time,
        ),
        *(np.ascontiguousarray(a, "<f8").tobytes()
          for a in (reading.capacitance, reading.delta, reading.self_capacitance)),
        reading.conversions.tobytes(), touch,
    )  # fmt: skip
    header = HEADER.pack(
        MAGIC, PROTOCOL, Kind.READING, flag, reading.sensor, len(reading.delta),
        len(reading.conversions), sum(map(len, parts)), reading.sequence, reading.time,
    )  # fmt: skip
    return b"".join((header, *parts))


def unpack_reading(message: bytes) -> ReadingMessage:
    """The reading in a message.

    Raises:
        ProtocolError: The message is not one of this protocol and version, or is cut or padded.
    """
    flags, sensor, m, count, sequence, time = _open(message, Kind.READING)
    if flags not in (ReadingFlag.NONE, ReadingFlag.TOUCH):
        raise ProtocolError(f"flags of a reading are {flags:#x}; 0 and 1 are known")
    size = _SUMMARY.size + 8 * m * (2 * m + 1) + CONVERSION.itemsize * count
    end = HEADER.size + size
    _check_size(message, size + (8 * (2 * m + 1) if flags else 0))
    at = HEADER.size
    iterations, dropped, error, wall = _SUMMARY.unpack_from(message, at)
    at += _SUMMARY.size
    numbers = np.frombuffer(message, "<f8", m * (2 * m + 1), at)
    conversions = np.frombuffer(message, CONVERSION, count, at + numbers.nbytes)
    return ReadingMessage(
        sensor, sequence, time, numbers[: m * m].reshape(m, m),
        numbers[m * m : 2 * m * m].reshape(m, m), numbers[2 * m * m :], iterations, dropped,
        error, wall, conversions, _touch(np.frombuffer(message, "<f8", 2 * m + 1, end)) if flags
        else None,
    )  # fmt: skip


def _touch(numbers: NDArray[np.float64]) -> Touch:
    force, compression = numbers[:-1].reshape(2, -1)
    return Touch(force, compression, float(numbers[-1]))


def _open(message: bytes, kind: Kind) -> tuple[int, int, int, int, int, float]:
    """Flags, sensor, rows, columns, sequence and time of a message of a kind."""
    if len(message) < HEADER.size:
        raise ProtocolError(
            f"a binary message of {len(message)} bytes is shorter than its header, {HEADER.size}"
        )
    magic, version, found, flags, sensor, rows, columns, size, sequence, time = HEADER.unpack_from(
        message
    )
    if magic != MAGIC:
        raise ProtocolError(f"a binary message starts with {magic!r}, not {MAGIC!r}")
    if version != PROTOCOL:
        raise ProtocolError(f"the message has version {version}; this is {PROTOCOL}", "version")
    if found != kind:
        raise ProtocolError(f"the message has kind {found}; {int(kind)} is expected here")
    if size != len(message) - HEADER.size:
        raise ProtocolError(
            f"the header announces {size} bytes, but {len(message) - HEADER.size} follow it"
        )
    _check_numbers(sensor, sequence, time)
    return flags, sensor, rows, columns, sequence, time


def _check_numbers(sensor: int, sequence: int, time: float) -> None:
    if not 0 <= sensor <= MAX_SENSOR:
        raise ProtocolError(f"sensor is {sensor}; give 0 to {MAX_SENSOR}")
    if not 0 <= sequence <= MAX_SEQUENCE:
        raise ProtocolError(f"sequence is {sequence}; give 0 to {MAX_SEQUENCE}")
    if not math.isfinite(time):
        raise ProtocolError(f"time is {time}; give seconds, a finite number")


def _check_size(message: bytes, expected: int) -> None:
    if len(message) - HEADER.size != expected:
        raise ProtocolError(
            f"the payload has {len(message) - HEADER.size} bytes; its header asks for {expected}"
        )
