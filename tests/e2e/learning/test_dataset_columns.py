"""Every quantity that is drawn has a column: scenes and chips can be made again from the file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import capsense as cs
from capsense.learning import scenes
from capsense.learning.draws import PREFIX, Draw, columns_of
from capsense.learning.scenes import load_spec
from capsense.learning.shards import run
from capsense.readout.config import parse_readout
from capsense.readout.randomisation import FIGURES, ReadoutRandomisation
from capsense.readout.readout import build
from capsense.readout.side_by_side import SideBySide
from capsense.scenario import ScenarioTable
from capsense.scene.materials import Ties

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

BODIES = """
[[body]]
name = "thing"
shape = { any = ["cylinder", "capsule"] }
radius = { from = 0.01, to = 0.03, steps = 4 }
length = 0.04
material = { any = ["steel", { name = "soap", eps_r = { from = 2, to = 20, log = true } }] }
grounding = { any = ["grounded", "floating", { earth = { from = 1e-12, to = 1e-10 } }] }
pose = { position = [{ from = -0.05, to = 0.05 }, 0.0, { from = 0.05, to = 0.1 }] }

[[body]]
name = "box"
chance = 0.6
shape = "box"
size = [0.05, { from = 0.05, to = 0.1, steps = 3 }, 0.02]
material = "wood"
pose = { position = [0, 0, 0.15], quaternion = "uniform" }

[[body]]
name = "arm"
chance = 0.7
shape = { any = ["arm", "leg"] }
sex = { any = ["female", "male"] }
grounding = { from = 30e-12, to = 300e-12, log = true }
pose = { position = [0, 0, { from = 0.2, to = 0.25 }], euler = [0, 90, { from = -30, to = 30 }] }
"""
CHIP = """
[readout]
chip = { any = ["fdc1004", "ad7746"] }
mode = "self"
latency = { from = 0.0, to = 0.01 }
noise = { white = { from = 1e-16, to = 1e-15, log = true } }

[randomisation]
gain = { mean = 1.0, sigma = 0.05 }
offset = { from = -1e-14, to = 1e-14 }
dead = 0.2
stuck = 0.1
"""
HEAD = """
name = "things"
design = "patch"
scenes = {count}
shard_size = 100
seed = {seed}
"""


def spec_of(folder: Path, text: str) -> scenes.Spec:
    file = folder / "spec.toml"
    file.write_text(text)
    return load_spec(file)


def rows_of(spec: scenes.Spec) -> list[dict[str, Any]]:
    out = spec.folder / "out"
    run(spec, out, workers=1)
    return pq.read_table(out / "data").to_pylist()  # type: ignore[no-any-return]


def random_leaves(value: Any, path: str) -> set[str]:
    """Names of what is random in a file, found by another walk than the generator's."""
    if isinstance(value, list):
        return set().union(*(random_leaves(v, f"{path}.{k}") for k, v in enumerate(value)))
    if not isinstance(value, dict):
        return set()
    if "from" in value:
        return {path}
    if "any" in value:
        kinds = {"number" if type(o) in (int, float) else type(o) for o in value["any"]}
        plain = len(kinds) == 1 and kinds <= {"number", str, bool}
        own = {path if plain else f"{path}.any"}
        for k, option in enumerate(value["any"]):
            nested = isinstance(option, dict) and "any" in option
            own |= random_leaves(option, f"{path}.any.{k}" if nested else path)
        return own
    out = set().union(*(random_leaves(v, f"{path}.{k}") for k, v in value.items()))
    return out | ({f"{path}.quaternion"} if value.get("quaternion") == "uniform" else set())


def body_of(row: dict[str, Any], slot: int) -> cs.Body | None:
    """A body from the columns alone."""
    one = {n: row[f"body_{n}"][slot] for n in ("present", "shape", "material", "grounding")}
    if not one["present"]:
        assert one["shape"] is None
        assert np.isnan(row["body_position"][3 * slot])
        return None
    size = row["body_size"][3 * slot : 3 * slot + 3]
    lengths = [v for v in size if not np.isnan(v)]
    kinds = {"capsule": cs.Capsule, "cylinder": cs.Cylinder}
    shape = cs.Box(lengths) if one["shape"] == "box" else kinds[one["shape"]](*lengths)
    pose = cs.Pose.from_unit(
        row["body_position"][3 * slot : 3 * slot + 3],
        row["body_quaternion"][4 * slot : 4 * slot + 4],
    )
    numbers = row["body_eps_r"][slot], row["body_sigma"][slot]
    matter = cs.Material("soap", *numbers) if one["material"] == "soap" else one["material"]
    earth, local = row["body_earth"][slot], row["body_local"][slot]
    grounding = {
        "capacitance": earth, "ties": Ties(earth, local) if 0 < earth < 1 else None
    }.get(one["grounding"], one["grounding"])  # fmt: skip
    conductor = row["body_conductor"][slot]
    return cs.Body(shape, pose, matter, grounding, conductor=conductor)


