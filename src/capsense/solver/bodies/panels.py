"""Flat panels on the surface of a rigid body, in its own frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense.errors import SceneError
from capsense.scene.mesh_shape import TriMesh
from capsense.scene.shapes import Box, Capsule, Cylinder, Ellipsoid, Shape, Sphere
from capsense.solver.bodies import grids
from capsense.solver.bodies.triangles import reduced_triangles

Array = NDArray[np.float64]


_SAME = 1e-7
"""Panels and mirror images that lie apart by less than this part of a surface are the same."""


class Mirrors(NamedTuple):
    """How the coordinate planes that map a surface to itself map its panels."""

    image: NDArray[np.int64]
    """The panel that each of g maps takes each panel to, and that panel back, shape (g, n)."""
    first: NDArray[np.int64]
    """The first of the panels that are each other's images, shape (n,)."""
    by: NDArray[np.int64]
    """Which map takes that one to each panel, shape (n,)."""


@dataclass(frozen=True, eq=False)
class SurfacePanels:
    """Flat convex polygons of three or four corners, n of them; arrays are read-only."""

    corners: Array
    """Corners [m], counter-clockwise about the normal, shape (n, 4, 3). A triangle repeats its
    last corner."""
    centers: Array
    """Centroids [m], shape (n, 3)."""
    normals: Array
    """Unit normals, shape (n, 3); outward where the surface is closed."""
    areas: Array
    """Areas [m²], shape (n,)."""
    moments: Array
    """Second central moments of area over the area [m²], shape (n, 3, 3)."""
    parts: NDArray[np.int64]
    """Connected part of the surface that a panel belongs to, 0, 1, ..., shape (n,)."""
    closed: bool
    """Whether the surface bounds a volume."""

    def __len__(self) -> int:
        return len(self.areas)

    @property
    def volumes(self) -> Array:
        """What each part bounds [m³], negative round a cavity, shape (parts,)."""
        shares = self.areas * np.einsum("ij,ij->i", self.centers, self.normals) / 3
        return np.asarray(np.bincount(self.parts, shares))

    @property
    def thickness(self) -> float:
        """Twice the volume over the area [m]; infinite where the surface is open."""
        if not self.closed:
            return np.inf
        return float(2.0 * abs(self.volumes.sum()) / self.areas.sum())

    @cached_property
    def mirrors(self) -> Mirrors:
        """Mirror images of panels; there is the identity at least."""
        image = np.arange(len(self))[None]
        own = np.round(self.centers / (_SAME * float(np.abs(self.corners).max())))
        order = np.lexsort(own.T)
        for axis in range(3):
            found = _mirrored(self.moments, own, order, axis)
            if found is not None:
                image = np.concatenate([image, found[image]])
        return Mirrors(image, image.min(axis=0), image.argmin(axis=0))

    def scaled(self, factor: float) -> SurfacePanels:
        """The panels of the body made ``factor`` times as large. F and Z go with 1/factor."""
        return replace(
            self,
            corners=_read_only(factor * self.corners),
            centers=_read_only(factor * self.centers),
            areas=_read_only(factor**2 * self.areas),
            moments=_read_only(factor**2 * self.moments),
        )


def panels_of(shape: Shape | ArrayLike, count: int = 600, *, merge: bool = True) -> SurfacePanels:
    """Cover a rigid shape with about ``count`` flat panels.

    Panels of boxes and cylinders shrink towards edges. Triangle meshes are reduced, or their
    triangles halved, to about ``count``, see :mod:`capsense.solver.bodies.triangles`.

    Args:
        shape: A primitive or a mesh, or the corners of triangles [m], shape (m, 3, 3), of an open
            or a closed surface with any winding.
        count: Number of panels to aim at.
        merge: Whether triangles of a mesh are merged; else there are ``count`` more of them.

    Returns:
        Panels in the frame of the shape. The same input always gives the same panels.

    Raises:
        SceneError: A shape without one surface of its own (layers), triangles of a wrong shape or
            with numbers that are not finite, or no triangle of an area above zero.
    """
    match shape:
        case Box():
            return polygon_panels(grids.box_polygons(shape.size, count))
        case Sphere():
            radii = (shape.radius,) * 3
            return polygon_panels(grids.ellipsoid_polygons(radii, count))
        case Ellipsoid():
            return polygon_panels(grids.ellipsoid_polygons(shape.radii, count))
        case Capsule():
            return polygon_panels(grids.capsule_polygons(shape.radius, shape.length, count))
        case Cylinder():
            return polygon_panels(grids.cylinder_polygons(shape.radius, shape.length, count))
        case TriMesh():
            triangles = shape.vertices[shape.faces]
        case Shape():
            raise SceneError(f"{type(shape).__name__}: this kind of shape has no panels")
        case _:
            triangles = np.asarray(shape, dtype=float)
    reduced = reduced_triangles(triangles, count, merge=merge)
    corners = reduced.corners[:, [0, 1, 2, 2]]
    return polygon_panels(corners, reduced.parts, reduced.closed)


