"""The surface core: charges on the bodies, against the Green's function of the design."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capsense.constants import EPS0
from capsense.errors import SceneError, SolveError
from capsense.field.background import BackgroundField
from capsense.field.green import GreenFunction
from capsense.scene import Body, Scene
from capsense.scene.shape import ShapeKind
from capsense.surface.rigid import RigidShape
from capsense.surface.solve_kernels import Solution, solve
from capsense.surface.step_kernels import BODY, Green
from capsense.surface.store import rigid
from capsense.surface.vector_kernels import WIDTH

Array = NDArray[np.float64]

UNIT = 4 * math.pi * EPS0
"""Capacitance of a ball of one metre [F]; the kernels take it for one."""
CONDUCTING = 1e4
"""Magnitude of the complex permittivity from which the inside of a body holds no field."""
_BOUND = 300.0, 3000.0
"""Real permittivities between which displacement current comes to tie a body to ground."""
_CONTACT = 6.0
"""Size of a body over that of the contact that ties it to ground."""
_SHUT = 1e9
"""Energy of the net charge of bodies that float together, over that of a ball of one metre."""


@dataclass(frozen=True)
class Preset:
    """How finely a scene is resolved."""

    panels: int = 700
    """About how many panels cover a shape."""
    threshold: float = 0.015
    """Charge functions count that take up this part of an electrode's energy alone."""
    width: float = 2.5
    """They fade in up to so many times that."""


class SurfaceSolver:
    """Solves scenes of rigid bodies, each by itself.

    Args:
        background: Field of the design.
        frequency: Excitation frequency [Hz].
        preset: How finely scenes are resolved.
    """

    def __init__(
        self, background: BackgroundField, *, frequency: float = 250e3, preset: Preset | None = None
    ) -> None:
        self.green = pack_green(background.green)
        self.frequency = frequency
        self.preset = preset or Preset()
        axes = background.lattice.storeys[0].axes
        top = background.lattice.storeys[-1].axes[2]
        self._room = np.array(
            [[axes[0][0], axes[1][0], axes[2][0]], [axes[0][-1], axes[1][-1], top[-1]]]
        )

    def solve(self, scene: Scene) -> tuple[Array, int, float, float]:
        """Return the change of the Maxwell matrix of all terminals [F], and its estimated error.

        Returns:
            Change, shape (terminals, terminals); the number of charge functions; estimated error
            of the largest entry [F]; and the same once more.

        Raises:
            SolveError: Bodies lie within each other in a way that leaves no solution.
        """
        bodies, _ = self.pack(scene)
        n = self.green.terminals
        if not len(bodies):
            return np.zeros((n, n)), 0, 0.0, 0.0
        solution = self.solution(bodies)
        error = UNIT * float(np.abs(np.diag(solution.left)).max())
        return UNIT * solution.delta, solution.size, error, error

    def reset(self) -> None:
        """Do nothing: no scene depends on the one before."""

    def solution(self, bodies: NDArray[np.void]) -> Solution:
        """Solve packed bodies."""
        out = solve(bodies, self.green, self.preset.threshold, self.preset.width)
        if not out.size:
            raise SolveError(
                "the charges of the bodies cannot be told apart; look for bodies that coincide"
            )
        return out

    def pack(self, scene: Scene) -> tuple[NDArray[np.void], list[RigidShape]]:
        """Lay out the bodies that lie in the domain, and the shapes that the layout points to."""
        packed = scene.pack()
        inside = (packed.bounds[:, 1] > self._room[0]).all(1) & (
            packed.bounds[:, 0] < self._room[1]
        ).all(1)
        chosen = np.flatnonzero(inside)
        bodies, shapes = np.zeros(len(chosen), BODY), []
        for place, k in enumerate(chosen):
            body = scene[int(k)]
            shape, size = rigid(body.shape, self.preset.panels)
            shapes.append(shape)
            bodies[place] = shape.record
            bodies["scale"][place] = size
            self._set_matter(bodies[place], body, shape, size)
        bodies["rotation"], bodies["position"] = packed.rotation[chosen], packed.position[chosen]
        bodies["group"] = np.arange(len(chosen))
        return bodies, shapes

    def _set_matter(self, record: np.void, body: Body, shape: RigidShape, size: float) -> None:
        eps = body.material.complex_permittivity(self.frequency)
        if abs(eps) >= CONDUCTING:
            record["neutral"] = body.grounding == "floating"
            if not isinstance(body.grounding, str):
                record["tie"] = UNIT / body.grounding
            return
        record["neutral"] = 1
        if abs(eps - 1) < 1e-9:
            eps = complex(1 + 1e-9)
        record["impedance"] = shape.impedance.ctypes.data
        record["softness"] = 1.0 / (eps.real - 1.0)


def pack_green(green: GreenFunction) -> Green:
    """Lay a Green's function out for the kernels."""
    terminals = green.near_phi.shape[1]
    lead = 8 * -(-terminals // 8)

    def table(phi: NDArray, modes: NDArray) -> NDArray:
        width = WIDTH * -(-(lead + modes.shape[1]) // WIDTH)
        out = np.zeros((len(phi), width), np.float32)
        out[:, :terminals] = phi
        out[:, lead : lead + modes.shape[1]] = modes
        return out

    far = table(green.far_phi, green.far_modes)
    return Green(
        np.ascontiguousarray(green.near_sources.T), table(green.near_phi, green.near_modes),
        np.ascontiguousarray(green.far_sources.T), far, np.ascontiguousarray(far[:, :lead]),
        lead, terminals, float(green.floor), np.asarray(green.box, float),
        np.asarray(green.blend, float),
    )  # fmt: skip
