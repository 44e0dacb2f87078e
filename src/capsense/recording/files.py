"""MCAP files: written so that a killed process loses half a second, read as far as whole."""

from __future__ import annotations

import os
import struct
import threading
import zlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from capsense._file_kinds import other_kind
from capsense.errors import RecordingError, require_package
from capsense.recording import ros

require_package("mcap", "mcap, which recordings need,", "record")
from mcap.data_stream import ReadDataStream  # noqa: E402
from mcap.opcode import Opcode  # noqa: E402
from mcap.records import (  # noqa: E402
    Attachment,
    Channel,
    Chunk,
    Message,
    Metadata,
    Schema,
)
from mcap.stream_reader import get_chunk_data_stream  # noqa: E402


def check_target(path: Path, *, overwrite: bool) -> None:
    """See that a file can be made, before anything is computed for it.

    Raises:
        RecordingError: It is there already, or its folder is not, or cannot be written to.
    """
    if path.is_dir():
        raise RecordingError(f"{path} is a folder; give a file")
    if path.exists() and not overwrite:
        raise _taken(path)
    if not path.parent.is_dir():
        raise RecordingError(f"{path}: there is no folder {path.parent}; make it first")
    if not os.access(path if path.exists() else path.parent, os.W_OK):
        raise RecordingError(f"{path} cannot be written to; give another place")


def _taken(path: Path) -> RecordingError:
    return RecordingError(
        f"{path} is there already; give another name, or replace it (--force, overwrite=True)"
    )


class Disk:
    """What an MCAP writer takes for a stream.

    Writing only keeps the bytes; :meth:`drain` puts them into the file. If that fails, the file
    ends with the last bytes that were written together and fit; the others are kept, and draining
    can be tried again.

    Args:
        path: The file.
        overwrite: Whether a file that is there may be replaced.

    Raises:
        RecordingError: It is there already, or cannot be made.
    """

    def __init__(self, path: Path, *, overwrite: bool) -> None:
        self.path = path
        flags = os.O_WRONLY | os.O_CREAT | (os.O_TRUNC if overwrite else os.O_EXCL)
        try:
            self._file = os.open(path, flags, 0o666)
        except FileExistsError:
            raise _taken(path) from None
        except OSError as error:
            raise RecordingError(
                f"{path} cannot be written to: {error.strerror}; give another place"
            ) from None
        self._pending: deque[bytes] = deque()
        self._on_disk = 0
        self._end = 0

    def write(self, data: bytes | memoryview) -> int:
        """Keep bytes for the next :meth:`drain`."""
        self._pending.append(bytes(data))
        self._end += len(data)
        return len(data)

    def tell(self) -> int:
        """Size of the file with what is still kept [bytes]."""
        return self._end

    def flush(self) -> None:
        """Do nothing; see :meth:`drain`."""

    def drain(self) -> None:
        """Put what is kept into the file.

        Raises:
            OSError: That failed; the file ends with whole records, and nothing is forgotten.
        """
        while self._pending:
            rest = memoryview(self._pending[0])
            try:
                while rest:
                    rest = rest[os.write(self._file, rest) :]
            except OSError:
                os.ftruncate(self._file, self._on_disk)
                os.lseek(self._file, self._on_disk, os.SEEK_SET)
                raise
            self._on_disk += len(self._pending.popleft())

    def close(self) -> None:
        """Close the file; what is still kept is lost."""
        os.close(self._file)


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
    other = other_kind(path, "recording")
    raise RecordingError(
        f"{other or f'{path} is no MCAP file'}; give a recording, which capsense record writes"
    )


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


FLUSH_EVERY = 0.5
"""Longest time that a message waits before it is written to the file [s]."""
CHUNK = 65536
"""Messages are packed together up to so many bytes: a chunk is in the file wholly or not at all."""


