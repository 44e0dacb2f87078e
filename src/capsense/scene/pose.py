"""Rigid poses: where a body stands in the sensor frame."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense._frozen import Frozen, read_only
from capsense.errors import SceneError

Array = NDArray[np.float64]
Vec3 = tuple[float, float, float]
Vec4 = tuple[float, float, float, float]

_MIN_NORM = 1e-9
_ORTHONORMAL_TOLERANCE = 1e-6


def as_float(value: object) -> float:
    """A value as a float, NaN if it is no number."""
    try:
        return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return math.nan


def checked_floats(values: object, count: int, what: str, fix: str) -> tuple[float, ...]:
    """Turn ``values`` into ``count`` finite floats, or raise :class:`SceneError`."""
    try:
        out = tuple([float(v) for v in values])  # type: ignore[attr-defined]
    except (TypeError, ValueError, OverflowError):
        raise SceneError(f"{what} is {values!r}; {fix}") from None
    if len(out) != count:
        raise SceneError(f"{what} has {len(out)} entries; {fix}")
    for v in out:
        if not math.isfinite(v):
            raise SceneError(f"{what} is {out}, which is not finite; {fix}")
    return out


@dataclass(frozen=True, init=False)
class Pose(Frozen):
    """A rotation followed by a translation: ``x_sensor = R x_local + position``.

    Poses are immutable, hashable and cheap to make, because bodies move at every step.

    Args:
        position: Origin of the body's frame [m] in the sensor frame, three numbers.
        quaternion: Orientation (x, y, z, w), scalar last. It is normalised; any length above
            1e-9 is accepted.

    Raises:
        SceneError: A number is missing or not finite, or the quaternion is zero.
    """

    position: Vec3
    """Origin of the body's frame [m] in the sensor frame."""
    quaternion: Vec4
    """Unit quaternion (x, y, z, w) that turns the body's axes into the sensor frame."""

    def __init__(
        self,
        position: Sequence[float] | Array = (0.0, 0.0, 0.0),
        quaternion: Sequence[float] | Array = (0.0, 0.0, 0.0, 1.0),
    ) -> None:
        px, py, pz = checked_floats(
            position, 3, "position", "give three numbers (x, y, z) in metres"
        )
        x, y, z, w = checked_floats(
            quaternion, 4, "quaternion", "give four numbers in the order (x, y, z, w)"
        )
        norm = math.hypot(x, y, z, w)
        if norm < _MIN_NORM:
            raise SceneError(
                f"quaternion is {(x, y, z, w)}, of length zero; no rotation is (0, 0, 0, 1)"
            )
        fields = self.__dict__
        fields["position"] = (px, py, pz)
        fields["quaternion"] = (x / norm, y / norm, z / norm, w / norm)

    @classmethod
    def from_unit(cls, position: Sequence[float], quaternion: Sequence[float]) -> Pose:
        """Make a pose with exactly the unit quaternion given, such as one written to a file.

        ``Pose(…)`` divides by the length, which may change the last digit of its own result.

        Raises:
            SceneError: As for the class, or the length differs from 1 by more than 1e-12.
        """
        pose = cls(position, quaternion)
        given = tuple([float(q) for q in quaternion])
        if abs(math.hypot(*given) - 1.0) > 1e-12:
            raise SceneError(f"quaternion is {given}, whose length is not 1; write Pose(…)")
        pose.__dict__["quaternion"] = given
        return pose

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> Pose:
        """Make a pose from a homogeneous transform.

        Args:
            matrix: Shape (4, 4), translation in metres; or shape (3, 3), a rotation alone.

        Raises:
            SceneError: Wrong shape, a number that is not finite, or a rotation part that
                scales, shears or mirrors by more than 1e-6.
        """
        m = np.asarray(matrix, dtype=float)
        if m.shape not in ((3, 3), (4, 4)):
            raise SceneError(f"matrix has shape {m.shape}; give (4, 4), or (3, 3) for a rotation")
        if not np.isfinite(m).all():
            raise SceneError("matrix holds a number that is not finite")
        if m.shape == (4, 4) and not np.allclose(m[3], (0.0, 0.0, 0.0, 1.0)):
            raise SceneError(f"matrix ends in the row {m[3].tolist()}; it must be 0, 0, 0, 1")
        r = m[:3, :3]
        deviation = float(np.abs(r @ r.T - np.eye(3)).max())
        if deviation > _ORTHONORMAL_TOLERANCE or np.linalg.det(r) < 0:
            raise SceneError(
                f"the rotation part of the matrix is not a rotation (|R R^T - 1| = "
                f"{deviation:.2g}, det = {np.linalg.det(r):.3g}); scale the shape, not the pose"
            )
        position = m[:3, 3] if m.shape == (4, 4) else (0.0, 0.0, 0.0)
        return cls(position, matrix_to_quaternion(r))

    @classmethod
    def from_mujoco(cls, position: Sequence[float] | Array, orientation: ArrayLike) -> Pose:
        """Make a pose from what MuJoCo tells, such as ``data.xpos[k], data.xquat[k]``.

        Args:
            position: Origin of the body's frame [m], shape (3,).
            orientation: A quaternion in MuJoCo's order (w, x, y, z), shape (4,); or a rotation
                matrix, row by row, shape (9,) or (3, 3), as ``data.xmat[k]``, ``data.site_xmat[k]``
                and ``data.geom_xmat[k]`` are.

        Raises:
            SceneError: Wrong shape, a number that is not finite, a quaternion of zeros, or a matrix
                that scales, shears or mirrors by more than 1e-6.
        """
        try:
            given = np.asarray(orientation, dtype=float)
        except (TypeError, ValueError):
            given = np.empty(0)
        if given.shape == (4,):
            w, x, y, z = given.tolist()
            return cls(position, (x, y, z, w))
        if given.shape not in ((9,), (3, 3)):
            raise SceneError(
                f"orientation has shape {given.shape}; give a quaternion (w, x, y, z), "
                "or a rotation matrix of shape (9,) or (3, 3)"
            )
        return cls(position, cls.from_matrix(given.reshape(3, 3)).quaternion)

    @classmethod
    def from_euler(
        cls,
        position: Sequence[float] | Array,
        angles: Sequence[float] | Array,
        *,
        degrees: bool = False,
    ) -> Pose:
        """Make a pose from roll, pitch and yaw about the fixed axes x, y, z, in that order.

        This is the convention of URDF and PyBullet: ``R = Rz(yaw) Ry(pitch) Rx(roll)``.

        Args:
            position: Origin of the body's frame [m], three numbers.
            angles: Roll, pitch, yaw [rad], or degrees where ``degrees`` is set.
            degrees: Whether the angles are in degrees.

        Radians beyond ±2π look like degrees, and are warned of once at each place.

        Raises:
            SceneError: A number is missing or not finite.
        """
        rpy = checked_floats(angles, 3, "angles", "give three numbers (roll, pitch, yaw)")
        if not degrees and max(map(abs, rpy)) > 2 * math.pi:
            warnings.warn(
                "Pose.from_euler was given an angle beyond ±2π rad; if it is in degrees, write "
                "Pose.from_euler(position, angles, degrees=True), or else take off whole turns",
                stacklevel=2,
            )
        half = [0.5 * (math.radians(a) if degrees else a) for a in rpy]
        (cr, cp, cy), (sr, sp, sy) = map(math.cos, half), map(math.sin, half)
        return cls(
            position,
            (
                sr * cp * cy - cr * sp * sy,
                cr * sp * cy + sr * cp * sy,
                cr * cp * sy - sr * sp * cy,
                cr * cp * cy + sr * sp * sy,
            ),
        )

    @cached_property
    def rotation(self) -> Array:
        """Rotation matrix from the body's frame to the sensor frame, shape (3, 3), read-only."""
        x, y, z, w = self.quaternion
        rows = (
            (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
            (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
            (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
        )
        return read_only(np.array(rows))

    @property
    def matrix(self) -> Array:
        """Homogeneous transform from the body's frame to the sensor frame, shape (4, 4)."""
        m = np.eye(4)
        m[:3, :3] = self.rotation
        m[:3, 3] = self.position
        return m

    def apply(self, points: ArrayLike) -> Array:
        """Map points from the body's frame to the sensor frame [m], shape (..., 3)."""
        return np.asarray(points, dtype=float) @ self.rotation.T + self.position

    def inverse(self) -> Pose:
        """Return the pose that undoes this one."""
        x, y, z, w = self.quaternion
        return Pose(-(self.rotation.T @ self.position), (-x, -y, -z, w))

    def __matmul__(self, other: Pose) -> Pose:
        """Chain poses: ``(a @ b).apply(p) == a.apply(b.apply(p))``."""
        if not isinstance(other, Pose):
            return NotImplemented
        x1, y1, z1, w1 = self.quaternion
        x2, y2, z2, w2 = other.quaternion
        return Pose(
            self.apply(other.position),
            (
                w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
                w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
                w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
                w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            ),
        )


def matrix_to_quaternion(r: Array) -> Vec4:
    """Return the quaternion (x, y, z, w) of a rotation matrix, by Shepperd's method.

    The largest of the four components is found first, so nothing is divided by a small number.
    """
    squares = (
        1 + r[0, 0] - r[1, 1] - r[2, 2],
        1 - r[0, 0] + r[1, 1] - r[2, 2],
        1 - r[0, 0] - r[1, 1] + r[2, 2],
        1 + r[0, 0] + r[1, 1] + r[2, 2],
    )
    a, b, c = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    xy, xz, yz = r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1]
    largest = max(range(4), key=squares.__getitem__)
    rows = (
        (squares[0], xy, xz, a),
        (xy, squares[1], yz, b),
        (xz, yz, squares[2], c),
        (a, b, c, squares[3]),
    )
    x, y, z, w = (float(v) for v in rows[largest])
    return x, y, z, w


def checked_pose(pose: object, what: str = "pose") -> Pose:
    """A pose; anything else is refused by the name ``what``.

    Raises:
        SceneError: It is none.
    """
    if not isinstance(pose, Pose):
        raise SceneError(f"{what} is {pose!r}; give a Pose(position, quaternion)")
    return pose
