"""What poses a fleet takes, and how it compares its readings with finer ones."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense._validate import as_whole, shorten
from capsense.errors import SceneError
from capsense.fleet.bodies import FleetCheck
from capsense.scene import Body, Pose, Scene
from capsense.simulator import Simulator

if TYPE_CHECKING:
    from capsense.fleet import Fleet, Preset

Array = NDArray[np.float64]

_QUATERNION = 1e-3
"""Quaternions may be longer or shorter than 1 by so much; they are made 1 long."""


def compare(
    fleet: Fleet, poses: ArrayLike, sensors: ArrayLike | None, samples: int, seed: int
) -> FleetCheck:
    """See :meth:`Fleet.check`."""
    if fleet.finer is None:
        raise ValueError(
            'the fleet has preset "fine", and there is no finer one to check it against; '
            'make one with preset="standard"'
        )
    whole = as_whole(samples)
    if whole is None or whole < 1:
        raise SceneError(f"samples is {shorten(samples)}; give a whole number from 1")
    e, s, b = fleet.count, fleet.sensors, fleet.places
    where = checked_poses("poses", poses, (e, b, 7))
    at = np.broadcast_to(np.array([0.0] * 6 + [1.0]), (e, s, 7))
    if sensors is not None:
        at = checked_poses("sensors", sensors, (e, s, 7))
    delta = fleet.solved(where, at).delta
    found = delta if isinstance(delta, np.ndarray) else delta.numpy()
    rows = np.random.default_rng(seed).permutation(e)[:whole]
    group = fleet.table.bodies.group
    joined = len(np.unique(group)) < len(group)
    finer = _by_fleet if joined else _by_simulator
    truth, contact = finer(fleet, fleet.finer, rows, where[rows], at[rows])
    scale = np.maximum(np.abs(truth).max(axis=(2, 3), keepdims=True), 1e-18)
    errors = np.abs(found[rows] - truth) / scale
    row, sensor = np.unravel_index(errors.max(axis=(2, 3)).argmax(), contact.shape)
    return FleetCheck(
        tuple(rows.tolist()), float(np.sqrt((errors**2).mean())), float(errors.max()),
        (int(rows[row]), int(sensor)),
        tuple((int(rows[k]), int(j)) for k, j in np.argwhere(contact)),
    )  # fmt: skip


def _by_simulator(
    fleet: Fleet, preset: Preset, rows: NDArray[np.int64], where: Array, at: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Changes of the matrices in some environments [F], and where bodies touch electrodes."""
    simulator = Simulator(
        fleet.design, excitation_frequency=fleet.excitation_frequency, preset=preset
    )
    truth = np.empty((*at.shape[:2], *fleet.baseline.shape))
    contact = np.zeros(at.shape[:2], np.bool_)
    for k, j in np.ndindex(contact.shape):
        frame = Pose(at[k, j, :3], at[k, j, 3:]).inverse()
        bodies = zip(
            fleet.table.given[rows[k]], where[k], fleet.table.bodies.hidden[j], strict=True
        )
        reading = simulator.step(
            Scene(
                body.moved(frame @ Pose(pose[:3], pose[3:]))
                for body, pose, hidden in bodies
                if body is not None and not hidden
            )
        )
        truth[k, j] = reading.delta
        contact[k, j] = reading.stats.solver_error >= np.abs(reading.capacitance).max()
    return truth, contact


def _by_fleet(
    fleet: Fleet, preset: Preset, rows: NDArray[np.int64], where: Array, at: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """The same by a finer fleet, whose places are joined alike."""
    given, known = fleet.table.given[rows], fleet.table.bodies
    some: Body = next(body for body in fleet.table.given.ravel() if body is not None)
    finer = type(fleet)(
        fleet.design, [some] * fleet.places, len(rows), sensors=fleet.sensors, preset=preset,
        excitation_frequency=fleet.excitation_frequency,
    )  # fmt: skip
    for place in range(fleet.places):
        finer.change(place, given[:, place].tolist())
    for sensor, hidden in enumerate(known.hidden):
        finer.hide(sensor, np.flatnonzero(hidden).tolist())
    for number in np.unique(known.group):
        places = np.flatnonzero(known.group == number).tolist()
        if len(places) > 1:
            finer.join(places)
    reading = finer.solved(where, at)
    return reading.delta, reading.error >= np.abs(reading.capacitance).max(axis=(2, 3))


def require_no_gradient(what: str, values: Any) -> None:
    """Refuse tensors whose gradients would be lost.

    Raises:
        SceneError: It is such a tensor.
    """
    if getattr(values, "requires_grad", False):
        raise SceneError(
            f"{what} is a tensor that requires gradients, which step does not follow; give "
            f"{what}.detach(), or write capsense.fleet.autograd.change(fleet, poses)"
        )


def checked_poses(what: str, values: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Poses on the host, with quaternions of length 1.

    Raises:
        SceneError: They have another shape, are not finite, or their quaternions not 1 long.
    """
    require_no_gradient(what, values)
    poses = np.array(values, float, order="C")
    if poses.shape != shape:
        raise SceneError(f"{what} has shape {poses.shape}; give {shape}")
    if not np.isfinite(poses).all():
        place = tuple(np.argwhere(~np.isfinite(poses))[0].tolist())
        raise SceneError(f"{what}{list(place)} is {poses[place]}; poses must be finite")
    length = np.linalg.norm(poses[..., 3:], axis=-1, keepdims=True)
    if (np.abs(length - 1.0) > _QUATERNION).any():
        place = tuple(np.argwhere(np.abs(length - 1.0) > _QUATERNION)[0].tolist())
        raise SceneError(
            f"the quaternion of {what}{list(place[:-1])} is {length[place]:g} long; give (x, y, z, "
            "w) of length 1"
        )
    poses[..., 3:] /= length
    return poses
