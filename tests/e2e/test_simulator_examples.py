"""The examples with simulators, run for real; pages about simulators, their snippets run."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from approximate import approx

ROOT = Path(__file__).parents[2]


def example(name: str, monkeypatch: pytest.MonkeyPatch) -> Any:
    """An example as a module, with fewer readings."""
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    module = importlib.import_module(name)
    monkeypatch.setattr(module, "RATE", 20.0)
    return module


@pytest.mark.parametrize(
    ("simulator", "options"), [("mujoco", {}), ("mujoco", {"depth": True}), ("pybullet", {})]
)
def test_forearm(
    simulator: str, options: dict[str, bool], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """Runs without a display, checks itself, writes a plot and an animation, prints a table."""
    pytest.importorskip(simulator, reason=f"{simulator} is not installed")
    monkeypatch.delenv("DISPLAY", raising=False)
    module = example(f"{simulator}_forearm", monkeypatch)
    monkeypatch.setattr("forearm_story.FRAMES", 2)
    record = module.main(tmp_path, **options)
    assert (tmp_path / "forearm.png").stat().st_size > 10_000
    from PIL import Image

    with Image.open(tmp_path / "forearm.webp") as animation:
        assert getattr(animation, "n_frames", 1) == 2
    table = (tmp_path / "forearm.csv").read_text(encoding="utf-8").splitlines()
    assert len(table) == 1 + len(record.time)
    last = [float(v) for v in table[-1].split(",")]
    assert last[2] == approx(record.delta[-1][0, 0] * 1e15, abs=1e-4)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split()[2:8] == list(record.names)
    assert len(lines) == 1 + -(-len(record.time) // 10)


def test_washcloth(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A cloth comes into contact with the skin; a wet one adds more than a dry one."""
    pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    module = example("washcloth", monkeypatch)
    monkeypatch.setattr(module, "RATE", 2.0)
    monkeypatch.setattr(sys, "argv", ["washcloth.py", str(tmp_path)])
    module.main()
    lines = capsys.readouterr().out.splitlines()
    readings, touched = (int(n) for n in re.findall(r"\d+", lines[0]))
    assert readings > touched > readings // 4
    none, dry, wet = (float(re.findall(r"([\d.]+) pF", line)[0]) for line in lines[1:])
    assert none < dry < wet
    assert (tmp_path / "washcloth.png").stat().st_size > 10_000


def test_sleeve(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An arm is felt through cotton that moves; the example checks itself and draws a plot."""
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    module = importlib.import_module("sleeve")
    monkeypatch.setattr(module, "STEPS", 21)
    module.main(tmp_path)
    assert (tmp_path / "sleeve.png").stat().st_size > 10_000


def test_skin_stops(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sixteen sensors stop a robot before it touches a person; the example checks itself."""
    pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    monkeypatch.delenv("DISPLAY", raising=False)
    module = example("skin_stops", monkeypatch)
    monkeypatch.setattr(module, "RATE", 10.0)
    monkeypatch.setattr(module, "FRAMES", 2)
    record = module.main(tmp_path)
    assert record.signal[0].shape == (16,)
    for name in ("skin_stops.png", "skin_stops.webp"):
        assert 5_000 < (tmp_path / name).stat().st_size < 400_000


def test_skin_touch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pads sense a fist before it touches, and how it presses; the example checks itself."""
    pytest.importorskip("pybullet", reason="PyBullet is not installed")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    module = importlib.import_module("skin_touch")
    monkeypatch.setattr(module, "READINGS", 36)
    monkeypatch.setattr(module, "FRAMES", 2)
    record = module.main(tmp_path)
    assert len(record.names) > 20
    for name in ("skin_touch.png", "skin_touch.webp"):
        assert 5_000 < (tmp_path / name).stat().st_size < 400_000


def test_gripper(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Two fingers grasp a block by touch; the example checks itself and prints a table."""
    pytest.importorskip("mujoco", reason="MuJoCo is not installed")
    monkeypatch.delenv("DISPLAY", raising=False)
    module = example("mujoco_gripper", monkeypatch)
    rows = module.main()
    assert {row.state for row in rows} == {"closes", "lifts", "holds"}
    assert len(capsys.readouterr().out.splitlines()) == 1 + -(-len(rows) // 5)


def test_people(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The picture is drawn; the more ground, the larger the change, near that of an earthed one."""
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    module = importlib.import_module("people")
    module.figure().savefig(tmp_path / "people.png")
    assert (tmp_path / "people.png").stat().st_size > 20_000
    rows = sorted(module.readings(), key=lambda row: row[2])
    assert [row[3] for row in rows] == sorted(row[3] for row in rows)
    assert all(93 < row[4] < 100 for row in rows)


@pytest.mark.parametrize("page", ["mujoco", "pybullet", "humans", "skins"])
def test_pages_run(page: str) -> None:
    """The first snippet of a page runs as it stands and feels an arm."""
    if page in ("mujoco", "pybullet"):
        pytest.importorskip(page, reason=f"{page} is not installed")
    text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    codes = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    for code in codes:
        compile(code, page, "exec")
    check = "assert isinstance(reading, cs.Reading) and reading.delta.diagonal().min() > 4e-15\n"
    subprocess.run([sys.executable, "-c", codes[0] + check], check=True, capture_output=True)
