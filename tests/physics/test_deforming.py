"""Deforming meshes, posed at every step: a hand and a person of one connected mesh each."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from benchmark_modules import imported
from rigged import rig

import capsense as cs

DATA = Path(__file__).resolve().parents[1] / "data" / "reference_deforming.json"
Make = Callable[..., cs.Simulator]
OVER = cs.Pose.from_euler((0.73, 0.02, -1.34), (0.0, 0.0, 0.0))
"""Puts the hand at rest over the sensor."""
CURLED = {"right_index_0": (0, -60, 0), "right_middle_1": (0, -40, 0), "right_thumb_0": (20, 0, 0)}


def read(sim: cs.Simulator, surface: cs.DeformableSurface, vertices: np.ndarray) -> np.ndarray:
    return np.asarray(sim.step(cs.Scene([surface.update(vertices)])).delta)


def test_moving_all_vertices_moves_the_body(simulators: Make) -> None:
    """Invariant: vertices moved as one read as the same vertices under a pose, to rounding."""
    sim, hand = simulators("six_patch_bare"), rig(hand_only=True)
    surface = cs.DeformableSurface(hand.vertices, hand.faces, grounding=1e-10)
    pose = cs.Pose.from_euler((0.72, 0.03, -1.345), (0.02, 0.05, -0.03))
    moved = read(sim, surface, pose.apply(hand.posed(CURLED)))
    body = surface.update(hand.posed(CURLED), pose)
    posed = sim.step(cs.Scene([body])).delta
    assert posed.max() > 10e-15
    assert np.abs(moved - posed).max() < 1e-6 * posed.max()


def test_at_rest_it_is_the_rigid_mesh(simulators: Make) -> None:
    """Differential: the hand as it was first, against fine panels of the rigid mesh."""
    hand = rig(hand_only=True)
    vertices = OVER.apply(hand.vertices)
    rigid = cs.Scene([cs.Body(cs.TriMesh(vertices, hand.faces))])
    wanted = simulators("six_patch_bare", preset="fine").step(rigid).delta
    surface = cs.DeformableSurface(vertices, hand.faces)
    found = read(simulators("six_patch_bare"), surface, vertices)
    assert np.abs(found - wanted).max() < 0.04 * wanted.max()


@pytest.mark.parametrize(
    ("name", "bound"), [("hand flat", 0.03), ("hand pointing", 0.03), ("foot", 0.03)]
)
def test_poses_against_boundary_elements(simulators: Make, name: str, bound: float) -> None:
    """Reference: the electrodes' own entries above 3 % of the largest, relative."""
    with imported("deforming") as modules:
        deforming = modules["deforming"]
        case = deforming.CASES[name]
        body = rig(case.mesh == "hand")
        surface = deforming.surface_of(case, body)
        found = read(simulators(case.design), surface, deforming.placed(case, body))
        truth = 1e-15 * np.array(json.loads(DATA.read_text())[name]["delta_fF"])
        assert deforming.error_of(np.diag(found), np.diag(truth)) < bound


def test_readings_do_not_jump(simulators: Make) -> None:
    """Invariant: third differences of 40 steps of a finger that bends in front of an electrode."""
    sim, hand = simulators("six_patch_bare"), rig(hand_only=True)
    surface = cs.DeformableSurface(hand.vertices, hand.faces)
    rows = []
    for angle in np.linspace(0.0, 8.0, 40):
        turns = {"right_index_0": (0.0, -angle, 0.0), "wrist": (0.0, 0.2 * angle, 0.0)}
        rows.append(np.diag(read(sim, surface, OVER.apply(hand.posed(turns)))))
    change = np.ptp(rows, axis=0).max()
    assert np.abs(np.diff(rows, 3, axis=0)).max() < 0.01 * change


def test_scans_with_faults_read(simulators: Make) -> None:
    """A scan with a hole, a face twice, a loose vertex and a face of no area reads as without."""
    sim, hand = simulators("six_patch_bare"), rig(hand_only=True)
    vertices = OVER.apply(hand.vertices)
    whole = read(sim, cs.DeformableSurface(vertices, hand.faces), vertices)
    high = np.flatnonzero(vertices[hand.faces][:, :, 2].min(axis=1) > 0.07)[:6]
    faces = np.concatenate([np.delete(hand.faces, high, axis=0), hand.faces[:1], [[5, 5, 9]]])
    more = np.concatenate([vertices, [[0.0, 0.0, 0.3]]])
    found = read(sim, cs.DeformableSurface(more, faces), more)
    assert np.abs(found - whole).max() < 0.02 * whole.max()
