"""Data sets of random scenes: the file that describes one, and what its shards hold."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.random import Generator

from capsense._validate import read_toml
from capsense.cover import Cover
from capsense.design import Design
from capsense.errors import MeshError, ScenarioError, SceneError, SolveError
from capsense.humans import Build, arm, leg
from capsense.learning.labels import Near, Outline
from capsense.learning.shards import DataSet, files_named
from capsense.reading import Reading
from capsense.readout import Readout
from capsense.readout.config import make_readout
from capsense.readout.conversions import Held
from capsense.scenario import (
    ScenarioTable,
    read_body,
    read_design,
    read_grounding,
    read_material,
    read_pose,
)
from capsense.scene import Body, Pose, Scene
from capsense.simulator import DEFAULT_PRESET, PresetName, Simulator, checked_preset

TOP_KEYS = (
    "name", "description", "design", "scenes", "shard_size", "seed", "preset", "readout",
    "clearance", "body",
)  # fmt: skip
LIMBS = {"arm": arm, "leg": leg}
"""Shapes that are limbs of people, beside those of scenarios."""
LIMB_KEYS = (
    "name", "shape", "material", "grounding", "pose", "sex", "percentile", "girth", "side",
    "segment", "angles",
)  # fmt: skip
_FORMAT = 1
"""Goes up when the same file comes to mean other scenes or columns."""
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
    "touch_force": "force that the cover carries above each electrode, M, N",
    "touch_compression": "largest compression of the cover above each electrode, M, m",
    "touch_total": "force that the whole cover carries, N",
}
"""Columns, and what they are; those of a readout only where one is given, those of touch only where
the design has a cover."""
_TRIES = 1000
"""A scene is drawn so many times at most until nothing touches the sensor."""


@dataclass(frozen=True, eq=False)
class Spec(DataSet):
    """A data set of scenes as its file describes it; made by :func:`load_spec`."""

    unit = "scenes"
    design: Design
    preset: PresetName
    readout: str | None
    """Name of a chip, or a file, which ends in ``.toml``."""
    clearance: float
    """No body comes nearer to the sensor than this [m]."""
    bodies: tuple[Mapping[str, Any], ...]
    """The tables ``[[body]]`` as they stand in the file."""

    @cached_property
    def settings(self) -> dict[str, Any]:
        """All that the numbers depend on, but for versions; contents of files by their SHA-256."""
        return {
            "format": _FORMAT, "design": self.design.content_hash(), "scenes": self.count,
            "shard_size": self.shard_size, "seed": self.seed, "preset": self.preset,
            "readout": self.readout, "clearance": self.clearance, "bodies": list(self.bodies),
            "files": files_named(_texts([*self.bodies, self.readout]), self.folder),
            **({} if self.design.cover is None else {"cover": mechanics(self.design.cover)}),
        }  # fmt: skip

    def file(self, shard: int) -> str:
        """The names that Hugging Face's ``datasets`` knows."""
        return f"data/train-{shard:05d}-of-{self.shards:05d}.parquet"

    def table(self, shard: int) -> Any:
        """A shard as a table of plain columns and lists of fixed size.

        Raises:
            ScenarioError: A scene cannot be drawn.
            SceneError: A scene is none that can be solved; the message names it.
            SolveError: A scene was not solved; the message names it.
        """
        import pyarrow as pa

        simulator, readout = self._sensor()
        rows = [self._row(number, simulator, readout) for number in self.numbers(shard)]
        electrodes = len(simulator.electrode_names)
        channels = 0 if readout is None else len(readout.channel_names)
        number, three = pa.float64(), pa.list_(pa.float64(), 3)
        matrix = pa.list_(number, electrodes**2)
        kinds = {
            "scene": pa.int64(), "capacitance": matrix, "delta": matrix,
            "self_delta": pa.list_(number, electrodes),
            "code": pa.list_(pa.int64(), channels), "code_delta": pa.list_(number, channels),
            "closest_point": three, "normal": three, "axis": three,
            "body": pa.string(), "material": pa.string(), "bodies": pa.int64(),
            "touch_force": pa.list_(number, electrodes),
            "touch_compression": pa.list_(number, electrodes),
        }  # fmt: skip
        missing: tuple[str, ...] = () if channels else ("code",)
        missing += () if self.design.cover is not None else ("touch",)
        names = [name for name in COLUMNS if not name.startswith(missing)]
        schema = pa.schema(
            pa.field(n, kinds.get(n, number), metadata={"meaning": COLUMNS[n]}) for n in names
        )
        return pa.Table.from_pylist(rows, schema=schema)

    def about(self) -> dict[str, Any]:
        """What the manifest says of the sensor and the columns."""
        simulator, readout = self._sensor()
        return {
            "design": self.design.name, "electrodes": simulator.electrode_names,
            "baseline_F": simulator.baseline.tolist(),
            "channels": () if readout is None else readout.channel_names, "columns": COLUMNS,
        }  # fmt: skip

    def _sensor(self) -> tuple[Simulator, Readout | None]:
        """The simulator, and the readout if there is one.

        Raises:
            ReadoutError: There is no such chip or file, or the file is wrong.
        """
        simulator, choice = Simulator(self.design, preset=self.preset), self.readout
        if choice is not None and choice.endswith(".toml"):
            return simulator, make_readout(self.folder / choice, simulator)
        return simulator, None if choice is None else make_readout(choice, simulator)

    def _row(self, number: int, simulator: Simulator, readout: Readout | None) -> dict[str, Any]:
        """The columns of a scene that are not null."""
        scene, near, rng = self.scene(number)
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
        if reading.touch is not None:
            touch = reading.touch
            row |= {
                "touch_force": touch.force, "touch_compression": touch.compression,
                "touch_total": touch.total,
            }  # fmt: skip
        if near is not None:
            matter = near.body.material
            row |= {
                "distance": near.distance, "closest_point": near.point, "normal": near.normal,
                "axis": near.axis, "body": near.body.name, "material": matter.name,
                "eps_r": matter.eps_r, "sigma": matter.sigma,
            }  # fmt: skip
        return row

    @cached_property
    def outline(self) -> Outline:
        """Where the sensor's surfaces are."""
        return Outline(self.design)

    def scene(self, number: int) -> tuple[Scene, Near | None, Generator]:
        """A scene, which depends on the file's settings, the seed and its number alone.

        Returns:
            The scene in the sensor frame; what of it is nearest to the electrodes, if anything is
            there; and the generator that drew it, for what else is random about it.

        Raises:
            ScenarioError: A table is wrong, or whatever is drawn touches the sensor.
        """
        rng = np.random.default_rng(np.random.SeedSequence((self.seed, number)))
        for _ in range(_TRIES):
            scene = Scene(b for raw in self.bodies for b in self._drawn(raw, rng))
            near = self.outline.nearest(scene)
            free = [b for b in scene if b.force is None]
            if near is None or self.outline.gap(free) >= self.clearance:
                return scene, near, rng
        raise ScenarioError(
            f"{self.source}: scene {number} came within clearance = {self.clearance:g} m of the "
            f"sensor in {_TRIES} draws; move the bodies away, or lower the clearance"
        )

    def _drawn(self, raw: Mapping[str, Any], rng: Generator) -> list[Body]:
        """The bodies that a table stands for, in one scene."""
        table = ScenarioTable(raw, self.source, f'body "{raw.get("name")}"')
        chance = table.number("chance", 0.0, 1.0, 1.0)
        if rng.random() >= chance:
            return []
        data = {k: _draw(v, rng, table) for k, v in raw.items() if k != "chance"}
        table = ScenarioTable(data, self.source, table.item)
        try:
            if data.get("shape") in LIMBS:
                return _limb(table)
            table.raw("pose", "{ position = [x, y, z] }")
            body = read_body(table, table.string("name"), self.folder).body
            return [body if body.force is None else self._on_cover(body, table)]
        except (SceneError, MeshError) as error:
            raise table.error(str(error)) from None

    def _on_cover(self, body: Body, table: ScenarioTable) -> Body:
        """A body that is pressed onto the cover, at the height at which it begins to touch it.

        Raises:
            ScenarioError: The design has no cover.
        """
        cover = self.design.cover
        if cover is None:
            raise table.error(
                f"force = {body.force:g} presses it onto a cover, which design "
                f"{self.design.name!r} does not have; leave it out"
            )
        up = body.shape.to_trimesh().vertices @ body.pose.rotation[2]
        x, y, _ = body.pose.position
        return body.moved(Pose((x, y, float(cover.upper[2] - up.min())), body.pose.quaternion))


