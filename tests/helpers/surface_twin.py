"""A slow twin of the surface step in NumPy, double precision: panels, matrices, dense algebra.

Takes the free-space blocks of bodies and the design's Green's function as given, and shares no code
with what comes after them. Metres, 4π eps0 = 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from capsense.field.green import GreenFunction
from capsense.field.green_kernels import Green
from capsense.field.grid_kernels import Grid
from capsense.solver.bodies.blocks import free_block, impedance
from capsense.solver.bodies.panels import SurfacePanels

Array = np.ndarray
SOFT, ROUND = 0.15, 0.82
"""Points of different bodies see 1/r bounded: extent and least moment count so much for it."""
GAIN = 1.3
"""What functions that are left out stand for, themselves and all below."""
WALL_PENALTY = 1e5
"""Energy of charge out of reach [1/m]."""
FULL = 0.1
"""How far something of a cluster within reach is represented where its functions are whole."""
COARSE_PANELS = 0.6
"""What panels are too coarse for, over the energy of the functions that end in them."""


@dataclass(frozen=True)
class Piece:
    """A body somewhere."""

    panels: SurfacePanels
    position: tuple[float, float, float]
    turned: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rotation vector [rad]."""
    scale: float = 1.0
    ground_elastance: complex = 0.0
    """Energy of its net charge beyond that of its field [1/m]; infinite if it can have none."""
    eps_r: complex = np.inf
    group: int | None = None
    """Bodies of one group are one conductor, with the tie of each."""

    @property
    def neutral(self) -> bool:
        return bool(np.isinf(self.ground_elastance))

    @cached_property
    def block(self) -> Array:
        """Mean potentials of the panels on each other, of the inside too [1/m]."""
        free = free_block(self.panels)
        out = free / self.scale
        if np.isfinite(self.eps_r):
            out = out + impedance(self.panels, free) / (self.eps_r - 1.0) / self.scale
        return out

    @property
    def free(self) -> bool:
        """Whether it is a conductor that is not at ground."""
        return not np.isfinite(self.eps_r) and (self.neutral or self.ground_elastance != 0.0)

    @property
    def rotation(self) -> Array:
        return Rotation.from_rotvec(self.turned).as_matrix()


class Clusters(NamedTuple):
    """Charge on clusters of panels, each by the centre and the second moments of its charge."""

    points: Array
    """Shape (k, 4, 3)."""
    softening_length: Array
    owner: Array


def galerkin(pieces: tuple[Piece, ...], green: GreenFunction, room: Array) -> Array:
    """ΔC with an unknown for every panel in the room, shape (terminals, terminals) [m]."""
    found = clusters(pieces, [np.eye(len(p.panels)) for p in pieces])
    out = beyond(found, pieces, room)[0]
    matrix = interaction(found, pieces, green, room)
    matrix = matrix.astype(
        np.result_type(*(p.block for p in pieces), *(p.ground_elastance for p in pieces))
    )
    group = np.array([-1 - b if p.group is None else p.group for b, p in enumerate(pieces)])
    for b, piece in enumerate(pieces):
        own, joint = found.owner == b, group[found.owner] == group[b]
        matrix[np.ix_(own, own)] += piece.block
        matrix[np.ix_(own, joint)] += 0.0 if piece.neutral else piece.ground_elastance
    phi = (1 - out)[:, None] * four_point_mean(found.points, green, "phi0")
    free = np.unique([g for g, p in zip(group, pieces, strict=True) if p.neutral])
    net = (group[found.owner][:, None] == free).astype(float)
    kept = out < 1.0
    matrix, phi, net = matrix[np.ix_(kept, kept)], phi[kept], net[kept]
    saddle = np.block([[matrix, net], [net.T, np.zeros((len(free),) * 2)]])
    x = np.linalg.solve(saddle, np.concatenate([phi, np.zeros((len(free), phi.shape[1]))]))
    return phi.T @ x[: len(phi)]


def off_walls(point: Array, room: Array, free: bool) -> tuple[float, float]:
    """How far a point is in what bodies fade out in, 0 to 1, beyond all walls and the floor."""
    off = np.maximum(np.stack([room[0] - point, point - room[1]]), 0.0) / WALL_FADE_LENGTH
    if free:
        inner = room + np.array([[35e-3, 35e-3, 0.0], [-35e-3, -35e-3, -35e-3]])
        length = np.array([[40e-3, 40e-3, 5e-3], [40e-3, 40e-3, 40e-3]])
        off = np.maximum(np.stack([inner[0] - point, point - inner[1]]), 0.0) / length
    return float(np.linalg.norm(off)), off[0, 2] if free else float(np.linalg.norm(off))


