"""Where the point charges of a Green's function lie, and the points that they are fitted at.

Charges lie where no body can be: behind sheets, on the side with less of a view, inside of layers
and housings, and outside of the walls. Points of the fit lie where bodies can be.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from capsense._jit import kernel
from capsense._thread_pool import filled
from capsense.design.model import Design
from capsense.design.solid import first_hit, paths
from capsense.field.boundary import INTERFACE, BoundaryModel, room_scale

Array = NDArray[np.float64]

_OPEN = 0.3
"""Bodies can be where the openness is larger."""
_PER_WIDTH = 0.2
"""Largest spacing of near point charges, over the width of the narrowest electrode."""
_SPACING = 1.5e-3
"""Smallest distance of neighbouring point charges, near representation [m]."""
_NEAR_FLOOR = 5.0
"""No body is below a flat design in a domain that is more than so many times its backplane wide."""
_FLAT = 3e-3
"""Sheets of a flat design rise by less than this, over their width."""
_RIM = 0.45
"""Behind free rims, which bodies can pass, the openness is larger."""
_BETWEEN = 0.3
"""Depth of point charges between two sheets, or behind one with a view on both sides, over the way
through. Those of both sides stay apart: where they met, the potential was that of one layer, while
it differs on both sides."""


@dataclass(frozen=True)
class GreenSettings:
    """Sizes of the representation; the defaults are those of all stored fields."""

    near_sources: int = 800
    """Largest number of point charges behind the sensor, near representation."""
    near_spacing: float = _SPACING
    """Smallest distance of neighbouring point charges, near representation [m]."""
    middle_sources: int = 440
    """As ``near_sources``, middle representation."""
    middle_spacing: float = 3.1e-3
    """As ``near_spacing``, middle representation [m]."""
    far_sources: int = 220
    """As ``near_sources``, far representation."""
    far_spacing: float = 4.5e-3
    """As ``near_spacing``, far representation [m]."""
    depth: float = 0.9
    """Depth of the point charges behind the surfaces, in spacings."""
    modes: int = 180
    """Largest number of modes."""
    middle_modes: int = 104
    """Largest number of modes where the middle representation is used."""
    far_modes: int = 56
    """Largest number of modes far away."""
    wall_grid: int = 5
    """Point charges along each edge of a wall."""
    wall_offset: float = 0.04
    """Distance of point charges from the walls of a box of up to 0.5 m [m]; more in larger ones."""
    training: int = 800
    """Points that the modes are fitted at, besides three for each near source."""
    wide: int = 1200
    """How many more there are all over the domain, where potentials are small."""
    far_training: int = 3000
    """Points that the middle and the far representation are fitted at, to the near one."""
    clearance: tuple[float, float] = (0.5, 0.25)
    """Smallest distance of these points from the design, over the spacing of the near charges, or
    over the width of an electrode's widest panel if that is more."""
    blends: tuple[tuple[float, float], ...] = ((0.0035, 0.005), (0.012, 0.018))
    """Distances where the middle representation starts and the near one ends [m], and where the far
    one starts and the middle one ends."""
    regularisation: float = 4e-9
    """Squared singular values below this share of the largest count for little."""


def narrowest_width(design: Design) -> float:
    """Width of the narrowest electrode [m]: twice its area over the length of its rims.

    Infinite where no electrode has a rim.
    """
    rims = [e.surface for e in design.electrodes if len(e.surface.rims)]
    lengths = [float(np.linalg.norm(np.diff(s.rims, axis=1), axis=2).sum()) for s in rims]
    widths = [2 * s.area / length for s, length in zip(rims, lengths, strict=True)]
    return min(widths, default=math.inf)


