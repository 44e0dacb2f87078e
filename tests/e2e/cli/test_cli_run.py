"""``capsense run``, mostly with a stand-in for the simulator: files, refusals, interruptions."""

from __future__ import annotations

import csv
import json
import os
import signal
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from approximate import approx
from ball_scenario import ball_scenario

import capsense as cs
from capsense.__main__ import main

COUNT = 13
FILES = {"readings.csv", "readings.npz", "summary.json", "plot.png"}


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    path = tmp_path / "ball.toml"
    path.write_text(ball_scenario(), encoding="utf-8")
    return path


def rows_of(folder: Path) -> list[dict[str, float]]:
    with (folder / "readings.csv").open(newline="", encoding="utf-8") as file:
        return [{k: float(v) for k, v in row.items()} for row in csv.DictReader(file)]


def summary_of(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "summary.json").read_text(encoding="utf-8"))


# ---- what is written ----


@pytest.mark.usefixtures("fake")
def test_all_files_agree(
    scenario: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Table, arrays and summary tell the same numbers; the picture is a picture."""
    out = tmp_path / "deep" / "out"
    assert main(["run", str(scenario), "-o", str(out)]) == 0
    assert {p.name for p in out.iterdir()} == FILES
    rows, summary = rows_of(out), summary_of(out)
    arrays = np.load(out / "readings.npz", allow_pickle=False)
    assert len(rows) == COUNT
    assert arrays["capacitance"].shape == (COUNT, 6, 6)
    assert arrays["delta"] == approx(arrays["capacitance"] - arrays["baseline"], abs=1e-24)
    assert arrays["body_positions"][:, 0, 0] == approx(np.linspace(-0.06, 0.06, COUNT))
    assert arrays["body_names"].tolist() == ["ball"]
    assert arrays["electrode_names"].tolist() == [f"E{k}" for k in range(1, 7)]
    for k, row in enumerate(rows):
        assert row["time_s"] == approx(k / 10)
        for i in range(6):
            for j in range(i, 6):
                value = row[f"C_E{i + 1}_E{j + 1}_F"]
                assert value == approx(arrays["capacitance"][k, i, j], rel=1e-9)
                change = row[f"dC_E{i + 1}_E{j + 1}_F"]
                assert change == approx(arrays["delta"][k, i, j], rel=1e-6, abs=1e-22)
    assert list(rows[0]) == list(summary["columns"])
    assert summary["samples"] == summary["samples_planned"] == COUNT
    assert (summary["interrupted"], summary["failure"]) == (False, None)
    assert summary["largest_error_estimate_F"] == approx(4e-18)
    assert summary["field"]["boundary panels"] == 3456
    assert summary["unknowns"]["median"] == 120
    assert summary["versions"]["capsense"] == cs.__version__
    first = summary["channels"][0]
    column = [row["C_E1_E1_F"] for row in rows]
    assert (first["min_F"], first["max_F"]) == approx((min(column), max(column)))
    assert first["baseline_F"] == approx(arrays["baseline"][0, 0])
    assert (out / "plot.png").read_bytes().startswith(b"\x89PNG")
    text, errors = capsys.readouterr()
    assert "C_E5_E6" in text
    assert f"{COUNT} of {COUNT}" in text
    assert errors == "capsense: building the field: panels, 50% done\n"  # no bar, no terminal


@pytest.mark.parametrize("grounding", ["grounded", "floating", 1e-10])
def test_the_error_is_the_largest_of_the_solver_s_estimates(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], grounding: str | float
) -> None:
    """Differential: sample by sample against the simulator itself, whatever the ball is tied to."""
    text = ball_scenario().replace(
        'material = "steel"', f'material = "steel"\ngrounding = {json.dumps(grounding)}'
    )
    path, out = tmp_path / "ball.toml", tmp_path / "out"
    path.write_text(text, encoding="utf-8")
    assert main(["run", str(path), "-o", str(out)]) == 0
    arrays, told = np.load(out / "readings.npz"), summary_of(out)["largest_error_estimate_F"]
    sim, errors = cs.Simulator("six_patch"), []
    for place in arrays["body_positions"][:, 0]:
        ball = cs.Body(cs.Sphere(0.02), cs.Pose(place), "steel", grounding)  # type: ignore[arg-type]
        errors.append(sim.step(cs.Scene([ball])).stats.solver_error)
    np.testing.assert_allclose(arrays["error_estimate"], errors, rtol=1e-6)
    assert max(errors) > 1.2 * min(errors)
    assert told == approx(max(errors), rel=1e-6)
    assert f"error      {told:.2g} F, the largest of the estimates" in capsys.readouterr().out


@pytest.mark.usefixtures("fake")
@pytest.mark.parametrize(
    ("excitation", "columns"),
    [
        ("self", ["C_E1_F", "C_E6_F", "dC_E1_F"]),
        ("mutual", ["Cm_E1_E2_F", "Cm_E5_E6_F", "dCm_E1_E2_F"]),
        ('mutual"\npairs = [["E6", "E1"]]\n#', ["Cm_E6_E1_F", "dCm_E6_E1_F"]),
    ],
)
def test_excitations(scenario: Path, tmp_path: Path, excitation: str, columns: list[str]) -> None:
    """Columns follow the excitation; mutual capacitances are positive."""
    scenario.write_text(ball_scenario(excitation), encoding="utf-8")
    assert main(["run", str(scenario), "-o", str(tmp_path / "out"), "-q"]) == 0
    rows = rows_of(tmp_path / "out")
    assert set(columns) <= set(rows[0])
    assert all(v > 0 for row in rows for k, v in row.items() if k.startswith("C"))
    assert len(rows[0]) == 2 + 2 * len(summary_of(tmp_path / "out")["channels"])


@pytest.mark.usefixtures("fake")
@pytest.mark.parametrize(("excitation", "told"), [("matrix", 1), ("self", 0), ("mutual", 0)])
def test_signs_in_the_table_are_told(
    scenario: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], excitation: str, told: int
) -> None:
    """Entries of the Maxwell matrix are not taken for mutual capacitances."""
    scenario.write_text(ball_scenario(excitation), encoding="utf-8")
    assert main(["run", str(scenario), "-o", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().out.count("Maxwell matrix; the mutual capacitance") == told


@pytest.mark.usefixtures("fake")
def test_rate_quiet_and_repeat(
    scenario: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """--rate thins the samples, --quiet says nothing, and a run repeats to the last digit."""
    for name in ("a", "b"):
        assert main(["run", str(scenario), "-o", str(tmp_path / name), "--rate", "5", "-q"]) == 0
    assert capsys.readouterr() == ("", "")
    one, two = ((tmp_path / n / "readings.csv").read_text() for n in "ab")
    assert one == two
    assert len(one.splitlines()) == 1 + 7


@pytest.mark.usefixtures("fake")
def test_still_scene(scenario: Path, tmp_path: Path) -> None:
    """A single sample is a run too."""
    text = ball_scenario("mutual").replace("[body.trajectory]", "[body.pose]")
    text = text[: text.index("waypoints")] + "position = [0.0, 0.0, 0.05]\n"
    scenario.write_text(text, encoding="utf-8")
    assert main(["run", str(scenario), "-o", str(tmp_path / "out"), "-q"]) == 0
    assert len(rows_of(tmp_path / "out")) == 1
    assert (tmp_path / "out" / "plot.png").exists()


@pytest.mark.usefixtures("fake")
def test_body_outside_is_told(
    scenario: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A body that never comes into the domain is likely a mistake: a warning, no refusal."""
    scenario.write_text(scenario.read_text().replace("0.04]", "0.9]"), encoding="utf-8")
    assert main(["run", str(scenario), "-o", str(tmp_path / "out")]) == 0
    told = " ".join(capsys.readouterr().err.split())
    assert 'warning: body "ball" never enters the domain and has no effect' in told
    assert "at its nearest it spans x -0.08 to -0.04, y -0.02 to 0.02, z 0.88 to 0.92 m" in told
    assert "and the domain x -0.25 to 0.25, y -0.25 to 0.25, z " in told


def test_samples_in_contact_are_marked(
    scenario: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Differential: against signed distances; extremes leave such samples out."""
    text = scenario.read_text().replace("0.04]", "0.015]").replace("0.06", "0.2")
    scenario.write_text(text.replace("speed = 0.1", "speed = 0.35"), encoding="utf-8")
    out = tmp_path / "out"
    assert main(["run", str(scenario), "-o", str(out), "--preset", "fast"]) == 0
    text, errors = capsys.readouterr()
    assert errors.count("readings mean nothing until this ends") == 1
    rows, summary = rows_of(out), summary_of(out)
    arrays = np.load(out / "readings.npz")
    marked = np.array([row["contact"] == 1.0 for row in rows])
    np.testing.assert_array_equal(marked, arrays["contact"])
    largest = np.abs(arrays["capacitance"]).max(axis=(1, 2))
    np.testing.assert_array_equal(marked, arrays["error_estimate"] >= largest)
    sensor = cs.load_design("six_patch")
    corners = np.concatenate([e.surface.triangles.reshape(-1, 3) for e in sensor.electrodes])
    apart = [np.linalg.norm(corners - p, axis=1).min() for p in arrays["body_positions"][:, 0]]
    assert marked[np.array(apart) < 0.02].all()
    assert 0 < summary["samples_in_contact"] == marked.sum() < len(rows)
    for channel, column in zip(summary["channels"], arrays["channels"][~marked].T, strict=True):
        assert (channel["min_F"], channel["max_F"]) == (column.min(), column.max())
    assert f"contact    {int(marked.sum())} samples mean nothing" in text


# ---- what is refused, before anything is computed ----


@pytest.fixture
def unused(monkeypatch: pytest.MonkeyPatch) -> None:
    """A simulator that must not be made."""

    def refuse(*_: object, **__: object) -> None:
        pytest.fail("the simulator was made before the input was checked")

    monkeypatch.setitem(cs.__dict__, "Simulator", refuse)


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The one line on stderr of a command that exits with 2."""
    assert main(arguments) == 2
    text, errors = capsys.readouterr()
    assert text == ""
    assert errors.startswith("capsense: error: ")
    assert errors.count("\n") == 1
    return errors


@pytest.mark.usefixtures("unused")
def test_missing_scenario(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A missing file is named; no output folder is left behind."""
    path = tmp_path / "none.toml"
    assert str(path) in refused(["run", str(path), "-o", str(tmp_path / "out")], capsys)
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("unused")
def test_output_not_empty(
    scenario: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nothing is overwritten unasked."""
    out = tmp_path / "out"
    out.mkdir()
    (out / "readings.csv").write_text("precious")
    message = refused(["run", str(scenario), "-o", str(out)], capsys)
    assert f"{out} is not empty" in message
    assert "--force" in message
    assert (out / "readings.csv").read_text() == "precious"


@pytest.mark.usefixtures("unused")
def test_output_is_a_file(
    scenario: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A file is no folder; neither is a folder within a file."""
    message = refused(["run", str(scenario), "-o", str(scenario)], capsys)
    assert "is a file; give a folder" in message
    message = refused(["run", str(scenario), "-o", str(scenario / "out")], capsys)
    assert "cannot be written to" in message


@pytest.mark.usefixtures("unused")
@pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere"
)
def test_output_read_only(
    scenario: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A folder that may not be written to is found out at once."""
    out = tmp_path / "out"
    out.mkdir(mode=stat.S_IRUSR | stat.S_IXUSR)
    assert "cannot be written to" in refused(["run", str(scenario), "-o", str(out)], capsys)


@pytest.mark.usefixtures("fake")
def test_force_replaces_results_only(scenario: Path, tmp_path: Path) -> None:
    """--force removes earlier results, and leaves other files alone."""
    out = tmp_path / "out"
    assert main(["run", str(scenario), "-o", str(out), "-q"]) == 0
    (out / "notes.txt").write_text("mine")
    arguments = ["run", str(scenario), "-o", str(out), "-q", "--force", "--rate", "5"]
    assert main(arguments) == 0
    assert len(rows_of(out)) == 7
    assert (out / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("rate", ["0", "-1", "inf", "nan", "fast"])
def test_bad_rate(rate: str, scenario: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A rate that is none is a usage error."""
    with pytest.raises(SystemExit) as stopped:
        main(["run", str(scenario), "-o", "x", "--rate", rate])
    assert stopped.value.code == 2
    assert "--rate" in capsys.readouterr().err


# ---- failures and interruptions keep what was computed ----


def check_partial(folder: Path, count: int) -> dict[str, Any]:
    """All files are there and hold the first ``count`` samples."""
    assert {p.name for p in folder.iterdir()} == FILES
    assert len(rows_of(folder)) == count
    assert np.load(folder / "readings.npz")["capacitance"].shape == (count, 6, 6)
    summary = summary_of(folder)
    assert (summary["samples"], summary["samples_planned"]) == (count, COUNT)
    return summary


def test_failure_midway(
    scenario: Path,
    tmp_path: Path,
    fail_at: Callable[[int], None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A step that fails ends the run, is named, and costs no earlier sample."""
    fail_at(6)
    assert main(["run", str(scenario), "-o", str(tmp_path / "out")]) == 1
    summary = check_partial(tmp_path / "out", 5)
    assert "the residual is" in summary["failure"]
    text, errors = capsys.readouterr()
    assert "stopped by an error" in text
    assert "stopped at sample 5 of 13 (t = 0.5 s)" in errors
    assert "Traceback" not in errors


def test_failure_at_the_first_sample(
    scenario: Path, tmp_path: Path, fail_at: Callable[[int], None]
) -> None:
    """Nothing computed: an empty table and a summary, no picture."""
    fail_at(1)
    assert main(["run", str(scenario), "-o", str(tmp_path / "out")]) == 1
    assert {p.name for p in (tmp_path / "out").iterdir()} == FILES - {"plot.png"}
    assert summary_of(tmp_path / "out")["step_time_s"] is None


def test_bug_midway(
    scenario: Path,
    tmp_path: Path,
    fake: Any,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """An unexpected exception keeps the samples too, and shows where it came from."""

    def hook(number: int) -> None:
        if number == 3:
            raise ZeroDivisionError("surprise")

    monkeypatch.setattr(fake, "after_step", staticmethod(hook))
    assert main(["run", str(scenario), "-o", str(tmp_path / "out")]) == 1
    check_partial(tmp_path / "out", 2)
    errors = capsys.readouterr().err
    assert "Traceback" in errors
    assert "internal error: surprise" in errors


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted(
    number: signal.Signals,
    scenario: Path,
    tmp_path: Path,
    fake: Any,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A signal lets the step at hand finish, and everything is written."""

    def hook(step: int) -> None:
        if step == 4:
            signal.raise_signal(number)

    before = signal.getsignal(number)
    monkeypatch.setattr(fake, "after_step", staticmethod(hook))
    assert main(["run", str(scenario), "-o", str(tmp_path / "out")]) == 130
    assert check_partial(tmp_path / "out", 4)["interrupted"] is True
    assert "interrupted after 4 of 13 samples" in capsys.readouterr().err
    assert signal.getsignal(number) is before


def test_interrupted_while_building(
    scenario: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Before there are samples, a signal stops at once and leaves no folder behind."""

    def build(*_: object, **__: object) -> None:
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setitem(cs.__dict__, "Simulator", build)
    assert main(["run", str(scenario), "-o", str(tmp_path / "out")]) == 130
    assert capsys.readouterr().err == "capsense: interrupted\n"
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("fake")
@pytest.mark.usefixtures("fake")
def test_a_disk_that_fills_up(
    scenario: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whole rows are left, as many as the message tells."""
    resource = pytest.importorskip("resource")
    assert main(["run", str(scenario), "-o", str(tmp_path / "whole")]) == 0
    whole = (tmp_path / "whole/readings.csv").read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(whole) // 2, limits[1]))
    try:
        code = main(["run", str(scenario), "-o", str(tmp_path / "out")])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert code == 1
    found = (tmp_path / "out/readings.csv").read_bytes()
    assert whole.startswith(found)
    assert found.endswith(b"\n")
    rows = found.count(b"\n") - 1
    assert 0 < rows < COUNT
    assert f"stopped at sample {rows} of {COUNT}" in capsys.readouterr().err


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_disk_full(
    scenario: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A full disk is told in one line, without a traceback."""
    real = Path.open

    def full(self: Path, mode: str = "r", *rest: Any, **more: Any) -> Any:
        return real(Path("/dev/full") if self.name == "readings.csv" else self, mode, *rest, **more)

    monkeypatch.setattr(Path, "open", full)
    assert main(["run", str(scenario), "-o", str(tmp_path / "out")]) == 1
    errors = capsys.readouterr().err
    assert "No space left on device" in errors
    assert "Traceback" not in errors
