"""``capsense readout``: recordings in, tables and pictures out, refusals."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from approximate import approx
from ball_scenario import ball_scenario
from maxwell import random_maxwell

from capsense.__main__ import main
from capsense.cli import BAD_INPUT, OK
from capsense.errors import ReadoutError
from capsense.readout import Readout
from capsense.readout.channels import ChannelBank, mutual_patterns, self_patterns
from capsense.readout.presets import CHIPS
from capsense.readout.recording import load_recording


@pytest.fixture(scope="module")
def originals(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where runs are kept, so that each is made once."""
    return tmp_path_factory.mktemp("originals")


@pytest.fixture
def run(fake: object, originals: Path, tmp_path: Path):
    """Runs a scenario with the stand-in for the simulator; gives a copy of its output folder."""

    def make(excitation: str = "matrix") -> Path:
        original, folder = originals / excitation, tmp_path / excitation
        if not original.exists():
            scenario = originals / f"{excitation}.toml"
            scenario.write_text(ball_scenario(excitation, sample_rate=20.0), encoding="utf-8")
            assert main(["run", str(scenario), "-o", str(original), "-q"]) == OK
        shutil.copytree(original, folder)
        return folder

    return make


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_recordings_read_out_as_runs(tmp_path: Path, capsys) -> None:
    """Differential: the counts of an .mcap file are those of the same run, to the last digit."""
    scenario, recording = tmp_path / "ball.toml", tmp_path / "ball.mcap"
    scenario.write_text(ball_scenario(), encoding="utf-8")
    options = ["--chip", "fdc1004", "--seed", "3"]
    assert main(["run", str(scenario), "-o", str(tmp_path / "run"), "-q"]) == OK
    assert main(["readout", str(tmp_path / "run"), *options]) == OK
    assert main(["record", str(scenario), "-o", str(recording), "-q"]) == OK
    assert main(["readout", str(recording), *options]) == OK
    name = "counts_fdc1004.csv"
    assert (tmp_path / name).read_bytes() == (tmp_path / "run" / name).read_bytes()
    capsys.readouterr()
    assert main(["readout", str(recording), *options, "--sensor", "other"]) == BAD_INPUT
    assert "has no sensor 'other'" in capsys.readouterr().err
    assert main(["readout", str(tmp_path / "run"), *options, "--sensor", "a"]) == BAD_INPUT
    assert "--sensor goes with an .mcap file" in capsys.readouterr().err


def test_tables_hold_what_python_gives(run, capsys):
    """Differential: the command's table against the readout called directly."""
    folder = run()
    assert main(["readout", str(folder), "--chip", "fdc1004", "--rate", "400", "--seed", "3"]) == OK
    rows = table(folder / "counts_fdc1004.csv")
    data = np.load(folder / "readings.npz")
    names = tuple(str(n) for n in data["electrode_names"])
    readout = Readout.preset("fdc1004", names, rate=400, seed=3)
    counts = readout(data["time"], data["capacitance"])
    assert len(rows) == len(counts) > 300
    assert [int(r["code"]) for r in rows] == counts.code.tolist()
    assert [r["channel"] for r in rows] == [names[c] for c in counts.channel]
    assert [float(r["time_s"]) for r in rows] == approx(counts.time, abs=1e-9)
    assert "E1" in capsys.readouterr().out


@pytest.mark.parametrize("excitation", ["matrix", "self", "mutual"])
def test_arrays_and_table_are_the_same_recording(run, excitation):
    """Differential: .npz, .csv and folder; the empty scene too. Excitations keep their channels."""
    folder = run(excitation)
    arrays, rows = load_recording(folder), load_recording(folder / "readings.csv")
    assert arrays.path.name == "readings.npz"
    assert arrays.electrodes == rows.electrodes
    patterns = mutual_patterns if excitation == "mutual" else self_patterns
    bank = ChannelBank(patterns(arrays.electrodes), arrays.electrodes)
    assert np.abs(arrays.channels(bank) - rows.channels(bank)).max() < 1e-9 * 5e-12
    assert np.abs(arrays.empty_channels(bank) - rows.empty_channels(bank)).max() < 1e-9 * 5e-12