def text_of(count: int, seed: int = 3) -> str:
    return HEAD.format(count=count, seed=seed) + CHIP + BODIES


def test_each_random_value_has_a_column(tmp_path: Path) -> None:
    """What a walk over the file finds, what is drawn, and the columns are the same."""
    spec = spec_of(tmp_path, text_of(40))
    expected = {"body.box.present", "body.arm.present"}
    for raw in spec.bodies:
        expected |= random_leaves(dict(raw), f"body.{raw['name']}")
    expected |= random_leaves(spec.readout, "readout")
    assert len(expected) == 20
    columns = spec.columns()
    found = {name for name in columns if name.startswith(PREFIX)}
    assert found == {PREFIX + name for name in expected}
    rows = rows_of(spec)
    seen: set[str] = set()
    for row in rows:
        draw = spec.scene(row["scene"])[2]
        assert draw.drawn.items() <= row.items()
        seen |= {name for name in found if row[name] is not None}
        assert row["drawn.body.box.present"] == row["body_present"][spec.slots.index("box")]
    assert seen == found
    share = [row["drawn.body.box.present"] for row in rows]
    assert 10 < sum(share) < 36


def test_scenes_from_columns(tmp_path: Path) -> None:
    """Bodies made of the columns alone give the same matrix, to the last bit."""
    spec = spec_of(tmp_path, text_of(15))
    simulator = cs.Simulator("patch")
    kinds: set[str] = set()
    for row in rows_of(spec):
        bodies = [body_of(row, k) for k in range(len(spec.slots))]
        there = [b for b in bodies if b is not None]
        assert len(there) == row["bodies"]
        kinds |= {str(g) for g in row["body_grounding"]}
        reading = simulator.step(cs.Scene(there))
        assert reading.delta.ravel().tolist() == row["delta"]
    assert kinds == {"grounded", "floating", "ties", "capacitance", "None"}


def test_chips_from_columns(tmp_path: Path) -> None:
    """A chip made of the columns alone has the same figures, specimen and codes."""
    spec = spec_of(tmp_path, text_of(12))
    simulator = cs.Simulator("patch")
    names = simulator.electrode_names
    chips = set()
    for row in rows_of(spec):
        chips.add(row["chip"])
        seed = row["chip_seed"]
        content = {
            "chip": row["chip"], "mode": "self", "latency": row["drawn.readout.latency"],
            "noise": {"white": row["drawn.readout.noise.white"]}, "seed": seed,
        }  # fmt: skip
        made = parse_readout(content, names)
        assert made.dac is not None
        bits = made.dac.bits
        errors = np.reshape(row["dac_errors"], (len(names), -1))
        assert errors[:, :bits].tolist() == made.dac.specimens(len(names), seed).tolist()
        assert np.isnan(errors[:, bits:]).all()
        figures = {n: np.array(row[f"chip_{n}"]) for n in FIGURES}
        many = SideBySide(made, 1, seed=seed, randomisation=ReadoutRandomisation(**figures))
        period = 2 * made.schedule.period + made.schedule.lag
        matrices = [
            simulator.empty.capacitance,
            np.reshape(row["capacitance"], simulator.baseline.shape),
        ]
        shields = simulator.empty.self_capacitance - np.diag(matrices[0])
        for k, matrix in enumerate(matrices):
            change = row["self_delta"] - np.diag(np.reshape(row["delta"], matrix.shape)) if k else 0
            for t in (k * period, (k + 1) * period):
                held = many.sample(t, matrix[None, None], (shields + change)[None, None])
        assert np.abs(held.code[0, 0] - row["code"]).max() <= 1
        dead = np.array(row["chip_dead"])
        stuck = np.array(row["chip_stuck"])
        change = np.array(row["code_delta"])
        assert (change[stuck] == 0).all()
        assert (np.abs(change[dead]) < 1e-14).all()
    assert chips == {"fdc1004", "ad7746"}


