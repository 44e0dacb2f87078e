"""Benchmark of the first millimetres: what it compares, and the references that it computes."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from approximate import approx
from benchmark_modules import imported

from capsense.design import parse_design

ROOT = Path(__file__).parents[3]
MODULES = ("near_map", "near_reference")
FILES = ("near_map.json", "near_held_out.json")


@pytest.fixture(scope="module")
def parts() -> Iterator[dict[str, ModuleType]]:
    """The benchmark's modules."""
    with imported(*MODULES) as found:
        yield found


@pytest.mark.parametrize("name", FILES)
def test_references_are_symmetric_over_designs_that_load(
    parts: dict[str, ModuleType], name: str
) -> None:
    data = json.loads((ROOT / "tests" / "data" / name).read_text(encoding="utf-8"))
    for case in data["cases"]:
        design = parts["near_map"].load_design(case["design"], data.get("designs", {}))
        delta = np.array(case["delta_fF"])
        assert delta.shape == (len(design.electrodes),) * 2
        np.testing.assert_allclose(delta, delta.T, atol=1e-3 * delta.max())
        assert (np.diag(delta) > 0).all()
        gap = min(map(parts["near_map"].lowest, case["bodies"])) - parts["near_map"].top(design)
        assert gap > 4e-5


def test_errors_count_beyond_the_reference(parts: dict[str, ModuleType]) -> None:
    truth = np.array([[100.0, 4.0, -2.0], [4.0, 50.0, 1.0], [-2.0, 1.0, 5.0]])
    delta = np.array([[90.0, -5.0, 0.0], [-5.0, 50.5, 0.0], [0.0, 0.0, 0.0]])
    row = parts["near_map"].compare(delta, truth, 0.02)
    assert row["entries"] == [0, 1]
    np.testing.assert_allclose(row["diagonal"], [-0.1, 0.01])
    np.testing.assert_allclose(row["beyond"], [-0.08, 0.0], atol=1e-12)
    assert row["pairs"] == [[0, 1]]
    np.testing.assert_allclose(row["mutual"], [-2.25])
    assert row["wrong_signs"] == 1


def test_lowest_point_of_a_tilted_capsule(parts: dict[str, ModuleType]) -> None:
    half = np.sqrt(0.5)
    body = {"shape": "capsule", "size": [0.01, 0.04], "position": [0, 0, 0.05],
            "quaternion": [0, np.sin(np.pi / 6), 0, np.cos(np.pi / 6)]}  # fmt: skip
    assert parts["near_map"].lowest(body) == approx(0.05 - 0.01 - 0.02 * 0.5)
    body["quaternion"] = [0, half, 0, half]
    assert parts["near_map"].lowest(body) == approx(0.04)


@pytest.mark.parametrize("k", [0.02, 0.25])
def test_discs_of_the_script_are_those_of_love(parts: dict[str, ModuleType], k: float) -> None:
    exact = {row[0]: row[1] for row in parts["near_map"].love_table()}[k]
    assert parts["near_map"].disc_and_body(k, 0.0, 80) == approx(exact, rel=1e-3)
    thin = parts["near_map"].disc_and_body(k, 1e-4, 80)
    assert exact < parts["near_map"].disc_and_body(k, 0.1, 80) * 1.001
    assert thin == approx(exact, rel=3e-3)


def test_boundary_elements_of_references_give_discs_of_love(parts: dict[str, ModuleType]) -> None:
    exact = {row[0]: row[1] for row in parts["near_map"].love_table()}[0.05]
    assert parts["near_reference"].exact_discs(0.05, 1.7) == approx(exact, rel=0.01)


def test_random_designs_can_be_built(parts: dict[str, ModuleType]) -> None:
    reference = parts["near_reference"]
    for number, kind in enumerate(reference.KINDS):
        rng = np.random.default_rng([1, number])
        design = parse_design(tomllib.loads(reference.random_design(kind, kind, rng)))
        for what in dict.fromkeys(reference.BODIES):
            body = reference.random_body(design, what, rng)
            gap = reference.lowest(body)[2] - parts["near_map"].top(design)
            assert 4.9e-5 < gap < 5.1e-3
            assert gap == approx(
                parts["near_map"].lowest(body) - parts["near_map"].top(design), abs=1e-8
            )
