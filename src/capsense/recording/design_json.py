"""Designs as JSON: the geometry itself, to the last bit, and not the file it was read from.

A design file may name STL files that move or change, and a later version may read it otherwise.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import shapely
from shapely.geometry import Polygon

from capsense.design.geometry import Facet, Surface
from capsense.design.model import Conductor, Design, Domain, Electrode, Layer, Role
from capsense.errors import RecordingError


def design_to_json(design: Design) -> str:
    """Write a design down. Python prints floats so that they are read back exactly."""
    domain = design.domain
    return json.dumps(
        {
            "name": design.name,
            "description": design.description,
            "domain": {
                "size": list(domain.size),
                "backplane": domain.backplane,
                "open": domain.open,
            },
            "electrodes": [
                {"name": e.name, "surface": _surface(e.surface)} for e in design.electrodes
            ],
            "layers": [
                {
                    "name": k.name,
                    "material": k.material,
                    "eps_r": k.eps_r,
                    "lower": np.asarray(k.lower).tolist(),
                    "upper": np.asarray(k.upper).tolist(),
                }
                for k in design.layers
            ],
            "conductors": [
                {"name": c.name, "role": c.role.value, "surface": _surface(c.surface)}
                for c in design.conductors
            ],
            "build": dict(design.build),
            "content_hash": design.content_hash(),
        }
    )


def design_from_json(text: str | bytes) -> Design:
    """The design that was written down.

    Raises:
        RecordingError: The text is damaged.
    """
    try:
        data = json.loads(text)
        design = Design(
            name=data["name"],
            domain=Domain(
                tuple(data["domain"]["size"]),
                data["domain"]["backplane"],
                data["domain"].get("open", False),
            ),
            electrodes=tuple(
                Electrode(e["name"], _read_surface(e["surface"])) for e in data["electrodes"]
            ),
            layers=tuple(
                Layer(
                    k["name"], k["material"], k["eps_r"], np.array(k["lower"]), np.array(k["upper"])
                )
                for k in data["layers"]
            ),
            conductors=tuple(
                Conductor(c["name"], Role(c["role"]), _read_surface(c["surface"]))
                for c in data["conductors"]
            ),
            description=data["description"],
            build=data["build"],
        )
        whole = design.content_hash() == data["content_hash"]
    except (KeyError, TypeError, ValueError, RecursionError, shapely.errors.ShapelyError) as error:
        raise RecordingError(f"the recorded design is damaged: {error!r}") from None
    if not whole:
        raise RecordingError("the recorded design is damaged: its content hash differs")
    return design


def _surface(surface: Surface) -> dict[str, Any]:
    facets = [
        {
            "rings": [
                shapely.get_coordinates(ring).tolist()
                for ring in (f.polygon.exterior, *f.polygon.interiors)
            ],
            "origin": np.asarray(f.origin).tolist(),
            "axes": np.asarray(f.axes).tolist(),
        }
        for f in surface.facets
    ]
    return {"facets": facets, "rims": np.asarray(surface.rims).tolist()}


def _read_surface(data: dict[str, Any]) -> Surface:
    facets = tuple(
        Facet(Polygon(f["rings"][0], f["rings"][1:]), np.array(f["origin"]), np.array(f["axes"]))
        for f in data["facets"]
    )
    return Surface(facets, np.array(data["rims"]).reshape(-1, 2, 3))
