"""The studies of ``capsense reproduce``, by name."""

from __future__ import annotations

from importlib import import_module
from typing import cast

from capsense.reproduce.study import Study

STUDIES: dict[str, str] = {
    "scenario1": "capsense.reproduce.scenario1:run",
    "scenario2": "capsense.reproduce.scenario2:run",
    "limb-approach": "capsense.reproduce.limb_approach:run",
    "fig8": "capsense.reproduce.fig8:run",
}
"""``"module:function"`` of each study, in the order of ``capsense reproduce all``."""


def load_study(name: str) -> Study:
    """Import the study of that name.

    Raises:
        KeyError: There is no such study.
        MissingDependencyError: It needs an optional package.
    """
    module, function = STUDIES[name].split(":")
    return cast(Study, getattr(import_module(module), function))
