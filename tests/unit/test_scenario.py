"""Scenario files: what they mean, and that a wrong one is refused with its fix."""

from __future__ import annotations

import contextlib
import math
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from approximate import approx
from changed_data import DROP, changed_copy
from hypothesis import given
from hypothesis import strategies as st

import capsense as cs
from capsense.errors import CapSenseError, DesignError, ScenarioError
from capsense.scenario import Excitation, Trajectory, load_scenario, parse_scenario
from capsense.scenario.model import channels_of, slerp
from capsense.scene import Pose, Ties

ROOT = Path(__file__).parents[2]
BASE = tomllib.loads(
    """
    name = "base"
    design = "six_patch"
    sample_rate = 10.0
    excitation = "mutual"
    pairs = [["E1", "E2"], ["E3", "E1"]]
    [[body]]
    name = "bar"
    shape = "box"
    size = [0.15, 0.15, 0.02]
    material = "steel"
    [body.trajectory]
    waypoints = [[-0.1, 0.0, 0.05], [0.1, 0.0, 0.05], [0.1, 0.0, 0.15]]
    speed = 0.1
    [[body]]
    name = "ball"
    shape = "sphere"
    radius = 0.02
    material = "water"
    grounding = "floating"
    pose = { position = [0.0, 0.05, 0.1] }
    """
)
INF, NAN = math.inf, math.nan


def changed(*changes: tuple[str, Any]) -> dict[str, Any]:
    """The base scenario with values replaced, or dropped, at dotted paths."""
    return changed_copy(BASE, *changes)


# ---- what a scenario means ----


def test_base() -> None:
    """Everything of a plain file arrives where it should."""
    scenario = parse_scenario(BASE)
    assert (scenario.name, scenario.design.name) == ("base", "six_patch")
    assert scenario.duration == approx(3.0)
    assert scenario.times == approx(np.arange(31) / 10)
    assert [c.column_name for c in scenario.channels] == ["Cm_E1_E2", "Cm_E3_E1"]
    assert scenario.method == "surface"
    assert parse_scenario({**BASE, "method": "fem_masked"}).method == "fem_masked"
    assert parse_scenario({**BASE, "method": "masked"}).method == "fem_masked"  # its former name
    scene = scenario.scene_at(1.0)
    assert scene["bar"].pose.position == approx((0.0, 0.0, 0.05))
    assert scene["bar"].grounding == "grounded"
    assert scene["ball"].pose.position == (0.0, 0.05, 0.1)
    assert scene["ball"].grounding == "floating"
    assert scenario.scene_at(99.0)["bar"].pose.position == approx((0.1, 0.0, 0.15))


def test_bodies_share_their_shapes() -> None:
    """A step makes no new shapes: what a shape keeps is made once."""
    scenario = parse_scenario(BASE)
    assert scenario.scene_at(0.1)["bar"].shape is scenario.scene_at(0.7)["bar"].shape


@pytest.mark.parametrize(
    ("keys", "shape"),
    [
        ({"shape": "box", "size": [0.1, 0.2, 0.3]}, cs.Box((0.1, 0.2, 0.3))),
        ({"shape": "sphere", "radius": 0.1}, cs.Sphere(0.1)),
        ({"shape": "capsule", "radius": 0.1, "length": 0.2}, cs.Capsule(0.1, 0.2)),
        ({"shape": "cylinder", "radius": 0.1, "length": 0.2}, cs.Cylinder(0.1, 0.2)),
        ({"shape": "ellipsoid", "radii": [0.1, 0.2, 0.3]}, cs.Ellipsoid((0.1, 0.2, 0.3))),
    ],
)
def test_shapes(keys: dict[str, Any], shape: cs.Box) -> None:
    """Every shape is read with its sizes."""
    body = {"name": "b", "material": "steel", "pose": {"position": [0, 0, 0.2]}, **keys}
    assert parse_scenario(changed(("body", [body]))).bodies[0].body.shape == shape


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply"])
def test_mesh_body(tmp_path: Path, suffix: str) -> None:
    """A mesh file is scaled by its unit; its folder is the scenario's."""
    trimesh.creation.box(extents=(20, 30, 40)).export(tmp_path / f"brick.{suffix}")
    body = {
        "name": "brick",
        "shape": "mesh",
        "file": f"brick.{suffix}",
        "unit": "mm",
        "material": "steel",
        "pose": {"position": [0, 0, 0.2]},
    }
    scenario = parse_scenario(changed(("body", [body])), folder=tmp_path)
    shape = scenario.bodies[0].body.shape
    assert np.ptp(shape.bounds(), axis=0) == approx((0.02, 0.03, 0.04))
    assert shape.volume == approx(24e-6)


