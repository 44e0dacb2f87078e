"""What a sensor is: electrodes, dielectric layers and other conductors in a grounded box.

And which designs are refused, since they could not be built or solved.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from capsense._validate import as_number, shorten
from capsense.constants import LARGEST_TIE
from capsense.cover import GROUND as COVER_GROUND
from capsense.cover import Cover
from capsense.design.film import Film
from capsense.design.geometry import (
    TOUCH,
    Facet,
    Surface,
    box_facets,
    coplanar_overlap,
    enters_box,
    find_contact,
    length_unit,
    measured,
    ring_vertices,
)
from capsense.errors import DesignError

Array = NDArray[np.float64]

RESOLUTIONS = 0.25, 4.0
"""The smallest and the largest ``[build] resolution``."""
_INFINITY = 1e5
"""How many box sizes below an open domain its ground lies."""
_SIGHT = 10.0
"""How many box sizes beyond an open domain bodies still count."""


@dataclass(frozen=True)
class Domain:
    """The grounded box around a sensor, centred in x and y, its floor at z = −backplane.

    An open domain has no walls: ground is at infinity, and the box only says where bodies are
    mostly. They count far beyond it.
    """

    size: tuple[float, float, float] = (0.5, 0.5, 0.5)
    """Full edge lengths of the box [m]."""
    backplane: float = 0.010
    """Distance from the electrode plane z = 0 down to the box's floor [m]."""
    open: bool = False
    """Whether there are no grounded walls and no floor."""

    @property
    def floor(self) -> float:
        """Height of the grounded floor [m]; of an open domain, so far down that it does nothing."""
        return -_INFINITY * max(self.size) if self.open else -self.backplane

    @property
    def lower(self) -> Array:
        """Lower corner of the box [m] in the sensor frame, shape (3,)."""
        return np.array([-self.size[0] / 2, -self.size[1] / 2, -self.backplane])

    @property
    def upper(self) -> Array:
        """Upper corner of the box [m] in the sensor frame, shape (3,)."""
        return self.lower + np.array(self.size)

    @property
    def sight(self) -> Array:
        """Corners of the box beyond which bodies do not count [m], shape (2, 3): the walls.

        Of an open domain it reaches so much farther that what lies beyond it changes nothing.
        """
        beyond = _SIGHT * max(self.size) if self.open else 0.0
        return np.array([self.lower - beyond, self.upper + beyond])

    def measured_in(self, unit: float) -> Domain:
        """This domain with lengths in a unit [m]."""
        x, y, z, depth = measured(np.array([*self.size, self.backplane]), unit).tolist()
        return Domain((x, y, z), depth, self.open)


LOCAL_GROUND = "local ground"
"""Name of the terminal that all conductors at ground are where they are not earthed."""


class Role(StrEnum):
    """What a conductor that is not an electrode is tied to."""

    GROUND = "ground"
    SHIELD = "shield"
    FLOATING = "floating"


@dataclass(frozen=True, eq=False)
class Electrode:
    """One electrode: a conducting sheet that the readout drives or listens to."""

    name: str
    surface: Surface


@dataclass(frozen=True, eq=False)
class Conductor:
    """A conductor that is not read out: a copper pour, a back plane, a shield or a housing."""

    name: str
    role: Role
    surface: Surface


