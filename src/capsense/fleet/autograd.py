"""A fleet's step as a function that PyTorch differentiates."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from capsense.fleet.fleet import Fleet

Array = NDArray[np.float64]


def change(fleet: Fleet, poses: torch.Tensor, sensors: torch.Tensor | None = None) -> torch.Tensor:
    """Change of the matrices by the bodies, with gradients by the poses of the bodies.

    Gradients are those of the solver's own adjoint, not of differences. That by a quaternion is
    within the unit sphere: a step along it turns the body and nothing else.

    Args:
        fleet: A fleet on the CPU.
        poses: As :meth:`Fleet.step` takes them, shape (e, b, 7).
        sensors: The same; no gradients are worked out by these.

    Returns:
        Shape (e, s, n, n) [F], of the precision of ``poses``.

    Raises:
        SceneError: As by :meth:`Fleet.step`.
        SolveError: As by :meth:`Fleet.step`.
        ValueError: The fleet is on Warp, or gradients by the sensors' poses are asked for.
    """
    if sensors is not None and sensors.requires_grad:
        raise ValueError("gradients by the poses of sensors are not known; move the bodies instead")
    out: torch.Tensor = _Change.apply(poses, sensors, fleet)
    return out


class _Change(torch.autograd.Function):
    @staticmethod
    def forward(
        context: Any, poses: torch.Tensor, sensors: torch.Tensor | None, fleet: Fleet
    ) -> torch.Tensor:
        host = poses.detach().cpu().numpy()
        at = None if sensors is None else sensors.detach().cpu().numpy()
        wanted = poses.requires_grad
        reading = fleet.solved(host, at, jacobian=wanted)
        context.slope = reading.jacobian
        context.turn = None if at is None else _matrices(at)
        context.save_for_backward(poses)
        return torch.as_tensor(reading.delta, dtype=poses.dtype, device=poses.device)

    @staticmethod
    def backward(context: Any, *outer: Any) -> tuple[torch.Tensor, None, None]:
        (poses,) = context.saved_tensors
        weights = outer[0].detach().cpu().numpy().astype(float)
        # along and about the axes of each sensor, then of the world
        slope = np.einsum("esij,esbijr->esbr", weights, context.slope)
        slope = slope.reshape(*slope.shape[:3], 2, 3)
        if context.turn is not None:
            slope = np.einsum("eskr,esbqr->esbqk", context.turn, slope)
        along, about = np.moveaxis(slope.sum(axis=1), 2, 0)
        quaternion = poses.detach().cpu().numpy().astype(float)[..., 3:]
        quaternion /= np.linalg.norm(quaternion, axis=-1, keepdims=True)
        v, w = quaternion[..., :3], quaternion[..., 3:]
        # a turn by a small vector t takes q to q + (t, 0) q / 2
        turned = np.concatenate(
            [w * about + np.cross(about, v), -(about * v).sum(axis=-1, keepdims=True)], axis=-1
        )
        gradient = np.concatenate([along, 2.0 * turned], axis=-1)
        return torch.as_tensor(gradient, dtype=poses.dtype, device=poses.device), None, None


def _matrices(poses: NDArray[Any]) -> Array:
    """Rotation matrices, shape (..., 7) -> (..., 3, 3)."""
    from scipy.spatial.transform import Rotation

    flat = poses.reshape(-1, 7)[:, 3:]
    return Rotation.from_quat(flat).as_matrix().reshape(*poses.shape[:-1], 3, 3)