def test_material_and_grounding() -> None:
    """A material of one's own, and a body tied to ground by a capacitance."""
    data = changed(("body.0.material", {"eps_r": 4.0, "sigma": 0.1}), ("body.0.grounding", 1e-10))
    body = parse_scenario(data).bodies[0].body
    assert (body.material.eps_r, body.material.sigma) == (4.0, 0.1)
    assert body.grounding == 1e-10
    for value, expected in (
        ("local", "local"),
        ({"earth": 1e-10, "local": 2e-11}, Ties(1e-10, 2e-11)),
        ({"local": float("inf")}, Ties(0.0, float("inf"))),
    ):
        data = changed(("body.0.grounding", value))
        assert parse_scenario(data).bodies[0].body.grounding == expected


def test_design_beside_the_scenario(tmp_path: Path) -> None:
    """A design's path is relative to the scenario file, not to where the command runs."""
    library = ROOT / "src" / "capsense" / "design" / "library" / "patch.toml"
    (tmp_path / "mine.toml").write_text(library.read_text(encoding="utf-8"), encoding="utf-8")
    text = 'name = "s"\ndesign = "mine.toml"\nsample_rate = 1.0\nduration = 0.0\n'
    (tmp_path / "scenario.toml").write_text(text, encoding="utf-8")
    assert load_scenario(tmp_path / "scenario.toml").design.name == "patch"


def test_times() -> None:
    """Samples from 0 to the duration, both included; a still scene is one sample."""
    assert parse_scenario(changed(("duration", 0.35))).times == approx([0, 0.1, 0.2, 0.3])
    assert parse_scenario(changed(("duration", 0.3))).count == 4  # 0.3 * 10 is not quite 3
    assert parse_scenario(changed(("body.0", BASE["body"][1]), ("body.1.name", "b"))).count == 1
    fast = parse_scenario(BASE).resampled(100.0)
    assert (fast.count, fast.duration) == (301, approx(3.0))


def test_path() -> None:
    """The way of a body is its pose at each sample."""
    scenario = parse_scenario(BASE)
    path = [scenario.bodies[0].at(float(t)).pose for t in scenario.times]
    assert len(path) == scenario.count
    assert path[10] == scenario.scene_at(1.0)["bar"].pose


# ---- channels ----


