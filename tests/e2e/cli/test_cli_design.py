"""``capsense design``, the parser, and the helpers for text."""

from __future__ import annotations

import re
import subprocess
import sys
from inspect import cleandoc
from pathlib import Path

import pytest
from approximate import approx

import capsense as cs
from capsense.__main__ import COMMANDS, build_parser, main
from capsense.cli import BuildProgress, facts, grouped, seconds, table


def output_of(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    assert main(arguments) == 0
    text, errors = capsys.readouterr()
    assert errors in ("", "capsense: building the field: panels, 50% done\n")
    return text


def test_progress_without_a_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A line at the start and one every ten seconds; no control characters, none when quiet."""
    clock = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: clock[0])
    with BuildProgress() as progress, BuildProgress(quiet=True) as quiet:
        for k in range(25):
            progress("panels" if k < 15 else "fit", k / 24)
            quiet("panels", k / 24)
            clock[0] += 1.0
    assert capsys.readouterr().err.splitlines() == [
        "capsense: building the field: panels, 0% done",
        "capsense: building the field: panels, 42% done, 10 s so far",
        "capsense: building the field: fit, 83% done, 20 s so far",
    ]


def test_list(capsys: pytest.CaptureFixture[str]) -> None:
    """Every packaged design is listed."""
    text = output_of(["design", "--list"], capsys)
    for name in cs.available_designs():
        assert f"\n{name} " in text


@pytest.mark.usefixtures("fake")
def test_figures_and_baseline(capsys: pytest.CaptureFixture[str]) -> None:
    """Electrodes, layers, conductors, the field and the matrix in picofarads."""
    text = output_of(["design", "stripe"], capsys)
    for part in ("-17.5 to -11.9", "back plane", "ground", "4.5", "3 456", "baseline [pF]"):
        assert part in text, part
    matrix = text[text.index("baseline [pF]") :].splitlines()
    simulator = cs.Simulator("stripe")
    for line, name, row in zip(
        matrix[1:], simulator.electrode_names, simulator.baseline, strict=True
    ):
        cells = line.split()
        assert cells[0] == name
        assert [float(c) for c in cells[1:]] == approx(row * 1e12, abs=5e-5)
    assert len({len(line) for line in matrix}) == 1


def test_drawing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing is drawn unasked; -o draws, and --no-build needs no simulator."""
    text = output_of(["design", "patch", "--no-build"], capsys)
    assert "-o patch.png" in text
    assert "baseline" not in text
    for suffix, magic in ((".png", b"\x89PNG"), (".svg", b"<?xml"), (".pdf", b"%PDF")):
        picture = tmp_path / f"patch{suffix}"
        assert str(picture) in output_of(
            ["design", "patch", "--no-build", "-o", str(picture)], capsys
        )
        assert picture.read_bytes().startswith(magic)


def test_guarded_self_capacitance(capsys: pytest.CaptureFixture[str]) -> None:
    """Designs with a driven shield print what a self-mode channel measures, others nothing more."""
    reading = cs.Simulator("arm_segment").step(cs.Scene())
    last = output_of(["design", "arm_segment"], capsys).splitlines()[-1]
    assert [float(x) for x in last.split()] == approx(reading.self_capacitance * 1e12, abs=5e-5)
    assert "shields driven" not in output_of(["design", "six_patch"], capsys)


def test_hint_is_a_line_for_the_shell(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Names with spaces are quoted."""
    file = tmp_path / "my sensor.toml"
    library = Path(cs.__file__).parent / "design" / "library"
    file.write_text((library / "six_patch_bare.toml").read_text())
    text = output_of(["design", str(file), "--no-build"], capsys)
    assert f"capsense design '{file}' --no-build" in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["design"], "no design given"),
        (["design", "strip"], "did you mean 'stripe'"),
        (["design", "no/such.toml"], "no design file no/such.toml"),
        (["design", "stripe", "-o", "x.docx"], "x.docx is no picture; give .*png"),
        (["design", "stripe", "-o", "none/x.png"], "no folder none"),
    ],
)
def test_refused(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Wrong input is refused in one line, before anything is printed."""
    assert main(arguments) == 2
    text, errors = capsys.readouterr()
    assert text == ""
    assert errors.count("\n") == 1
    assert re.search(message, errors)


# ---- the parser ----


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    """--version prints the package's."""
    with pytest.raises(SystemExit) as stopped:
        main(["--version"])
    assert stopped.value.code == 0
    assert capsys.readouterr().out == f"capsense {cs.__version__}\n"


def test_help_of_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    """Each help page has examples, which parse, and says where exit codes are explained."""
    for command in COMMANDS:
        with pytest.raises(SystemExit) as stopped:
            main([command.name, "--help"])
        assert stopped.value.code == 0
        text = capsys.readouterr().out
        assert text.count("exit codes:") == 1
        assert text.endswith("exit codes: see 'capsense --help'\n")
        _, _, lines = cleandoc(command.execute.__doc__ or "").partition("examples:\n")
        examples = [line.strip().split("   ")[0].split() for line in lines.splitlines()]
        assert len(examples) >= 2
        for words in examples:
            assert words[:2] == ["capsense", command.name]
            build_parser().parse_args(words[1:])


@pytest.mark.parametrize("arguments", [[], ["walk"], ["run"], ["run", "x.toml"]])
def test_usage_errors(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """What cannot be parsed exits with 2 and shows the usage."""
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2
    assert "usage: capsense" in capsys.readouterr().err


def test_module_and_script() -> None:
    """``python -m capsense`` is the command, and returns its exit codes."""
    command = [sys.executable, "-m", "capsense"]
    done = subprocess.run([*command, "design", "nosuch"], capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.startswith("capsense: error: no packaged design is named 'nosuch'")


@pytest.mark.skipif(not Path("/bin/sh").exists(), reason="needs a shell")
def test_closed_pipe() -> None:
    """A reader that goes away early is no error."""
    line = f"'{sys.executable}' -m capsense design --list | true"
    done = subprocess.run(["/bin/sh", "-c", line], capture_output=True, text=True)
    assert done.returncode == 0
    assert "Traceback" not in done.stderr


# ---- text ----


def test_table() -> None:
    """Numbers to the right, words to the left, no trailing blanks."""
    text = table(("name", "value"), [("a", "-1.5"), ("long name", "10.25")])
    assert text == "name       value\na           -1.5\nlong name  10.25"
    assert table(("a", "b"), []) == "a  b"


def test_small_texts() -> None:
    """Times, counts and facts."""
    assert [seconds(v) for v in (2e-5, 3.14e-3, 0.5, 2.5)] == [
        "20 µs",
        "3.14 ms",
        "500 ms",
        "2.5 s",
    ]
    assert [grouped(v) for v in (1234567, 12, 0.123456, "x")] == ["1 234 567", "12", "0.1235", "x"]
    assert facts([("a", "1"), ("bcd", "2")]) == "a    1\nbcd  2"


def test_tolerance(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The resolution for a tolerance is told; it ends with 3 where no panels meet it."""
    file = tmp_path / "pad.toml"
    file.write_text(
        'name = "pad"\n[domain]\nsize = [0.2, 0.2, 0.2]\nbackplane = 0.01\n'
        '[build]\nresolution = 0.25\n[[electrode]]\nname = "A"\nshape = "disc"\nradius = 0.01\n'
    )
    assert main(["design", str(file), "--tolerance", "2%", "-q"]) == 0
    text, errors = capsys.readouterr()
    assert errors == ""
    assert "tolerance                2 %, met" in text
    assert re.search(r"resolution +[\d.]+ under \[build\]; the design has 0\.25", text)
    assert re.search(r"baseline \[pF\] +A\nA +\d\.\d{4}\n\nerror \[%\] +A\nA +[\d.]+\n", text)
    assert main(["design", str(file), "--tolerance", "1e-9", "-q"]) == 3
    assert "NOT met" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        main(["design", str(file), "--tolerance", "120%"])
    assert "give a part above 0 and below 1" in capsys.readouterr().err
