"""Scenes of a few rigid bodies, laid out for the surface kernels."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from interpreted import fewer, thinned
from scipy.spatial.transform import Rotation

import capsense as cs
from capsense.field.green_kernels import Green, pack_green
from capsense.solver.bodies.panels import panels_of
from capsense.solver.tree.rigid import BODY, RigidShape, rigid_shape

Array = np.ndarray


class Placed(NamedTuple):
    """A shape somewhere."""

    shape: cs.Sphere | cs.Capsule | cs.Box
    position: tuple[float, float, float]
    turned: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rotation vector [rad]."""
    floating: bool = False
    eps_r: float = np.inf


@cache
def shape_of(shape: cs.Sphere | cs.Capsule | cs.Box) -> RigidShape:
    """The charge functions of a shape, kept for the whole run of the tests."""
    return rigid_shape(panels_of(shape, fewer(300)), apart=True)


@cache
def green_of(design: str = "six_patch_bare") -> Green:
    """The Green's function of a packaged design."""
    sim = cs.Simulator(design)
    return pack_green(thinned(sim.background.green), sim.design)


def pack(*bodies: Placed) -> Array:
    """Lay bodies out; their shapes live on in :func:`shape_of`."""
    out = np.zeros(len(bodies), BODY)
    for k, body in enumerate(bodies):
        shape = shape_of(body.shape)
        out[k] = shape.record
        out["scale"][k], out["position"][k], out["group"][k] = 1.0, body.position, k
        out["rotation"][k] = Rotation.from_rotvec(body.turned).as_matrix()
        out["neutral"][k] = body.floating or np.isfinite(body.eps_r)
        out["free"][k] = body.floating and not np.isfinite(body.eps_r)
        if np.isfinite(body.eps_r):
            out["neumann_to_dirichlet"][k] = shape.neumann_to_dirichlet.ctypes.data
            out["inverse_susceptibility"][k] = 1.0 / (body.eps_r - 1.0)
            out["polarization_stiffness"][k] = 2.0 / (body.eps_r - 1.0)
    return out


def moved(bodies: Array, which: int, direction: int, step: float) -> Array:
    """Move a body along an axis [m], or turn it about one that passes through its origin [rad]."""
    out = bodies.copy()
    vector = np.zeros(3)
    vector[direction % 3] = step
    if direction < 3:
        out["position"][which] += vector
    else:
        out["rotation"][which] = Rotation.from_rotvec(vector).as_matrix() @ out["rotation"][which]
    return out