def test_channels() -> None:
    """Which numbers each excitation reads, in order."""
    names = ("A", "B", "C")
    matrix = channels_of(Excitation.MATRIX, names)
    assert [(c.row, c.column) for c in matrix] == [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    assert [c.column_name for c in channels_of(Excitation.SELF, names)] == ["C_A", "C_B", "C_C"]
    mutual = channels_of(Excitation.MUTUAL, names)
    assert [c.label for c in mutual] == ["A–B", "A–C", "B–C"]
    (pair,) = channels_of(Excitation.MUTUAL, names, [("C", "A")])
    assert (pair.row, pair.column, pair.column_name) == (2, 0, "Cm_C_A")


def test_channel_signs() -> None:
    """The matrix is read as it is; a mutual capacitance is minus its off-diagonal entry."""

    class Fake:
        capacitance = np.array([[3.0, -1.0], [-1.0, 2.0]])
        self_capacitance = np.array([5.0, 4.0])

    def read(excitation: Excitation) -> list[float]:
        return [c.read(Fake) for c in channels_of(excitation, ("A", "B"))]  # type: ignore[arg-type]

    assert read(Excitation.MATRIX) == [3.0, -1.0, 2.0]
    assert read(Excitation.SELF) == [5.0, 4.0]
    assert read(Excitation.MUTUAL) == [1.0]


# ---- trajectories ----


def poses(*points: tuple[float, float, float]) -> tuple[Pose, ...]:
    return tuple(Pose(p) for p in points)


def test_speeds_and_dwell() -> None:
    """Rests and legs follow each other in the order of the waypoints."""
    way = Trajectory(
        poses((0, 0, 0), (1, 0, 0), (1, 2, 0)), speeds=(1.0, 4.0), dwell=(0.5, 1.0, 2.0)
    )
    assert way.duration == approx(0.5 + 1 + 1 + 0.5 + 2)
    expected = {
        -1.0: (0, 0, 0),
        0.3: (0, 0, 0),
        1.0: (0.5, 0, 0),
        1.5: (1, 0, 0),
        2.0: (1, 0, 0),
        2.75: (1, 1, 0),
        3.5: (1, 2, 0),
        99.0: (1, 2, 0),
    }
    for time, point in expected.items():
        assert way.pose_at(time).position == approx(point), time


def test_closed_way_repeats() -> None:
    """A closed trajectory is periodic, rests included."""
    way = Trajectory(poses((0, 0, 0), (1, 0, 0), (0, 1, 0)), (1.0,) * 3, (0.5, 0, 0), closed=True)
    assert way.duration == approx(2.5 + math.sqrt(2))
    for time in np.linspace(0, way.duration, 40):
        once, again = way.pose_at(time), way.pose_at(time + 3 * way.duration)
        assert again.position == approx(once.position, abs=1e-12)
    assert way.pose_at(way.duration + 0.4).position == approx((0, 0, 0), abs=1e-12)


@given(st.floats(0, 30), st.floats(1e-6, 1e-2))
def test_speed_is_kept(time: float, step: float) -> None:
    """Nothing moves faster than its leg's speed, and nothing jumps."""
    way = Trajectory(
        poses((0, 0, 0), (0.3, 0.1, 0), (0.3, 0.1, 0.4)), (0.1, 0.2, 0.05), (1, 0, 2), closed=True
    )
    moved = math.dist(way.pose_at(time).position, way.pose_at(time + step).position)
    assert moved <= 0.2 * step * (1 + 1e-6) + 1e-12


def test_one_waypoint() -> None:
    """A single waypoint is a place to rest at."""
    way = Trajectory(poses((0, 0, 1)), dwell=(2.0,))
    assert (way.duration, way.pose_at(1.0).position) == (2.0, (0, 0, 1))


def test_turning() -> None:
    """Orientation turns at a constant rate between waypoints, the short way."""
    turn = [Pose.from_euler((x, 0, 0), (0, 0, a), degrees=True) for x, a in ((0, 170), (1, -170))]
    way = Trajectory(tuple(turn), (1.0,))
    for share, angle in ((0.0, 170), (0.25, 175), (0.5, 180), (1.0, 190)):
        expected = Pose.from_euler((share, 0, 0), (0, 0, angle), degrees=True)
        assert way.pose_at(share).rotation == approx(expected.rotation, abs=1e-12)


quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 0.1)


@given(quaternions, quaternions, st.floats(0, 1))
def test_slerp(start: tuple[float, ...], end: tuple[float, ...], share: float) -> None:
    """Unit length, ends met, and the same from either end."""
    a, b = Pose((0, 0, 0), start).quaternion, Pose((0, 0, 0), end).quaternion
    q = slerp(a, b, share)
    assert math.hypot(*q) == approx(1, abs=1e-9)
    assert slerp(a, b, 0.0) == approx(a, abs=1e-9)
    overlap = abs(sum(x * y for x, y in zip(slerp(a, b, 1.0), b, strict=True)))
    assert overlap == approx(1, abs=1e-9)
    if abs(sum(x * y for x, y in zip(a, b, strict=True))) > 1e-6:
        back = slerp(b, a, 1 - share)
        assert abs(sum(x * y for x, y in zip(q, back, strict=True))) == approx(1, abs=1e-9)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"waypoints": ()}, "0 waypoints"),
        ({"waypoints": poses((0, 0, 0)), "closed": True, "speeds": (1.0,)}, "at least 2"),
        ({"speeds": (1.0, 1.0)}, "2 speeds for 1 legs"),
        ({"speeds": (0.0,)}, "speed is 0.0 m/s"),
        ({"speeds": (NAN,)}, "speed is nan"),
        ({"dwell": (1.0,)}, "1 dwell times for 2 waypoints"),
        ({"dwell": (1.0, -1.0)}, "dwell time is -1.0 s"),
        ({"waypoints": poses((0, 0, 1), (0, 0, 1))}, "same point.*dwell"),
    ],
)
def test_bad_trajectories(arguments: dict[str, Any], message: str) -> None:
    """A trajectory that cannot be followed is refused."""
    good: dict[str, Any] = {"waypoints": poses((0, 0, 0), (1, 0, 0)), "speeds": (1.0,)}
    with pytest.raises(ScenarioError, match=message):
        Trajectory(**{**good, **arguments})


