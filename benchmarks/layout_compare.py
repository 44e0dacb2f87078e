"""Compare a board with its own Gerber set: ``python benchmarks/layout_compare.py BOARD SET``.

The areas of copper by layer, the area that only one of them has, the area of openings in the
solder mask, and nets that the set joins or splits otherwise than the board. Both must be of one
state of the board.
"""

from __future__ import annotations

import sys
from collections import defaultdict

import shapely
import shapely.affinity
from shapely.geometry.base import BaseGeometry

import capsense as cs
from capsense.layout.model import UNCONNECTED, polygons_of


def by_layer(layout: cs.BoardLayout) -> dict[str, BaseGeometry]:
    """All copper of each layer."""
    shapes: dict[str, list[BaseGeometry]] = defaultdict(list)
    for layers in layout.nets.values():
        for layer, shape in layers.items():
            shapes[layer].append(shape)
    return {layer: shapely.union_all(found) for layer, found in shapes.items()}


def main() -> None:
    """Print what differs."""
    board, gerbers = (cs.load_layout(path, tolerance=5e-6) for path in sys.argv[1:3])
    one, other = by_layer(board), by_layer(gerbers)
    first = next(iter(one))
    dx, dy = (one[first].bounds[k] - other[first].bounds[k] for k in (0, 1))
    print(f"origins differ by {dx * 1e3:.3f}, {dy * 1e3:.3f} mm")
    for layer, shape in one.items():
        there = shapely.affinity.translate(other.get(layer, shapely.Polygon()), dx, dy)
        off = shape.symmetric_difference(there).area
        print(f"{layer}: {shape.area * 1e6:.2f} and {there.area * 1e6:.2f} mm², "
              f"{off / shape.area:.4%} differ")  # fmt: skip
    for layer in sorted(set(board.masks) & set(gerbers.masks)):
        areas = (layout.masks[layer].area * 1e6 for layout in (board, gerbers))
        print(f"openings over {layer}: " + " and ".join(f"{a:.2f} mm²" for a in areas))
    islands = [(net, layer, part) for net, layers in board.nets.items()
               for layer, shape in layers.items() for part in polygons_of(shape)]  # fmt: skip
    tree = shapely.STRtree([part for _, _, part in islands])
    meets: dict[str, set[str]] = defaultdict(set)
    parts: dict[str, set[str]] = defaultdict(set)
    for net, layers in gerbers.nets.items():
        for layer, shape in layers.items():
            for part in polygons_of(shape):
                spot = shapely.affinity.translate(part.representative_point(), dx, dy)
                for k in tree.query(spot, predicate="intersects"):
                    if islands[k][1] == layer and islands[k][0] != UNCONNECTED:
                        meets[net].add(islands[k][0])
                        parts[islands[k][0]].add(net)
    print("nets:", len(board.nets), "and", len(gerbers.nets))
    print("joined:", {k: sorted(v) for k, v in meets.items() if len(v) > 1} or "none")
    print("split:", {k: sorted(v) for k, v in parts.items() if len(v) > 1} or "none")


if __name__ == "__main__":
    main()
