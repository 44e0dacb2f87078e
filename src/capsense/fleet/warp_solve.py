"""The step of many environments as Warp kernels: the matrix, its solution, what electrodes see.

The twin of these kernels is :mod:`capsense.solver.system.system_kernels` with the same cut.

What has losses is complex: a factor has its real part in the lower half of ``matrix`` and its
imaginary part in the upper one, but for the diagonal's, which is in ``loss``. Functions that are
dropped have zeros on the diagonal. Lengths in metres, 4π eps0 = 1.
"""

from __future__ import annotations

import warp as wp

from capsense.fleet.warp_cut import Places, Shapes, WarpActiveTree

wp.set_module_options({"enable_backward": False, "fast_math": True})

_DROPPED = wp.constant(1e-5)
"""Functions whose pivot is so small against their own energy are left out."""


@wp.kernel
def to_functions(cut: WarpActiveTree, limited: int, values: wp.array3d(dtype=wp.float32)):
    """Integrate what clusters have in the first index with the charge functions, in place.

    ``limited`` says that the second index is of columns, of which a view has its width.
    """
    c, v = wp.tid()
    if limited != 0 and c >= cut.width[v]:
        return
    for b in range(cut.leader.shape[0]):
        o = b * cut.clusters
        for k in range(cut.clusters - 1):
            j = cut.clusters - 1 - k
            if cut.number[o + j, v] >= 0:
                i = o + cut.split[o + j, v]
                x = values[i, c, v]
                y = values[o + j, c, v]
                p = cut.mix[o + j, v]
                values[i, c, v] = p * x + (1.0 - p) * y
                values[o + j, c, v] = x - y
        leader = cut.leader[b, v]
        if leader != b:
            values[o, c, v] -= values[leader * cut.clusters, c, v]


@wp.func
def own(shapes: Shapes, places: Places, e: int, b: int, x: int, y: int):
    """Energy of two functions of a body, complex."""
    u = places.choice[e, b]
    place = wp.int64(x) * wp.int64(shapes.functions[u]) + wp.int64(y)
    out = wp.vec2(shapes.potential_coefficients[shapes.block[u] + place], 0.0)
    inside = places.inverse_susceptibility[e, b]
    if inside[0] != 0.0 or inside[1] != 0.0:
        out += inside * shapes.neumann_to_dirichlet[shapes.inside[u] + place]
    return out / places.scale[e, b]


