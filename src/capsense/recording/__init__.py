"""Recordings: MCAP files of ROS 2 messages, written step by step, replayed bit for bit.

This module has what a recording says once, at its start: the sensor, the simulator's settings and
versions.
"""

from __future__ import annotations

import json
import platform
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np
from llvmlite.binding import get_host_cpu_name
from numpy.typing import NDArray

from capsense.design.model import Design
from capsense.errors import RecordingError
from capsense.field.background import NUMERICS, BuildSettings, MeshSettings
from capsense.reading import Reading, StepStats
from capsense.readout import Readout
from capsense.readout.config import file_content, parse_readout
from capsense.scenario import FORMER_METHODS, METHODS, Channel, Excitation, Scenario
from capsense.scenario.model import channels_of
from capsense.simulator import Method, PresetName, Simulator, checked_preset

Array = NDArray[np.float64]

FORMAT = 1
"""Version of what recordings hold; a reader refuses others."""
NAME = "capsense"
"""Of the metadata record that makes an MCAP file a recording."""
DESIGN, SESSION = "design.json", "session.json"
"""The attachments."""
GONE = ("perturbation",)
"""Methods of earlier versions, which no longer exist; what they recorded can still be read."""


def version_of(package: str) -> str:
    """Version of a package, or that it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def versions() -> dict[str, str]:
    """Versions of Python, the packages that compute and the fields' numerics; the processor."""
    return {
        "python": platform.python_version(), "platform": platform.platform(),
        "processor": get_host_cpu_name(), "numerics": str(NUMERICS),
        **{package: version_of(package) for package in ("capsense", "numpy", "scipy", "numba")},
    }  # fmt: skip


@dataclass(frozen=True, eq=False)
class Session:
    """Everything of a recording that does not change from step to step."""

    name: str
    """Of the sensor: its frame, and the beginning of its topics."""
    title: str
    """What was recorded, in words."""
    design: Design
    method: str
    """The simulator's; one of ``METHODS``, or of :data:`GONE`."""
    preset: PresetName
    """The simulator's."""
    excitation_frequency: float
    """The simulator's [Hz]."""
    settings: BuildSettings
    """Of the background field."""
    empty: Reading
    """The reading of the empty domain."""
    excitation: Excitation
    """Which numbers of a reading tables hold."""
    pairs: tuple[tuple[str, str], ...]
    """For mutual excitation: the pairs; all of them if empty."""
    readout: Mapping[str, Any] | None
    """Content of the readout's file, where replaying can build it again."""
    versions: Mapping[str, str]
    """Of what the numbers depend on, see :func:`~capsense.recording.versions`."""

    @property
    def channels(self) -> tuple[Channel, ...]:
        """What tables hold."""
        return channels_of(self.excitation, self.design.electrode_names, self.pairs)

    def simulator(
        self,
        *,
        method: Method | None = None,
        cache_dir: Path | None = None,
        progress: Callable[[str, float], None] | None = None,
    ) -> Simulator:
        """A simulator with the recorded settings, or with another method.

        Raises:
            RecordingError: The recorded method is gone, and no other is given.
            FieldError: The background field could not be built.
        """
        if method is None and self.method in GONE:
            raise RecordingError(
                f"this was recorded with method {self.method!r} of capsense "
                f"{self.versions.get('capsense', 'before')}, which is gone; its readings can be "
                'read, and method "surface" (capsense replay --method surface) simulates it anew'
            )
        return Simulator(
            self.design, method=method or cast("Method", self.method), preset=self.preset,
            excitation_frequency=self.excitation_frequency, settings=self.settings,
            cache_dir=cache_dir, progress=progress,
        )  # fmt: skip

    def new_readout(self) -> Readout | None:
        """The readout, as it was at the start; None where replaying cannot build it.

        Raises:
            ReadoutError: The chip is not known to this version.
        """
        if self.readout is None:
            return None
        return parse_readout(self.readout, self.design.electrode_names, source="the recording")

    def metadata(self) -> dict[str, str]:
        """What readers of MCAP show."""
        return {
            "format": str(FORMAT), "name": self.name, "title": self.title,
            "design": self.design.name, "design_hash": self.design.content_hash(),
            "method": self.method, **self.versions,
        }  # fmt: skip

    def to_json(self) -> str:
        """Everything but the design."""
        content = {
            "format": FORMAT, "name": self.name, "title": self.title, "method": self.method,
            "preset": self.preset, "frequency_Hz": self.excitation_frequency,
            "settings": asdict(self.settings), "electrodes": self.design.electrode_names,
            "empty_F": self.empty.capacitance.tolist(),
            "empty_shield_coupling_F": self.empty.shield_coupling.tolist(),
            "excitation": self.excitation, "pairs": self.pairs, "readout": self.readout,
            "versions": self.versions,
        }  # fmt: skip
        return json.dumps(content, indent=1)


