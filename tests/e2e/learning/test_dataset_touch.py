"""Touch as labels of data sets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from approximate import approx

import capsense as cs
from capsense.errors import ScenarioError
from capsense.learning.scenes import load_spec

pytest.importorskip("pyarrow")

FOAM = Path(__file__).parents[2] / "data/foam.toml"
SPEC = f"""
name = "presses"
design = "{FOAM}"
scenes = 4
seed = 3

[[body]]
name = "ball"
shape = "sphere"
radius = {{ from = 0.006, to = 0.01 }}
material = "steel"
force = {{ from = 0.1, to = 1.0, log = true }}
pose = {{ position = [{{ from = -0.014, to = -0.01 }}, 0.0, 0.03] }}
"""


def test_what_is_pressed_on_is_a_label(foam_field: cs.Design, tmp_path: Path) -> None:
    (tmp_path / "spec.toml").write_text(SPEC)
    spec = load_spec(tmp_path / "spec.toml")
    rows = spec.table(0).to_pylist()
    assert len(rows) == 4
    for row in rows:
        scene, near, _ = spec.scene(row["scene"])
        assert near is not None
        assert row["touch_total"] == approx(scene[0].force, rel=1e-9)
        assert row["touch_force"] == approx([row["touch_total"], 0.0], rel=0.1)
        assert row["touch_compression"][0] > 1e-4
        assert row["distance"] == approx(0.002, abs=1e-6)  # it just touches
    columns = spec.table(0).schema
    assert b"N" in columns.field("touch_force").metadata[b"meaning"]
    softer = SPEC.replace("foam.toml", "foam2.toml").replace(str(FOAM.parent), str(tmp_path))
    (tmp_path / "foam2.toml").write_text(FOAM.read_text().replace("60e3", "30e3"))
    (tmp_path / "spec.toml").write_text(softer)
    assert load_spec(tmp_path / "spec.toml").identity != spec.identity


def test_designs_without_a_cover_have_no_labels_and_take_no_force(tmp_path: Path) -> None:
    (tmp_path / "spec.toml").write_text(SPEC.replace(str(FOAM), "patch"))
    with pytest.raises(ScenarioError, match="cover"):
        load_spec(tmp_path / "spec.toml")
    plain = "\n".join(line for line in SPEC.splitlines() if not line.startswith("force"))
    (tmp_path / "spec.toml").write_text(plain.replace(str(FOAM), "patch"))
    names = load_spec(tmp_path / "spec.toml").table(0).column_names
    assert not [name for name in names if name.startswith("touch")]
    assert np.isin(["delta", "distance"], names).all()
