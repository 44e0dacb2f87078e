"""The example of the reference page runs as printed."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

import capsense as cs


def test_the_example_runs(tmp_path, monkeypatch, capsys):
    page = (Path(__file__).parents[3] / "docs/meshes.md").read_text()
    (example,) = re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(example, names)
    assert "negative link weights 0 (0.0%)" in capsys.readouterr().out
    capacitance = cs.Simulator(mesh=names["mesh"]).baseline  # type: ignore[arg-type]
    # An 80 mm plate, 20 mm from the floor and 80 mm from the lid: more than two plate capacitors.
    plates = 8.854e-12 * 0.08**2 * (1 / 0.02 + 1 / 0.08)
    assert plates < np.squeeze(capacitance) < 2.5 * plates
