"""The paper's scheme on scenes: tetrahedra whose centroid lies in a body take its material."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from capsense.errors import SceneError
from capsense.field.change import Change
from capsense.masked.mesh_sensor import MeshSensor
from capsense.masked.solver import GROUNDED, MaskedSolver
from capsense.scene import Scene

Array = NDArray[np.float64]


class MaskedScenes:
    """Masks the tetrahedra of a mesh with a scene's bodies and solves in full.

    Floating conductors are met by a large permittivity, as a scheme that knows only permittivity
    must; impedances to ground cannot be represented and are refused. Each scene is solved from the
    last one's potentials, or from zero.
    """

    FLOATING_EPS_R = 1e4

    def __init__(
        self, sensor: MeshSensor, excitation_frequency: float, *, warm_start: bool = True
    ) -> None:
        self._excitation_frequency = excitation_frequency
        self._mesh = sensor.mesh
        self._centroids = sensor.mesh.centroids
        self._solver = MaskedSolver(
            sensor.mesh, sensor.names, sensor.ground, sensor.eps_r, profiles=sensor.profiles,
            warm_start=warm_start,
        )  # fmt: skip
        self.empty: Array = self._solver.step(np.full(self._mesh.n_tets, -1), [])
        """Maxwell matrix of the empty mesh [F], shape (terminals, terminals)."""

    def reset(self) -> None:
        """Forget the last solution."""
        self._solver.reset()

    def potentials(self, points: Array) -> Array:
        """Not offered.

        Raises:
            ValueError: Always.
        """
        raise ValueError('method "masked" gives no potentials; use "surface"')

    def solve(self, scene: Scene, *, jacobian: bool = False) -> Change:
        """Return what a scene changes, from the last one's potentials; there is no Jacobian."""
        assert not jacobian
        inside = np.full(self._mesh.n_tets, -1, dtype=np.int64)
        eps = np.ones(len(scene))
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
            local = body.pose.inverse().apply(self._centroids)
            within = body.shape.signed_distance(local) < 0
            conducts = body.material.is_conductor(self._excitation_frequency)
            if conducts:
                eps[i] = GROUNDED if body.grounding == "grounded" else self.FLOATING_EPS_R
                inside[within] = i
            else:
                eps[i] = body.material.at(self._excitation_frequency).eps_r
                taken = inside >= 0
                conductor = np.array(
                    [b.material.is_conductor(self._excitation_frequency) for b in scene]
                )
                inside[within & ~(taken & conductor[inside])] = i
        matrix = self._solver.step(inside, eps.tolist())
        stats = self._solver.stats
        goal = self._solver.tolerance * float(np.abs(matrix).max())
        free = self._mesh.n_points - stats.grounded_nodes
        return Change(matrix - self.empty, goal, int(stats.iterations), free)
