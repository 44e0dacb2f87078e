"""Where a limb is, by Gauss–Newton on the solver's own gradients or by a network; how to follow it.

The task is that of Z. Erickson, H. M. Clever, V. Gangaram, G. Turk, C. K. Liu and C. C. Kemp,
"Multidimensional capacitive sensing for robot-assisted dressing and bathing", ICORR 2019 (arXiv
1904.02111): lateral and vertical position, pitch and yaw of a limb from six electrodes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize

from capsense.errors import SceneError
from capsense.learning.labels import LimbPose
from capsense.scene import Body, Capsule, Material, Pose, Scene
from capsense.scene.materials import Grounding
from capsense.simulator import Simulator

Array = NDArray[np.float64]

_PROPORTION = 8.0
"""Length of the limb's model, in radii; always the same: new proportions take the solver long."""
_LEAST_GAP = 0.004
"""No estimate is nearer to the electrodes than this [m]."""
_STEEPEST = math.radians(50.0)
"""Angles of estimates are held within ± this [rad]."""
_LARGEST_STEP = np.array([0.02, 0.015, 0.15, 0.2, 0.2])
"""Of one iteration [m, m, rad, rad, 1]."""
_PROBE = 0.02
"""Relative change of the radius that its slope is found with."""
LAYERS = (32, 32)
"""Units of the network's hidden layers."""
DECAY = 1e-4
"""Weight of the squared weights in what its training minimises."""


@dataclass(frozen=True)
class Belief:
    """What is known of a limb before it is measured: means and standard deviations.

    Raises:
        SceneError: A spread is negative or not finite, or the radius is not positive.
    """

    pose: LimbPose = LimbPose()  # noqa: RUF009, it is immutable
    spread: LimbPose = LimbPose(0.03, 0.03, 0.15, 0.2)  # noqa: RUF009
    """Standard deviations of the pose; what has none is taken as known."""
    radius: float = 0.042
    """[m]"""
    radius_spread: float = 0.25
    """Standard deviation of the radius' logarithm; 0 where it is known."""
    taper: float = 0.0
    """Angle of the skin to the axis of a limb that gets thicker towards +x [rad]; some 0.06 of
    forearms and shanks. The capsule that stands for the limb is turned by it, to lie along the
    skin that the sensor faces."""
    material: Material | str = "human"
    grounding: Grounding = 100e-12
    """As of a :class:`~capsense.Body`."""

    def __post_init__(self) -> None:
        for name, value in (*self.spread._asdict().items(), ("radius_spread", self.radius_spread)):
            if not 0.0 <= value < math.inf:
                raise SceneError(f"belief: spread of {name} is {value!r}; give 0 or more")
        if not 0.0 < self.radius < math.inf:
            raise SceneError(f"belief: radius is {self.radius!r}; give a length in metres")
        if not abs(self.taper) < 1.0:
            raise SceneError(f"belief: taper is {self.taper!r}; give an angle in radians")

    @property
    def mean(self) -> Array:
        """Lateral, vertical, pitch, yaw and the radius' logarithm, shape (5,)."""
        return np.array([*self.pose, math.log(self.radius)])

    @property
    def deviation(self) -> Array:
        """Their standard deviations, shape (5,)."""
        return np.array([*self.spread, self.radius_spread])


