"""Data sets of random scenes: the file that describes one, and what its shards hold."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, get_args

import numpy as np

from capsense._validate import read_toml
from capsense.cover import Cover
from capsense.design import Design
from capsense.errors import MeshError, ReadoutError, ScenarioError, SceneError, SolveError
from capsense.humans import Build, Limb, arm, leg
from capsense.learning.chips import ChipSource, padded
from capsense.learning.columns import (
    COLUMNS,
    DRAWN,
    Column,
    body_columns,
    columns_for,
    schema_of,
)
from capsense.learning.draws import PREFIX, Draw, alternatives, columns_of
from capsense.learning.labels import Near, Outline
from capsense.learning.shards import DataSet, files_named
from capsense.readout.randomisation import FIGURES
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
    "clearance", "body", "randomisation",
)  # fmt: skip
LIMBS = {"arm": arm, "leg": leg}
"""Shapes that are limbs of people, beside those of scenarios."""
LIMB_KEYS = (
    "name", "shape", "material", "grounding", "pose", "sex", "percentile", "girth", "side",
    "segment", "angles",
)  # fmt: skip
_FORMAT = 2
"""Goes up when the same file comes to mean other scenes or columns."""
_TRIES = 1000
"""A scene is drawn so many times at most until nothing touches the sensor."""


@dataclass(frozen=True, eq=False)
class Spec(DataSet):
    """A data set of scenes as its file describes it; made by :func:`load_spec`."""

    unit = "scenes"
    design: Design
    preset: PresetName
    readout: str | Mapping[str, Any] | None
    """Name of a chip, or a file, which ends in ``.toml``; or a table as such a file holds it."""
    randomisation: Mapping[str, Any] | None
    """How the figures of chips scatter: the table of that name, as it stands in the file."""
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
            **({} if self.randomisation is None else {"randomisation": self.randomisation}),
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

        simulator = Simulator(self.design, preset=self.preset)
        rows = [self._row(number, simulator) for number in self.numbers(shard)]
        return pa.Table.from_pylist(rows, schema=schema_of(self.columns()))

    def about(self) -> dict[str, Any]:
        """What the manifest says of the sensor and the columns."""
        simulator, chips = Simulator(self.design, preset=self.preset), self.chips
        return {
            "design": self.design.name, "electrodes": simulator.electrode_names,
            "baseline_F": simulator.baseline.tolist(), "bodies": self.slots,
            "channels": () if chips is None else chips.channel_names,
            "columns": {n: c.meaning for n, c in self.columns().items()},
        }  # fmt: skip

    @cached_property
    def chips(self) -> ChipSource | None:
        """Where the chips come from; None without a readout.

        Raises:
            ReadoutError: There is no such chip or file, or the file is wrong.
            ScenarioError: What should be random is written wrongly.
        """
        if self.readout is None:
            return None
        electrodes = self.design.electrode_names
        return ChipSource(self.readout, self.randomisation, self.folder, self.source, electrodes)

    @cached_property
    def slots(self) -> tuple[str, ...]:
        """Names of the bodies that there may be, in the order of the columns; B of them."""
        names: dict[str, None] = {}
        for raw in self.bodies:
            for shape in alternatives(raw.get("shape")):
                limb = LIMBS[shape](Build(), "right") if shape in LIMBS else None
                some = [str(raw["name"])] if limb is None else _names(limb, str(raw["name"]))
                names.update(dict.fromkeys(some))
        return tuple(names)

    def columns(self) -> dict[str, Column]:
        """All columns, by name."""
        chips, m, b = self.chips, len(self.design.electrode_names), len(self.slots)
        k = 0 if chips is None else len(chips.channel_names)
        absent: list[str] = []
        if chips is None:
            absent += ["code", "code_delta", "chip", "chip_seed"]
        if chips is None or not chips.dac_bits:
            absent.append("dac_errors")
        if chips is None or not chips.scatters:
            absent += [f"chip_{name}" for name in FIGURES]
        if self.design.cover is None:
            absent += [name for name in COLUMNS if name.startswith("touch_")]
        bits = 0 if chips is None else chips.dac_bits
        out = {n: c for n, c in columns_for(m, k, b, bits).items() if n not in absent}
        return out | self._drawn_columns()

    def _drawn_columns(self) -> dict[str, Column]:
        """Columns of what is random in the file.

        Raises:
            ScenarioError: It is written wrongly, or one column would hold several kinds.
        """
        out: dict[str, Column] = {}
        found = [] if self.chips is None else [*self.chips.columns.items()]
        for raw in self.bodies:
            table, path = _item(raw, self.source)
            if table.number("chance", 0.0, 1.0, 1.0) < 1.0:
                found.append((f"{PREFIX}{path}.present", bool))
            found += columns_of({k: v for k, v in raw.items() if k != "chance"}, table, path)
        for name, kind in found:
            if out.setdefault(name, DRAWN[kind]) != DRAWN[kind]:
                raise ScenarioError(
                    f"{self.source}: {name.removeprefix(PREFIX)} is now a number and now a text; "
                    "give options of one kind"
                )
        return out

    def _row(self, number: int, simulator: Simulator) -> dict[str, Any]:
        """The columns of a scene that are not null."""
        scene, near, draw = self.scene(number)
        try:
            reading = simulator.step(scene)
        except (SceneError, SolveError) as error:
            raise type(error)(f"scene {number}: {error}") from None
        row: dict[str, Any] = {
            "scene": number,
            "capacitance": reading.capacitance.ravel(),
            "delta": reading.delta.ravel(),
            "self_delta": reading.self_capacitance - simulator.empty.self_capacitance,
            "bodies": len(scene), **body_columns(scene, self.slots),
        }  # fmt: skip
        if self.chips is not None:
            try:
                chip = self.chips.draw(draw.rng, simulator.empty)
                empty, held, columns = chip.registers(simulator.empty, reading)
            except ReadoutError as error:
                raise ReadoutError(f"scene {number}: {error}") from None
            if "dac_errors" in columns:
                columns["dac_errors"] = padded(columns["dac_errors"], self.chips.dac_bits)
            row |= {"code": held.code, "code_delta": held.capacitance - empty.capacitance}
            row |= columns
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
        return row | draw.drawn

    @cached_property
    def outline(self) -> Outline:
        """Where the sensor's surfaces are."""
        return Outline(self.design)

    def scene(self, number: int) -> tuple[Scene, Near | None, Draw]:
        """A scene, which depends on the file's settings, the seed and its number alone.

        Returns:
            The scene in the sensor frame; what of it is nearest to the electrodes, if anything is
            there; and what was drawn, with the generator for what else is random about it.

        Raises:
            ScenarioError: A table is wrong, or whatever is drawn touches the sensor.
        """
        rng = np.random.default_rng(np.random.SeedSequence((self.seed, number)))
        for _ in range(_TRIES):
            draw = Draw(rng)
            scene = Scene(b for raw in self.bodies for b in self._drawn(raw, draw))
            near = self.outline.nearest(scene)
            free = [b for b in scene if b.force is None]
            if near is None or self.outline.gap(free) >= self.clearance:
                return scene, near, draw
        raise ScenarioError(
            f"{self.source}: scene {number} came within clearance = {self.clearance:g} m of the "
            f"sensor in {_TRIES} draws; move the bodies away, or lower the clearance"
        )

    def _drawn(self, raw: Mapping[str, Any], draw: Draw) -> list[Body]:
        """The bodies that a table stands for, in one scene."""
        table, path = _item(raw, self.source)
        if not draw.happens(table.number("chance", 0.0, 1.0, 1.0), f"{path}.present"):
            return []
        data = draw.table({k: v for k, v in raw.items() if k != "chance"}, table, path)
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
        readout=_readout(top), randomisation=_randomisation(top),
        clearance=top.length("clearance", 1e-3), bodies=bodies,
        source=file.name, folder=folder,
    )  # fmt: skip
    spec.columns()  # raises where a chip is wrong
    for number in range(min(10, spec.count)):
        spec.scene(number)
    return spec


