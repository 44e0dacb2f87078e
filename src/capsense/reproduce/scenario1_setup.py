"""Scenario 1's set-up: what its file states, and where the bar is when."""

from __future__ import annotations

import csv
import dataclasses
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense.design import Design, Role, load_design
from capsense.errors import ScenarioError
from capsense.scenario.schema import Table
from capsense.scenario.trajectory import Trajectory
from capsense.scene import Pose

Array = NDArray[np.float64]
DATA = files("capsense.reproduce") / "data"
FILE = "scenario1.toml"


@dataclass(frozen=True)
class Board:
    """A sensor of the scenario, and how it is read."""

    design: str
    pair: tuple[str, str]
    """Transmitter and receiver."""
    depth: float
    """How far the triangle in front of it goes away from the line across it [m]."""
    sample_rate: float
    """[Hz]"""
    level: float
    """What the reading without an object is normalised to."""
    gain: float
    """Of the amplifier."""
    panel: str = ""
    """File with the curves of the paper's figure; empty without one."""

    def sensor(self, pour: str) -> Design:
        """The packaged design with its pour and back plane at a potential.

        Args:
            pour: ``"ground"``, as packaged, or ``"floating"``.
        """
        design = load_design(self.design)
        role = Role(pour)
        copper = tuple(dataclasses.replace(part, role=role) for part in design.conductors)
        return dataclasses.replace(design, conductors=copper)


@dataclass(frozen=True)
class Setup:
    """Everything that scenario 1 depends on; SI units, tilt in degrees."""

    speeds: tuple[float, ...]
    panel_speed: float
    frequency: float
    pour: str
    """Potential of the boards' pours and back planes, see :meth:`Board.sensor`."""
    size: tuple[float, float, float]
    material: str
    half_line: float
    gap: float
    tilt: float
    offset: float
    rest: float
    trajectories: Mapping[str, tuple[tuple[float, float], ...]]
    stray: float
    shunt: float
    full_scale: float
    conversion: float
    noise: float
    boards: Mapping[str, Board]
    uncertainty: Mapping[str, float]
    """Standard uncertainties; its keys are those of the fitted figures, see :meth:`value`."""

    def value(self, key: str) -> float:
        """A figure by name, ``"gap"``, or ``"stripe.level"`` for one of a board's."""
        name, _, own = key.partition(".")
        return float(getattr(self.boards[name], own) if own else getattr(self, name))

    def changed(self, values: Mapping[str, float]) -> Setup:
        """The same with other figures, by the names of :meth:`value`."""
        boards = dict(self.boards)
        top: dict[str, Any] = {}
        for key, value in values.items():
            name, _, own = key.partition(".")
            if own:
                change: dict[str, Any] = {own: float(value)}
                boards[name] = dataclasses.replace(boards[name], **change)
            else:
                top[name] = float(value)
        return dataclasses.replace(self, boards=boards, **top)

    def path(self, board: str, trajectory: str, speed: float) -> Trajectory:
        """The way of the bar's centre in the sensor frame, without the rest at its start.

        Args:
            board: Name of the board.
            trajectory: Name, ``"T1"`` to ``"T4"``.
            speed: [m/s]
        """
        angle = -math.radians(self.tilt)  # a positive tilt lifts the bar at positive x
        middle = (self.offset, 0.0, self.gap + 0.5 * self.size[2])
        corners = [
            (x * self.half_line, 0.0, z * self.boards[board].depth)
            for x, z in self.trajectories[trajectory]
        ]
        points = Pose.from_euler(middle, (0.0, angle, 0.0)).apply(np.array(corners))
        poses = tuple(Pose(point) for point in points)
        return Trajectory(poses, (speed,) * len(poses), closed=True)

    def poses(self, board: str, trajectory: str, speed: float, times: ArrayLike) -> list[Pose]:
        """Poses of the bar at times [s] since the start of a recording."""
        path = self.path(board, trajectory, speed)
        return [path.pose_at(t - self.rest) for t in np.asarray(times, dtype=float).tolist()]