class PoseEstimator:
    """Finds the pose of a limb from capacitances, without any training.

    The limb is a capsule of unknown radius. An estimate minimises
    ``|(measured - model(x)) / s|² + |(x - mean) / deviation|²`` over ``x``, the pose and the
    radius' logarithm: the most likely one under noise of the standard deviation ``s`` and under
    the belief. Gauss–Newton steps begin at the estimate before. The model is the simulator, and
    its Jacobian (closed adjoint) gives the slopes by the pose; that by the radius is a difference.

    Args:
        simulator: A sensor with gradients; ``preset="fast"`` will do.
        belief: What is known beforehand.
        noise: Standard deviation of every measured capacitance [F].
        relative: A further part of it, proportional to the capacitance: gain, and what the limb is
            unlike a capsule by; added in quadrature.
        matrix: Whether whole matrices are measured, not self capacitances only.
        iterations: Gauss–Newton steps of an estimate.

    Raises:
        SceneError: The simulator has no gradients, or a setting is out of range.
    """

    def __init__(
        self,
        simulator: Simulator,
        belief: Belief = Belief(),
        *,
        noise: float = 0.5e-15,
        relative: float = 0.05,
        matrix: bool = False,
        iterations: int = 3,
    ) -> None:
        if simulator.method != "surface":
            raise SceneError(f'method "{simulator.method}" has no gradients; use "surface"')
        if not (0 < noise < math.inf and 0 <= relative < math.inf and iterations >= 1):
            raise SceneError(
                f"noise = {noise!r}, relative = {relative!r}, iterations = {iterations!r}: give a "
                "positive noise [F], a part from 0 on, and 1 iteration or more"
            )
        if not matrix and any(c.role == "shield" for c in simulator.design.conductors):
            raise SceneError(
                f"design {simulator.design.name!r} has a driven shield, and self capacitances no "
                "gradients then; give matrix=True, and measure matrices"
            )
        self.simulator, self.belief, self.iterations = simulator, belief, iterations
        self._noise, self._relative = noise, relative
        m = len(simulator.electrode_names)
        self._picked = np.triu_indices(m) if matrix else (np.arange(m), np.arange(m))
        self.reset()

    def reset(self) -> None:
        """Forget the estimate before."""
        self._state = self.belief.mean

    @property
    def radius(self) -> float:
        """Radius of the limb in the last estimate [m]."""
        return math.exp(self._state[4])

    @property
    def pose(self) -> LimbPose:
        """The last estimate."""
        return LimbPose(*self._state[:4].tolist())

    def model(self, pose: LimbPose, radius: float | None = None) -> tuple[Array, Array]:
        """What would be measured, and how it changes.

        Args:
            pose: Of the limb.
            radius: Of the limb [m]; by default that of the belief.

        Returns:
            Changes from the empty scene [F], shape (K,): K self capacitances, or the upper
            triangle of the matrix row by row; and their derivatives by lateral, vertical [F/m],
            pitch, yaw [F/rad] and the radius' logarithm [F], shape (K, 5).
        """
        radius = radius or self.belief.radius
        reading = self.simulator.step(self.scene(pose, radius), jacobian=True)
        assert reading.jacobian is not None
        motion = reading.jacobian[0][self._picked]
        tilt = np.array([math.sin(pose.yaw), -math.cos(pose.yaw), 0.0])
        columns = [motion[:, 1], motion[:, 2], motion[:, 3:] @ tilt, motion[:, 5]]
        values, thicker = reading.delta[self._picked], np.zeros(len(motion))
        if self.belief.radius_spread:
            probe = self.simulator.step(self.scene(pose, radius * (1 + _PROBE)))
            thicker = (probe.delta[self._picked] - values) / math.log1p(_PROBE)
        return values, np.stack([*columns, thicker], axis=1)

    def scene(self, pose: LimbPose, radius: float) -> Scene:
        """The model of the limb before the sensor."""
        shape = Capsule(radius, _PROPORTION * radius)
        skin = pose._replace(pitch=pose.pitch - self.belief.taper)
        x, y, z = skin.direction  # turned there from z by the shortest way
        where = Pose((0.0, pose.lateral, pose.vertical + radius), (-y, x, 0.0, 1.0 + z))
        return Scene([Body(shape, where, self.belief.material, self.belief.grounding, "limb")])

    def estimate(self, measured: ArrayLike) -> LimbPose:
        """The most likely pose.

        Args:
            measured: Changes of the capacitances since nothing was near [F], shape (K,) as in
                :meth:`model`.

        Raises:
            SceneError: It has another shape, or is not finite.
        """
        values = _capacitances(measured, len(self._picked[0]))
        for _ in range(self.iterations):
            free, rows, scale, model = self._linearised(self._state, values)
            pull = (self.belief.mean - self._state)[free] / self.belief.deviation[free]
            rest = np.concatenate([(values - model) / scale, pull])
            step = np.zeros(5)
            step[free] = np.linalg.lstsq(rows, rest)[0] * self.belief.deviation[free]
            state = self._state + step / max(1.0, float(np.abs(step / _LARGEST_STEP).max()))
            state[1] = max(state[1], _LEAST_GAP)
            state[2:4] = np.clip(state[2:4], -_STEEPEST, _STEEPEST)
            self._state = state
        return self.pose

    def covariance(self, pose: LimbPose, radius: float | None = None) -> Array:
        """The Cramér–Rao bound of the pose, with the belief as prior, shape (4, 4) [m, rad].

        The inverse of the Fisher information of one measurement and of the belief (H. L. Van Trees,
        "Detection, Estimation, and Modulation Theory", part I, 1968, section 2.4), the radius being
        unknown as well.
        """
        state = np.array([*pose, math.log(radius or self.belief.radius)])
        free, rows, _, _ = self._linearised(state)
        out = np.zeros((5, 5))
        spread = self.belief.deviation[free]
        out[np.ix_(free, free)] = np.linalg.inv(rows.T @ rows) * np.outer(spread, spread)
        return out[:4, :4]

    def _linearised(
        self, state: Array, measured: Array | None = None
    ) -> tuple[NDArray[np.intp], Array, Array, Array]:
        """Which unknowns there are; rows of the least-squares problem in units of their spread, the
        standard deviations of what is measured [F], and the model at a state [F]."""
        values, slopes = self.model(LimbPose(*state[:4]), math.exp(state[4]))
        seen = values if measured is None else measured
        scale = np.hypot(self._noise, self._relative * seen)
        free = np.flatnonzero(self.belief.deviation)
        rows = slopes[:, free] * self.belief.deviation[free] / scale[:, None]
        return free, np.concatenate([rows, np.eye(len(free))]), scale, values


