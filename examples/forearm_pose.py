"""Where is the forearm? Its pose, found from capacitances alone while it moves over the sensor.

A person's forearm crosses six electrodes. Each sample gives one matrix of capacitances, as the
finest preset has it and with the noise of a converter. Gauss-Newton steps find the arm's lateral
offset, its height and two angles from it, with the Jacobian that the simulator hands back beside
the capacitances; each sample starts from the pose found last.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

import capsense as cs

ARM = cs.Capsule(0.040, 0.250)
NOISE = 0.05e-15
"""Standard deviation of every measured capacitance [F]."""
START = np.array([0.0, 0.08, 0.0, 0.0])
"""First guess: lateral offset y and height z [m], angle about z and rise [rad]."""
STEPS = 3
"""Gauss-Newton steps a sample."""
_ALONG_X = Rotation.from_euler("y", 90, degrees=True)
_LARGEST_STEP = np.array([0.01, 0.01, 0.15, 0.15])


def scene(pose: np.ndarray) -> cs.Scene:
    """The arm lies along x, rises by an angle about y, then turns by one about z."""
    y, z, turn, rise = pose
    quaternion = (Rotation.from_euler("ZY", [turn, rise]) * _ALONG_X).as_quat()
    where = cs.Pose((0.0, y, z), tuple(quaternion))
    return cs.Scene([cs.Body(ARM, pose=where, material="steel")])


def expected(sim: cs.Simulator, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Change of the matrix [F] as it would be, (21,), and how it changes with the pose, (21, 4)."""
    reading = sim.step(scene(pose), jacobian=True)
    upper = np.triu_indices(len(reading.delta))
    by_motion = reading.jacobian[0][upper]
    axis = np.array([-np.sin(pose[2]), np.cos(pose[2]), 0.0])  # about which the arm rises
    columns = [by_motion[:, 1], by_motion[:, 2], by_motion[:, 5], by_motion[:, 3:] @ axis]
    return reading.delta[upper], np.stack(columns, axis=1)


def improve(sim: cs.Simulator, pose: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """One Gauss-Newton step towards the pose that explains a measured matrix (21,)."""
    delta, by_pose = expected(sim, pose)
    units = np.array([1e-3, 1e-3, 1e-2, 1e-2])  # so that the columns are alike in size
    step = units * np.linalg.lstsq(by_pose * units, measured - delta, rcond=1e-4)[0]
    return pose + step / max(1.0, np.abs(step / _LARGEST_STEP).max())


def path(count: int) -> np.ndarray:
    """Poses of an arm that swings over the sensor, shape (count, 4)."""
    t = np.linspace(0.0, 2 * np.pi, count)
    return np.stack([
        0.025 * np.sin(t), 0.07 - 0.012 * np.cos(2 * t), 0.3 * np.sin(t + 0.5), 0.06 * np.cos(t)
    ], axis=1)  # fmt: skip


def main(samples: int = 60) -> None:
    """Follow the arm, and print how far off the pose is at every sample."""
    sim = cs.Simulator("six_patch_bare", method="surface")
    truth = cs.Simulator("six_patch_bare", method="surface", preset="fine")
    rng = np.random.default_rng(1)
    upper = np.triu_indices(6)
    found, errors = START, []
    for k, true in enumerate(path(samples)):
        measured = truth.step(scene(true)).delta[upper] + NOISE * rng.standard_normal(21)
        for _ in range(STEPS):
            found = improve(sim, found, measured)
        error = (found - true) * [1e3, 1e3, 180 / np.pi, 180 / np.pi]
        errors.append(error)
        print("{:3d}: lateral {:+6.2f} mm, height {:+6.2f} mm, turn {:+6.2f} deg, "
              "rise {:+6.2f} deg".format(k, *error))  # fmt: skip
    rms = np.sqrt(np.mean(np.square(errors[2:]), axis=0))
    print("rms: lateral {:.2f} mm, height {:.2f} mm, turn {:.2f} deg, rise {:.2f} deg".format(*rms))


if __name__ == "__main__":
    main()
