"""Scenes and reference figures of the curved design, from ``benchmarks/references.py --curved``."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import capsense as cs

FILE = Path(__file__).parents[1] / "data" / "reference_arm_segment.json"
RADIUS = 0.048
"""Of the shell [m]; its axis lies this far under the electrode plane, along y."""


@cache
def curved_figures() -> dict[str, Any]:
    """The reference figures, as in their file."""
    return json.loads(FILE.read_text())


def curved_reference(case: str) -> NDArray[np.float64]:
    """Reference change of the Maxwell matrix [F]."""
    return 1e-12 * np.array(curved_figures()["cases"][case]["delta"])


def curved_body(case: str) -> cs.Body:
    """The grounded body of a case: ``ball 10``, ``limb 50``, …"""
    table = curved_figures()
    position = table["cases"][case]["position"]
    if case.startswith("ball"):
        return cs.Body(cs.Sphere(table["ball_radius"]), cs.Pose(position))
    axis = np.array(table["limb_axis"])
    side = np.array([axis[1], -axis[0], 0.0])
    frame = np.eye(4)
    frame[:3, :3] = np.stack([side, np.cross(axis, side), axis], axis=1)
    frame[:3, 3] = position
    shape = cs.Capsule(table["limb_radius"], table["limb_length"])
    return cs.Body(shape, cs.Pose.from_matrix(frame))