def beyond(found: Clusters, pieces: tuple[Piece, ...], room: Array) -> tuple[Array, Array]:
    """How far clusters are out of reach, 0 to 1, by their middles; and what keeps charge off
    [1/m]."""
    out, barrier = [], []
    for points, owner in zip(found.points, found.owner, strict=True):
        off, edge = off_walls(points.mean(axis=0), room, pieces[owner].free)
        x, held = _smooth(off), _smooth(edge)
        arms = np.linalg.norm(points[:1] - points[1:3], axis=1) / 2
        soft = min(x * x / max(1 - x, 1e-9), 1e4) / (math.sqrt(12) * arms.max())
        out.append(x)
        barrier.append(WALL_PENALTY * held**3 + (soft if held < x else 0.0))
    return np.array(out), np.array(barrier)


def interaction(
    found: Clusters, pieces: tuple[Piece, ...], green: GreenFunction, room: Array
) -> Array:
    """Mean potentials of clusters on each other but for those of a body on itself [1/m]."""
    out, barrier = beyond(found, pieces, room)
    psi = (1 - out)[:, None] * four_point_mean(found.points, green, "psi")
    image = found.points * [1.0, 1.0, -1.0] + [0.0, 0.0, 2.0 * green.floor]
    other = found.owner[:, None] != found.owner
    between = np.where(
        other, inverse_distances(found.points, found.points, found.softening_length), 0.0
    )
    images = inverse_distances(found.points, image, found.softening_length) + psi @ psi.T
    return between - images + np.diag(barrier)


def four_point_mean(points: Array, green: GreenFunction, name: str) -> Array:
    """Means of ``green.psi`` or ``phi0``; levels give way to each other by a cluster's centre."""
    beyond, before = (1e8, 1e9), (-2.0, -1.0)
    out = 0.0
    for share, blends in zip(
        green.shares(points.mean(axis=1)),
        ((beyond, beyond), (before, beyond), (before, before)),
        strict=True,
    ):
        alone = replace(green, blends=np.array(blends))
        values = getattr(alone, name)(points.reshape(-1, 3))
        out = out + share[:, None] * values.reshape(len(points), 4, -1).mean(axis=1)
    return out


def inverse_distances(points: Array, others: Array, soft: Array) -> Array:
    """Means over four points each of a bounded 1/r, shape (k, k)."""
    square = ((points[:, None, :, None] - others[None, :, None]) ** 2).sum(axis=-1)
    bound = np.maximum(soft[:, None], soft) ** 4
    return ((square**2 + bound[:, :, None, None]) ** -0.25).mean(axis=(2, 3))


def clusters(pieces: tuple[Piece, ...], charges: list[Array]) -> Clusters:
    """Place clusters; ``charges`` has, body by body, a column of panel charges for each."""
    points, soft, owner = [], [], []
    for b, (piece, columns) in enumerate(zip(pieces, charges, strict=True)):
        for column in columns.T:
            center, second = charge_moments(piece.panels, column)
            local, size = rectangle(center, second)
            points.append(piece.scale * local @ piece.rotation.T + piece.position)
            soft.append(piece.scale * size)
            owner.append(b)
    return Clusters(np.array(points), np.array(soft), np.array(owner))


def charge_moments(panels: SurfacePanels, charge: Array) -> tuple[Array, Array]:
    """Centre [m] and second central moments [m²] of charge on panels, shapes (3,) and (3, 3)."""
    weight = charge / charge.sum()
    center = weight @ panels.centers
    off = panels.centers - center
    return center, np.einsum("n,nij->ij", weight, panels.moments) + (off.T * weight) @ off


def rectangle(center: Array, second: Array) -> tuple[Array, float]:
    """Four points with the two largest second moments, and where 1/r from them is bounded [m]."""
    size, axes = np.linalg.eigh(second)
    arms = axes[:, 1:] * np.sqrt(np.maximum(size[1:], 0.0))
    signs = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    soft = math.sqrt(12.0 * SOFT**2 * size[2] + ROUND * max(size[0], 0.0))
    return center + signs @ arms.T, soft


# ---- charge functions ----


def members(children: Array, panel: Array) -> list[Array]:
    """Panels in each cluster, sorted."""
    out: list[Array] = [np.empty(0, int)] * len(children)
    for k in range(len(children) - 1, -1, -1):
        if children[k, 0] < 0:
            out[k] = np.array([panel[k]])
        else:
            out[k] = np.sort(np.concatenate([out[children[k, 0]], out[children[k, 1]]]))
    return out


