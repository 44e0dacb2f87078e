"""PyBullet's bodies and links: their names, what they are made of, and which there are."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from capsense.adapters.rules import Names, Rules, Tie, read_grounding, read_material
from capsense.errors import SceneError
from capsense.scene import Material, Pose

_WATCHES = itertools.count()
_MOST_LINKS = 127
"""Links beside its base of which PyBullet gives the states; of a body with more, of none."""
_SOFT_BODY = 3
"""Bullet's body type of deformables, entry 10 of ``getDynamicsInfo``."""
BODY_NAME, LINK_NAME = "capsense.body", "capsense.link"
"""Keys of user data: the name of a body, at its base, and that of a link."""


@dataclass(frozen=True)
class Link:
    """One link of one body."""

    body: int
    link: int
    """-1 is the base."""
    name: str
    names: Names


class Mount(NamedTuple):
    """Where a sensor sits."""

    body: int
    link: int
    """-1 is the base."""
    pose_in_link: Pose
    """The sensor frame in the link's frame."""


def body_numbers(client: int) -> list[int]:
    """The numbers of all bodies in the world."""
    import pybullet as p

    count = p.getNumBodies(physicsClientId=client)
    return [p.getBodyUniqueId(i, physicsClientId=client) for i in range(count)]


class BodyWatch:
    """Notices that bodies were added or removed, or the world was reset and filled anew.

    After a reset numbers begin anew and may be the same; user data of the first body tell.

    Args:
        client: Number of the physics client.
    """

    def __init__(self, client: int) -> None:
        self._client = client
        self._key = f"capsense.seen.{next(_WATCHES)}"
        self._bodies: list[int] = []

    def bodies(self) -> list[int]:
        """The numbers of all bodies, taken for known from now on."""
        import pybullet as p

        self._bodies = body_numbers(self._client)
        if self._bodies:
            p.addUserData(self._bodies[0], self._key, "", physicsClientId=self._client)
        return self._bodies

    def changed(self) -> bool:
        """Whether the world holds others than it did.

        Raises:
            SceneError: The client is not connected any more.
        """
        import pybullet as p

        if not p.isConnected(physicsClientId=self._client):
            raise SceneError(
                f"physics client {self._client} is not connected any more; attach the sensor to a "
                "client that is"
            )
        if body_numbers(self._client) != self._bodies:
            return True
        first = self._bodies[:1]
        return any(p.getUserDataId(b, self._key, physicsClientId=self._client) < 0 for b in first)


def check_patterns(rules: Rules, links: Sequence[Link]) -> None:
    """Refuse patterns that fit nothing.

    Raises:
        SceneError: Such a pattern.
    """
    try:
        rules.check([k.names for k in links])
    except SceneError as error:
        raise SceneError(
            f"{error}; of a body that enters later, say it by user data, like "
            "addUserData(body, 'capsense.material', 'human')"
        ) from None


def gone(body: int) -> SceneError:
    """The error for a sensor whose carrier was removed."""
    return SceneError(f"body {body}, which carries the sensor, has left the world; attach it anew")


def links_of(client: int, body: int) -> list[Link]:
    """The base and the links of a body, in order, by the names that user data give them, if any.

    Raises:
        SceneError: It has more links than PyBullet gives the states of.
    """
    import pybullet as p

    count = p.getNumJoints(body, physicsClientId=client)
    if count > _MOST_LINKS:
        name = p.getBodyInfo(body, physicsClientId=client)[1].decode() or f"body{body}"
        joints = [p.getJointInfo(body, k, physicsClientId=client)[2] for k in range(count)]
        raise SceneError(
            f"body {body}, {name!r}, has {count} links beside its base, and PyBullet gives the "
            f"states of {_MOST_LINKS} at most; load it with flags=pybullet.URDF_MERGE_FIXED_LINKS, "
            f"which joins its {joints.count(p.JOINT_FIXED)} fixed links to others, or make a model "
            "of fewer links"
        )
    base, title = (n.decode() for n in p.getBodyInfo(body, physicsClientId=client))
    title = _user_data(client, body, -1, BODY_NAME) or title or f"body{body}"
    names = [base or "base"]
    for joint in range(count):
        names.append(p.getJointInfo(body, joint, physicsClientId=client)[12].decode())
    names = [_user_data(client, body, i - 1, LINK_NAME) or name for i, name in enumerate(names)]
    return [
        Link(body, i - 1, name, (name, title, f"{title}/{name}")) for i, name in enumerate(names)
    ]


def matter_of(client: int, link: Link, rules: Rules) -> tuple[Material, Tie]:
    """What a link is made of, and its tie to ground.

    Raises:
        SceneError: Its user data name no known material or grounding.
    """
    said = _user_data(client, link.body, link.link, "capsense.material")
    where = f"user data of {link.names[-1]!r}"
    material = None if said is None else read_material(said, where)
    said = _user_data(client, link.body, link.link, "capsense.grounding")
    tie = None if said is None else Tie(read_grounding(said, where), f"body {link.body} {said}")
    return rules.material_of(link.names, material), rules.tie_of(link.names, tie)


def _user_data(client: int, body: int, link: int, key: str) -> str | None:
    import pybullet as p

    found = p.getUserDataId(body, key, link, physicsClientId=client)
    return None if found < 0 else p.getUserData(found, physicsClientId=client).decode()


def is_soft(client: int, link: Link) -> bool:
    """Whether a link is a soft body."""
    import pybullet as p

    dynamics = p.getDynamicsInfo(link.body, link.link, physicsClientId=client)
    return bool(dynamics[10] == _SOFT_BODY)
