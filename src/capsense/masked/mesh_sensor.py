"""Meshes, and which of their nodes are held at which potentials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense.design.geometry import Surface
from capsense.design.model import Design, Domain, Electrode
from capsense.design.stl import sheet_surface, weld
from capsense.errors import DesignError, MeshError
from capsense.mesh import TetMesh
from capsense.mesh.tetmesh import GROUND

Array = NDArray[np.float64]


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