@dataclass(frozen=True, eq=False)
class Layer:
    """A dielectric part of homogeneous material: an upright box, or any closed surface."""

    name: str
    material: str
    eps_r: float
    lower: Array
    """Lower corner of it or of its bounding box [m], shape (3,)."""
    upper: Array
    """Upper corner [m], shape (3,)."""
    facets: tuple[Facet, ...] = ()
    """Faces of a part that is no upright box, normals outwards; none of a box."""

    @cached_property
    def surface(self) -> Surface:
        """Its closed surface, without rims."""
        return Surface(self.facets or box_facets(self.lower, self.upper), np.empty((0, 2, 3)))

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Which points [m] lie inside, shape (n, 3) -> (n,)."""
        if self.facets:
            from capsense.design.solid import inside

            return inside(points, self.surface.triangles)
        return np.asarray(((points > self.lower) & (points < self.upper)).all(axis=-1))

    def measured_in(self, unit: float) -> Layer:
        """This part with lengths in a unit [m]."""
        return replace(
            self, lower=measured(self.lower, unit), upper=measured(self.upper, unit),
            facets=tuple(facet.measured_in(unit) for facet in self.facets),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Design:
    """A sensor as it is built: geometry and materials."""

    name: str
    domain: Domain
    electrodes: tuple[Electrode, ...]
    layers: tuple[Layer, ...] = ()
    conductors: tuple[Conductor, ...] = ()
    description: str = ""
    build: Mapping[str, float] = field(default_factory=dict)
    """Numerical settings of the ``[build]`` table; ``resolution`` is the only one."""
    cover: Cover | None = None
    """How the outermost layer gives way, if it does; the layer itself, and the fabric on it if
    any, are among ``layers`` and ``conductors``."""
    film: Film | None = None
    """What ``[bend]`` rolled onto a cylinder, if it did, as it was before."""
    ground_capacitance: float | None = None
    """Capacitance from the local ground, that of the readout and of the conductors at ground, to
    earth [F]: 0 where it floats; None where it is earthed. Walls and floor of the domain are
    earth."""

    @property
    def local_ground(self) -> bool:
        """Whether its conductors at ground are a terminal of their own, apart from earth."""
        return self.ground_capacitance is not None and any(
            c.role == Role.GROUND for c in self.conductors
        )

    def with_grounding(self, grounding: str | float) -> Design:
        """This design with its local ground on earth, floating, or tied to earth.

        Args:
            grounding: ``"grounded"``, ``"floating"``, or the capacitance to earth [F].

        Raises:
            DesignError: It is none of these, or the cover has a fabric at ground, whose compression
                is known for an earthed ground only.
        """
        if isinstance(grounding, str) and grounding == "grounded":
            return replace(self, ground_capacitance=None)
        tie = 0.0
        if not (isinstance(grounding, str) and grounding == "floating"):
            tie = as_number(grounding)
            if not 0.0 < tie <= LARGEST_TIE:
                raise DesignError(
                    f'grounding = {shorten(grounding)}; give "grounded", "floating", or the '
                    "capacitance from the local ground to earth in farads, like 100e-12, up to "
                    f"{LARGEST_TIE:g}"
                )
        if LOCAL_GROUND in (sheet.name for sheet in self.sheets):
            raise DesignError(
                f"grounding = {grounding!r}, but an electrode or conductor is named "
                f"{LOCAL_GROUND!r}, as the terminal of all conductors at ground is then; rename it"
            )
        if self.cover is not None and self.cover.top == COVER_GROUND:
            raise DesignError(
                f"grounding = {grounding!r}, but cover {self.cover.name!r} has a fabric at ground "
                'on top, which must be earthed; give top = "none", or grounding = "grounded"'
            )
        return replace(self, ground_capacitance=tie)

    @property
    def as_built(self) -> Design:
        """What its field depends on: whether conductors at ground are a terminal, not on what."""
        return replace(self, ground_capacitance=0.0 if self.local_ground else None)

    def content_hash(self) -> str:
        """SHA-256 (hex) over the geometry, materials and domain.

        Names, description, file formatting, ``build`` and the mechanics of a cover do not enter:
        the field in the empty domain does not depend on them. The order of electrodes does, since
        it is the order of matrix rows. Coordinates count to a billionth
        of the :attr:`unit`.
        """
        if self.unit != 1.0:
            return hashlib.sha256(
                f"{self.in_units.content_hash()} times {self.unit!r}".encode()
            ).hexdigest()
        lines = ["capsense design 1"]
        lines.append(f"domain {_nanometres(np.array([*self.domain.size, self.domain.backplane]))}")
        lines += ["open"] * self.domain.open
        lines += ["its cover gives way"] * (self.cover is not None)
        if self.ground_capacitance is not None:
            lines.append(f"its ground on {self.ground_capacitance!r} F")
        lines += [] if self.film is None else [f"bent {_nanometres(np.array(self.film.radius))}"]
        for electrode in self.electrodes:
            lines += ["electrode", *_surface_lines(electrode.surface)]
        others = [
            "\n".join([f"conductor {c.role.value}", *_surface_lines(c.surface)])
            for c in self.conductors
        ]
        others += [
            "\n".join(
                [
                    f"layer {float(k.eps_r)!r} {_nanometres(np.concatenate([k.lower, k.upper]))}",
                    *(_surface_lines(k.surface) if k.facets else ()),
                ]
            )
            for k in self.layers
        ]
        return hashlib.sha256("\n".join(lines + sorted(others)).encode()).hexdigest()

    @cached_property
    def unit(self) -> float:
        """Length that it is solved in [m], see :func:`~capsense.design.geometry.length_unit`."""
        areas = [electrode.surface.area for electrode in self.electrodes]
        return length_unit(areas) if areas else 1.0

    @cached_property
    def in_units(self) -> Design:
        """This design with all lengths in its :attr:`unit`."""
        unit = self.unit
        if unit == 1.0:
            return self
        out = replace(
            self, domain=self.domain.measured_in(unit),
            electrodes=tuple(
                replace(e, surface=e.surface.measured_in(unit)) for e in self.electrodes
            ),
            layers=tuple(layer.measured_in(unit) for layer in self.layers),
            conductors=tuple(
                replace(c, surface=c.surface.measured_in(unit)) for c in self.conductors
            ),
            cover=None if self.cover is None else self.cover.measured_in(unit),
            film=None if self.film is None else self.film.measured_in(unit),
        )  # fmt: skip
        out.__dict__["unit"] = 1.0  # but for rounding
        return out

    @property
    def sheets(self) -> tuple[Electrode | Conductor, ...]:
        """Everything that conducts: the electrodes, then the other conductors."""
        return (*self.electrodes, *self.conductors)

    @property
    def resolution(self) -> float:
        """How much finer than by default it asks to be built, its ``[build] resolution``."""
        return float(self.build.get("resolution", 1.0))

    @property
    def electrode_names(self) -> tuple[str, ...]:
        """Electrode names in matrix order."""
        return tuple(e.name for e in self.electrodes)


def _nanometres(values: Array) -> list[int]:
    return np.rint(np.asarray(values, dtype=float) * 1e9).astype(np.int64).ravel().tolist()


def _surface_lines(surface: Surface) -> list[str]:
    """One line per facet, the same whatever vertex a ring starts at and whichever way it runs."""
    lines = []
    for facet in surface.facets:
        rings = []
        for points in ring_vertices(facet):
            ring = [tuple(_nanometres(p)) for p in points]
            start = ring.index(min(ring))
            forward = ring[start:] + ring[:start]
            rings.append(min(forward, forward[:1] + forward[:0:-1]))
        lines.append(f"facet {rings[0]} {sorted(rings[1:])}")
    return sorted(lines)


def check_design(design: Design, *, source: str = "design") -> None:
    """Refuse a design that could not be built, or that the field solver could not treat.

    Raises:
        DesignError: If there is no electrode; if a name is used twice; if an electrode touches
            another, or a conductor; if anything leaves the domain; if layers overlap; if a sheet
            crosses a layer's surface. The message names ``source``, the item, the value and the
            fix.
    """
    if not design.electrodes:
        raise DesignError(f"{source}: design has no electrode; add an [[electrode]] table")
    unit, design = design.unit, design.in_units
    _unique_names(design.sheets, source)
    _unique_names(design.layers, source)
    for sheet in design.sheets:
        _inside_domain(sheet, design.domain, unit, source)
    for layer in design.layers:
        _layer_inside_domain(layer, design.domain, unit, source)
    for lower, upper in combinations(design.layers, 2):
        _apart(lower, upper, unit, source)
    for one, other in combinations(design.sheets, 2):
        _no_short(one, other, unit, source)
    for sheet in design.sheets:
        for layer in design.layers:
            _not_crossing(sheet, layer, unit, source)


def _label(item: Electrode | Conductor | Layer) -> str:
    return f'{type(item).__name__.lower()} "{item.name}"'


def _unique_names(items: Sequence[Electrode | Conductor | Layer], source: str) -> None:
    seen: dict[str, str] = {}
    for item in items:
        if item.name in seen:
            raise DesignError(
                f"{source}: {_label(item)}: the name {item.name!r} is already that of "
                f"{seen[item.name]}; give each its own name"
            )
        seen[item.name] = _label(item)


def _at(point: Array) -> str:
    return "(" + ", ".join(f"{x:.6g}" for x in np.round(point, 12) + 0.0) + ") m"


def _beyond(bounds: Array, domain: Domain, margin: float, unit: float) -> Iterator[tuple[str, str]]:
    """What bounds, shape (2, 3), do that are not ``margin`` inside, and where, in words."""
    walls = np.array([domain.lower, domain.upper])
    room = (bounds - walls) * [[1.0], [-1.0]]
    for axis, side in zip(*np.nonzero(margin > room.T), strict=True):
        name, value, wall = "xyz"[axis], bounds[side, axis], walls[side, axis]
        verb = "touches" if abs(value - wall) < TOUCH else "leaves"
        at = f"it reaches {name} = {unit * value:.6g} m"
        yield verb, f"{at} and the wall is at {name} = {unit * wall:.6g} m"


def _inside_domain(sheet: Electrode | Conductor, domain: Domain, unit: float, source: str) -> None:
    for verb, where in _beyond(sheet.surface.bounds, domain, TOUCH, unit):
        raise DesignError(
            f"{source}: {_label(sheet)}: {verb} the grounded box: {where}; move it inside (center, "
            "z, size) or enlarge domain size or backplane; lengths are metres"
        )


def _layer_inside_domain(layer: Layer, domain: Domain, unit: float, source: str) -> None:
    for _, where in _beyond(np.array([layer.lower, layer.upper]), domain, -TOUCH, unit):
        raise DesignError(
            f"{source}: {_label(layer)}: leaves the domain: {where}; reduce its size or z, or "
            "enlarge domain size or backplane; lengths are metres"
        )


def _apart(one: Layer, other: Layer, unit: float, source: str) -> None:
    low, high = np.maximum(one.lower, other.lower), np.minimum(one.upper, other.upper)
    if not np.all(high - low > TOUCH):
        return
    if one.facets or other.facets:
        from capsense.design.solid import overlap

        point = overlap(one.surface, other.surface)
        if point is not None:
            raise DesignError(
                f"{source}: {_label(other)}: overlaps {_label(one)} at {_at(unit * point)}; move "
                "one of them or cut it back in CAD, so that they share no more than flat faces"
            )
    else:
        raise DesignError(
            f"{source}: {_label(other)}: overlaps {_label(one)} over {_at(unit * (high - low))} at "
            f"{_at(unit * (low + high) / 2)}; change z, size or center so that they only share a "
            "face"
        )


def _no_short(
    one: Electrode | Conductor, other: Electrode | Conductor, unit: float, source: str
) -> None:
    alike = (
        isinstance(one, Conductor)
        and isinstance(other, Conductor)
        and one.role == other.role
        and one.role is not Role.FLOATING
    )
    point = find_contact(one.surface, other.surface)
    if point is None:
        return
    if alike:
        area = coplanar_overlap(one.surface, other.surface)
        if area > TOUCH**2:
            raise DesignError(
                f"{source}: {_label(other)}: lies on {_label(one)} over "
                f"{unit**2 * area * 1e6:.6g} mm² at {_at(unit * point)}; "
                "cut one of them back, they may only share edges"
            )
        return
    fix = "move them apart (center, z) or reduce their size"
    if isinstance(one, Electrode) and isinstance(other, Conductor):
        fix = f"set clearance = 0.0005 on {_label(other)} or move it to another z"
    raise DesignError(
        f"{source}: {_label(one)}: touches or overlaps {_label(other)} at {_at(unit * point)}, a "
        f"short circuit; {fix}"
    )


def _not_crossing(sheet: Electrode | Conductor, layer: Layer, unit: float, source: str) -> None:
    low, high = sheet.surface.bounds
    if layer.facets:
        _not_through(sheet, layer, unit, source)
        return
    within = np.all(low >= layer.lower - TOUCH) and np.all(high <= layer.upper + TOUCH)
    if within or not enters_box(sheet.surface, layer.lower, layer.upper):
        return
    span, other = (f"{_at(unit * a)} to {_at(unit * b)}" for a, b in (
        (low, high), (layer.lower, layer.upper),
    ))  # fmt: skip
    raise DesignError(
        f"{source}: {_label(sheet)}: crosses the surface of {_label(layer)}: it spans {span}, the "
        f"layer {other}; put it on a face of the layer (such as "
        f"z = {unit * layer.upper[2]:g}), or wholly inside or outside"
    )


def _not_through(sheet: Electrode | Conductor, part: Layer, unit: float, source: str) -> None:
    from capsense.design.solid import crossing

    low, high = sheet.surface.bounds
    if np.any(low > part.upper) or np.any(high < part.lower):
        return
    point = crossing(sheet.surface.triangles, part.surface.triangles)
    if point is not None:
        raise DesignError(
            f"{source}: {_label(sheet)}: is partly inside of {_label(part)}, at "
            f"{_at(unit * point)}, and partly outside; put it wholly inside or outside, or flat on "
            "a flat face; where both are curved leave a gap of 0.2 mm: they are made of flat pieces"
        )
