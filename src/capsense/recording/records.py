"""The records of an MCAP file in order, as far as it is whole."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterable, Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema
from mcap.stream_reader import get_chunk_data_stream

from capsense.errors import RecordingError

MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")
_CRC = struct.Struct("<I")

_MOST = 256_000_000
"""Chunks may not be larger [bytes]; a recorder's hold a megabyte, or one larger message."""

Record = Attachment | Channel | Message | Metadata | Schema
_READERS: dict[int, Callable[[ReadDataStream, int], Record]] = {
    Opcode.SCHEMA: lambda stream, _: Schema.read(stream),
    Opcode.CHANNEL: lambda stream, _: Channel.read(stream),
    Opcode.MESSAGE: Message.read,
}
"""What a chunk may hold."""


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


def _parse(opcode: int, content: bytes) -> Iterable[Record]:
    stream = ReadDataStream(BytesIO(content))
    if opcode == Opcode.CHUNK:
        return _chunk(Chunk.read(stream))
    if opcode == Opcode.ATTACHMENT:
        (expected,) = _CRC.unpack(content[-_CRC.size :])
        if expected and expected != zlib.crc32(content[: -_CRC.size]):
            raise ValueError("the checksum differs")
        return [Attachment.read(stream)]
    if opcode == Opcode.METADATA:
        return [Metadata.read(stream)]
    return ()


def _chunk(chunk: Chunk) -> Iterator[Record]:
    """The records of a chunk, of which there are three kinds."""
    size = _inflated_size(chunk)
    if size > _MOST:
        raise ValueError(f"its content would take up {size:,} bytes of memory")
    stream, size = get_chunk_data_stream(chunk, validate_crc=True)
    while stream.count < size:
        opcode, length = _HEAD.unpack(stream.read(_HEAD.size))
        end = stream.count + length
        if end > size or opcode not in _READERS:
            raise ValueError(f"a record of kind {opcode} and {length} bytes is in a chunk")
        yield _READERS[opcode](stream, length)
        stream.read(end - stream.count)


def _inflated_size(chunk: Chunk) -> int:
    """Size that a chunk's content says it has [bytes]; LZ4 keeps to 255 times the file's."""
    if chunk.compression != "zstd":
        return chunk.uncompressed_size
    import zstandard

    return max(chunk.uncompressed_size, zstandard.frame_content_size(chunk.data))
