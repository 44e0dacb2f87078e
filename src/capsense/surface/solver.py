"""The surface core: charges on the bodies, against the Green's function of the design."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capsense.errors import SceneError, SolveError
from capsense.field.background import BackgroundField
from capsense.field.green import GreenFunction
from capsense.scene import Layers, Scene
from capsense.scene.scene import PackedScene
from capsense.surface.changing import ChangingBody, layer_pieces
from capsense.surface.lossy import solve_lossy
from capsense.surface.matter import UNIT, Matter, matter_of, sizes_of
from capsense.surface.rigid import RigidShape
from capsense.surface.solve_kernels import Solution, solve
from capsense.surface.step_kernels import BODY, Green
from capsense.surface.store import rigid
from capsense.surface.vector_kernels import WIDTH

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Preset:
    """How finely a scene is resolved."""

    panels: int = 700
    """About how many panels cover a shape."""
    threshold: float = 0.015
    """Charge functions count that take up this part of an electrode's energy alone."""
    width: float = 2.5
    """They fade in up to so many times that."""


PRESETS = {
    "standard": Preset(),
    "learning": Preset(panels=300, threshold=0.08),
    "fine": Preset(panels=1400, threshold=0.004),
}
"""Presets by name."""


@dataclass(frozen=True, eq=False)
class PackedBodies:
    """The bodies of a scene that reach into the domain, as the kernels take them."""

    records: NDArray[np.void]
    """One :data:`BODY` each, shape (n,)."""
    chosen: NDArray[np.intp]
    """Their places in the scene, shape (n,)."""
    matter: Matter
    """What they are made of and what ties them to ground."""
    shapes: list[RigidShape | ChangingBody]
    """What the records point to."""


class SurfaceSolver:
    """Solves scenes, each by itself.

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
        low, top = background.lattice.storeys[0].axes, background.lattice.storeys[-1].axes[2]
        self._room = np.array([[a[0] for a in low], [low[0][-1], low[1][-1], top[-1]]])

    def in_farads(self, solution: Solution) -> tuple[Array, float]:
        """Change of the Maxwell matrix of all terminals [F], (terminals, terminals), and its error.

        The error is an estimate of that of the largest entry [F].
        """
        return UNIT * solution.delta, UNIT * float(np.abs(np.diag(solution.left)).max())

    def jacobian(self, scene: Scene, bodies: PackedBodies, solution: Solution | None) -> Array:
        """How the matrix of all terminals changes with the poses of a scene's bodies.

        Returns:
            Shape (bodies, terminals, terminals, 6): as each body moves along the sensor frame's x,
            y, z [F/m], and turns about axes parallel to these through its origin [F/rad].

        Raises:
            SceneError: A body is of matter with losses.
        """
        out = np.zeros((len(scene), self.green.terminals, self.green.terminals, 6))
        if solution is None:
            return out
        if bodies.matter.lossy:
            raise SceneError(
                "a Jacobian is asked for with bodies of lossy matter, which have none yet; give "
                "them a conductor's or a lossless material"
            )
        from capsense.surface.gradient_kernels import jacobian

        out[bodies.chosen] = UNIT * jacobian(solution, bodies.records, self.green)
        return out

    def solution(
        self, scene: Scene, *, jacobian: bool = False
    ) -> tuple[PackedBodies, Solution | None]:
        """Return the packed bodies of a scene and their charges; None where none is in the domain.

        Raises:
            SceneError: A dielectric has no inside, see :meth:`unsupported`.
            SolveError: Bodies lie within each other in a way that leaves no solution.
        """
        bodies, preset = self.pack(scene), self.preset
        if not len(bodies.records):
            return bodies, None
        if bodies.matter.lossy:
            matter = bodies.matter
            softness = matter.softness()
            impedances = [
                s.impedance if soft != 0 and isinstance(s, RigidShape) else None
                for s, soft in zip(bodies.shapes, softness, strict=True)
            ]
            out = solve_lossy(
                bodies.records, matter.ties(sizes_of(bodies.records, bodies.shapes)), softness,
                impedances, self.green, preset.threshold, preset.width,
            )  # fmt: skip
        else:
            out = solve(bodies.records, self.green, preset.threshold, preset.width, jacobian)
        if not (out.size and np.isfinite(out.delta).all()):
            raise SolveError(
                "the charges of the bodies cannot be told apart; look for bodies that coincide"
            )
        return bodies, out

    def unsupported(self, scene: Scene) -> str | None:
        """Say what of a scene has no surface charges here, if anything."""
        packed = scene.pack()
        within = self._within(packed)
        for k in np.flatnonzero(self._met(packed)).tolist():
            body = scene[k]
            if matter_of([body], self.frequency).conducting[0]:
                continue
            if isinstance(body.shape, Layers):
                return "a dielectric given by a depth image"
            if not within[k]:
                return "a dielectric that the walls of the domain cut off"
            if not getattr(body.shape, "closed", True):
                return "a dielectric whose surface is open"
        return None

    def pack(self, scene: Scene) -> PackedBodies:
        """Lay out the bodies that reach into the domain."""
        packed = scene.pack()
        met, within = np.flatnonzero(self._met(packed)).tolist(), self._within(packed)
        matter = matter_of([scene[k] for k in met], self.frequency)
        shapes: list[RigidShape | ChangingBody] = []
        sizes: list[float] = []
        kept: list[int] = []
        for place, k in enumerate(met):
            shape, size = self._shape(
                scene, packed, k, bool(within[k] or not matter.conducting[place])
            )
            if shape is not None:
                shapes.append(shape)
                sizes.append(size)
                kept.append(place)
        chosen = np.array(met, np.intp)[kept]
        matter = matter[kept].joined(scene, packed, chosen)
        records = np.array([s.record for s in shapes], BODY)
        records["scale"] = sizes
        records["rotation"], records["position"] = packed.rotation[chosen], packed.position[chosen]
        matter.write(records, shapes)
        return PackedBodies(records, chosen, matter, shapes)

    def _shape(
        self, scene: Scene, packed: PackedScene, k: int, whole: bool
    ) -> tuple[RigidShape | ChangingBody | None, float]:
        """Charge functions of a body and its size; None where nothing of it is in the domain."""
        shape = scene[k].shape
        if isinstance(shape, Layers):
            tree, pieces, wanted = layer_pieces(shape)
            inside = wanted & self._inside(pieces.centers, packed, k)
            return (ChangingBody(tree, pieces, inside) if inside.any() else None), 1.0
        functions, size = rigid(shape, self.preset.panels)
        if whole:
            return functions, size
        inside = self._inside(size * functions.panels.centers, packed, k)
        return (
            ChangingBody(functions.tree, functions.panels, inside) if inside.any() else None
        ), size

    def _met(self, packed: PackedScene) -> Bools:
        """Which bodies reach into the domain."""
        low, high = packed.bounds[:, 0], packed.bounds[:, 1]
        return ((high > self._room[0]) & (low < self._room[1])).all(axis=1)

    def _within(self, packed: PackedScene) -> Bools:
        """Which bodies lie in the domain as a whole."""
        low, high = packed.bounds[:, 0], packed.bounds[:, 1]
        return ((low > self._room[0]) & (high < self._room[1])).all(axis=1)

    def _inside(self, points: Array, packed: PackedScene, k: int) -> Bools:
        """Which points of a body's frame lie in the domain."""
        world = points @ packed.rotation[k].T + packed.position[k]
        return ((world > self._room[0]) & (world < self._room[1])).all(axis=1)


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
