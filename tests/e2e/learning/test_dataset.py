"""Data sets: scenes by number alone, labels that are right, shards that are whole or not there."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import re
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from approximate import approx

import capsense as cs
from capsense.__main__ import main
from capsense.errors import MissingDependencyError
from capsense.learning.labels import Outline
from capsense.learning.scenes import COLUMNS, Spec, load_spec
from capsense.learning.shards import missing, run

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

SPEC = """
name = "balls"
design = "patch"
readout = "ad7747"
scenes = 11
shard_size = 3
seed = 5

[[body]]
name = "ball"
shape = "sphere"
radius = { from = 0.01, to = 0.03 }
material = { any = ["steel", { name = "soap", eps_r = { from = 2, to = 20, log = true } }] }
pose = { position = [{ from = -0.05, to = 0.05 }, 0.0, { from = 0.02, to = 0.1 }] }

[[body]]
name = "rod"
chance = 0.5
shape = "capsule"
radius = { from = 0.01, to = 0.02, steps = 3 }
length = 0.1
material = "steel"
pose = { position = [0, 0, 0.15], quaternion = "uniform" }
"""
POSITION = "position = [{ from = -0.05, to = 0.05 }, 0.0, { from = 0.02, to = 0.1 }]"


def spec_of(folder: Path, text: str = SPEC) -> Spec:
    file = folder / "spec.toml"
    file.write_text(text)
    return load_spec(file)


def contents(spec: Spec, folder: Path) -> list[bytes]:
    return [(folder / spec.file(k)).read_bytes() for k in range(spec.shards)]


def poses(spec: Spec, number: int) -> list[object]:
    return [(b.pose, b.material, b.shape) for b in spec.scene(number)[0]]


def test_scene_depends_on_seed_and_number_alone(tmp_path: Path) -> None:
    spec = spec_of(tmp_path)
    first = [poses(spec, k) for k in range(11)]
    again = spec_of(tmp_path)
    assert [poses(again, k) for k in reversed(range(11))] == first[::-1]
    other = spec_of(tmp_path, SPEC.replace("seed = 5", "seed = 6"))
    assert all(poses(other, k) != scene for k, scene in enumerate(first))
    assert {len(scene) for scene in first} == {1, 2}
    radii = {s.radius for k in range(200) for _, _, s in poses(spec, k)[1:]}  # type: ignore[attr-defined]
    assert sorted(radii) == approx([0.01, 0.015, 0.02])


def test_ranges_are_drawn_as_told(tmp_path: Path) -> None:
    """Uniform, and uniform in the logarithm."""
    spec = spec_of(tmp_path)
    balls = [spec.scene(k)[0]["ball"] for k in range(600)]
    radius = np.array([b.shape.radius for b in balls])  # type: ignore[attr-defined]
    assert radius.min() > 0.01
    assert radius.max() < 0.03
    assert radius.mean() == approx(0.02, abs=0.001)
    logs = np.log([b.material.eps_r for b in balls if b.material.name == "soap"])
    assert 200 < len(logs) < 400
    assert logs.mean() == approx(np.log(np.sqrt(40)), abs=0.12)


def test_labels_of_simple_bodies() -> None:
    """Nearest points that can be told by hand, over the patch, beside it, and of a tilted rod."""
    outline = Outline(cs.load_design("six_patch"))
    ball = cs.Body(cs.Sphere(0.02), cs.Pose((0.041, 0.027, 0.06)))
    near = outline.nearest(
        cs.Scene([cs.Body(cs.Box((0.1, 0.1, 0.02)), cs.Pose((0, 0, 0.2))), ball])
    )
    assert near is not None
    assert near.body is ball
    assert near.axis is None
    assert near.distance == approx(0.04, abs=1e-9)
    assert near.point == approx([0.041, 0.027, 0.04], abs=1e-7)
    assert near.normal == approx([0, 0, -1], abs=1e-6)
    aside = outline.nearest(cs.Scene([cs.Body(cs.Sphere(0.02), cs.Pose((0.153, 0.0, 0.1)))]))
    assert aside is not None  # the nearest corner of E3 or E6: (0.053, ±0.01, 0)
    assert aside.distance == approx(np.sqrt(0.1**2 + 0.1**2 + 0.01**2) - 0.02, abs=1e-7)
    rod = cs.Body(
        cs.Capsule(0.01, 0.1), cs.Pose.from_euler((0, 0, 0.05), (0, 90, 30), degrees=True)
    )
    found = outline.nearest(cs.Scene([rod]))
    assert found is not None
    assert found.axis == approx([np.cos(np.pi / 6), 0.5, 0])
    assert found.distance == approx(0.04, abs=1e-6)
    assert outline.nearest(cs.Scene()) is None


def test_clearance(tmp_path: Path) -> None:
    """Scenes that touch are drawn again; where all do, that is an error."""
    spec = spec_of(tmp_path, SPEC.replace("to = 0.1 }]", "to = 0.04 }]"))
    gaps = [spec.outline.gap(spec.scene(k)[0]) for k in range(100)]
    assert min(gaps) >= 1e-3
    with pytest.raises(cs.ScenarioError, match="scene 0 came within clearance"):
        spec_of(tmp_path, SPEC.replace(POSITION, "position = [0, 0, 0.005]"))


def test_limb_stands_where_its_segment_is_put(tmp_path: Path) -> None:
    text = (
        SPEC[: SPEC.index("[[body]]")]
        + """
