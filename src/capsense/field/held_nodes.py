"""Which lattice nodes the sheets of a design hold, and which links they cut."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from capsense.design.geometry import Facet, Surface
from capsense.design.model import Design
from capsense.field.boundary import terminals

Array = NDArray[np.float64]
Axes = tuple[Array, Array, Array]
Crossings = list[tuple[int, NDArray[np.int64], Array, int]]

FREE, WALL = -1, -2
"""Owners of nodes that belong to no terminal: an unknown, or a node at 0 V."""

_ON_PLANE = 1e-7


@dataclass(frozen=True, eq=False)
class Cuts:
    """Links crossed by a sheet that does not lie on lattice nodes.

    Each such link is replaced by a half-link from its lower node to the sheet nearest to it, and
    one from its upper node.
    """

    axis: NDArray[np.int64]
    node: NDArray[np.int64]
    """Flat index of the link's lower node."""
    lower: Array
    """Distance from the lower node to the first sheet, as a fraction of the link."""
    lower_owner: NDArray[np.int64]
    upper: Array
    """Distance from the upper node to the last sheet, as a fraction of the link."""
    upper_owner: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.node)


def hold_nodes(design: Design, axes: Axes) -> tuple[NDArray[np.int64], Cuts]:
    """Return the owner of each node of a tensor-product lattice, and the links cut by sheets.

    The owners have the lattice's shape; nodes on its outer faces belong to ``WALL``.
    """
    names = terminals(design)
    owner = np.full(tuple(len(a) for a in axes), FREE, dtype=np.int64)
    crossings: Crossings = []
    for body in design.sheets:
        who = names.index(body.name) if body.name in names else WALL
        _claim_nodes(axes, owner, crossings, body.surface, who)
    for axis in range(3):
        face: list[slice | int] = [slice(None)] * 3
        for end in (0, -1):
            face[axis] = end
            owner[tuple(face)] = WALL
    return owner, _collect_cuts(axes, owner.ravel(), crossings)


def _claim_nodes(
    axes: Axes,
    owner: NDArray[np.int64],
    crossings: Crossings,
    surface: Surface,
    who: int,
) -> None:
    """Mark the nodes on a sheet and collect where it crosses links: (axis, lines, t, who)."""
    z = axes[2]
    for facet in surface.facets:
        k = int(np.argmin(np.abs(z - facet.origin[2])))
        horizontal = abs(facet.axes[2, 2]) > 1 - 1e-12
        if horizontal and abs(z[k] - facet.origin[2]) < _ON_PLANE:
            _claim_plane(axes, owner, crossings, facet, k, who)
        else:
            _cross_triangles(axes, owner, crossings, facet, who)


def _claim_plane(
    axes: Axes,
    owner: NDArray[np.int64],
    crossings: Crossings,
    facet: Facet,
    k: int,
    who: int,
) -> None:
    x, y, _ = axes
    xy = facet.to_sensor(shapely.get_coordinates(facet.polygon))[:, :2]
    polygon = shapely.set_coordinates(shapely.Polygon(facet.polygon), xy)
    closed = polygon.buffer(1e-8, join_style="mitre")
    gx, gy = np.meshgrid(x, y, indexing="ij")
    inside = shapely.contains_xy(closed, gx.ravel(), gy.ravel()).reshape(gx.shape)
    owner[:, :, k][inside] = who
    for axis, (lines, span) in enumerate(((y, x), (x, y))):
        for line, c in enumerate(lines):
            ends = [(span[0], c), (span[-1], c)] if axis == 0 else [(c, span[0]), (c, span[-1])]
            hit = shapely.intersection(polygon, shapely.LineString(ends))
            pieces = [p for p in shapely.get_parts(hit) if p.geom_type == "LineString"]
            ts = [q[axis] for p in pieces for q in p.coords]
            if ts:
                index = np.array([[line, k]] * len(ts), dtype=np.int64)
                crossings.append((axis, index, np.array(ts), who))


def _cross_triangles(
    axes: Axes,
    owner: NDArray[np.int64],
    crossings: Crossings,
    facet: Facet,
    who: int,
) -> None:
    """Intersect every lattice line with a facet in general position."""
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
        crossings.append((axis, np.stack([gp, gq], axis=1), t, who))


def _collect_cuts(
    axes: Axes,
    owner: NDArray[np.int64],
    crossings: Crossings,
) -> Cuts:
    shape = tuple(len(a) for a in axes)
    strides = (shape[1] * shape[2], shape[2], 1)
    found: dict[tuple[int, int], list[tuple[float, int]]] = {}
    for axis, lines, ts, who in crossings:
        p, q = [a for a in range(3) if a != axis]
        c = axes[axis]
        for (ip, iq), t in zip(lines, ts, strict=True):
            m = int(np.searchsorted(c, t)) - 1
            if m < 0 or m >= len(c) - 1:
                continue
            s = (t - c[m]) / (c[m + 1] - c[m])
            if s < 1e-6 or s > 1 - 1e-6:
                continue
            node = m * strides[axis] + ip * strides[p] + iq * strides[q]
            if owner[node] != FREE and owner[node + strides[axis]] != FREE:
                continue
            found.setdefault((axis, int(node)), []).append((float(s), who))
    rows = []
    for (axis, node), hits in sorted(found.items()):
        first, last = min(hits), max(hits)
        rows.append((axis, node, first[0], first[1], 1.0 - last[0], last[1]))
    table = np.array(rows, dtype=float).reshape(-1, 6)
    whole = table.astype(np.int64)
    return Cuts(whole[:, 0], whole[:, 1], table[:, 2], whole[:, 3], table[:, 4], whole[:, 5])
