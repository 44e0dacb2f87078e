"""Scenes from depth cameras: depth frames with permittivity."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense.errors import SceneError
from capsense.scene.camera import OrthographicCamera
from capsense.scene.layers import Layers
from capsense.scene.materials import (
    CONDUCTOR_PERMITTIVITY,
    Grounding,
    Material,
    checked_grounding,
    checked_material,
)
from capsense.scene.scene import Body, Scene

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
        one = checked_material(eps_r) if isinstance(eps_r, Material | str) else None
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
