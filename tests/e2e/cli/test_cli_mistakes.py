"""Slips on the command line: files of another kind, keys left out; each message names the fix."""

from __future__ import annotations

from pathlib import Path

import pytest
from ball_scenario import ball_scenario

import capsense as cs
from capsense.__main__ import EXIT_CODES, main
from capsense._file_kinds import kind_of, other_kind
from capsense._validate import read_toml
from capsense.errors import CapSenseError, DesignError, RecordingError, ScenarioError

ROOT = Path(__file__).parents[3]
KINDS = {
    "examples/hand_approach.toml": "scenario",
    "examples/steel_bar_triangle.toml": "scenario",
    "examples/designs/forearm_pads.toml": "task",
    "examples/designs/pad_over_ground.toml": "design",
    "examples/datasets/forearms.toml": "data set",
    "examples/datasets/follow.toml": "data set",
    "examples/tolerances/hand_pad.toml": "study",
}
COMMANDS = {
    "scenario": "capsense run",
    "design": "capsense design",
    "data set": "capsense dataset",
    "study": "capsense tolerance",
    "task": "capsense optimise",
}


@pytest.mark.parametrize("file", KINDS)
@pytest.mark.parametrize("wanted", ["scenario", "design", "data set", "study", "task", "readout"])
def test_files_are_known_by_their_keys(file: str, wanted: str) -> None:
    """Every example is read as what it is, and refused with its command as anything else."""
    path, kind = ROOT / file, KINDS[file]
    if kind == wanted:
        assert kind_of(read_toml(path, wanted, CapSenseError)) == kind
        return
    with pytest.raises(CapSenseError, match=f"{path.name} is .*{COMMANDS[kind]} takes it"):
        read_toml(path, wanted, CapSenseError)


def test_every_packaged_design_is_known() -> None:
    """Invariant: no packaged design is taken for another kind."""
    library = Path(cs.__file__).parent / "design" / "library"
    assert {kind_of(read_toml(p, "design", DesignError)) for p in library.glob("*.toml")} == {
        "design"
    }


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["run", "hand.mcap", "-o", "out"], "hand.mcap is a recording; capsense replay or "),
        (["run", "design.toml", "-o", "out"], "design.toml is a sensor design; capsense design "),
        (["design", "ball.toml"], "ball.toml is a scenario; capsense run takes it"),
        (["replay", "ball.toml"], "ball.toml is a scenario; capsense run takes it"),
        (["export", "ball.toml", "-o", "x.csv"], "ball.toml is a scenario; capsense run"),
        (["readout", "ball.toml", "--chip", "fdc1004"], "ball.toml is a scenario; capsense run"),
        (["dataset", "ball.toml", "-o", "out"], "ball.toml is a scenario; capsense run"),
        (["optimise", "ball.toml", "-o", "x.toml"], "ball.toml is a scenario; capsense run"),
        (["optimize", "ball.toml", "-o", "x.toml"], "ball.toml is a scenario; capsense run"),
    ],
)
def test_wrong_command(
    arguments: list[str],
    told: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Exit code 2, one line that says what the file is and which command takes it, no files."""
    monkeypatch.chdir(tmp_path)
    Path("ball.toml").write_text(ball_scenario(), encoding="utf-8")
    pads = ROOT / "examples/designs/pad_over_ground.toml"
    Path("design.toml").write_bytes(pads.read_bytes())
    Path("hand.mcap").write_bytes(b"\x89MCAP0\r\n\x00\xff")
    assert main(arguments) == 2
    assert told in " ".join(capsys.readouterr().err.split())
    assert {p.name for p in tmp_path.iterdir()} == {"ball.toml", "design.toml", "hand.mcap"}


def test_files_that_cannot_be_read_are_of_no_kind(tmp_path: Path) -> None:
    """Too deep, not TOML, or not there: what is wrong with them is told elsewhere."""
    deep, odd = tmp_path / "deep.toml", tmp_path / "odd.toml"
    deep.write_text("a = " + "[" * 100_000 + "]" * 100_000, encoding="utf-8")
    odd.write_bytes(b"\xff\xfe=")
    for path in (deep, odd, tmp_path / "absent.toml"):
        assert other_kind(path, "design") is None


def test_a_damaged_recording_is_not_taken_for_a_good_one(tmp_path: Path) -> None:
    """An .mcap file that is none is refused by what it lacks, not by its name."""
    path = tmp_path / "hand.mcap"
    path.write_bytes(b"nothing")
    assert other_kind(path, "recording") is None
    from capsense.recording.reader import open_recording

    with pytest.raises(RecordingError, match="is no MCAP file"):
        open_recording(path)


@pytest.mark.parametrize(
    ("text", "missing"),
    [
        ("duration = 1.0\n", "'name', 'design' and 'sample_rate'"),
        ('name = "a"\ndesign = "six_patch"\nsample_rate = 1\n[[body]]\nmaterial = "steel"\n',
         "'name' and 'shape'"),
        ('name = "a"\ndesign = "six_patch"\nsample_rate = 1\n[[body]]\nname = "b"\n'
         'shape = "capsule"\n', "'material', 'radius' and 'length'"),
    ],
)  # fmt: skip
def test_missing_keys_are_told_together(text: str, missing: str, tmp_path: Path) -> None:
    """All of a table at once, so that a file is right after one correction."""
    path = tmp_path / "a.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ScenarioError, match=f"missing keys {missing}; add them"):
        cs.load_scenario(path)


def test_exit_codes_are_explained_once(capsys: pytest.CaptureFixture[str]) -> None:
    """``capsense --help`` lists them; they are those of the page on the command line."""
    with pytest.raises(SystemExit):
        main(["--help"])
    assert capsys.readouterr().out.count(EXIT_CODES) == 1
