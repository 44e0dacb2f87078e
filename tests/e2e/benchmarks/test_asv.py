"""The benchmarks for asv run, each once."""

from __future__ import annotations

import importlib.util
import inspect
import itertools
import json
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).parents[3]
FOLDER = ROOT / "benchmarks" / "asv"


def module(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"asv_{name}", FOLDER / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


MODULES = {path.stem: module(path.stem) for path in FOLDER.glob("[a-z]*.py")}
CLASSES = {
    f"{name}.{title}": kind
    for name, made in MODULES.items()
    for title, kind in inspect.getmembers(made, inspect.isclass)
    if kind.__module__ == made.__name__
}
NAMES = [
    f"{title}.{method}"
    for title, kind in CLASSES.items()
    for method in vars(kind)
    if method.startswith(("time_", "track_"))
]


def cases(kind: type) -> list[tuple[Any, ...]]:
    """The parameters of each call: asv takes one list, or a list of lists."""
    params = getattr(kind, "params", ())
    if not params:
        return [()]
    return list(itertools.product(*(params if isinstance(params[0], tuple) else [params])))


@pytest.mark.parametrize("name", NAMES)
def test_runs(name: str) -> None:
    title, _, method = name.rpartition(".")
    for case in cases(CLASSES[title]):
        made = CLASSES[title]()
        try:
            made.setup(*case)
        except NotImplementedError as error:
            pytest.skip(str(error))
        value = getattr(made, method)(*case)
        assert value is None or value > 0


def test_a_sensor_sees_the_finger() -> None:
    pytest.importorskip("mujoco")
    made = MODULES["attach"].Attach()
    made.setup()
    assert made.sensor.read().delta.diagonal().max() > 1e-15


def test_configuration_names_the_folder() -> None:
    config = json.loads((ROOT / "asv.conf.json").read_text(encoding="utf-8"))
    assert (ROOT / config["benchmark_dir"]).samefile(FOLDER)