def check_name(name: str) -> None:
    """Refuse what cannot be the name of a sensor.

    Raises:
        RecordingError: It is none.
    """
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise RecordingError(f"name is {name!r}; give letters, digits and underscores")


def make_readout(
    readout: Readout | str | Path | None, electrodes: Sequence[str], empty: Reading | None = None
) -> tuple[Readout | None, Mapping[str, Any] | None]:
    """A readout, and the content of its file where it has one or could have.

    Args:
        readout: A chip's name, the path of a readout file, a readout, or None.
        electrodes: Electrode names in matrix order.
        empty: The reading of an empty scene, which a named chip is set up for.

    Raises:
        ReadoutError: There is no such chip or file, or anything in it is wrong.
    """
    if readout is None or isinstance(readout, Readout):
        return readout, None
    config = file_content(readout, electrodes, empty)
    return parse_readout(config, electrodes, source=str(readout)), config


def describe(
    simulator: Simulator, name: str, readout: Mapping[str, Any] | None = None,
    scenario: Scenario | None = None,
) -> Session:  # fmt: skip
    """The session of a simulator as it is.

    Raises:
        RecordingError: Its sensor is given by a mesh, which recordings do not hold.
    """
    s = simulator
    if s.mesh is not None:
        raise RecordingError("a simulator on a mesh cannot be recorded; use one of a design")
    title, excitation = "", Excitation.MATRIX
    pairs: tuple[tuple[str, str], ...] = ()
    if scenario is not None:
        title, excitation, pairs = scenario.name, scenario.excitation, scenario.pairs
    return Session(
        name, title, s.design, s.method, s.preset, s.excitation_frequency, s.settings, s.empty,
        excitation, pairs, readout, versions(),
    )  # fmt: skip


def read_session(text: bytes, design: Design) -> Session:
    """The session that was written down.

    Raises:
        RecordingError: The text is damaged, or of another version.
    """
    try:
        data = json.loads(text)
        if data["format"] != FORMAT:
            raise RecordingError(
                f"the recording has format {data['format']!r}, but this version reads {FORMAT}; "
                f"it was made by capsense {data['versions']['capsense']}"
            )
        preset = data.get("preset", "standard")  # older files have none
        method = FORMER_METHODS.get(data["method"], data["method"])
        known = method in (*METHODS, *GONE) and preset in get_args(PresetName)
        if not known or tuple(data["electrodes"]) != design.electrode_names:
            raise RecordingError("the recording's settings do not fit its design; it is damaged")
        capacitance = np.array(data["empty_F"], dtype=float)
        coupling = np.array(data["empty_shield_coupling_F"], dtype=float)
        empty = reading_of(design, capacitance, np.zeros_like(capacitance), coupling)
        return Session(
            data["name"], data["title"], design, method, checked_preset(preset),
            data["frequency_Hz"],
            _read_settings(data["settings"]), empty, Excitation(data["excitation"]),
            tuple((a, b) for a, b in data["pairs"]), data["readout"], data["versions"],
        )  # fmt: skip
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        if isinstance(error, RecordingError):
            raise
        raise RecordingError(f"the recording's settings are damaged: {error!r}") from None


def _read_settings(data: Mapping[str, Any]) -> BuildSettings:
    """Settings from what is written down; earlier versions called the mesh a lattice, with more."""
    mesh = data["mesh"] if "mesh" in data else data["lattice"]
    known = {f.name: float(mesh[f.name]) for f in fields(MeshSettings)}
    return BuildSettings(float(data["panel_scale"]), MeshSettings(**known))


def reading_of(
    design: Design, capacitance: Array, delta: Array, coupling: Array,
    stats: StepStats = StepStats(0.0, 0.0),  # noqa: B008, it is immutable
) -> Reading:  # fmt: skip
    """A reading from its parts.

    Raises:
        RecordingError: They do not have the design's size.
    """
    n = len(design.electrode_names)
    if capacitance.size != n * n or delta.size != n * n or coupling.size != n:
        raise RecordingError(f"a reading is not one of {n} electrodes; the recording is damaged")
    return Reading(
        capacitance.reshape(n, n), delta.reshape(n, n), stats, design.electrode_names, coupling
    )
