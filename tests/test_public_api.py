"""The public names, and that getting at them is cheap."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.metadata import version

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
        "from capsense.cli.main import build_parser; build_parser()",
    ],
)
def test_import_is_light(statement: str) -> None:
    """Neither the package nor the command line's parser imports numerics."""
    assert not HEAVY & modules_after(statement)


def test_every_name_resolves_to_one_home() -> None:
    """Each public name imports, once, from the module that defines it."""
    for name in cs.__all__:
        value = getattr(cs, name)
        assert getattr(cs, name) is value
        home = getattr(value, "__module__", "capsense")
        assert home.startswith(("capsense", "types")), (name, home)
    assert set(cs.__all__) <= set(dir(cs))
    assert len(cs.__all__) == len(set(cs.__all__))


def test_documented_contract() -> None:
    """The names that the documentation promises."""
    promised = {"load_design", "Simulator", "Reading", "Scenario", "load_scenario"}
    promised |= {"Scene", "Body", "Pose", "Material"}
    promised |= {"Box", "Sphere", "Capsule", "Cylinder", "Ellipsoid", "TriMesh"}
    assert promised <= set(cs.__all__)
    assert cs.__version__ == version("capsense")


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
