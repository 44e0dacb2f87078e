"""Depth cameras: where the pixels of their images stand in the sensor frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense.errors import SceneError
from capsense.scene.pose import Pose, as_float

Array = NDArray[np.float64]

_HALF_TURN = Pose(quaternion=(1.0, 0.0, 0.0, 0.0))
"""From the camera frame used here to that of OpenGL: y and z change sign."""


@dataclass(frozen=True)
class OrthographicCamera:
    """A camera with parallel rays.

    In its own frame it looks along +z; x and y span the image, whose middle is the origin. With
    the default pose it sits at the sensor's origin and looks out of the sensor.

    Raises:
        SceneError: A length is not a positive finite number, ``far`` does not exceed ``near``, or a
            pixel order is unknown.
    """

    width: float = 0.5
    """Extent of the image along the camera's x [m]."""
    height: float = 0.5
    """Extent of the image along the camera's y [m]."""
    pose: Pose = field(default_factory=Pose)
    """The camera's frame in the sensor frame."""
    near: float = 0.0
    """Depths up to this [m] are not seen."""
    far: float = 0.5
    """Depths from this on [m] are not seen."""
    rows: Literal["+y", "-y"] = "+y"
    """Direction in which the row index grows."""
    columns: Literal["+x", "-x"] = "+x"
    """Direction in which the column index grows."""

    def __post_init__(self) -> None:
        for name in ("width", "height", "near", "far"):
            value = getattr(self, name)
            number = as_float(value)
            if not math.isfinite(number) or number < 0 or (number == 0 and name != "near"):
                raise SceneError(
                    f"OrthographicCamera: {name} is {value!r}; give a length in metres"
                    + (", not negative" if name == "near" else " above zero")
                )
            object.__setattr__(self, name, number)
        _require_view(self)
        for name, known in (("rows", ("+y", "-y")), ("columns", ("+x", "-x"))):
            if getattr(self, name) not in known:
                raise SceneError(
                    f"OrthographicCamera: {name} is {getattr(self, name)!r}; give {known[0]!r} or "
                    f"{known[1]!r}, the direction in which the index grows"
                )

    @classmethod
    def opengl(cls, width: float, height: float, pose: Pose, **options: Any) -> OrthographicCamera:
        """A camera as in OpenGL and MuJoCo: looks along −z, y up, first row of the image on top.

        Args:
            width: Full extent of the image along x [m].
            height: Full extent of the image along y [m].
            pose: Frame of the OpenGL camera in the sensor frame.
            options: ``near``, ``far``, ``rows`` and ``columns``, as for the class.

        Raises:
            SceneError: As for the class.
        """
        if not isinstance(pose, Pose):
            raise SceneError(f"OrthographicCamera: pose is {pose!r}; give a Pose")
        return cls(width, height, pose @ _HALF_TURN, **options)

    @classmethod
    def from_projection(cls, matrix: ArrayLike, pose: Pose, **options: Any) -> OrthographicCamera:
        """The camera of an OpenGL projection matrix.

        Args:
            matrix: Takes points of the OpenGL camera's frame to clip space, shape (4, 4).
            pose: Frame of the OpenGL camera in the sensor frame.
            options: ``rows`` and ``columns``, as for the class.

        Raises:
            SceneError: The matrix has another shape, is not finite, or is not that of a plain
                orthographic camera: perspective, sheared or mirrored.
        """
        m = np.asarray(matrix, dtype=float)
        if m.shape != (4, 4) or not np.isfinite(m).all():
            raise SceneError(
                f"OrthographicCamera: projection matrix of shape {m.shape}; give (4, 4), finite"
            )
        if not np.allclose(m[3], (0.0, 0.0, 0.0, 1.0)):
            raise SceneError(
                f"OrthographicCamera: the projection matrix ends in the row {m[3].tolist()}, so it "
                "is not orthographic; depth frames need parallel rays, with last row 0, 0, 0, 1; "
                "PerspectiveCamera makes points of a perspective image"
            )
        scale = np.diag(m)[:3]
        off = m[:3, :3] - np.diag(scale)
        if np.abs(off).max() > 1e-9 or not (scale[0] > 0 and scale[1] > 0 and scale[2] < 0):
            raise SceneError(
                "OrthographicCamera: the projection matrix shears or mirrors; its upper left part "
                "must be diagonal with signs +, +, -"
            )
        near, far = (m[2, 3] + 1) / scale[2], (m[2, 3] - 1) / scale[2]
        centre = Pose((-m[0, 3] / scale[0], -m[1, 3] / scale[1], 0.0))
        return cls.opengl(
            2 / scale[0], 2 / scale[1], pose @ centre, near=max(float(near), 0.0), far=float(far),
            **options,
        )  # fmt: skip

    def pixel_centres(self, resolution: tuple[int, int]) -> tuple[Array, Array]:
        """Camera x of the columns and y of the rows [m], in the order of the image.

        Args:
            resolution: Rows and columns.

        Returns:
            Shapes (columns,) and (rows,).
        """
        rows, columns = resolution
        x = ((np.arange(columns) + 0.5) / columns - 0.5) * self.width
        y = ((np.arange(rows) + 0.5) / rows - 0.5) * self.height
        return (x if self.columns == "+x" else x[::-1]), (y if self.rows == "+y" else y[::-1])

    def upright(self, image: Array) -> Array:
        """An image, rows and columns last, turned so that its indices grow along +y and +x."""
        if self.rows == "-y":
            image = image[..., ::-1, :]
        return image if self.columns == "+x" else image[..., ::-1]


