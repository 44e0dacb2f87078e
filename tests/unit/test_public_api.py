"""The public names, and that getting at them is cheap."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections import Counter
from importlib.metadata import version
from pathlib import Path

import pytest

import capsense as cs

LOADED_AFTER = """
import json, sys
{statement}
print(json.dumps(sorted(sys.modules)))
"""
HEAVY = {"numpy", "scipy", "numba", "shapely", "trimesh", "matplotlib", "gmsh", "meshio", "tqdm"}


def modules_after(statement: str) -> set[str]:
    """Top-level modules loaded by a fresh interpreter after a statement."""
    done = subprocess.run(
        [sys.executable, "-c", LOADED_AFTER.format(statement=statement)],
        capture_output=True,
        text=True,
        check=True,
    )
    return {name.partition(".")[0] for name in json.loads(done.stdout.splitlines()[-1])}


@pytest.mark.parametrize(
    "statement",
    [
        "import capsense",
        "import capsense; capsense.CapSenseError; dir(capsense); capsense.__all__",
        "from capsense.__main__ import build_parser; build_parser()",
    ],
)
def test_import_is_light(statement: str) -> None:
    """Neither the package nor the command line's parser imports numerics."""
    assert not HEAVY & modules_after(statement)


def test_every_name_resolves_to_one_home() -> None:
    """Each public name imports, once, from the module that defines it."""
    for module, extra in ("mcap", "record"), ("mujoco", "mujoco"), ("websockets", "serve"):
        pytest.importorskip(module, reason=f'needs pip install "capsense[{extra}]"')
    for name in cs.__all__:
        value = getattr(cs, name)
        assert getattr(cs, name) is value
        home = getattr(value, "__module__", "capsense")
        assert home.startswith(("capsense", "types")), (name, home)
    assert set(cs.__all__) <= set(dir(cs))
    assert len(cs.__all__) == len(set(cs.__all__))


def test_documented_contract() -> None:
    """The names are those that the documentation lists."""
    page = Path(__file__).parents[2] / "docs" / "conventions.md"
    listed = page.read_text(encoding="utf-8").partition("## Public names")[2].partition("\n\n|")[2]
    rows = listed.partition("\n\n")[0].splitlines()[2:]
    names = [name for row in rows for name in re.findall(r"`(\w+)`", row)]
    assert sorted(names) == sorted(cs.__all__)
    assert cs.__version__ == version("capsense")


def test_no_two_classes_have_one_name() -> None:
    counts = Counter(
        name
        for file in Path(cs.__file__).parent.rglob("*.py")
        for name in re.findall(r"^ *class (\w+)[(:\[]", file.read_text(encoding="utf-8"), re.M)
    )
    assert counts["Simulator"] == counts["Recorder"] == 1
    assert not {name for name, count in counts.items() if count > 1}


def test_unknown_name() -> None:
    """A wrong name is an AttributeError, as for any module."""
    with pytest.raises(AttributeError, match="no attribute 'Simulater'"):
        _ = cs.Simulater
    assert not hasattr(cs, "nothing")


def test_errors_share_a_base() -> None:
    """One ``except`` catches everything raised on purpose."""
    for name in cs.__all__:
        if name.endswith("Error"):
            assert issubclass(getattr(cs, name), cs.CapSenseError)
