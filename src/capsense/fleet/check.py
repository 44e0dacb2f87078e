"""How a fleet's readings are compared with finer ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capsense.fleet.bodies import BodyTable
from capsense.scene import Pose, Scene
from capsense.simulator import Simulator

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FleetCheck:
    """Errors of some environments against :class:`Simulator`, over each one's largest entry."""

    environments: tuple[int, ...]
    """Which environments."""
    rms: float
    """Root of the mean square over all entries."""
    worst: float
    """The largest."""
    where: tuple[int, int]
    """Environment and sensor that have it."""
    contact: tuple[tuple[int, int], ...] = ()
    """Environments and sensors whose readings mean nothing: a bare electrode lies inside a body,
    or touches a conductor."""
    lifted: tuple[tuple[int, int], ...] = ()
    """Environments and sensors whose readings lack the first millimetres in front of a design:
    of conductors where matter has losses, which the readings that they are compared with lack, too.
    On Warp also of dielectrics, of all bodies near a bent film, and where more than 8 conductors
    that are not at ground are near.
    Gaps between bodies that Warp does not resolve are part of ``rms`` and ``worst``.
    """


def by_simulator(
    simulator: Simulator, table: BodyTable, rows: NDArray[np.int64], where: Array, at: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Read some environments with a simulator.

    Args:
        simulator: Of the fleet's design.
        table: What stands in the fleet's places.
        rows: Numbers of the environments, shape (k,).
        where: Poses of the bodies in these, shape (k, b, 7).
        at: Poses of the sensors, shape (k, s, 7).

    Returns:
        Changes of the matrices [F], shape (k, s, n, n), and whether bodies touch electrodes,
        shape (k, s).
    """
    electrodes = len(simulator.electrode_names)
    truth = np.empty((*at.shape[:2], electrodes, electrodes))
    contact = np.zeros(at.shape[:2], np.bool_)
    for k, j in np.ndindex(contact.shape):
        frame = Pose(at[k, j, :3], at[k, j, 3:]).inverse()
        bodies = zip(table.given[rows[k]], where[k], table.bodies.hidden[j], strict=True)
        reading = simulator.step(
            Scene(
                body.moved(frame @ Pose(pose[:3], pose[3:]))
                for body, pose, hidden in bodies
                if body is not None and not hidden
            )
        )
        truth[k, j] = reading.delta
        contact[k, j] = reading.in_contact
    return truth, contact


def summary(
    found: Array, truth: Array, contact: NDArray[np.bool_], rows: NDArray[np.int64],
    lifted: NDArray[np.bool_],
) -> FleetCheck:  # fmt: skip
    """Errors of what was found in some environments.

    Args:
        found: Changes of the matrices [F], shape (k, s, n, n).
        truth: What they should be, the same shape.
        contact: Whether bodies touch electrodes, shape (k, s).
        rows: Numbers of the environments, shape (k,).
        lifted: Whether readings lack the first millimetres, shape (k, s).
    """
    scale = np.maximum(np.abs(truth).max(axis=(2, 3), keepdims=True), 1e-18)
    errors = np.abs(found - truth) / scale
    row, sensor = np.unravel_index(errors.max(axis=(2, 3)).argmax(), contact.shape)
    return FleetCheck(
        tuple(rows.tolist()), float(np.sqrt((errors**2).mean())), float(errors.max()),
        (int(rows[row]), int(sensor)),
        *(
            tuple((int(rows[k]), int(j)) for k, j in np.argwhere(some))
            for some in (contact, lifted)
        ),
    )  # fmt: skip
