"""The online mesh: a graded rectilinear lattice whose Kuhn tetrahedra carry P1 elements.

On such a mesh the stiffness matrix has links along the three axes only, all of positive weight.
Lattice planes follow the faces of electrodes, conductors and dielectric layers; sheets that do
not lie on lattice planes cut the links they cross.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray

from capsense.constants import EPS0
from capsense.design.geometry import Facet, Surface
from capsense.design.model import Design
from capsense.field.boundary import eps_at, terminals

Array = NDArray[np.float64]

FREE, WALL = -1, -2
"""Owners of nodes that belong to no terminal: an unknown, or a node at 0 V."""

_ON_PLANE = 1e-7


@dataclass(frozen=True)
class LatticeSettings:
    """Spacings of the online lattice; all lengths in metres."""

    edge: float = 0.006
    """Largest spacing beside an electrode's edge, in the plane."""
    growth: float = 0.45
    """Growth of the in-plane spacing per unit distance from the nearest edge."""
    far: float = 0.035
    """Largest in-plane spacing."""
    face: float = 0.0015
    """Spacing beside an electrode's face, across the plane."""
    growth_z: float = 0.3
    """Growth of the spacing across the plane per unit distance from the nearest face."""
    far_z: float = 0.014
    """Largest spacing across the plane."""
    merge: float = 0.0008
    """Edges closer to each other than this share one lattice plane."""

    def refined(self, factor: float) -> LatticeSettings:
        """Return settings with ``factor`` times as many nodes along each axis."""
        return LatticeSettings(
            self.edge / factor, self.growth / factor, self.far / factor, self.face / factor,
            self.growth_z / factor, self.far_z / factor, self.merge / max(1.0, factor),
        )  # fmt: skip


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