def test_without_randomisation_the_readout_alone_is_told(tmp_path: Path) -> None:
    """One chip by name: its seed and specimen are columns, its figures are not."""
    head = HEAD.format(count=3, seed=1) + 'readout = "fdc1004"\n'
    body = BODIES[BODIES.index('[[body]]\nname = "box"') : BODIES.index('[[body]]\nname = "arm"')]
    spec = spec_of(tmp_path, head + body)
    rows = rows_of(spec)
    assert "chip_gain" not in rows[0]
    assert {row["chip"] for row in rows} == {"fdc1004"}
    assert len({row["chip_seed"] for row in rows}) == 3
    readout = build("fdc1004", cs.Simulator("patch").electrode_names)
    assert readout.dac is not None
    expected = readout.dac.specimens(4, rows[2]["chip_seed"])
    assert rows[2]["dac_errors"] == expected.ravel().tolist()


def test_columns_hold_for_common_libraries(tmp_path: Path) -> None:
    """pandas reads all columns, and one body's by themselves."""
    pandas = pytest.importorskip("pandas")
    spec = spec_of(tmp_path, text_of(5))
    rows_of(spec)
    frame = pandas.read_parquet(tmp_path / "out" / "data")
    assert np.stack(frame["body_position"]).shape == (5, 3 * len(spec.slots))
    assert frame["body_shape"][0][0] in ("cylinder", "capsule")
    alone = pandas.read_parquet(tmp_path / "out" / "data", columns=["body", "body_force"])
    assert list(alone.columns) == ["body", "body_force"]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"ad7746"]', '"mpr122"]', "mpr122"),
        ('mode = "self"\n', "", "give chips of one data set the same ones"),
        ("latency =", "latncy =", "unknown key 'latncy'"),
        ("latency =", "seed = 1\nlatency =", "seed is drawn for every scene"),
        ("dead = 0.2", "dead = 1.2", "from 0 to 1"),
        ("dead = 0.2", "daed = 0.2", "unknown key 'daed'"),
        ("mean = 1.0, sigma = 0.05", "mean = 1.0", "must be a number, a list, or"),
        ("mean = 1.0, sigma = 0.05", "from = 2.0, to = 1.0", "gain is"),
        ("dead = 0.2", "crosstalk = [0.1, 0.2]", "crosstalk"),
        ("[readout]", "[radeout]", "unknown key 'radeout'"),
    ],
)
def test_mistakes_about_chips(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in text_of(5)
    with pytest.raises(cs.CapSenseError, match=message):
        spec_of(tmp_path, text_of(5).replace(old, new))


def test_randomisation_needs_a_chip(tmp_path: Path) -> None:
    text = text_of(5)
    without = text[: text.index("[readout]")] + text[text.index("[randomisation]") :]
    with pytest.raises(cs.ScenarioError, match="give a readout, too"):
        spec_of(tmp_path, without)


SPANS = st.tuples(st.floats(0.5, 1.0), st.floats(1.0, 2.0)).map(
    lambda pair: {"from": pair[0], "to": pair[1]}
)
PLAIN = st.one_of(st.floats(0, 1), st.sampled_from(["steel", "wood"]), st.booleans(), SPANS)
VALUES = st.recursive(
    PLAIN,
    lambda inner: st.one_of(
        st.lists(inner, min_size=1, max_size=3),
        st.dictionaries(st.sampled_from(["name", "size", "material"]), inner, max_size=3),
        st.lists(inner, min_size=1, max_size=3).map(lambda options: {"any": options}),
        st.just({"position": [0, 0, 1], "quaternion": "uniform"}),
    ),
    max_leaves=12,
)


@given(st.dictionaries(st.sampled_from(["radius", "pose", "shape"]), VALUES), st.integers(0, 2**32))
@example({"radius": {"any": [0.0, 0.0, {"any": [0.0, "steel"]}]}}, 0)
@example({"radius": {"any": [{"any": [1.0, 2.0]}, {"any": [1.0, "steel"]}]}}, 0)
@settings(max_examples=200, deadline=None)
def test_whatever_is_drawn_is_noted(raw: dict[str, Any], seed: int) -> None:
    """Of any table: decided values are noted under columns that are known beforehand.

    Two draws that note the same decide the same.
    """
    table = ScenarioTable(raw, "spec.toml", "body")
    known = {name for key, v in raw.items() for name, _ in columns_of(v, table, f"body.{key}")}
    decided: dict[str, Any] = {}
    for number in range(5):
        draw = Draw(np.random.default_rng([seed, number]))
        out = draw.table(raw, table, "body")
        assert draw.drawn.keys() <= known
        assert "from" not in repr(out)
        assert "any" not in repr(out)
        assert decided.setdefault(repr(draw.drawn), repr(out)) == repr(out)
    assert known == {PREFIX + n for k, v in raw.items() for n in random_leaves(v, f"body.{k}")}
