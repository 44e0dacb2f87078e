"""A scenario of a steel ball that passes six electrodes."""

from __future__ import annotations


def ball_scenario(excitation: str = "matrix", *, sample_rate: float = 10.0) -> str:
    """The text of a scenario file: 1.2 s, that many samples a second."""
    return f"""
name = "ball over six electrodes"
design = "six_patch"
sample_rate = {sample_rate}
excitation = "{excitation}"
[[body]]
name = "ball"
shape = "sphere"
radius = 0.02
material = "steel"
[body.trajectory]
waypoints = [[-0.06, 0.0, 0.04], [0.06, 0.0, 0.04]]
speed = 0.1
"""