@dataclass(frozen=True, eq=False)
class Lattice:
    """A graded rectilinear lattice with its links and the nodes that are held at a potential."""

    axes: tuple[Array, Array, Array]
    """Node coordinates [m] along x, y and z, increasing."""
    weights: Array
    """Link weights [F] in the empty domain, shape (3, n): from each node to the next along an axis;
    zero behind the last node."""
    eps_r: Array
    """Relative permittivity of the empty domain on each link, shape (3, n)."""
    owner: NDArray[np.int64]
    """Terminal that holds a node, or ``FREE`` or ``WALL``, shape (n,)."""
    kink: NDArray[np.bool_]
    """Nodes across which the empty-domain potential is not smooth, shape (n,)."""
    cuts: Cuts

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of nodes along x, y and z."""
        x, y, z = self.axes
        return len(x), len(y), len(z)

    @property
    def n_nodes(self) -> int:
        """Number of nodes; node (i, j, k) has the flat index (i·ny + j)·nz + k."""
        return int(np.prod(self.shape))

    @property
    def n_tets(self) -> int:
        """Number of Kuhn tetrahedra, six a cell."""
        return 6 * int(np.prod([n - 1 for n in self.shape]))

    @property
    def points(self) -> Array:
        """Node positions [m], shape (n, 3)."""
        return np.stack(np.meshgrid(*self.axes, indexing="ij"), axis=-1).reshape(-1, 3)

    @property
    def strides(self) -> tuple[int, int, int]:
        """Step of the flat index along x, y and z."""
        _, ny, nz = self.shape
        return ny * nz, nz, 1


def build_lattice(design: Design, settings: LatticeSettings | None = None) -> Lattice:
    """Lay a lattice through a design: planes, link weights, held nodes and cut links."""
    settings = settings or LatticeSettings()
    axes = _plan_axes(design, settings)
    shape = tuple(len(a) for a in axes)
    names = terminals(design)
    owner = np.full(shape, FREE, dtype=np.int64)
    crossings: list[tuple[int, NDArray[np.int64], Array, int]] = []
    for body in design.sheets:
        who = names.index(body.name) if body.name in names else WALL
        _claim_nodes(axes, owner, crossings, body.surface, who)
    for axis in range(3):
        face: list[slice | int] = [slice(None)] * 3
        for end in (0, -1):
            face[axis] = end
            owner[tuple(face)] = WALL
    weights, eps = _link_weights(design, axes)
    flat_owner = owner.ravel()
    cuts = _collect_cuts(axes, flat_owner, crossings)
    kink = flat_owner != FREE
    kink |= _on_layer_faces(design, axes).ravel()
    strides = (shape[1] * shape[2], shape[2], 1)
    for axis in range(3):
        nodes = cuts.node[cuts.axis == axis]
        kink[nodes] = True
        kink[nodes + strides[axis]] = True
    return Lattice(
        axes, weights.reshape(3, -1), eps.reshape(3, -1), flat_owner, kink, cuts
    )  # fmt: skip


# -- planes ---------------------------------------------------------------------------------


def _plan_axes(design: Design, s: LatticeSettings) -> tuple[Array, Array, Array]:
    lower, upper = design.domain.lower, design.domain.upper
    sheets = [b.surface for b in design.sheets]
    out = []
    for axis in range(3):
        edges = np.concatenate([_sheet_planes(sheet, axis) for sheet in sheets])
        edges = _merge(edges, s.merge, lower[axis], upper[axis])
        faces = np.array([[la.lower[axis], la.upper[axis]] for la in design.layers]).ravel()
        planes = _merge(np.concatenate([edges, faces]), s.merge, lower[axis], upper[axis])
        if axis < 2:
            gaps = np.diff(np.concatenate([[lower[axis]], edges, [upper[axis]]]))
            size = np.clip(0.5 * np.minimum(gaps[1:], gaps[:-1]), 1.2 * s.merge, s.edge)
            growth, far = s.growth, s.far
        else:
            size, growth, far = np.full(len(edges), s.face), s.growth_z, s.far_z
        out.append(_graded(lower[axis], upper[axis], planes, edges, size, growth, far))
    return out[0], out[1], out[2]


def _sheet_planes(sheet: Surface, axis: int) -> Array:
    """Coordinates that lattice planes should follow: edges and faces across an axis, bounds."""
    rims = sheet.rims
    flat = np.abs(rims[:, 0, axis] - rims[:, 1, axis]) < 1e-9
    length = np.linalg.norm(rims[:, 1] - rims[:, 0], axis=1)
    # short segments are the facets of an arc, not edges worth a plane of their own
    total: dict[float, float] = {}
    for c, ell in zip(np.round(rims[flat, 0, axis], 9), length[flat], strict=True):
        total[c] = total.get(c, 0.0) + ell
    keep = [c for c, ell in total.items() if ell > 0.002]
    return np.concatenate([keep, sheet.bounds[:, axis]])


def _merge(values: Array, distance: float, lower: float, upper: float) -> Array:
    """Sort, drop what lies on the walls, and replace close groups by their middle."""
    values = np.unique(np.round(values, 9))
    values = values[(values > lower + distance / 2) & (values < upper - distance / 2)]
    groups: list[list[float]] = []
    for v in values:
        if groups and v - groups[-1][0] < distance:
            groups[-1].append(v)
        else:
            groups.append([v])
    return np.array([(g[0] + g[-1]) / 2 for g in groups])


def _graded(
    lower: float, upper: float, planes: Array, edges: Array, size: Array, growth: float, far: float
) -> Array:
    """Lay planes through ``planes``, spaced by ``size`` at ``edges`` and growing from there."""
    stops = np.concatenate([[lower], planes, [upper]])
    out = [lower]
    for a, b in pairwise(stops):
        t = np.linspace(a, b, 801)
        mid = 0.5 * (t[1:] + t[:-1])
        h = np.minimum((size[None] + growth * np.abs(mid[:, None] - edges[None])).min(axis=1), far)
        count = np.concatenate([[0.0], np.cumsum(np.diff(t) / h)])
        n = max(1, int(np.ceil(count[-1] - 0.1)))
        out.extend(np.interp(np.arange(1, n) * count[-1] / n, count, t))
        out.append(b)
    return np.array(out)


# -- held nodes and cut links ---------------------------------------------------------------


def _claim_nodes(
    axes: tuple[Array, Array, Array],
    owner: NDArray[np.int64],
    crossings: list[tuple[int, NDArray[np.int64], Array, int]],
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
    axes: tuple[Array, Array, Array],
    owner: NDArray[np.int64],
    crossings: list[tuple[int, NDArray[np.int64], Array, int]],
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
    axes: tuple[Array, Array, Array],
    owner: NDArray[np.int64],
    crossings: list[tuple[int, NDArray[np.int64], Array, int]],
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
    axes: tuple[Array, Array, Array],
    owner: NDArray[np.int64],
    crossings: list[tuple[int, NDArray[np.int64], Array, int]],
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


# -- materials --------------------------------------------------------------------------------


def _link_weights(design: Design, axes: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    """P1 link weights [F] of the Kuhn tetrahedra and the permittivity each link sees."""
    steps = [np.diff(a) for a in axes]
    centers = [0.5 * (a[1:] + a[:-1]) for a in axes]
    cells = np.stack(np.meshgrid(*centers, indexing="ij"), axis=-1)
    volume = np.einsum("i,j,k->ijk", *steps)
    shape = tuple(len(a) for a in axes)
    weights, eps = np.zeros((3, *shape)), np.ones((3, *shape))
    cell_eps = eps_at(design, cells)
    for axis in range(3):
        h = steps[axis].reshape([-1 if k == axis else 1 for k in range(3)])
        full = _spread(EPS0 * cell_eps * volume / h**2 / 4, axis)
        bare = _spread(EPS0 * volume / h**2 / 4, axis)
        part = tuple(slice(0, n - (k == axis)) for k, n in enumerate(shape))
        weights[axis][part] = full
        eps[axis][part] = full / bare
    return weights, eps


def _spread(cells: Array, axis: int) -> Array:
    """Add each cell's share to its four links along an axis."""
    for other in range(3):
        if other != axis:
            pad = [(1, 1) if k == other else (0, 0) for k in range(3)]
            padded = np.pad(cells, pad)
            n = padded.shape[other]
            cells = padded.take(range(n - 1), axis=other) + padded.take(range(1, n), axis=other)
    return cells


def _on_layer_faces(design: Design, axes: tuple[Array, Array, Array]) -> NDArray[np.bool_]:
    """Nodes on the surface of a dielectric layer."""
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    out = np.zeros(points.shape[:-1], dtype=bool)
    for layer in design.layers:
        closed = ((points >= layer.lower - 1e-9) & (points <= layer.upper + 1e-9)).all(axis=-1)
        inner = ((points > layer.lower + 1e-9) & (points < layer.upper - 1e-9)).all(axis=-1)
        out |= closed & ~inner
    return out
