"""How the matrix changes as bodies move, by the closed adjoint; 4π eps0 = 1.

With the charges q_i that a scene answers terminal i with, ΔC_ij changes with the pose as
q_i·V_j + q_j·V_i do while the charges move in the fields ∇V as they are. V_j is the potential of
terminal j less that of all charges q_j but those of the body itself: its own charges keep their
distances, so that only their images in the floor, and what the design answers them with, push back.

What the design does comes from its point sources, and leaves feel each other's images as one more
table of sources. Only sums over a body enter, so forces are summed source by source first:

  dΔC_ij = Σ_s (Σ_p q_i(p) ∇b_s(p)) c_sj,  plus the same with i and j exchanged

and the force of a source on a body passes through that source, which gives the torque. Leaves that
fade out before a wall see the design by a share 1 - x, and have an energy of their own for it; both
change with where they are.
"""

from __future__ import annotations

import numpy as np

from capsense._dense import multiply, multiply_simd
from capsense._jit import compiled, kernel
from capsense.field.face_kernels import barrier_slope, off_walls, smooth
from capsense.field.green_kernels import distances, level_share
from capsense.solver.placement.placement_kernels import (
    leaf_rows,
    near_pairs,
    pair_line,
    source_lines,
)
from capsense.solver.tree.mean_kernels import cluster_moments

_BLOCK = 32
"""Leaves taken at a time, whose tables stay in the cache."""


@compiled
def jacobian(solution, bodies, green):
    """How the Maxwell matrix changes with the pose of each body.

    Args:
        solution: What :func:`capsense.solver.system.step.solve` returned.
        bodies: The bodies it was given.
        green: The Green's function it was given.

    Returns:
        Shape (b, m, m, 6): moving along the sensor frame's x, y, z [1], turning about axes
        parallel to these through the body's position [m/rad].
    """
    charge, points = solution.charge, solution.points
    phi_columns, m, count = charge.shape[1], green.terminals, bodies.shape[0]
    bounds = np.zeros(count + 1, np.int64)
    for j in range(points.shape[0]):
        bounds[solution.owner[j] + 1] = j + 1
    for b in range(count):
        bounds[b + 1] = max(bounds[b], bounds[b + 1])
    work = np.zeros((count, 6, phi_columns, phi_columns), np.float32)
    fade, held, slope = _faded(solution, bodies, green.space)
    right = _add_design(points, charge, fade, bounds, green, work)
    _add_fading(solution, fade, held, slope, right, green, work)
    _add_pairs(solution, bounds, green.floor, work)
    out = np.empty((count, m, m, 6))
    for b in range(count):
        x, y, z = bodies[b].position[0], bodies[b].position[1], bodies[b].position[2]
        for i in range(m):
            for j in range(m):
                for r in range(6):
                    out[b, i, j, r] = float(work[b, r, i, j]) + float(work[b, r, j, i])
                f = out[b, i, j]
                # so far the torques are about the origin of the sensor frame
                f[3] -= y * f[2] - z * f[1]
                f[4] -= z * f[0] - x * f[2]
                f[5] -= x * f[1] - y * f[0]
    return out


@compiled
def _faded(solution, bodies, space):
    """How far leaves are faded out before walls, (l,), as ``off_walls``; its slope, (l, 3).

    Those that are beyond them carry no charge.
    """
    points = solution.points
    n = points.shape[0]
    fade, held, slope = np.zeros(n), np.zeros(n), np.zeros((n, 3))
    for j in range(n):
        c = 0.5 * (points[j, 0] + points[j, 3])
        free = bodies[solution.owner[j]].free
        inner, length = space.inner[free], space.fade[free]
        off, edge = off_walls(c[0], c[1], c[2], free, space)
        fade[j], held[j] = smooth(off), smooth(edge)
        if 0.0 < off < 1.0:
            for i in range(3):
                low = max(inner[0, i] - c[i], 0.0) / length[0, i] ** 2
                high = max(c[i] - inner[1, i], 0.0) / length[1, i] ** 2
                slope[j, i] = 6.0 * (1.0 - off) * (high - low)
    return fade, held, slope


