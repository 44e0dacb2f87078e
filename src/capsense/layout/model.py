"""What a layout is: copper of each net on each layer, dielectrics, solder mask and outline."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase

import shapely
import shapely.affinity
from shapely.geometry import MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

from capsense._validate import suggest
from capsense.errors import LayoutError

FR4 = 4.5
"""Relative permittivity of boards whose material is not stated."""
UNCONNECTED = "(no net)"
"""Name of the copper that belongs to no net."""


@dataclass(frozen=True)
class Slab:
    """A dielectric layer of a stack-up."""

    name: str
    eps_r: float
    """Relative permittivity."""
    z: tuple[float, float]
    """Bottom and top [m]."""


@dataclass(frozen=True, eq=False)
class BoardData:
    """Copper of a board by net and layer, and what is around it.

    Lengths in metres, in the axes of the board: x and y as its file has them, y up; z = 0 at the
    outermost top copper, and other copper below. Copper has no thickness.
    """

    source: str
    """Name of the file."""
    nets: Mapping[str, Mapping[str, BaseGeometry]]
    """Polygons [m] by net and copper layer."""
    heights: Mapping[str, float]
    """Height [m] of each copper layer, from the top down."""
    slabs: tuple[Slab, ...] = ()
    """Dielectrics between the copper layers, from the top down."""
    outline: BaseGeometry | None = None
    """Board [m], with cutouts as holes; None if the file has none."""
    masks: Mapping[str, BaseGeometry] = field(default_factory=dict)
    """Openings [m] in the solder mask by copper layer, where the file has a mask."""
    mask: tuple[float, float] = (2e-5, 3.3)
    """Thickness [m] and relative permittivity of the solder mask."""
    notes: tuple[str, ...] = ()
    """What the file lacks, or was left out, and what was assumed: one sentence each."""

    def matching(self, patterns: Sequence[str], role: str) -> list[str]:
        """Names of the nets that match patterns such as ``TOUCH*``, in natural order.

        A leading ``/``, as KiCad puts before names of local labels, need not be written.

        Raises:
            LayoutError: A pattern matches no net.
        """
        found: dict[str, None] = {}
        for pattern in patterns:
            names = [n for n in self.nets if _matches(n, pattern)]
            if not names:
                named = [n for n in self.nets if n != UNCONNECTED]
                raise LayoutError(
                    f"{role} {pattern!r} matches no net of {self.source}; "
                    f"{suggest(pattern.strip('*'), sorted(named)[:40])}"
                )
            found.update(dict.fromkeys(sorted(names, key=natural)))
        return list(found)


def _matches(name: str, pattern: str) -> bool:
    plain = name.rpartition("/")[2]
    return any(fnmatchcase(n.lower(), pattern.lower()) for n in (name, plain, name.lstrip("/")))


def natural(name: str) -> list[tuple[int, str]]:
    """A key that sorts TOUCH2 before TOUCH10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


def polygons_of(shape: BaseGeometry) -> list[Polygon]:
    """The polygons of a geometry, without lines and points, and without empty ones."""
    parts = shapely.get_parts(shapely.get_parts(shape))
    return [p for p in parts if isinstance(p, Polygon) and p.area > 0.0]


def united(shapes: Iterable[BaseGeometry]) -> BaseGeometry:
    """The union of polygons; what is not valid among them is repaired."""
    valid = [s if s.is_valid else s.buffer(0) for s in shapes]
    return MultiPolygon(polygons_of(shapely.union_all(valid)))


def gather(
    pieces: Iterable[tuple[str, str, BaseGeometry]],
    placed: Callable[[BaseGeometry], BaseGeometry],
) -> dict[str, dict[str, BaseGeometry]]:
    """Unite pieces of (net, layer, shape) by net and layer, and put each where it belongs."""
    heap: dict[str, dict[str, list[BaseGeometry]]] = {}
    for net, layer, shape in pieces:
        heap.setdefault(net, {}).setdefault(layer, []).append(shape)
    nets = {
        net: {layer: placed(one) for layer, shapes in layers.items()
              if not (one := united(shapes)).is_empty}
        for net, layers in heap.items()
    }  # fmt: skip
    return {net: nets[net] for net in sorted(nets, key=natural) if nets[net]}


def in_metres(shape: BaseGeometry) -> BaseGeometry:
    """A geometry of millimetres in metres."""
    return shapely.affinity.scale(shape, 1e-3, 1e-3, origin=(0, 0))
