"""Contact forces of a simulator, given to the bodies that are pressed onto a sensor's cover."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense.cover import Cover
from capsense.scene import Body, Pose
from capsense.scene.contact import distances
from capsense.scene.mesh_shape import TriangleShape

Array = NDArray[np.float64]


class Contact(NamedTuple):
    """One contact point of the body that carries a sensor, in the simulator's world."""

    frame: int
    """Frame of the other body."""
    position: Sequence[float] | Array
    """Where [m], shape (3,)."""
    normal: Sequence[float] | Array
    """Unit vector out of the carrier, shape (3,)."""
    force: float
    """Normal force [N]."""
    gap: float
    """Distance between the two surfaces [m], negative where they overlap."""


def pressed(
    bodies: Sequence[Body],
    frames: Sequence[int],
    contacts: Sequence[Contact],
    sensor: Pose,
    cover: Cover,
) -> list[Body]:
    """Return bodies with the normal forces that press them onto a cover.

    A contact counts if it lies over the cover, no farther from its faces than its thickness and
    the overlap of the surfaces, between which simulators put it: the simulator's surface of the
    sensor may be that of the cover or of the electrodes. Its force is
    the part along the sensor's z, and goes to the body of its frame that is nearest to it. Contacts
    that carry no force and do not overlap, as within a margin, do not count. A body without contact
    keeps ``force=None``, so that its overlap with the cover counts.

    Args:
        bodies: Bodies in the sensor frame.
        frames: The frame that carries each, or -1.
        contacts: Contacts of the sensor's carrier.
        sensor: The sensor frame in the world.
        cover: The cover.
    """
    out, forces = list(bodies), dict[int, float]()
    world, turn = sensor.inverse(), sensor.rotation.T
    for contact in contacts:
        if contact.force <= 0.0 and contact.gap > 0.0:
            continue
        at = world.apply(np.array(contact.position))
        own = [k for k, frame in enumerate(frames) if frame == contact.frame]
        spare = np.array([0.0, 0.0, cover.thickness + max(0.0, -contact.gap)])
        if not own or (at < cover.lower - spare).any() or (at > cover.upper + spare).any():
            continue
        up = float(turn[2] @ np.asarray(contact.normal))
        if up <= 0.0:
            continue
        nearest = min(own, key=lambda k: _distance(out[k], at)) if len(own) > 1 else own[0]
        forces[nearest] = forces.get(nearest, 0.0) + max(contact.force, 0.0) * up
    for k, force in forces.items():
        out[k] = out[k].pressed(force)
    return out


def _distance(body: Body, point: Array) -> float:
    """Distance of a point to the surface of a body [m]."""
    if isinstance(body.shape, TriangleShape):
        return float(body.shape.distance(body.pose.inverse().apply(point[None]))[0])
    return abs(float(distances(body, point[None])[0]))