class Surroundings:
    """Points all over the surfaces that bodies see, and from which side."""

    def __init__(self, design: Design, model: BoundaryModel) -> None:
        self.design = design
        panels = model.panels
        lower, upper = design.domain.lower, design.domain.upper
        edge = np.minimum(panels.centers - lower, upper - panels.centers)
        inner = np.flatnonzero(edge.min(axis=1) > 1e-6)
        up, down = (
            openness(design, panels.centers[inner] + sign * 1e-3 * panels.normals[inner])
            for sign in (1, -1)
        )
        up_front = (model.owner[inner] == INTERFACE) | (up >= down)
        seen = np.where(up_front, up, down) > _OPEN  # others are met by no body
        if seen.any():
            inner, up_front = inner[seen], up_front[seen]
        used = panels.weights[inner] > 0
        self.points = panels.quad[inner][used]
        self.normals = np.repeat(panels.normals[inner], used.sum(axis=1), axis=0)
        self.normals *= np.repeat(np.where(up_front, 1.0, -1.0), used.sum(axis=1))[:, None]
        """Unit normals towards the side from which bodies come, shape (points, 3)."""
        self.areas = panels.weights[inner][used]
        on = (model.owner >= 0) & (model.owner < len(design.electrodes))
        electrodes = np.repeat(on[inner], used.sum(axis=1))
        self.narrowest = narrowest_width(design)
        """Width of the narrowest electrode [m]."""
        self.widest = float(np.sqrt(panels.areas[on].max()))
        """Width of the widest panel of an electrode [m]."""
        self.tree = cKDTree(self.points)
        away = cKDTree(self.points[electrodes]).query(self.points)[0]
        self.coarseness = np.clip(away / 0.015, 1.0, 5.0)
        """How much coarser than at the electrodes things may be, shape (points,)."""
        self.weights = self.areas / self.coarseness**2
        """Areas that count less where things may be coarser [m²], shape (points,)."""

    def spacing(self, count: int, least: float) -> float:
        """Distance of neighbours among up to ``count`` points near electrodes [m]."""
        least *= min(1.0, _PER_WIDTH * self.narrowest / _SPACING)
        return max(least, float(np.sqrt(self.weights.sum() / count)))

    def clearance(self, settings: GreenSettings) -> float:
        """Smallest distance of points of the fit from the design [m]."""
        spacing = self.spacing(settings.near_sources, settings.near_spacing)
        return max(settings.clearance[0] * spacing, settings.clearance[1] * self.widest)

    def sources(self, count: int, spacing: float, depth: float) -> Array:
        """Up to ``count`` points evenly spread behind the surfaces [m], shape (s, 3)."""
        spacing = self.spacing(count, spacing)
        count = min(count, max(8, int(self.weights.sum() / spacing**2)))
        chosen = spread(self.points, self.coarseness, count)
        return self.behind(chosen, depth * spacing * self.coarseness[chosen])

    def behind(self, chosen: NDArray[np.intp], depth: Array) -> Array:
        """Points behind the chosen ones, (k,), (k,) -> (k, 3)."""
        points = self.points[chosen]
        back = -self.normals[chosen]
        room = points[:, 2] - self.design.domain.floor
        depth = np.minimum(depth, 0.6 * room / np.maximum(-back[:, 2], 1e-9))
        # not through another sheet and out again where bodies can be
        path = free_path(self.design, points, back)
        view = openness(self.design, points + depth[:, None] * back)
        # bodies beside a rim come as close as those in front of it
        depth = np.where(view > _RIM, 0.35 * depth, depth)
        depth = np.where(view > _OPEN, np.minimum(_BETWEEN * path, depth), depth)
        return points + depth[:, None] * back


def spread(points: Array, scale: Array, count: int) -> NDArray[np.intp]:
    """Indices of ``count`` points, each as far as can be from those before, relative to scale."""
    chosen = np.empty(count, dtype=np.intp)
    nearest = np.full(len(points), np.inf)
    pick = int(np.argmin(points @ [1.0, 1.1, 1.2]))
    columns, square = np.ascontiguousarray(points.T), scale**2
    away, along = np.empty((2, len(points)))
    for k in range(count):  # in place: no memory is fetched anew for each of them
        chosen[k] = pick
        away[:] = 0.0
        for x in columns:
            np.subtract(x, x[pick], out=along)
            away += np.square(along, out=along)
        away /= square
        np.minimum(nearest, away, out=nearest)
        pick = int(nearest.argmax())
    return chosen


