"""Exports hold the numbers that were recorded, in the forms that runs have."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
import recorded_scenes

import capsense as cs
from capsense.__main__ import main
from capsense.errors import MissingDependencyError, RecordingError
from capsense.readout.conversions import join
from capsense.recording.export import export

ROOT = Path(__file__).parents[3]
Recorded = tuple[Path, list[cs.Reading]]


def columns(path: Path) -> dict[str, list[str]]:
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {name: [row[name] for row in rows] for name in rows[0]}


@pytest.mark.parametrize("excitation", ["matrix", "self", "mutual"])
def test_the_same_files_as_a_run(tmp_path: Path, excitation: str) -> None:
    """A recorded scenario, exported, is what capsense run writes; only step times differ."""
    text = (ROOT / "examples" / "hand_approach.toml").read_text(encoding="utf-8")
    scenario = tmp_path / "s.toml"
    lines = [line for line in text.splitlines() if not line.startswith("excitation")]
    scenario.write_text(f'excitation = "{excitation}"\n' + "\n".join(lines), encoding="utf-8")
    rate = ["--rate", "1", "--quiet"]
    assert main(["run", str(scenario), "-o", str(tmp_path / "run"), *rate]) == 0
    mcap = tmp_path / "r.mcap"
    assert main(["record", str(scenario), "-o", str(mcap), *rate]) == 0
    for ending in ("csv", "npz"):
        assert main(["export", str(mcap), "-o", str(tmp_path / f"readings.{ending}")]) == 0
    run = columns(tmp_path / "run" / "readings.csv")
    mine = columns(tmp_path / "readings.csv")
    assert set(mine.pop("episode")) == {"0"}
    assert mine == run
    a, b = (dict(np.load(p / "readings.npz")) for p in (tmp_path / "run", tmp_path))
    assert (b.pop("episode") == 0).all()
    assert a.keys() == b.keys()
    for name in a.keys() - {"step_time"}:
        np.testing.assert_array_equal(b[name], a[name], err_msg=name)


def test_arrays(recorded: Recorded, tmp_path: Path) -> None:
    """Bodies that are not there stand at NaN; the counts lie beside the readings."""
    path, readings = recorded
    assert export(cs.open_recording(path), tmp_path / "a.npz") == 12
    a = dict(np.load(tmp_path / "a.npz"))
    assert a["episode"].tolist() == [0] * 8 + [1] * 4
    assert (np.diff(a["time"]) > 0).all()
    np.testing.assert_array_equal(a["delta"], [r.delta for r in readings])
    names = a["body_names"].tolist()
    assert names[:6] == ["box", "ball", "finger", "rod", "body4", "wedge"]
    for k in range(8):
        scene = recorded_scenes.scene_at(k)
        there = {b.name or f"body{i}": b.pose for i, b in enumerate(scene)}
        for name, place in zip(names, a["body_positions"][k], strict=True):
            if name in there:
                assert tuple(place) == there[name].position
            else:
                assert np.isnan(place).all()
    counts = join([r.counts for r in readings if r.counts is not None])
    np.testing.assert_array_equal(a["counts_code"], counts.code)
    np.testing.assert_array_equal(a["counts_time_s"], counts.time)


def test_readout_takes_an_export(recorded: Recorded, tmp_path: Path) -> None:
    for ending in (".npz", ".csv"):
        path = tmp_path / f"a{ending}"
        export(cs.open_recording(recorded[0]), path)
        assert main(["readout", str(path), "--chip", "ad7746", "--force"]) == 0
        assert (tmp_path / "counts_ad7746.csv").stat().st_size > 100


def test_parquet(recorded: Recorded, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs pip install 'capsense[record]'")
    path, readings = recorded
    recording = cs.open_recording(path)
    assert export(recording, tmp_path / "a.parquet") == 12
    table = parquet.read_table(tmp_path / "a.parquet")
    export(recording, tmp_path / "a.csv")
    assert table.column_names == list(columns(tmp_path / "a.csv"))
    assert table["C_E1_E2_F"].to_pylist() == [r.capacitance[0, 1] for r in readings]
    assert table["episode"].to_pylist() == [0] * 8 + [1] * 4
    assert table.schema.field("C_E1_E2_F").metadata[b"meaning"].startswith(b"entry (E1, E2)")
    counts = join([r.counts for r in readings if r.counts is not None])
    assert export(recording, tmp_path / "c.parquet", counts=True) == len(counts)
    table = parquet.read_table(tmp_path / "c.parquet")
    assert table["code"].to_pylist() == counts.code.tolist()
    assert set(table["channel"].to_pylist()) == set(counts.channel_names)
    export(recording, tmp_path / "c.csv", counts=True)
    assert columns(tmp_path / "c.csv")["code"] == [str(c) for c in counts.code]


def test_a_file_cut_short_is_made_whole(recorded: Recorded, tmp_path: Path) -> None:
    from mcap.reader import make_reader

    content = recorded[0].read_bytes()
    part, whole = tmp_path / "part.mcap", tmp_path / "whole.mcap"
    part.write_bytes(content[:-9])
    assert main(["export", str(part), "-o", str(whole)]) == 0
    recording = cs.open_recording(whole)
    assert recording.complete
    assert cs.replay(recording).same
    with whole.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary, header = reader.get_summary(), reader.get_header()
    assert header.profile == "ros2"
    assert summary is not None
    assert summary.statistics is not None
    with recorded[0].open("rb") as file:
        original = make_reader(file).get_summary()
    assert original is not None
    assert original.statistics is not None
    assert summary.statistics.message_count == original.statistics.message_count
    assert {c.topic: c.metadata for c in summary.channels.values()} == {
        c.topic: c.metadata for c in original.channels.values()
    }


def test_refusals(
    recorded: Recorded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sim: cs.Simulator
) -> None:
    recording = cs.open_recording(recorded[0])
    with pytest.raises(RecordingError, match=r"must end in .csv, .npz, .parquet, .mcap"):
        export(recording, tmp_path / "a.xlsx")
    with pytest.raises(RecordingError, match=r"counts alone go to .csv or .parquet"):
        export(recording, tmp_path / "a.npz", counts=True)
    monkeypatch.setitem(__import__("sys").modules, "pyarrow.parquet", None)
    with pytest.raises(MissingDependencyError, match=r"capsense\[record\]"):
        export(recording, tmp_path / "a.parquet")
    cs.record(tmp_path / "empty.mcap", sim).close()
    empty = cs.open_recording(tmp_path / "empty.mcap")
    with pytest.raises(RecordingError, match="no steps"):
        export(empty, tmp_path / "a.npz")
    with pytest.raises(RecordingError, match="no counts"):
        export(empty, tmp_path / "a.csv", counts=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["empty.mcap"]