@wp.kernel
def energies(
    shapes: Shapes, places: Places, cut: WarpActiveTree, out: wp.array3d(dtype=wp.float32)
):
    """Energies of the shapes' functions, (n, n, v), where views have others, see ``weigh``."""
    i, j, v = wp.tid()
    if cut.walled[v] == 0:
        return
    b = i // cut.clusters
    value = float(0.0)
    if b == j // cut.clusters and cut.node[b * cut.clusters, v] >= 0:
        x = wp.where(i % cut.clusters == 0, 0, cut.number[i, v])
        y = wp.where(j % cut.clusters == 0, 0, cut.number[j, v])
        if x >= 0 and y >= 0:
            value = own(shapes, places, v // places.hidden.shape[0], b, x, y)[0]
    out[i, j, v] = value


@wp.kernel
def from_functions(
    cut: WarpActiveTree, walled: int, values: wp.array3d(dtype=wp.float32)
):  # fmt: skip
    """What clusters have of what the shapes' functions have in the first index, in place.

    ``walled`` asks for it only in views whose functions are others, see ``weigh``.
    """
    c, v = wp.tid()
    if cut.walled[v] < walled:
        return
    for b in range(cut.leader.shape[0]):
        o = b * cut.clusters
        for k in range(1, cut.clusters):
            if cut.number[o + k, v] >= 0:
                i = o + cut.split[o + k, v]
                whole = values[i, c, v]
                apart = values[o + k, c, v]
                p = cut.part[o + k, v]
                values[i, c, v] = whole + (1.0 - p) * apart
                values[o + k, c, v] = whole - p * apart


@wp.kernel
def assemble(
    shapes: Shapes, places: Places, cut: WarpActiveTree, start: int,
    potentials: wp.array3d(dtype=wp.float32), matrix: wp.array3d(dtype=wp.float32),
    loss: wp.array2d(dtype=wp.float32),
):  # fmt: skip
    """The matrix of all functions from their pairs, in place: its real part in the lower half.

    The imaginary part is in the upper half, and that of the diagonal in ``loss``.
    """
    f, g, v = wp.tid()
    if g > f:
        return
    e = v // places.hidden.shape[0]
    x = cut.number[f, v]
    y = cut.number[g, v]
    value = wp.vec2(wp.where(f == g, 1.0, 0.0), 0.0)
    if x >= 0 and y >= 0:
        value = wp.vec2(matrix[f, g, v], 0.0)
        for k in range(start, cut.width[v]):
            value[0] -= potentials[f, k, v] * potentials[g, k, v]
        b = f // cut.clusters
        c = g // cut.clusters
        apart = cut.walled[v] == 0  # else the pairs have the shapes' energies
        first = cut.leader[b, v]
        other = cut.leader[c, v]
        joined = f == b * cut.clusters and first != b
        another = g == c * cut.clusters and other != c
        if b == c:
            if apart:
                value += own(shapes, places, e, b, x, y)
            if x == 0 and y == 0 and not joined:
                value += cut.ground_elastance[b, v]
        if apart and joined and first == c:
            value -= own(shapes, places, e, c, 0, y)
        if apart and another and other == b:
            value -= own(shapes, places, e, b, x, 0)
        if apart and joined and another and first == other:
            value += own(shapes, places, e, first, 0, 0)
    matrix[f, g, v] = value[0]
    if f == g:
        loss[f, v] = value[1]
    else:
        matrix[g, f, v] = value[1]


@wp.func
def times(x: wp.vec2, y: wp.vec2):
    """Product of complex numbers."""
    return wp.vec2(x[0] * y[0] - x[1] * y[1], x[0] * y[1] + x[1] * y[0])


@wp.func
def over(x: wp.vec2, y: wp.vec2):
    """Quotient of complex numbers."""
    return times(x, wp.vec2(y[0], -y[1])) / wp.dot(y, y)


@wp.func
def _root(x: wp.vec2):
    """Square root of a complex number with a positive real part."""
    real = wp.sqrt(0.5 * (wp.length(x) + x[0]))
    return wp.vec2(real, 0.5 * x[1] / real)


@wp.kernel
def factorise(
    cut: WarpActiveTree, matrix: wp.array3d(dtype=wp.float32), dropped: wp.array(dtype=wp.int32)
):
    """Cholesky factor L of every real matrix."""
    v = wp.tid()
    lost = int(0)
    if cut.lossy[v] == 0:
        for i in range(matrix.shape[0]):
            if cut.number[i, v] >= 0:
                total = matrix[i, i, v]
                own = total
                for j in range(i):
                    value = matrix[i, j, v]
                    for k in range(j):
                        value -= matrix[i, k, v] * matrix[j, k, v]
                    pivot = matrix[j, j, v]
                    value = wp.where(pivot > 0.0, value / pivot, 0.0)
                    matrix[i, j, v] = value
                    total -= value * value
                lost += wp.where(total > _DROPPED * wp.abs(own), 0, 1)
                matrix[i, i, v] = wp.where(total > _DROPPED * wp.abs(own), wp.sqrt(total), 0.0)
    dropped[v] = lost


@wp.kernel
def factorise_lossy(
    cut: WarpActiveTree, matrix: wp.array3d(dtype=wp.float32), loss: wp.array2d(dtype=wp.float32),
    dropped: wp.array(dtype=wp.int32),
):  # fmt: skip
    """Factor L of every complex symmetric matrix L Lᵀ, without pivots: see ``_dense.eliminate``."""
    v = wp.tid()
    if cut.lossy[v] == 0:
        return
    lost = int(0)
    for i in range(matrix.shape[0]):
        if cut.number[i, v] >= 0:
            total = wp.vec2(matrix[i, i, v], loss[i, v])
            own = wp.length(total)
            for j in range(i):
                value = wp.vec2(matrix[i, j, v], matrix[j, i, v])
                for k in range(j):
                    value -= times(
                        wp.vec2(matrix[i, k, v], matrix[k, i, v]),
                        wp.vec2(matrix[j, k, v], matrix[k, j, v]),
                    )
                pivot = wp.vec2(matrix[j, j, v], loss[j, v])
                if pivot[0] > 0.0:  # noqa: SIM108 - Warp has no conditional of vectors
                    value = over(value, pivot)
                else:
                    value = wp.vec2()
                matrix[i, j, v] = value[0]
                matrix[j, i, v] = value[1]
                total -= times(value, value)
            if total[0] > _DROPPED * own:
                total = _root(total)
            else:
                lost += 1
                total = wp.vec2()
            matrix[i, i, v] = total[0]
            loss[i, v] = total[1]
    dropped[v] = lost


@wp.kernel
def forward(
    cut: WarpActiveTree, terminals: int, given: wp.array3d(dtype=wp.float32),
    matrix: wp.array3d(dtype=wp.float32), loss: wp.array2d(dtype=wp.float32),
    potentials: wp.array3d(dtype=wp.float32), quadrature: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """L⁻¹ φ⁰ of the functions, whose imaginary part is in ``quadrature``, from ``given`` φ⁰.

    Columns behind so many ``terminals`` are of nodes at 1 V, where net charges have -1 V.
    """
    t, v = wp.tid()
    if t >= cut.columns[v]:
        return
    lossy = cut.lossy[v] != 0
    for i in range(matrix.shape[0]):
        right = wp.vec2()
        if cut.number[i, v] >= 0:
            if t < terminals:
                right[0] = given[i, t, v]
            elif i % cut.clusters == 0 and cut.slot[i // cut.clusters, v] == t - terminals:
                right[0] = -1.0
            if lossy:
                for k in range(i):
                    right -= times(
                        wp.vec2(matrix[i, k, v], matrix[k, i, v]),
                        wp.vec2(potentials[k, t, v], quadrature[k, t, v]),
                    )
                pivot = wp.vec2(matrix[i, i, v], loss[i, v])
                if pivot[0] > 0.0:  # noqa: SIM108
                    right = over(right, pivot)
                else:
                    right = wp.vec2()
            else:
                for k in range(i):
                    right[0] -= matrix[i, k, v] * potentials[k, t, v]
                if matrix[i, i, v] > 0.0:
                    right[0] = right[0] / matrix[i, i, v]
                else:
                    right[0] = 0.0
        potentials[i, t, v] = right[0]
        quadrature[i, t, v] = right[1]


@wp.kernel
def charges(
    cut: WarpActiveTree, phi_columns: int, matrix: wp.array3d(dtype=wp.float32),
    loss: wp.array2d(dtype=wp.float32), potentials: wp.array3d(dtype=wp.float32),
    quadrature: wp.array3d(dtype=wp.float32), out: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Charges L⁻ᵀ L⁻¹ φ⁰ of the functions from L⁻¹ φ⁰, (n, 2 lead, v)."""
    t, v = wp.tid()
    if t >= cut.columns[v]:
        return
    n = matrix.shape[0]
    lossy = cut.lossy[v] != 0
    for step in range(n):
        i = n - 1 - step
        total = wp.vec2(potentials[i, t, v], quadrature[i, t, v])
        pivot = wp.vec2(matrix[i, i, v], 0.0)
        if pivot[0] <= 0.0 or cut.number[i, v] < 0:
            total = wp.vec2()
        elif lossy:
            for k in range(i + 1, n):
                below = wp.vec2(matrix[k, i, v], matrix[i, k, v])
                total -= times(below, wp.vec2(out[k, t, v], out[k, phi_columns + t, v]))
            pivot[1] = loss[i, v]
            total = over(total, pivot)
        else:
            for k in range(i + 1, n):
                total[0] -= matrix[k, i, v] * out[k, t, v]
            total[0] = total[0] / pivot[0]
        out[i, t, v] = total[0]
        out[i, phi_columns + t, v] = total[1]


@wp.struct
class Left:
    """Charges, and what functions that are not solved for leave; see :mod:`warp_left`."""

    charge: wp.array3d(dtype=wp.float32)  # of functions, (n, 2 lead, v)
    on: wp.array3d(dtype=wp.float32)  # on clusters, (n, 2 lead, v)
    sums: wp.array3d(dtype=wp.float32)  # of ψ over all charges, (modes, 2 lead, v)
    strength: wp.array3d(dtype=wp.float32)  # of the design's sources, (s, 2 lead, v)
    residual: wp.array3d(dtype=wp.float32)  # potential in the function below a cluster, as charge
    energy: wp.array2d(dtype=wp.vec2)  # of that function, (n, v)
    dropped: wp.array(dtype=wp.int32)  # functions solved for that were left out, (v,)
    doubt: wp.array2d(dtype=wp.float32)  # estimated error of each diagonal [m], (t, v)
    below: wp.array3d(dtype=wp.float32)  # of the matrix, by functions not solved for [m], (t, t, v)
    volts: wp.array3d(dtype=wp.float32)  # of nodes, with a terminal at 1 V, (slots, t, v)
