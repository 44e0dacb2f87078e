"""The example that finds a forearm's pose from capacitances and their Jacobian."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[3] / "examples" / "forearm_pose.py"


def test_follows_the_arm(capsys: pytest.CaptureFixture[str]) -> None:
    """Measured: what the example prints last, with twenty samples."""
    runpy.run_path(str(EXAMPLE))["main"](20)
    last = capsys.readouterr().out.splitlines()[-1]
    lateral, gap, pitch, yaw = map(float, re.findall(r"[\d.]+(?= mm| deg)", last))
    assert max(lateral, gap) < 1.0
    assert max(pitch, yaw) < 2.0
