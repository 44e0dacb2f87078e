"""Which nodes of a rectilinear mesh the sheets of a design hold."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray

from capsense.design.geometry import Facet
from capsense.design.model import Design
from capsense.field.boundary import terminals

Array = NDArray[np.float64]
Axes = tuple[Array, Array, Array]
Owner = NDArray[np.int64]

FREE, WALL = -1, -2
"""Owners of nodes that belong to no terminal: an unknown, or a node at 0 V."""

_ON_PLANE = 1e-7


def hold_nodes(design: Design, axes: Axes) -> Owner:
    """Return the owner of each node, shape (nx, ny, nz): a terminal's number, FREE or WALL.

    Nodes on the outer faces belong to ``WALL``.
    """
    names = terminals(design)
    owner = np.full(tuple(len(a) for a in axes), FREE, dtype=np.int64)
    for body in design.sheets:
        who = names.index(body.name) if body.name in names else WALL
        for facet in body.surface.facets:
            k = int(np.argmin(np.abs(axes[2] - facet.origin[2])))
            horizontal = abs(facet.axes[2, 2]) > 1 - 1e-12
            if horizontal and abs(axes[2][k] - facet.origin[2]) < _ON_PLANE:
                _claim_plane(axes, owner, facet, k, who)
            else:
                _claim_crossed(axes, owner, facet, who)
    for axis in range(3):
        face: list[slice | int] = [slice(None)] * 3
        for end in (0, -1):
            face[axis] = end
            owner[tuple(face)] = WALL
    return owner


def _claim_plane(axes: Axes, owner: Owner, facet: Facet, k: int, who: int) -> None:
    """Mark the nodes of plane k of the z axis that lie on a horizontal facet."""
    x, y, _ = axes
    xy = facet.to_sensor(shapely.get_coordinates(facet.polygon))[:, :2]
    polygon = shapely.set_coordinates(shapely.Polygon(facet.polygon), xy)
    closed = polygon.buffer(1e-8, join_style="mitre")
    gx, gy = np.meshgrid(x, y, indexing="ij")
    inside = shapely.contains_xy(closed, gx.ravel(), gy.ravel()).reshape(gx.shape)
    owner[:, :, k][inside] = who


def _claim_crossed(axes: Axes, owner: Owner, facet: Facet, who: int) -> None:
    """Mark the nodes that a facet in general position goes through."""
    for axis in range(3):
        if abs(facet.axes[2, axis]) < 1e-6:
            continue
        p, q = [a for a in range(3) if a != axis]
        # project the outline along the axis; the plane gives the coordinate
        coords = facet.to_sensor(shapely.get_coordinates(facet.polygon))[:, [p, q]]
        shadow = shapely.set_coordinates(shapely.Polygon(facet.polygon), coords)
        shadow = shadow.buffer(1e-8, join_style="mitre")
        x0, y0, x1, y1 = shadow.bounds
        ip = np.flatnonzero((axes[p] >= x0) & (axes[p] <= x1))
        iq = np.flatnonzero((axes[q] >= y0) & (axes[q] <= y1))
        if not len(ip) or not len(iq):
            continue
        gp, gq = np.repeat(ip, len(iq)), np.tile(iq, len(ip))
        inside = shapely.contains_xy(shadow, axes[p][gp], axes[q][gq])
        gp, gq = gp[inside], gq[inside]
        n = facet.axes[2]
        t = (
            facet.origin[axis]
            - (n[p] * (axes[p][gp] - facet.origin[p]) + n[q] * (axes[q][gq] - facet.origin[q]))
            / n[axis]
        )
        near = np.abs(axes[axis][:, None] - t[None]).argmin(axis=0)
        on_node = np.abs(axes[axis][near] - t) < _ON_PLANE
        index = [gp, gq]
        index.insert(axis, near)
        owner[tuple(i[on_node] for i in index)] = who