def test_matrices_are_put_together_right(tmp_path):
    """Round trip: a table of the upper triangle, with names that hold underscores."""
    names = ("top_left", "b", "top")
    rng = np.random.default_rng(0)
    matrices = [random_maxwell(rng, 3) for _ in range(4)]
    pairs = [(i, j) for i in range(3) for j in range(i, 3)]
    lines = ["time_s," + ",".join(f"C_{names[i]}_{names[j]}_F" for i, j in pairs)]
    lines += [
        f"{0.1 * k}," + ",".join(repr(float(c[p])) for p in pairs) for k, c in enumerate(matrices)
    ]
    path = tmp_path / "readings.csv"
    path.write_text("\n".join(lines) + "\n0.4,1e-1", encoding="utf-8")  # and half a line
    recording = load_recording(path)
    assert recording.electrodes == names
    bank = ChannelBank(mutual_patterns(names), names)
    expected = [[-c[i, j] for i, j in pairs if i != j] for c in matrices]
    assert recording.channels(bank) == approx(np.array(expected), rel=1e-12, abs=0)
    assert (recording.empty_channels(bank) == recording.channels(bank)[0]).all()


def test_shields_count_as_recorded(run):
    """A self recording holds what shields do; self channels are read from it."""
    folder = run("self")
    recording = load_recording(folder)
    bank = ChannelBank(self_patterns(recording.electrodes), recording.electrodes)
    columns = np.stack([recording.columns[f"C_{n}"] for n in recording.electrodes], axis=1)
    assert recording.channels(bank) == approx(columns, rel=1e-12, abs=0)


def test_driven_shields_are_read_from_a_matrix_recording(run):
    """Self channels drive the shields along: the arrays say what that gives, a table does not."""
    folder = run()
    with np.load(folder / "readings.npz") as data:
        arrays = dict(data)
    arrays["self_capacitance"] = 0.2 * np.diagonal(arrays["capacitance"], axis1=1, axis2=2)
    arrays["self_baseline"] = 0.2 * np.diag(arrays["baseline"])
    np.savez(folder / "readings.npz", **arrays)
    recording = load_recording(folder)
    driven = ChannelBank(self_patterns(recording.electrodes), recording.electrodes)
    assert recording.channels(driven) == approx(arrays["self_capacitance"], rel=1e-12)
    assert recording.empty_channels(driven) == approx(arrays["self_baseline"], rel=1e-12)
    summary = json.loads((folder / "summary.json").read_text("utf-8"))
    (folder / "summary.json").write_text(json.dumps({**summary, "shields": 1}), "utf-8")
    table = load_recording(folder / "readings.csv")
    with pytest.raises(ReadoutError, match="what the sensor's shields do when they are driven"):
        table.channels(driven)
    still = ChannelBank(self_patterns(recording.electrodes, shield=0.0), recording.electrodes)
    diagonal = np.diagonal(arrays["capacitance"], axis1=1, axis2=2)
    assert table.channels(still) == approx(diagonal, rel=1e-9)


def test_all_chips_write_and_draw(run, tmp_path, capsys):
    folder = run()
    assert main(["readout", str(folder), "--chip", "all", "-o", str(tmp_path / "counts")]) == OK
    written = {p.name for p in (tmp_path / "counts").iterdir()}
    assert written == {f"counts_{name}.csv" for name in CHIPS}
    picture = tmp_path / "chips.png"
    assert main(["readout", str(folder), "--chip", "all", "--plot", str(picture)]) == OK
    assert picture.stat().st_size > 20_000
    assert main(["readout", str(folder), "--chip", "mpr121", "--plot", str(picture),
                 "--electrode", "E5"]) == OK  # fmt: skip


def test_chips_are_set_up_for_the_recorded_electrodes(run, tmp_path):
    """An MPR121 has one setting for all: that of the smallest electrode keeps all in range."""
    folder = run()
    with np.load(folder / "readings.npz") as data:
        arrays = dict(data)
    for kind, empty in (("capacitance", "baseline"), ("self_capacitance", "self_baseline")):
        smaller = np.array([1.0, 0.8, 0.7, 0.6, 0.5, 0.45])
        if arrays[empty].ndim == 2:
            smaller = np.sqrt(np.outer(smaller, smaller))
        arrays[kind], arrays[empty] = arrays[kind] * smaller, arrays[empty] * smaller
    np.savez(folder / "readings.npz", **arrays)
    assert main(["readout", str(folder), "--chip", "mpr121"]) == OK
    rows = table(folder / "counts_mpr121.csv")
    assert len({r["channel"] for r in rows}) == 6
    assert {r["flags"] for r in rows} == {"0"}


def test_a_file_of_options(run, tmp_path):
    folder = run()
    config = tmp_path / "mine.toml"
    config.write_text('chip = "fdc1004"\nrandom = false\n[detector]\ntouch = 9000\n', "utf-8")
    assert main(["readout", str(folder), "--config", str(config)]) == OK
    rows = table(folder / "counts_mine.csv")
    assert {"baseline", "touched"} <= rows[0].keys()
    assert {r["touched"] for r in rows} == {"0", "1"}
    other = tmp_path / "other"
    assert main(["readout", str(folder), "--chip", str(config), "-o", str(other)]) == OK
    assert table(other / "counts_mine.csv") == rows
    assert main(["readout", str(folder), "--chip", str(config), "--rate", "400"]) == BAD_INPUT


