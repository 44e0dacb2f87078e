"""The benchmark against other solvers: every method solves the same systems to the same answer."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from scipy.sparse.linalg import splu

from capsense.mesh import TetMesh, kuhn_tets

ROOT = Path(__file__).parents[3]
MODULES = ("peers_task", "peers_iterative", "peers_direct", "peers_ngsolve", "peers_report")
METHODS = {
    "JacobiCg": ("peers_iterative", ()),
    "PlainCg": ("peers_iterative", ()),
    "AmgCg": ("peers_iterative", ("pyamg",)),
    "AmgRebuiltCg": ("peers_iterative", ("pyamg",)),
    "ScikitFem": ("peers_iterative", ("skfem",)),
    "Pardiso": ("peers_direct", ("pypardiso",)),
    "Cholmod": ("peers_direct", ("sksparse",)),
    "NgSolve": ("peers_ngsolve", ("ngsolve",)),
}
PLACES = ((0.0, 0.03), (0.02, 0.03), (0.05, 0.012))


@pytest.fixture(scope="module")
def parts() -> dict[str, ModuleType]:
    """The benchmark's modules."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "benchmarks"))
        found = {name: import_module(name) for name in MODULES}
    for name in MODULES:
        sys.modules.pop(name)
    return found


@pytest.fixture(scope="module")
def mesh(parts: dict[str, ModuleType]) -> TetMesh:
    """A coarse lattice with nodes on the six electrodes."""
    x = np.concatenate([[-0.25, -0.15], np.linspace(-0.09, 0.09, 10), [0.15, 0.25]])
    z = np.array([-0.01, -0.005, 0.0, 0.01, 0.02, 0.03, 0.04, 0.05, 0.08, 0.2, 0.49])
    lattice = kuhn_tets(x, x, z)
    groups = dict(lattice.node_groups)
    for electrode in parts["peers_task"].design().electrodes:
        low, high = electrode.surface.bounds
        inside = ((lattice.points > low - 1e-9) & (lattice.points < high + 1e-9)).all(axis=1)
        groups[electrode.name] = np.flatnonzero(inside).astype(np.int32)
    return TetMesh(lattice.points, lattice.tets, node_groups=groups)


def direct(system: Any, x: float, gap: float) -> np.ndarray:
    """C [F] by SciPy's direct solver with the bar's nodes taken out."""
    free = np.flatnonzero(~system.held(x, gap))
    loads = system.loads[free]
    return system.fixed_energy - loads.T @ splu(system.matrix[free][:, free].tocsc()).solve(loads)


@pytest.mark.parametrize("name", METHODS)
def test_a_peer_solves_the_same_problem(
    name: str, parts: dict[str, ModuleType], mesh: TetMesh
) -> None:
    """ΔC within 1e-3 of a direct solve: as near as CapSense's default tolerance, and single
    precision, leave it; also from the last place's solution.
    """
    module, needed = METHODS[name]
    for package in needed:
        pytest.importorskip(package)
    system = parts["peers_task"].p1_system(mesh)
    method = getattr(parts[module], name)(mesh if name == "NgSolve" else system)
    empty = direct(system, 9.0, 9.0)
    for x, gap in PLACES:
        assert system.held(x, gap).any()
        expected = direct(system, x, gap) - empty
        found = method.step(x, gap) - empty
        assert np.abs(found - expected).max() < 1e-3 * np.abs(expected).max()
    if hasattr(method, "close"):
        method.close()


def test_ratios_are_taken_within_a_group(parts: dict[str, ModuleType]) -> None:
    """The best peer within 3 % is held against CapSense in the run of that peer."""
    row = {"name": "CapSense", "label": "capsense", "tetrahedra": 0, "worst": 0.01,
           "settings": "Simulator.step, preset standard"}  # fmt: skip
    peer = {"name": "a peer", "label": "peer", "tetrahedra": 2000, "worst": 0.02}
    results = {
        "fast": {"results": [row | {"median_ms": 1.0}, peer | {"median_ms": 5.0, "worst": 0.2}]},
        "good": {"results": [row | {"median_ms": 4.0}, peer | {"median_ms": 100.0}]},
        "slow": {"results": [peer | {"median_ms": 500.0}, {"label": "gone", "missing": "no"}]},
    }
    text = parts["peers_report"].report(results)
    assert "ratio 25" in text
    assert "500.00" not in text


def test_the_plot_is_drawn_from_what_there_is(parts: dict[str, ModuleType], tmp_path: Path) -> None:
    """Methods that were not measured leave no gap."""
    row = {"name": "CapSense", "label": "capsense", "tetrahedra": 1000, "worst": 0.01,
           "median_ms": 1.0}  # fmt: skip
    parts["peers_report"].plot({"30k": {"results": [row]}}, tmp_path / "plot.png")
    assert (tmp_path / "plot.png").stat().st_size > 1000


def test_presets_are_points_of_one_line(parts: dict[str, ModuleType], tmp_path: Path) -> None:
    """They have no mesh; what tells them apart is the preset, which the report names."""
    report = parts["peers_report"]
    row = {"name": "CapSense", "label": "capsense", "tetrahedra": 0, "worst": 0.01}
    results = {
        preset: {
            "results": [row | {"median_ms": k, "settings": f"Simulator.step, preset {preset}"}]
        }
        for k, preset in enumerate(("fast", "fine"), start=1)
    }
    points = [report.rows(results, group)["capsense"] for group in results]
    assert len({report.point_key(point) for point in points}) == 2
    assert [report.size_label(point) for point in points] == ["fast", "fine"]
    report.plot(results, tmp_path / "plot.png")
    assert (tmp_path / "plot.png").stat().st_size > 1000