@compiled
def _add_fading(solution, fade, held, slope, right, green, work):
    """Add forces and torques by what leaves fade out in."""
    n, phi_columns = fade.shape[0], right.shape[1]
    some = np.empty(n, np.int64)
    count = 0
    for j in range(n):
        if 0.0 < fade[j] < 1.0:
            some[count] = j
            count += 1
    if count == 0:
        return
    points = np.empty((count, 4, 3))
    for k in range(count):
        for q in range(4):
            for i in range(3):
                points[k, q, i] = solution.points[some[k], q, i]
    rows = leaf_rows(points, np.zeros(count), green)
    for k in range(count):
        j = some[k]
        b, x, charge = solution.owner[j], fade[j], solution.charge[j]
        energy = 0.5 * barrier_slope(x, held[j], solution.extent[j])
        c = 0.5 * (points[k, 0] + points[k, 3])
        s = slope[j]
        six = (
            s[0], s[1], s[2],
            c[1] * s[2] - c[2] * s[1], c[2] * s[0] - c[0] * s[2], c[0] * s[1] - c[1] * s[0],
        )  # fmt: skip
        for o in range(phi_columns):
            seen = 0.0
            for w in range(rows.shape[1]):
                seen += rows[k, w] * right[w, o]
            for i in range(phi_columns):
                value = np.float32(charge[i] * (seen + energy * charge[o]))
                for r in range(6):
                    work[b, r, i, o] -= np.float32(six[r]) * value


@compiled
def _add_design(points, charge, fade, bounds, green, work):
    """Add forces and torques by the design's sources, (b, 6, lead, lead).

    Returns:
        What the columns of leaves' rows give for the potential of each terminal, (w, lead).
    """
    n, phi_columns, floor = points.shape[0], charge.shape[1], green.floor
    distance, share = distances(points, green), np.empty(n)
    modes = np.zeros((phi_columns, green.levels[0].table.shape[1]), np.float32)
    sums = [np.empty((0, 0, 0, 0), np.float32) for _ in green.levels]
    for k in range(len(green.levels)):
        level = green.levels[k]
        for j in range(n):
            share[j] = level_share(distance[j], k, green.blends) * (1.0 - fade[j])
        sums[k] = _source_sums(points, charge, share, bounds, level, floor)
        _add_modes(sums[k], level.table, modes)
    right = np.zeros((modes.shape[1], phi_columns), np.float32)
    for i in range(phi_columns):
        right[i, i] = 1.0
        for k in range(phi_columns, modes.shape[1]):
            right[k, i] = modes[i, k]
    for k in range(len(green.levels)):
        _add_work(sums[k], green.levels[k].sources, green.levels[k].table, right, work)
    return right


@compiled
def _source_sums(points, charge, share, bounds, level, floor):
    """Sums over each body's charges, weighted with ``share``, of what a source does to them.

    Returns:
        Shape (b, 6, lead, s), the six numbers of
        :func:`capsense.solver.placement.placement_kernels.source_lines`; b = 0 where no weight is
        above zero.
    """
    sources, floor, least = level.sources, np.float32(floor), np.float32(level.least)
    count, phi_columns, width = bounds.shape[0] - 1, charge.shape[1], sources.shape[1]
    some_count = 0
    for j in range(points.shape[0]):
        some_count += share[j] > 0.0
    if some_count == 0:
        return np.zeros((0, 6, phi_columns, width), np.float32)
    out = np.zeros((count, 6, phi_columns, width), np.float32)
    some = np.empty((_BLOCK, 4, 3), np.float32)
    lines = np.empty((6, _BLOCK, width), np.float32)
    sums = np.empty((phi_columns, width), np.float32)
    for b in range(count):
        j = bounds[b]
        while j < bounds[b + 1]:
            chosen = 0
            left = np.zeros((phi_columns, _BLOCK), np.float32)
            while j < bounds[b + 1] and chosen < _BLOCK:
                if share[j] > 0.0:
                    for i in range(phi_columns):
                        left[i, chosen] = 0.25 * share[j] * charge[j, i]
                    for q in range(4):
                        for i in range(3):
                            some[chosen, q, i] = points[j, q, i]
                    chosen += 1
                j += 1
            left = _narrowed(left, chosen)
            source_lines(some[:chosen], sources, floor, least, lines)
            for r in range(6):
                multiply(left, lines[r, :chosen], sums)
                _add(sums, out[b, r])
    return out


@compiled
def _narrowed(table, columns):
    out = np.empty((table.shape[0], columns), np.float32)
    for i in range(table.shape[0]):
        for k in range(columns):
            out[i, k] = table[i, k]
    return out


@kernel
def _add(addend, out):
    for i in range(out.shape[0]):
        for k in range(out.shape[1]):
            out[i, k] += addend[i, k]


