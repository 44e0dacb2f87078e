"""Compiled integrals over flat panels that all but touch, for ``near_reference.py``.

As in ``bem_integrals.py``, whose potentials of a panel in closed form these use; but the outer rule
is a composite one where two panels lie nearer to each other than they are long, so that a gap may
be a small part of a panel. The floor at z = 0 is met by images.
"""

# ruff: noqa: PLR0913  (kernels take panels as arrays)

from __future__ import annotations

import math

import numpy as np
from bem_integrals import NODES, WEIGHTS, _charged, _order, _point
from numba import njit, prange

PIECE, MOST = 1.5, 10
"""Length of a piece of the outer panel over its distance from the other, and most pieces a side."""


@njit(cache=True)
def _distance(v, cv, rv, nw, cw, rw, sign):
    """A lower bound of the distance of two panels; 0 where they touch, cross or share a plane."""
    dx, dy, dz = cv[0] - cw[0], cv[1] - cw[1], cv[2] - sign * cw[2]
    nz = sign * nw[2]
    center = dx * nw[0] + dy * nw[1] + dz * nz
    low = high = center
    for k in range(4):
        h = (
            (v[k, 0] - cw[0]) * nw[0]
            + (v[k, 1] - cw[1]) * nw[1]
            + (v[k, 2] - sign * cw[2]) * nz
        )  # fmt: skip
        low, high = min(low, h), max(high, h)
    height = max(low, -high, 0.0)
    across = math.sqrt(max(0.0, dx * dx + dy * dy + dz * dz - center * center))
    return math.sqrt(height**2 + max(0.0, across - rv - rw) ** 2)


@njit(cache=True)
def _length(v, a, b, c, d):
    """The longer one of two sides, of corners a to b and c to d."""
    one = two = 0.0
    for k in range(3):
        one += (v[b, k] - v[a, k]) ** 2
        two += (v[d, k] - v[c, k]) ** 2
    return math.sqrt(max(one, two))


@njit(cache=True)
def _pair(v, nv, cv, av, rv, w, nw, cw, aw, rw, mirror, want, nodes, weights, point, field):
    """∬ 1/r over two panels, or (``want``) the flux through the first of the second's field.

    With ``mirror``, the second panel is mirrored in z = 0.
    """
    sign = -1.0 if mirror else 1.0
    dx, dy, dz = cv[0] - cw[0], cv[1] - cw[1], cv[2] - sign * cw[2]
    gap = math.sqrt(dx * dx + dy * dy + dz * dz)
    order = _order(gap, min(rv, rw), max(rv, rw))
    if order == 1:
        if want:
            return av * aw * (dx * nv[0] + dy * nv[1] + dz * nv[2]) / gap**3
        return av * aw / gap
    swap = rw < rv and not want
    along = across = 1
    if order >= 4:
        if swap:
            away = _distance(w, cw, rw, nv, cv, rv, sign)
            one, two = _length(w, 0, 1, 3, 2), _length(w, 0, 3, 1, 2)
        else:
            away = _distance(v, cv, rv, nw, cw, rw, sign)
            one, two = _length(v, 0, 1, 3, 2), _length(v, 0, 3, 1, 2)
        if away > 1e-9:
            along = int(min(MOST, max(1.0, math.ceil(one / (PIECE * away)))))
            across = int(min(MOST, max(1.0, math.ceil(two / (PIECE * away)))))
    total = 0.0
    for p in range(along):
        for q in range(across):
            for i in range(order):
                for j in range(order):
                    a = (p + nodes[order, i]) / along
                    b = (q + nodes[order, j]) / across
                    if swap:
                        jac = _point(w, a, b, point)
                        value = _charged(v, nv, point[0], point[1], sign * point[2], field)
                    else:
                        jac = _point(v, a, b, point)
                        value = _charged(w, nw, point[0], point[1], sign * point[2], field)
                        if want:
                            value = field[0] * nv[0] + field[1] * nv[1] + sign * field[2] * nv[2]
                    total += weights[order, i] * weights[order, j] * jac * value
    return total / (along * across)


@njit(cache=True, parallel=True)
def _rows(v, nv, cv, av, rv, w, nw, cw, aw, rw, want, same, nodes, weights):
    out = np.zeros((len(av), len(aw)))
    for i in prange(len(av)):
        point, field = np.empty(3), np.empty(3)
        for j in range(i + 1 if same and not want else len(aw)):
            value = 0.0
            for mirror in (False, True):
                if want and same and i == j and not mirror:
                    continue  # a flat panel sends no flux through itself
                one = _pair(
                    v[i], nv[i], cv[i], av[i], rv[i], w[j], nw[j], cw[j], aw[j], rw[j],
                    mirror, want, nodes, weights, point, field,
                )  # fmt: skip
                value += -one if mirror else one
            out[i, j] = value
    return out


def potentials(mine, other):
    """Potentials of the panels ``other``, and of their images, integrated over ``mine``, (n, m)."""
    same = mine is other
    out = _rows(*mine.args, *other.args, False, same, NODES, WEIGHTS)
    return np.tril(out) + np.tril(out, -1).T if same else out


def fluxes(mine, other):
    """Fluxes of the panels ``other``, and of their images, through ``mine``; none of its own."""
    return _rows(*mine.args, *other.args, True, mine is other, NODES, WEIGHTS)
