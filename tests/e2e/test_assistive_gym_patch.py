"""The script that patches a checkout of Assistive Gym, on lines as they stand in one."""

from __future__ import annotations

import ast
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

LINES = """import numpy as np
import pybullet as p
from keras.models import load_model
from ray.rllib.env.multi_agent_env import MultiAgentEnv
from ray.tune.registry import register_env
class Env(MultiAgentEnv):
    def make(self):
        human = p.createMultiBody(1, linkJointAxis=a, linkLowerLimits=l, linkUpperLimits=u, flags=0)
        last_sphere_id = p.createMultiBody(0, batchPositions=places, physicsClientId=self.id)
        return list(range(last_sphere_id - 2, last_sphere_id + 1))
    def set_gravity(self, ax=0.0, ay=0.0, az=-9.81):
        p.setGravity(ax, ay, az, body=self.body, physicsClientId=self.id)
        p.setGravity(0, 0, -1, physicsClientId=self.id)
    def pick(self):
        return np.zeros(3, dtype=np.int)[self.np_random.randint(2)]
register_env("a", Env)
"""


@pytest.fixture
def patch() -> Any:
    root = Path(__file__).parents[2]
    return runpy.run_path(str(root / "examples" / "assistive_gym_patch.py"))["patch"]


def test_a_checkout(patch: Any, tmp_path: Path) -> None:
    """Every line that today's packages refuse is replaced, once, and the rest stays."""
    package = tmp_path / "assistive_gym"
    (package / "envs").mkdir(parents=True)
    (package / "__init__.py").write_text("tasks = []\n")
    file = package / "envs" / "env.py"
    file.write_text(LINES)
    assert {f.name for f in patch(tmp_path)} == {"_absent.py", "__init__.py", "env.py"}
    after = file.read_text()
    ast.parse(after)
    for gone in ("linkLowerLimits", "linkUpperLimits", "np.int)", ".randint(", "  p.setGravity(ax"):
        assert gone not in after
    for kept in ("linkJointAxis=a, flags=0", "  p.setGravity(0, 0, -1, physicsClientId"):
        assert kept in after
    assert "max(np.atleast_1d(p.createMultiBody(0, batchPositions" in after
    assert (package / "__init__.py").read_text().startswith("import assistive_gym._absent")
    assert patch(tmp_path) == []
    file.write_text(after.replace("import pybullet as p", "p = None"))
    used = "from assistive_gym.envs.env import *; print(load_model('a').predict_classes([[0.0]]))"
    done = subprocess.run(  # elsewhere: what stands in for a package would be met by other tests
        [sys.executable, "-c", used], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[1]"


def test_what_is_no_checkout(patch: Any, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="no checkout of Assistive Gym"):
        patch(tmp_path)
