"""The example that finds a forearm's pose, on the kernels alone."""

from __future__ import annotations

import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from surface_scenes import Placed, green_of, pack

import capsense as cs
from capsense.constants import EPS0
from capsense.surface.gradient_kernels import jacobian
from capsense.surface.solve_kernels import solve

EXAMPLE = Path(__file__).parents[2] / "examples" / "forearm_pose.py"
UNIT = 4 * np.pi * EPS0


class _Simulator:
    """Steps of one body, with their Jacobian."""

    def step(self, scene: cs.Scene, jacobian: bool = False) -> SimpleNamespace:
        body = scene[0]
        bodies = pack(Placed(body.shape, body.pose.position))  # type: ignore[arg-type]
        bodies["rotation"][0] = body.pose.rotation
        solution = solve(bodies, green_of(), 0.015, 2.5, True)
        return SimpleNamespace(delta=UNIT * solution.delta, jacobian=_jacobian(solution, bodies))


def _jacobian(solution: object, bodies: np.ndarray) -> np.ndarray:
    return UNIT * jacobian(solution, bodies, green_of())


@pytest.mark.parametrize("sample", [0, 3, 7])
def test_finds_the_pose(sample: int) -> None:
    example = runpy.run_path(str(EXAMPLE))
    sim, true = _Simulator(), example["path"](10)[sample]
    measured = sim.step(example["scene"](true)).delta[np.triu_indices(6)]
    pose = true + np.array([0.01, 0.008, 0.1, -0.05])
    for _ in range(6):
        pose = example["improve"](sim, pose, measured)
    assert pose[:2] == pytest.approx(true[:2], abs=2e-4)
    assert pose[2:] == pytest.approx(true[2:], abs=5e-3)
