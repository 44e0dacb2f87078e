"""Bodies close to a flat design, in contact with it, and overlapping it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from approximate import approx

import capsense as cs

DATA = Path(__file__).parents[1] / "data" / "near_map.json"
MAP = {
    case["category"]: case
    for case in json.loads(DATA.read_text(encoding="utf-8"))["cases"]
    if case["design"] == "six_patch_bare"
}
SHAPES = {"sphere": cs.Sphere, "capsule": cs.Capsule, "box": lambda *size: cs.Box(size)}
PAD = (-0.038, -0.025)
"""Centre of the first pad of six_patch [m]."""


def _scene(case) -> cs.Scene:
    return cs.Scene(
        [
            cs.Body(
                SHAPES[b["shape"]](*b["size"]),
                pose=cs.Pose(tuple(b["position"]), tuple(b["quaternion"])),
                material="steel", grounding=b["kind"],
            )
            for b in case["bodies"]
        ]
    )  # fmt: skip


def _over_pad(shape: cs.Shape, height: float, grounding="grounded") -> cs.Scene:
    """A steel shape with its origin at a height over the first pad [m]."""
    pose = cs.Pose((*PAD, height))
    return cs.Scene([cs.Body(shape, pose=pose, material="steel", grounding=grounding)])


@pytest.mark.parametrize(
    "name", ["6pb ball10 g0.3", "6pb ball10 g1", "6pb needle r.5 L40 vertical g1"]
)
@pytest.mark.parametrize(("preset", "bound"), [("fast", 0.1), ("standard", 0.02)])
def test_near_references(name, preset, bound, simulators):
    """Differential: boundary elements of sensor and body together, to 1 %."""
    delta = 1e15 * simulators("six_patch_bare", preset=preset).step(_scene(MAP[name])).delta
    wanted = np.array(MAP[name]["delta_fF"])
    k = np.diag(wanted).argmax()
    assert delta[k, k] == approx(wanted[k, k], rel=bound)


@pytest.mark.parametrize("gap", [5e-5, 1e-4, 3e-4])
def test_a_plate_on_a_pad_is_a_plate_capacitor(gap, simulators):
    """Analytic: eps0 A / d, with 1 to 4 % more at the rims."""
    box = cs.Box((0.06, 0.06, 0.01))
    delta = simulators("six_patch_bare").step(_over_pad(box, 0.005 + gap)).delta
    assert delta[0, 0] == approx(8.854188e-12 * 9e-4 / gap, rel=0.04)


@pytest.mark.parametrize("preset", ["fast", "standard", "fine"])
@pytest.mark.parametrize(
    ("shape", "half"),
    [
        (cs.Box((0.03, 0.03, 0.03)), 0.015),
        (cs.Sphere(0.02), 0.02),
        (cs.Cylinder(0.035, 0.09), 0.045),
    ],
    ids=["box", "ball", "cup"],
)  # fmt: skip
def test_readings_rise_to_contact_and_stay(preset, shape, half, simulators):
    """Invariant: hard bodies of physics engines overlap; they are pressed out."""
    sensor = simulators("six_patch", preset=preset)
    gaps = [*np.geomspace(0.2, 2e-5, 30), 0.0, *-np.geomspace(1e-5, 5e-3, 8)]
    top = float(sensor.background.green.gap.top)
    found = [sensor.step(_over_pad(shape, top + half + gap)).delta[0, 0] for gap in gaps]
    assert all(np.diff(found) >= -1e-6 * max(found))
    np.testing.assert_allclose(found[31:], found[31], rtol=0.03)


def test_overlap_does_not_turn_with_the_body(simulators):
    """Invariant: a ball reads the same however it is turned, also in contact."""
    sensor, found = simulators("six_patch"), []
    for angle in (0.0, 0.4, 1.3):
        pose = cs.Pose((*PAD, 0.019), (np.sin(angle), 0.0, 0.0, np.cos(angle)))
        found.append(sensor.step(cs.Scene([cs.Body(cs.Sphere(0.02), pose, "steel")])).delta)
    for other in found[1:]:
        np.testing.assert_allclose(other, found[0], rtol=0, atol=5e-3 * found[0].max())


@pytest.mark.parametrize("gap", [2e-4, 1e-3, 4e-3])
def test_capacitance_to_ground_leads_from_floating_to_grounded(gap, simulators):
    sensor, box = simulators("six_patch_bare"), cs.Box((0.06, 0.06, 0.01))

    def read(grounding) -> float:
        return float(sensor.step(_over_pad(box, 0.005 + gap, grounding)).delta[0, 0])

    found = [read(tie) for tie in ("floating", 1e-13, 1e-12, 1e-11, 1e-10, "grounded")]
    assert found == sorted(found)
    assert read(1e-18) == approx(found[0], rel=1e-4)
    assert read(1e-6) == approx(found[-1], rel=1e-4)


def test_a_floating_plate_couples_two_pads(simulators):
    """Invariant: a floating plate close to two pads puts their gaps in series."""
    sensor, gap = simulators("six_patch_bare"), 1e-4
    plate = cs.Box((0.07, 0.03, 0.002))
    pose = cs.Pose((-0.019, -0.025, 0.001 + gap))
    body = cs.Body(plate, pose=pose, material="steel", grounding="floating")
    delta = sensor.step(cs.Scene([body])).delta
    assert -delta[0, 1] == approx(0.5 * 8.854188e-12 * 9e-4 / gap, rel=0.06)


@pytest.mark.parametrize("gap", [5e-4, 2e-3])
def test_meshes_are_as_the_primitives_they_are_of(gap, simulators):
    sensor = simulators("six_patch_bare")
    ball = trimesh.creation.icosphere(4, 0.02)
    mesh = cs.TriMesh(np.asarray(ball.vertices), np.asarray(ball.faces))
    found, exact = (
        sensor.step(_over_pad(shape, 0.02 + gap)).delta[0, 0] for shape in (mesh, cs.Sphere(0.02))
    )
    assert found == approx(exact, rel=0.025)


@pytest.mark.parametrize("grounding", ["grounded", "floating"])
@pytest.mark.parametrize("gap", [3e-4, 1e-3, 2.2e-3])
def test_slopes_near_contact_are_those_of_the_step(gap, grounding, simulators):
    sensor, step = simulators("six_patch_bare"), 1e-6

    def read(offset) -> np.ndarray:
        at = offset + np.array([PAD[0] + 0.004, PAD[1] + 0.003, 0.012 + gap])
        body = cs.Body(cs.Sphere(0.012), cs.Pose(tuple(at)), "steel", grounding=grounding)
        return sensor.step(cs.Scene([body]), jacobian=True)

    found = read(np.zeros(3)).jacobian[0, 0, 0, :3]
    wanted = np.array(
        [(read(d).delta - read(-d).delta)[0, 0] / (2 * step) for d in step * np.eye(3)]
    )
    np.testing.assert_allclose(found, wanted, rtol=0, atol=0.03 * np.abs(wanted).max())


def test_beyond_twice_the_validity_distance_nothing_is_added(simulators):
    sensor = simulators("six_patch_bare")
    gap = 2.01 * sensor.background.green.gap.validity
    solver = sensor._solver
    scene = _over_pad(cs.Sphere(0.02), 0.02 + gap)
    _, solution = solver.solution(solver.look(scene))
    assert not solution.near.any()
