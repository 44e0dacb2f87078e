"""Figures of a pad over its own ground plane that floats, against boundary elements of everything.

The example builds three fields of some 20 s each on a slow core.
"""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np
import pytest

import capsense as cs
from capsense.design import parse_design
from capsense.field.boundary import Accuracy, BoundarySolution

EXAMPLES = Path(__file__).parents[3] / "examples"
DESIGN = EXAMPLES / "designs" / "pad_over_ground.toml"
TIES = [0.0, 1e-12, 1e-11, 1e-10]
PUBLISHED = np.array([0.283, 0.478, 1.58, 2.76, 3.015])
"""Plate of 0.1 m over its own ground plane 3 mm below, grounded box 20 mm above, open, at a C_g of
0, 1, 10, 100 pF, and earthed [pF]; how thick the box is is not said."""


def whole_matrix(hand: bool, scale: float) -> np.ndarray:
    """Maxwell matrix of pad, plane and hand by boundary elements of all together [F]."""
    sheet = {"shape": "rectangle", "size": [0.1, 0.1]}
    conductors = [{"name": "plane", "role": "shield", "z": -0.003, **sheet}]
    if hand:
        box = {"shape": "box", "size": [0.1, 0.1, 0.02], "center": [0.0, 0.0], "z": 0.03}
        conductors.append({"name": "hand", "role": "shield", **box})
    design = parse_design({
        "name": "all", "conductor": conductors, "electrode": [{"name": "pad", **sheet}],
        "domain": {"size": [1.0, 1.0, 1.0], "backplane": 0.5, "open": True},
    })  # fmt: skip
    solution = BoundarySolution(design.in_units, Accuracy(scale, fitted=False))
    charges = solution.terminal_charges(solution.densities(np.eye(solution.model.n_terminals)))
    return 0.5 * design.unit * (charges + charges.T)


def reading(matrix: np.ndarray, tie: float) -> float:
    """Charge of the pad at 1 V against the plane, by Kirchhoff's laws, with the hand at earth."""
    # Unknowns: potential of the plane, charge of the pad, charge of the plane [pF, V].
    c = matrix[:2, :2] / 1e-12
    system = np.array([
        [c[0, 0] + c[0, 1], -1.0, 0.0],
        [c[1, 0] + c[1, 1], 0.0, -1.0],
        [tie / 1e-12, 1.0, 1.0],
    ])  # fmt: skip
    return float(np.linalg.solve(system, [-c[0, 0], -c[1, 0], 0.0])[1])


def by_boundary_elements(scale: float = 1.0) -> np.ndarray:
    """Changes by the hand at the capacitances of :data:`TIES` and with an earthed plane [pF]."""
    with_hand, empty = whole_matrix(True, scale), whole_matrix(False, scale)
    floating = [reading(with_hand, tie) - reading(empty, tie) for tie in TIES]
    return np.array([*floating, (with_hand - empty[0, 0])[0, 0] / 1e-12])


def test_boundary_elements_have_converged() -> None:
    """Differential: against coarser panels, and the published figures, whose box may be another."""
    fine, coarse = by_boundary_elements(), by_boundary_elements(2.0)
    np.testing.assert_allclose(coarse, fine, rtol=5e-3)
    np.testing.assert_allclose(fine, PUBLISHED, rtol=0.02)


def test_the_example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, field_cache: Path) -> None:
    """Differential: all of its readings of a hand on earth are within 2 % of boundary elements."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    module = importlib.import_module("floating_ground")
    monkeypatch.setenv("CAPSENSE_CACHE_DIR", str(field_cache))
    found = module.main(tmp_path)["hand on earth"]
    assert (tmp_path / "floating_ground.png").stat().st_size > 10_000
    expected = by_boundary_elements()
    chosen = 1e12 * found[[0, 1, 2, 3, -1]]
    np.testing.assert_allclose(chosen, expected, rtol=0.02)
    np.testing.assert_allclose(chosen, PUBLISHED, rtol=0.03)
    printed = [value for value in module.REFERENCE if value is not None]
    np.testing.assert_allclose(printed, expected, rtol=1e-3)
    plain = cs.load_design(DESIGN)
    earthed = cs.Simulator(plain.with_grounding("grounded"))
    assert earthed.background.terminals == ("pad",)
    assert cs.Simulator(plain).background.terminals == ("pad", "local ground")
