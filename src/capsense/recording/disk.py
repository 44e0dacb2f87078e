"""A file that only grows by whole records, whatever happens to the disk."""

from __future__ import annotations

import os
from collections import deque
from pathlib import Path

from capsense.errors import RecordingError


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
