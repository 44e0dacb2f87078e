"""The scheme of Schöffmann et al. 2022: masked tetrahedra, solved in full at every step.

This module has the meshes of sensors. Planes of a design's mesh follow the edges and faces of its
sheets and layers, and spread out with distance. Tetrahedra take the material at their centroid.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import NoReturn

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from capsense.design.geometry import Facet, Surface
from capsense.design.model import Design, Domain, Electrode
from capsense.design.stl import sheet_surface, weld
from capsense.errors import CapSenseError, DesignError, MeshError, SceneError
from capsense.field.background import CapacitanceChange, MeshSettings
from capsense.field.boundary import terminals
from capsense.masked.solver import GROUNDED, MaskedSolver
from capsense.mesh import TetMesh, kuhn_tets
from capsense.mesh.tetmesh import GROUND
from capsense.scene import Scene
from capsense.scene.contact import TOUCH, met
from capsense.scene.shapes import ShapeKind

Array = NDArray[np.float64]


def plan_axes(design: Design, s: MeshSettings) -> tuple[Array, Array, Array]:
    """Coordinates [m] of the planes across x, y and z, in increasing order."""
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
        tall = s.tall if axis == 2 else 0.0
        stops = np.concatenate([[lower[axis]], planes, [upper[axis]]])
        out.append(_graded(stops, edges, size, growth, far, tall))
    return out[0], out[1], out[2]


def _sheet_planes(sheet: Surface, axis: int) -> Array:
    """Coordinates that planes should follow: edges and faces across an axis, bounds."""
    rims = sheet.rims
    flat = np.abs(rims[:, 0, axis] - rims[:, 1, axis]) < 1e-9
    length = np.linalg.norm(rims[:, 1] - rims[:, 0], axis=1)
    # short segments are the facets of an arc, not edges worth a plane of their own
    at, which = np.unique(np.round(rims[flat, 0, axis], 9), return_inverse=True)
    long = np.bincount(which, length[flat], len(at)) > 0.002
    return np.concatenate([at[long], sheet.bounds[:, axis]])


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
    stops: Array, edges: Array, size: Array, growth: float, far: float, tall: float
) -> Array:
    """Lay planes through ``stops``, spaced by ``size`` at ``edges`` and growing from there.

    The spacing is at most ``far``, or the fraction ``tall`` of the distance from the edges.
    """
    out = [stops[0]]
    for a, b in pairwise(stops):
        t = np.linspace(a, b, 801)
        mid = 0.5 * (t[1:] + t[:-1])
        away = np.abs(mid[:, None] - edges[None])
        h = (size[None] + growth * away).min(axis=1)
        h = np.minimum(h, np.maximum(far, tall * away.min(axis=1)))
        count = np.concatenate([[0.0], np.cumsum(np.diff(t) / h)])
        n = max(1, int(np.ceil(count[-1] - 0.1)))
        out.extend(np.interp(np.arange(1, n) * count[-1] / n, count, t))
        out.append(b)
    return np.array(out)


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
            _claim(axes, owner, facet, who)
    for axis in range(3):
        face: list[slice | int] = [slice(None)] * 3
        for end in (0, -1):
            face[axis] = end
            owner[tuple(face)] = WALL
    return owner


def _claim(axes: Axes, owner: Owner, facet: Facet, who: int) -> None:
    """Mark the nodes that a facet goes through."""
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


@dataclass(frozen=True, eq=False)
class MeshSensor:
    """A mesh, and which of its node groups are held at which potentials.

    What is in no group has a free surface (∂φ/∂n = 0). Groups that are neither electrodes nor
    ground are not held.
    """

    mesh: TetMesh
    """The mesh in the sensor frame, around x = y = 0."""
    electrodes: Sequence[str] | None = None
    """Node groups that are driven, in matrix order; by default all that are not ground. A wall at
    a potential of its own is one of them."""
    ground: Sequence[str] = (GROUND,)
    """Node groups at 0 V; none where empty."""
    eps_r: ArrayLike = 1.0
    """Relative permittivity of the empty domain: one number, or one per tetrahedron, (k,), such as
    ``mesh.cell_values({"plate": 2.9})``."""
    profiles: Mapping[str, ArrayLike] = field(default_factory=dict)
    """Potential [V] along electrodes that are not at one potential, while each is driven with 1 V:
    one number for each of the group's nodes, (g,), from 0 on, in the order of ``node_groups``."""

    @property
    def names(self) -> tuple[str, ...]:
        """Electrode names in matrix order."""
        if self.electrodes is not None:
            return tuple(self.electrodes)
        return tuple(name for name in self.mesh.node_groups if name not in self.ground)

    @cached_property
    def design(self) -> Design:
        """Electrodes as the sheets between their nodes, in the box around the mesh.

        Raises:
            MeshError: The mesh does not lie around x = y = 0, or a name is not one of its groups.
        """
        points = self.mesh.points
        lower, upper = points.min(axis=0), points.max(axis=0)
        size, middle = upper - lower, 0.5 * (lower + upper)
        if np.abs(middle[:2]).max() > 1e-6 * size.max():
            top = points[self.mesh.group_nodes(self.names), 2].max()
            shift = ", ".join(f"{-v:.6g}" for v in (*middle[:2], top))
            raise MeshError(
                f"the middle of the mesh is at x = {middle[0]:.6g}, y = {middle[1]:.6g} m, but the "
                f"sensor frame's origin is in the middle of the electrodes; use mesh.moved(({shift}"
                "))"
            )
        electrodes = tuple(Electrode(name, self._surface(name)) for name in self.names)
        width, depth, height = size.tolist()
        return Design("mesh", Domain((width, depth, height), -float(lower[2])), electrodes)

    def unit_potentials(self) -> tuple[Array, NDArray[np.bool_]]:
        """Dirichlet values of the M unit problems, and which nodes are free.

        Returns:
            values: 1 V, or the profile given, on electrode j in column j and 0 V elsewhere [V],
                shape (n, M).
            free: Nodes on no electrode and not on ground, shape (n,).

        Raises:
            MeshError: If a group is unknown or empty, an electrode shares nodes with another or
                ground, or a profile is of no electrode, of another shape, negative or not finite.
        """
        mesh, names = self.mesh, list(self.names)
        if not names:
            raise MeshError("at least one electrode group is needed")
        if strange := sorted(set(self.profiles) - set(names)):
            raise MeshError(f"profile {strange[0]!r} is of no electrode; there are {names}")
        owner = np.full(mesh.n_points, -1)
        values = np.zeros((mesh.n_points, len(names)))
        owner[mesh.group_nodes(self.ground)] = len(names)
        for column, name in enumerate(names):
            members = mesh.group_nodes([name])
            if len(members) == 0:
                raise MeshError(f"electrode group {name!r} is empty")
            if shared := int((owner[members] >= 0).sum()):
                raise MeshError(
                    f"electrode group {name!r} shares {shared} nodes with another group"
                )
            owner[members] = column
            values[members, column] = _profile(name, self.profiles.get(name, 1.0), len(members))
        return values, owner < 0

    def _surface(self, name: str) -> Surface:
        """Faces whose corners are all nodes of a group, without those in its inside.

        No facets where these faces are no plain sheet: the scheme itself needs the nodes only.
        """
        tets = self.mesh.tets
        held = np.isin(tets, self.mesh.group_nodes([name]))
        partly = ~held.all(axis=1)
        faces = np.concatenate(
            [np.delete(tets[partly & np.delete(held, k, 1).all(axis=1)], k, 1) for k in range(4)]
        )
        with suppress(DesignError):
            if len(faces):
                return sheet_surface(weld(self.mesh.points[np.unique(np.sort(faces), axis=0)]))
        return Surface((), np.empty((0, 2, 3)))