def training_points(
    surface: Surroundings, sources: Array, settings: GreenSettings
) -> tuple[Array, Array]:
    """Points for the boundary elements, and their distances from the design [m], (n, 3), (n,).

    Their spacing goes with the distance from the design.
    """
    count = settings.training + 3 * len(sources)
    points = reachable_points(surface, sources, surface.clearance(settings), count)
    distance, nearest = surface.tree.query(points)
    scale = distance * surface.coarseness[nearest]
    kept = spread(points, scale, min(count, len(points)))
    return _with_wide(surface, points[kept], settings)


def _with_wide(
    surface: Surroundings, points: Array, settings: GreenSettings
) -> tuple[Array, Array]:
    """Points and more of them all over the domain, with their distances from the design [m]."""
    lower, upper = surface.design.domain.lower, surface.design.domain.upper
    margin = 0.02 * (upper - lower)
    wide = np.random.default_rng(1).uniform(lower + margin, upper - margin, (settings.wide, 3))
    far = surface.tree.query(wide)[0] > 0.04 * float((upper - lower).max())
    points = np.concatenate([points, wide[far]])
    return points, surface.tree.query(points)[0]


def reachable_points(surface: Surroundings, sources: Array, clearance: float, count: int) -> Array:
    """Some five times ``count`` points that bodies can reach, at all distances [m], (n, 3).

    They lie in front of the surfaces, around the rims, and anywhere in the box. None is within
    layers, beyond walls, or closer to a source than bodies come.
    """
    design = surface.design
    lower, upper = design.domain.lower, design.domain.upper
    random = np.random.default_rng(0)
    span = float((upper - lower).max()) / clearance

    def offsets(directions: Array) -> Array:
        lengths = clearance * span ** random.uniform(0, 0.95, len(directions))
        return directions * (lengths / np.linalg.norm(directions, axis=1))[:, None]

    chance = surface.weights / surface.weights.sum()
    chosen = random.choice(len(chance), 4 * count, p=chance)
    front = surface.normals[chosen] + 0.5 * random.normal(size=(4 * count, 3))
    rims = np.concatenate([body.surface.rims for body in design.sheets])
    length = np.linalg.norm(rims[:, 1] - rims[:, 0], axis=1)
    if len(rims):
        ends = rims[random.choice(len(rims), 2 * count, p=length / length.sum())]
    else:  # closed surfaces have none
        corners = design.sheets[0].surface.triangles
        ends = corners[random.choice(len(corners), 2 * count)][:, :2]
    along = ends[:, 0] + random.uniform(size=(2 * count, 1)) * (ends[:, 1] - ends[:, 0])
    points = np.concatenate(
        [
            surface.points[chosen] + offsets(front),
            along + offsets(random.normal(size=along.shape)),
            lower + (upper - lower) * random.uniform(0.0, 1.0, (count, 3)),
        ]
    )
    margin = 0.02 * (upper - lower)
    truncate_to_domain = ((points > lower + margin) & (points < upper - margin)).all(axis=1)
    for layer in design.layers:
        truncate_to_domain &= ~layer.contains(points)
    points = points[truncate_to_domain & ~_shut(design, points)]
    distance, nearest = surface.tree.query(points)
    apart = distance > clearance * surface.coarseness[nearest] ** 0.5
    apart &= cKDTree(sources).query(points)[0] > 0.6 * distance
    points = points[apart]
    return points[openness(design, points) > _OPEN]


def _shut(design: Design, points: Array) -> NDArray[np.bool_]:
    """Which points lie between a flat design and a floor near it, where no body can be, (n,)."""
    domain = design.domain
    if domain.open or not is_flat(design) or _NEAR_FLOOR * domain.backplane >= min(domain.size):
        return np.zeros(len(points), np.bool_)
    box = design_box(design)
    beside = (points[:, :2] < box[0, :2]) | (points[:, :2] > box[1, :2])
    return np.asarray((points[:, 2] < box[1, 2]) & ~beside.any(axis=1))


def wall_sources(design: Design, settings: GreenSettings) -> Array:
    """Points outside of the ceiling and the side walls [m], none if open, shape (n, 3)."""
    if design.domain.open:
        return np.empty((0, 3))
    lower, upper = design.domain.lower, design.domain.upper
    off, k = settings.wall_offset * room_scale(design), settings.wall_grid
    low, high = lower - [off, off, 0.0], upper + off
    x, y, z = (a + (np.arange(k) + 0.5) / k * (b - a) for a, b in zip(low, high, strict=True))
    faces = []
    for axis, sides in ((0, (low[0], high[0])), (1, (low[1], high[1])), (2, (high[2],))):
        for side in sides:
            lines = [x, y, z]
            lines[axis] = np.array([side])
            grid = np.meshgrid(*lines, indexing="ij")
            faces.append(np.stack([a.ravel() for a in grid], axis=1))
    return np.concatenate(faces)