def load_spec(path: str | Path) -> Spec:
    """Load the file of a data set, and see that its first scenes can be drawn.

    Args:
        path: The ``.toml`` file. What it names is relative to its folder.

    Raises:
        ScenarioError: There is no such file, or anything in it is wrong.
        DesignError: Something is wrong in the design file it names.
    """
    file = Path(path)
    top = ScenarioTable(read_toml(file, "data set", ScenarioError), file.name, "data set")
    top.only(TOP_KEYS)
    folder = file.resolve().parent
    bodies = tuple(top.tables("body"))
    if not bodies:
        raise top.error("holds no body; add a [[body]]")
    names = [
        ScenarioTable(b, file.name, f"body {n}").string("name") for n, b in enumerate(bodies, 1)
    ]
    if len(set(names)) < len(names):
        raise top.error(f"names of bodies repeat: {', '.join(names)}; names must differ")
    spec = Spec(
        name=top.string("name"), design=read_design(top, folder),
        count=top.integer("scenes", 1, 10**9),
        shard_size=top.integer("shard_size", 1, 10**6, 1000),
        seed=top.integer("seed", 0, 2**63 - 1, 0),
        preset=checked_preset(top.choice("preset", get_args(PresetName), DEFAULT_PRESET)),
        readout=top.string("readout") if "readout" in top else None,
        clearance=top.length("clearance", 1e-3), bodies=bodies,
        source=file.name, folder=folder,
    )  # fmt: skip
    for number in range(min(10, spec.count)):
        spec.scene(number)
    return spec


