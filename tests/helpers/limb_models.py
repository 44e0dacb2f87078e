"""Limbs as models of simulators, posed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from adapter_worlds import load
from approximate import approx

import capsense as cs
from capsense.humans import Limb


def bend_in_mujoco(
    mujoco: Any, model: Any, data: Any, limb: Limb, angles: Mapping[str, float]
) -> None:
    """Set the joints of a limb [rad], and find where its geoms are."""
    for name, angle in angles.items():
        data.joint(f"{limb.name}_{name}").qpos[0] = angle
    mujoco.mj_forward(model, data)


def check_geoms(data: Any, bodies: list[cs.Body]) -> None:
    """Geoms of the bodies' names stand where these do; capsules may be rolled about their axes."""
    for body in bodies:
        geom = data.geom(str(body.name))
        assert geom.xpos == approx(np.array(body.pose.position), abs=1e-9)
        axis = geom.xmat.reshape(3, 3)[:, 2]
        assert abs(axis @ body.pose.rotation[:, 2]) == approx(1, abs=1e-9)


def check_ranges(model: Any, limb: Limb) -> None:
    """Joints bend as far as those of the limb."""
    ranges = [model.joint(f"{limb.name}_{j.name}").range for j in limb.joints]
    assert np.array(ranges) == approx(np.array([(j.lower, j.upper) for j in limb.joints]))


def load_in_pybullet(
    p: Any, client: int, limb: Limb, base: cs.Pose, angles: Mapping[str, float], folder: Path
) -> tuple[int, dict[str, int]]:
    """Load the URDF of a limb, bent [rad], on a fixed base.

    Returns:
        Number of the body, and those of its links by name.
    """
    body = load(client, limb.urdf(), base, folder)
    links = {}
    for k in range(p.getNumJoints(body, physicsClientId=client)):
        info = p.getJointInfo(body, k, physicsClientId=client)
        links[info[12].decode()] = k
        name = info[1].decode().removeprefix(f"{limb.name}_")
        if name in angles:
            p.resetJointState(body, k, angles[name], physicsClientId=client)
    return body, links
