"""Scenes of rigid bodies for the twin of the step, and as the kernels take them."""

from __future__ import annotations

import math
from functools import cache

import interpreted
import numpy as np
from interpreted import fewer, thinned
from surface_twin import Piece

import capsense as cs
from capsense.constants import UNIT
from capsense.field.green import GreenFunction
from capsense.field.green_kernels import Green, pack_green
from capsense.solver.bodies.panels import panels_of
from capsense.solver.gap.body_gap_kernels import facing_of
from capsense.solver.surface_solver import Preset, SurfaceSolver
from capsense.solver.system.step import Solution, prepared, solve
from capsense.solver.tree.rigid import BODY, RigidShape, rigid_shape

Array = np.ndarray
BALL, FINGER, BOX = cs.Sphere(0.03), cs.Capsule(0.008, 0.06), cs.Box((0.1, 0.06, 0.02))
CYLINDER, EGG = cs.Cylinder(0.02, 0.05), cs.Ellipsoid((0.04, 0.03, 0.02))
ACROSS, TILTED = (0.1, math.pi / 2, 0.2), (0.1, 0.2, 0.3)
NONE = math.inf
"""The tie of a body that floats."""
WIDTH = 2.5
ALL = 1e-12
"""A threshold below which no charge function falls that counts."""


def prepared_alone(bodies, threshold):
    """The system of bodies that face no other conductor."""
    return prepared(bodies, packed_green(), threshold, WIDTH, facing_of(bodies[:0]), bodies)


@cache
def shape_of(shape: cs.Shape, count: int = 150) -> RigidShape:
    return rigid_shape(panels_of(shape, fewer(count)))


@cache
def simulator() -> cs.Simulator:
    return cs.Simulator("six_patch_bare")


def exact() -> GreenFunction:
    return thinned(simulator().background.green)


def coarse_solver() -> SurfaceSolver:
    return SurfaceSolver(exact(), simulator().design, preset=Preset(panels=150, coarsest=None))


@cache
def packed_green() -> Green:
    return pack_green(exact(), simulator().design)


class Scene(tuple[tuple[Piece, RigidShape], ...]):
    """Bodies as the twin takes them, with their charge functions."""

    @property
    def pieces(self) -> tuple[Piece, ...]:
        return tuple(piece for piece, _ in self)

    @property
    def trees(self) -> list[tuple[Array, Array, Array]]:
        return [(s.tree.children, s.tree.panel, charge_of(s)) for _, s in self]

    def packed(self) -> Array:
        """The same for the kernels."""
        out = np.zeros(len(self), BODY)
        for k, (piece, shape) in enumerate(self):
            out[k] = shape.record
            out["scale"][k], out["position"][k] = piece.scale, piece.position
            out["rotation"][k] = piece.rotation
            out["group"][k] = k if piece.group is None else piece.group
            joined = piece.group is not None
            out["neutral"][k] = piece.neutral and not joined
            if joined:
                out["ground_elastance"][k] = 1e8 if piece.neutral else piece.ground_elastance.real
            elif not piece.neutral:
                out["ground_elastance"][k] = piece.ground_elastance.real
            out["free"][k] = piece.free
            if np.isfinite(piece.eps_r):
                out["neumann_to_dirichlet"][k] = shape.neumann_to_dirichlet.ctypes.data
                out["inverse_susceptibility"][k] = (1 / (piece.eps_r - 1)).real
                out["polarization_stiffness"][k] = 2.0 * abs(1 / (piece.eps_r - 1))
        return out

    def solved(self, threshold: float = ALL) -> Solution:
        return solve(self.packed(), packed_green(), threshold, WIDTH, False)


def body(shape: cs.Shape, *where: tuple[float, ...], **state: complex) -> tuple[Piece, RigidShape]:
    found = shape_of(shape)
    return Piece(found.panels, *where, **state), found


def charge_of(shape: RigidShape) -> Array:
    """Equilibrium charge of the panels."""
    tree, single = shape.tree, shape.tree.panel >= 0
    out = np.empty(len(shape.panels))
    out[tree.panel[single]] = tree.charge[single]
    return out


def apart(found: Array, wanted: Array) -> float:
    """Largest difference over the largest entry."""
    return float(np.abs(found - wanted).max() / np.abs(wanted).max())


