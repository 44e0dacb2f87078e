"""Where compiled kernels are kept, if Numba has no place of its own for them."""

from __future__ import annotations

import os
import sys
from pathlib import Path

_MEMORY = "/dev/shm"
"""A file system in memory; containers have it where nothing else can be written."""


kept = True
"""Whether what this process compiles is there for the next one."""


def ensure_place(package: Path) -> None:
    """Give Numba a folder for this process alone if it could write its files nowhere.

    It writes into ``NUMBA_CACHE_DIR``, beside the sources, or into the user's cache directory; it
    refuses to compile where none of them can be written, as in containers that have a read-only
    installation and no home.
    """
    home = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))
    given = os.environ.get("NUMBA_CACHE_DIR")
    if any(map(_writable, [*([Path(given)] if given else []), package, home / "numba"])):
        return
    global kept
    kept = False
    import logging

    logging.getLogger("capsense").warning(
        "compiled kernels cannot be kept: neither %s nor %s can be written, so that each process "
        "compiles for about a minute; set NUMBA_CACHE_DIR to a folder that can", package, home,
    )  # fmt: skip
    folder = _temporary()
    if folder is None:
        return  # Numba says so when it compiles
    os.environ["NUMBA_CACHE_DIR"] = folder
    if "numba" in sys.modules:  # it has read its settings already
        sys.modules["numba"].config.CACHE_DIR = folder


def _writable(folder: Path) -> bool:
    """Whether a folder can be written, or made."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)


def _temporary() -> str | None:
    """A folder that is removed when the process ends; None where none can be made."""
    import atexit
    import shutil
    import tempfile

    for place in (None, _MEMORY):
        try:
            folder = tempfile.mkdtemp(prefix="capsense-kernels-", dir=place)
            break
        except OSError:
            continue
    else:
        return None
    owner = os.getpid()

    def remove() -> None:
        if os.getpid() == owner:  # not a child that was forked off
            shutil.rmtree(folder, ignore_errors=True)

    atexit.register(remove)
    return folder
