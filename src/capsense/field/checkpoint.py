"""Results of the finished stages of a build, so that an interrupted one can go on."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from capsense.errors import FieldError
from capsense.field.store import Arrays, read_arrays, write_arrays

_log = logging.getLogger(__name__)


class FolderCheckpoint:
    """Keeps finished stages in a folder of their own, one file each.

    A file that is damaged or belongs to something else counts as not there. When the folder cannot
    be written, nothing more is kept, and the build goes on.
    """

    def __init__(self, folder: Path, key: str) -> None:
        self._folder = folder
        self._key = key
        self._writable = True

    def load(self, stage: str) -> Arrays | None:
        """Return the arrays of a finished stage, or None."""
        path = self._path(stage)
        try:
            return read_arrays(path, kind=stage, key=self._key)[0]
        except FileNotFoundError:
            return None
        except FieldError as error:
            _log.info("an earlier, interrupted build is not continued: %s", error)
            return None

    def save(self, stage: str, **arrays: NDArray[Any]) -> None:
        """Keep the arrays of a finished stage."""
        if not self._writable:
            return
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            write_arrays(self._path(stage), arrays, {"kind": stage, "key": self._key})
        except OSError as error:
            self._writable = False
            _log.info("if interrupted, this build will start anew: %s", error)

    def clear(self) -> None:
        """Delete what was kept."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def _path(self, stage: str) -> Path:
        return self._folder / f"{stage}.npz"
