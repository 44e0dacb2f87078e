"""A fleet's step as a function that PyTorch differentiates."""

from __future__ import annotations

from typing import Any

import torch
from torch.autograd.function import once_differentiable

from capsense.fleet.fleet import Fleet


def change(fleet: Fleet, poses: torch.Tensor, sensors: torch.Tensor | None = None) -> torch.Tensor:
    """Change of the matrices by the bodies, with gradients by the poses of the bodies.

    Gradients are those of the solver's own adjoint, not of differences. Quaternions count by their
    direction: a step along the gradient turns the body and nothing else. There are no second
    derivatives; PyTorch refuses them. With a fleet on Warp nothing leaves the device.

    Args:
        fleet: A fleet.
        poses: As :meth:`Fleet.step` takes them, shape (e, b, 7); on the fleet's device.
        sensors: The same; no gradients are worked out by these.

    Returns:
        Shape (e, s, n, n) [F], of the precision of ``poses``.

    Raises:
        TypeError: Poses are no tensors.
        SceneError: As by :meth:`Fleet.step`.
        SolveError: As by :meth:`Fleet.step`.
        ValueError: Gradients by the sensors' poses are asked for.
    """
    for what, values in (("poses", poses), ("sensors", sensors)):
        if not isinstance(values, torch.Tensor | None):
            raise TypeError(
                f"{what} is of {type(values).__name__}; give a tensor, such as "
                f"torch.tensor({what}, requires_grad=True)"
            )
    if sensors is not None and sensors.requires_grad:
        raise ValueError("gradients by the poses of sensors are not known; move the bodies instead")
    wanted = poses if torch.is_grad_enabled() else poses.detach()
    out: torch.Tensor = _Change.apply(wanted, sensors, fleet)
    return out


class _Change(torch.autograd.Function):
    @staticmethod
    def forward(
        context: Any, poses: torch.Tensor, sensors: torch.Tensor | None, fleet: Fleet
    ) -> torch.Tensor:
        def given(values: torch.Tensor | None) -> Any:
            if values is None:
                return None
            values = values.detach()
            return values.cpu().numpy() if fleet.device == "cpu" else values.float().contiguous()

        reading = fleet.solved(given(poses), given(sensors), jacobian=poses.requires_grad)

        def kept(values: Any) -> torch.Tensor:
            # the fleet writes its arrays anew
            return torch.from_dlpack(values).to(poses.device, poses.dtype, copy=True)

        context.slope = kept(reading.jacobian) if poses.requires_grad else None
        context.save_for_backward(poses, sensors)
        return kept(reading.delta)

    @staticmethod
    @once_differentiable
    def backward(context: Any, *outer: Any) -> tuple[torch.Tensor, None, None]:
        poses, sensors = context.saved_tensors
        # along and about the axes of each sensor, then of the world
        slope = torch.einsum("esij,esbijr->esbr", outer[0], context.slope)
        slope = slope.reshape(*slope.shape[:3], 2, 3)
        if sensors is not None:
            turn = _matrices(sensors.to(slope))
            slope = torch.einsum("eskr,esbqr->esbqk", turn, slope)
        along, about = slope.sum(dim=1).unbind(dim=2)
        length = torch.linalg.vector_norm(poses.detach()[..., 3:], dim=-1, keepdim=True)
        v, w = (poses.detach()[..., 3:] / length).split([3, 1], dim=-1)
        # a turn by a small vector t takes q to q + (t, 0) q / 2
        turned = torch.cat(
            [w * about + torch.linalg.cross(about, v), -(about * v).sum(dim=-1, keepdim=True)], -1
        )
        return torch.cat([along, 2.0 * turned / length], dim=-1), None, None


def _matrices(poses: torch.Tensor) -> torch.Tensor:
    """Rotation matrices, shape (..., 7) -> (..., 3, 3)."""
    x, y, z, w = torch.nn.functional.normalize(poses[..., 3:], dim=-1).unbind(dim=-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
