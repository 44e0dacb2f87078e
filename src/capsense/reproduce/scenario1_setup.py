"""Scenario 1's set-up: what its file states, where the bar is when, and how the board is read."""

from __future__ import annotations

import csv
import dataclasses
import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense.design import Design, Role, load_design
from capsense.readout import Readout
from capsense.readout.calibration import base_capacitance, relative_to
from capsense.readout.channels import ChannelBank, Wiring, mutual_patterns
from capsense.readout.conversions import Schedule
from capsense.readout.laws import ShuntFrontEnd, ShuntLaw
from capsense.readout.noise import White
from capsense.scenario.model import Trajectory
from capsense.scene import Body, Box, Pose, Scene
from capsense.simulator import Simulator

Array = NDArray[np.float64]
DATA = files("capsense.reproduce") / "data"
FILE = "scenario1.toml"
TRIANGLE, ZIGZAG = "T2", "T4"


@dataclass(frozen=True)
class Board:
    """A sensor of the scenario, and how it is read."""

    design: str
    pair: tuple[str, str]
    """Transmitter and receiver."""
    height: float
    """How much nearer to the bar it lies than the stripe board [m]."""
    depth: float
    """How far the triangle in front of it goes away from the line across it [m]."""
    gain: float
    """Of the amplifier."""

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
class Panel:
    """A recording: a board on a trajectory at the panels' speed."""

    board: str
    trajectory: str
    samples: int
    level: float | None = None
    """What the reading without an object is normalised to; if none, as in the others."""
    pace: float = 1.0
    """Its samples per second, as a multiple of the sample rate of the others."""
    file: str = ""
    """With the curves of the paper's figure; empty where they are not given."""

    @property
    def name(self) -> str:
        """Like ``"stripe_T2"``."""
        return f"{self.board}_{self.trajectory}"


@dataclass(frozen=True)
class Zigzag:
    """Trajectory T4: to and fro in front of the board while the bar drifts across it, once."""

    teeth: int
    """How often the bar is near while it crosses; it also starts and ends near."""
    depth: float
    """Of a tooth, away from the board [m]."""
    pitch: float
    """From tooth to tooth along x [m]."""
    lift: float
    """How much farther than the line across the sensor a tooth's tip stays [m]."""
    start: float
    """How much farther than a tooth's tip the bar starts [m]."""

    def corners(self) -> Array:
        """Along x from the board's middle and away from the line across it [m], shape (n, 2)."""
        steps = np.arange(2 * self.teeth + 4)
        x = 0.5 * self.pitch * (steps - self.teeth - 1)
        away = self.lift + self.depth * (steps % 2)
        away[0] += self.start
        return np.stack([x, away], axis=1)


@dataclass(frozen=True)
class Scenario1Setup:
    """Everything that scenario 1 depends on; SI units, tilt in degrees."""

    speeds: Sequence[float]
    panel_speed: float
    sample_rate: float
    level: float
    """What readings without an object are normalised to where a panel has none of its own."""
    excitation_frequency: float
    pour: str
    """Potential of the boards' pours and back planes, see :meth:`Board.sensor`."""
    size: tuple[float, float, float]
    material: str
    half_line: float
    gap: float
    tilt: float
    offset: float
    rest: float
    trajectories: Mapping[str, Sequence[Sequence[float]]]
    """Corners of T1 to T3, as multiples of :attr:`half_line` and of a board's depth."""
    zigzag: Zigzag
    stray: float
    shunt: float
    full_scale: float
    conversion: float
    noise: float
    boards: Mapping[str, Board]
    panels: Mapping[str, Panel]
    """By :attr:`Panel.name`."""
    uncertainty: Mapping[str, float]
    """Standard uncertainties; its keys are those of the fitted figures, see :meth:`value`."""

    def value(self, key: str) -> float:
        """A figure by name, like ``"gap"``, ``"stripe.depth"`` or ``"patch_T2.pace"``.

        Raises:
            KeyError: There is no such figure.
        """
        name, _, own = key.rpartition(".")
        parts = {"": self, "zigzag": self.zigzag, **self.boards, **self.panels}
        return float(vars(parts[name])[own])

    def level_of(self, panel: Panel) -> float:
        """What a panel's reading without an object is normalised to."""
        return self.level if panel.level is None else panel.level

    @property
    def ways(self) -> tuple[str, ...]:
        """Names of all trajectories."""
        return (*self.trajectories, ZIGZAG)

    def path(self, board: str, trajectory: str, speed: float) -> Trajectory:
        """The way of the bar's centre in the sensor frame, without the rest at its start.

        Args:
            board: Name of the board.
            trajectory: Name, ``"T1"`` to ``"T4"``.
            speed: [m/s]
        """
        if trajectory == ZIGZAG:
            flat = self.zigzag.corners() - [self.offset, 0.0]
        else:
            scale = [self.half_line, self.boards[board].depth]
            flat = np.array(self.trajectories[trajectory]) * scale
        angle = -math.radians(self.tilt)  # a positive tilt lifts the bar at positive x
        height = self.gap - self.boards[board].height + 0.5 * self.size[2]
        corners = np.insert(flat, 1, 0.0, axis=1)
        points = Pose.from_euler((self.offset, 0.0, height), (0.0, angle, 0.0)).apply(corners)
        poses = tuple(Pose(point) for point in points)
        return Trajectory(poses, (speed,) * len(poses), closed=True)

    def poses(self, board: str, trajectory: str, speed: float, times: ArrayLike) -> list[Pose]:
        """Poses of the bar at times [s] since the start of a recording."""
        path = self.path(board, trajectory, speed)
        return [path.pose_at(t - self.rest) for t in np.asarray(times, dtype=float).tolist()]

    def times(self, panel: Panel) -> Array:
        """Of a panel's samples [s], shape (samples,)."""
        return np.arange(panel.samples) / (self.sample_rate * panel.pace)


