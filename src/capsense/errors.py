"""The exceptions CapSense raises on purpose. All derive from :class:`CapSenseError`."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from importlib import import_module
from typing import Any

_LONGEST, _HEAD, _TAIL = 1000, 600, 300
"""Longer messages are cut in the middle: the head names the thing, the tail the fix."""


class CapSenseError(Exception):
    """Base of every error that CapSense raises on purpose.

    A message that echoes long input is cut in the middle.
    """

    def __str__(self) -> str:
        text = super().__str__()
        return text if len(text) <= _LONGEST else f"{text[:_HEAD]} […] {text[-_TAIL:]}"


class ExperimentalWarning(UserWarning):
    """A part is used that was never run with the program or device that it is for."""


_warned: set[str] = set()


def warn_experimental(part: str, tested: str) -> None:
    """Warn once in a process that a part is experimental.

    Args:
        part: What it is called.
        tested: What it was tested with in place of the program that it is for.
    """
    if part not in _warned:
        _warned.add(part)
        warnings.warn(
            f"{part} is experimental: it was tested with {tested} only; compare its readings with "
            "a scene that you know, and see the page on support levels",
            ExperimentalWarning,
            stacklevel=3,
        )


class DesignError(CapSenseError, ValueError):
    """A sensor design is wrong; the message names the item, the value and the fix."""


class LayoutError(CapSenseError, ValueError):
    """A layout of a board cannot be read, or makes no design."""


class SceneError(CapSenseError, ValueError):
    """A scene, body, shape, pose or material is wrong."""


class ScenarioError(CapSenseError, ValueError):
    """A scenario file is wrong."""


class MeshError(CapSenseError, ValueError):
    """A mesh or mesh file is wrong."""


class FieldError(CapSenseError, RuntimeError):
    """The background field could not be built."""


class AdapterError(CapSenseError, RuntimeError):
    """A robot simulator cannot be reached, refused a call, or is too old."""


class SolveError(CapSenseError, RuntimeError):
    """A step did not reach its tolerance."""


class PartialError(CapSenseError, RuntimeError):
    """Some of many readings failed; those that did not are kept."""

    def __init__(
        self, message: str, readings: dict[Any, Any], failures: dict[Any, CapSenseError]
    ) -> None:
        super().__init__(message)
        self.readings = readings
        """Name of a sensor, or number of a scene → reading, of those that did not fail."""
        self.failures = failures
        """Name or number → error, of those that did."""

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (*self.args, self.readings, self.failures)


class SkinError(PartialError):
    """Some sensors of a skin failed; the readings of the others are kept, by name."""


class BatchError(PartialError):
    """Some scenes of a batch failed; the readings of the others are kept, by number from 0."""


class MissingDependencyError(CapSenseError, ImportError):
    """An optional dependency is missing; the message gives the command that installs it."""


class ReadoutError(CapSenseError, ValueError):
    """A readout, its configuration or what is given to it is wrong."""


class RecordingError(CapSenseError, ValueError):
    """A recording cannot be made, or its file is not a recording or is damaged."""


class ServerError(CapSenseError, ValueError):
    """An option of the server is wrong."""


class ProtocolError(CapSenseError, ValueError):
    """A message breaks the server's protocol, or the server refused what was asked."""

    def __init__(self, message: str, code: str = "malformed") -> None:
        super().__init__(message)
        self.code = code
        """What is wrong, one of :data:`capsense.server.messages.CODES`."""


def require_package(module: str, title: str, extra: str) -> None:
    """Refuse to go on without an optional package.

    Args:
        module: What is imported.
        title: What people call it.
        extra: The extra of CapSense that installs it.

    Raises:
        MissingDependencyError: It is not installed.
    """
    try:
        import_module(module)
    except ImportError:
        raise MissingDependencyError(
            f"{title} is not installed; pip install 'capsense[{extra}]'"
        ) from None


def listed(names: Sequence[object], most: int) -> str:
    """The first names in quotes, and how many more there are, for a message."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(map(repr, names[:most])) + more
