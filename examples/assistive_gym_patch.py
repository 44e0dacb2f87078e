"""Make a checkout of Assistive Gym 1.0 run with today's Python, NumPy, Gym and PyBullet.

    git clone https://github.com/Healthcare-Robotics/assistive-gym
    python examples/assistive_gym_patch.py assistive-gym
    pip install gym==0.26.2 "capsense[pybullet]"
    PYTHONPATH=assistive-gym python examples/assistive_gym_check.py

The files of the checkout are changed in place; running the script again changes nothing more. What
the patches are for:

- PyBullet from the package index lacks what a fork has: limits of links that are made in Python,
  and gravity by body. Both are left out: a person's joints have no limits of their own, and gravity
  acts on robots, whose motors hold them.
- Making many bodies at once returns the numbers of all of them, where the last was expected.
- ``np.int`` and ``randint`` of NumPy's old generators are gone.
- Ray, Torch, SMPL-X, Keras and screeninfo, which environments of one robot do not need, are
  replaced by empty stand-ins where they are not installed.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

PATCHES = (
    (r", linkLowerLimits=\w+, linkUpperLimits=\w+", ""),
    (r", linkLowerLimits=\[0\], linkUpperLimits=\[0\]", ""),
    (r"^(\s*)p\.setGravity\((.*), body=[\w.]+(, .*)$", r"\1pass  # p.setGravity(\2, body\3"),
    (r"(last_sphere_id = )(p\.createMultiBody\(.*\))$", r"\1max(np.atleast_1d(\2))"),
    (r"\bnp\.int\b", "int"),
    (r"\bnp_random\.randint\(", "np_random.integers("),
)
"""What is replaced, line by line, and by what."""
ABSENT = '''"""Empty stand-ins for packages that are not installed."""

import importlib
import sys
import types


class _Anything:
    def __init__(self, *args, **kwargs):
        pass

    def predict_classes(self, poses):
        return [1] * len(poses)  # every pose of an arm is possible


_NAMES = {
    "ray": (), "ray.rllib": (), "ray.rllib.env": (), "ray.tune": (),
    "ray.rllib.env.multi_agent_env": ("MultiAgentEnv",), "ray.tune.registry": ("register_env",),
    "torch": (), "smplx": (), "screeninfo": ("get_monitors",), "keras": (),
    "keras.models": ("load_model",),
}
for _name, _members in _NAMES.items():
    try:
        importlib.import_module(_name)
    except Exception:
        _module = sys.modules[_name] = types.ModuleType(_name)
        for _member in _members:
            setattr(_module, _member, type(_member, (_Anything,), {}))
'''
FIRST = "import assistive_gym._absent  # noqa\n"


def patch(checkout: Path) -> list[Path]:
    """Patch a checkout; returns the files that were changed.

    Raises:
        SystemExit: It is none.
    """
    package = checkout / "assistive_gym"
    if not (package / "envs" / "env.py").is_file():
        raise SystemExit(f"{checkout} is no checkout of Assistive Gym; it lacks {package}/envs")
    changed = []
    absent = package / "_absent.py"
    if not absent.is_file():
        absent.write_text(ABSENT, encoding="utf-8")
        changed.append(absent)
    for file in sorted(set(package.rglob("*.py")) - {absent}):
        before = file.read_text(encoding="utf-8")
        after = before
        for old, new in PATCHES:
            after = re.sub(old, new, after, flags=re.MULTILINE)
        if file == package / "__init__.py" and not after.startswith(FIRST):
            after = FIRST + after
        if after != before:
            file.write_text(after, encoding="utf-8")
            changed.append(file)
    return changed


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("checkout", type=Path, help="the folder that git cloned")
    for path in patch(parser.parse_args().checkout):
        print("patched", path)
