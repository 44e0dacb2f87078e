"""Where is the forearm? Its pose, found from capacitances alone while it moves over the sensor.

A person's forearm crosses six electrodes. Each sample gives one matrix of capacitances, as the
finest preset has it and with the noise of a converter. Gauss-Newton steps on the gradients of a
coarser simulator find the arm's lateral offset, the gap to its skin and two angles from it.
"""

from __future__ import annotations

import numpy as np

import capsense as cs
from capsense.learning.servo import Belief, LimbPose, PoseEstimator

NOISE = 0.05e-15
"""Standard deviation of every measured capacitance [F]."""
ARM = Belief(LimbPose(vertical=0.04), radius=0.04, radius_spread=0.0, material="steel")


def path(count: int) -> list[LimbPose]:
    """Poses of an arm that swings over the sensor."""
    t = np.linspace(0.0, 2 * np.pi, count)
    poses = np.stack([
        0.025 * np.sin(t), 0.03 - 0.012 * np.cos(2 * t), 0.06 * np.cos(t), 0.3 * np.sin(t + 0.5)
    ], axis=1)  # fmt: skip
    return [LimbPose(*row) for row in poses.tolist()]


def main(samples: int = 60) -> None:
    """Follow the arm, and print how far off the pose is at every sample."""
    estimator = PoseEstimator(
        cs.Simulator("six_patch_bare"), ARM, noise=NOISE, relative=0.0, matrix=True
    )
    truth = cs.Simulator("six_patch_bare", preset="fine")
    rng = np.random.default_rng(1)
    upper = np.triu_indices(6)
    errors = []
    for k, true in enumerate(path(samples)):
        exact = truth.step(estimator.scene(true, ARM.radius)).delta[upper]
        found = estimator.estimate(exact + NOISE * rng.standard_normal(21))
        error = np.subtract(found, true) * [1e3, 1e3, 180 / np.pi, 180 / np.pi]
        errors.append(error)
        print("{:3d}: lateral {:+6.2f} mm, gap {:+6.2f} mm, pitch {:+6.2f} deg, "
              "yaw {:+6.2f} deg".format(k, *error))  # fmt: skip
    rms = np.sqrt(np.mean(np.square(errors[2:]), axis=0))
    print("rms: lateral {:.2f} mm, gap {:.2f} mm, pitch {:.2f} deg, yaw {:.2f} deg".format(*rms))


if __name__ == "__main__":
    main()
