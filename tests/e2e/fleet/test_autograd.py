"""Gradients through PyTorch, against central differences."""

from __future__ import annotations

import numpy as np
import pytest
from approximate import approx
from fleet_scenes import BODIES, frames

from capsense.errors import SceneError
from capsense.fleet import Fleet

torch = pytest.importorskip("torch")


def two_by_two(device):
    """Two sensors before two bodies in two environments, quaternions of any length; weights."""
    fleet = Fleet(
        "six_patch", [BODIES[0], BODIES[2]], 2, sensors=2, device=device, budget=64,
        preset="fine" if device == "cpu" else "standard",
    )  # fmt: skip
    rng = np.random.default_rng(1)
    poses = np.array([[[-0.06, 0.0, 0.05, 0, 0, 0, 1.0], [0.05, 0.02, 0.06, 0, 0, 0, 1.0]]] * 2)
    poses[..., 3:] = rng.normal(size=(2, 2, 4))
    poses[1, :, :3] += 0.01
    sensors = frames(rng, 2, 2)
    sensors[..., 3:] *= rng.uniform(0.5, 3.0, (2, 2, 1))
    weights = rng.normal(size=(2, 2, 6, 6)) * 1e15
    return fleet, *map(torch.tensor, (poses, sensors, weights))


@pytest.mark.parametrize("device", ["cpu", "warp:cpu"])
def test_gradients(device):
    """Differential: a random sum of all entries, by every pose; to 0.5 and 0.1 % of the largest."""
    from capsense.fleet.autograd import change

    if device != "cpu":
        pytest.importorskip("warp")
    fleet = Fleet(
        "six_patch", [BODIES[0], BODIES[2]], 2, sensors=2, device=device, budget=64,
        preset="fine" if device == "cpu" else "standard",
    )  # fmt: skip

    def delta(poses):
        found = fleet.step(poses, sensors).delta
        return found if device == "cpu" else found.numpy().astype(float)

    rng = np.random.default_rng(1)
    poses = np.array([[[-0.06, 0.0, 0.05, 0, 0, 0, 1.0], [0.05, 0.02, 0.06, 0, 0, 0, 1.0]]] * 2)
    turn = rng.normal(size=(2, 2, 4))
    poses[..., 3:] = turn / np.linalg.norm(turn, axis=-1, keepdims=True)
    poses[1, :, :3] += 0.01
    sensors, weights = frames(rng, 2, 2), rng.normal(size=(2, 2, 6, 6)) * 1e15
    given = torch.tensor(poses, requires_grad=True)
    found = change(fleet, given, torch.tensor(sensors))
    np.testing.assert_allclose(found.detach().numpy(), delta(poses), rtol=1e-5, atol=1e-20)
    (found * torch.tensor(weights)).sum().backward()
    gradient = given.grad.numpy()
    # quaternions of length 1 only: no gradient across the sphere
    across = (gradient[..., 3:] * poses[..., 3:]).sum(axis=-1)
    np.testing.assert_allclose(across, 0.0, atol=1e-9 * np.abs(gradient).max())
    scale = np.abs(gradient).max()
    for e, b, k in np.ndindex(2, 2, 7):
        step = (2e-5 if device == "cpu" else 2e-4) if k < 3 else 1e-3
        ends = []
        for sign in (1, -1):
            moved = poses.copy()
            moved[e, b, k] += sign * step
            moved[e, b, 3:] /= np.linalg.norm(moved[e, b, 3:])
            ends.append((delta(moved) * weights).sum())
        difference = (ends[0] - ends[1]) / (2 * step)
        bound = 5e-3 if device == "cpu" else 1e-3
        assert gradient[e, b, k] == approx(difference, rel=0, abs=bound * scale)


