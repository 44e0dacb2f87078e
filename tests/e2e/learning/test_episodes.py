"""Episodes as LeRobot data sets: the layout of its version 3.0, the same wherever they are made."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from approximate import approx

import capsense as cs
from capsense.__main__ import main
from capsense.learning.episodes import Episodes, load_episodes
from capsense.learning.shards import missing, run
from capsense.readout.calibration import LinearSensor

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")
gymnasium = pytest.importorskip("gymnasium")
pytest.importorskip("mujoco")

SPEC = """
name = "short rides"
environment = "capsense/LimbFollow-v0"
task = "fly away from a forearm"
policy = "away.py:act"
noise = 0.1
episodes = 5
shard_size = 2
steps = 19
seed = 5

[options.randomisation]
girth = [0.9, 1.1]
"""
ROOT = Path(__file__).parents[3]
AWAY = "def act(observation):\n    return [0.0, 0.2, 1.0, 0.0, 0.0]\n"
"""Some episodes end early, as the pad is lost."""


def spec_of(folder: Path, text: str = SPEC) -> Episodes:
    (folder / "away.py").write_text(AWAY)
    (folder / "spec.toml").write_text(text)
    return load_episodes(folder / "spec.toml")


def contents(folder: Path) -> dict[str, str]:
    """Hashes of all files but the manifest."""
    return {
        str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in folder.rglob("*")
        if p.is_file() and p.name != "manifest.json"
    }


def column(table: Any, name: str) -> np.ndarray:
    return np.array(table.column(name).to_pylist())


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("episodes")
    assert run(spec_of(folder), folder / "out", workers=1) == 5
    return folder / "out"


def test_layout(made: Path) -> None:
    """Files, counts and ranges as LeRobot's documentation lays them out."""
    info = json.loads((made / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert info["fps"] == 25
    assert (info["total_episodes"], info["total_tasks"]) == (5, 1)
    assert info["splits"] == {"train": "0:5"}
    episodes = pq.read_table(made / "meta/episodes/chunk-000/file-000.parquet")
    starts, ends = (column(episodes, f"dataset_{w}_index") for w in ("from", "to"))
    lengths = column(episodes, "length")
    assert len(set(lengths)) > 1
    assert lengths.max() == 19
    np.testing.assert_array_equal(ends - starts, lengths)
    np.testing.assert_array_equal(starts[1:], ends[:-1])
    assert ends[-1] == info["total_frames"]
    for row in episodes.to_pylist():
        path = info["data_path"].format(
            chunk_index=row["data/chunk_index"], file_index=row["data/file_index"]
        )
        table = pq.read_table(made / path)
        mine = table.filter(pa.compute.equal(table["episode_index"], row["episode_index"]))
        first, count = row["dataset_from_index"], row["length"]
        np.testing.assert_array_equal(column(mine, "index"), first + np.arange(count))
        np.testing.assert_array_equal(column(mine, "frame_index"), np.arange(count))
        np.testing.assert_allclose(column(mine, "timestamp"), np.arange(count) / 25, rtol=1e-6)
        assert column(mine, "next.done").tolist() == [False] * (count - 1) + [True]
        assert row["tasks"] == ["fly away from a forearm"]
        state = column(mine, "observation.state")
        np.testing.assert_allclose(row["stats/observation.state/mean"], state.mean(axis=0))
        for name, told in info["features"].items():
            kind = mine.schema.field(name).type
            size = kind.list_size if pa.types.is_fixed_size_list(kind) else 1
            assert told["shape"] == [size]
            inner = str(kind.value_type if size > 1 else kind)
            assert inner == {"float32": "float"}.get(told["dtype"], told["dtype"])
            assert told["names"] is None or len(told["names"]) == size
    assert sorted(mine.column_names) == sorted(info["features"])


def test_statistics_are_those_of_all_frames(made: Path) -> None:
    stats = json.loads((made / "meta/stats.json").read_text())
    actions = column(pq.read_table(made / "data"), "action").astype(float)
    assert stats["action"]["count"] == [len(actions)]
    for name, expected in {
        "min": actions.min(axis=0), "mean": actions.mean(axis=0), "std": actions.std(axis=0),
        "q10": np.quantile(actions, 0.1, axis=0), "q99": np.quantile(actions, 0.99, axis=0),
    }.items():  # fmt: skip
        np.testing.assert_allclose(stats["action"][name], expected)


def test_frames_are_those_of_the_environment(made: Path) -> None:
    """The same seed and actions give the same observations and rewards."""
    spec = load_episodes(made.parent / "spec.toml")
    table = pq.read_table(made / spec.file(1))
    mine = table.filter(pa.compute.equal(table["episode_index"], 3))
    env = spec.make()
    rng = np.random.default_rng(np.random.SeedSequence((5, 3)))
    seed = int(rng.integers(2**31))
    observation, _ = env.reset(seed=seed)
    drawn = env.unwrapped.drawn
    expected = {f.name: getattr(drawn, f.name) for f in dataclasses.fields(drawn)}
    assert len(expected) == 11
    (gain,) = {
        float(stage.gain)
        for chip in env.unwrapped.signals.readouts.values()
        for stage in chip.stages
        if isinstance(stage, LinearSensor)
    }
    for row in mine.to_pylist():
        assert row["drawn.seed"] == seed
        for name, value in expected.items():
            assert row[f"drawn.{name}"] == approx(value, rel=1e-6)
        assert row["drawn.chip_gain"] == [approx(gain, rel=1e-6)] * 6
        np.testing.assert_array_equal(row["observation.state"], observation)
        observation, reward, over, cut, facts = env.step(np.array(row["action"], np.float32))
        assert row["next.reward"] == approx(reward, rel=1e-6)
        assert row["next.error"] == approx(facts["error"], rel=1e-6)
        assert row["next.done"] == (over or cut)


def test_shards_are_the_same_wherever_they_are_made(made: Path, tmp_path: Path) -> None:
    """In parts, out of order, and where one was lost; by the command as well."""
    spec, out = spec_of(tmp_path), tmp_path / "out"
    file = str(tmp_path / "spec.toml")
    assert main(["dataset", file, "-o", str(out), "--shard", "2/3", "--quiet"]) == 0
    assert missing(spec, out) == [0, 1]
    assert not (out / "meta").exists()
    assert run(spec, out, workers=1) == 4
    assert contents(out) == contents(made)
    (out / spec.file(1)).unlink()
    (out / "meta/info.json").unlink()
    assert run(spec, out, workers=1) == 2
    assert contents(out) == contents(made)
    assert json.loads((out / "manifest.json").read_text())["complete"]


def test_hugging_face_and_pandas(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    pandas = pytest.importorskip("pandas")
    tasks = pandas.read_parquet(made / "meta/tasks.parquet")
    assert tasks.index.tolist() == ["fly away from a forearm"]
    assert tasks.loc["fly away from a forearm"].task_index == 0
    datasets = pytest.importorskip("datasets")
    found = datasets.load_dataset(str(made), cache_dir=str(tmp_path))["train"]
    assert found.features["observation.state"].length == 22
    assert found["index"][:] == list(range(len(found)))


def test_lerobot_reads_it(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    lerobot = pytest.importorskip("lerobot.datasets.lerobot_dataset")
    found = lerobot.LeRobotDataset(
        "capsense/test", root=made, episodes=[3], delta_timestamps={"action": [0.0, 0.04]}
    )
    assert found[0]["action"].shape == (2, 5)
    assert int(found[0]["episode_index"]) == 3
    assert found[0]["task"] == "fly away from a forearm"


def test_a_policy_that_changed_is_another_data_set(tmp_path: Path) -> None:
    before = spec_of(tmp_path).identity
    (tmp_path / "away.py").write_text(AWAY.replace("1.0", "0.9"))
    assert load_episodes(tmp_path / "spec.toml").identity != before


def test_the_page_s_file_and_the_example_hold(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "learning.md").read_text(encoding="utf-8")
    text = page.partition("### Episodes for LeRobot")[2].partition("```toml\n")[2]
    shutil.copy(ROOT / "examples" / "policies.py", tmp_path)
    shown = spec_of(tmp_path, text.partition("```")[0])
    example = load_episodes(ROOT / "examples" / "datasets" / "follow.toml")
    assert shown.count == example.count == 1000
    assert {**shown.settings, "policy": "", "files": {}} == {
        **example.settings, "policy": "", "files": {},
    }  # fmt: skip


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("steps = 19", "step = 19", "unknown key 'step'"),
        ("LimbFollow-v0", "LimbFolow-v0", "cannot be made"),
        ("capsense/LimbFollow-v0", "CartPole-v1", "unexpected keyword argument .randomisation"),
        ("girth = [0.9", "girh = [0.9", "no range 'girh'; did you mean 'girth'"),
        ("away.py:act", "away.py:fly", "away.py has no function 'fly'"),
        ("away.py:act", "gone.py:act", r'"FILE.py:FUNCTION" with a file in'),
    ],
)
def test_mistakes_in_the_file(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises((cs.ScenarioError, cs.SceneError), match=message):
        spec_of(tmp_path, SPEC.replace(old, new))