def load_setup() -> Scenario1Setup:
    """What the packaged file states; the classes refuse keys that they do not know."""
    data = tomllib.loads((DATA / FILE).read_text(encoding="utf-8"))
    boards = [Board(**{**raw, "pair": tuple(raw["pair"])}) for raw in data.pop("board")]
    panels = [Panel(**raw) for raw in data.pop("panel")]
    zigzag = Zigzag(**data.pop("zigzag"))
    for part in ("bar", "path", "front_end"):
        data.update(data.pop(part))
    data["size"] = tuple(data["size"])
    return Scenario1Setup(
        **data,
        zigzag=zigzag,
        boards={board.design: board for board in boards},
        panels={panel.name: panel for panel in panels},
    )


@dataclass(frozen=True, eq=False)
class PaperCurves:
    """The two curves of a panel of the paper's Fig. 9, at samples 1 to n."""

    measured: Array
    """Hardware, normalised, shape (n,)."""
    simulated: Array
    """The paper's simulation, normalised, shape (n,)."""


def load_curves(panel: Panel) -> PaperCurves:
    """Read a panel; points were read off the vector figure, and are interpolated to samples."""
    text = (DATA / panel.file).read_text(encoding="utf-8")
    rows = list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))
    curves = []
    for series in ("measured", "simulated"):
        points = [
            (float(row["sample"]), float(row["norm_capacitance"]))
            for row in rows
            if row["series"] == series
        ]
        sample, value = np.array(points).T
        curves.append(np.interp(np.arange(1, panel.samples + 1), sample, value))
    return PaperCurves(*curves)


CALIBRATION_SAMPLES = 100
"""Readings without an object that the base capacitance is the mean of."""


def matrices(sim: Simulator, setup: Scenario1Setup, poses: list[Pose]) -> Array:
    """Maxwell matrices of the simulator with the bar at poses [F], shape (n, M, M)."""
    sim.reset()
    return np.array(
        [
            sim.step(Scene([Body(Box(setup.size), pose, setup.material)])).capacitance
            for pose in poses
        ]
    )


def mutual(matrix: Array, names: tuple[str, ...], pair: tuple[str, str]) -> Array:
    """Mutual capacitance of a pair [F], of matrices of shape (..., M, M)."""
    i, j = (names.index(name) for name in pair)
    return -matrix[..., i, j]


def readout_of(setup: Scenario1Setup, board: Board, *, noise: bool, seed: int = 0) -> Readout:
    """The radio behind the front end, reading the board's pair at the sample rate."""
    front_end = ShuntFrontEnd(setup.excitation_frequency, setup.shunt, board.gain)
    return Readout(
        ChannelBank(mutual_patterns(board.pair), board.pair),
        Schedule.simultaneous(1, setup.conversion, period=1.0 / setup.sample_rate),
        ShuntLaw(front_end, setup.full_scale),
        wiring=Wiring(coupling=setup.stray),
        stages=[White(setup.noise)] if noise else [],
        seed=seed,
    )


def normalised(
    setup: Scenario1Setup,
    board: Board,
    capacitance: ArrayLike,
    empty: float,
    *,
    noise: bool,
    seed: int = 0,
) -> Array:
    """What the front end makes of capacitances, over what it reads without an object.

    Args:
        setup: The scenario.
        board: The board.
        capacitance: Mutual capacitances at the samples [F], shape (n,).
        empty: The same without an object [F].
        noise: Whether readings are noisy; they are rounded in any case.
        seed: Of the noise.

    Returns:
        Readings over the base capacitance, shape (n,).
    """
    chain = readout_of(setup, board, noise=noise, seed=seed)
    values = [*np.full(CALIBRATION_SAMPLES, empty), *np.asarray(capacitance, dtype=float)]
    times = chain.due((len(values) - 0.5) / setup.sample_rate)
    parts = [
        chain.sample(time, [value]).capacitance for time, value in zip(times, values, strict=True)
    ]
    parts.append(chain.sample(times[-1] + setup.conversion, values[-1:]).capacitance)
    readings = np.concatenate(parts)
    base = base_capacitance(readings[:CALIBRATION_SAMPLES])
    return relative_to(readings[CALIBRATION_SAMPLES:], base)
