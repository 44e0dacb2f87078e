"""The example that finds a forearm's pose from capacitances and their Jacobian."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import numpy as np
import pytest

import capsense as cs

EXAMPLE = Path(__file__).parents[2] / "examples" / "forearm_pose.py"


@pytest.mark.parametrize("sample", [0, 3, 7])
def test_finds_the_pose(sample: int) -> None:
    """Measured: from a centimetre and some degrees off."""
    example = runpy.run_path(str(EXAMPLE))
    sim, true = cs.Simulator("six_patch_bare", method="surface"), example["path"](10)[sample]
    measured = sim.step(example["scene"](true)).delta[np.triu_indices(6)]
    pose = true + np.array([0.01, 0.008, 0.1, -0.05])
    for _ in range(6):
        pose = example["improve"](sim, pose, measured)
    assert pose[:2] == pytest.approx(true[:2], abs=2e-4)
    assert pose[2:] == pytest.approx(true[2:], abs=5e-3)


def test_follows_the_arm(capsys: pytest.CaptureFixture[str]) -> None:
    """Measured: what the example prints last, with twenty samples."""
    runpy.run_path(str(EXAMPLE))["main"](20)
    last = capsys.readouterr().out.splitlines()[-1]
    lateral, height, turn, rise = map(float, re.findall(r"[\d.]+(?= mm| deg)", last))
    assert max(lateral, height) < 1.0
    assert max(turn, rise) < 2.0
