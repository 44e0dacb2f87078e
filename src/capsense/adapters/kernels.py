"""Compiled placing of a simulator's solids in the frame of a sensor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from capsense._jit import compiled

Array = NDArray[np.float64]


@compiled
def _multiply(a: Array, b: Array, out: Array) -> None:
    """Quaternion product a b, (x, y, z, w)."""
    x1, y1, z1, w1 = a[0], a[1], a[2], a[3]
    x2, y2, z2, w2 = b[0], b[1], b[2], b[3]
    out[0] = w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2
    out[1] = w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2
    out[2] = w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2
    out[3] = w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2


@compiled
def _rotate(q: Array, v: Array, out: Array) -> None:
    """Turn v by the unit quaternion q: v + 2 u × (u × v + w v), with q = (u, w)."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    vx, vy, vz = v[0], v[1], v[2]
    cx = y * vz - z * vy + w * vx
    cy = z * vx - x * vz + w * vy
    cz = x * vy - y * vx + w * vz
    out[0] = vx + 2.0 * (y * cz - z * cy)
    out[1] = vy + 2.0 * (z * cx - x * cz)
    out[2] = vz + 2.0 * (x * cy - y * cx)


@compiled
def place_solids(
    frame_position: Array,
    frame_quaternion: Array,
    frame: NDArray[np.int64],
    local_position: Array,
    local_quaternion: Array,
    centre: Array,
    half: Array,
    depth: Array,
    sensor_position: Array,
    sensor_quaternion: Array,
    lower: Array,
    upper: Array,
    position: Array,
    quaternion: Array,
    seen: NDArray[np.bool_],
) -> None:
    """Find where solids stand in the sensor frame, and which of them reach into its domain.

    Args:
        frame_position: Origins of the simulator's moving frames [m] in the world, shape (f, 3).
        frame_quaternion: Their unit quaternions (x, y, z, w), shape (f, 4).
        frame: Frame of each solid, shape (n,).
        local_position: Origins of the solids [m] in their frames, shape (n, 3).
        local_quaternion: Their unit quaternions, shape (n, 4).
        centre: Centres of the solids' own bounding boxes [m], shape (n, 3).
        half: Half edge lengths of those boxes [m], shape (n, 3).
        depth: Zero for a solid; for a half space below its local plane z = 0, the thickness
            [m] of the plate that stands for it, shape (n,).
        sensor_position: Origin of the sensor frame [m] in the world, shape (3,).
        sensor_quaternion: Its unit quaternion, shape (4,).
        lower: Lower corner of the domain [m] in the sensor frame, shape (3,).
        upper: Upper corner, shape (3,).
        position: Receives the origins of the solids [m] in the sensor frame, shape (n, 3).
        quaternion: Receives their quaternions, shape (n, 4).
        seen: Receives whether the bounding box reaches into the domain, shape (n,).
    """
    inverse = sensor_quaternion * np.array([-1.0, -1.0, -1.0, 1.0])
    turn, arm, axis = np.empty(4), np.empty(3), np.empty(3)
    middle, reach = np.empty(3), np.empty(3)
    for i in range(frame.shape[0]):
        f = frame[i]
        _multiply(frame_quaternion[f], local_quaternion[i], turn)
        _rotate(frame_quaternion[f], local_position[i], arm)
        for k in range(3):
            arm[k] += frame_position[f, k] - sensor_position[k]
        _multiply(inverse, turn, quaternion[i])
        _rotate(inverse, arm, position[i])
        if depth[i] > 0.0:
            axis[:] = 0.0
            axis[2] = 1.0
            _rotate(quaternion[i], axis, arm)
            above, extent = 0.0, 0.0
            for k in range(3):
                above += arm[k] * (0.5 * (lower[k] + upper[k]) - position[i, k])
                extent += abs(arm[k]) * 0.5 * (upper[k] - lower[k])
            for k in range(3):
                foot = 0.5 * (lower[k] + upper[k]) - above * arm[k]
                position[i, k] = foot - 0.5 * depth[i] * arm[k]
            seen[i] = above < extent
            continue
        _rotate(quaternion[i], centre[i], middle)
        reach[:] = 0.0
        for j in range(3):
            axis[:] = 0.0
            axis[j] = half[i, j]
            _rotate(quaternion[i], axis, arm)
            for k in range(3):
                reach[k] += abs(arm[k])
        seen[i] = True
        for k in range(3):
            at = position[i, k] + middle[k]
            if at - reach[k] >= upper[k] or at + reach[k] <= lower[k]:
                seen[i] = False