def _readout(top: ScenarioTable) -> str | dict[str, Any] | None:
    """What ``readout`` says: a name, a file or a table."""
    if "readout" not in top:
        return None
    given = top.raw("readout", "a chip, a readout file, or a table [readout]")
    return dict(given) if isinstance(given, Mapping) else top.string("readout")


def _randomisation(top: ScenarioTable) -> dict[str, Any] | None:
    if "randomisation" not in top:
        return None
    if "readout" not in top:
        raise top.error("randomisation is of the chip's figures; give a readout, too")
    given = top.raw("randomisation", "a table [randomisation]")
    return dict(ScenarioTable(given, top.source, "randomisation").data)


def _item(raw: Mapping[str, Any], source: str) -> tuple[ScenarioTable, str]:
    """The table of a body, and the beginning of its columns' names."""
    name = raw.get("name")
    return ScenarioTable(raw, source, f'body "{name}"'), f"body.{name}"


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
    whole = table.string("name")
    names = _names(limb, whole)
    return [replace(b, name=name, conductor=b.conductor and whole)
            for name, b in zip(names, bodies, strict=True)]  # fmt: skip


def _names(limb: Limb, name: str) -> list[str]:
    """What the bodies of a limb are called in a data set, in which it has a name of its own."""
    return [f"{name}_{str(b.name)[len(limb.name) + 1 :]}" for b in limb.bodies()]
