"""What the shards of a data set of scenes hold: matrices, counts and labels."""

from __future__ import annotations

from typing import Any

from capsense.errors import SceneError, SolveError
from capsense.learning.settle import settled, settling
from capsense.learning.spec import Spec
from capsense.readout.config import make_readout
from capsense.readout.readout import Readout
from capsense.simulator import Simulator

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
}
"""Columns, and what they are; those of a readout only where one is given."""


def about(spec: Spec) -> dict[str, Any]:
    """What the manifest says of the sensor and the columns."""
    simulator = Simulator(spec.design, preset=spec.preset)
    readout = spec_readout(spec, simulator)
    return {
        "design": spec.design.name, "electrodes": simulator.electrode_names,
        "baseline_F": simulator.baseline.tolist(),
        "channels": () if readout is None else readout.channel_names, "columns": COLUMNS,
    }  # fmt: skip


def spec_readout(spec: Spec, simulator: Simulator) -> Readout | None:
    """The readout of a data set, if it has one.

    Raises:
        ReadoutError: There is no such chip or file, or the file is wrong.
    """
    choice = spec.readout
    if isinstance(choice, str) and choice.endswith(".toml"):
        choice = spec.folder / choice
    return None if choice is None else make_readout(choice, simulator)


def _row(spec: Spec, number: int, simulator: Simulator, readout: Readout | None) -> dict[str, Any]:
    scene, near, rng = spec.scene(number)
    try:
        reading = simulator.step(scene)
    except (SceneError, SolveError) as error:
        raise type(error)(f"scene {number}: {error}") from None
    row: dict[str, Any] = {
        "scene": number,
        "capacitance": reading.capacitance.ravel(),
        "delta": reading.delta.ravel(),
        "self_delta": reading.self_capacitance - simulator.empty.self_capacitance,
        "bodies": len(scene),
    }
    if readout is not None:
        readout.reset(seed=int(rng.integers(2**63)))
        empty = settled(readout, simulator.empty, 0.0)
        held = settled(readout, reading, settling(readout))
        row |= {"code": held.code, "code_delta": held.capacitance - empty.capacitance}
    if near is not None:
        row |= {
            "distance": near.distance, "closest_point": near.point, "normal": near.normal,
            "axis": near.axis, "body": near.body.name, "material": near.body.material.name,
            "eps_r": near.body.material.eps_r, "sigma": near.body.material.sigma,
        }  # fmt: skip
    return row


def table(spec: Spec, shard: int) -> Any:
    """A shard as a table of plain columns and lists of fixed size.

    Raises:
        ScenarioError: A scene cannot be drawn.
        SceneError: A scene is none that can be solved; the message names it.
        SolveError: A scene was not solved; the message names it.
    """
    import pyarrow as pa

    simulator = Simulator(spec.design, preset=spec.preset)
    readout = spec_readout(spec, simulator)
    rows = [_row(spec, number, simulator, readout) for number in spec.numbers(shard)]
    electrodes = len(simulator.electrode_names)
    channels = 0 if readout is None else len(readout.channel_names)
    number, three = pa.float64(), pa.list_(pa.float64(), 3)
    matrix = pa.list_(number, electrodes**2)
    kinds = {
        "scene": pa.int64(), "capacitance": matrix, "delta": matrix,
        "self_delta": pa.list_(number, electrodes),
        "code": pa.list_(pa.int64(), channels), "code_delta": pa.list_(number, channels),
        "distance": number, "closest_point": three, "normal": three, "axis": three,
        "body": pa.string(), "material": pa.string(), "eps_r": number, "sigma": number,
        "bodies": pa.int64(),
    }  # fmt: skip
    names = [name for name in COLUMNS if channels or not name.startswith("code")]
    fields = [pa.field(n, kinds[n], metadata={"meaning": COLUMNS[n]}) for n in names]
    return pa.Table.from_arrays(
        [pa.array([row.get(n) for row in rows], kinds[n]) for n in names],
        schema=pa.schema(fields),
    )
