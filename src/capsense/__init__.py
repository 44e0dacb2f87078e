"""CapSense: real-time simulation of capacitive proximity sensors for robots.

The public names are listed in ``docs/conventions.md``. They are imported at first use, so that
``import capsense`` itself is light: ``__init__.pyi`` says where each is from, to type checkers and
to :func:`__getattr__`.
"""

from __future__ import annotations

import ast
from importlib import import_module
from pathlib import Path
from typing import Any

from capsense._kernel_cache import ensure_place

ensure_place(Path(__file__).parent)

_HOMES = {
    name.name: str(node.module)
    for node in ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")).body
    if isinstance(node, ast.ImportFrom)
    for name in node.names
}
"""The module of each public name."""
_MODULES = ("humans", "skin", "assistive_gym", "coppeliasim", "mujoco", "pybullet")
__all__ = ["__version__", *_HOMES]


def __getattr__(name: str) -> Any:
    """Import a public name, or a submodule, at first use (PEP 562)."""
    value: Any
    if name == "__version__":
        from importlib.metadata import version

        value = version("capsense")
    elif name not in _HOMES:
        raise AttributeError(f"module 'capsense' has no attribute {name!r}")
    elif name in _MODULES:
        value = import_module(f"{_HOMES[name]}.{name}")
    else:
        value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
