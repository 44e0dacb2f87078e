"""Conductors of different potentials that are nearer to each other than their panels are wide."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from approximate import approx
from numpy.typing import NDArray
from reference_scenes import DATA, FEMTO, body_of_json

import capsense as cs
from capsense.field.face_kernels import held_off
from capsense.solver.gap.body_gap_kernels import SHARE, facing_of, local_capacitance
from capsense.solver.system.step import solve

Array = NDArray[np.float64]
REFERENCES = json.loads((DATA / "body_gaps.json").read_text(encoding="utf-8"))["cases"]
SHEET = cs.Box((0.06, 0.06, 0.001))
LOW = cs.Body(SHEET, cs.Pose((0.038, 0.025, 0.0035)), "steel", grounding="floating")
TOP = 0.004
"""Height of that sheet's upper face [m]."""


def mesh_box(size: tuple[float, float, float]) -> cs.TriMesh:
    """A box of twelve triangles."""
    x, y, z = np.array(size) / 2
    corners = np.array([[a, b, c] for a in (-x, x) for b in (-y, y) for c in (-z, z)])
    faces = [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ]  # fmt: skip
    return cs.TriMesh(corners, np.array(faces))


def above(gap: float, shape: cs.Shape = SHEET, half: float = 0.0005, **more: Any) -> cs.Body:
    return cs.Body(shape, cs.Pose((0.038, 0.025, TOP + gap + half)), "steel", **more)


def records_of(sim: cs.Simulator, *bodies: cs.Body) -> NDArray[np.void]:
    solver = sim._solver
    return solver.pack(solver.look(cs.Scene(list(bodies)))).records


def held(sim: cs.Simulator, *bodies: cs.Body) -> int:
    return int(facing_of(records_of(sim, *bodies)).pairs)


def largest(sim: cs.Simulator, *bodies: cs.Body) -> float:
    return float(np.diag(sim.step(cs.Scene(list(bodies))).delta).max())


def path_of(design: str) -> Path:
    return DATA / "near_designs" / f"{design}.toml"


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(c, id=c["category"], marks=[pytest.mark.e2e] * path_of(c["design"]).exists())
        for c in REFERENCES
    ],
)
def test_readings_with_bodies_near_each_other(simulators, case):
    """Boundary elements of sensor and bodies together; large entries are right to 5 %.

    Fields of designs that do not come with the package take a minute to build.
    """
    path = path_of(case["design"])
    sim = simulators(str(path) if path.exists() else case["design"])
    reading = sim.step(cs.Scene([body_of_json(b) for b in case["bodies"]]))
    truth = FEMTO * np.diag(case["delta_fF"])
    counts = truth > 0.1 * truth.max()
    error = np.diag(reading.delta)[counts] / truth[counts] - 1.0
    assert np.abs(error).max() < 0.05 + case["error"]


def test_a_floating_plate_comes_to_the_potential_of_the_plate_above_it(simulators):
    """Plate capacitor: what it lacks to a grounded one goes with the gap, and to zero."""
    sim = simulators("six_patch_bare")
    grounded = cs.Body(SHEET, LOW.pose, "steel")
    lack = [largest(sim, grounded) - largest(sim, LOW, above(g)) for g in (1e-4, 2e-4, 4e-4)]
    assert 0.0 < lack[0] < 0.05 * largest(sim, grounded)
    np.testing.assert_allclose(np.divide(lack[1:], lack[:-1]), 2.0, rtol=0.2)


@pytest.mark.parametrize("gap", [5e-5, 2e-4, 1e-3, 5e-3])
def test_local_capacitance_of_plates(simulators, gap):
    """Analytic: A (1/g - 1/h) over facing faces; sides of the plates add some per cent."""
    records = records_of(simulators("six_patch_bare"), LOW, above(gap))
    facing = facing_of(records)
    length = float(facing.length[0])
    c = local_capacitance(records[0], records[1], length, facing.point, facing.room)
    plate = 0.06**2 * (1.0 / gap - 1.0 / held_off(gap, length)) / (4.0 * math.pi)
    assert plate < c < 1.05 * plate


@pytest.mark.parametrize("gap", [2e-5, 3e-4, 2e-3])
@pytest.mark.parametrize("mesh", [False, True])
def test_local_capacitance_of_a_ball_and_a_plate(simulators, gap, mesh):
    """Numerical quadrature in one dimension: the ball's distance from the plate is z."""
    radius = 0.012
    plate = mesh_box((0.06, 0.06, 0.001)) if mesh else SHEET
    low = cs.Body(plate, LOW.pose, "steel", grounding="floating")
    records = records_of(simulators("six_patch_bare"), low, above(gap, cs.Sphere(radius), radius))
    facing = facing_of(records)
    length = float(facing.length[0])
    c = local_capacitance(records[1], records[0], length, facing.point, facing.room)
    angle = np.linspace(0.0, 0.5 * math.pi, 200_001)
    z = gap + radius * (1.0 - np.cos(angle))
    arc = np.where(angle > 0.0, angle / np.sin(np.maximum(angle, 1e-9)), 1.0)
    change = (1.0 / z - 1.0 / np.array([held_off(d, length) for d in z])) / arc
    wanted = np.trapezoid(change * 2.0 * math.pi * radius**2 * np.sin(angle), angle)
    assert c == approx(wanted / (4.0 * math.pi), rel=0.02)


