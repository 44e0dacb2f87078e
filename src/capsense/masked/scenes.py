"""Scenes in masked meshes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from capsense.errors import CapSenseError, SceneError
from capsense.masked.mesh_sensor import MeshSensor
from capsense.masked.solver import GROUNDED, MaskedSolver
from capsense.reading import CapacitanceChange
from capsense.scene import Scene
from capsense.scene.contact import TOUCH, met
from capsense.scene.shapes import ShapeKind

Array = NDArray[np.float64]


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
            if body.grounding not in ("grounded", "floating"):
                tie = body.grounding
                way = f"{tie:g} F" if isinstance(tie, float) else repr(tie)
                raise SceneError(
                    f"body {body.name or i} is tied to ground through {way}; method 'fem_masked' "
                    "knows only grounded and floating bodies"
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