def _profile(name: str, given: ArrayLike, count: int) -> Array:
    potential = np.asarray(given, dtype=np.float64)
    if potential.shape not in ((), (count,)):
        raise MeshError(
            f"profile {name!r} has shape {potential.shape}; give one potential for each of the "
            f"group's {count} nodes"
        )
    if not (np.isfinite(potential) & (potential >= 0)).all() or not potential.any():
        raise MeshError(
            f"profile {name!r} must be finite, from 0 V on and not zero everywhere; drive the "
            "electrode with a negative voltage instead, or split its group in two"
        )
    return potential


def mesh_sensor(mesh: TetMesh | MeshSensor) -> MeshSensor:
    """What is given as ``mesh`` to a simulator; of a mesh, all groups but "ground" are driven.

    Raises:
        MeshError: It is something else.
    """
    if isinstance(mesh, TetMesh):
        return MeshSensor(mesh)
    if not isinstance(mesh, MeshSensor):
        raise MeshError(f"mesh is {mesh!r}; give a TetMesh, as load_mesh returns, or a MeshSensor")
    return mesh


def lattice_sensor(design: Design, terminals: Sequence[str], settings: MeshSettings) -> MeshSensor:
    """The Kuhn tetrahedra of a graded mesh for a design, its sheets and walls held.

    Raises:
        SceneError: The mesh has no node on a terminal.
    """
    axes = plan_axes(design, settings)
    mesh = kuhn_tets(*axes)
    owner = hold_nodes(design, axes).ravel()
    groups = {name: np.flatnonzero(owner == k) for k, name in enumerate(terminals)}
    if missing := [name for name, nodes in groups.items() if not len(nodes)]:
        raise SceneError(
            f"method 'fem_masked' needs mesh nodes on every electrode; {missing[0]!r} has none: "
            "raise [build] resolution, or use method 'surface'"
        )
    mesh = mesh.with_groups(node_groups={**groups, GROUND: np.flatnonzero(owner == WALL)})
    eps = np.ones(mesh.n_tets)
    for layer in design.layers:
        eps[layer.contains(mesh.centroids)] = layer.eps_r
    return MeshSensor(mesh, tuple(terminals), (GROUND,), eps)


