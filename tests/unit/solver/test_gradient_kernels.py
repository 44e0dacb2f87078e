"""The Jacobian of the surface step: against a slow twin and differences, and its symmetries."""

from __future__ import annotations

import gradient_twin
import numpy as np
import pytest
from surface_scenes import Placed, green_of, moved, pack

import capsense as cs
from capsense.field.green_kernels import Green, no_gap
from capsense.solver.gradients.gradient_kernels import jacobian
from capsense.solver.system.step import Solution, solve

Array = np.ndarray
FINGER, ARM, BALL = cs.Capsule(0.008, 0.06), cs.Capsule(0.04, 0.25), cs.Sphere(0.03)
BOX = cs.Box((0.1, 0.06, 0.02))
ACROSS = (0.1, np.pi / 2, 0.2)
SCREENED = "a ball in front of an arm"
"""The ball takes up the field, so that the arm's Jacobian is a hundredth of the ball's."""

SCENES = {
    "finger at 8 mm": (Placed(FINGER, (0.01, -0.02, 0.016), ACROSS),),
    "finger between near and far": (Placed(FINGER, (0.01, -0.02, 0.023), ACROSS),),
    "finger upright": (Placed(FINGER, (0.02, 0.01, 0.06), (0.2, 0.1, 0.0)),),
    "arm": (Placed(ARM, (0.0, 0.01, 0.07), ACROSS),),
    "floating ball": (Placed(BALL, (0.02, 0.01, 0.045), floating=True),),
    "box": (Placed(BOX, (0.01, 0.0, 0.05), (0.1, 0.2, 0.3)),),
    "box far off": (Placed(BOX, (0.01, 0.0, 0.11), (0.1, 0.2, 0.3)),),
    "arm through a wall": (Placed(ARM, (0.2, 0.01, 0.06), ACROSS),),
    "floating arm through a wall": (Placed(ARM, (0.15, 0.01, 0.07), ACROSS, floating=True),),
    "arm of eps 3": (Placed(ARM, (0.0, 0.01, 0.07), ACROSS, eps_r=3.0),),
    "ball of eps 80": (Placed(BALL, (0.02, 0.01, 0.045), eps_r=80.0),),
    "two fingers": (
        Placed(FINGER, (0.01, -0.02, 0.03), ACROSS), Placed(FINGER, (0.0, 0.01, 0.04), ACROSS),
    ),
    SCREENED: (
        Placed(BALL, (0.0, 0.0, 0.05)), Placed(ARM, (0.0, 0.0, 0.14), ACROSS),
    ),
}  # fmt: skip


def _solved(name: str, threshold: float) -> tuple[Array, Solution, Array]:
    bodies = pack(*SCENES[name])
    solution = solve(bodies, green_of(), threshold, 2.5, True)
    return bodies, solution, jacobian(solution, bodies, green_of())


def _differences(bodies: Array, threshold: float) -> Array:
    out = np.empty((len(bodies), green_of().terminals, green_of().terminals, 6))
    for b in range(len(bodies)):
        for r in range(6):
            step = 2e-4 if r < 3 else 4e-3
            deltas = [
                solve(moved(bodies, b, r, s), green_of(), threshold, 2.5, True).delta
                for s in (step, -step)
            ]
            out[b, :, :, r] = (deltas[0] - deltas[1]) / (2 * step)
    return out


def _apart(found: Array, wanted: Array) -> float:
    """Largest difference over the largest entry, body by body; a turn counts at 50 mm."""
    weights = np.array([1.0, 1.0, 1.0, 20.0, 20.0, 20.0])
    differences = np.abs((found - wanted) * weights).max(axis=(1, 2, 3))
    return float((differences / np.abs(wanted * weights).max(axis=(1, 2, 3))).max())


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.e2e
def test_agrees_with_energies_of_moved_charges(name: str) -> None:
    bodies, solution, found = _solved(name, 0.015)
    wanted = gradient_twin.jacobian(solution, bodies, green_of())
    assert _apart(found, wanted) < 1e-5