@dataclass(frozen=True)
class PerspectiveCamera:
    """A pinhole camera, as most real depth cameras are; its image becomes a cloud of points.

    In its own frame it looks along +z, x runs along the rows of the image and y down its columns,
    as in OpenCV and the optical frames of ROS. A point (x, y, z) is seen in column
    ``cx + fx x / z`` and row ``cy + fy y / z``, counted from 0 at the middle of the first pixel.

    Raises:
        SceneError: A number is not finite, a focal length is not positive, or ``far`` does not
            exceed ``near``.
    """

    fx: float
    """Focal length along the columns' number [pixels]."""
    fy: float
    """Focal length along the rows' number [pixels]."""
    cx: float
    """Column of the optical axis [pixels]."""
    cy: float
    """Row of the optical axis [pixels]."""
    pose: Pose = field(default_factory=Pose)
    """The camera's frame in the sensor frame."""
    near: float = 0.0
    """Depths up to this [m] are not seen."""
    far: float = 0.5
    """Depths from this on [m] are not seen."""

    def __post_init__(self) -> None:
        for name in ("fx", "fy", "cx", "cy", "near", "far"):
            value = getattr(self, name)
            number, above = as_float(value), name in ("fx", "fy", "far")
            if not math.isfinite(number) or (above and number <= 0):
                raise SceneError(
                    f"PerspectiveCamera: {name} is {value!r}; give a finite number"
                    + (" above zero" if above else "")
                )
            object.__setattr__(self, name, number)
        _require_view(self)

    @classmethod
    def opengl(
        cls, fovy: float, resolution: tuple[int, int], pose: Pose, **options: Any
    ) -> PerspectiveCamera:
        """A camera as in OpenGL, MuJoCo and PyBullet: looks along −z, y up, first row on top.

        Args:
            fovy: Full angle of view from top to bottom [rad].
            resolution: Rows and columns.
            pose: Frame of the OpenGL camera in the sensor frame.
            options: ``near`` and ``far``, as for the class.

        Raises:
            SceneError: The angle is not between 0 and π; as for the class.
        """
        if not 0 < fovy < math.pi:
            raise SceneError(f"PerspectiveCamera: fovy is {fovy!r} rad; give one from 0 to 3.14")
        rows, columns = resolution
        f = rows / (2 * math.tan(fovy / 2))
        return cls(f, f, (columns - 1) / 2, (rows - 1) / 2, pose @ _HALF_TURN, **options)

    def points(self, depth: ArrayLike) -> Array:
        """What a depth image shows, as points in the sensor frame.

        Args:
            depth: Depth along the optical axis, not along the ray [m], shape (rows, columns);
                pixels that are not finite, not beyond ``near`` or not before ``far`` are left out.

        Returns:
            Points [m], shape (n, 3), row by row.

        Raises:
            SceneError: The image has another number of axes.
        """
        z = np.asarray(depth, dtype=float)
        if z.ndim != 2:
            raise SceneError(f"PerspectiveCamera: depth has shape {z.shape}; give (rows, columns)")
        row, column = np.nonzero((z > self.near) & (z < self.far))
        z = z[row, column]
        x, y = (column - self.cx) / self.fx * z, (row - self.cy) / self.fy * z
        return self.pose.apply(np.column_stack([x, y, z]))


def _require_view(camera: OrthographicCamera | PerspectiveCamera) -> None:
    """See that a camera's depths rise and that it stands somewhere."""
    name = type(camera).__name__
    if camera.far <= camera.near:
        raise SceneError(f"{name}: far is {camera.far:g} m; it must exceed near, {camera.near:g} m")
    if not isinstance(camera.pose, Pose):
        raise SceneError(f"{name}: pose is {camera.pose!r}; give a Pose")
