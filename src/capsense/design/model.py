"""What a sensor is: electrodes, dielectric layers and other conductors in a grounded box."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from capsense.design.geometry import Facet, Surface, box_facets, ring_vertices

Array = NDArray[np.float64]

_INFINITY = 1e5
"""How many box sizes below an open domain its ground lies."""


@dataclass(frozen=True)
class Domain:
    """The grounded box around a sensor, centred in x and y, its floor at z = −backplane.

    An open domain has no walls: ground is at infinity, and the box only says where bodies are
    looked for.
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

    def content_hash(self) -> str:
        """SHA-256 (hex) over the geometry, materials and domain.

        Names, description, file formatting and ``build`` do not enter; the order of electrodes
        does, since it is the order of matrix rows. Coordinates count to a nanometre.
        """
        return design_hash(self)

    @property
    def sheets(self) -> tuple[Electrode | Conductor, ...]:
        """Everything that conducts: the electrodes, then the other conductors."""
        return (*self.electrodes, *self.conductors)

    @property
    def electrode_names(self) -> tuple[str, ...]:
        """Electrode names in matrix order."""
        return tuple(e.name for e in self.electrodes)


def design_hash(design: Design) -> str:
    """SHA-256 (hex) over everything of a design that its fields depend on."""
    lines = ["capsense design 1"]
    lines.append(f"domain {_nanometres(np.array([*design.domain.size, design.domain.backplane]))}")
    lines += ["open"] * design.domain.open
    for electrode in design.electrodes:
        lines += ["electrode", *_surface_lines(electrode.surface)]
    others = [
        "\n".join([f"conductor {c.role.value}", *_surface_lines(c.surface)])
        for c in design.conductors
    ]
    others += [
        "\n".join(
            [
                f"layer {float(k.eps_r)!r} {_nanometres(np.concatenate([k.lower, k.upper]))}",
                *(_surface_lines(k.surface) if k.facets else ()),
            ]
        )
        for k in design.layers
    ]
    return hashlib.sha256("\n".join(lines + sorted(others)).encode()).hexdigest()


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
