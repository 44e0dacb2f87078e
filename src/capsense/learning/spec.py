"""What a data set is made of: a file, and the random scenes that it describes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np
from numpy.random import Generator

from capsense._validate import read_toml
from capsense.design import Design
from capsense.errors import MeshError, ScenarioError, SceneError
from capsense.humans import Build, arm, leg
from capsense.learning.labels import Near, Outline
from capsense.learning.shards import DataSet, files_named
from capsense.scenario.loader import (
    ScenarioTable,
    read_body,
    read_design,
    read_grounding,
    read_material,
    read_pose,
)
from capsense.scene import Body, Pose, Scene
from capsense.simulator import PresetName

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
_TRIES = 1000
"""A scene is drawn so many times at most until nothing touches the sensor."""


@dataclass(frozen=True, eq=False)
class Spec(DataSet):
    """A data set of scenes as its file describes it; made by :func:`load_spec`."""

    unit = "scenes"
    design: Design
    preset: PresetName
    readout: str | Path | None
    """Name of a chip, or a file."""
    clearance: float
    """No body comes nearer to the sensor than this [m]."""
    bodies: tuple[Mapping[str, Any], ...]
    """The tables ``[[body]]`` as they stand in the file."""

    @cached_property
    def settings(self) -> dict[str, Any]:
        """All that the numbers depend on, but for versions; contents of files by their SHA-256."""
        readout = None if self.readout is None else str(self.readout)
        return {
            "format": _FORMAT, "design": self.design.content_hash(), "scenes": self.count,
            "shard_size": self.shard_size, "seed": self.seed, "preset": self.preset,
            "readout": readout, "clearance": self.clearance, "bodies": list(self.bodies),
            "files": files_named(_texts([*self.bodies, readout]), self.folder),
        }  # fmt: skip

    def file(self, shard: int) -> str:
        """The names that Hugging Face's ``datasets`` knows."""
        return f"data/train-{shard:05d}-of-{self.shards:05d}.parquet"

    def table(self, shard: int) -> Any:
        """See :func:`capsense.learning.scenes.table`."""
        from capsense.learning import scenes

        return scenes.table(self, shard)

    def about(self) -> dict[str, Any]:
        """Sensor and columns."""
        from capsense.learning import scenes

        return scenes.about(self)

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
            if near is None or self.outline.gap(scene) >= self.clearance:
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
            return [read_body(table, table.string("name"), self.folder).body]
        except (SceneError, MeshError) as error:
            raise table.error(str(error)) from None


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
    readout: str | Path | None = top.string("readout") if "readout" in top else None
    spec = Spec(
        name=top.string("name"), design=read_design(top, folder),
        count=top.integer("scenes", 1, 10**9),
        shard_size=top.integer("shard_size", 1, 10**6, 1000),
        seed=top.integer("seed", 0, 2**63 - 1, 0),
        preset=cast("PresetName", top.choice("preset", get_args(PresetName), "standard")),
        readout=readout, clearance=top.length("clearance", 1e-3), bodies=bodies,
        source=file.name, folder=folder,
    )  # fmt: skip
    for number in range(min(10, spec.count)):
        spec.scene(number)
    return spec


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
    grounding = read_grounding(table) if "grounding" in table else 100e-12
    material = read_material(table) if "material" in table else "human"
    bodies = limb.bodies(root, bent, degrees=True, material=material, grounding=grounding)
    name = table.string("name")
    short = len(limb.name) + 1
    return [Body(b.shape, b.pose, b.material, b.grounding, f"{name}_{str(b.name)[short:]}")
            for b in bodies]  # fmt: skip