def mechanics(cover: Cover) -> dict[str, Any]:
    """How a cover gives way, which a design's hash does not tell."""
    return {
        "strain": cover.law.strain.tolist(), "stress": cover.law.stress.tolist(),
        "relaxation": cover.relaxation, "hysteresis": cover.hysteresis,
        "bending_length": cover.bending_length,
    }  # fmt: skip


def _texts(value: Any) -> Iterator[str]:
    """All strings within nested lists and tables."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping | list):
        for item in value.values() if isinstance(value, Mapping) else value:
            yield from _texts(item)


def _draw(value: Any, rng: Generator, table: ScenarioTable) -> Any:
    """A value with everything random in it decided.

    ``{ from = a, to = b }`` is a number, ``{ any = [...] }`` one of several, and
    ``quaternion = "uniform"`` any orientation.
    """
    if isinstance(value, list):
        return [_draw(v, rng, table) for v in value]
    if not isinstance(value, Mapping):
        return value
    if "any" in value:
        options = value["any"]
        if len(value) > 1 or not isinstance(options, list) or not options:
            raise table.error(f"{dict(value)} must be {{ any = [one, another, …] }}")
        return _draw(options[rng.integers(len(options))], rng, table)
    if "from" in value or "to" in value:
        return _number(ScenarioTable(value, table.source, f"{table.item}: {{ from, to }}"), rng)
    out = {k: _draw(v, rng, table) for k, v in value.items()}
    if out.get("quaternion") == "uniform":
        four = rng.standard_normal(4)
        out["quaternion"] = (four / np.linalg.norm(four)).tolist()
    return out


def _number(span: ScenarioTable, rng: Generator) -> float:
    """A number between two; with ``log`` uniform in its logarithm, with ``steps`` one of so many.

    Steps suit sizes: a body of new proportions takes the solver many times as long as others.
    """
    span.only(("from", "to", "log", "steps"))
    log = span.boolean("log", False)
    low = span.number("from", 1e-300 if log else -1e12, 1e12)
    high = span.number("to", low, 1e12)
    steps = span.integer("steps", 2, 10**6, 0)
    share = rng.integers(steps) / (steps - 1) if steps else rng.random()
    return float(low * (high / low) ** share if log else low + (high - low) * share)


def _limb(table: ScenarioTable) -> list[Body]:
    """An arm or a leg; its pose is that of the middle of one segment, z along the segment."""
    table.only(LIMB_KEYS)
    build = Build(
        table.choice("sex", ("female", "male"), "male"),  # type: ignore[arg-type]
        percentile=table.number("percentile", 0.1, 99.9, 50.0),
        girth=table.number("girth", 0.5, 2.0, 1.0),
    )
    side = table.choice("side", ("left", "right"), "right")
    limb = LIMBS[table.string("shape")](build, side)  # type: ignore[arg-type]
    angles = ScenarioTable(table.data.get("angles", {}), table.source, f"{table.item}: angles")
    bent = {joint: angles.number(joint, -180.0, 180.0) for joint in angles.data}
    named = {s.name: s for s in limb.segments}
    segment = named[table.choice("segment", list(named), limb.segments[1].name)]
    pose = read_pose(
        ScenarioTable(table.raw("pose", "{ position = [x, y, z] }"), table.source, table.item)
    )
    ends = np.array([p for part in segment.parts for p in (part.start, part.end)])
    middle = Pose(0.5 * (ends.min(axis=0) + ends.max(axis=0)))
    root = pose @ (limb.forward(bent, degrees=True)[segment.name] @ middle).inverse()
    grounding = read_grounding(table, 100e-12)
    material = read_material(table, "human")
    bodies = limb.bodies(root, bent, degrees=True, material=material, grounding=grounding)
    name = table.string("name")
    short = len(limb.name) + 1
    return [Body(b.shape, b.pose, b.material, b.grounding, f"{name}_{str(b.name)[short:]}", b.force)
            for b in bodies]  # fmt: skip


def settling(readout: Readout) -> float:
    """Time after which every channel has reported what it sees now [s]."""
    return 2 * readout.schedule.period + readout.schedule.lag


def settled(readout: Readout, reading: Reading, start: float) -> Held:
    """The registers after a reading has stood from ``start`` [s] for the time of settling."""
    readout.sample(start, reading)
    return readout.sample(start + settling(readout), reading).held()