def shares(children: Array, panel: Array, charge: Array) -> Array:
    """The equilibrium ``charge`` (n,) within each cluster, as a column of sum one, (n, 2 n - 1)."""
    out = np.zeros((len(charge), len(children)))
    for k, own in enumerate(members(children, panel)):
        out[own, k] = charge[own] / charge[own].sum()
    return out


def haar(children: Array, panel: Array, charge: Array) -> Array:
    """Columns: equilibrium charge; then, cluster by cluster, one part minus the other, (n, n)."""
    share = shares(children, panel, charge)
    split = children[:, 0] >= 0
    return np.column_stack(
        [share[:, 0], share[:, children[split, 0]] - share[:, children[split, 1]]]
    )


class Chosen(NamedTuple):
    """What is solved for, of one body."""

    active: Array
    """Clusters that are represented by themselves."""
    self_weight: Array
    """How far each of these is, 1 if it is not split; the rest is left to its parts."""
    functions: Array
    """Clusters that are split."""
    fade: Array
    """How far the functions are faded in."""
    parent_fade: Array
    """The same of the cluster above."""


def within_reach(
    tree: tuple[Array, Array, Array], share: Array, chosen: Chosen, out: Array
) -> tuple[dict[int, tuple[Array, Array]], dict[int, float]]:
    """Unit charges on what is within reach of each cluster, on the panels and on the leaves, and
    how far something of it within reach is represented.

    ``out`` is how far each leaf is out of reach. A cluster that is wholly out has none.
    """
    children, _, charge = tree
    amount = [charge[share[:, k] > 0].sum() for k in range(len(children))]
    leaves, split = chosen.active.tolist(), chosen.functions.tolist()
    inside: dict[int, float] = {}
    there: dict[int, float] = {}
    found: dict[int, tuple[Array, Array]] = {}
    for k in sorted({*leaves, *split}, reverse=True):  # parts stand behind their wholes
        terms, rest = [], 1.0
        if k in leaves:
            j = leaves.index(k)
            terms.append(
                (chosen.self_weight[j] * (1 - out[j]), share[:, k], np.eye(len(leaves))[j])
            )
            rest -= chosen.self_weight[j]
            there[k] = chosen.self_weight[j] * (out[j] < 1.0)
        if k in split:
            for part in children[k].tolist():
                if part in found:
                    weight = rest * amount[part] / amount[k] * inside[part]
                    terms.append((weight, *found[part]))
                    there[k] = max(there.get(k, 0.0), rest * there[part])
        inside[k] = sum(weight for weight, _, _ in terms)
        if inside[k] > 0.0:
            found[k] = (
                sum(weight * panels for weight, panels, _ in terms) / inside[k],
                sum(weight * on for weight, _, on in terms) / inside[k],
            )
    return found, there


def reduced(
    pieces: tuple[Piece, ...],
    trees: list[tuple[Array, Array, Array]],
    chosen: list[Chosen],
    green: GreenFunction,
    room: Array,
) -> tuple[Array, Array, Array]:
    """ΔC and the part of it that is estimated, from chosen functions (children, panel, charge), and
    what panels are too coarse for."""
    share = [shares(*tree) for tree in trees]
    found = clusters(pieces, [s[:, c.active] for s, c in zip(share, chosen, strict=True)])
    out = beyond(found, pieces, room)[0]
    columns, blocks, fade, above, ends = [], [], [], [], []
    for b, (piece, tree, all_of, cut) in enumerate(zip(pieces, trees, share, chosen, strict=True)):
        children, own = tree[0], found.owner == b
        units, there = within_reach(tree, all_of, cut, out[own])
        used = [] if piece.neutral or 0 not in units else [units[0]]
        full = [_smooth(there[0] / FULL)] * len(used)
        net = len(used)
        parted = [x in units and y in units for x, y in children[cut.functions]]
        for x, y in children[cut.functions[parted]]:
            used.append((units[x][0] - units[y][0], units[x][1] - units[y][1]))
            full.append(_smooth(min(there[x], there[y]) / FULL))
        functions = np.array([on for on, _ in used]).reshape(-1, len(piece.panels)).T
        spread = np.zeros((len(found.owner), len(used)))
        spread[own] = np.array([on for _, on in used]).reshape(-1, own.sum()).T
        columns.append(spread)
        block = functions.T @ piece.block @ functions
        block[:net, :net] += piece.ground_elastance
        blocks.append(block)
        fade.append(full * np.concatenate([[1.0] * net, cut.fade[parted]]))
        above.append(full * np.concatenate([[1.0] * net, cut.parent_fade[parted]]))
        panels = (children[children[cut.functions[parted]]][..., 0] < 0).mean(axis=1)
        members_out = [
            any(out[own][on != 0.0].max(initial=0.0) > 0.0 for on in (units[x][1], units[y][1]))
            for x, y in children[cut.functions[parted]]
        ]
        ends.append(np.concatenate([[0.0] * net, np.where(members_out, 0.0, panels)]))
    to_leaves = np.concatenate(columns, axis=1)
    matrix = to_leaves.T @ interaction(found, pieces, green, room) @ to_leaves
    at = np.cumsum([0, *(len(b) for b in blocks)])
    for b, block in enumerate(blocks):
        matrix[at[b] : at[b + 1], at[b] : at[b + 1]] += block
    phi = four_point_mean(found.points, green, "phi0")
    phi = to_leaves.T @ ((1 - out)[:, None] * phi)
    t, parent = np.concatenate(fade), np.concatenate(above)
    root = np.sqrt(t)
    faded = root[:, None] * matrix * root
    np.fill_diagonal(faded, np.diag(matrix))
    x = root[:, None] * np.linalg.solve(faded, root[:, None] * phi)
    lack = GAIN * (1 - t) * (1 - (1 - parent) ** 4) / np.diag(matrix)
    residual = phi - matrix @ x
    left = residual.T @ (lack[:, None] * residual)
    coarse = COARSE_PANELS * (np.concatenate(ends) * np.diag(matrix)) @ x**2
    return phi.T @ x + left, left, coarse


