"""The design of a fleet on Warp, its circuit, and shapes of bodies, laid out for the kernels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from capsense.constants import UNIT
from capsense.field.background import Terminals
from capsense.fleet import warp_cut
from capsense.fleet import warp_network as network
from capsense.fleet import warp_pairs as pairs
from capsense.fleet.bodies import Bodies
from capsense.solver.surface_solver import SurfaceSolver
from capsense.solver.tree.rigid import RigidShape


def pack_response(solver: SurfaceSolver, slots: int, device: Any) -> Any:
    """The Green's function of a design, and how many columns terminals and nodes have."""
    out, green = warp_cut.Response(), solver.green
    phi_columns = pairs.COLUMNS * -(-(green.terminals + slots) // pairs.COLUMNS)
    near, _, far = green.levels  # the middle level is not used here
    sources = np.concatenate([far.sources.T, near.sources.T]).astype(np.float32)
    (count, few), size = far.table.shape, warp_cut.SOURCES
    width, whole = (
        warp_cut.WIDTH * -(-columns // warp_cut.WIDTH) for columns in (few, near.table.shape[1])
    )
    table = np.zeros((size * -(-len(sources) // size), whole), np.float32)
    table[:count, :few] = far.table
    table[count : len(sources), : near.table.shape[1]] = near.table
    columns = np.ascontiguousarray(table.T).reshape(len(table.T), -1, size)
    parts = table[: len(sources)].reshape(len(sources), -1, warp_cut.WIDTH)
    out.sources = wp.array(sources, dtype=wp.vec3, device=device)
    out.table = wp.array(parts, dtype=warp_cut.row, device=device)
    out.columns = wp.array(columns, dtype=warp_cut.many, device=device)
    out.far, out.passes = count, width // warp_cut.WIDTH
    out.first, out.phi_columns = green.phi_columns, phi_columns
    out.terminals, out.middle = green.terminals, wp.vec3(*solver.middle)
    out.length = solver.length
    out.extent, out.validity = green.extent, green.gap.validity
    out.floor = green.floor
    out.has_face = int(green.space.has_face and green.gap.curvature == 0.0)
    out.blend0, out.blend1 = green.blends[-1].tolist()
    (out.box0, out.box1), (out.room0, out.room1) = (
        (wp.vec3(*corners[0]), wp.vec3(*corners[1])) for corners in (green.box, green.active_bounds)
    )
    walls = np.array([green.space.inner, green.space.fade], np.float32)
    out.walls = wp.array(walls, dtype=wp.vec3, device=device)
    return out


def pack_circuit(solver: SurfaceSolver, terminals: Terminals, device: Any) -> Any:
    """The terminals of a design."""
    out = network.Circuit()
    out.electrodes, out.driven = terminals.electrodes, terminals.driven
    out.unit, out.metre = solver.unit, UNIT
    for name in ("empty_maxwell", "empty"):
        setattr(out, name, wp.array(getattr(terminals, name), dtype=wp.float64, device=device))
    bound = np.minimum(terminals.bound, np.finfo(np.float32).max).astype(np.float32)
    out.screened = wp.array(bound, dtype=wp.float32, device=device)
    return out


def pack_shapes(shapes: Sequence[RigidShape], bodies: Bodies, array: Any) -> Any:
    """Lay shapes out one behind the other."""
    trees = [shape.tree for shape in shapes]
    sizes = np.array([len(shape.panels) for shape in shapes])
    blocks = [shape.potential_coefficients.ravel() for shape in shapes]
    soft = bodies.shapes["neumann_to_dirichlet"] != 0
    none = np.zeros(0, np.float32)  # conductors have no inside
    inside = [
        shape.neumann_to_dirichlet.ravel() if s else none
        for shape, s in zip(shapes, soft, strict=True)
    ]

    def joined(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(tree, name) for tree in trees])

    out = warp_cut.Shapes()
    out.first = array(np.concatenate([[0], np.cumsum(2 * sizes - 1)[:-1]]), wp.int32)
    out.functions = array(sizes, wp.int32)
    for name, parts in (("block", blocks), ("inside", inside)):
        ends = np.cumsum([0, *map(len, parts)])
        setattr(out, name, array(ends[:-1], wp.int64))
    out.radius = array(bodies.radius, wp.float32)
    out.capacitance = array(np.array([shape.capacitance for shape in shapes]), wp.float32)
    for name, kind in (
        ("children", wp.int32), ("function", wp.int32), ("charge", wp.float32), ("center", wp.vec3),
        ("points", wp.vec3), ("extent", wp.float32), ("softening_length", wp.float32),
    ):  # fmt: skip
        setattr(out, name, array(joined(name), kind))
    out.potential_coefficients = array(np.concatenate(blocks), wp.float32)
    out.neumann_to_dirichlet = array(np.concatenate(inside), wp.float32)
    return out
