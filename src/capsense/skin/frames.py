"""Frames of a robot's description (URDF) that stand for the taxels of a skin."""

from __future__ import annotations

import math
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

from capsense._validate import read_file
from capsense.errors import SceneError, listed
from capsense.scene import Pose


class _Joint(NamedTuple):
    parent: str
    fixed: bool
    origin: Pose
    """Of the child in the frame of the parent, where the joint is at zero."""


def read_frames(path: Path, pattern: str) -> dict[str, Pose]:
    """Links of a URDF file with a name of a pattern, which one link carries by fixed joints.

    Args:
        path: The file.
        pattern: Such as ``"l_forearm_skin_*"``.

    Returns:
        Their poses in the frame of the link that carries them, the first one above them that a
        joint moves, or the root; in the order of the file.

    Raises:
        SceneError: The file cannot be read, no link has such a name, or they move against each
            other.
    """
    joints, links = _read(path)
    names = [name for name in links if fnmatchcase(name, pattern)]
    if not names:
        near = sorted(n for n in links if pattern.split("*")[0] in n) or links
        raise SceneError(f"{path} has no link named {pattern!r}; its links are {listed(near, 8)}")
    found: dict[str, Pose] = {}
    carriers: dict[str, str] = {}
    for name in names:
        pose, link = Pose(), name
        while link in joints and joints[link].fixed:
            pose, link = joints[link].origin @ pose, joints[link].parent
        found[name] = pose
        carriers.setdefault(link, name)
    if len(carriers) > 1:
        (one, first), (two, second) = list(carriers.items())[:2]
        raise SceneError(
            f"{path}: {first!r} is fixed to {one!r}, but {second!r} to {two!r}; give a pattern of "
            "frames that one link carries"
        )
    return found


def _read(path: Path) -> tuple[dict[str, _Joint], list[str]]:
    """The joint above each link, and the names of all links."""
    try:
        root = ElementTree.fromstring(read_file(path))
    except FileNotFoundError:
        raise SceneError(f"there is no URDF file {path}; check the path") from None
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error.strerror}") from None
    except ElementTree.ParseError as error:
        raise SceneError(f"{path} is no XML: {error}; expand it first if it is a xacro") from None
    joints: dict[str, _Joint] = {}
    for joint in root.iter("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is None or child is None:  # those of transmissions have neither
            continue
        name, above = child.get("link", ""), parent.get("link", "")
        fixed = joint.get("type") == "fixed"
        joints[name] = _Joint(above, fixed, _origin(path, name, joint.find("origin")))
    for name in joints:
        link, seen = name, {name}
        while link in joints:
            link = joints[link].parent
            if link in seen:
                raise SceneError(f"{path}: the joints above link {name!r} go round in a circle")
            seen.add(link)
    return joints, [link.get("name", "") for link in root.iter("link")]


def _origin(path: Path, link: str, origin: ElementTree.Element | None) -> Pose:
    """The pose that an ``origin`` element says: roll, pitch and yaw about fixed axes."""
    values = []
    for key in ("xyz", "rpy"):
        text = "0 0 0" if origin is None else origin.get(key, "0 0 0")
        try:
            numbers = [float(word) for word in text.split()]
        except ValueError:
            numbers = []
        if len(numbers) != 3 or not all(map(math.isfinite, numbers)):
            raise SceneError(f"{path}: {key} of link {link!r} is {text!r}; give three numbers")
        values.append(numbers)
    return Pose.from_euler(values[0], values[1])