@pytest.mark.parametrize("device", ["cpu", "warp:cpu"])
def test_gradients_by_long_quaternions(device):
    """Invariant: the longer, the smaller the gradient."""
    from capsense.fleet.autograd import change

    if device != "cpu":
        pytest.importorskip("warp")
    fleet = Fleet("six_patch", BODIES[:1], 1, device=device, budget=32)
    pose = np.array([[[0.01, 0.0, 0.06, 0.1, 0.5, 0.2, 0.8]]])
    pose[..., 3:] /= np.linalg.norm(pose[..., 3:])
    factor, gradients = 2.0, []
    for length in (1.0, factor):
        given = torch.tensor(pose * np.array([1, 1, 1, *[length] * 4]), requires_grad=True)
        change(fleet, given)[0, 0, 0, 0].backward()
        gradients.append(given.grad.numpy()[0, 0])
    wanted = gradients[0] / np.array([1, 1, 1, *[factor] * 4])
    bound = 1e-9 if device == "cpu" else 1e-4
    np.testing.assert_allclose(gradients[1], wanted, rtol=0, atol=bound * np.abs(wanted).max())


@pytest.mark.parametrize("device", ["cpu", "warp:cpu"])
def test_gradients_by_sensors(device):
    """Differential: central differences by every number of the sensors' poses, as by bodies."""
    from capsense.fleet.autograd import change

    if device != "cpu":
        pytest.importorskip("warp")
    fleet, poses, sensors, weights = two_by_two(device)

    def loss(poses, sensors):
        return (change(fleet, poses, sensors) * weights).sum()

    given = [values.clone().requires_grad_() for values in (poses, sensors)]
    loss(*given).backward()
    for which, values in enumerate(given):
        gradient = values.grad.numpy()
        across = (gradient[..., 3:] * values.detach().numpy()[..., 3:]).sum(axis=-1)
        np.testing.assert_allclose(across, 0.0, atol=1e-6 * np.abs(gradient).max())
        difference = np.empty_like(gradient)
        for place in np.ndindex(*gradient.shape):
            step = (2e-5 if device == "cpu" else 2e-4) if place[-1] < 3 else 1e-3
            ends = []
            for sign in (1, -1):
                moved = [poses.clone(), sensors.clone()]
                moved[which][place] += sign * step
                ends.append(float(loss(*moved)))
            difference[place] = (ends[0] - ends[1]) / (2 * step)
        bound = 6e-3 * np.abs(difference).max()
        np.testing.assert_allclose(gradient, difference, rtol=0, atol=bound)


@pytest.mark.parametrize("device", ["cpu", "warp:cpu"])
def test_all_moved_together(device):
    """Invariant: a world that moves as a whole changes nothing, so that gradients add to zero."""
    from capsense.fleet.autograd import change

    if device != "cpu":
        pytest.importorskip("warp")
    fleet, poses, sensors, weights = two_by_two(device)
    given = [values.clone().requires_grad_() for values in (poses, sensors)]
    (change(fleet, *given) * weights).sum().backward()
    along = [values.grad[..., :3].sum(dim=1) for values in given]
    bound = (1e-9 if device == "cpu" else 1e-5) * float(along[0].abs().max())
    torch.testing.assert_close(along[0], -along[1], rtol=0, atol=bound)


@pytest.mark.parametrize("device", ["cpu", "warp:cpu"])
def test_torch_func(device):
    """Differential: grad, jacrev and both orders of vmap with grad give what backward gives."""
    from capsense.fleet.autograd import change

    if device != "cpu":
        pytest.importorskip("warp")
    fleet, poses, sensors, weights = two_by_two(device)

    def loss(poses, sensors):
        return (change(fleet, poses, sensors) * weights).sum()

    given = [values.clone().requires_grad_() for values in (poses, sensors)]
    loss(*given).backward()
    wanted = [values.grad for values in given]
    found = torch.func.grad(loss, argnums=(0, 1))(poses, sensors)
    torch.testing.assert_close(list(found), wanted)
    rows = torch.func.jacrev(lambda s: change(fleet, poses, s))(sensors)
    assert rows.shape == (2, 2, 6, 6, 2, 2, 7)
    summed = (rows * weights[..., None, None, None]).sum(dim=(0, 1, 2, 3))
    torch.testing.assert_close(summed, wanted[1])
    other = poses + torch.tensor([0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.0])
    batch = torch.stack([other, poses], dim=1)  # not the first dimension
    each = torch.func.vmap(torch.func.grad(loss), in_dims=(1, None))(batch, sensors)
    torch.testing.assert_close(each[1], wanted[0])
    assert not torch.allclose(each[0], each[1])
    total = torch.func.grad(lambda b: torch.func.vmap(loss, in_dims=(1, None))(b, sensors).sum())
    torch.testing.assert_close(total(batch), each.transpose(0, 1))
    with pytest.raises(RuntimeError, match="cannot be differentiated twice"):
        torch.func.jacrev(torch.func.grad(loss))(poses, sensors)


