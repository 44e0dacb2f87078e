"""A fleet's step as a function that PyTorch differentiates."""

from __future__ import annotations

from typing import Any

import torch

from capsense.errors import SceneError
from capsense.fleet.fleet import Fleet


def change(fleet: Fleet, poses: torch.Tensor, sensors: torch.Tensor | None = None) -> torch.Tensor:
    """Change of the matrices by the bodies, with gradients by the poses of bodies and sensors.

    Gradients are those of the solver's own adjoint, not of differences. Quaternions may be of any
    length, and count by their direction: a gradient has no part along them, so that a step along
    it turns the body and nothing else. There are no second derivatives; PyTorch refuses them. With
    a fleet on Warp nothing leaves the device.

    ``torch.func.grad``, ``vjp`` and ``jacrev`` work. ``vmap`` makes one step of the fleet for each
    member of the batch; there is no forward mode (``jvp``, ``jacfwd``).

    Args:
        fleet: A fleet.
        poses: As :meth:`Fleet.step` takes them, shape (e, b, 7); on the fleet's device.
        sensors: The same of the sensors' frames, shape (e, s, 7); by default those of the worlds.

    Returns:
        Shape (e, s, n, n) [F], of the precision of ``poses``.

    Raises:
        TypeError: Poses are no tensors.
        SceneError: As by :meth:`Fleet.step`; a quaternion has length 0 (on Warp, this gives
            readings that are not finite).
        SolveError: As by :meth:`Fleet.step`.
    """
    for what, values in (("poses", poses), ("sensors", sensors)):
        if not isinstance(values, torch.Tensor | None):
            raise TypeError(
                f"{what} is of {type(values).__name__}; give a tensor, such as "
                f"torch.tensor({what}, requires_grad=True)"
            )
    slopes = torch.is_grad_enabled() and any(map(_followed, (poses, sensors)))
    if not slopes:
        poses, sensors = poses.detach(), None if sensors is None else sensors.detach()
    out: torch.Tensor = _Change.apply(poses, sensors, fleet, slopes)[0]
    return out


def _followed(values: torch.Tensor | None) -> bool:
    """Whether gradients by a tensor may be asked for; within ``torch.func`` that is not known."""
    if values is None:
        return False
    return values.requires_grad or bool(torch._C._functorch.is_functorch_wrapped_tensor(values))


class _Change(torch.autograd.Function):
    """ΔC, shape (e, s, n, n), and its derivatives by bodies, (e, s, b, n, n, 6), if wanted."""

    @staticmethod
    def forward(
        poses: torch.Tensor, sensors: torch.Tensor | None, fleet: Fleet, slopes: bool
    ) -> tuple[torch.Tensor, torch.Tensor]:
        where, at = _given("poses", poses, fleet), _given("sensors", sensors, fleet)
        reading = fleet.solved(where, at, jacobian=slopes)

        def kept(values: Any) -> torch.Tensor:
            # the fleet writes its arrays anew
            return torch.from_dlpack(values).to(poses.device, poses.dtype, copy=True)

        return kept(reading.delta), kept(reading.jacobian) if slopes else poses.new_zeros(0)

    @staticmethod
    def setup_context(context: Any, inputs: tuple[Any, ...], output: tuple[Any, ...]) -> None:
        context.mark_non_differentiable(output[1])
        context.save_for_backward(inputs[0], inputs[1], output[1])

    @staticmethod
    def backward(context: Any, *outer: Any) -> tuple[Any, ...]:
        return (*_Pull.apply(outer[0], *context.saved_tensors), None, None)

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[Any, ...], poses: torch.Tensor, sensors: torch.Tensor | None,
        fleet: Fleet, slopes: bool,
    ) -> tuple[tuple[torch.Tensor, ...], tuple[int, ...]]:  # fmt: skip
        def member(values: Any, dim: int | None, k: int) -> Any:
            return values if dim is None else values.select(dim, k)

        each = [
            _Change.apply(
                member(poses, in_dims[0], k), member(sensors, in_dims[1], k), fleet, slopes
            )
            for k in range(info.batch_size)
        ]
        return tuple(torch.stack(parts) for parts in zip(*each, strict=True)), (0, 0)


class _Pull(torch.autograd.Function):
    """Gradients by the poses of bodies and of sensors, if there are any, from those by ΔC."""

    generate_vmap_rule = True

    @staticmethod
    def forward(
        outer: torch.Tensor, poses: torch.Tensor, sensors: torch.Tensor | None, slope: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor | None]:
        # along and about the axes of each sensor, (e, s, b, 2, 3), then of the world
        pull = torch.einsum("esij,esbijr->esbr", outer, slope).unflatten(-1, (2, 3))
        if sensors is None:
            return _by_pose(pull.sum(dim=1), poses), None
        pull = torch.einsum("eskr,esbqr->esbqk", _matrices(sensors.to(pull)), pull)
        # to move a sensor is to move all bodies back, about its origin
        along, about = pull.unbind(dim=3)
        arm = poses[:, None, :, :3] - sensors[:, :, None, :3].to(poses)
        about = about + torch.linalg.cross(arm.expand_as(along), along)
        back = -torch.stack([along.sum(dim=2), about.sum(dim=2)], dim=2)
        return _by_pose(pull.sum(dim=1), poses), _by_pose(back, sensors.to(back)).to(sensors)

    @staticmethod
    def setup_context(context: Any, inputs: tuple[Any, ...], output: tuple[Any, ...]) -> None:
        pass

    @staticmethod
    def backward(context: Any, *outer: Any) -> Any:
        raise RuntimeError(
            "change(fleet, …) cannot be differentiated twice: a fleet has no second derivatives; "
            "take differences of its gradients"
        )


def _given(what: str, poses: torch.Tensor | None, fleet: Fleet) -> Any:
    """Poses as a fleet takes them; on the host with quaternions of length 1.

    Raises:
        SceneError: A quaternion has length 0.
    """
    if poses is None:
        return None
    poses = poses.detach()
    if fleet.device != "cpu":
        return poses.float().contiguous()
    if poses.shape[-1:] != (7,):
        return poses.cpu().numpy()  # which is refused
    length = torch.linalg.vector_norm(poses[..., 3:], dim=-1, keepdim=True)
    if (length == 0.0).any():
        place = torch.argwhere(length == 0.0)[0].tolist()[:-1]
        raise SceneError(
            f"the quaternion of {what}{place} is 0 long; give (x, y, z, w) that is not all zero"
        )
    return torch.cat([poses[..., :3], poses[..., 3:] / length], dim=-1).cpu().numpy()


def _by_pose(pull: torch.Tensor, poses: torch.Tensor) -> torch.Tensor:
    """Gradients by poses (..., 7) from those along and about the axes of the world, (..., 2, 3)."""
    along, about = pull.unbind(dim=-2)
    length = torch.linalg.vector_norm(poses[..., 3:], dim=-1, keepdim=True)
    v, w = (poses[..., 3:] / length).split([3, 1], dim=-1)
    # a turn by a small vector t takes q to q + (t, 0) q / 2
    turned = w * about + torch.linalg.cross(about, v.expand_as(about))
    turned = torch.cat([turned, -(about * v).sum(dim=-1, keepdim=True)], -1)
    return torch.cat([along, 2.0 * turned / length], dim=-1)


def _matrices(poses: torch.Tensor) -> torch.Tensor:
    """Rotation matrices, shape (..., 7) -> (..., 3, 3)."""
    x, y, z, w = torch.nn.functional.normalize(poses[..., 3:], dim=-1).unbind(dim=-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
