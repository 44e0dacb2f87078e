"""Mean of 1/r between two clusters, each given by four points."""

from __future__ import annotations

import math

from capsense.surface.vector_kernels import fast

_FAR = 4.0
"""Clusters farther apart than so many of their joint extents are met by their moments."""
_SOFT = 0.15
"""Distance, as a part of the larger extent, below which 1/r of two points is bounded: clusters
that coincide then have less energy between them than each has alone."""


@fast
def mean_inverse(first, second, extent, other):
    """Mean of 1/r [1/m] over four points of each of two clusters, shapes (4, 3).

    Far ones by their centres and second moments, near ones point by point with a bounded 1/r.
    """
    cx = 0.25 * (first[0, 0] + first[1, 0] + first[2, 0] + first[3, 0])
    cy = 0.25 * (first[0, 1] + first[1, 1] + first[2, 1] + first[3, 1])
    cz = 0.25 * (first[0, 2] + first[1, 2] + first[2, 2] + first[3, 2])
    dx = cx - 0.25 * (second[0, 0] + second[1, 0] + second[2, 0] + second[3, 0])
    dy = cy - 0.25 * (second[0, 1] + second[1, 1] + second[2, 1] + second[3, 1])
    dz = cz - 0.25 * (second[0, 2] + second[1, 2] + second[2, 2] + second[3, 2])
    square = dx * dx + dy * dy + dz * dz
    reach = _FAR * (extent + other)
    if square > reach * reach:
        along, whole = 0.0, 0.0
        for c in range(2):
            body = first if c == 0 else second
            for k in range(1, 3):  # half of the sum and of the difference of the arms
                ax = 0.5 * (body[0, 0] - body[k, 0])
                ay = 0.5 * (body[0, 1] - body[k, 1])
                az = 0.5 * (body[0, 2] - body[k, 2])
                p = ax * dx + ay * dy + az * dz
                along += p * p
                whole += ax * ax + ay * ay + az * az
        return (1.0 + (1.5 * along / square - 0.5 * whole) / square) / math.sqrt(square)
    bound = (_SOFT * max(extent, other)) ** 4
    total = 0.0
    for p in range(4):
        for q in range(4):
            x = first[p, 0] - second[q, 0]
            y = first[p, 1] - second[q, 1]
            z = first[p, 2] - second[q, 2]
            s = x * x + y * y + z * z
            total += 1.0 / math.sqrt(math.sqrt(s * s + bound))
    return total / 16.0