def test_time_must_be_finite() -> None:
    """No pose at no time."""
    with pytest.raises(ScenarioError, match="time is nan"):
        parse_scenario(BASE).scene_at(NAN)


# ---- what is refused ----

TWO = {"waypoints": [[0, 0, 0.1], [0, 0, 0.2]], "speed": 0.1}
REFUSED = [
    (("name", DROP), "missing key 'name'"),
    (("nam", "x"), "unknown key 'nam'; did you mean 'name'"),
    (("design", DROP), "missing key 'design'"),
    (("design", "six_pach"), "six_pach.*did you mean 'six_patch'"),
    (("design", "no/such.toml"), r"no file .*such\.toml.*relative to the scenario"),
    (("sample_rate", DROP), "missing key 'sample_rate'"),
    (("sample_rate", 0), "sample_rate = 0 must be from 0.001 to 1e[+]06 Hz"),
    (("sample_rate", "fast"), "sample_rate = 'fast' must be a number"),
    (("sample_rate", NAN), "sample_rate = nan must be a finite"),
    (("sample_rate", 1e6), "3000001 samples, more than 1000000; lower"),
    (("duration", -1.0), "duration = -1 must be from 0"),
    (("duration", INF), "duration = inf must be a finite"),
    (("excitation", "both"), "'both' is not known.*matrix, self, mutual"),
    (("excitation", "self"), 'pairs is for excitation = "mutual"'),
    (("pairs", []), r"pairs = \[\] must be a list of pairs"),
    (("pairs", [["E1"]]), r"pairs\[0\] = \['E1'\] must be two electrode names"),
    (("pairs", ["E1", "E2"]), r"pairs\[0\] = 'E1' must be two"),
    (("pairs", [["E1", "E7"]]), "no electrode 'E7' of design 'six_patch'.*E6"),
    (("pairs", [["E1", "E1"]]), "two different electrodes"),
    (("pairs", [["E1", "E2"], ["E2", "E1"]]), r"pairs\[1\].*listed twice"),
    (("method", "surfaces"), "did you mean 'surface'"),
    (("method", "perturbation"), 'method = "perturbation" is gone; write "surface", or remove'),
    (("tolerance", 1e-17), "tolerance is gone.*remove the line"),
    (("body", {"name": "x"}), r"write \[\[body\]\]"),
    (("body", []), r"no body and no duration; add a \[\[body\]\]"),
    (("body.1.name", "bar"), "two bodies are named 'bar'"),
    (("body.0.name", DROP), "body 1: missing key 'name'"),
    (("body.0.shape", "cube"), "body \"bar\": shape = 'cube' is not known.*box"),
    (("body.0.radius", 1.0), "unknown key 'radius'.*valid are name, shape"),
    (("body.0.size", [0.15, 0.15]), "must be .x, y, z. in metres"),
    (("body.0.size", [150, 150, 20]), r"size = 150 is larger.*did you mean 0\.15"),
    (("body.0.size", [0.15, 0.15, -0.02]), "size = -0.02 must be positive"),
    (("body.1.radius", DROP), "body \"ball\": missing key 'radius'"),
    (("body.0.material", DROP), "missing key 'material'"),
    (("body.0.material", "steal"), "body \"bar\": unknown material 'steal'; did you mean 'steel'"),
    (("body.0.material", {"eps_r": 0.5}), "eps_r = 0.5 must be from 1 to"),
    (("body.0.material", {"eps": 2}), "unknown key 'eps'; did you mean 'eps_r'"),
    (("body.0.grounding", "ground"), "'ground', which is not known; did you mean 'grounded'"),
    (("body.0.grounding", 100), "100 F, more than 0.001 F.*farads; did you mean 1e-10"),
    (("body.0.grounding", 0), "not a positive finite"),
    (("body.0.grounding", {"earth": -1.0}), "ties: earth is -1.0 F; give 0 to 0.001 F"),
    (("body.0.grounding", {"robot": 1e-12}), "unknown key 'robot'"),
    (("body.0.grounding", {"local": "all"}), "local is 'all' F"),
    (("body.0.grounding", {}), "both are 0 F; give one"),
    (("body.0.grounding", True), "grounding is True, not a positive finite"),
    (("body.0.pose", {"position": [0, 0, 0]}), "pose and trajectory both"),
    (("body.0.trajectory", DROP), "missing key: give pose = "),
    (("body.1.pose", [0, 0, 0]), "pose: must be a table"),
    (("body.1.pose.position", [0, 0]), "position = .0, 0. must be"),
    (("body.1.pose.euler", [0, 0, 400]), "within ±360 degrees"),
    (("body.1.pose.quaternion", [0, 0, 0, 2]), "length 2; give a unit quaternion"),
    (("body.1.pose", {"position": [0, 0, 0], "euler": [[0, 0, 0], [0, 0, 1]]}), "2 orientations"),
    (("body.0.trajectory.waypoints", DROP), "trajectory: missing key 'waypoints'"),
    (("body.0.trajectory.waypoints", []), r"waypoints = \[\] must be a list"),
    (("body.0.trajectory.waypoints", [[0, 0, 50.0]]), r"waypoints\[0\] = 50 is larger.*0\.05"),
    (("body.0.trajectory.waypoints", [[0, 0, 0.1], [0, 0]]), r"waypoints\[1\] = .0, 0. must"),
    (("body.0.trajectory.waypoints", [[0, 0, 0.1]] * 2), "same point"),
    (("body.0.trajectory.speed", DROP), "missing key 'speed'"),
    (("body.0.trajectory.speed", 0), "speed = 0 must be from 1e-06 to 1000 m/s"),
    (("body.0.trajectory.speed", [0.1, -1]), r"speed\[1\] = -1 must be"),
    (("body.0.trajectory.speed", [0.1]), "1 speeds for 2 legs"),
    (("body.0.trajectory.dwell", [1.0]), "1 dwell times for 3 waypoints"),
    (("body.0.trajectory.closed", "yes"), "closed = 'yes' must be true or false"),
    (("body.0.trajectory.euler", [[0, 0, 0], [0, 0, 9]]), "2 orientations for 3 waypoints"),
    (("body.0.trajectory", {**TWO, "euler": [0, 0, 0], "quaternion": [0, 0, 0, 1]}), "keep one"),
    (("body.0.trajectory", {**TWO, "speeds": 1}), "unknown key 'speeds'; did you mean 'speed'"),
]