[[body]]
name = "person"
shape = "arm"
angles = { elbow_flexion = 40 }
pose = { position = [0, 0, 0.1], euler = [0, 90, 0] }
"""
    )
    scene = spec_of(tmp_path, text).scene(0)[0]
    forearm = [b for b in scene if str(b.name).startswith("person_forearm")]
    ends = np.concatenate([
        b.pose.apply([[0, 0, s * b.shape.length / 2] for s in (-1, 1)])  # type: ignore[attr-defined]
        for b in forearm
    ])  # fmt: skip
    assert 0.5 * (ends.min(axis=0) + ends.max(axis=0)) == approx([0, 0, 0.1], abs=1e-12)
    assert np.ptp(ends, axis=0)[1:] == approx([0, 0], abs=1e-12)
    assert scene["person_upper_arm_1"].pose.rotation[:, 2] @ forearm[0].pose.rotation[:, 2] == (
        approx(np.cos(np.radians(40)))
    )


def test_shards_are_the_same_wherever_they_are_made(tmp_path: Path) -> None:
    """In parts, resumed, and over a shard that was cut off; the manifest tells their hashes."""
    spec = spec_of(tmp_path)
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    sizes: list[int] = []
    assert run(spec, whole, workers=1, each=sizes.append) == 11
    assert sizes == [3, 3, 3, 2]
    expected = contents(spec, whole)
    assert run(spec, parts, part=(1, 3), workers=1) == 3
    assert not json.loads((parts / "manifest.json").read_text())["complete"]
    assert missing(spec, parts) == [0, 2, 3]
    assert run(spec, parts, workers=1) == 8
    assert contents(spec, parts) == expected
    (parts / spec.file(2)).write_bytes(expected[2][:1000])
    (parts / spec.file(0)).unlink()
    assert run(spec, parts, workers=2) == 6
    assert contents(spec, parts) == expected
    told = json.loads((parts / "manifest.json").read_text())
    assert told["complete"]
    assert [s["sha256"] for s in told["shards"]] == [
        hashlib.sha256(data).hexdigest() for data in expected
    ]
    assert told["settings"]["design"] == spec.design.content_hash()
    assert told["settings"]["seed"] == 5
    assert len(told["versions"]) == 1
    assert not [p for p in parts.rglob("*") if p.name.endswith(".part")]


def test_a_late_start_leaves_a_complete_manifest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A job that finds no manifest, and dies after others have completed the set meanwhile."""
    spec, out, about = spec_of(tmp_path), tmp_path / "out", Spec.about

    def die(*_: object) -> None:
        raise KeyboardInterrupt

    def late(self: Spec) -> dict[str, Any]:
        monkeypatch.setattr(Spec, "about", about)
        assert run(spec_of(tmp_path), out, workers=1) == 11
        monkeypatch.setattr(Spec, "finish", die)
        return about(self)

    monkeypatch.setattr(Spec, "about", late)
    with pytest.raises(KeyboardInterrupt):
        run(spec, out, workers=1)
    assert json.loads((out / "manifest.json").read_text())["complete"]


