"""The online mesh: a graded lattice in storeys that thin out with height.

Every storey is a rectilinear lattice with links along the three axes only, all of positive weight.
The planes of the lowest follow the faces of electrodes, conductors and dielectric layers; sheets
that do not lie on them cut the links they cross. From one storey to the next, neighbouring lines
merge: the topmost nodes of several columns link to one node of the storey above.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from capsense.constants import EPS0
from capsense.design.model import Design
from capsense.errors import FieldError
from capsense.field.boundary import eps_at
from capsense.field.held_nodes import FREE, WALL, Cuts, hold_nodes
from capsense.field.planes import LatticeSettings, StoreyPlan, plan_storeys

__all__ = ["FREE", "WALL", "Cuts", "Joints", "Lattice", "LatticeSettings", "Storey",
           "build_lattice"]  # fmt: skip

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Storey:
    """A rectilinear part of the lattice.

    Its first and last planes along x and y are walls. Along z they are walls too in the lowest
    storey's first and the highest storey's last plane; elsewhere they stand in for the storeys
    below (*floor*) and above (*ceiling*) and hold no unknowns.
    """

    axes: tuple[Array, Array, Array]
    """Node coordinates [m] along x, y and z, increasing."""
    faces: tuple[Array, Array, Array]
    """Ends of the cross-sections that nodes stand for, between each node and the next [m]."""
    first: int
    """Flat index of the first node; node (i, j, k) is number ``first + (i·ny + j)·nz + k``."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of nodes along x, y and z."""
        x, y, z = self.axes
        return len(x), len(y), len(z)

    @property
    def stop(self) -> int:
        """Flat index behind the last node."""
        return self.first + int(np.prod(self.shape))

    @property
    def strides(self) -> tuple[int, int, int]:
        """Step of the flat index along x, y and z."""
        _, ny, nz = self.shape
        return ny * nz, nz, 1

    @property
    def nodes(self) -> Index:
        """Flat indices, in the storey's shape."""
        return np.arange(self.first, self.stop).reshape(self.shape)

    @property
    def points(self) -> Array:
        """Node positions [m], shape (nodes, 3)."""
        return np.stack(np.meshgrid(*self.axes, indexing="ij"), axis=-1).reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class Joints:
    """Links from the topmost nodes of a storey's columns to the storey above."""

    ceiling: Index
    """Stand-ins, in the lower storey, for nodes of the upper one; the top node comes before."""
    parent: Index
    """The nodes they stand for; each comes after its floor node, which stands for what is below."""

    def __len__(self) -> int:
        return len(self.ceiling)


@dataclass(frozen=True, eq=False)
class Lattice:
    """A graded lattice with its links and the nodes that are held at a potential."""

    storeys: tuple[Storey, ...]
    """From the lowest to the highest."""
    joints: Joints
    weights: Array
    """Link weights [F] in the empty domain, shape (3, n): from each node to the next along an axis;
    zero behind the last node."""
    eps_r: Array
    """Relative permittivity of the empty domain on each link, shape (3, n)."""
    owner: Index
    """Terminal that holds a node, or ``FREE`` or ``WALL``, shape (n,)."""
    kink: NDArray[np.bool_]
    """Nodes across which the empty-domain potential is not smooth, shape (n,)."""
    cuts: Cuts

    @property
    def n_nodes(self) -> int:
        """Number of nodes, with walls and stand-ins."""
        return self.storeys[-1].stop

    @property
    def n_tets(self) -> int:
        """Number of tetrahedra, six a cell."""
        return 6 * sum(
            int(np.prod([n - 1 for n in s.shape])) - (int(np.prod([n - 1 for n in s.shape[:2]]))
            if s.first else 0) for s in self.storeys
        )  # fmt: skip

    @cached_property
    def points(self) -> Array:
        """Node positions [m], shape (n, 3)."""
        return np.concatenate([s.points for s in self.storeys])

    @cached_property
    def home(self) -> Index:
        """The node itself; for a ceiling node, the node it stands for. Shape (n,)."""
        out = np.arange(self.n_nodes)
        out[self.joints.ceiling] = self.joints.parent
        return out

    @cached_property
    def unknown(self) -> NDArray[np.bool_]:
        """Nodes whose potential the empty domain leaves free, stand-ins apart, shape (n,)."""
        out = self.owner == FREE
        out[self.joints.ceiling] = False
        return out

    @property
    def levels(self) -> Array:
        """Heights of all planes of nodes [m], increasing."""
        return np.concatenate([s.axes[2][self._own_planes(s)] for s in self.storeys])

    def _own_planes(self, storey: Storey) -> slice:
        return slice(
            1 if storey.first else 0, None if storey.stop == self.n_nodes else storey.shape[2] - 1
        )

    def on_grid(self, values: Array, axes: tuple[Array, Array, Array]) -> Array:
        """Carry values at the nodes to another rectilinear grid, by cubic splines.

        Across planes where the values have kinks, those of electrodes and layers, they are rounded.

        Args:
            values: One or more values at each node, shape (n, m).
            axes: Coordinates x, y, z of the grid's nodes [m], in the domain.

        Returns:
            Shape (len(x), len(y), len(z), m).

        Raises:
            FieldError: An axis leaves the domain.
        """
        from scipy.interpolate import make_interp_spline

        wanted = [np.asarray(a, dtype=float) for a in axes]
        for name, new, (low, high) in zip("xyz", wanted, self.bounds, strict=True):
            if not (new.ndim == 1 and new.size and low <= new.min() and new.max() <= high):
                raise FieldError(
                    f"axis {name} of the grid is {new!r}; give coordinates from {low:g} to "
                    f"{high:g} m"
                )
        planes = []
        for s in self.storeys:
            part = values[s.first : s.stop].reshape(*s.shape, -1)[:, :, self._own_planes(s)]
            for axis in range(2):
                part = make_interp_spline(s.axes[axis], part, k=3, axis=axis)(wanted[axis])
            planes.append(part)
        return make_interp_spline(self.levels, np.concatenate(planes, axis=2), axis=2)(wanted[2])

    @property
    def bounds(self) -> list[tuple[float, float]]:
        """Lower and upper end of the domain along x, y and z [m]."""
        x, y, _ = self.storeys[0].axes
        return [(float(c[0]), float(c[-1])) for c in (x, y, self.levels)]

    def beyond(self, axis: Index | int, node: Index) -> Index:
        """Flat indices of the far ends of links, given by axis and lower node (not taken home)."""
        starts = np.array([s.first for s in self.storeys])
        strides = np.array([s.strides for s in self.storeys])
        storey = np.searchsorted(starts, node, side="right") - 1
        return node + strides[storey, axis]