@pytest.mark.parametrize(("shape", "half"), [(SHEET, 0.0005), (cs.Sphere(0.012), 0.012)])
def test_readings_are_continuous_in_the_gap(simulators, shape, half):
    """Neither a body's range nor small gaps make a step; readings grow towards contact.

    Where a ball comes to have finer parts, its reading rises by 2 % of the largest within 1 mm.
    """
    sim = simulators("six_patch_bare")
    for gaps in (np.linspace(0.022, 3e-3, 77), np.geomspace(3e-3, 5e-6, 90)):
        values = np.array([largest(sim, LOW, above(g, shape, half)) for g in gaps])
        steps = np.diff(values)
        assert steps.min() > -4e-3 * values.max()
        assert np.abs(np.diff(steps)).max() < 0.012 * values.max()


def test_overlap_is_contact(simulators):
    """Meshes are not joined where they overlap: readings stay, or grow, up to a bound."""
    sim = simulators("six_patch_bare")
    thick = cs.Body(mesh_box((0.06, 0.06, 0.006)), cs.Pose((0.038, 0.025, TOP - 0.0005)), "steel",
                    grounding="floating")  # fmt: skip
    top = TOP + 0.0025
    values = []
    for gap in (3e-4, 1e-4, 1e-5, -1e-4, -3e-4, -1e-3, -2e-3):
        pose = cs.Pose((0.038, 0.025, top + gap + 0.005))
        values.append(largest(sim, thick, cs.Body(mesh_box((0.05, 0.05, 0.01)), pose, "steel")))
    grounded = largest(sim, cs.Body(thick.shape, thick.pose, "steel"))
    assert (np.diff(values) > -1e-3 * grounded).all()
    assert max(values) < 1.1 * grounded


def test_bodies_apart_are_solved_as_before(simulators):
    """Beyond the range no bit changes: records without outlines face nothing."""
    sim = simulators("six_patch_bare")
    solver = sim._solver
    ranges = 3.0 * SHARE * 0.06
    for gap, same in ((1.02 * ranges, True), (0.3 * ranges, False)):
        records = records_of(sim, cs.Body(SHEET, cs.Pose((0.038, 0.025, 0.03)), "steel",
                                          grounding="floating"),
                         cs.Body(SHEET, cs.Pose((0.038, 0.025, 0.031 + gap)), "steel"))  # fmt: skip
        assert (facing_of(records).pairs == 0) == same
        found = solve(records, solver.green, 0.015, 2.5, False).delta
        records["outline"] = 0
        plain = solve(records, solver.green, 0.015, 2.5, False).delta
        assert np.array_equal(found, plain) == same


def test_which_bodies_face_each_other(simulators):
    """Conductors of different potentials; not those at ground, of one net, or dielectrics."""
    sim = simulators("six_patch_bare")
    assert held(sim, LOW, above(1e-3)) == 1
    assert held(sim, LOW, above(1e-3, grounding=1e-11)) == 1
    assert held(sim, LOW, above(1e-3, grounding="floating")) == 1
    assert held(sim, cs.Body(SHEET, LOW.pose, "steel"), above(1e-3)) == 0
    assert held(sim, LOW, above(0.0)) == 0  # they touch
    assert held(sim, LOW, cs.Body(SHEET, above(1e-3).pose, "glass")) == 0
    assert held(sim, LOW) == 0


def test_jacobian_between_bodies(simulators):
    """Central differences of whole steps."""
    sim = simulators("six_patch_bare")

    def scene(shift: float) -> cs.Scene:
        ball = cs.Body(cs.Sphere(0.012), cs.Pose((0.03, 0.02, TOP + 4e-4 + 0.012 + shift)), "steel")
        return cs.Scene([LOW, ball])

    step = 2e-5
    ends = [np.diag(sim.step(scene(s)).delta) for s in (step, -step)]
    slope = (ends[0] - ends[1]) / (2.0 * step)
    found = np.diagonal(sim.step(scene(0.0), jacobian=True).jacobian[1, :, :, 2])
    k = int(np.abs(slope).argmax())
    assert slope[k] < 0.0
    assert found[k] == approx(slope[k], rel=0.02)


def test_surfaces_that_change_have_no_such_pairs(simulators):
    """Of a sheet near the design the outline is that of a part, without sizes; a ball floats."""
    sim = simulators("six_patch_bare")
    corners = np.array([[-0.02, -0.02], [0.02, -0.02], [0.02, 0.02], [-0.02, 0.02]])
    vertices = np.column_stack([corners, np.full(4, 1e-3)])
    sheet = cs.DeformableSurface(vertices, [[0, 1, 2], [0, 2, 3]], material="steel").body()
    ball = cs.Body(cs.Sphere(0.01), cs.Pose((0.0, 0.0, 0.012)), "steel", grounding="floating")
    scene = cs.Scene([sheet, ball])
    bodies = sim._solver.pack(sim._solver.look(scene))
    assert (bodies.records["outline"] != 0).all()
    assert facing_of(bodies.records).pairs == 0
    assert np.isfinite(sim.step(scene).delta).all()