def load_setup() -> Setup:
    """Read the packaged file.

    Raises:
        ScenarioError: A key is missing, unknown or wrong.
    """
    return parse_setup(tomllib.loads((DATA / FILE).read_text(encoding="utf-8")))


_TOP = ("speeds", "panel_speed", "frequency", "pour", "bar", "path", "trajectories", "front_end",
        "board", "uncertainty")  # fmt: skip
_PATH = {"half_line": 1.0, "gap": 1.0, "tilt": 45.0, "offset": 1.0, "rest": 1e3}
_FRONT_END = {"stray": 1e-9, "shunt": 1e9, "full_scale": 1e3, "conversion": 10.0, "noise": 1e-9}


def parse_setup(data: Mapping[str, Any]) -> Setup:
    """Read the content of such a file.

    Raises:
        ScenarioError: A key is missing, unknown or wrong.
    """
    top = Table(data, FILE, "scenario 1")
    top.only(_TOP)

    def part(name: str) -> Table:
        return Table(top.raw(name, "a table"), FILE, name)

    path, front, bar, ways = (part(n) for n in ("path", "front_end", "bar", "trajectories"))
    speeds = top.series("speeds", 1e-6, 1e3, "m/s")
    a, b, c = bar.sizes("size", 3, "[x, y, z] in metres")
    boards = [_board(Table(raw, FILE, f"board {n}")) for n, raw in enumerate(top.tables("board"))]
    setup = Setup(
        speeds=tuple(speeds) if isinstance(speeds, list) else (speeds,),
        panel_speed=top.number("panel_speed", 1e-6, 1e3, unit="m/s"),
        frequency=top.number("frequency", 1.0, 1e12, unit="Hz"),
        pour=top.choice("pour", (Role.GROUND, Role.FLOATING)),
        size=(a, b, c),
        material=bar.string("material"),
        **{key: path.number(key, -limit, limit) for key, limit in _PATH.items()},
        trajectories={
            name: tuple((x, z) for x, z in ways.vectors(name, 2, "[x, z]")) for name in ways.data
        },
        **{key: front.number(key, 0.0, limit) for key, limit in _FRONT_END.items()},
        boards={board.design: board for board in boards},
        uncertainty={key: part("uncertainty").number(key, 0.0, 1e3) for key in data["uncertainty"]},
    )
    for key in setup.uncertainty:
        try:
            setup.value(key)
        except (KeyError, AttributeError):
            raise ScenarioError(f"{FILE}: uncertainty: there is no figure {key!r}") from None
    return setup


def _board(table: Table) -> Board:
    table.only([f.name for f in dataclasses.fields(Board)])
    pair = table.raw("pair", '["E1", "E2"]')
    if not (isinstance(pair, list) and len(pair) == 2):
        raise table.error(f'pair = {pair!r} must be two electrodes, like ["E1", "E2"]')
    return Board(
        table.string("design"),
        (str(pair[0]), str(pair[1])),
        table.number("depth", 1e-3, 1.0, unit="m"),
        table.number("sample_rate", 1e-3, 1e6, unit="Hz"),
        table.number("level", 0.0, 10.0),
        table.number("gain", 1e-6, 1e9),
        table.string("panel", "") if "panel" in table else "",
    )


PANEL_SAMPLES = 250
"""Samples of the paper's triangular panels."""


@dataclass(frozen=True, eq=False)
class Panel:
    """The two curves of a panel of the paper's Fig. 9, at samples 1 to 250."""

    measured: Array
    """Hardware, normalised, shape (250,)."""
    simulated: Array
    """The paper's simulation, normalised, shape (250,)."""


def load_panel(name: str) -> Panel:
    """Read a panel; points were read off the vector figure, and are interpolated to samples."""
    text = (DATA / name).read_text(encoding="utf-8")
    rows = list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))
    curves = []
    for series in ("measured", "simulated"):
        points = [
            (float(row["sample"]), float(row["norm_capacitance"]))
            for row in rows
            if row["series"] == series
        ]
        sample, value = np.array(points).T
        curves.append(np.interp(np.arange(1, PANEL_SAMPLES + 1), sample, value))
    return Panel(*curves)