# ---- scores ----

COARSE, LINEAR, DECAY, LEAST = 31, (0.45, 0.58), 0.35, 3e-3
CROSSED, LARGE, SEEN = 0.3, (0.08, 0.12), 0.1
LONG, WALL_FADE_LENGTH, BEHIND = (0.03, 0.06), 5e-3, 4e-3
"""The first two in a domain of 0.5 m."""
CLOSE, GROWTH, USUAL = (8e-3, 12e-3), 0.2, 0.015


def scores(
    pieces: tuple[Piece, ...],
    trees: list[tuple[Array, Array, Array]],
    green: GreenFunction,
    packed: Green,
    threshold: float,
) -> list[Array]:
    """Share of the electrodes' energies that each split takes up alone, raised from below.

    Of the packed Green's function, its table and room are taken. Parts that cross a wall have at
    least their share of that of their body, by length. The larger the threshold, the larger are the
    clusters whose parts are not looked at.
    """
    linear_from = np.array(LINEAR) * max(1.0, (threshold / USUAL) ** (1 / 3))
    seen, stiff = [], []
    energy = np.zeros(green.far_phi.shape[1])
    for piece, (children, panel, charge) in zip(pieces, trees, strict=True):
        share = shares(children, panel, charge)
        block = free_block(piece.panels) / piece.scale
        means, looks = _means(piece, children, share, green, packed, linear_from)
        linear = {k: look.linearity for k, look in looks.items()}
        net = 0.0
        own, told = np.zeros(len(children)), np.ones(len(children))
        for k in sorted(means):
            if children[k, 0] >= 0:
                told[children[k]] = told[k] * (1 - linear[k])
        for k, value in means.items():
            x, y = children[k]
            if x >= 0 and x in means:
                function = share[:, x] - share[:, y]
                own[k] = function @ block @ function
                if np.isfinite(piece.eps_r):  # about Z = 2 F
                    own[k] *= 1.0 + 2.0 * abs(1.0 / (piece.eps_r - 1.0))
                p = share[members_of(share, x), k].sum()
                below = p * means[x] + (1 - p) * means[y]
                means[k] = linear[k] * value + (1 - linear[k]) * below
                value = means[x] - means[y]
                energy += told[k] * (1 - linear[k]) * value**2 / own[k]
        if not piece.neutral:
            net = means[0] ** 2 / (share[:, 0] @ block @ share[:, 0] + piece.ground_elastance)
            energy += net
        seen.append((means, linear, looks, net, piece.neutral and piece.group is None))
        stiff.append(own)
    weight = 1 / (energy + 0.01 * np.linalg.norm(energy))
    out = []
    for (*found, net, neutral), own, (children, _, _) in zip(seen, stiff, trees, strict=True):
        means, linear, looks = found
        score = np.zeros(len(children))
        for k in means:
            if own[k] > 0:
                x, y = children[k]
                value = (
                    weight @ (means[x] - means[y]) ** 2 / (own[k] * looks[k].screening_factor ** 3)
                )
                for below in (score[x], score[y]):
                    value = max(value, below) + 0.5 * min(value, below)
                score[k] = (1 - linear[k]) * value
        score[0] = max(score[0], looks[0].wall_crossing_weight * np.sum(weight * net))
        seen, told = np.ones(len(children)), np.ones(len(children))
        for k in range(len(children)):
            for part in children[k]:
                if part >= 0 and children[part, 0] >= 0:
                    seen[part] = seen[k] * _smooth((1 - linear.get(k, 1.0)) / SEEN)
                    told[part] = told[k] * (1 - linear.get(k, 1.0))
                    rest = 1 - told[part] * (1 - linear.get(part, 1.0))
                    score[part] = told[part] * score[part] + rest * DECAY * score[k]
        whole = score[0]
        for k in reversed(range(len(children))):
            if k in looks:
                large = _smooth((looks[k].size - LARGE[0]) / (LARGE[1] - LARGE[0]))
                forced = min(CROSSED, 2.5 * whole) if neutral else CROSSED
                least = max(whole * looks[k].size / looks[0].size, forced * large)
                score[k] = max(score[k], seen[k] * looks[k].wall_crossing_weight * least)
            score[k] = max([score[k], *(score[p] for p in children[k] if p >= 0)])
        out.append(score)
    return out