def test_a_shard_that_fails_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = spec_of(tmp_path)

    def half(table: object, path: Path) -> None:
        path.write_bytes(b"PAR1")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pyarrow.parquet.write_table", half)
    with pytest.raises(OSError, match="No space"):
        run(spec, tmp_path / "out", workers=1)
    assert not list((tmp_path / "out" / "data").iterdir())


def test_killed_processes_are_told_of(tmp_path: Path) -> None:
    """What they had completed is kept, and the same call makes the rest."""
    spec = spec_of(tmp_path, SPEC.replace("shard_size = 3", "shard_size = 1"))

    def kill(_: int) -> None:
        for child in multiprocessing.active_children():
            child.kill()

    with pytest.raises(ChildProcessError, match="run it again"):
        run(spec, tmp_path / "out", workers=2, each=kill)
    assert 0 < len(left := missing(spec, tmp_path / "out")) < 11
    assert run(spec, tmp_path / "out", workers=1) == len(left)


def test_another_data_set_is_refused(tmp_path: Path) -> None:
    spec = spec_of(tmp_path)
    run(spec, tmp_path / "out", part=(0, 4), workers=1)
    other = spec_of(tmp_path, SPEC.replace("seed = 5", "seed = 6"))
    with pytest.raises(cs.ScenarioError, match="of other settings"):
        run(other, tmp_path / "out")
    (tmp_path / "out" / "manifest.json").unlink()
    with pytest.raises(cs.ScenarioError, match="of other settings"):
        run(other, tmp_path / "out")