class McapFile:
    """Writes messages in chunks, which a thread closes and hands to the system twice a second.

    So a process that is killed loses half a second. What fails on the way to the disk is kept and
    tried again; :attr:`failure` tells of it.

    Args:
        path: The file.
        overwrite: Whether a file that is there may be replaced.

    Raises:
        RecordingError: It is there already, or cannot be made.
    """

    def __init__(self, path: Path, *, overwrite: bool = False) -> None:
        from mcap.writer import Writer

        self.path = path
        self.failure: OSError | None = None
        """Why the file could not be written the last time that was tried, if it failed."""
        self._disk = Disk(path, overwrite=overwrite)
        self._writer = Writer(self._disk, chunk_size=CHUNK)  # type: ignore[arg-type]
        self._writer.start(profile="ros2", library="capsense")
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._finished = self._closed = False
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._sequence: dict[int, int] = {}
        self._thread = threading.Thread(target=self._flush_often, daemon=True)
        self._thread.start()

    def begin(self, name: str, values: Mapping[str, str], files: Mapping[str, str]) -> None:
        """Write what is said once: a record of names and values, and files of JSON; flush.

        Raises:
            OSError: That failed.
        """
        with self._lock:
            self._writer.add_metadata(name, dict(values))
            for file, text in files.items():
                self._writer.add_attachment(0, 0, file, "application/json", text.encode())
        self.flush()

    def write(self, stamp: int, messages: Sequence[tuple[str, Any]]) -> None:
        """Write messages that belong together, each with its topic.

        Args:
            stamp: Their time on the clock of the recording [ns].
            messages: Made by :func:`~capsense.recording.ros.make`.
        """
        data = [(topic, m.__msgtype__, ros.encode(m)) for topic, m in messages]
        with self._lock:
            for topic, type_name, content in data:
                channel = self._channels.get(topic) or self._channel(topic, type_name)
                number = self._sequence[channel] = self._sequence.get(channel, -1) + 1
                self._writer.add_message(channel, stamp, content, stamp, number)

    def flush(self) -> None:
        """Put everything into the file.

        Raises:
            OSError: That failed; it can be tried again.
        """
        with self._lock:
            self._writer.flush()
            self._drain()

    def close(self) -> None:
        """Put everything and the index into the file, and close it.

        Raises:
            OSError: The last part could not be written. The file ends with what was written
                before, and can be read; closing can be tried again.
        """
        if self._closed:
            return
        self._closing.set()
        self._thread.join()
        with self._lock:
            # the messages first: there may be room for them and none for the index
            self._writer.flush()
            self._drain()
            if not self._finished:
                self._writer.finish()
                self._finished = True
            self._drain()
            self._disk.close()
            self._closed = True

    def _drain(self) -> None:
        try:
            self._disk.drain()
        except OSError as error:
            self.failure = error
            raise
        self.failure = None

    def _flush_often(self) -> None:
        while not self._closing.wait(FLUSH_EVERY):
            try:
                self.flush()
            except OSError:
                continue  # self.failure tells whoever writes next

    def _channel(self, topic: str, type_name: str) -> int:
        if type_name not in self._schemas:
            text = ros.definition(type_name)
            self._schemas[type_name] = self._writer.register_schema(
                type_name, "ros2msg", text.encode()
            )
        notes = {
            "offered_qos_profiles": offered_qos(topic),
            "topic_type_hash": ros.type_hash(type_name),
        }
        channel = self._writer.register_channel(topic, "cdr", self._schemas[type_name], notes)
        self._channels[topic] = channel
        return channel


def offered_qos(topic: str) -> str:
    """Quality of service of a lasting topic, as rosbag2 writes it down.

    Policies are numbers, which all versions of rosbag2 read. Other topics have none, which it takes
    for its defaults.
    """
    if not ros.lasting(topic):
        return ""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability
    from rosbags.interfaces import QosTime as Time
    from rosbags.rosbag2.metadata import dump_qos_v8

    ever = Time(9223372036, 854775807)
    profile = Qos(
        QosHistory.KEEP_LAST, ros.lasting(topic), QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL, ever, ever, QosLiveliness.AUTOMATIC, ever, False,
    )  # fmt: skip
    return dump_qos_v8([profile])