@cache
def scenes() -> dict[str, Scene]:
    return {
        "ball": Scene([body(BALL, (0.01, 0.0, 0.05))]),
        "ball between near and far": Scene([body(BALL, (0.01, 0.0, 0.038))]),
        "ball far off": Scene([body(BALL, (0.01, 0.0, 0.12))]),
        "finger at 5 mm": Scene([body(FINGER, (0.01, -0.02, 0.013), ACROSS)]),
        "box": Scene([body(BOX, (0.01, 0.0, 0.05), TILTED)]),
        "floating, made smaller": Scene(
            [body(BALL, (0.02, 0.01, 0.04), scale=0.7, ground_elastance=NONE)]
        ),
        "floating egg": Scene([body(EGG, (0.02, 0.01, 0.05), TILTED, ground_elastance=NONE)]),
        "ball on a capacitance": Scene([body(BALL, (0.02, 0.01, 0.04), ground_elastance=20.0)]),
        "ball of eps 3": Scene([body(BALL, (0.02, 0.01, 0.04), ground_elastance=NONE, eps_r=3.0)]),
        "box of eps 5": Scene(
            [body(BOX, (0.02, 0.01, 0.05), TILTED, ground_elastance=NONE, eps_r=5.0)]
        ),
        "finger of eps 80, larger": Scene(
            [body(FINGER, (0.0, 0.01, 0.04), ACROSS, scale=1.6, ground_elastance=NONE, eps_r=80.0)]
        ),
        "ball of eps 2000 with a contact": Scene(
            [body(BALL, (0.0, 0.01, 0.045), ground_elastance=0.08, eps_r=2000.0)]
        ),
        "finger and floating finger": Scene(
            [
                body(FINGER, (0.01, -0.02, 0.03), ACROSS),
                body(FINGER, (0.0, 0.01, 0.04), ACROSS, ground_elastance=NONE),
            ]
        ),
        "cylinder of eps 4 before a ball": Scene(
            [
                body(CYLINDER, (0.0, 0.0, 0.035), ACROSS, ground_elastance=NONE, eps_r=4.0),
                body(BALL, (0.01, 0.0, 0.09)),
            ]
        ),
        "three of all kinds": Scene(
            [
                body(FINGER, (0.01, -0.02, 0.03), ACROSS, ground_elastance=30.0),
                body(BALL, (0.0, 0.01, 0.08), ground_elastance=NONE, eps_r=4.0),
                body(BOX, (0.0, 0.05, 0.07), TILTED),
            ]
        ),
        "two joined, floating": Scene(
            [
                body(BALL, (-0.03, 0.0, 0.045), ground_elastance=NONE, group=0),
                body(FINGER, (0.03, 0.0, 0.04), ACROSS, ground_elastance=NONE, group=0),
            ]
        ),
        "two joined on a capacitance, a third alone": Scene(
            [
                body(BALL, (-0.04, 0.0, 0.045), ground_elastance=12.0, group=0),
                body(EGG, (0.0, 0.05, 0.05), ground_elastance=NONE),
                body(FINGER, (0.04, 0.0, 0.04), ACROSS, ground_elastance=12.0, group=0),
            ]
        ),
        "ball and box across a wall": Scene(
            [
                body(BALL, (0.0, -0.02, 0.05), ground_elastance=30.0),
                body(BOX, (0.22, 0.0, 0.05), TILTED),
            ]
        ),
        "floating box across two walls": Scene(
            [body(BOX, (0.19, 0.2, 0.04), TILTED, scale=1.5, ground_elastance=NONE)]
        ),
        "box of eps 5 across a wall": Scene(
            [body(BOX, (-0.2, 0.01, 0.05), TILTED, ground_elastance=NONE, eps_r=5.0)]
        ),
        "two across a wall, a third inside": Scene(
            [
                body(
                    CYLINDER, (0.0, -0.24, 0.04), ACROSS, scale=2.0, ground_elastance=NONE, group=0
                ),
                body(FINGER, (0.0, -0.2, 0.03), ACROSS, ground_elastance=NONE, group=0),
                body(BALL, (0.0, -0.02, 0.05), ground_elastance=30.0),
            ]
        ),
    }


NAMES = (
    "ball", "ball between near and far", "ball far off", "finger at 5 mm", "box",
    "floating, made smaller", "floating egg", "ball on a capacitance", "ball of eps 3",
    "box of eps 5", "finger of eps 80, larger", "ball of eps 2000 with a contact",
    "finger and floating finger", "cylinder of eps 4 before a ball", "three of all kinds",
    "two joined, floating", "two joined on a capacitance, a third alone",
    "ball and box across a wall", "floating box across two walls", "box of eps 5 across a wall",
    "two across a wall, a third inside",
)  # fmt: skip
TIED = (
    "ball on a capacitance", "ball of eps 2000 with a contact", "three of all kinds",
    "two joined, floating", "two joined on a capacitance, a third alone",
    "ball and box across a wall", "two across a wall, a third inside",
)  # fmt: skip
"""Where net charge has an energy of its own."""
if interpreted.ON:
    NAMES = (
        "finger at 5 mm", "floating, made smaller", "finger of eps 80, larger",
        "ball of eps 2000 with a contact", "three of all kinds",
        "two joined on a capacitance, a third alone", "ball and box across a wall",
        "floating box across two walls", "box of eps 5 across a wall",
    )  # fmt: skip
SOME = ("ball between near and far", "box of eps 5", "three of all kinds")


def reading(*bodies: cs.Body) -> Array:
    """ΔC [F] of a scene, by the solver."""
    solver = coarse_solver()
    _, solution = solver.solution(solver.look(cs.Scene(list(bodies))))
    assert solution is not None
    return UNIT * solution.delta.real


def cube(x: float, grounding: str | float, material: str | cs.Material = "steel") -> cs.Body:
    """20 mm wide, at x widths."""
    return cs.Body(cs.Box((0.02, 0.03, 0.03)), cs.Pose((0.02 * x, 0.0, 0.045)), material, grounding)
