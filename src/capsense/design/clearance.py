"""The free gap that is cut into a pour around electrodes in its plane."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely
from shapely.geometry import Polygon
from shapely.geometry.polygon import orient

from capsense.design.contact import in_plane_of
from capsense.design.geometry import Facet, Surface, boundary_segments
from capsense.design.model import Electrode
from capsense.design.schema import DesignTable

SLIVER = 1e-5
"""Remainders narrower than this [m] are dropped: no board house would etch them."""
GRID = 1e-9
"""Coordinates of cut outlines are snapped to this grid [m]."""


def cut_clearance(table: DesignTable, surface: Surface, electrodes: Sequence[Electrode]) -> Surface:
    """Cut ``clearance`` [m] around every electrode that lies in a facet's plane.

    The gap's outline is the electrode's, offset with mitred corners. What remains may be several
    pieces with holes; they stay one conductor, as a pour stitched by vias is. A pour in another
    plane than the electrodes' keeps its outline.

    Raises:
        DesignError: If ``clearance`` is no positive length, if the conductor is not flat, or if
            nothing of it remains.
    """
    clearance = table.length("clearance")
    facets: list[Facet] = []
    cut = False
    for facet in surface.facets:
        gaps = []
        for electrode in electrodes:
            for other in electrode.surface.facets:
                outline = in_plane_of(facet, other)
                if outline is not None:
                    gaps.append(outline.buffer(clearance, join_style="mitre", mitre_limit=2.0))
        if not gaps:
            facets.append(facet)
            continue
        cut = True
        rest = shapely.difference(
            facet.polygon, shapely.union_all(gaps, grid_size=GRID), grid_size=GRID
        )
        for piece in shapely.get_parts(rest):
            if isinstance(piece, Polygon) and not piece.buffer(-SLIVER / 2).is_empty:
                facets.append(Facet(orient(piece), facet.origin, facet.axes))
    if not cut:
        return surface
    if any(in_plane_of(surface.facets[0], f) is None for f in surface.facets):
        raise table.error(
            f"clearance = {clearance:g} needs a flat conductor; give the pour as a planar shape of "
            "its own"
        )
    if not facets:
        raise table.error(
            f"clearance = {clearance:g} leaves nothing of it; make it larger or reduce clearance"
        )
    return Surface(tuple(facets), np.concatenate([boundary_segments(f) for f in facets]))
