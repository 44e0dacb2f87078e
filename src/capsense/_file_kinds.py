"""What kind a file is, for messages to those who give one to the wrong command."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

_SIGNATURES: tuple[tuple[str, str, tuple[str, ...], str], ...] = (
    ("design", "a sensor design", ("domain", "electrode"), "design"),
    ("design", "a sensor design", ("domain", "electrodes_from_stl"), "design"),
    ("scenario", "a scenario", ("design", "sample_rate"), "run"),
    ("data set", "the description of a data set", ("design", "scenes"), "dataset"),
    ("data set", "the description of a data set", ("environment", "episodes"), "dataset"),
    ("study", "a tolerance study", ("parameters", "specifications"), "tolerance"),
    ("task", "a task for optimise", ("parameters", "design"), "optimise"),
    ("readout", "a readout", ("chip",), "readout REC --config"),
)
"""What readers call it, what messages do, keys that only it has together, and its command."""
_ENDINGS = {
    ".mcap": ("recording", "a recording", "replay", "export", "readout"),
    ".npz": ("readings", "an array file, such as those of a run", "readout"),
    ".csv": ("readings", "a table, such as those of a run", "readout"),
}
"""Other files by their endings: what readers call them, what messages do, and commands."""


def kind_of(data: Mapping[str, Any]) -> str | None:
    """What a TOML file describes, as readers call it, by its keys; None if they do not tell."""
    return next((k for k, _, keys, _ in _SIGNATURES if all(key in data for key in keys)), None)


def other_kind(path: Path, wanted: str, data: Mapping[str, Any] | None = None) -> str | None:
    """A sentence part that says what a file is instead, and which command takes it.

    Args:
        path: The file.
        wanted: What readers of the right kind call it, such as ``scenario``.
        data: Its content, of a TOML file that was read already.

    Returns:
        Such as ``hand.toml is a scenario; capsense run takes it``; None if it is not known to be of
        another kind.
    """
    ending = path.suffix.lower()
    if data is None and ending in _ENDINGS:
        kind, what, *commands = _ENDINGS[ending]
        if kind == wanted:
            return None
        return f"{path} is {what}; {' or '.join(f'capsense {c}' for c in commands)} takes it"
    if data is None:
        try:
            data = tomllib.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            return None
    found = kind_of(data)
    if found in (None, wanted):
        return None
    what, command = next((what, c) for k, what, _, c in _SIGNATURES if k == found)
    return f"{path} is {what}; capsense {command} takes it"
