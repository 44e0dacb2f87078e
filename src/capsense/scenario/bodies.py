"""Readers of bodies, materials, groundings and poses, in files and messages."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from capsense import _validate
from capsense._validate import MAX_LENGTH, UNITS
from capsense.codec import SHAPES, lengths_of
from capsense.errors import MeshError, ScenarioError, SceneError
from capsense.scenario.model import (
    MovingBody,
    Trajectory,
)
from capsense.scene import Body, Material, Pose, Shape, TriMesh
from capsense.scene.materials import Grounding, Ties, checked_grounding
from capsense.scene.surface import read_triangles

if TYPE_CHECKING:
    pass


class ScenarioTable(_validate.Table):
    """One table of a scenario file; whatever is wrong raises :class:`ScenarioError`."""

    error_type = ScenarioError


MESH_KEYS = ("file", "unit")
BODY_KEYS = (
    "name", "shape", "material", "grounding", "conductor", "pose", "trajectory", "force",
)  # fmt: skip
MAX_FORCE = 1e6
"""No body is pressed onto a cover by more than this [N]."""
TRAJECTORY_KEYS = ("waypoints", "speed", "dwell", "euler", "quaternion", "closed")


def read_body(table: ScenarioTable, name: str, folder: Path) -> MovingBody:
    """Read one ``[[body]]``.

    Args:
        table: The table.
        name: Its name, already read.
        folder: Folder that mesh files are relative to.

    Raises:
        ScenarioError: A key, type or number is wrong.
        SceneError: A shape or material is wrong.
    """
    shape_name = table.choice("shape", [*SHAPES, "mesh"])
    lengths = MESH_KEYS if shape_name == "mesh" else tuple(lengths_of(shape_name))
    table.only((*BODY_KEYS, *lengths))
    shape = _read_shape(table, shape_name, folder)
    material = read_material(table)
    grounding = read_grounding(table)
    if ("pose" in table) == ("trajectory" in table):
        if "pose" in table:
            raise table.error("pose and trajectory both say where it is; keep one of them")
        raise table.error(
            "missing key: give pose = { position = [x, y, z] }, or a [body.trajectory]"
        )
    trajectory = None
    if "trajectory" in table:
        sub = ScenarioTable(table.data["trajectory"], table.source, f"{table.item}: trajectory")
        trajectory = _read_trajectory(sub)
        pose = trajectory.pose_at(0.0)
    else:
        pose = read_pose(ScenarioTable(table.data["pose"], table.source, f"{table.item}: pose"))
    force = table.number("force", 0.0, MAX_FORCE, unit="N") if "force" in table else None
    conductor = table.string("conductor") if "conductor" in table else None
    body = Body(shape, pose, material, grounding, name, force, conductor)
    return MovingBody(body, trajectory)


def _read_shape(table: ScenarioTable, shape: str, folder: Path) -> Shape:
    if shape == "mesh":
        return _read_mesh(table, folder)
    lengths: list[Any] = [
        table.length(key) if count == 1 else table.sizes(key, count, "[x, y, z] in metres")
        for key, count in lengths_of(shape).items()
    ]
    return SHAPES[shape](*lengths)


def _read_mesh(table: ScenarioTable, folder: Path) -> TriMesh:
    file = table.string("file")
    scale = UNITS[table.choice("unit", list(UNITS))]
    path = folder / file
    if not path.is_file():
        raise table.error(
            f"file = {file!r}: there is no file {path}; paths are relative to the scenario file"
        )
    if path.suffix.lower() not in (".stl", ".obj", ".ply", ".off"):
        raise table.error(f"file = {file!r} is of no known kind; give .stl, .obj, .ply or .off")
    try:
        vertices, faces = read_triangles(path)
    except SceneError as error:
        raise table.error(f"file = {file!r} {error}") from None
    extent = float(np.ptp(vertices, axis=0).max()) * scale
    if extent > MAX_LENGTH:
        raise table.error(
            f'file = {file!r} is {extent:g} m across with unit = "{table.data["unit"]}", larger '
            f"than {MAX_LENGTH:g} m; give the unit that the file is in"
        )
    return TriMesh(vertices * scale, faces)


def read_material(table: ScenarioTable, default: str | None = None) -> Material | str:
    """The material that ``material`` names or describes.

    Args:
        table: The table.
        default: What it is where the table does not say; without one, it must.

    Raises:
        ScenarioError: It is neither, or a number is out of range.
    """
    if default is not None and "material" not in table:
        return default
    value = table.raw("material", '"steel", or { eps_r = number, sigma = S/m }')
    if isinstance(value, dict):
        sub = ScenarioTable(value, table.source, f"{table.item}: material")
        sub.only(("name", "eps_r", "sigma"))
        return Material(
            sub.string("name", "custom"),
            sub.number("eps_r", 1.0, 1e6),
            sub.number("sigma", 0.0, 1e9, 0.0, unit="S/m"),
        )
    return table.string("material")


def read_grounding(table: ScenarioTable, default: Grounding = "grounded") -> Grounding:
    """What ``grounding`` says.

    Raises:
        ScenarioError: Neither ``"grounded"``, ``"floating"``, ``"local"``, a capacitance [F], nor
            a table of ties, ``{ earth = 100e-12, local = 20e-12 }``.
    """
    value = table.data.get("grounding", default)
    try:
        if isinstance(value, dict):
            sub = ScenarioTable(value, table.source, f"{table.item}: grounding")
            sub.only(("earth", "local"))
            return Ties(**value)
        return checked_grounding(value)
    except SceneError as error:
        raise table.error(str(error)) from None


def _rotations(table: ScenarioTable) -> list[Pose]:
    """The rotations that ``euler`` or ``quaternion`` give; none if neither is there."""
    if "euler" in table and "quaternion" in table:
        raise table.error("euler and quaternion both turn it; keep one of them")
    if "euler" in table:
        angles = table.vectors("euler", 3, "[roll, pitch, yaw] in degrees")
        for row in angles:
            if max(abs(a) for a in row) > 360:
                raise table.error(f"euler = {list(row)} must be within ±360 degrees")
        return [Pose.from_euler((0, 0, 0), row, degrees=True) for row in angles]
    if "quaternion" in table:
        return [Pose((0, 0, 0), row) for row in table.unit_quaternions("quaternion")]
    return []


def read_pose(table: ScenarioTable) -> Pose:
    """The pose that a table describes by ``position`` and ``euler`` or ``quaternion``."""
    table.only(("position", "euler", "quaternion"))
    position = table.coordinates("position", (3,))
    rotations = _rotations(table) or [Pose()]
    if len(rotations) > 1:
        raise table.error(f"{len(rotations)} orientations for one position; give one")
    return Pose(position, rotations[0].quaternion)


def _read_trajectory(table: ScenarioTable) -> Trajectory:
    table.only(TRAJECTORY_KEYS)
    points = table.vectors("waypoints", 3, "[x, y, z] in metres")
    for number, point in enumerate(points):
        for value in point:
            table.plausible(f"waypoints[{number}]", value)
    rotations = _rotations(table) or [Pose()]
    if len(rotations) not in (1, len(points)):
        raise table.error(
            f"{len(rotations)} orientations for {len(points)} waypoints; give one for all, or "
            "one per waypoint"
        )
    closed = table.boolean("closed", False)
    legs = len(points) if closed else len(points) - 1
    speeds: tuple[float, ...] = ()
    if legs or "speed" in table:
        speeds = _each(table.series("speed", 1e-6, 1e3, "m/s"), legs)
    dwell: tuple[float, ...] = ()
    if "dwell" in table:
        dwell = _each(table.series("dwell", 0.0, 1e7, "s"), len(points))
    if len(rotations) == 1:
        rotations *= len(points)
    waypoints = tuple(
        Pose(point, turn.quaternion) for point, turn in zip(points, rotations, strict=True)
    )
    try:
        return Trajectory(waypoints, speeds, dwell, closed)
    except ScenarioError as error:
        raise table.error(str(error)) from None


def _each(value: list[float] | float, count: int) -> tuple[float, ...]:
    """One number for all, or as many as there are."""
    return tuple(value) if isinstance(value, list) else (value,) * count


def read_bodies(top: ScenarioTable, folder: Path) -> tuple[MovingBody, ...]:
    """Read the array of tables ``body``.

    Args:
        top: The table that holds it.
        folder: Folder that mesh files are relative to.

    Raises:
        ScenarioError: Anything is wrong, or two bodies share a name.
    """
    out: list[MovingBody] = []
    names: set[str] = set()
    for number, raw in enumerate(top.tables("body"), start=1):
        label = raw.get("name") if isinstance(raw, Mapping) else None
        tag = f'body "{label}"' if isinstance(label, str) and label else f"body {number}"
        table = ScenarioTable(raw, top.source, tag)
        name = table.string("name")
        if name in names:
            raise table.error(f"two bodies are named {name!r}; names must differ")
        names.add(name)
        try:
            out.append(read_body(table, name, folder))
        except (SceneError, MeshError) as error:
            raise table.error(str(error)) from None
    return tuple(out)