def tabulated(grid: Grid, point: Array) -> Array:
    """Value of a table at a point: a product of SciPy's splines, over all nodes."""
    count, first, side = grid.size.astype(float)
    low, high = grid.box.astype(float)
    within = np.clip(point, low, high)
    off = (point - within) / side
    u = (within - low) / side + np.sign(off) * np.log1p(GROWTH * np.abs(off)) / GROWTH - first
    basis, values = BSpline.basis_element(np.arange(-1.5, 2.0), extrapolate=False), grid.values
    values = values.astype(float).reshape(*count.astype(int), -1)
    for i in range(3):
        weights = np.nan_to_num(basis(np.clip(u[i], 1, count[i] - 2) - np.arange(count[i])))
        values = np.tensordot(weights, values, axes=1)
    return values


def members_of(share: Array, cluster: int) -> Array:
    return np.flatnonzero(share[:, cluster])


class Look(NamedTuple):
    """A cluster that is looked at."""

    linearity: float
    """How linear it sees the potential."""
    wall_crossing_weight: float
    """How much it crosses a wall."""
    screening_factor: float
    """Energy of its function before a plane at that distance, over that in free space."""
    size: float
    """Its length [m]."""


def _smooth(x: float) -> float:
    x = min(1.0, max(0.0, x))
    return x * x * (3 - 2 * x)


def _means(
    piece: Piece,
    children: Array,
    share: Array,
    green: GreenFunction,
    packed: Green,
    linear_from: Array,
) -> tuple[dict[int, Array], dict[int, Look]]:
    """Potentials in the centres of the clusters that are looked at, finest first, and the looks."""
    room = packed.active_bounds
    sources = green.far_sources.astype(float)
    image = sources * [1.0, 1.0, -1.0] + [0.0, 0.0, 2.0 * green.floor]
    out, looks = {}, {}
    wanted = [0]
    for k in wanted:
        center, second = charge_moments(piece.panels, share[:, k])
        point = piece.scale * piece.rotation @ center + piece.position
        size = piece.scale * np.sqrt(12.0 * max(np.linalg.eigvalsh(second)[2], 0.0))
        near = 1 / np.maximum(np.linalg.norm(point - sources, axis=1), LEAST)
        inside = min((point - room[0]).min(), (room[1] - point).min())
        off, _ = off_walls(point, room, piece.free)
        close = _smooth((CLOSE[1] - green.distance(point[None])[0]) / (CLOSE[1] - CLOSE[0]))
        out[k] = (1 - close) * tabulated(packed.grid, point)[: green.far_phi.shape[1]]
        out[k] += close * (near - 1 / np.linalg.norm(point - image, axis=1)) @ green.far_phi
        within = 1 - _smooth(off)
        out[k] *= within
        crossing = _smooth(2 - 4 * abs(inside) / size)
        crossing *= _smooth((size - LONG[0]) / (LONG[1] - LONG[0]))
        even = (linear_from[1] - size / green.distance(point[None])[0]) / np.diff(linear_from)[0]
        even = 1 - within * (1 - _smooth(even))
        off = green.distance(point[None])[0]
        front = _smooth(1 + (point[2] - green.box[1, 2]) / BEHIND)
        stiff = 1 - front * math.exp(-2 * math.pi * off / size)
        looks[k] = Look(even * (1 - crossing) if k >= COARSE else 0.0, crossing, stiff, size)
        if children[k, 0] >= 0 and looks[k].linearity < 1:
            wanted += children[k].tolist()
    return {k: out[k] for k in sorted(out, reverse=True)}, looks