def _read_only(values: Array) -> Array:
    out = np.ascontiguousarray(values)
    out.setflags(write=False)
    return out


def polygon_panels(
    corners: Array, parts: NDArray[np.int64] | None = None, closed: bool = True
) -> SurfacePanels:
    """Panels that are planar polygons, corners [m] of shape (n, 4, 3), seen from the outside."""
    at = np.ascontiguousarray(corners.transpose(1, 2, 0))
    u, v, w = at[1:] - at[0]
    first, second = _cross(u, v), _cross(v, w)
    total = first + second
    double = np.sqrt((total * total).sum(axis=0))
    share = np.sqrt([(first * first).sum(axis=0), (second * second).sum(axis=0)])
    share /= share.sum(axis=0)
    center = (share[0] * (u + v) + share[1] * (v + w)) / 3
    # of triangles with one corner at the origin, from two sides and their sum
    sides = np.stack([u, v, u + v, v, w, v + w])
    moments = np.empty((len(corners), 3, 3))
    for i in range(3):
        for j in range(i + 1):
            square = (sides[:, i] * sides[:, j]).reshape(2, 3, -1).sum(axis=1)
            both = (share * square).sum(axis=0) / 12 - center[i] * center[j]
            moments[:, i, j] = moments[:, j, i] = both
    labels = np.zeros(len(corners), dtype=np.int64) if parts is None else parts
    labels.setflags(write=False)
    return SurfacePanels(
        _read_only(corners),
        _read_only((at[0] + center).T),
        _read_only((total / double).T),
        _read_only(0.5 * double),
        _read_only(moments),
        labels,
        closed,
    )


def _cross(u: Array, v: Array) -> Array:
    """Products of vectors, shape (3, n)."""
    return np.stack([u[k - 2] * v[k - 1] - u[k - 1] * v[k - 2] for k in range(3)])


def _mirrored(
    moments: Array, own: Array, order: NDArray[np.int64], axis: int
) -> NDArray[np.int64] | None:
    """The panels that the plane across an axis takes panels to, (n,), or None.

    Args:
        moments: Of the panels [m²], shape (n, 3, 3).
        own: Their centres in whole numbers, shape (n, 3).
        order: What sorts these, shape (n,).
        axis: The axis.
    """
    sign = np.ones(3)
    sign[axis] = -1.0
    there = np.lexsort((sign * own).T)
    if not np.array_equal(own[order], sign * own[there]):
        return None
    out = np.empty_like(order)
    out[order] = there
    off = np.abs(sign[:, None] * moments[out] * sign - moments).max()
    return out if off <= _SAME * moments.max() else None


def _lengths(shape: Shape) -> tuple[float, float, float]:
    """How long a shape is [m] along the axes that it can be cut along, else 0."""
    if isinstance(shape, Box):
        return shape.size
    return (0.0, 0.0, shape.length) if isinstance(shape, Cylinder | Capsule) else (0.0, 0.0, 0.0)


def longer(shape: Shape, reach: float) -> bool:
    """Whether :func:`windowed` cuts a shape."""
    return max(_lengths(shape)) > reach


def windowed(shape: Shape, middle: Array, reach: float) -> tuple[Shape, Array]:
    """Cut a box, cylinder or capsule to a length that reaches through the domain.

    The part keeps its size while the body moves, so that its charge functions are made once.

    Args:
        shape: Any shape.
        middle: Centre of the domain in the shape's frame [m], shape (3,).
        reach: Diagonal of the domain [m]. What is no longer along any axis stays whole.

    Returns:
        The part, and its centre in the shape's frame [m], shape (3,).
    """
    if not longer(shape, reach):
        return shape, np.zeros(3)
    size = np.array(_lengths(shape))
    part = np.minimum(size, reach)
    at = np.clip(middle, 0.5 * (part - size), 0.5 * (size - part))
    held = shape.__dict__.get("_window")
    if held is None or held[0] != reach:
        x, y, z = part.tolist()
        if isinstance(shape, Cylinder | Capsule):
            held = reach, type(shape)(shape.radius, z)
        else:
            held = reach, Box((x, y, z))
        shape.__dict__["_window"] = held
    return held[1], at
