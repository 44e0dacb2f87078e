"""Binary messages: what is packed comes out again, and nothing else gets through."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from capsense.errors import ProtocolError
from capsense.server import (
    CONVERSION,
    HEADER,
    MAX_SENSOR,
    MAX_SEQUENCE,
    PROTOCOL,
    ReadingMessage,
    pack_depth,
    pack_reading,
    unpack_depth,
    unpack_reading,
)

PAGE = (Path(__file__).parents[3] / "docs" / "protocol.md").read_text(encoding="utf-8")
MAX_PIXELS = 400

shapes = hnp.array_shapes(min_dims=2, max_dims=2, max_side=20)
sensors = st.integers(0, MAX_SENSOR)
sequences = st.integers(0, MAX_SEQUENCE)
times = st.floats(allow_nan=False, allow_infinity=False)


@st.composite
def depth_frames(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray | None]:
    """A depth image of any floats, without, or with either kind of permittivities."""
    shape = draw(shapes)
    depth = draw(hnp.arrays("<f4", shape))
    kind = draw(st.sampled_from([None, "u1", "<f4"]))
    return depth, None if kind is None else draw(hnp.arrays(kind, shape))


@given(sensors, sequences, times, depth_frames())
def test_depth_round_trip(
    sensor: int, sequence: int, time: float, frame: tuple[np.ndarray, np.ndarray | None]
) -> None:
    """Every bit of a frame arrives."""
    depth, eps_r = frame
    message = pack_depth(sensor, sequence, time, depth, eps_r)
    found = unpack_depth(message, MAX_PIXELS)
    assert (found.sensor, found.sequence, found.time) == (sensor, sequence, time)
    assert found.depth.tobytes() == depth.tobytes()
    assert found.depth.shape == depth.shape
    if eps_r is None:
        assert found.eps_r is None
    else:
        assert found.eps_r is not None
        assert found.eps_r.dtype == eps_r.dtype
        assert found.eps_r.tobytes() == eps_r.tobytes()


@given(st.integers(1, 7), st.integers(0, 9), st.randoms(use_true_random=False))
def test_reading_round_trip(m: int, conversions: int, random: object) -> None:
    """Every number of a reading arrives, at its place."""
    rng = np.random.default_rng(m + 10 * conversions)
    counts = np.zeros(conversions, CONVERSION)
    for name in CONVERSION.names or ():
        counts[name] = rng.integers(0, 100, conversions)
    sent = ReadingMessage(
        3, 2**40, 0.25, rng.random((m, m)), rng.random((m, m)), rng.random(m), 7, 2**32 + 5,
        1e-19, 2e-3, counts,
    )  # fmt: skip
    found = unpack_reading(pack_reading(sent))
    for name in ("capacitance", "delta", "self_capacitance", "conversions"):
        assert np.array_equal(getattr(found, name), getattr(sent, name)), name
    for name in ("sensor", "sequence", "time", "iterations", "solver_error", "wall_time"):
        assert getattr(found, name) == getattr(sent, name), name
    assert found.dropped == 5


@given(st.binary(max_size=200))
def test_noise_is_refused(message: bytes) -> None:
    """Bytes that no client packed raise the one error, and no other."""
    for unpack in (lambda m: unpack_depth(m, MAX_PIXELS), unpack_reading):
        with pytest.raises(ProtocolError):
            unpack(message)


@given(depth_frames(), st.data())
def test_cut_and_padded_messages_are_refused(
    frame: tuple[np.ndarray, np.ndarray | None], data: st.DataObject
) -> None:
    """A message of any other length than it announces is malformed."""
    message = pack_depth(0, 0, 0.0, *frame)
    size = data.draw(st.integers(0, len(message) + 50).filter(lambda n: n != len(message)))
    with pytest.raises(ProtocolError) as caught:
        unpack_depth((message + bytes(50))[:size], MAX_PIXELS)
    assert caught.value.code == "malformed"


@given(depth_frames(), st.data())
def test_damaged_headers(frame: tuple[np.ndarray, np.ndarray | None], data: st.DataObject) -> None:
    """A header with some other bytes is refused, or still describes the payload that follows."""
    message = bytearray(pack_depth(0, 0, 0.0, *frame))
    for _ in range(data.draw(st.integers(1, 4))):
        message[data.draw(st.integers(0, HEADER.size - 1))] = data.draw(st.integers(0, 255))
    try:
        found = unpack_depth(bytes(message), MAX_PIXELS)
    except ProtocolError:
        return
    extra = 0 if found.eps_r is None else found.eps_r.nbytes
    assert HEADER.size + found.depth.nbytes + extra == len(message)
    assert np.isfinite(found.time)


@pytest.mark.parametrize(
    ("field", "value", "code", "words"),
    [
        (0, b"CSNX", "malformed", "starts with b'CSNX'"),
        (1, PROTOCOL + 1, "version", "version 2; this is 1"),
        (2, 2, "malformed", "kind 2; 1 is expected"),
        (3, 3, "malformed", "flags are 0x3"),
        (5, 0, "malformed", "0 rows"),
        (5, 101, "limit", "101 x 4 pixels; this server takes up to 400"),
        (5, 2**32 - 1, "limit", "pixels"),
        (5, 4, "malformed", "its header asks for 64"),
        (7, 47, "malformed", "announces 47 bytes, but 48 follow"),
        (8, 2**60, "malformed", "sequence is"),
        (9, float("nan"), "malformed", "time is nan"),
    ],
)
def test_each_field(field: int, value: object, code: str, words: str) -> None:
    """Every field that is wrong is named."""
    message = pack_depth(1, 2, 3.0, np.zeros((3, 4)))
    fields = [*HEADER.unpack_from(message)]
    fields[field] = value
    with pytest.raises(ProtocolError, match=re.escape(words)) as caught:
        unpack_depth(HEADER.pack(*fields) + message[HEADER.size :], MAX_PIXELS)
    assert caught.value.code == code


def test_what_cannot_be_packed() -> None:
    """The client is told before it sends."""
    for depth, eps_r, words in (
        (np.zeros(3), None, "shape"), (np.zeros((0, 3)), None, "shape"),
        (np.zeros((2, 3)), np.zeros((3, 2)), "eps_r"),
    ):  # fmt: skip
        with pytest.raises(ProtocolError, match=words):
            pack_depth(0, 0, 0.0, depth, eps_r)
    with pytest.raises(ProtocolError, match="sequence is -1"):
        pack_depth(0, -1, 0.0, np.zeros((2, 2)))


def table(title: str) -> list[list[str]]:
    """The rows of the table that follows a heading of the page."""
    text = PAGE.partition(f"## {title}\n")[2].partition("\n## ")[0]
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in row] for row in rows][1:]


def test_the_page_describes_the_header() -> None:
    """Offsets, types and names of the header, as documented, hold a packed frame."""
    rows = table("Header of binary messages")
    formats = {"bytes": "4s", "u8": "B", "u16": "H", "u32": "I", "u64": "Q", "f64": "d"}
    assert struct.Struct("<" + "".join(formats[row[1]] for row in rows)).format == HEADER.format
    offset = 0
    for row in rows:
        assert int(row[0]) == offset, row
        offset += struct.calcsize("<" + formats[row[1]])
    assert offset == HEADER.size


def test_the_page_describes_conversions() -> None:
    """Offsets, types and names of the records of a readout."""
    formats = {"u8": "|u1", "u16": "<u2", "u32": "<u4", "i64": "<i8", "f64": "<f8"}
    rows = [row for row in table("Readings") if row[0].isdigit()]
    documented = [(row[2], formats[row[1]], int(row[0])) for row in rows]
    fields = CONVERSION.fields
    assert fields is not None
    assert documented == [(name, fields[name][0].str, fields[name][1]) for name in fields]
