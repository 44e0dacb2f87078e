"""Scenes from depth cameras: depth frames with permittivity, and surfaces through points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense.errors import SceneError
from capsense.scene.camera import OrthographicCamera
from capsense.scene.layers import Layers
from capsense.scene.materials import CONDUCTOR_PERMITTIVITY, Material, material
from capsense.scene.mesh_shape import SHEET_THICKNESS, RestSurface, SurfaceMesh
from capsense.scene.scene import Body, Grounding, Scene, checked_grounding
from capsense.scene.shapes import as_points

Array = NDArray[np.float64]
Back = str | float | ArrayLike | Sequence[str | float]

CONDUCTOR_CODE = 255
"""Red channel that stands for a conductor."""
_FILL = 10.0
"""Where a filled back side ends [m]: behind the end of any domain."""
_CONDUCTOR = Material("conductor", 1.0, 1e7, "any conductor that a depth frame shows")


def encode_permittivity(eps_r: ArrayLike) -> NDArray[np.uint8]:
    """The red channel that stands for relative permittivities; see :func:`decode_permittivity`.

    Args:
        eps_r: Relative permittivities; 0 and 1 are air; from 1000 on, and infinity, conductors.

    Returns:
        0 for air, 255 for conductors, else the nearest whole number. Same shape.

    Raises:
        SceneError: A number is not 0 and below 1, NaN, or lies from 254.5 up to 1000, for which
            there is no code.
    """
    e = np.asarray(eps_r, dtype=float)
    bad = ~((e == 0) | (e >= 1)) | ((e >= CONDUCTOR_CODE - 0.5) & (e < CONDUCTOR_PERMITTIVITY))
    if bad.any():
        raise SceneError(
            f"eps_r is {float(e[bad].ravel()[0])!r}, for which the red channel has no code; it "
            "takes 0 (air), 1 to 254, and 1000 and above (conductors); give floats instead"
        )
    code = np.where(e >= CONDUCTOR_PERMITTIVITY, CONDUCTOR_CODE, np.rint(np.minimum(e, 254)))
    return np.where(e <= 1, 0, code).astype(np.uint8)


def decode_permittivity(red: ArrayLike) -> Array:
    """Relative permittivities that a red channel stands for.

    As in the paper, the channel holds the relative permittivity itself, and 0 is air. Added to
    that, 255 is a conductor.

    Args:
        red: Codes, type uint8.

    Returns:
        0 for air, infinity for conductors, else the code as a number. Same shape.

    Raises:
        SceneError: Another type.
    """
    codes = np.asarray(red)
    if codes.dtype != np.uint8:
        raise SceneError(f"the red channel has type {codes.dtype}; give uint8")
    return _DECODED[codes]


_DECODED = np.arange(256, dtype=float)
_DECODED[1] = 0.0
_DECODED[CONDUCTOR_CODE] = np.inf


@dataclass(frozen=True, init=False, eq=False, repr=False)
class DepthFrame:
    """An orthographic depth image with permittivities: a world for ``Simulator.step``.

    Pixels whose depth is NaN, infinite, not positive, not beyond the camera's ``near``, or not
    before its ``far`` are air.

    Args:
        depth: Depth along the camera's view [m], shape (rows, columns), or (layers, rows,
            columns) for several surfaces behind one another.
        eps_r: What is seen: a relative permittivity, a material or its name; an array of
            permittivities (0 or 1 is air, infinity a conductor) of the shape of ``depth`` or with
            one number for each layer; or an image of type uint8 whose red channel holds codes,
            see :func:`decode_permittivity`, of the shape of ``depth``, with or without a last
            axis of three or four channels.
        camera: Where the pixels stand.
        conducting: Pixels that are conductors whatever ``eps_r`` says, of the shape of ``depth``.
        grounding: Of all conductors: ``"grounded"``, ``"floating"`` or a capacitance [F]. Those
            of one frame are one body.
        back: Where bodies end: ``"fill"``, as in the paper, at the end of the domain; a thickness
            along the view [m]; or back faces, an array of depths of the shape of ``depth``. A
            list holds a word or thickness for each layer.

    Raises:
        SceneError: Wrong shapes or types, a permittivity between 0 and 1, too many different
            permittivities, or a camera that is not an :class:`OrthographicCamera`.
    """

    depth: Array
    """Depths [m], shape (layers, rows, columns), in the order given."""
    back: Array
    """Depths at which bodies end [m], same shape."""
    camera: OrthographicCamera
    grounding: Grounding
    _group: NDArray[np.int8]
    _materials: tuple[Material, ...]

    def __init__(
        self,
        depth: ArrayLike,
        eps_r: float | str | Material | ArrayLike = np.inf,
        camera: OrthographicCamera = OrthographicCamera(),  # noqa: B008, it is immutable
        *,
        conducting: ArrayLike | None = None,
        grounding: Grounding = "grounded",
        back: Back = "fill",
    ) -> None:
        from capsense.scene.image_kernels import MAX_GROUPS, sort_pixels

        if not isinstance(camera, OrthographicCamera):
            raise SceneError(
                f"DepthFrame: camera is {camera!r}; depth must come from parallel rays, so give an "
                "OrthographicCamera"
            )
        d = _checked_depth(depth)
        shape = d.shape
        if d.ndim == 2:
            d = d[None]
        known = np.empty(MAX_GROUPS)
        one = _one_material(eps_r)
        e = np.full((1, 1, 1), np.inf) if one else _checked_eps(eps_r, shape)
        if conducting is not None:
            mask = np.asarray(conducting)
            if mask.dtype != bool or mask.shape != shape:
                raise SceneError(
                    f"DepthFrame: conducting has shape {mask.shape} and type {mask.dtype}; give "
                    f"bool, shape {shape}"
                )
            if one and not one.is_conductor():
                e = np.full((1, 1, 1), one.eps_r)
            one = None
            e = np.where(mask.reshape(d.shape), np.inf, e)
        group = np.empty(d.shape, np.int8)
        n = sort_pixels(d, e, camera.near, camera.far, CONDUCTOR_PERMITTIVITY, group, known)
        if n < 0:
            raise SceneError(_complaint(n, d.shape, e))
        fields = self.__dict__
        fields["depth"], fields["camera"] = d, camera
        fields["back"] = _backs(back, d)
        fields["grounding"] = checked_grounding(grounding)
        fields["_group"] = group
        fields["_materials"] = tuple(
            one or (_CONDUCTOR if k == np.inf else Material(f"eps_r {k:g}", k))
            for k in known[:n].tolist()
        )

    def __repr__(self) -> str:
        seen = ", ".join(m.name for m in self._materials) or "nothing"
        return f"DepthFrame(shape {self.depth.shape}, {seen}, {self.camera})"

    @property
    def resolution(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.depth.shape[1], self.depth.shape[2]

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Pixels that show something other than air, shape (layers, rows, columns)."""
        return self._group >= 0

    @property
    def permittivity(self) -> Array:
        """Relative permittivity at every pixel, shape (layers, rows, columns).

        0 for air, infinity for conductors.
        """
        known = [np.inf if m.is_conductor() else m.eps_r for m in self._materials]
        return np.array([*known, 0.0])[self._group]

    def points(self) -> Array:
        """The surface seen, as a point cloud [m] in the sensor frame.

        Returns:
            Shape (n, 3), one point for every valid pixel, in the order of ``depth``.
        """
        x, y = self.camera.pixel_centres(self.resolution)
        layer, row, column = np.nonzero(self.valid)
        local = np.column_stack([x[column], y[row], self.depth[layer, row, column]])
        return self.camera.pose.apply(local)

    def scene(self) -> Scene:
        """The frame as a scene: one body for each permittivity, all conductors being one.

        Returns:
            A scene in the sensor frame, empty if no pixel is valid. Bodies come in the order in
            which their pixels do.
        """
        from capsense.scene.image_kernels import pick

        camera = self.camera
        size = (camera.width, camera.height)
        bodies = []
        for k, matter in enumerate(self._materials):
            front, back = np.empty_like(self.depth), np.empty_like(self.depth)
            found = pick(
                self.depth, self.back, self._group, k, camera.rows == "-y",
                camera.columns == "-x", front, back,
            )  # fmt: skip
            if found:
                bodies.append(Body(Layers(front, back, size), camera.pose, matter, self.grounding))
        return Scene(bodies)