@pytest.mark.parametrize(("change", "message"), REFUSED, ids=[m for _, m in REFUSED])
def test_refused(change: tuple[str, Any], message: str) -> None:
    """A wrong value is refused with the file, the item, the value and the fix."""
    with pytest.raises(ScenarioError, match=message) as caught:
        parse_scenario(changed(change), source="my.toml")
    assert str(caught.value).startswith("my.toml: ")
    assert "\n" not in str(caught.value)


def test_refused_meshes(tmp_path: Path) -> None:
    """Mesh files that are missing, broken, empty or in the wrong unit; open ones are taken."""
    trimesh.creation.box(extents=(20, 30, 40)).export(tmp_path / "brick.stl")
    open_box = trimesh.creation.box(extents=(0.02, 0.03, 0.04))
    open_box.update_faces(np.arange(10))
    open_box.export(tmp_path / "open.stl")
    open_box.vertices[:] = open_box.vertices[0]
    open_box.export(tmp_path / "point.stl")
    (tmp_path / "broken.ply").write_text("ply\nnonsense\n")
    (tmp_path / "brick.docx").write_text("")
    body = {"name": "m", "shape": "mesh", "material": "steel", "pose": {"position": [0, 0, 0.2]}}
    cases = [
        ({"file": "brick.stl"}, "missing key 'unit'"),
        ({"file": "brick.stl", "unit": "m"}, '40 m across with unit = "m"'),
        ({"file": "none.stl", "unit": "m"}, r"no file .*none\.stl"),
        ({"file": "point.stl", "unit": "m"}, 'body "m": TriMesh'),
        ({"file": "broken.ply", "unit": "m"}, "broken.ply' (cannot be read|holds no triangles)"),
        ({"file": "brick.docx", "unit": "m"}, "no known kind; give .stl"),
    ]
    for keys, message in cases:
        with pytest.raises(ScenarioError, match=message):
            parse_scenario(changed(("body", [{**body, **keys}])), folder=tmp_path)
    taken = {**body, "file": "open.stl", "unit": "m"}
    parse_scenario(changed(("body", [taken])), folder=tmp_path)


