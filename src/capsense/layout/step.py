"""STEP files: each named body or sheet is a net; its upper level face counts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from capsense.errors import LayoutError
from capsense.layout.board import BoardLayout
from capsense.layout.curves import even_odd
from capsense.layout.stl import OUTLINES, level_layout

LEVEL = 1e-3
"""Faces whose corners differ in height by less than this [mm] are level."""


def read(path: Path, error: float, thickness: float) -> BoardLayout:
    """Read a file; lengths in millimetres, as Open CASCADE converts them.

    Raises:
        LayoutError: The file is no STEP file, or a body has no level face.
        MissingDependencyError: Gmsh is not installed.
    """
    from capsense.mesh.gmsh_mesher import import_gmsh

    gmsh = import_gmsh()
    gmsh.initialize(interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("Geometry.OCCImportLabels", 1)
        gmsh.option.setString("Geometry.OCCTargetUnit", "MM")
        try:
            bodies = gmsh.model.occ.importShapes(str(path), highestDimOnly=True)
        except Exception as cause:  # Gmsh raises nothing narrower
            raise LayoutError(f"{path} is no STEP file that can be read: {cause}") from None
        gmsh.model.occ.synchronize()
        pieces: list[tuple[str, float, BaseGeometry]] = []
        outline: list[BaseGeometry] = []
        for number, (dim, tag) in enumerate(bodies, start=1):
            label = gmsh.model.getEntityName(dim, tag).rpartition("/")[2]
            label = f"body{number}" if not label or "translator" in label else label
            faces = [tag] if dim == 2 else [
                abs(t) for _, t in gmsh.model.getBoundary([(dim, tag)], oriented=False)
            ]  # fmt: skip
            level = [f for f in faces if _is_level(gmsh, f)]
            if not level:
                raise LayoutError(f"{path}: {label} has no level face; export it as STL and "
                                  'describe it in a design as shape = "stl"')  # fmt: skip
            heights = {f: gmsh.model.getBoundingBox(2, f)[5] for f in level}
            top = max(heights.values())
            for face in (f for f in level if heights[f] > top - LEVEL):
                shape = _face(gmsh, face, error)
                if label.lower() in OUTLINES:
                    outline.append(shape)
                else:
                    pieces.append((label, round(top, 3), shape))
    finally:
        gmsh.finalize()
    return level_layout(path.name, pieces, outline, thickness)


def _is_level(gmsh, face: int) -> bool:  # type: ignore[no-untyped-def]
    bounds = gmsh.model.getBoundingBox(2, face)
    return gmsh.model.getType(2, face) == "Plane" and bounds[5] - bounds[2] < LEVEL


def _face(gmsh, face: int, error: float) -> BaseGeometry:  # type: ignore[no-untyped-def]
    """A level face as polygons, its curves as chords."""
    import shapely

    lines = []
    for _, curve in gmsh.model.getBoundary([(2, face)], oriented=False):
        low, high = (float(v[0]) for v in gmsh.model.getParametrizationBounds(1, abs(curve)))
        count = 1 if gmsh.model.getType(1, abs(curve)) == "Line" else 64
        t = np.linspace(low, high, count + 1)
        lines.append(np.reshape(gmsh.model.getValue(1, abs(curve), t), (-1, 3))[:, :2].round(7))
    rings = shapely.get_parts(shapely.polygonize(shapely.linestrings(lines) if len(
        {len(x) for x in lines}) == 1 else [shapely.LineString(x) for x in lines]))  # fmt: skip
    outer = [Polygon(r.exterior) for r in rings]
    return even_odd([r for k, r in enumerate(outer) if not any(r.equals(o) for o in outer[:k])])
