"""Columns of data sets of scenes: what they hold, and what they hold of bodies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from capsense.codec import SHAPES, lengths_of
from capsense.readout.randomisation import FIGURES
from capsense.scene import Body, Scene
from capsense.scene.materials import Ties, ties_of

Kind = Literal["number", "whole", "text", "bool"]


class Column(NamedTuple):
    """What is in a column."""

    kind: Kind
    """Of the items."""
    size: int
    """How many items a list has; 0 for no list."""
    meaning: str


COLUMNS = {
    "scene": "number of the scene",
    "capacitance": "Maxwell capacitance matrix, row by row, M × M, F",
    "delta": "its change from the empty scene, row by row, M × M, F",
    "self_delta": "change of the self capacitances, the design's shields driven along, M, F",
    "code": "what the converter of each channel holds, K, codes",
    "code_delta": "what its user makes of it, change from the empty scene, K, F",
    "distance": "from the nearest electrode to the nearest body, m",
    "closest_point": "the point of that body's surface nearest to the electrodes, x, y, z, m",
    "normal": "unit normal of its surface there, out of the body, x, y, z",
    "axis": "unit vector along it, where it is a capsule or a cylinder, x, y, z",
    "body": "its name",
    "material": "its material",
    "eps_r": "relative permittivity of that",
    "sigma": "conductivity of that, S/m",
    "bodies": "how many bodies the scene holds",
    "body_present": "whether each of the B bodies that there may be is there, B",
    "body_shape": "its shape: box, sphere, capsule, cylinder, ellipsoid or mesh, B",
    "body_size": "edges of a box, or of a mesh's bounding box in its own frame; radius; radius and "
    "length; or radii; NaN for those it does not have, B × 3, m",
    "body_position": "its position, x, y, z, B × 3, m",
    "body_quaternion": "its orientation, x, y, z, w, B × 4",
    "body_material": "its material, B",
    "body_eps_r": "relative permittivity of that, B",
    "body_sigma": "conductivity of that, B, S/m",
    "body_grounding": "grounded, floating, local, capacitance or ties, B",
    "body_conductor": "conductor that it belongs to with others of that name, if any, B",
    "body_earth": "capacitance that ties it to earth, infinite for grounded, B, F",
    "body_local": "capacitance that ties it to the sensor's ground, infinite for local, B, F",
    "body_force": "force that presses it onto the cover, NaN for none given, B, N",
    "touch_force": "force that the cover carries above each electrode, M, N",
    "touch_compression": "largest compression of the cover above each electrode, M, m",
    "touch_total": "force that the whole cover carries, N",
    "chip": "name of the chip",
    "chip_seed": "seed of its noise, and of its specimen",
    "dac_errors": "what each bit of its offset DAC has too much, the least significant first; NaN "
    "for bits it does not have, K × bits, F",
    "chip_gain": "factor on the capacitance of each channel, K",
    "chip_offset": "added to it, K, F",
    "chip_noise": "factor on the noise, K",
    "chip_delay": "further time until a result can be read, K, s",
    "chip_jitter": "largest further delay that is drawn for each conversion, K, s",
    "chip_hysteresis": "width of the loop, K, F",
    "chip_crosstalk": "share of every other channel that is added, K",
    "chip_dead": "whether each electrode is cut off, M",
    "chip_stuck": "whether each channel reports its first code for ever, K",
}
"""Columns, and what they are; those of a chip only where one is given, those of its figures only
with ``[randomisation]``, those of touch only where the design has a cover. Further ones hold each
random value of the file, see :func:`capsense.learning.draws.columns_of`."""
OF_BODIES: Mapping[str, tuple[Kind, int]] = {
    "present": ("bool", 1), "shape": ("text", 1), "size": ("number", 3), "position": ("number", 3),
    "quaternion": ("number", 4), "material": ("text", 1), "eps_r": ("number", 1),
    "sigma": ("number", 1), "grounding": ("text", 1), "conductor": ("text", 1),
    "earth": ("number", 1), "local": ("number", 1), "force": ("number", 1),
}  # fmt: skip
"""What is known of each body, of which kind, and how many of them."""
DRAWN = {
    float: Column("number", 0, "as drawn"),
    int: Column("whole", 0, "number of the option drawn, from 0"),
    str: Column("text", 0, "as drawn"),
    bool: Column("bool", 0, "as drawn"),
    list: Column("number", 4, "as drawn, x, y, z, w"),
}
"""Columns of what is random in a file, by what :func:`capsense.learning.draws.columns_of` says."""


def columns_for(electrodes: int, channels: int, bodies: int, bits: int) -> dict[str, Column]:
    """All of :data:`COLUMNS`, for so many electrodes, channels, bodies and bits of a DAC."""
    m, k = electrodes, channels
    lists: dict[str, tuple[Kind, int]] = {
        "capacitance": ("number", m * m), "delta": ("number", m * m), "self_delta": ("number", m),
        "code": ("whole", k), "code_delta": ("number", k), "dac_errors": ("number", k * bits),
        "closest_point": ("number", 3), "normal": ("number", 3), "axis": ("number", 3),
        "touch_force": ("number", m), "touch_compression": ("number", m),
        **{f"body_{n}": (kind, count * bodies) for n, (kind, count) in OF_BODIES.items()},
        **{f"chip_{n}": ("number", k) for n in FIGURES},
        "chip_dead": ("bool", m), "chip_stuck": ("bool", k),
    }  # fmt: skip
    single: dict[str, Kind] = {
        "scene": "whole", "bodies": "whole", "chip_seed": "whole",
        "body": "text", "material": "text", "chip": "text",
    }  # fmt: skip
    return {
        name: Column(*lists.get(name, (single.get(name, "number"), 0)), meaning)
        for name, meaning in COLUMNS.items()
    }


def schema_of(columns: Mapping[str, Column]) -> Any:
    """The schema of a table of pyarrow with some columns."""
    import pyarrow as pa

    kinds = {
        "number": pa.float64(), "whole": pa.int64(), "text": pa.string(), "bool": pa.bool_(),
    }  # fmt: skip
    return pa.schema(
        pa.field(
            name,
            pa.list_(kinds[column.kind], column.size) if column.size else kinds[column.kind],
            metadata={"meaning": column.meaning},
        )
        for name, column in columns.items()
    )


def body_columns(scene: Scene, names: Sequence[str]) -> dict[str, Any]:
    """What a row says of every body that there may be.

    Args:
        scene: The scene.
        names: Names of these bodies, in their order.
    """
    there = {str(body.name): body for body in scene}
    facts = [_facts(there.get(name)) for name in names]
    out = {}
    for name, (kind, _) in OF_BODIES.items():
        items = [fact[name] for fact in facts]
        out[f"body_{name}"] = np.hstack(items) if kind == "number" else items
    return out


def _facts(body: Body | None) -> dict[str, Any]:
    """What columns hold of a body; of none, no text and NaN."""
    if body is None:
        return {
            name: {"bool": False, "text": None}.get(kind, np.full(count, np.nan))
            for name, (kind, count) in OF_BODIES.items()
        }
    size, shape = np.full(3, np.nan), body.shape
    kind = shape.kind.name.lower()
    if kind in SHAPES:
        lengths = np.hstack([getattr(shape, name) for name in lengths_of(kind)])
    else:
        lengths = np.ptp(shape.to_trimesh().vertices, axis=0)
    size[: len(lengths)] = lengths
    tied = {float: "capacitance", Ties: "ties"}.get(type(body.grounding), body.grounding)
    earth, local = ties_of(body.grounding)
    return {
        "present": True, "shape": kind, "size": size, "position": body.pose.position,
        "quaternion": body.pose.quaternion, "material": body.material.name,
        "eps_r": body.material.eps_r, "sigma": body.material.sigma, "grounding": tied,
        "conductor": body.conductor, "earth": earth, "local": local,
        "force": np.nan if body.force is None else body.force,
    }  # fmt: skip
