"""The notebooks run, and print what they hold."""

from __future__ import annotations

import importlib.util
import json
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

FOLDER = Path(__file__).parents[2] / "examples" / "notebooks"
NUMBER = re.compile(r"-?\d+(?:\.\d*)?")


@pytest.fixture
def runner() -> ModuleType:
    spec = importlib.util.spec_from_file_location("notebook_runner", FOLDER / "run.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def notebook(name: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))
    return found


def outputs(found: dict[str, Any]) -> tuple[str, int]:
    """All printed text, and how many figures there are."""
    all_of_them = [out for cell in found["cells"] for out in cell.get("outputs", [])]
    text = "".join("".join(out.get("text", "")) for out in all_of_them)
    return text, sum("image/png" in out.get("data", {}) for out in all_of_them)


def check(name: str, runner: ModuleType) -> dict[str, Any]:
    """Run it: words, numbers within 3 % or a digit, and figures are those that it holds."""
    stored, anew = notebook(name), notebook(name)
    scope: dict[str, Any] = runner.run(anew)
    (old, old_figures), (new, new_figures) = outputs(stored), outputs(anew)
    assert new_figures == old_figures > 0
    assert NUMBER.sub("#", new).split() == NUMBER.sub("#", old).split()
    numbers = [np.array(NUMBER.findall(text), dtype=float) for text in (new, old)]
    np.testing.assert_allclose(*numbers, rtol=0.03, atol=0.0101)
    return scope


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.ipynb")), ids=lambda p: p.stem)
def test_form(path: Path) -> None:
    """Version 4.5: identifiers of cells are unique, code cells are numbered as they were run."""
    found = notebook(path.stem)
    assert (found["nbformat"], found["nbformat_minor"]) == (4, 5)
    names = [cell["id"] for cell in found["cells"]]
    assert len(set(names)) == len(names)
    counts = [c["execution_count"] for c in found["cells"] if c["cell_type"] == "code"]
    assert counts == list(range(1, len(counts) + 1))


def test_first_sensor(runner: ModuleType) -> None:
    """Signals fall with the gap, and a grounded hand reads more than floating steel or wood."""
    change = check("first_sensor", runner)["change"]
    assert all((np.diff(values) < 0).all() for values in change.values())
    assert (np.array(change["hand"]) > np.array(change["floating steel"])).all()
    assert (np.array(change["hand"]) > np.array(change["wood"])).all()


def test_chip_readout(runner: ModuleType) -> None:
    """The chip's peak is late, and near the true one."""
    pytest.importorskip("mujoco")
    scope = check("chip_readout", runner)
    truth, chip = (scope[k] - scope[k][2] for k in ("truth", "chip"))
    late = scope["times"][int(np.argmax(chip))] - scope["times"][int(np.argmax(truth))]
    assert 0 <= late < 0.1
    assert 0.8 < chip.max() / truth.max() < 1.05
