"""The slow, readable twin of the online solver: the same discrete problem, solved directly.

Nothing here is compiled and nothing is carried from one scene to the next. Bodies are met through
their shapes' ``line_intervals``, the matrix is factorised, and everything is in double precision.
The kernels are tested against it.

**Columns.** A lattice line stands for the column half-way to its neighbours. A conductor weighs in
with the share of the column that it covers, steepened by ``RAMP``, and is met at the middle of the
part that it covers; dielectrics are met on the line itself. A line of which several bodies cover
different parts is a bundle of lines, each with its part of every link's weight: see ``layers``.

**Links.** A link of weight w runs from a node to the next along an axis; where a sheet of the
design cuts it, two half-links run from the nodes to the sheet. Between its ends a scene lays
stretches of dielectric and of conductor. A stretch of length ℓ of the link's total L adds the
resistance ℓ / (L κ), κ being its permittivity over that of the empty domain; so the empty link has
resistance 1.

- No conductor: the link's weight becomes w / Σ resistance, or another, where sheets lie along it:
  see ``mixed_permittivity``. The change δ = w′ − w drives both ends, ``−δ (φ⁰_a − φ⁰_b)`` at a, and
  adds ``δ Δφ⁰_i Δφ⁰_j`` to the energy.
- A conductor: the link is taken away (less of it, where the conductor ends beside the line and its
  end comes abreast of a node). From each end a *tie* of weight w / r leads to the first
  conductor met, r being the resistance up to it. A node inside the conductor has none. The tie's
  far end is at −φ⁰ of that point (u = φ − φ⁰ and φ = 0 there). The rest of the link's empty-domain
  energy, weight w (1 − r_a − r_b), is added. Conductors that face each other on one link are joined
  by a coupling. A conductor that covers all of a link, but neither of its nodes, runs beside it and
  leaves it as it is.
- What is left of a link from a node inside a conductor to one outside is a tie too, to the node;
  what matter that fills more of the column than the conductor adds to it is one more, whose far
  end is at −φ⁰ of the node outside. What is left of half-links from it to sheets is a tie to none.

**Energy.** With K the matrix of links and ties, f_i the loads and v the ties' values,

    ΔC_ij = Σ_ties (w/r) v_i v_j + Σ_links δ Δφ⁰_i Δφ⁰_j − f_i · K⁻¹ f_j

over electrodes and floating conductors alike; a floating conductor is one more right-hand side, of
tie value −1. Floating conductors are then eliminated with what ties them to ground.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numpy.typing import NDArray

from capsense.field.background import BackgroundField
from capsense.field.lattice import FREE, Storey
from capsense.scene import Body, Scene
from capsense.solve.perturbation import CONTACT
from capsense.solve.reference_columns import Column, Part, layers, met, pierce
from capsense.solve.reference_matter import Matter, mixed_permittivity, storey_of
from capsense.solve.trace_kernels import _LEAST, _SNAP

Array = NDArray[np.float64]


def reference_delta(background: BackgroundField, scene: Scene, frequency: float = 250e3) -> Array:
    """Change of the Maxwell matrix of all terminals by a scene [F], shape (terminals, terminals).

    Takes seconds at the default resolution; meant for coarse lattices and single scenes.
    """
    problem = _Problem(background, scene, frequency)
    for axis in range(3):
        for line, bundle in problem.lines(axis):
            for share, stretches in bundle:
                problem.lay(line, stretches, share)
    problem.mix_matter()
    problem.close_nodes_inside()
    return problem.solve()


@dataclass(frozen=True)
class _Line:
    """A lattice line of one storey."""

    axis: int
    nodes: NDArray[np.int64]
    c: Array
    """Coordinates [m] of the nodes."""
    smooth: tuple[int, int]
    """First and last node between which values may be interpolated by cubics."""


@dataclass(frozen=True)
class _Stretch:
    """Where a lattice line runs inside a body: coordinates [m] along the line."""

    start: float
    end: float
    body: int
    aside: float = 0.0
    """How far what the body covers of the line's column lies from the line [m]."""


def _stretches(part: Part) -> list[_Stretch]:
    return [_Stretch(a, b, part.body, part.aside) for a, b in part.stretches]