class PoseNetwork:
    """Two hidden layers of tanh from capacitances to a limb's pose; made by :meth:`fit`.

    Inputs are ``arcsinh(measured / unit)``: linear in small changes, logarithmic in large ones.

    Args:
        unit: Change that the inputs turn logarithmic at [F].
        weights: Matrices and offsets of the layers in turn; the first shifts and scales inputs,
            the last brings outputs to metres and radians.
    """

    def __init__(self, unit: float, weights: list[Array]) -> None:
        self.unit, self.weights = unit, weights

    @classmethod
    def fit(
        cls, measured: ArrayLike, poses: ArrayLike, *, unit: float = 2e-15, seed: int = 0,
        iterations: int = 600,
    ) -> PoseNetwork:  # fmt: skip
        """Train by L-BFGS on all samples at once; the same seed gives the same network.

        Squares of errors are minimised, each output in units of its spread over the samples, so
        that a noisy reading gives the mean of the poses that it may come from.

        Args:
            measured: Changes of capacitances with the noise that they will have in use [F], shape
                (n, K).
            poses: Lateral, vertical [m], pitch and yaw [rad], shape (n, 4).
            unit: As of the network.
            seed: Of the first weights.
            iterations: At most.

        Raises:
            SceneError: Shapes do not fit, or a number is not finite.
        """
        x, y = np.asarray(measured, dtype=float), np.asarray(poses, dtype=float)
        if x.ndim != 2 or y.shape != (len(x), 4) or len(x) < 2:
            raise SceneError(f"measured {x.shape} and poses {y.shape} do not fit: (n, K), (n, 4)")
        if not (np.isfinite(x).all() and np.isfinite(y).all()):
            raise SceneError("measured or poses hold numbers that are not finite; leave them out")
        x = np.arcsinh(x / unit)
        middle, spread = x.mean(axis=0), np.maximum(x.std(axis=0), 1e-9)
        low, high = y.mean(axis=0), np.maximum(y.std(axis=0), 1e-9)
        rng = np.random.default_rng(seed)
        sizes = (x.shape[1], *LAYERS, 4)
        parts = []
        for a, b in pairwise(sizes):
            parts += [rng.standard_normal((a, b)) / np.sqrt(a), np.zeros(b)]
        shapes = [p.shape for p in parts]
        start = np.concatenate([p.ravel() for p in parts])
        inputs, goals = (x - middle) / spread, (y - low) / high

        def loss(flat: Array) -> tuple[float, Array]:
            weights = _split(flat, shapes)
            values = _layers(inputs, weights)
            rest = (values[-1] - goals) / len(goals)
            slopes, back = [], rest
            for k in range(len(weights) - 2, -1, -2):
                slopes += [back.sum(axis=0), values[k // 2].T @ back]
                back = (back @ weights[k].T) * (1 - values[k // 2] ** 2)
            gradient = np.concatenate([s.ravel() for s in reversed(slopes)])
            value = 0.5 * len(goals) * float((rest**2).sum()) + 0.5 * DECAY * float(flat @ flat)
            return value, gradient + DECAY * flat

        found = minimize(loss, start, jac=True, method="L-BFGS-B",
                         options={"maxiter": iterations, "maxfun": 2 * iterations})  # fmt: skip
        weights = _split(found.x, shapes)
        weights[1] = weights[1] - (middle / spread) @ weights[0]
        weights[0] = weights[0] / spread[:, None]
        weights[-1] = weights[-1] * high + low
        weights[-2] = weights[-2] * high
        return cls(unit, weights)

    def __call__(self, measured: ArrayLike) -> Array:
        """Poses of many readings [F], shape (n, K), as an array (n, 4)."""
        return _layers(np.arcsinh(np.asarray(measured, dtype=float) / self.unit), self.weights)[-1]

    def estimate(self, measured: ArrayLike) -> LimbPose:
        """The pose of one reading [F], shape (K,).

        Raises:
            SceneError: It has another shape, or is not finite.
        """
        values = _capacitances(measured, len(self.weights[0]))
        return LimbPose(*self(values[None])[0].tolist())

    def save(self, path: str | Path) -> None:
        """Write it to an ``.npz`` file."""
        arrays = {f"w{k}": w for k, w in enumerate(self.weights)}
        np.savez(path, unit=np.array(self.unit), **arrays)  # type: ignore[arg-type]

    @classmethod
    def load(cls, path: str | Path) -> PoseNetwork:
        """Read one that :meth:`save` wrote."""
        with np.load(path, allow_pickle=False) as file:
            weights = [file[f"w{k}"] for k in range(len(file.files) - 1)]
            return cls(float(file["unit"]), weights)


def _split(flat: Array, shapes: list[tuple[int, ...]]) -> list[Array]:
    """Weights of all layers from one vector."""
    ends = np.cumsum([np.prod(s) for s in shapes])[:-1]
    return [p.reshape(s) for p, s in zip(np.split(flat, ends), shapes, strict=True)]


def _layers(inputs: Array, weights: list[Array]) -> list[Array]:
    """The inputs, what each hidden layer puts out, and the outputs."""
    values = [inputs]
    for k in range(0, len(weights), 2):
        linear = values[-1] @ weights[k] + weights[k + 1]
        values.append(linear if k + 2 == len(weights) else np.tanh(linear))
    return values


def _capacitances(measured: ArrayLike, count: int) -> Array:
    """Readings [F] as an array (count,).

    Raises:
        SceneError: They have another shape, or are not finite.
    """
    values = np.asarray(measured, dtype=float)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise SceneError(f"measured is {measured!r}; give {count} finite capacitances in F")
    return values


def follow(
    pose: LimbPose, gap: float = 0.05, speed: float = 0.0, gain: float = 8.0, turning: float = 3.0
) -> Array:
    """The motion by which a sensor keeps over a limb and goes along it, shape (6,).

    Args:
        pose: Where the limb is.
        gap: The gap to be kept [m].
        speed: Along the limb, towards +x [m/s].
        gain: Errors of place decay at this rate [1/s].
        turning: Errors of angles, which are noisier, decay at this one [1/s].

    Returns:
        Velocity of the sensor [m/s] and its angular velocity [rad/s], in the sensor frame.
    """
    keep = gain * np.array([0.0, pose.lateral, pose.vertical - gap])
    turn = turning * np.array([0.0, -pose.pitch, pose.yaw])
    return np.concatenate([keep + speed * pose.direction, turn])
