"""The pose of a limb by a small network, trained on simulated readings."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize

from capsense.errors import SceneError
from capsense.learning.servo import LimbPose

Array = NDArray[np.float64]

LAYERS = (32, 32)
"""Units of the hidden layers."""
DECAY = 1e-4
"""Weight of the squared weights in what is minimised."""


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
        values = np.asarray(measured, dtype=float)
        if values.shape != (len(self.weights[0]),) or not np.isfinite(values).all():
            raise SceneError(
                f"measured is {measured!r}; give {len(self.weights[0])} finite capacitances in F"
            )
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
