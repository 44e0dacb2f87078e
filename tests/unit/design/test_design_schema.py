"""Designs with one thing wrong: each must be refused with its name, its value and a fix."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import Any

import pytest
from changed_data import DROP, changed_copy

from capsense.design import load_design, parse_design
from capsense.errors import CapSenseError, DesignError

BASE = tomllib.loads(
    """
    name = "base"
    [domain]
    size = [0.5, 0.5, 0.5]
    backplane = 0.010
    [[electrode]]
    name = "A"
    shape = "rectangle"
    size = [0.03, 0.03]
    center = [-0.03, 0.0]
    [[electrode]]
    name = "B"
    shape = "disc"
    radius = 0.015
    center = [0.03, 0.0]
    [[layer]]
    name = "plate"
    material = "polycarbonate"
    size = [0.115, 0.085]
    z = [-0.001, 0.0]
    [[conductor]]
    name = "back"
    role = "ground"
    shape = "rectangle"
    size = [0.1, 0.08]
    z = -0.001
    """
)
INF, NAN = float("inf"), float("nan")
NEXT_LAYER = {"name": "film", "eps_r": 3.0, "size": [0.1, 0.08]}
POUR = {"name": "pour", "role": "ground", "shape": "rectangle", "size": [0.11, 0.08]}


def changed(*changes: tuple[str, Any]) -> dict[str, Any]:
    """The base design with values replaced, or dropped, at dotted paths."""
    return changed_copy(BASE, *changes)


A, B, PLATE, BACK = "electrode.0.", "electrode.1.", "layer.0.", "conductor.0."
TRACK = (A + "shape", "polygon"), (A + "size", DROP)
COMB = (
    (A + "shape", "comb"),
    (A + "size", DROP),
    (A + "fingers", 3),
    (A + "finger_size", [0.002, 0.02]),
    (A + "spine_width", 0.002),
)
MEANDER = (
    (A + "shape", "meander"),
    (A + "size", DROP),
    (A + "width", 1e-5),
    (A + "pitch", 2e-5),
    (A + "length", 0.01),
)
PLATE_OF_ITS_OWN = ((PLATE + "material", DROP),)
STRIPES = (A + "shape", "stripes"), (A + "size", [0.004, 0.03]), (A + "count", 3)

# what is changed; what the message must contain: the item, the value, the fix
BAD: dict[str, tuple[tuple[tuple[str, Any], ...], tuple[str, ...]]] = {
    "unknown top key": ((("electrodes", []),), ("design", "'electrodes'", "'electrode'")),
    "unknown key": (((A + "centre", [0, 0]),), ('electrode "A"', "'centre'", "'center'")),
    "key of another shape": (((A + "radius", 0.1),), ('electrode "A"', "'radius'", "size")),
    "unknown domain key": ((("domain.height", 1),), ("domain", "'height'", "backplane")),
    "unknown build key": ((("build.resolutoin", 1),), ("build", "'resolutoin'", "'resolution'")),
    "build range": ((("build.resolution", 9),), ("build", "9", "from 0.25 to 4")),
    "no name": ((("name", DROP),), ("design", "'name'", "add name")),
    "no domain": ((("domain", DROP),), ("design", "'domain'", "[domain]")),
    "no electrode": ((("electrode", []),), ("design", "no electrode", "[[electrode]]")),
    "electrode not an array": ((("electrode", {}),), ("design", "'electrode'", "[[electrode]]")),
    "electrode not a table": ((("electrode", [3]),), ("electrode 1", "3", "table")),
    "nameless": (((A + "name", DROP),), ("electrode 1", "'name'", "add name")),
    "empty name": (((A + "name", " "),), ("electrode", "' '", "non-empty")),
    "no shape": (((A + "shape", DROP),), ('electrode "A"', "'shape'", "rectangle")),
    "shape": (((A + "shape", "rectangel"),), ('electrode "A"', "'rectangel'", "'rectangle'")),
    "missing size": (((A + "size", DROP),), ('electrode "A"', "'size'", "[x, y]")),
    "millimetres": (((A + "size", [30, 30]),), ('electrode "A"', "size = 30", "mean 0.03?")),
    "mm center": (((B + "center", [38, 0]),), ('electrode "B"', "center = 38", "mean 0.038?")),
    "mm radius": (((B + "radius", 15.0),), ('electrode "B"', "radius = 15", "mean 0.015?")),
    "mm domain": ((("domain.size", [500, 500, 500]),), ("domain", "500", "mean 0.5?")),
    "larger than domain": (((B + "radius", 0.6),), ('electrode "B"', "0.6", "metres")),
    "mm layer": (((PLATE + "z", [-1, 0]),), ('layer "plate"', "z = -1", "mean -0.001?")),
    "size of one": (((A + "size", 0.03),), ('electrode "A"', "0.03", "[x, y] in metres")),
    "size of three": (((A + "size", [0.1, 0.1, 0.1]),), ('electrode "A"', "0.1", "[x, y]")),
    "negative size": (((A + "size", [-0.03, 0.03]),), ('electrode "A"', "-0.03", "positive")),
    "zero size": (((A + "size", [0, 0.03]),), ('electrode "A"', "size = 0", "positive")),
    "tiny size": (((A + "size", [3e-9, 0.03]),), ('electrode "A"', "3e-09", "metres")),
    "string": (((A + "size", ["30 mm", 0.03]),), ('electrode "A"', "'30 mm'", "number")),
    "boolean": (((B + "radius", True),), ('electrode "B"', "radius = True", "number")),
    "infinite": (((B + "radius", INF),), ('electrode "B"', "inf", "finite")),
    "nan": (((A + "center", [NAN, 0.0]),), ('electrode "A"', "nan", "finite")),
    "corner": (((A + "corner_radius", 0.02),), ('electrode "A"', "0.02", "at most 0.015")),
    "two heights": (
        ((A + "z", 0.01), (A + "center", [0, 0, 0.1])),
        ('electrode "A"', "z = 0.01", "keep one"),
    ),
    "two turns": (
        ((A + "rotation", 10), (A + "quaternion", [0, 0, 0, 1])),
        ('electrode "A"', "rotation = 10", "keep one"),
    ),
    "quaternion": (((A + "quaternion", [1, 1, 0, 1]),), ('electrode "A"', "1.732", "unit")),
    "tilt": (((A + "tilt", [0, 900, 0]),), ('electrode "A"', "900", "±360")),
    "rotation": (((A + "rotation", 1e9),), ('electrode "A"', "1e+09", "360 degrees")),
    "ring": (
        (
            (B + "shape", "ring"),
            (B + "radius", DROP),
            (B + "inner_radius", 0.02),
            (B + "outer_radius", 0.01),
        ),
        ('electrode "B"', "0.02", "swap"),
    ),
    "bow tie": (
        (*TRACK, (A + "points", [[0, 0], [0.01, 0.01], [0.01, 0], [0, 0.01]])),
        ('electrode "A"', "Self-intersection", "in order"),
    ),
    "flat polygon": (
        (*TRACK, (A + "points", [[0, 0], [0.01, 0], [0.02, 0]])),
        ('electrode "A"', "points", "corners"),
    ),
    "two points": (
        (*TRACK, (A + "points", [[0, 0], [0.01, 0]])),
        ('electrode "A"', "[[0, 0], [0.01, 0]]", "at least 3"),
    ),
    "stripe pitch": ((*STRIPES, (A + "pitch", 0.003)), ('electrode "A"', "0.003", "exceed")),
    "no pitch": (STRIPES, ('electrode "A"', "'pitch'", "metres")),
    "count": (
        (*STRIPES, (A + "count", 2.5), (A + "pitch", 0.01)),
        ('electrode "A"', "2.5", "integer from 1"),
    ),
    "comb pitch": ((*COMB, (A + "pitch", 0.001)), ('electrode "A"', "0.001", "exceed")),
    "comb side": (
        (*COMB, (A + "pitch", 0.005), (A + "side", "botom")),
        ('electrode "A"', "'botom'", "'bottom'"),
    ),
    "meander": (
        (
            (A + "shape", "meander"),
            (A + "size", DROP),
            (A + "turns", 2),
            (A + "width", 0.004),
            (A + "pitch", 0.003),
            (A + "length", 0.02),
        ),
        ('electrode "A"', "0.003", "exceed"),
    ),
    "loose lead": (
        ((A + "leads", [{"points": [[0.02, 0.0], [0.02, 0.02]], "width": 0.001}]),),
        ('electrode "A": leads[0]', "0.02", "start the lead on it"),
    ),
    "lead width": (
        ((A + "leads", [{"points": [[0.0, 0.0], [0.0, 0.02]]}]),),
        ('electrode "A": leads[0]', "'width'", "metres"),
    ),
    "duplicate": (((B + "name", "A"),), ('electrode "A"', "'A'", "own name")),
    "duplicate conductor": (((BACK + "name", "A"),), ('conductor "A"', "'A'", "own name")),
    "overlap": (((B + "center", [0.0, 0.0]),), ('"A"', '"B"', "m, a short", "move them apart")),
    "touch": (((B + "center", [-0.03, 0.03]),), ('"A"', '"B"', "short circuit", "apart")),
    "nested": (((B + "center", [-0.03, 0.0]),), ('"A"', '"B"', "short circuit", "apart")),
    "crossing": (
        (
            (B + "center", [-0.03, 0.0]),
            (B + "radius", 0.005),
            (B + "tilt", [0, 90, 0]),
            ("layer", []),
            ("conductor", []),
        ),
        ('electrode "A"', '"B"', "short circuit", "apart"),
    ),
    "touching along a tilt": (
        (
            (B + "shape", "rectangle"),
            (B + "radius", DROP),
            (B + "size", [0.02, 0.02]),
            (B + "center", [-0.015, 0.0, 0.01]),
            (B + "tilt", [0, 90, 0]),
        ),
        ('electrode "A"', '"B"', "(-0.015,", "apart"),
    ),
    "electrode on pour": (
        (("conductor.+", POUR),),
        ('electrode "A"', 'conductor "pour"', "clearance = 0.0005"),
    ),
    "clearance eats it": (
        (
            (
                "conductor.+",
                {**POUR, "size": [0.02, 0.02], "center": [-0.03, 0], "clearance": 0.001},
            ),
        ),
        ('conductor "pour"', "0.001", "reduce clearance"),
    ),
    "clearance zero": (
        (("conductor.+", {**POUR, "clearance": 0.0}),),
        ('conductor "pour"', "clearance = 0", "positive"),
    ),
    "clearance on a box": (
        (
            (
                "conductor.+",
                {**POUR, "shape": "box", "size": [0.09, 0.07, 0.02], "clearance": 0.001, "z": 0.01},
            ),
        ),
        ('conductor "pour"', "0.001", "flat"),
    ),
    "roles touch": (
        (("conductor.+", {**POUR, "role": "shield", "z": -0.001}),),
        ('conductor "back"', 'conductor "pour"', "short circuit", "apart"),
    ),
    "double ground": (
        (("conductor.+", {**POUR, "z": -0.001}),),
        ('conductor "pour"', "8000 mm²", "cut one"),
    ),
    "role": (((BACK + "role", "gnd"),), ('conductor "back"', "'gnd'", "'ground'")),
    "no role": (((BACK + "role", DROP),), ('conductor "back"', "'role'", '"ground"')),
    "beyond the wall": (((B + "center", [0.24, 0.0]),), ('electrode "B"', "x = 0.255", "inside")),
    "on the floor": (((BACK + "z", -0.01),), ('conductor "back"', "z = -0.01 m", "enlarge")),
    "below the floor": (((BACK + "z", -0.02),), ('conductor "back"', "z = -0.02 m", "leaves")),
    "layer below": (((PLATE + "z", [-0.02, 0]),), ('layer "plate"', "z = -0.02", "enlarge")),
    "layer upside down": (((PLATE + "z", [0, -0.001]),), ('layer "plate"', "-0.001", "rise")),
    "layers overlap": (
        (("layer.+", {**NEXT_LAYER, "z": [-0.002, -0.0005]}),),
        ('layer "film"', '"plate"', "0.0005", "share a face"),
    ),
    "duplicate layer": (
        (("layer.+", {**NEXT_LAYER, "name": "plate", "z": [0.0, 0.0005]}),),
        ('layer "plate"', "'plate'", "own name"),
    ),
    "material": (
        ((PLATE + "material", "polycarb"),),
        ('layer "plate"', "'polycarb'", "'polycarbonate'"),
    ),
    "two permittivities": (((PLATE + "eps_r", 3),), ('layer "plate"', "eps_r = 3", "keep one")),
    "no permittivity": (((PLATE + "material", DROP),), ('layer "plate"', "missing", "eps_r")),
    "eps_r": (
        ((PLATE + "material", DROP), (PLATE + "eps_r", 0.5)),
        ('layer "plate"', "0.5", "from 1"),
    ),
    "crosses a layer": (
        ((B + "tilt", [0, 10, 0]), ("conductor", [])),
        ('electrode "B"', '"plate"', "-0.0026", "face of the layer"),
    ),
    "leaves a layer sideways": (
        ((B + "center", [0.055, 0.0, -0.0005]),),
        ('electrode "B"', '"plate"', "0.07", "wholly inside or outside"),
    ),
    "backplane": ((("domain.backplane", 0.5),), ("domain", "0.5", "smaller")),
    "no backplane": ((("domain.backplane", DROP),), ("domain", "'backplane'", "metres")),
    "description": ((("description", 3),), ("design", "3", "quotes")),
    "no unit": (
        ((A + "shape", "stl"), (A + "size", DROP), (A + "file", "a.stl")),
        ('electrode "A"', "'unit'", '"mm"'),
    ),
    "unit": (
        (
            (A + "shape", "stl"),
            (A + "size", DROP),
            (A + "file", "a.stl"),
            (A + "unit", "millimetres"),
        ),
        ('electrode "A"', "'millimetres'", "mm, cm, m, in"),
    ),
}


def test_base_is_good() -> None:
    """The base that the bad designs are made from loads."""
    design = parse_design(BASE)
    assert design.electrode_names == ("A", "B")
    assert design.build == {"resolution": 1.0}


@pytest.mark.parametrize("case", BAD)
def test_refused_with_name_value_and_mend(case: str) -> None:
    """Every wrong input is refused, and the message says which, what and how to fix it."""
    changes, parts = BAD[case]
    with pytest.raises(DesignError) as error:
        parse_design(changed(*changes), source="bad.toml")
    message = str(error.value)
    assert message.startswith("bad.toml: ")
    for part in parts:
        assert part in message, message


@pytest.mark.parametrize(
    "changes",
    [
        ((B + "center", [0.03, 0.0, 5e-7]),),
        ((B + "center", [0.03, 0.0, -0.0005]),),
        ((B + "center", [0.055, 0.0, 0.0]),),
        ((B + "center", [0.03, 0.0, 0.02]), (B + "tilt", [0, 90, 0])),
        (("electrode.+", {**BASE["electrode"][0], "name": "C", "center": [-0.03, 0.030002]}),),
        (("layer.+", {**NEXT_LAYER, "z": [0.0, 0.001]}),),
        (("layer.+", {**NEXT_LAYER, "z": [-0.01, -0.001]}),),
        (("conductor.+", {**POUR, "clearance": 0.0005}),),
        (("description", "two electrodes"),),
        (("build.resolution", 2),),
        ((BACK + "center", [0.0, 0.0]), (BACK + "role", "shield")),
    ],
)
def test_near_misses_load(changes: tuple[tuple[str, Any], ...]) -> None:
    """What is right, if only just, is not refused."""
    parse_design(changed(*changes))


@pytest.mark.parametrize(
    ("changes", "key", "low", "high"),
    [
        ((), "build.resolution", 0.25, 4.0),
        (PLATE_OF_ITS_OWN, PLATE + "eps_r", 1.0, 1000.0),
        ((), A + "rotation", -360.0, 360.0),
        (COMB, A + "fingers", 1, 1000),
        (STRIPES, A + "count", 1, 1000),
        (MEANDER, A + "turns", 1, 1000),
    ],
)
def test_numbers_up_to_their_limits(
    changes: tuple[tuple[str, Any], ...], key: str, low: float, high: float
) -> None:
    """Limits: what lies beyond is refused by its key, the ends are not."""
    beyond = (low - 1, high + 1)
    if isinstance(low, float):
        beyond = math.nextafter(low, -math.inf), math.nextafter(high, math.inf)
    for value, refused in ((low, False), (high, False), (beyond[0], True), (beyond[1], True)):
        told = ""
        try:
            parse_design(changed(*changes, (key, value)))
        except DesignError as error:
            told = str(error)
        assert (f": {key.split('.')[-1]} = " in told) == refused, told


@pytest.mark.parametrize("one", ["ground", "shield", "floating"])
@pytest.mark.parametrize("other", ["ground", "shield", "floating"])
def test_which_conductors_may_touch(one: str, other: str) -> None:
    """Grounds touch grounds, and shields shields, along an edge; all else is a short circuit."""
    beside = {**POUR, "size": [0.1, 0.02], "center": [0.0, 0.05], "z": -0.001, "role": other}
    data = changed((BACK + "role", one), ("conductor.+", beside))
    if one == other != "floating":
        assert len(parse_design(data).conductors) == 2
    else:
        with pytest.raises(DesignError, match=r'conductor "back".*"pour".*short circuit'):
            parse_design(data)


def test_height_within_a_micrometre_is_snapped_to_the_face() -> None:
    """A sheet half a micrometre off a layer's face lies exactly on it."""
    design = parse_design(changed((B + "center", [0.03, 0.0, 5e-7])))
    surface = design.electrodes[1].surface
    assert surface.bounds[:, 2].tolist() == [0.0, 0.0]
    assert abs(surface.rims[..., 2]).max() == 0.0


def test_unknown_name_lists_the_valid_ones() -> None:
    """A misspelt packaged name brings the right one and the list."""
    with pytest.raises(DesignError, match=r"six_pach.*did you mean 'six_patch'.*three_stripes"):
        load_design("six_pach")


def test_files_that_are_not_designs(tmp_path: Path) -> None:
    """Missing, unreadable and malformed files are refused by their path."""
    with pytest.raises(DesignError, match=r"no design file .*none\.toml.*six_patch"):
        load_design(tmp_path / "none.toml")
    with pytest.raises(DesignError, match="cannot be read"):
        load_design(tmp_path)
    bad = tmp_path / "bad.toml"
    bad.write_text('name = "x\n')
    with pytest.raises(DesignError, match=r"bad\.toml is not valid TOML.*line 1"):
        load_design(bad)
    bad.write_bytes(b'name = "\xff"')
    with pytest.raises(DesignError, match=r"bad\.toml is not valid TOML"):
        load_design(str(bad))


def test_errors_are_value_errors() -> None:
    """Callers may catch them as CapSense errors or as ValueError."""
    assert issubclass(DesignError, CapSenseError)
    assert issubclass(DesignError, ValueError)
