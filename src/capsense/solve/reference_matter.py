"""Dielectrics that fill a column in part, for the slow twin.

Across a sheet of matter the field is that of capacitances in series, along it that of capacitances
side by side. A line through a node along each axis tells how much of the node's surroundings is
filled, F; a surface divides those lines that it crosses, F (1 − F) > 0, and leaves the others on
one of its sides. These products are the weights with which the axes say what a link's permittivity
is: its own axis by resistances in series, the other two by the mean of κ. Only thin sheets count,
those of up to half a link, and in part of up to one and a half; for thick bodies, whose surfaces
the lattice resolves, the link itself decides.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from capsense.field.lattice import Lattice, Storey

Array = NDArray[np.float64]


@dataclass
class Matter:
    """What dielectrics fill of a link; pairs: what its lower and upper end bear, as of a beam."""

    series: float
    """Resistance of the link over that of the empty one."""
    fill: Array = field(default_factory=lambda: np.zeros(2))
    """Fraction filled."""
    gain: Array = field(default_factory=lambda: np.zeros(2))
    """Mean of κ − 1 along the link."""
    thin: Array = field(default_factory=lambda: np.zeros(2))
    """Fraction filled by thin sheets."""

    def add(self, fill: float, middle: float, kappa: float, thick: float) -> None:
        """Add a stretch at ``middle`` of a body as ``thick`` there, in lengths of the link.

        A body is as thick as the line's stretch inside it, and nowhere less than the largest ball
        that it holds: where a ball ends, it is no sheet.
        """
        part = fill * np.array([1.0 - middle, middle])
        self.fill += part
        self.gain += part * (kappa - 1.0)
        self.thin += part * min(max(1.5 - thick, 0.0), 1.0)


def storey_of(lattice: Lattice, node: int) -> Storey:
    """The storey that a node is of."""
    return next(s for s in lattice.storeys if s.first <= node < s.stop)


def mixed_permittivity(
    lattice: Lattice,
    matter: Mapping[tuple[int, int], Matter | None],
    cut: set[tuple[int, int]],
    axis: int,
    a: int,
    b: int,
) -> float:
    """Permittivity of the link from a to b over the empty domain's."""
    own = matter.get((axis, a)) or Matter(1.0)
    fill, series = own.fill.sum(), 1.0 / own.series
    votes = [(fill * (1.0 - fill), own.thin.sum() * (1.0 - fill), series)]
    for across in {0, 1, 2} - {axis}:
        ends = [_at_node(lattice, matter, cut, across, node) for node in (a, b)]
        if None not in ends:
            fills, gains, thins = np.array(ends).T
            votes.append(
                (
                    float(np.mean(fills * (1.0 - fills))), float(np.mean(thins * (1.0 - fills))),
                    float(1.0 + np.mean(gains)),
                )
            )  # fmt: skip
    weights, thin, eps = np.array(votes).T
    total = weights.sum()
    if total <= 1e-6:
        return float(series)
    return float(series + thin.sum() / total * (weights @ eps / total - series))


def _at_node(
    lattice: Lattice,
    matter: Mapping[tuple[int, int], Matter | None],
    cut: set[tuple[int, int]],
    axis: int,
    node: int,
) -> tuple[float, float, float] | None:
    """Fill, gain and thin fill along a line around a node; None beside other than matter alone."""
    storey = storey_of(lattice, node)
    stride, c = storey.strides[axis], storey.axes[axis]
    k = (node - storey.first) // stride % storey.shape[axis]
    total, length = np.zeros(3), 0.0
    for side, lower, inside in ((0, node, k < len(c) - 1), (1, node - stride, k > 0)):
        if not inside:
            continue
        here = matter.get((axis, lower), Matter(1.0))
        if here is None or (axis, lower) in cut:
            return None
        part = c[k + 1] - c[k] if side == 0 else c[k] - c[k - 1]
        total += part * np.array([here.fill[side], here.gain[side], here.thin[side]])
        length += 0.5 * part
    fill, gain, thin = (total / length).tolist()
    return fill, gain, thin
