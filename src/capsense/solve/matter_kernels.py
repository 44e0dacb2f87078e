"""Links that dielectrics alone meet: what permittivity they have where these fill a column in part.

Along the normal of a dielectric's surface the field is that of capacitances in series, across it
that of capacitances side by side. Which of both a link sees is told by the lines along all three
axes that pass its ends: a surface crosses those along its normal, and the others lie wholly on one
of its sides.
"""

from __future__ import annotations

import numpy as np

from capsense._jit import kernel
from capsense.solve.finding_kernels import add_energy, room, storey_of

MATTER = np.dtype(
    [
        ("fill", np.float32, (2,)),
        ("gain", np.float32, (2,)),
        ("thin", np.float32, (2,)),
        ("series", np.float32),
        ("mark", np.int32),
    ]
)
"""Of a link in matter: the fraction filled, the mean of κ − 1 along it, and what of the fraction
is of thin sheets, each shared out between the link's ends as a load on a beam is, κ being the
permittivity over the empty domain's; its resistance over that of the empty link, and a mark."""
PURE, MIXED, SHARED = 1, 2, 3
"""Marks: met by dielectrics alone; done; met by conductors too, or in part of its column."""


@kernel
def thinness(thick, length):
    """Weight of a stretch of matter as a sheet: 1 up to half a link, 0 from one and a half on."""
    return min(max(1.5 - thick / length, 0.0), 1.0)


@kernel
def add_matter(record, fill, middle, kappa, thin):
    """Add a stretch that fills part of a link, at ``middle`` of its length."""
    for end in range(2):
        part = fill * (1.0 - middle if end == 0 else middle)
        record.fill[end] += part
        record.gain[end] += part * (kappa - 1.0)
        record.thin[end] += part * thin


@kernel
def note_matter(matter, touched, counts, axis, a, own, series):
    """Keep what dielectrics do to a link, to be turned into a weight by :func:`mix_matter`."""
    record = matter[axis, a]
    for end in range(2):
        record.fill[end], record.gain[end] = own.fill[end], own.gain[end]
        record.thin[end] = own.thin[end]
    record.series, record.mark = series, PURE
    touched[counts[4]] = 3 * a + axis
    counts[4] += 1


@kernel
def note_shared(matter, touched, counts, axis, a):
    """Keep that a link is not of dielectrics alone."""
    record = matter[axis, a]
    if record.mark == 0:
        touched[counts[4]] = 3 * a + axis
        counts[4] += 1
    clear_record(record)
    record.mark = SHARED


@kernel
def clear_record(record):
    """Forget what was noted of a link."""
    for end in range(2):
        record.fill[end], record.gain[end], record.thin[end] = 0.0, 0.0, 0.0
    record.series, record.mark = 1.0, 0


@kernel
def mix_matter(storeys, axes, nodes, links, inside, matter, touched, weight, ties, energies,
               couples, counts):  # fmt: skip
    """Change the links that dielectrics alone meet, and those beside them.

    Clears ``matter`` and ``counts[4]``. Returns False if the findings do not fit.
    """
    fits = True
    noted, s = counts[4], 0
    for i in range(noted):
        axis, a = touched[i] % 3, touched[i] // 3
        if matter[axis, a].mark == SHARED:
            continue
        s = storey_of(storeys, a, s)
        storey = storeys[s]
        strides = (storey.shape[1] * storey.shape[2], storey.shape[2], 1)
        fits = fits and _mix(storey, strides, axis, a, axes, nodes, links, inside, matter, touched,
                             weight, ties, energies, couples, counts)  # fmt: skip
        for end in range(2):
            node = a if end == 0 else a + strides[axis]
            for other in range(3):
                if other == axis:
                    continue
                for side in range(2):
                    lower = node if side == 0 else node - strides[other]
                    if matter[other, lower].mark == 0:
                        fits = fits and _mix(storey, strides, other, lower, axes, nodes, links,
                                             inside, matter, touched, weight, ties, energies,
                                             couples, counts)  # fmt: skip
    clear_matter(matter, touched, counts)
    return fits


@kernel
def clear_matter(matter, touched, counts):
    """Forget what was noted of all links."""
    for i in range(counts[4]):
        clear_record(matter[touched[i] % 3, touched[i] // 3])
    counts[4] = 0


@kernel
def _mix(storey, strides, axis, a, axes, nodes, links, inside, matter, touched, weight, ties,
         energies, couples, counts):  # fmt: skip
    """Change one link; False if the findings do not fit."""
    record, link, b = matter[axis, a], links[axis, a], a + strides[axis]
    if record.mark == 0:
        touched[counts[4]] = 3 * a + axis
        counts[4] += 1
    elif record.mark != PURE:
        return True
    record.mark = MIXED
    if (
        link.cut >= 0 or link.weight == 0.0 or inside[a] >= 0 or inside[b] >= 0
        or (nodes[a].owner != -1 and nodes[a].owner == nodes[b].owner)
    ):  # fmt: skip
        return True
    # weights of the axes: how far a surface across each of them divides the place
    fill, series = record.fill[0] + record.fill[1], 1.0 / record.series
    total = fill * (1.0 - fill)
    thin, mixed = (record.thin[0] + record.thin[1]) * (1.0 - fill), total * series
    for across in range(3):
        if across != axis:
            fill_a, gain_a, thin_a = _at_node(storey, strides, across, a, axes, links, matter)
            fill_b, gain_b, thin_b = _at_node(storey, strides, across, b, axes, links, matter)
            if fill_a >= 0.0 and fill_b >= 0.0:
                part = 0.5 * (fill_a * (1.0 - fill_a) + fill_b * (1.0 - fill_b))
                total += part
                thin += 0.5 * (thin_a * (1.0 - fill_a) + thin_b * (1.0 - fill_b))
                mixed += part * (1.0 + 0.5 * (gain_a + gain_b))
    eps = series
    if total > 1e-6:
        eps += thin / total * (mixed / total - series)
    if abs(eps - 1.0) <= 1e-9:
        return True
    if not room(ties, energies, couples, counts):
        return False
    change = link.weight * (eps - 1.0)
    weight[axis, a] += change
    add_energy(energies, counts, a, b, -3, change, True)
    return True


@kernel
def _at_node(storey, strides, axis, node, axes, links, matter):
    """Fraction filled, mean of κ − 1, and fraction in thin sheets, along a line around a node.

    A negative fraction where the links along the line are not of dielectrics alone.
    """
    k = (node - storey.first) // strides[axis] % storey.shape[axis]
    here = storey.begin[axis] + k
    fill, gain, thin, length = 0.0, 0.0, 0.0, 0.0
    for side in range(2):
        lower = node if side == 0 else node - strides[axis]
        if (side == 0 and k == storey.shape[axis] - 1) or (side == 1 and k == 0):
            continue
        record = matter[axis, lower]
        if record.mark == SHARED or links[axis, lower].cut >= 0:
            return -1.0, 0.0, 0.0
        part = axes[here + 1] - axes[here] if side == 0 else axes[here] - axes[here - 1]
        fill += part * record.fill[side]
        gain += part * record.gain[side]
        thin += part * record.thin[side]
        length += 0.5 * part
    return fill / length, gain / length, thin / length