def far_points(
    surface: Surroundings, sources: Array, settings: GreenSettings, start: float
) -> tuple[Array, Array]:
    """Points where a representation is used that starts at a distance from the design [m], and
    their distances from it [m], (n, 3), (n,)."""
    count = settings.far_training
    points = reachable_points(surface, sources, 0.5 * start, count // 2)
    away = outside(design_box(surface.design), points) > 0.8 * start
    if away.sum() > len(sources):  # else the box ends near the sensor
        points = points[away]
    points = points[np.random.default_rng(1).permutation(len(points))[:count]]
    return _with_wide(surface, points, settings)


def is_flat(design: Design) -> bool:
    """Whether all sheets of a design are flat and level."""
    return all(
        np.ptp(body.surface.bounds[:, 2])
        <= _FLAT * np.ptp(body.surface.bounds[:, :2], axis=0).max()
        for body in design.sheets
    )


def design_box(design: Design) -> Array:
    """Lower and upper corner of electrodes, conductors and layers [m], shape (2, 3)."""
    corners = [body.surface.bounds for body in design.sheets]
    corners += [np.array([layer.lower, layer.upper]) for layer in design.layers]
    both = np.array(corners)
    return np.array([both[:, 0].min(axis=0), both[:, 1].max(axis=0)])


def outside(box: Array, points: Array) -> Array:
    """Distance of points from a box [m], zero inside, shape (n, 3) -> (n,)."""
    beyond = np.maximum(np.maximum(box[0] - points, points - box[1]), 0.0)
    return np.sqrt((beyond**2).sum(axis=1))


_RAYS = 48
_FLOOR_REACH = 5.0, 0.5
"""A floor nearer along a ray than so many times the backplane, but no more than this part of the
domain's shortest side, counts as closed in proportion."""


def openness(design: Design, points: Array) -> Array:
    """Share of the directions in which a point has a free view, shape (n, 3) -> (n,).

    A ray that meets a conductor has none, one that reaches a side wall or the ceiling has a free
    view, and one that meets the floor counts as ``_FLOOR_REACH`` says. In front of a sheet it is
    more than one half; behind one that lies near the floor about a quarter; inside a closed housing
    0. Layers are transparent.
    """
    triangles = np.concatenate([body.surface.triangles for body in design.sheets])
    k = np.arange(_RAYS) + 0.5
    z, turn = 1 - 2 * k / _RAYS, k * math.pi * (3 - math.sqrt(5))
    side = np.sqrt(1 - z * z)
    rays = np.stack([side * np.cos(turn), side * np.sin(turn), z], axis=1)
    domain = design.domain
    reach = min(_FLOOR_REACH[0] * domain.backplane, _FLOOR_REACH[1] * min(domain.size))
    floor = domain.floor, reach
    out = np.empty(len(points))
    return filled(_fill_views, out, np.ascontiguousarray(points), rays, triangles, floor)


def free_path(design: Design, points: Array, rays: Array) -> Array:
    """Distance to the first conductor along unit rays [m], (n, 3), (n, 3) -> (n,); may be inf."""
    triangles = np.concatenate([body.surface.triangles for body in design.sheets])
    return paths(points, rays, triangles)


@kernel
def _fill_views(
    start: int,
    stop: int,
    points: Array,
    rays: Array,
    triangles: Array,
    floor: tuple[float, float],
    out: Array,
) -> None:
    for i in range(start, stop):
        total = 0.0
        for r in range(len(rays)):
            if first_hit(points[i], rays[r], triangles, False) == math.inf:
                view = 1.0
                if rays[r, 2] < 0.0:
                    view = min(1.0, (floor[0] - points[i, 2]) / rays[r, 2] / floor[1])
                total += max(view, 0.0)
        out[i] = total / len(rays)
