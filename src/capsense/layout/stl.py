"""Folders with one STL file per net, in millimetres: flat copper, level with the board."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from capsense.design.stl import read_stl
from capsense.errors import LayoutError
from capsense.layout.board import BoardLayout
from capsense.layout.model import FR4, Slab, gather, in_metres, united

OUTLINES = ("outline", "board", "edge", "edge_cuts", "edge.cuts")
"""Names, in lower case, of what is the board and no net."""
LEVEL = 1e-3
"""Faces whose corners differ in height by less than this [mm] are level."""


def read(path: Path, error: float, thickness: float) -> BoardLayout:
    """Read a folder; of a body with thickness the upper faces count.

    Raises:
        LayoutError: A file is damaged, or its copper is not level.
    """
    pieces: list[tuple[str, float, BaseGeometry]] = []
    outline: list[BaseGeometry] = []
    for file in sorted(p for p in path.iterdir() if p.suffix.lower() == ".stl"):
        triangles = read_stl(file)
        z = triangles[..., 2]
        flat = np.ptp(z, axis=1) < LEVEL
        if not flat.any():
            raise LayoutError(
                f'{file} has no level face; describe it in a design as shape = "stl" instead'
            )
        heights = z[flat].mean(axis=1)
        top = float(heights.max())
        faces = shapely.polygons(triangles[flat][np.abs(heights - top) < LEVEL][..., :2])
        shape = united([shapely.union_all(faces, grid_size=1e-6)])
        if file.stem.lower() in OUTLINES:
            outline.append(shape)
        else:
            pieces.append((file.stem, round(top, 3), shape))
    return level_layout(path.name, pieces, outline, thickness)


def level_layout(
    name: str, pieces: list[tuple[str, float, BaseGeometry]], outline: list[BaseGeometry],
    thickness: float,
) -> BoardLayout:  # fmt: skip
    """A layout of copper at heights [mm] on a board of FR4; layers are named by their height."""
    levels = sorted({z for _, z, _ in pieces}, reverse=True)
    names = {z: f"z = {z - levels[0] + 0.0:g} mm" for z in levels}
    depth = max(thickness, levels[0] - levels[-1]) if levels else thickness
    return BoardLayout(
        name, gather(((n, names[z], s) for n, z, s in pieces), in_metres),
        {names[z]: (z - levels[0]) * 1e-3 for z in levels},
        (Slab("board", FR4, (-depth * 1e-3, 0.0)),),
        in_metres(united(outline)) if outline else None,
        notes=(f"The file states no material: FR4 of permittivity {FR4}, {depth:g} mm thick, is "
               "assumed.",),
    )  # fmt: skip
