"""The benchmark of a GPU, on Warp's CPU backend: what it measures, and what it leaves out."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from benchmark_modules import imported

pytest.importorskip("warp")
SMALL = ["--device", "warp:cpu", "--counts", "2", "--budgets", "32", "--scenes", "2"]


@pytest.fixture(scope="module")
def gpu() -> Iterator[ModuleType]:
    """The benchmark's module."""
    with imported("gpu", "fleet") as found:
        yield found["gpu"]


def test_one_command_measures_all(gpu: ModuleType, tmp_path: Path) -> None:
    """JSON holds what the docs name, all above zero; the table stands between the marks."""
    page, file = tmp_path / "page.md", tmp_path / "out" / "gpu.json"
    page.write_text(f"before\n{gpu.MARKERS[0]}\nold\n{gpu.MARKERS[1]}\nafter\n", encoding="utf-8")
    assert gpu.main([*SMALL, "-o", str(file), "--write", str(page)]) == 0
    found = json.loads(file.read_text(encoding="utf-8"))
    (row,) = found["rates"]
    assert row["environments"] == 2
    assert min(row["solves"], row["step"], found["peaks"]["flops"], found["peaks"]["bytes"]) > 0.0
    assert row["with_derivatives"] > row["step"]
    assert 50e3 < row["bytes"] < row["bytes_with_derivatives"] < 1e6
    (far,) = found["errors"]
    assert far["scenes"] == 2
    assert 0.0 < far["rms"] < far["worst"] < 20.0
    kernels = {one["kernel"]: one for one in found["kernels"]}
    assert {"rows", "pairs", "factorise", "residuals", "choose"} <= set(kernels)
    assert 0.0 < kernels["factorise"]["least"] < kernels["factorise"]["seconds"]
    told = [line for line in found["left_out"] if not line.startswith("simulator")]
    assert not told
    if "simulator" in found:
        assert 0.0 < found["simulator"]["share"] < 1.0
    text = page.read_text(encoding="utf-8")
    assert text.startswith(
        f"before\n{gpu.MARKERS[0]}\n`python benchmarks/gpu.py --device warp:cpu`"
    )
    assert text.endswith(f"\n{gpu.MARKERS[1]}\nafter\n")
    assert "old" not in text
    assert f"| 32 | 2 | {row['solves']:,.0f} |" in text


def test_what_does_not_fit_into_the_time_is_named(gpu: ModuleType, tmp_path: Path) -> None:
    file = tmp_path / "gpu.json"
    assert gpu.main([*SMALL, "--seconds", "0", "-o", str(file)]) == 0
    found = json.loads(file.read_text(encoding="utf-8"))
    assert not found["rates"]
    assert not found["errors"]
    assert [line.split(":")[0] for line in found["left_out"]] == [
        "budget 32", "kernels", "simulator", "errors at budget 32",
    ]  # fmt: skip


def test_work_is_counted_for_what_is_there(gpu: ModuleType) -> None:
    """One finger at budget 32: 32 functions in each view, so 32³ / 3 operations to factorise."""
    device = gpu.known_device("warp:cpu")
    fleet, poses = gpu.finger_fleet(gpu.Clock(device, 60.0), 3, 32)
    fleet.step(poses)
    counted = gpu.work(fleet)
    np.testing.assert_allclose(counted["factorise"], (3 * 32**3 / 3, 4 * 3 * 32**2))
    np.testing.assert_allclose(counted["pairs"][0], 3 * 60 * 32 * 33 / 2)


def test_errors_name_the_fix(
    gpu: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.md"
    page.write_text(gpu.MARKERS[0], encoding="utf-8")
    with pytest.raises(ValueError, match="has no lines"):
        gpu.write_between(page, gpu.MARKERS, "")
    with pytest.raises(SystemExit):
        gpu.main(["--device", "warp:nothing"])
    assert "there are cpu, warp:cpu" in capsys.readouterr().err
