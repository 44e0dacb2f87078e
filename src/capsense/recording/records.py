"""The records of an MCAP file in order, as far as it is whole."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk

from capsense.errors import RecordingError

MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")
_CRC = struct.Struct("<I")

Record = Attachment | Channel | Message | Metadata | Schema


def ends_well(path: Path) -> bool:
    """Whether a file was closed by its writer.

    Raises:
        RecordingError: It cannot be read, or is no MCAP file.
    """
    try:
        with path.open("rb") as file:
            begin = file.read(len(MAGIC))
            if begin == MAGIC:
                file.seek(-len(MAGIC), 2)
                return file.tell() > 0 and file.read() == MAGIC
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from None
    raise RecordingError(f"{path} is no MCAP file; give one that capsense record wrote")


def read_records(path: Path) -> Iterator[Record]:
    """The records up to the index at the end; of a file cut short, those that are whole.

    Raises:
        RecordingError: The file is damaged, not just cut short.
    """
    closed = ends_well(path)
    with path.open("rb") as file:
        size = file.seek(0, 2)
        file.seek(len(MAGIC))
        while (found := _next(file, size)) is not None:
            opcode, content, place = found
            if opcode == Opcode.DATA_END:
                return
            try:
                yield from _parse(opcode, content)
            except Exception as error:  # whatever decompression and parsing make of damage
                raise RecordingError(
                    f"{path} is damaged: the record at byte {place} cannot be read ({error})"
                ) from None
        if closed:
            raise RecordingError(
                f"{path} is damaged: a record near byte {file.tell()} is not whole"
            )


def _next(file: BinaryIO, size: int) -> tuple[int, bytes, int] | None:
    """Opcode, content and place of the next record; None where the file ends before it does."""
    place = file.tell()
    if size - place < _HEAD.size:
        return None
    opcode, length = _HEAD.unpack(file.read(_HEAD.size))
    # Zeros are what some file systems leave behind when the power fails.
    if opcode == 0 or length > size - place - _HEAD.size:
        return None
    return opcode, file.read(length), place


def _parse(opcode: int, content: bytes) -> list[Record]:
    stream = ReadDataStream(BytesIO(content))
    if opcode == Opcode.CHUNK:
        return breakup_chunk(Chunk.read(stream), validate_crc=True)  # type: ignore[return-value]
    if opcode == Opcode.ATTACHMENT:
        (expected,) = _CRC.unpack(content[-_CRC.size :])
        if expected and expected != zlib.crc32(content[: -_CRC.size]):
            raise ValueError("the checksum differs")
        return [Attachment.read(stream)]
    if opcode == Opcode.METADATA:
        return [Metadata.read(stream)]
    return []
