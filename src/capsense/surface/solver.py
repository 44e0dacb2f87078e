"""The surface core: charges on the bodies, against the Green's function of the design."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from capsense.constants import EPS0
from capsense.field.green import GreenFunction
from capsense.surface.solve_kernels import solve
from capsense.surface.step_kernels import BODY, Green
from capsense.surface.vector_kernels import WIDTH

Array = NDArray[np.float64]


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

    near, far = table(green.near_phi, green.near_modes), table(green.far_phi, green.far_modes)
    return Green(
        np.ascontiguousarray(green.near_sources.T), near, np.ascontiguousarray(green.far_sources.T),
        far, np.ascontiguousarray(far[:, :lead]), lead, terminals, float(green.floor),
        np.asarray(green.box, float), np.asarray(green.blend, float),
    )  # fmt: skip
