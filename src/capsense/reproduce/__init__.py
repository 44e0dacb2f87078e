"""The evaluation of Schöffmann et al. 2022, and what goes beyond it, each from one command.

A study is a function ``run(folder, *, reduced, report) -> Outcome`` in a module of its own, listed
in :data:`STUDIES`. :mod:`~capsense.reproduce.harness` says what it
returns; :class:`capsense.reproduce.harness.Store` keeps what it has computed.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, cast

from capsense.errors import MissingDependencyError

if TYPE_CHECKING:
    from capsense.reproduce.harness import Study

STUDIES: dict[str, str] = {
    "scenario1": "capsense.reproduce.scenario1:run",
    "scenario2": "capsense.reproduce.scenario2:run",
    "limb-approach": "capsense.reproduce.limb_approach:run",
    "fig8": "capsense.reproduce.fig8:run",
}
"""``"module:function"`` of each study, in the order of ``capsense reproduce all``."""
NEEDS: dict[str, tuple[str, ...]] = {"scenario2": ("mujoco", "pybullet")}
"""Optional packages of a study, which are named like the extras that bring them."""


def load_study(name: str) -> Study:
    """Import the study of that name.

    Raises:
        KeyError: There is no such study.
        MissingDependencyError: It needs an optional package.
    """
    missing = [package for package in NEEDS.get(name, ()) if find_spec(package) is None]
    if missing:
        raise MissingDependencyError(
            f"study {name} needs {' and '.join(missing)}, not installed here; "
            f"pip install 'capsense[{','.join(missing)}]'"
        )
    module, function = STUDIES[name].split(":")
    return cast("Study", getattr(import_module(module), function))
