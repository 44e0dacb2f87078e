"""The columns of the slow twin: which share of one a body covers, and where."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capsense.field.lattice import Storey
from capsense.scene import Body, PackedScene, ShapeKind
from capsense.scene.approach_kernels import approach, slenderness
from capsense.solve.column_kernels import RAMP, WHOLE, part_covered, thin_factor

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Column:
    """What a lattice line stands for: about half-way to its neighbours."""

    axis: int
    across: tuple[int, int]
    middle: tuple[float, float]
    bounds: dict[int, tuple[float, float]]

    @classmethod
    def around(cls, storey: Storey, axis: int, i: int, j: int) -> Column:
        p, q = [a for a in range(3) if a != axis]
        bounds = {
            a: (float(storey.faces[a][k - 1]), float(storey.faces[a][k]))
            for a, k in ((p, i), (q, j))
        }
        return cls(axis, (p, q), (float(storey.axes[p][i]), float(storey.axes[q][j])), bounds)

    def trials(self, packed: PackedScene, number: int) -> list[tuple[float, float]]:
        """Where to look for a body that the middle misses.

        Where it comes closest to the column's line, drawn into the column. For meshes and
        layers, the middles of the column's sides, then its corners.
        """
        (u, v), (p, q) = self.middle, self.across
        (pl, ph), (ql, qh) = self.bounds[p], self.bounds[q]
        kind = packed.kinds[number]
        if kind not in (ShapeKind.MESH, ShapeKind.LAYERS):
            x, y, z = self.at(u, v).tolist()
            near = approach(
                kind, packed.params[number], packed.rotation[number], packed.position[number],
                x, y, z, self.axis,
            )  # fmt: skip
            return [(float(np.clip(near[p], pl, ph)), float(np.clip(near[q], ql, qh)))]
        return [
            (pl, v), (ph, v), (u, ql), (u, qh), (pl, ql), (pl, qh), (ph, ql), (ph, qh)
        ]  # fmt: skip

    def at(self, u: float, v: float) -> Array:
        """A point of the line at (u, v) across."""
        out = np.zeros(3)
        out[list(self.across)] = u, v
        return out


def met(
    body: Body, number: int, packed: PackedScene, conducts: bool, column: Column
) -> list[tuple[float, float, float, float]]:
    """A body's stretches in a column: weight, start, end, and how far aside they lie."""
    axis = column.axis
    low, high = packed.bounds[number]
    if any(end < low[a] or start > high[a] for a, (start, end) in column.bounds.items()):
        return []
    middle = column.at(*column.middle)
    if not conducts:
        return [(1.0, a, b, 0.0) for a, b in pierce(body, middle[None], axis)[0]]
    hit = pierce(body, middle[None], axis)[0]
    centred, point = bool(hit), middle.copy()
    if not centred:
        trials = np.array([column.at(*uv) for uv in column.trials(packed, number)])
        hits = pierce(body, trials, axis)
        first = next((k for k, found in enumerate(hits) if found), None)
        if first is None:
            return []
        hit, point = hits[first], trials[first].copy()
    a, b = max(hit, key=lambda ab: ab[1] - ab[0])
    point[axis] = 0.5 * (a + b)
    kind, params = body.shape.kind, packed.params[number]
    slender = float(slenderness(kind, params))
    share, widths, extents, off = 1.0, [], [], []
    for along, node in zip(column.across, column.middle, strict=True):
        low, high = column.bounds[along]
        chords = [
            (a, b)
            for a, b in pierce(body, point[None], along)[0]
            if a - 1e-12 <= point[along] <= b + 1e-12
        ]
        a, b = chords[0] if chords else (point[along], point[along])
        inside = (max(low, a), min(high, b))
        widths.append(high - low)
        extents.append(max(b - a, slender))
        share *= part_covered(low, node, high, *inside, extents[-1])
        point[along] = 0.5 * (inside[0] + inside[1])
        off.append(max(inside[0] - node, node - inside[1], 0.0))
    weight = 0.5 + RAMP * (share - 0.5)
    weight = 1.0 if weight > WHOLE else weight
    if slender < min(widths):
        weight *= thin_factor(*widths, *extents)
    if weight <= 0.0:
        return []
    if weight == 1.0 and centred:
        point = middle
    aside = math.hypot(*off)
    return [(weight, a, b, aside) for a, b in pierce(body, point[None], axis)[0]]


def pierce(body: Body, points: Array, axis: int) -> list[list[tuple[float, float]]]:
    """Stretches inside a body of lines along an axis: coordinates [m] of their ends."""
    origins = points.copy()
    origins[:, axis] = 0.0
    back = body.pose.rotation.T
    local = (origins - np.asarray(body.pose.position)) @ back.T
    found = body.shape.line_intervals(local, back[:, axis]).reshape(len(origins), -1, 2)
    return [[(float(a), float(b)) for a, b in rows if b > a] for rows in found]