def build_lattice(design: Design, settings: LatticeSettings | None = None) -> Lattice:
    """Lay a lattice through a design: planes, link weights, held nodes and cut links."""
    plans = plan_storeys(design, settings or LatticeSettings())
    storeys: list[Storey] = []
    for plan in plans:
        storeys.append(Storey(plan.axes, plan.faces, storeys[-1].stop if storeys else 0))
    n = storeys[-1].stop
    weights, eps = np.zeros((3, n)), np.ones((3, n))
    owner = np.full(n, WALL, dtype=np.int64)
    for storey in storeys:
        part = slice(storey.first, storey.stop)
        w, e = _link_weights(design, storey)
        if storey.first:
            w[:, :, :, 0] = 0.0
        if storey.stop < n:
            w[:, :, :, -1] = 0.0
        weights[:, part], eps[:, part] = w.reshape(3, -1), e.reshape(3, -1)
        owner[storey.nodes[1:-1, 1:-1, 1:-1]] = FREE
    held, cuts = hold_nodes(design, storeys[0].axes)
    owner[: storeys[0].stop] = held.ravel()
    joints = _join_storeys(storeys, plans, weights, owner)
    kink = owner != FREE
    kink[: storeys[0].stop] |= _on_layer_faces(design, storeys[0].axes).ravel()
    lattice = Lattice(tuple(storeys), joints, weights, eps, owner, kink, cuts)
    kink[cuts.node] = True
    kink[lattice.beyond(cuts.axis, cuts.node)] = True
    return lattice


def _join_storeys(
    storeys: list[Storey], plans: list[StoreyPlan], weights: Array, owner: Index
) -> Joints:
    """Link each storey to the next, and mend the links beside so that linear fields stay exact.

    A joint that leans sideways carries part of the sideways flux; the links between the lines that
    merge carry that much less.
    """
    ceilings, parents = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for lower, upper, plan in zip(storeys, storeys[1:], plans[1:], strict=False):
        assert plan.groups is not None
        below, above = lower.nodes, upper.nodes
        own: list[Index] = []
        for axis, groups in enumerate(plan.groups):
            number = np.empty(sum(len(g) for g in groups), dtype=np.int64)
            for g, lines in enumerate(groups, start=1):
                number[np.array(lines) - 1] = g
            own.append(number)
            top = np.moveaxis(below[:, :, -2], axis, 0)
            joint = weights[2][top]
            for g, lines in enumerate(groups, start=1):
                carried = np.zeros(joint.shape[1])
                for i in lines[:-1]:
                    at, after = lower.axes[axis][i], lower.axes[axis][i + 1]
                    carried = carried + joint[i] * (upper.axes[axis][g] - at)
                    weights[axis][top[i]] -= carried / (after - at)
        ceiling = below[1:-1, 1:-1, -1]
        owner[ceiling] = FREE
        ceilings.append(ceiling.ravel())
        parents.append(above[np.ix_(own[0], own[1], np.ones(1, np.int64))].ravel())
    return Joints(np.concatenate(ceilings), np.concatenate(parents))


# -- materials --------------------------------------------------------------------------------


def _link_weights(design: Design, storey: Storey) -> tuple[Array, Array]:
    """Link weights [F], trilinear elements with nodal quadrature, and each link's permittivity."""
    steps = [np.diff(a) for a in storey.axes]
    centers = [0.5 * (a[1:] + a[:-1]) for a in storey.axes]
    cells = np.stack(np.meshgrid(*centers, indexing="ij"), axis=-1)
    weights, eps = np.zeros((3, *storey.shape)), np.ones((3, *storey.shape))
    cell_eps = eps_at(design, cells)
    for axis in range(3):
        h = steps[axis].reshape([-1 if k == axis else 1 for k in range(3)])
        full = _spread(EPS0 * cell_eps / h, axis, storey)
        bare = _spread(EPS0 * np.ones_like(cell_eps) / h, axis, storey)
        part = tuple(slice(0, n - (k == axis)) for k, n in enumerate(storey.shape))
        weights[axis][part] = full
        eps[axis][part] = full / bare
    return weights, eps


def _spread(cells: Array, axis: int, storey: Storey) -> Array:
    """Sum each cell's value over the four links along an axis, times what they own of it."""
    for other in range(3):
        if other != axis:
            c, face = storey.axes[other], storey.faces[other]
            shape = [-1 if k == other else 1 for k in range(3)]
            near, beyond = (face - c[:-1]).reshape(shape), (c[1:] - face).reshape(shape)
            low = [(0, 1) if k == other else (0, 0) for k in range(3)]
            high = [(1, 0) if k == other else (0, 0) for k in range(3)]
            cells = np.pad(cells * near, low) + np.pad(cells * beyond, high)
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
