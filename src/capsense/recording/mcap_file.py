"""An MCAP file that is on disk up to half a second ago."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from capsense.recording.disk import Disk
from capsense.recording.messages import Messages, offered_qos

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
        self.messages = Messages()
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

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a record of names and values."""
        with self._lock:
            self._writer.add_metadata(name, dict(values))

    def attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Write a file within the file."""
        with self._lock:
            self._writer.add_attachment(0, 0, name, media_type, data)

    def write(self, stamp: int, messages: Sequence[tuple[str, Any]]) -> None:
        """Write messages that belong together, each with its topic.

        Args:
            stamp: Their time on the clock of the recording [ns].
            messages: Made by :attr:`messages`.
        """
        data = [(topic, m.__msgtype__, self.messages.encode(m)) for topic, m in messages]
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
            text = self.messages.definition(type_name)
            self._schemas[type_name] = self._writer.register_schema(
                type_name, "ros2msg", text.encode()
            )
        notes = {
            "offered_qos_profiles": offered_qos(topic),
            "topic_type_hash": self.messages.type_hash(type_name),
        }
        channel = self._writer.register_channel(topic, "cdr", self._schemas[type_name], notes)
        self._channels[topic] = channel
        return channel