class MaskedScenes:
    """Masks the tetrahedra of a mesh with a scene's bodies and solves in full.

    Floating conductors are met by a large permittivity, as a scheme that knows only permittivity
    must; impedances to ground cannot be represented and are refused. Each scene is solved from the
    last one's potentials, or from zero.

    Args:
        sensor: The mesh and its node groups.
        excitation_frequency: Excitation frequency [Hz].
        electrodes: Node groups for which contact with bodies is told; by default all that are held.
        warm_start: Whether to solve from the last potentials.
    """

    FLOATING_EPS_R = 1e4

    together = 1
    """How many scenes of a batch a thread takes at a time."""
    touch = TOUCH
    """What is nearer to an electrode than this [m] touches it."""

    def __init__(
        self, sensor: MeshSensor, excitation_frequency: float, *,
        electrodes: Sequence[str] | None = None, warm_start: bool = True,
    ) -> None:  # fmt: skip
        self._excitation_frequency = excitation_frequency
        held = sensor.names if electrodes is None else electrodes
        self._points = sensor.mesh.points[sensor.mesh.group_nodes(held)]
        self._mesh = sensor.mesh
        self._solver = MaskedSolver(sensor, warm_start=warm_start)
        self.empty: Array = self._solver.step(np.full(self._mesh.n_tets, -1), [])
        """Maxwell matrix of the empty mesh [F], shape (terminals, terminals)."""

    def reset(self) -> None:
        """Forget the last solution."""
        self._solver.reset()

    def field(self) -> NoReturn:
        """Not offered.

        Raises:
            ValueError: Always.
        """
        raise ValueError('method "fem_masked" keeps no field; use "surface"')

    def solve_each(self, scenes: Sequence[Scene]) -> list[CapacitanceChange | CapSenseError]:
        """Return what each of many scenes changes, from rest, or what was wrong with it."""
        out: list[CapacitanceChange | CapSenseError] = []
        for scene in scenes:
            self.reset()
            try:
                out.append(self.solve(scene))
            except CapSenseError as error:
                out.append(error)
        return out

    def solve(
        self, scene: Scene, *, jacobian: bool = False, time: float | None = None
    ) -> CapacitanceChange:
        """Return what a scene changes, from the last one's potentials; there is no Jacobian."""
        assert not jacobian
        inside = np.full(self._mesh.n_tets, -1, dtype=np.int64)
        eps, contact = np.ones(len(scene)), False
        conducts = np.array([b.material.is_conductor(self._excitation_frequency) for b in scene])
        for i, body in enumerate(scene):
            if not isinstance(body.grounding, str):
                raise SceneError(
                    f"body {body.name or i} is tied to ground through {body.grounding} F; method "
                    "'fem_masked' knows only grounded and floating bodies"
                )
            if not getattr(body.shape, "closed", True):
                raise SceneError(
                    f"body {body.name or i} is an open surface, and method 'fem_masked' needs an "
                    "inside: close it, give a DepthFrame, or use method 'surface'"
                )
            to_body = body.pose.inverse()
            within = body.shape.signed_distance(to_body.apply(self._mesh.centroids)) < 0
            off = body.shape.signed_distance(to_body.apply(self._points))
            contact |= body.shape.kind != ShapeKind.LAYERS and met(off, bool(conducts[i]))
            if conducts[i]:
                eps[i] = GROUNDED if body.grounding == "grounded" else self.FLOATING_EPS_R
                inside[within] = i
            else:
                eps[i] = body.material.at(self._excitation_frequency).eps_r
                inside[within & ~((inside >= 0) & conducts[inside])] = i
        matrix = self._solver.step(inside, eps.tolist())
        stats = self._solver.stats
        error = math.inf if contact else self._solver.tolerance * float(np.abs(matrix).max())
        free = self._mesh.n_points - stats.grounded_nodes
        return CapacitanceChange(matrix - self.empty, error, int(stats.iterations), free)