@pytest.mark.parametrize("name", SCENES)
def test_agrees_with_differences_of_fine_solutions(name: str) -> None:
    bodies, _, found = _solved(name, 1e-3)
    assert _apart(found, _differences(bodies, 1e-3)) < (0.03 if name == SCREENED else 0.015)


def _faceless() -> Green:
    """A shell that bodies may reach into: without a face, they are not lifted off it."""
    green = green_of("arm_segment")
    gap = no_gap(green.gap.validity, green.gap.face)
    return green._replace(gap=gap, space=green.space._replace(has_face=False))


@pytest.mark.parametrize(
    ("shape", "depth"), [(cs.Capsule(0.004, 0.03), 0.004), (cs.Sphere(0.005), 0.012)]
)
def test_bodies_within_a_sensor_feel_no_source_that_their_potential_is_bounded_by(shape, depth):
    """Regression: against central differences of the values; forces of those sources were not
    bounded, which made the Jacobian wrong by half to over the whole of it."""
    green = _faceless()
    place = (0.016, 0.011, float(green.box[1, 2]) + shape.radius - depth)
    bodies = pack(Placed(shape, place, ACROSS, eps_r=1.2))
    found = jacobian(solve(bodies, green, 1e-4, 2.5, True), bodies, green)[..., :3]
    for k in range(3):
        ends = [solve(moved(bodies, 0, k, s), green, 1e-4, 2.5, True).delta for s in (5e-5, -5e-5)]
        miss = found[0, ..., k] - (ends[0] - ends[1]) / 1e-4
        assert np.abs(miss).max() < 0.05 * np.abs(found).max()


def test_a_ball_around_a_source_feels_no_force_of_it() -> None:
    """Differential: against energies of moved charges, none of which is 1 mm from the source."""
    green = _faceless()
    sources, middle = green.levels[0].sources.T, green.box.mean(axis=0)
    place = sources[np.argmin(np.linalg.norm(sources - middle, axis=1))]
    bodies = pack(Placed(cs.Sphere(0.5 * green.levels[0].least), tuple(place.tolist())))
    solution = solve(bodies, green, 0.015, 2.5, True)
    wanted = gradient_twin.jacobian(solution, bodies, green)
    assert _apart(jacobian(solution, bodies, green), wanted) < 1e-5


@pytest.mark.parametrize("name", SCENES)
def test_coarse_solutions_have_nearly_the_jacobian_of_fine_ones(name: str) -> None:
    bodies, _, found = _solved(name, 0.015)
    fine = solve(bodies, green_of(), 1e-3, 2.5, True)
    limit = 0.15 if name == SCREENED else 0.05
    assert _apart(found, jacobian(fine, bodies, green_of())) < limit


def test_is_symmetric_in_the_terminals() -> None:
    _, _, found = _solved("two fingers", 0.015)
    assert np.array_equal(found, found.swapaxes(1, 2))


@pytest.mark.parametrize("name", ["floating ball", "ball of eps 80"])
def test_turning_a_ball_changes_next_to_nothing(name: str) -> None:
    _, _, found = _solved(name, 1e-3)
    turn, shift = np.abs(found[..., 3:]).max(), np.abs(found[..., :3]).max()
    assert turn < 2e-2 * 0.03 * shift


def test_a_body_that_comes_nearer_raises_the_diagonal() -> None:
    _, _, found = _solved("arm", 0.015)
    assert (np.diagonal(found[0, :, :, 2]) < 0).all()


def test_a_body_far_off_changes_little() -> None:
    _, _, near = _solved("box", 0.015)
    _, _, far = _solved("box far off", 0.015)
    assert np.abs(far).max() < 0.1 * np.abs(near).max()


def test_turning_moves_what_is_off_the_origin() -> None:
    """A body whose origin is displaced gains the displacement's lever."""
    bodies, solution, found = _solved("finger upright", 0.015)
    lever = np.array([0.01, -0.02, 0.03])
    shifted = bodies.copy()
    shifted["position"] -= lever
    other = jacobian(solution, shifted, green_of())
    wanted = found[0, ..., 3:] + np.cross(lever, found[0, ..., :3])
    assert np.allclose(other[0, ..., 3:], wanted, atol=1e-5 * np.abs(wanted).max())
