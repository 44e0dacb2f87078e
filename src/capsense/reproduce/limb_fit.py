"""One electrode fitted to the slopes of public data above a human arm.

The data's electrode, its mounting and the zero of its distance are not described. So three figures
are fitted to four slopes: the electrode's edge, an offset of its distance, and the tare.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import RectBivariateSpline
from scipy.optimize import least_squares

from capsense.reproduce.limb_curves import Array, distances, slopes

ARM = (-0.87, -1.31, -1.88, -2.64)
"""Slopes of the public human-arm data over the ranges of
:data:`~capsense.reproduce.limb_curves.RANGES`; their uncertainties are not known."""
WITHIN = 0.15
"""How near each slope is to be."""
EDGES = (0.02, 0.03, 0.06, 0.10, 0.15)
"""Edges of the square electrodes [m] between which the fit interpolates."""
FAR = (0.18, 0.21, 0.25)
"""Distances [m] beyond the ranges, for the offset."""
SPAN = ((EDGES[0], -0.005, -1.0), (EDGES[-1], 0.08, 0.95))
"""Between which edge [m], offset [m] and tare, see :class:`ArmFit`, are sought; readings nearer
than 5 mm, where large electrodes are less sure, are left out."""
STEPS = (13, 30, 27)
"""Of the search over these."""


@dataclass(frozen=True)
class ArmFit:
    """What a fit to the arm found."""

    figures: tuple[float, float, float]
    """The electrode's edge [m], the offset [m] that is added to the data's distances, and the
    tare, as a share of the reading at 15 cm."""
    slopes: tuple[float, ...]
    ranges: tuple[tuple[float, float], ...]
    """Of each figure, where all slopes are near enough with some values of the others; empty if
    nowhere."""

    @property
    def apart(self) -> float:
        """The largest difference of a slope from the data's."""
        return float(np.abs(np.subtract(self.slopes, ARM)).max())


class _Model:
    """Slopes over edge, offset and tare, by interpolation of curves."""

    def __init__(self, edges: ArrayLike, distance: Array, change: Array) -> None:
        self._spline = RectBivariateSpline(np.log(edges), np.log(distance), np.log(change))
        self._nearest, self._farthest = distance[0], distance[-1]
        self._z = distances(6)
        self._z = self._z[self._z > 0.009]

    def slopes(self, figures: ArrayLike) -> Array:
        edge, offset, tare = np.asarray(figures, dtype=float)
        z = np.clip(np.append(self._z, 0.15) + offset, self._nearest, self._farthest)
        reading = np.exp(self._spline.ev(np.log(edge), np.log(z)))
        return np.array(slopes(self._z, reading[:-1] - tare * reading[-1]))


def fit_arm(edges: ArrayLike, distance: Array, change: Array) -> ArmFit:
    """Fit edge, offset and tare by least squares, and look where else all slopes are near enough.

    Args:
        edges: Of the electrodes [m], shape (e,).
        distance: From the electrode to the skin [m], rising, shape (n,).
        change: Readings less those without a limb [F], shape (e, n).
    """
    model = _Model(edges, distance, np.asarray(change))
    low, high = np.array(SPAN)
    axes = [np.linspace(a, b, n) for a, b, n in zip(low, high, STEPS, strict=True)]
    tried = np.array(list(product(*axes)))
    apart = np.abs([model.slopes(figures) - ARM for figures in tried])  # NaN where all is tared
    near = tried[apart.max(axis=1) < WITHIN]
    best = least_squares(
        lambda figures: model.slopes(figures) - ARM,
        tried[np.nanargmin((apart**2).sum(axis=1))],
        x_scale=(0.02, 0.005, 0.1),
        bounds=(low, high),
    ).x
    ranges = [(float(c.min()), float(c.max())) for c in near.T] if len(near) else []
    a, b, c = (float(value) for value in best)
    return ArmFit((a, b, c), tuple(model.slopes(best).tolist()), tuple(ranges))
