"""A fleet's step on Warp: room for what the kernels work with, and their launches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from capsense.elements.matter import UNIT
from capsense.elements.rigid import RigidShape
from capsense.errors import SceneError
from capsense.field.green_kernels import Green
from capsense.fleet import warp_cut
from capsense.fleet import warp_kernels as kernels
from capsense.fleet.step_kernels import Bodies

Array = NDArray[np.float64]


class WarpCore:
    """Solves views, each sensor in each environment one.

    Args:
        green: Green's function of the design.
        empty: Maxwell matrix of the m electrodes in the empty domain [F], shape (m, m).
        screened: Bound of the change of each entry [F], the same shape.
        counts: How many environments, places for bodies, and sensors.
        clusters: Into how many clusters a body is cut.
        device: Warp's device.
    """

    def __init__(
        self, green: Green, empty: Array, screened: Array, counts: tuple[int, int, int],
        clusters: int, device: Any,
    ) -> None:  # fmt: skip
        self.device, self._taken = device, 0
        self.counts, self.clusters = counts, clusters
        self.green = _response(green, empty, screened, self.device)
        environments, places, sensors = counts
        views, n, m = environments * sensors, places * clusters, len(empty)

        def room(*shape: int, dtype: Any = wp.float32) -> Any:
            return wp.zeros(shape, dtype=dtype, device=self.device)

        cut = warp_cut.WarpCut()
        cut.pose = room(places, views, dtype=wp.transform)
        for name in ("node", "split", "number"):
            setattr(cut, name, room(n, views, dtype=wp.int32))
        for name in ("score", "part", "extent", "beyond", "near"):
            setattr(cut, name, room(n, views))
        cut.points = room(n, 4, views, dtype=wp.vec3)
        self.cut = cut
        passes = self.green.near_table.shape[1]
        self.rows, self.matrix = room(n, passes * warp_cut.WIDTH, views), room(n, n, views)
        self.capacitance, self.delta = (room(environments, sensors, m, m) for _ in range(2))
        self.dropped = room(environments, sensors, dtype=wp.int32)

    def take(self, bodies: Bodies, shapes: Sequence[RigidShape]) -> None:
        """Take over what stands where."""
        places = warp_cut.Places()
        for name in ("choice", "neutral", "hidden"):
            setattr(places, name, self._array(getattr(bodies, name), wp.int32))
        for name in ("scale", "softness", "tie"):
            setattr(places, name, self._array(getattr(bodies, name), wp.float32))
        self.places = places
        if len(bodies.shapes) != self._taken:
            self.shapes, self._taken = _shapes(shapes, bodies, self._array), len(bodies.shapes)

    def _array(self, values: NDArray[Any], dtype: Any) -> Any:
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self.device)

    def solve(self, bodies: Any, sensors: Any) -> None:
        """Fill :attr:`capacitance`, :attr:`delta` [F] and :attr:`dropped`; nothing is waited for.

        Args:
            bodies: Poses, see :func:`as_transforms`, shape (e, b, 7).
            sensors: The same of the sensors, shape (e, s, 7).

        Raises:
            SceneError: They are of another shape or precision, or on another device.
        """
        environments, places, count = self.counts
        bodies = as_transforms(bodies, (environments, places, 7), self.device)
        sensors = as_transforms(sensors, (environments, count, 7), self.device)
        views, n, k = self.dropped.size, self.cut.node.shape[0], self.clusters
        green, cut, at = self.green, self.cut, (self.shapes, self.places)
        width = self.rows.shape[1]
        for kernel, dim, arguments in (
            (warp_cut.choose, (places, views), [*at, green, bodies, sensors, k, cut]),
            (warp_cut.place, (n, views), [*at, green, count, k, cut]),
            (kernels.rows, (n, width // warp_cut.WIDTH, views), [green, cut, self.rows]),
            (kernels.pairs, (n, n, views), [green, cut, k, self.matrix]),
            (kernels.to_functions, (places, width, views), [cut, k, self.rows]),
            (kernels.to_functions, (places, n, views), [cut, k, self.matrix]),
            (kernels.to_functions, (places, n, views), [cut, k, self.matrix.transpose((1, 0, 2))]),
            (
                kernels.assemble, (n, n, views),
                [*at, cut, count, k, green.lead, self.rows, self.matrix],
            ),
            (
                kernels.factorise, views,
                [cut, self.matrix, green.terminals, self.rows, self.dropped.flatten()],
            ),
            (
                kernels.change, (green.terminals, green.terminals, views),
                [green, n, self.rows, self.capacitance, self.delta],
            ),
        ):  # fmt: skip
            wp.launch(kernel, dim=dim, inputs=arguments, device=self.device)


def known_device(name: str) -> Any:
    """Warp's device of a fleet's name for it.

    Raises:
        ValueError: There is none.
    """
    wp.config.quiet = True
    wp.init()
    try:
        return wp.get_device(name.removeprefix("warp:"))
    except Exception as error:
        known = ", ".join(["cpu", "warp:cpu", *map(str, wp.get_cuda_devices())])
        raise ValueError(f"device is {name!r}; there are {known}") from error


def as_transforms(poses: Any, shape: tuple[int, ...], device: Any) -> Any:
    """Poses, shape (..., 7), as a Warp array of transforms on a device, without a copy if it can.

    Raises:
        SceneError: They are of another shape or precision, on another device, or not contiguous.
    """
    if not hasattr(poses, "__dlpack__") or isinstance(poses, np.ndarray):
        return wp.array(np.ascontiguousarray(poses, np.float32), dtype=wp.transform, device=device)
    if not isinstance(poses, wp.array):
        poses = wp.from_dlpack(poses)
    if (poses.dtype, poses.shape, poses.device) == (wp.transformf, shape[:-1], device):
        return poses
    if (poses.shape, poses.dtype, poses.device) != (shape, wp.float32, device) or (
        not poses.is_contiguous
    ):
        raise SceneError(
            f"poses are {poses.dtype.__name__} of shape {poses.shape} on {poses.device}; give "
            f"contiguous float32 of shape {shape} on {device}"
        )
    out = wp.array(ptr=poses.ptr, dtype=wp.transform, shape=shape[:-1], device=device)
    out.owner = poses  # whose memory it is
    return out


def _response(green: Green, empty: Array, screened: Array, device: Any) -> Any:
    out = warp_cut.Response()
    for name in ("near", "far"):
        sources = np.ascontiguousarray(getattr(green, name).T, np.float32)
        table = getattr(green, f"{name}_table")
        parts = np.ascontiguousarray(table.reshape(len(table), -1, warp_cut.WIDTH))
        setattr(out, name, wp.array(sources, dtype=wp.vec3, device=device))
        setattr(out, f"{name}_table", wp.array(parts, dtype=warp_cut.row, device=device))
    out.lead, out.terminals, out.unit = green.lead, len(empty), UNIT
    out.floor, out.cover = green.floor, min(green.cover, 1e3)
    out.blend0, out.blend1 = green.blend.tolist()
    (out.box0, out.box1), (out.room0, out.room1) = (
        (wp.vec3(*corners[0]), wp.vec3(*corners[1])) for corners in (green.box, green.room)
    )
    bound = np.minimum(screened, np.finfo(np.float32).max)
    for name, values in (("empty", empty), ("screened", bound)):
        setattr(out, name, wp.array(values.astype(np.float32), dtype=wp.float32, device=device))
    return out


def _shapes(shapes: Sequence[RigidShape], bodies: Bodies, array: Any) -> Any:
    """Lay shapes out one behind the other."""
    trees = [shape.tree for shape in shapes]
    sizes = np.array([len(shape.panels) for shape in shapes])
    blocks = [shape.energy.ravel() for shape in shapes]
    soft = bodies.shapes["impedance"] != 0
    inside = [
        (shape.impedance if s else np.zeros_like(shape.energy)).ravel()
        for shape, s in zip(shapes, soft, strict=True)
    ]

    def joined(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(tree, name) for tree in trees])

    out = warp_cut.Shapes()
    out.first = array(np.concatenate([[0], np.cumsum(2 * sizes - 1)[:-1]]), wp.int32)
    out.functions = array(sizes, wp.int32)
    out.block = array(np.concatenate([[0], np.cumsum(sizes**2)[:-1]]), wp.int64)
    out.radius = array(bodies.radius, wp.float32)
    for name, kind in (
        ("kids", wp.int32), ("function", wp.int32), ("charge", wp.float32), ("center", wp.vec3),
        ("points", wp.vec3), ("extent", wp.float32),
    ):  # fmt: skip
        setattr(out, name, array(joined(name), kind))
    out.energy = array(np.concatenate(blocks), wp.float32)
    out.impedance = array(np.concatenate(inside), wp.float32)
    return out