def test_adam_on_quaternions():
    """Regression: steps make quaternions longer; a body is turned to where another reading was."""
    from capsense.fleet.autograd import change

    fleet = Fleet("six_patch", BODIES[:1], 1)
    first = torch.tensor([[[0.0, 0.0, 0.06, 0.0, 0.6, 0.0, 0.8]]], dtype=torch.float64)
    turned = torch.tensor([0.0, 0.0, 0.06, 0.0, 0.28, 0.0, 0.96], dtype=torch.float64)
    wanted = 1e12 * change(fleet, turned[None, None])
    place, turn = first[..., :3], first[..., 3:].clone().requires_grad_()
    adam, losses = torch.optim.Adam([turn], lr=0.02), []
    for _ in range(40):
        adam.zero_grad()
        found = 1e12 * change(fleet, torch.cat([place, turn], dim=-1))
        loss = ((found - wanted) ** 2).sum()
        loss.backward()
        adam.step()
        losses.append(float(loss))
    assert float(turn.detach().norm()) > 1.004
    assert losses[-1] < 0.01 * losses[0]


def test_refused():
    """Errors name the thing: a quaternion of no direction."""
    from capsense.fleet.autograd import change

    fleet = Fleet("six_patch", BODIES[:1], 1)
    poses = torch.tensor([[[0.0, 0.0, 0.06, 0.0, 0.0, 0.0, 0.0]]])
    with pytest.raises(SceneError, match=r"quaternion of poses\[0, 0\] is 0 long"):
        change(fleet, poses)
    with pytest.raises(SceneError, match="poses has shape"):
        change(fleet, poses[..., :6])


def test_arguments_of_the_other_function():
    """Each names the function, or the conversion, that takes what was given."""
    from capsense.fleet.autograd import change

    fleet = Fleet("six_patch", [BODIES[0]], 1)
    poses = np.array([[[0.0, 0.0, 0.06, 0, 0, 0, 1]]])
    given = torch.tensor(poses, requires_grad=True)
    with pytest.raises(SceneError, match=r"poses is a tensor .*autograd\.change\(fleet, poses\)"):
        fleet.step(given)
    with pytest.raises(TypeError, match=r"poses is of ndarray; give a tensor"):
        change(fleet, poses)
    with pytest.raises(TypeError, match=r"sensors is of ndarray; give a tensor"):
        change(fleet, given, poses)
    assert np.array_equal(fleet.step(given.detach()).delta, fleet.step(poses).delta)


def test_second_derivatives_are_refused():
    """Unit: they would be without the derivative of the Jacobian."""
    from capsense.fleet.autograd import change

    fleet = Fleet("six_patch", [BODIES[0]], 1)
    poses = torch.tensor([[[0.0, 0.0, 0.08, 0.0, 0.0, 0.0, 1.0]]], requires_grad=True)
    value = (1e12 * change(fleet, poses)).square().sum()
    (slope,) = torch.autograd.grad(value, poses, create_graph=True)
    with pytest.raises(RuntimeError, match="differentiated twice"):
        slope.sum().backward()


def test_no_jacobian_where_no_gradient_is_wanted(monkeypatch):
    """Unit: under ``no_grad`` it would take three times as long."""
    from capsense.fleet.autograd import change

    fleet, asked = Fleet("six_patch", [BODIES[0]], 1), []
    solved = fleet.solved

    def spied(*poses, jacobian):
        asked.append(jacobian)
        return solved(*poses, jacobian=jacobian)

    monkeypatch.setattr(fleet, "solved", spied)
    poses = torch.tensor([[[0.0, 0.0, 0.08, 0.0, 0.0, 0.0, 1.0]]], requires_grad=True)
    with torch.no_grad():
        before = change(fleet, poses)
    after = change(fleet, poses)
    assert asked == [False, True]
    assert torch.equal(before, after.detach())