@dataclass(frozen=True)
class _Link:
    """A link or half-link; an end is a node, or at a terminal's sheet (or a grounded one)."""

    weight: float
    starts: float
    """Coordinate [m] of end a."""
    ends: float
    """Coordinate [m] of end b."""
    nodes: tuple[int, int]
    """Flat indices of ends a and b; −1 on a sheet that cuts the link."""
    held: tuple[int, int]
    """Terminals of the ends on a sheet; negative otherwise."""


@dataclass
class _Problem:
    background: BackgroundField
    scene: Scene
    frequency: float
    links_left: dict[tuple[int, int], float] = field(default_factory=dict)
    """Weights [F] of whole links by axis and lower node."""
    diagonal: dict[int, float] = field(default_factory=dict)
    """Weights [F] of ties and half-links by node."""
    matter: dict[tuple[int, int], Matter | None] = field(default_factory=dict)
    """What dielectrics fill of whole links; None where these are not of dielectrics alone."""

    def __post_init__(self) -> None:
        bg, la = self.background, self.background.lattice
        self.conductors = [
            b for b, body in enumerate(self.scene) if body.material.is_conductor(self.frequency)
        ]
        self.n_terminals = len(bg.terminals)
        self.n_lanes = self.n_terminals + len(self.conductors)
        self.load = np.zeros((la.n_nodes, self.n_lanes))
        self.energy = np.zeros((self.n_lanes, self.n_lanes))
        self.same = {b: b for b in self.conductors}
        self.cut_of = {
            (int(a), int(n)): k
            for k, (a, n) in enumerate(zip(la.cuts.axis, la.cuts.node, strict=True))
        }
        for axis, node in np.argwhere(la.weights > 0).tolist():
            if (axis, node) not in self.cut_of:
                self.links_left[axis, node] = float(la.weights[axis, node])
        for k, node in enumerate(la.cuts.node.tolist()):
            beyond = int(la.beyond(la.cuts.axis[k], node))
            self._tie(node, float(bg.half_weights[k, 0]))
            self._tie(beyond, float(bg.half_weights[k, 1]))
        self.packed = self.scene.pack()
        self.inside = self._nodes_inside()

    def _nodes_inside(self) -> dict[int, int]:
        """Free nodes inside conductors, with the first such body; seen along z."""
        la = self.background.lattice
        free = np.flatnonzero(la.unknown)
        points = la.points[free]
        out: dict[int, int] = {}
        for body in self.conductors:
            for node, z, stretches in zip(
                free.tolist(), points[:, 2], pierce(self.scene[body], points, 2), strict=True
            ):
                if any(a <= z <= b for a, b in stretches):
                    out.setdefault(node, body)
        for node, parent in zip(la.joints.ceiling.tolist(), la.joints.parent.tolist(), strict=True):
            if parent in out:
                out[node] = out[parent]
        return out

    # -- geometry ---------------------------------------------------------------------------

    def lines(self, axis: int) -> Iterator[tuple[_Line, list[tuple[float, list[_Stretch]]]]]:
        """All lattice lines off the walls that meet a body, each with a bundle.

        A bundle is a list of shares and of the stretches met with this share.
        """
        for storey in self.background.lattice.storeys:
            yield from self._lines_of(storey, axis)

    def _lines_of(
        self, storey: Storey, axis: int
    ) -> Iterator[tuple[_Line, list[tuple[float, list[_Stretch]]]]]:
        p, q = [a for a in range(3) if a != axis]
        grid, c = np.moveaxis(storey.nodes, axis, -1), storey.axes[axis]
        low, high = self.packed.bounds[:, 0, axis], self.packed.bounds[:, 1, axis]
        here = np.flatnonzero((low <= c[-1]) & (high >= c[0])).tolist()
        smooth = (0, len(c) - 1)
        if axis == 2:
            highest = storey.stop == self.background.lattice.n_nodes
            smooth = (1 if storey.first else 0, len(c) - (1 if highest else 2))
        for i in range(1, len(storey.axes[p]) - 1):
            for j in range(1, len(storey.axes[q]) - 1):
                column = Column.around(storey, axis, i, j)
                parts = [
                    met(self.scene[body], body, self.packed, body in self.same, column)
                    for body in here
                ]
                bundle = [
                    (share, self._disjoint([s for part in filled for s in _stretches(part)]))
                    for share, filled in layers([part for part in parts if part.stretches])
                ]
                if bundle:
                    yield _Line(axis, grid[i, j], c, smooth), bundle

    def _disjoint(self, raw: list[_Stretch]) -> list[_Stretch]:
        """Conductors win over dielectrics, later dielectrics over earlier ones."""
        stops = sorted({x for s in raw for x in (s.start, s.end)})
        out: list[_Stretch] = []
        for a, b in pairwise(stops):
            here = [s.body for s in raw if s.start <= (a + b) / 2 <= s.end]
            metal = [body for body in here if body in self.same]
            if b - a <= 1e-12 or not here:
                continue
            for other in metal[1:]:
                self._join(metal[0], other)
            best = metal[0] if metal else max(here)
            aside = next(s.aside for s in raw if s.body == best)
            touching = bool(out) and a - out[-1].end <= 1e-12
            if touching and out[-1].body == best:
                out[-1] = _Stretch(out[-1].start, b, best, aside)
                continue
            if touching and out[-1].body in self.same and best in self.same:
                self._join(out[-1].body, best)
            out.append(_Stretch(a, b, best, aside))
        return out

    def _join(self, a: int, b: int) -> None:
        """Bodies that touch are one conductor."""
        old, new = self.same[b], self.same[a]
        self.same = {k: new if v == old else v for k, v in self.same.items()}

    def links(self, line: _Line, share: float) -> Iterator[_Link]:
        """The links and half-links of a line, with this share of their weights."""
        bg, la = self.background, self.background.lattice
        axis, c = line.axis, line.c
        for m in range(len(c) - 1):
            a, b = int(line.nodes[m]), int(line.nodes[m + 1])
            if la.owner[a] != FREE and la.owner[a] == la.owner[b]:
                continue  # both ends on one sheet: no field between them
            k = self.cut_of.get((axis, a))
            if k is None:
                yield _Link(share * float(la.weights[axis, a]), c[m], c[m + 1], (a, b), (-3, -3))
                continue
            low = c[m] + la.cuts.lower[k] * (c[m + 1] - c[m])
            high = c[m + 1] - la.cuts.upper[k] * (c[m + 1] - c[m])
            half = share * bg.half_weights[k]
            yield _Link(half[0], c[m], low, (a, -1), (-3, int(la.cuts.lower_owner[k])))
            yield _Link(half[1], high, c[m + 1], (-1, b), (int(la.cuts.upper_owner[k]), -3))

    # -- assembly ---------------------------------------------------------------------------

    def lay(self, line: _Line, stretches: list[_Stretch], share: float) -> None:
        """Change a line's links, to this share, by what lies on it."""
        axis = line.axis
        for link in self.links(line, share):
            on = [s for s in stretches if min(s.end, link.ends) > max(s.start, link.starts)]
            inside = [n in self.inside for n in link.nodes]
            if not on or all(inside):
                continue
            metal = any(s.body in self.same for s in on)
            if min(link.nodes) >= 0:
                if not metal and not any(inside) and share >= 1.0 - 1e-9:
                    self.matter[axis, link.nodes[0]] = self._matter_on(axis, link, on)
                    continue
                self.matter[axis, link.nodes[0]] = None
                if link.weight == 0.0:
                    continue  # another storey has this link
            if metal:
                self._lay_conductor(line, link, on)
                continue
            resistance = self._resistance(axis, link, on, link.starts, link.ends)
            if abs(resistance - 1.0) > 1e-9:
                self._lay_dielectric(axis, link, link.weight / resistance - link.weight)

    def _matter_on(self, axis: int, link: _Link, on: list[_Stretch]) -> Matter:
        length = link.ends - link.starts
        out = Matter(self._resistance(axis, link, on, link.starts, link.ends))
        for s in on:
            a, b = max(s.start, link.starts), min(s.end, link.ends)
            eps = self.scene[s.body].material.at(self.frequency).eps_r
            kappa = eps / self.background.lattice.eps_r[axis, link.nodes[0]]
            middle = (0.5 * (a + b) - link.starts) / length
            thick = max(s.end - s.start, self.scene[s.body].shape.breadth)
            out.add((b - a) / length, middle, float(kappa), thick / length)
        return out

    def mix_matter(self) -> None:
        """Change the links that dielectrics alone meet, and those beside them."""
        la = self.background.lattice
        noted = [key for key, matter in self.matter.items() if matter is not None]
        wanted = set(noted)
        for axis, a in noted:
            strides = storey_of(la, a).strides
            for node in (a, a + strides[axis]):
                for other in {0, 1, 2} - {axis}:
                    wanted |= {(other, node), (other, node - strides[other])} - set(self.matter)
        for axis, a in wanted:
            b = a + storey_of(la, a).strides[axis]
            weight = float(la.weights[axis, a])
            if (axis, a) in self.cut_of or weight == 0.0 or a in self.inside or b in self.inside:
                continue
            if la.owner[a] != FREE and la.owner[a] == la.owner[b]:
                continue
            eps = mixed_permittivity(la, self.matter, set(self.cut_of), axis, a, b)
            if abs(eps - 1.0) > 1e-9:
                link = _Link(weight, 0.0, 1.0, (a, b), (-3, -3))
                self._lay_dielectric(axis, link, weight * (eps - 1.0))

    def _lay_dielectric(self, axis: int, link: _Link, change: float) -> None:
        """Change the weight of a link or half-link that no conductor meets in this share."""
        held = [k for k in range(2) if link.nodes[k] in self.inside]
        if held:
            # one end is at the potential of a conductor that fills less of the column
            self._tie_to_inside(link.nodes[held[0]], link.nodes[1 - held[0]], change,
                                self._end_value(link, 1 - held[0]))  # fmt: skip
            return
        drop = self._end_value(link, 0) - self._end_value(link, 1)
        self.energy += change * np.outer(drop, drop)
        for node, sign in zip(link.nodes, (-1.0, 1.0), strict=True):
            if node >= 0:
                self.load[node] += sign * change * drop
        self._change(axis, link, change)

    def _tie_to_inside(self, inside: int, node: int, weight: float, background: Array) -> None:
        """Tie a node (−1: a sheet) to the conductor around another, given a potential there."""
        value = background.copy()
        value[self.n_terminals + self.conductors.index(self.inside[inside])] = -1.0
        self.energy += weight * np.outer(value, value)
        if node >= 0 and self.background.lattice.owner[node] == FREE:
            self.load[node] -= weight * value
            self._tie(node, weight)

    def _change(self, axis: int, link: _Link, change: float) -> None:
        """Add to the weight of a link or half-link."""
        if min(link.nodes) < 0:
            self._tie(max(link.nodes), change)
        else:
            self.links_left[axis, link.nodes[0]] += change

    def _tie(self, node: int, weight: float) -> None:
        self.diagonal[node] = self.diagonal.get(node, 0.0) + weight

    def _lay_conductor(self, line: _Line, link: _Link, on: list[_Stretch]) -> None:
        axis = line.axis
        la, length = self.background.lattice, link.ends - link.starts
        metal = [s for s in on if s.body in self.same]
        surfaces = max(metal[0].start, link.starts), min(metal[-1].end, link.ends)
        resistances = (
            self._resistance(axis, link, on, link.starts, surfaces[0]),
            self._resistance(axis, link, on, surfaces[1], link.ends),
        )
        deep = (
            metal[0].start < link.starts - _SNAP * length,
            metal[-1].end > link.ends + _SNAP * length,
        )
        free = [n >= 0 and la.owner[n] == FREE for n in link.nodes]
        inside = [n in self.inside for n in link.nodes]
        pairs = [
            (a, b, gap)
            for a, b in pairwise(metal)
            if (gap := self._resistance(axis, link, on, a.end, b.start)) > 0.0 and a.body != b.body
        ]
        beside = max(resistances) <= 0.0 and all(deep) and not pairs
        if beside and all(free) and not any(inside):
            return  # the body runs beside the link, not across it
        for a, b, gap in pairs:
            pair = np.zeros(self.n_lanes)
            pair[self.n_terminals + self.conductors.index(a.body)] = 1.0
            pair[self.n_terminals + self.conductors.index(b.body)] = -1.0
            self.energy += link.weight / max(gap, _LEAST) * np.outer(pair, pair)
        hidden = [inside[k] or (resistances[k] <= 0.0 and deep[k]) for k in range(2)]
        # a surface that ends beside the line draws less and less on a node it comes abreast of
        ahead = [surfaces[0] - link.starts, link.ends - surfaces[1]]
        off_line = max(s.aside for s in metal)
        seen = [ahead[k] for k in range(2) if free[k] and not hidden[k]]
        if off_line > 0.0 and seen:
            link = replace(
                link, weight=link.weight * min(seen) ** 2 / (min(seen) ** 2 + off_line**2)
            )
        self._change(axis, link, -link.weight)
        rest = link.weight
        for side, stretch in enumerate((metal[0], metal[-1])):
            node, surface, r = link.nodes[side], surfaces[side], resistances[side]
            if free[side] and hidden[side]:
                continue  # no field on this side
            r = max(r, _LEAST if free[side] else min(CONTACT / length, 1.0))
            value = self._background_at(line, link, side, surface, r)
            value[self.n_terminals + self.conductors.index(stretch.body)] = -1.0
            weight = link.weight / r
            rest -= link.weight * r
            self.energy += weight * np.outer(value, value)
            if free[side]:
                self.load[node] -= weight * value
                self._tie(node, weight)
        drop = self._end_value(link, 0) - self._end_value(link, 1)
        self.energy += rest * np.outer(drop, drop)

    def _resistance(self, axis: int, link: _Link, on: list[_Stretch], a: float, b: float) -> float:
        """Resistance of a link between two of its points, with no conductor in between."""
        la = self.background.lattice
        first = link.nodes[0] if link.nodes[0] >= 0 else link.nodes[1] - la.storeys[0].strides[axis]
        empty = la.eps_r[axis, first]
        total = max(0.0, b - a)
        for s in on:
            part = min(s.end, b) - max(s.start, a)
            if part > 0.0 and s.body not in self.same:
                total += part * (empty / self.scene[s.body].material.at(self.frequency).eps_r - 1.0)
        return total / (link.ends - link.starts)

    def _end_value(self, link: _Link, side: int) -> Array:
        """Background potential of a link's end, per lane."""
        out = np.zeros(self.n_lanes)
        if link.nodes[side] >= 0:
            out[: self.n_terminals] = self.background.potentials[link.nodes[side]]
        elif link.held[side] >= 0:
            out[link.held[side]] = 1.0
        return out

    def _background_at(
        self, line: _Line, link: _Link, side: int, surface: float, resistance: float
    ) -> Array:
        """Background potential at a conductor's surface, per lane.

        Lagrange's polynomial through the link's ends and, where the potential is smooth across an
        end, the node beyond it. Where the resistance is not the plain distance (a dielectric in
        front, or a film), the point is moved along the link by the difference.
        """
        la = self.background.lattice
        value_a, value_b = self._end_value(link, 0), self._end_value(link, 1)
        length = link.ends - link.starts
        distance = (surface - link.starts if side == 0 else link.ends - surface) / length
        shift = (distance - resistance) * (value_a - value_b) * (1.0 if side == 0 else -1.0)
        if min(link.nodes) < 0:
            t = (surface - link.starts) / length
            return (1.0 - t) * value_a + t * value_b + shift
        c, nodes = line.c, line.nodes
        m = int(np.flatnonzero(nodes == link.nodes[0])[0])
        points = {m: value_a, m + 1: value_b}
        low, high = line.smooth
        for end, beyond in ((m, m - 1), (m + 1, m + 2)):
            if m < high and low <= beyond <= high and not la.kink[nodes[end]]:
                points[beyond] = np.zeros(self.n_lanes)
                points[beyond][: self.n_terminals] = self.background.potentials[nodes[beyond]]
        out = shift
        for i, value in points.items():
            out = out + value * np.prod(
                [(surface - c[j]) / (c[i] - c[j]) for j in points if j != i]
            )
        return out

    def close_nodes_inside(self) -> None:
        """Turn what is left of links at nodes inside conductors into ties."""
        la, phi = self.background.lattice, self.background.potentials
        for node in self.inside:
            here = np.zeros(self.n_lanes)
            here[: self.n_terminals] = phi[node]
            half = 0.0
            for axis in range(3):
                stride = int(la.beyond(axis, np.array(node))) - node
                ends = ((node, node + stride), (node - stride,) * 2)
                for side, (lower, other) in enumerate(ends):
                    weight = self.links_left.pop((axis, lower), 0.0)
                    whole = float(la.weights[axis, lower])
                    if (axis, lower) in self.cut_of:
                        half += self.background.half_weights[self.cut_of[axis, lower], side]
                    elif other in self.inside:
                        drop = np.zeros(self.n_lanes)
                        drop[: self.n_terminals] = phi[node] - phi[other]
                        self.energy += weight * np.outer(drop, drop)
                    elif weight > 1e-5 * whole:
                        self._tie_to_inside(node, other, weight, here)
            rest = self.diagonal.pop(node, 0.0)
            if rest > 1e-5 * half:
                self._tie_to_inside(node, -1, rest, here)

    # -- solution ---------------------------------------------------------------------------

    def solve(self) -> Array:
        """Solve, merge the lanes of joined conductors, eliminate the floating ones."""
        la = self.background.lattice
        keys = np.array(list(self.links_left), dtype=np.int64).reshape(-1, 2)
        weight = np.array(list(self.links_left.values()))
        a, b = keys[:, 1], la.home[la.beyond(keys[:, 0], keys[:, 1])]
        shape = (la.n_nodes, la.n_nodes)
        links = sp.coo_matrix((weight, (a, b)), shape=shape).tocsr()
        total = np.asarray(links.sum(axis=0)).ravel() + np.asarray(links.sum(axis=1)).ravel()
        for node, extra in self.diagonal.items():
            total[la.home[node]] += extra
        load = np.zeros_like(self.load)
        np.add.at(load, la.home, self.load)
        matrix = (sp.diags(total) - links - links.T).tocsr()
        free = np.flatnonzero(la.unknown & (total > 1e-9 * la.weights.max()))
        merge = self._merged_lanes()
        load, energy = load[free] @ merge, merge.T @ self.energy @ merge
        u = spla.spsolve(matrix[free][:, free].tocsc(), load)
        energy = energy - load.T @ u.reshape(load.shape)
        n = self.n_terminals
        inner, outer = energy[n:, n:] + np.diag(self._grounds()), energy[:n, n:]
        met = np.flatnonzero(np.diag(inner) > 0.0)  # the others lie between the lattice lines
        inner, outer = inner[np.ix_(met, met)], outer[:, met]
        delta = energy[:n, :n]
        if len(met):
            delta = delta - outer @ np.linalg.solve(inner, outer.T)
        return 0.5 * (delta + delta.T)

    def _groups(self) -> list[list[int]]:
        """Joined conductors with no member at ground."""
        roots = sorted(set(self.same.values()))
        groups = [[b for b, root in self.same.items() if root == r] for r in roots]
        return [g for g in groups if all(self.scene[b].grounding != "grounded" for b in g)]

    def _merged_lanes(self) -> Array:
        """Terminals unchanged, one lane a group of floating conductors, shape (lanes, new)."""
        groups, n = self._groups(), self.n_terminals
        out = np.zeros((self.n_lanes, n + len(groups)))
        out[:n, :n] = np.eye(n)
        for k, group in enumerate(groups):
            out[[n + self.conductors.index(b) for b in group], n + k] = 1.0
        return out

    def _grounds(self) -> list[float]:
        """What ties each group to ground [F]."""
        return [sum(_farads(self.scene[b]) for b in group) for group in self._groups()]


def _farads(body: Body) -> float:
    return 0.0 if isinstance(body.grounding, str) else float(body.grounding)