def test_columns_in_pandas(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What the command writes is what the simulator reads; pandas needs no help."""
    pandas = pytest.importorskip("pandas")
    spec = spec_of(tmp_path)
    out = tmp_path / "out"
    assert main(["dataset", str(tmp_path / "spec.toml"), "-o", str(out), "--workers", "1"]) == 0
    assert "11 scenes in" in (text := capsys.readouterr().out)
    assert text.rstrip().endswith("complete")
    frame = pandas.read_parquet(out / "data")
    assert frame["scene"].tolist() == list(range(11))
    told = json.loads((out / "manifest.json").read_text())
    simulator = cs.Simulator("patch")
    np.testing.assert_array_equal(told["baseline_F"], simulator.baseline)
    shape = (-1, *simulator.baseline.shape)
    matrices = np.stack(frame["capacitance"]).reshape(shape)
    changes = np.stack(frame["delta"]).reshape(shape)
    assert matrices - simulator.baseline == approx(changes, abs=1e-25)
    for k in (0, 4, 10):
        scene, near, _ = spec.scene(k)
        np.testing.assert_array_equal(changes[k], simulator.step(scene).delta)
        assert near is not None
        row = frame.iloc[k]
        assert (row["body"], row["distance"]) == (near.body.name, near.distance)
        assert (row["material"], row["eps_r"]) == (
            near.body.material.name,
            near.body.material.eps_r,
        )
        assert row["bodies"] == len(scene)
        assert (row["axis"] is None) == (near.axis is None)
    # an AD7747 drives the shield; its noise and its codes are parts of a femtofarad
    told, felt = (np.stack(frame[name])[:, 0] for name in ("code_delta", "self_delta"))
    assert len(np.unique(told - felt)) == 11
    assert np.ptp(felt) > 5e-16
    assert told == approx(felt, abs=0.5e-15)


def test_datasets_of_hugging_face(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    datasets = pytest.importorskip("datasets")
    spec = spec_of(tmp_path)
    run(spec, tmp_path / "out", workers=1)
    found = datasets.load_dataset(str(tmp_path / "out"), cache_dir=str(tmp_path / "cache"))
    assert list(found) == ["train"]
    assert len(found["train"]) == 11
    assert found["train"].features["closest_point"].length == 3
    table = pq.read_table(tmp_path / "out" / "data").to_pylist()
    assert found["train"][7]["closest_point"] == table[7]["closest_point"]


def test_a_killed_worker_of_a_cluster_loses_nothing(tmp_path: Path) -> None:
    """Its shards are given to another; the files are those of one process."""
    distributed = pytest.importorskip("distributed")
    spec = spec_of(tmp_path)
    run(spec, tmp_path / "here", workers=1)
    killed: list[int] = []
    options = {"threads_per_worker": 1, "dashboard_address": None, "local_directory": tmp_path}
    with distributed.LocalCluster(2, **options) as cluster, distributed.Client(cluster) as client:

        def kill(_: int) -> None:
            if not killed:
                killed.extend(client.run(os.getpid).values())
                os.kill(killed[0], signal.SIGKILL)

        run(spec, tmp_path / "out", scheduler=cluster.scheduler_address, each=kill)
    assert killed
    assert contents(spec, tmp_path / "out") == contents(spec, tmp_path / "here")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("seed = 5", "sed = 5", "unknown key 'sed'"),
        ("from = 0.01, to = 0.03", "from = 0.03, to = 0.01", "to = 0.01 must be from 0.03"),
        ("from = 0.01, to = 0.03", "from = 0.01", "missing key 'to'"),
        ("any = [", "any = [], x = [", "must be { any ="),
        ("steps = 3", "steps = 1", "steps = 1 must be an integer from 2"),
        ('shape = "sphere"', 'shape = "spere"', "shape = 'spere' is not known"),
        ("chance = 0.5", "chance = 1.5", "chance = 1.5 must be from 0 to 1"),
        ('name = "rod"', 'name = "ball"', "names of bodies repeat"),
        ('design = "patch"', 'design = "pacth"', "pacth"),
        ("pose = { position = [0, 0, 0.15]", "pos = { position = [0, 0, 0.15]", "key 'pose'"),
    ],
)
def test_mistakes_in_the_file(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(cs.ScenarioError, match=message.replace("{", r"\{").replace("[", r"\[")):
        spec_of(tmp_path, SPEC.replace(old, new))


@pytest.mark.parametrize("text", ["3/3", "1", "-1/4", "a/b"])
def test_shards_that_are_not(text: str) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["dataset", "spec.toml", "-o", "out", f"--shard={text}"])
    assert stopped.value.code == 2


@pytest.mark.parametrize(
    ("module", "extra", "options"),
    [("pyarrow.parquet", "dataset", {}), ("distributed", "cluster", {"scheduler": "tcp://x:1"})],
)
def test_what_is_not_installed_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str, extra: str, options: Any
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingDependencyError, match=rf"capsense\[{extra}\]"):
        run(spec_of(tmp_path), tmp_path / "out", **options)


def test_no_scheduler_there(tmp_path: Path) -> None:
    dask = pytest.importorskip("dask")
    with dask.config.set({"distributed.comm.timeouts.connect": "0.3s"}):
        spec = spec_of(tmp_path)
        with pytest.raises(cs.AdapterError, match="no Dask scheduler answers"):
            run(spec, tmp_path / "out", scheduler="tcp://127.0.0.1:9")


def test_example_holds() -> None:
    spec = load_spec(Path(__file__).parents[3] / "examples" / "datasets" / "forearms.toml")
    assert spec.shards == 20
    assert spec.scene(9999)[1] is not None


def test_the_page_s_file_holds(tmp_path: Path) -> None:
    """What the page shows is a data set, and its table of columns is that of the files."""
    page = (Path(__file__).parents[3] / "docs" / "learning.md").read_text(encoding="utf-8")
    text = page.partition("```toml\n")[2].partition("```")[0]
    assert spec_of(tmp_path, text).shards == 100
    table = page.partition("### Columns")[2].partition("Lists have")[0]
    named = re.findall(
        r"`(\w+)`",
        "\n".join(row.split("|")[1] for row in table.splitlines() if row.startswith("|")),
    )
    assert named == list(COLUMNS)
