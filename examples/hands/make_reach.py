"""Makes ``examples/hands/reach.npz``: a made-up reach over a sensor, as a tracker would report it.

Run it: ``python examples/hands/make_reach.py [FILE]``. It is synthetic: the joints of a hand model
that moves on a path, in OpenXR's order, 60 times a second, with the errors of a tracker: noise of
1 mm, a bias of some millimetres that wanders within seconds, fingertips that the fist hides, and
half a second in which the hand is lost. The same seed gives the same file.

An open hand comes from the side, hovers over the middle, presses its fingertips down to 1 mm above
the electrodes, rises, closes to a fist, comes down again, and leaves.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import capsense as cs
from capsense.humans import Build, HandRecording, TrackedHand

RATE = 60.0
"""Frames a second [Hz]."""
NOISE, DRIFT, DRIFT_TIME = 1e-3, 1.5e-3, 1.0
"""Standard deviations of noise and drift [m], and the time over which the drift wanders [s]."""
LOST = (4.2, 4.7)
"""The hand is lost in between [s]."""
BEST = 1e-4
"""The file holds multiples of this [m]."""
BASE = np.stack([(0.0, 1.0, 0.0), (0.0, 0.0, -1.0), (-1.0, 0.0, 0.0)], axis=1)
"""From the axes of the hand (x to the thumb, y out of the palm, z back along the fingers) to the
sensor frame: the palm looks down, the fingers along +x."""
PATH = np.array([
    # time, x and y of the wrist, clearance, pitch of the hand, bend of the fingers
    (0.0, -0.32, -0.05, 0.110, 0.0, 0.05),
    (1.2, -0.12, 0.00, 0.050, 0.0, 0.05),
    (1.8, -0.12, 0.00, 0.050, 0.0, 0.05),
    (2.4, -0.12, 0.00, 0.001, 0.2, 0.20),
    (2.9, -0.12, 0.00, 0.001, 0.2, 0.20),
    (3.5, -0.10, 0.00, 0.080, 0.0, 0.05),
    (4.2, -0.07, 0.00, 0.040, 0.0, 1.00),
    (4.9, -0.06, 0.02, 0.002, 0.0, 1.00),
    (5.3, -0.06, 0.02, 0.002, 0.0, 1.00),
    (6.0, -0.30, 0.05, 0.110, 0.0, 0.30),
])  # fmt: skip
"""Lengths [m], angles [rad]; the clearance is that of the lowest point of the hand above the
electrodes. Between the rows it moves with the least jerk."""
FIST = {"mcp_flexion": 80.0, "pip_flexion": 95.0, "dip_flexion": 60.0}
"""Angles of a finger that is bent wholly [degrees]."""
HAND = TrackedHand(Build("female"), "right", "openxr")
"""The hand that is tracked."""
THUMB = {"thumb_cmc_abduction": 45.0, "thumb_mcp_flexion": 40.0, "thumb_ip_flexion": 40.0}


def state(time: float) -> tuple[dict[str, float], cs.Pose]:
    """Angles of the joints [degrees], and the pose of the wrist in the sensor frame."""
    i = min(int(np.searchsorted(PATH[:, 0], time, side="right")) - 1, len(PATH) - 2)
    start, end = PATH[i, 0], PATH[i + 1, 0]
    share = np.clip((time - start) / (end - start), 0.0, 1.0)
    share = share**3 * (10 - 15 * share + 6 * share**2)
    x, y, clearance, pitch, bend = PATH[i, 1:] + share * (PATH[i + 1, 1:] - PATH[i, 1:])
    angles = {
        f"{finger}_{joint}": bend * most
        for finger in ("index", "middle", "ring", "little")
        for joint, most in FIST.items()
    }
    angles |= {name: bend * most for name, most in THUMB.items()}
    turn = cs.Pose.from_euler((0, 0, 0), (0.0, pitch, 0.0)) @ cs.Pose.from_matrix(BASE)
    bodies = HAND.limb.bodies(turn, angles, degrees=True)
    ends = [
        body.pose.apply((0, 0, side * body.shape.length / 2)) for body in bodies for side in (-1, 1)
    ]
    radii = np.repeat([body.shape.radius for body in bodies], 2)
    z = clearance - np.min(np.array(ends)[:, 2] - radii)
    return angles, cs.Pose((x, y, z)) @ turn


def truth(times: np.ndarray) -> np.ndarray:
    """Joints without errors [m], shape (n, 26, 3)."""
    return np.array([HAND.joints(*state(t), degrees=True) for t in times])


def make() -> HandRecording:
    """The recording."""
    rng = np.random.default_rng(2026)
    times = np.arange(0.0, PATH[-1, 0], 1.0 / RATE)
    joints = truth(times)
    keep = np.exp(-1.0 / (RATE * DRIFT_TIME))
    drift = np.zeros_like(joints)
    drift[0] = DRIFT * rng.normal(size=drift.shape[1:])
    for k in range(1, len(drift)):
        fresh = rng.normal(size=drift.shape[1:])
        drift[k] = keep * drift[k - 1] + np.sqrt(1 - keep**2) * DRIFT * fresh
    joints += drift + NOISE * rng.normal(size=joints.shape)
    bend = np.interp(times, PATH[:, 0], PATH[:, 5])
    hidden = (bend > 0.8)[:, None] & (rng.random((len(times), 5)) < 0.3)
    joints[:, [5, 10, 15, 20, 25]] = np.where(hidden[..., None], np.nan, joints[:, 5::5])
    lost = (times >= LOST[0]) & (times < LOST[1])
    joints[lost] = np.nan
    confidence = np.where(lost, 0.0, 0.95)
    return HandRecording(times, BEST * np.round(joints / BEST), confidence, "right", "openxr")


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("reach.npz")
    make().save(target)
    print(f"{target}: {target.stat().st_size / 1024:.0f} kB")