def _checked_depth(depth: ArrayLike) -> Array:
    try:
        d = np.array(depth, dtype=float, order="C")
    except (TypeError, ValueError, OverflowError):
        raise SceneError("DepthFrame: depth is not made of numbers; give metres") from None
    if d.ndim not in (2, 3) or not d.size:
        raise SceneError(
            f"DepthFrame: depth has shape {d.shape}; give (rows, columns), or (layers, rows, "
            "columns)"
        )
    return d


def _one_material(eps_r: object) -> Material | None:
    """The material of all pixels, if one is named."""
    if isinstance(eps_r, Material):
        return eps_r
    return material(eps_r) if isinstance(eps_r, str) else None


def _checked_eps(eps_r: Any, shape: tuple[int, ...]) -> Array:
    """Permittivities, shape (layers, rows, columns), every axis of full length or of one."""
    e = np.asarray(eps_r)
    if e.dtype == np.uint8:
        e = decode_permittivity(e[..., 0] if e.ndim == len(shape) + 1 and e.shape[-1] in (3, 4)
                                else e)  # fmt: skip
    try:
        e = np.ascontiguousarray(e, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise SceneError(f"DepthFrame: eps_r is {eps_r!r}; give numbers or a material") from None
    if e.ndim == 0 or e.size == 1:
        return e.reshape(1, 1, 1)
    if len(shape) == 3 and e.shape == shape[:1]:
        return e.reshape(-1, 1, 1)
    if e.shape == shape:
        return e if e.ndim == 3 else e[None]
    raise SceneError(
        f"DepthFrame: eps_r has shape {np.shape(eps_r)}, but depth has {shape}; give one number, "
        "that shape, one for each layer, or a uint8 image of that size"
    )


def _backs(back: Back, depth: Array) -> Array:
    """Depths at which bodies end [m], of the shape of ``depth``."""
    if isinstance(back, list | tuple) and all(np.ndim(b) == 0 for b in back):
        if len(back) != len(depth):
            raise SceneError(
                f"DepthFrame: back lists {len(back)} backs, but there are {len(depth)} layers"
            )
        return np.stack([_backs(b, d) for b, d in zip(back, depth, strict=True)])
    if isinstance(back, str):
        if back != "fill":
            raise SceneError(f'DepthFrame: back is {back!r}; give "fill", a thickness or depths')
        return np.full(depth.shape, _FILL)
    try:
        b = np.asarray(back, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise SceneError(f'DepthFrame: back is {back!r}; give "fill", metres or depths') from None
    if b.ndim == 0:
        if not (np.isfinite(b) and b > 0):
            raise SceneError(f"DepthFrame: back is {float(b)!r} m; give a thickness above zero")
        return depth + b
    if b.shape == depth.shape or (len(depth) == 1 and b.shape == depth.shape[1:]):
        return np.array(b, order="C").reshape(depth.shape)
    raise SceneError(f"DepthFrame: back has shape {b.shape}, but depth has {depth.shape}")


def _complaint(code: int, shape: tuple[int, ...], eps_r: Array) -> str:
    if code == -1:
        from capsense.scene.image_kernels import MAX_GROUPS

        return (
            f"DepthFrame: eps_r holds more than {MAX_GROUPS} different permittivities; round them, "
            "since every one makes a body"
        )
    pixel = np.unravel_index(-2 - code, shape)
    value = float(np.broadcast_to(eps_r, shape)[pixel])
    return (
        f"DepthFrame: eps_r is {value!r} at pixel {tuple(int(p) for p in pixel)} (layer, row, "
        "column); give 0 for air, at least 1, or inf for a conductor"
    )


_NEAR = 8
"""Neighbours that tell how much surface a point stands for, and how it is inclined."""
_FEWEST = 16
_MOST = 50_000


def point_surface(
    points: ArrayLike,
    normals: ArrayLike | None = None,
    *,
    spacing: float | None = None,
    thickness: float = SHEET_THICKNESS,
) -> SurfaceMesh:
    """The surface that a cloud of points lies on, as a shape: a small flat piece at each of them.

    Pieces are equilateral triangles with the second moments of the square that a point stands
    for, π d² / 8 with d the distance of its eighth neighbour. They do not touch each other; the
    shape has no inside. So it suits conductors; a dielectric is a sheet of ``thickness``.

    Args:
        points: Points [m], shape (n, 3), at least 16.
        normals: Normals of any length, shape (n, 3), those of one side pointing alike; by default
            those of planes through each point and its eight neighbours, towards the origin.
        spacing: Points in one cell of a cubic grid of this pitch [m] become one, in their middle;
            by default all stay.
        thickness: Of a dielectric [m].

    Raises:
        SceneError: Wrong shapes, fewer than 16 or more than 50,000 points, a number that is not
            finite, or a normal without length.
    """
    p = as_points(points)
    n = None if normals is None else as_points(normals)
    if n is not None and n.shape != p.shape:
        raise SceneError(f"normals have shape {n.shape}, but points {p.shape}; give one a point")
    for name, values in (("points", p), ("normals", p if n is None else n)):
        bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(bad):
            raise SceneError(f"{name}[{bad[0]}] is {values[bad[0]].tolist()}; give finite numbers")
    if spacing is not None:
        p, n = _merged(p, n, spacing)
    if not _FEWEST <= len(p) <= _MOST:
        raise SceneError(
            f"there are {len(p)} points; give {_FEWEST} to {_MOST:,}, of which spacing=0.005 "
            "makes one in every 5 mm"
        )
    from scipy.spatial import cKDTree

    distance, near = cKDTree(p).query(p, k=_NEAR + 1)
    n = _fitted(p, near) if n is None else _unit(n)
    side = np.sqrt(np.pi / _NEAR) * np.maximum(distance[:, -1], 1e-9)  # of the square
    across = _unit(np.cross(n, np.eye(3)[np.abs(n).argmin(axis=1)]))
    turn = 2 * np.pi / 3 * np.arange(3)[:, None, None]
    arms = np.cos(turn) * across + np.sin(turn) * np.cross(n, across)  # (3, n, 3)
    corners = p[:, None] + np.sqrt(2 / 3) * side[:, None, None] * arms.transpose(1, 0, 2)
    vertices = corners.reshape(-1, 3)
    faces = np.arange(len(vertices)).reshape(-1, 3)
    return SurfaceMesh(vertices, RestSurface(vertices, faces, thickness))


def _merged(p: Array, n: Array | None, spacing: float) -> tuple[Array, Array | None]:
    """Means of the points, and of their unit normals, in each cell of a grid."""
    if not (np.isfinite(spacing) and spacing > 0):
        raise SceneError(f"spacing is {spacing!r}; give a positive length in metres")
    key = np.zeros(len(p), np.int64)
    for along in np.floor(p / spacing).T:
        levels, level = np.unique(along, return_inverse=True)
        key = key * len(levels) + level
    _, cell, count = np.unique(key, return_inverse=True, return_counts=True)

    def means(values: Array) -> Array:
        return np.column_stack([np.bincount(cell, v) for v in values.T]) / count[:, None]

    return means(p), None if n is None else means(_unit(n))


def _fitted(p: Array, near: NDArray[np.intp]) -> Array:
    """Normals of planes through neighbours, towards the origin."""
    arms = p[near] - p[near].mean(axis=1, keepdims=True)
    n = np.linalg.eigh(arms.transpose(0, 2, 1) @ arms)[1][:, :, 0]
    return np.where((n * p).sum(axis=1, keepdims=True) > 0, -n, n)


def _unit(n: Array) -> Array:
    length = np.linalg.norm(n, axis=1, keepdims=True)
    bad = np.flatnonzero(length < 1e-12)
    if len(bad):
        raise SceneError(
            f"the normal of point {bad[0]} has no length; leave normals out, or correct it"
        )
    return n / length