@compiled
def _add_modes(sums, table, modes):
    """Add the sums of ψ over all charges to ``modes`` (lead, w); those of φ⁰ mean nothing."""
    if sums.shape[0] == 0:
        return
    phi_columns, s = sums.shape[2], table.shape[0]
    whole = np.zeros((phi_columns, s), np.float32)
    for b in range(sums.shape[0]):
        for i in range(phi_columns):
            for k in range(s):
                whole[i, k] += sums[b, 0, i, k]
    part = np.empty((phi_columns, table.shape[1]), np.float32)
    multiply(whole, table, part)
    _add(part, modes[:, : table.shape[1]])


@compiled
def _add_work(sums, sources, table, right, work):
    """Add forces and torques by sources of coefficients ``table @ right``, shape (s, lead)."""
    count, phi_columns, width = sums.shape[0], sums.shape[2], sums.shape[3]
    if count == 0:
        return
    coefficients = np.empty((width, phi_columns), np.float32)
    multiply_simd(table, right[: table.shape[1]], coefficients)
    for b in range(count):
        own = sums[b]
        for i in range(phi_columns):
            for k in range(width):
                x, y = sources[0, k], sources[1, k]
                fx, fy, fz = own[1, i, k], own[2, i, k], own[3, i, k]
                gx, gy = own[4, i, k], own[5, i, k]
                own[0, i, k], own[1, i, k], own[2, i, k] = fx, fy, fz
                own[3, i, k], own[4, i, k] = y * fz - gy, gx - x * fz
                own[5, i, k] = x * fy - y * fx
        _add_contracted(own, coefficients, work[b])


@compiled
def _add_contracted(sums, coefficients, work):
    """``work += sums @ coefficients``, shapes (6, lead, lead), (6, lead, s) and (s, lead)."""
    phi_columns, width = sums.shape[1], sums.shape[2]
    part = np.empty((6 * phi_columns, phi_columns), np.float32)
    multiply_simd(sums.reshape((6 * phi_columns, width)), coefficients, part)
    _add(part, work.reshape((6 * phi_columns, phi_columns)))


@compiled
def _add_pairs(solution, bounds, floor, work):
    """Add forces and torques by other bodies' charges and by all images in the floor."""
    charge, points = solution.charge, solution.points
    extent, soft = solution.extent, solution.softening_length
    n, phi_columns = charge.shape
    image = np.empty((n, 4, 3))
    for j in range(n):
        for q in range(4):
            image[j, q, 0], image[j, q, 1] = points[j, q, 0], points[j, q, 1]
            image[j, q, 2] = 2.0 * floor - points[j, q, 2]
    shapes, mirrored = cluster_moments(points, extent), cluster_moments(image, extent)
    width = shapes.shape[1]
    coefficients = np.zeros((width, phi_columns), np.float32)
    for j in range(n):
        for i in range(phi_columns):
            coefficients[j, i] = charge[j, i]
    weight, near = np.empty(width, np.float32), np.empty((14, width), np.float32)
    sums = np.empty((6, phi_columns, width), np.float32)
    for b in range(work.shape[0]):
        start, stop = bounds[b], bounds[b + 1]
        lines = np.zeros((6, stop - start, width), np.float32)
        left = np.empty((phi_columns, stop - start), np.float32)
        for i in range(start, stop):
            for k in range(phi_columns):
                left[k, i - start] = charge[i, k]
            _weigh(shapes, i, mirrored, n, 1.0, weight)
            pair_line(shapes, i, mirrored, weight, lines, i - start)
            near_pairs(points, image, soft, i, (0, 0), weight, near, lines[:, i - start])
            if stop - start < n:
                _weigh(shapes, i, shapes, n, -1.0, weight)
                for j in range(start, stop):
                    weight[j] = 0.0
                pair_line(shapes, i, shapes, weight, lines, i - start)
                own = (start, stop)
                near_pairs(points, points, soft, i, own, weight, near, lines[:, i - start])
        for r in range(6):
            multiply(left, lines[r], sums[r])
        _add_contracted(sums, coefficients, work[b])


@kernel
def _weigh(shapes, i, others, n, sign, weight):
    """Give the clusters that cluster i meets by moments the weight ``sign``, others zero."""
    sign, none = np.float32(sign), np.float32(0.0)
    x, y, z, reach = shapes[0, i], shapes[1, i], shapes[2, i], shapes[9, i]
    for j in range(n):
        dx, dy, dz = x - others[0, j], y - others[1, j], z - others[2, j]
        far = reach + others[9, j]
        weight[j] = sign if dx * dx + dy * dy + dz * dz > far * far else none
    for j in range(n, weight.shape[0]):
        weight[j] = none
