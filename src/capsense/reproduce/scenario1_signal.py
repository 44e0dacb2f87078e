"""Scenario 1's signals: the bar's poses in, normalised readings of the front end out."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from capsense.readout.calibration import base_capacitance, relative_to
from capsense.readout.channels import ChannelBank, mutual_patterns
from capsense.readout.converter import ShuntLaw
from capsense.readout.front_end import ShuntFrontEnd, Wiring
from capsense.readout.noise import White
from capsense.readout.readout import Readout
from capsense.readout.schedule import Schedule
from capsense.reproduce.scenario1_setup import Array, Board, Scenario1Setup
from capsense.scene import Body, Box, Pose, Scene
from capsense.simulator import Simulator

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