def test_refused_files(tmp_path: Path) -> None:
    """A file that is missing, a folder, no TOML, or names a wrong design."""
    with pytest.raises(ScenarioError, match=r"no scenario file .*none\.toml"):
        load_scenario(tmp_path / "none.toml")
    with pytest.raises(ScenarioError, match="cannot be read"):
        load_scenario(tmp_path)
    (tmp_path / "bad.toml").write_text("name = \n")
    with pytest.raises(ScenarioError, match=r"bad\.toml is not valid TOML.*line 1"):
        load_scenario(tmp_path / "bad.toml")
    (tmp_path / "design.toml").write_text('nam = "x"\n')
    (tmp_path / "s.toml").write_text('name="s"\ndesign="design.toml"\nsample_rate=1\n')
    with pytest.raises(DesignError, match=r"design\.toml: design: unknown key 'nam'"):
        load_scenario(tmp_path / "s.toml")


junk = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5),
    st.lists(st.floats(), max_size=4),
    st.dictionaries(st.text(max_size=3), st.floats(), max_size=2),
)  # fmt: skip
PATHS = [
    "name", "design", "sample_rate", "duration", "excitation", "pairs", "method", "tolerance",
    "description", "body", "body.0", "body.0.shape", "body.0.size", "body.0.material",
    "body.0.grounding", "body.0.trajectory", "body.0.trajectory.waypoints",
    "body.0.trajectory.speed", "body.0.trajectory.dwell", "body.0.trajectory.euler",
    "body.0.trajectory.quaternion", "body.0.trajectory.closed", "body.1.pose", "body.1.radius",
]  # fmt: skip


@given(st.sampled_from(PATHS), junk)
def test_junk_never_crashes(path: str, value: Any) -> None:
    """Whatever stands in a file, it loads or is refused; nothing else is raised."""
    with contextlib.suppress(CapSenseError):
        assert parse_scenario(changed((path, value))).count >= 1


# ---- examples and the reference page ----


@pytest.mark.parametrize("path", sorted((ROOT / "examples").glob("*.toml")), ids=lambda p: p.stem)
def test_examples_load(path: Path) -> None:
    """Every example is a scenario whose bodies stay above the sensor."""
    scenario = load_scenario(path)
    assert scenario.count > 10
    for time in scenario.times[:: max(1, scenario.count // 50)]:
        bounds = scenario.scene_at(float(time)).pack().bounds
        assert bounds[:, 0, 2].min() > 0.002


def test_steel_bar_example() -> None:
    """The bar and the speed are the paper's; 250 samples as in its figure."""
    scenario = load_scenario(ROOT / "examples" / "steel_bar_triangle.toml")
    assert scenario.design.name == "stripe"
    assert scenario.count == 250
    bar = scenario.bodies[0]
    assert bar.body.shape == cs.Box((0.150, 0.150, 0.020))
    assert bar.body.grounding == "grounded"
    assert bar.trajectory is not None
    assert set(bar.trajectory.speeds) == {0.116}
    heights = [
        p.position[2] for p in [scenario.bodies[0].at(float(t)).pose for t in scenario.times]
    ]
    assert min(heights) == heights[0]


def test_reference_page() -> None:
    """Every TOML block of the page is a scenario, or keys that complete one."""
    page = (ROOT / "docs" / "scenarios.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```toml\n(.*?)```", page, flags=re.DOTALL)
    assert blocks
    for text in blocks:
        data = {"name": "s", "design": "six_patch", "sample_rate": 10.0, "duration": 1.0}
        data.update(tomllib.loads(text))
        for body in data.get("body", []):
            if body.get("shape") != "mesh":
                continue
            body.update(shape="sphere", radius=0.01)
            for key in ("file", "unit"):
                body.pop(key, None)
        assert parse_scenario(data).count >= 1
