"""The columns of the slow twin: which share of one a body covers, and where."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise

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


@dataclass
class Part:
    """What a body takes of a column."""

    body: int
    stretches: list[tuple[float, float]]
    """Where it is met: coordinates [m] along the column."""
    weight: float = 1.0
    """How much of the column's cross-section it fills."""
    aside: float = 0.0
    """How far what it covers lies from the column's line [m]."""
    across: list[tuple[float, float]] = field(default_factory=list)
    """From where to where it covers the column, along both axes across [m]."""
    begin: float = 0.0
    """It takes ``[begin, begin + weight]`` of the cross-section's weight."""


def met(body: Body, number: int, packed: PackedScene, conducts: bool, column: Column) -> Part:
    """What a body takes of a column, of no stretches where they do not meet."""
    axis = column.axis
    low, high = packed.bounds[number]
    if any(end < low[a] or start > high[a] for a, (start, end) in column.bounds.items()):
        return Part(number, [])
    middle = column.at(*column.middle)
    hit = pierce(body, middle[None], axis)[0]
    if not conducts:
        return Part(number, hit)
    centred, point = bool(hit), middle.copy()
    if not centred:
        trials = np.array([column.at(*uv) for uv in column.trials(packed, number)])
        hits = pierce(body, trials, axis)
        first = next((k for k, found in enumerate(hits) if found), None)
        if first is None:
            return Part(number, [])
        hit, point = hits[first], trials[first].copy()
    a, b = max(hit, key=lambda ab: ab[1] - ab[0])
    point[axis] = 0.5 * (a + b)
    kind, params = body.shape.kind, packed.params[number]
    slender = float(slenderness(kind, params))
    share, widths, extents, off, across = 1.0, [], [], [], []
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
        across.append(inside)
    weight = 0.5 + RAMP * (share - 0.5)
    weight = 1.0 if weight > WHOLE else weight
    if slender < min(widths):
        weight *= thin_factor(*widths, *extents)
    if weight <= 0.0:
        return Part(number, [])
    if weight == 1.0 and centred:
        point = middle
    stretches = pierce(body, point[None], axis)[0]
    return Part(number, stretches, weight, math.hypot(*off), across)


def layers(parts: list[Part]) -> list[tuple[float, list[Part]]]:
    """Layers of a column's cross-section, each with its share and the parts that fill it.

    Bodies that lie beside each other in the column fill one layer after the other, those of which
    one lies within the other the same. Dielectrics fill all of it.
    """
    for k, part in enumerate(parts):
        for other in parts[:k]:
            if other.across and part.weight < 1.0 and other.weight < 1.0:
                begin = other.begin + (1.0 - _nested(part, other)) * other.weight
                part.begin = max(part.begin, begin)
        part.begin = min(part.begin, 1.0 - part.weight)
    edges = [0.0]
    for edge in sorted({e for part in parts for e in (part.begin, part.begin + part.weight)}):
        if edge > edges[-1] + 1e-9:
            edges.append(edge)
    return [
        (upper - lower, filled)
        for lower, upper in pairwise(edges)
        if (
            filled := [
                part
                for part in parts
                if part.begin <= lower + 1e-9 and part.begin + part.weight >= upper - 1e-9
            ]
        )
    ]


def _nested(part: Part, other: Part) -> float:
    """How much of the smaller of two parts lies within the other: 0 beside, 1 inside."""
    share = 1.0
    for (a, b), (c, d) in zip(part.across, other.across, strict=True):
        narrow = min(b - a, d - c)
        share *= min(max(min(b, d) - max(a, c), 0.0) / narrow, 1.0) if narrow > 0.0 else 1.0
    return share


def pierce(body: Body, points: Array, axis: int) -> list[list[tuple[float, float]]]:
    """Stretches inside a body of lines along an axis: coordinates [m] of their ends."""
    origins = points.copy()
    origins[:, axis] = 0.0
    back = body.pose.rotation.T
    local = (origins - np.asarray(body.pose.position)) @ back.T
    found = body.shape.line_intervals(local, back[:, axis]).reshape(len(origins), -1, 2)
    return [[(float(a), float(b)) for a, b in rows if b > a] for rows in found]