def test_tables_are_not_replaced_by_accident(run, capsys):
    folder = run()
    command = ["readout", str(folder), "--chip", "teensy"]
    assert main(command) == OK
    assert main(command) == BAD_INPUT
    assert "--force" in capsys.readouterr().err
    assert main([*command, "--force"]) == OK


def test_listings(capsys):
    assert main(["readout", "--list"]) == OK
    listing = capsys.readouterr().out
    assert all(name in listing for name in CHIPS)
    assert main(["readout", "--list", "--chip", "fdc1004"]) == OK
    figures = capsys.readouterr().out
    assert "3.125 pF" in figures
    assert "confirmed" in figures


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "no recording given"),
        (["{}"], "give --chip NAME or --config"),
        (["{}", "--chip", "fdc1005"], "did you mean 'fdc1004'"),
        (["{}", "--chip", "fdc1004", "--rate", "3"], "no rate of 3.0"),
        (["{}", "--chip", "fdc1004", "--seed", "-1"], "--seed -1"),
        (["{}", "--chip", "fdc1004", "--plot", "x.txt"], "is no picture"),
        (["{}", "--chip", "fdc1004", "--plot", "none/x.png"], "there is no folder none"),
        (["{}", "--chip", "fdc1004", "--electrode", "E1"], "goes with --plot"),
        (["{}", "--config", "none.toml"], "there is no readout file"),
        (["{}", "--config", "none.toml", "--rate", "3"], "write them in the file"),
        (["{}", "--chip", "fdc1004", "--plot", "{}/x.png", "--electrode", "E9"], "electrode 'E9'"),
        (["{}/none", "--chip", "fdc1004"], "there is no recording"),
        (["{}/summary.json", "--chip", "fdc1004"], "is no recording"),
    ],
)
def test_bad_usage_is_refused(run, capsys, arguments, words):
    folder = run()
    code = main(["readout", *(a.format(folder) for a in arguments)])
    assert code == BAD_INPUT
    assert words in capsys.readouterr().err


def test_bad_recordings_are_refused(run, tmp_path):
    folder = run("mutual")
    recording = load_recording(folder / "readings.csv")
    bank = ChannelBank(self_patterns(recording.electrodes), recording.electrodes)
    with pytest.raises(ReadoutError, match=r"does not hold what channel 'E1' needs"):
        recording.channels(bank)
    with pytest.raises(ReadoutError, match="holds no readings"):
        load_recording(tmp_path / "mutual" / "..")
    broken = tmp_path / "broken"
    shutil.copytree(folder, broken)
    for name, content, words in (
        ("readings.npz", b"PK broken", "no readings.npz"),
        ("readings.csv", b"time_s,C_E1_F\n", "holds no samples"),
        ("readings.csv", b"time_s,C_E1_F\n0,1e-12\n0,1e-12\n", "do not rise"),
        ("readings.csv", b"time_s,C_E1_F\n0,nan\n", "no number somewhere"),
        ("readings.csv", b"time_s,C_E1_F\n0,one\n", "is no readings.csv"),
        ("readings.csv", b"t,C_E1_F\n0,1\n", "no column time_s"),
        ("readings.csv", b"", "is no readings.csv"),
    ):
        (broken / name).write_bytes(content)
        with pytest.raises(ReadoutError, match=words):
            load_recording(broken / name)
    with np.load(folder / "readings.npz") as data:
        older = {name: data[name] for name in data.files if name != "self_capacitance"}
    np.savez(broken / "readings.npz", **older)
    words = "no readings.npz of this version: it lacks 'self_capacitance'; run it again"
    with pytest.raises(ReadoutError, match=words):
        load_recording(broken / "readings.npz")
    names = tmp_path / "names.csv"
    names.write_bytes(b"time_s,Cm_a_b_c_F\n0,1e-12\n")
    with pytest.raises(ReadoutError, match="electrodes of column 'Cm_a_b_c' are not clear"):
        load_recording(names)
    whole = tmp_path / "whole.mcap"
    whole.write_bytes(b"")
    with pytest.raises(ReadoutError, match=r"whole\.mcap is a recording; capsense replay or"):
        load_recording(whole)
    odd = tmp_path / "odd.csv"
    odd.write_bytes(b"time_s,C_a_F,C_b_F,C_a_b_F\n0,1,1,1\n")
    with pytest.raises(ReadoutError, match="may mean the pair or the electrode"):
        load_recording(odd)
