"""The gap law in front of surfaces that change: deforming meshes, cloth and depth images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from approximate import approx
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import capsense as cs
from capsense.scene import RestSurface, SurfaceMesh
from capsense.scene.geometry_kernels import Boxes
from capsense.scene.layers import render_depth
from capsense.solver.tree.dynamic_surface import MeshBody
from capsense.solver.tree.near_triangles import Face, near_triangles

pytestmark = pytest.mark.e2e
Array = NDArray[np.float64]
DESIGNS = Path(__file__).parents[2] / "data" / "near_designs"
_BALL = trimesh.creation.icosphere(4, 0.012)
_BLOCK = trimesh.creation.box((0.03, 0.02, 0.01)).subdivide_to_size(0.002)
SHAPES = {"ball": (cs.Sphere(0.012), _BALL), "block": (cs.Box((0.03, 0.02, 0.01)), _BLOCK)}
PITCH, PIXELS, BELOW = 0.8e-3, 60, 0.02
"""Pixels of the camera, their number, and how far it stands below the electrodes [m]."""


@pytest.fixture(scope="module", params=["pad10", "pad10c01"])
def sim(request: pytest.FixtureRequest, field_cache: Path) -> cs.Simulator:
    return cs.Simulator(DESIGNS / f"{request.param}.toml", cache_dir=field_cache)


@pytest.fixture(scope="module")
def pad(field_cache: Path) -> cs.Simulator:
    return cs.Simulator(DESIGNS / "pad10.toml", cache_dir=field_cache)


def lengths(sim: cs.Simulator) -> tuple[float, float]:
    """Height of the face and validity distance [m]."""
    gap, unit = sim._solver.green.gap, sim._solver.length
    return unit * gap.top, unit * gap.validity


def place(sim: cs.Simulator, mesh: trimesh.Trimesh, gap: float) -> Array:
    """Where a mesh stands over the first electrode, its lowest vertex at a height [m]."""
    middle = sim.design.electrodes[0].surface.bounds.mean(axis=0)
    top, _ = lengths(sim)
    return np.array([middle[0], middle[1], top + gap - mesh.vertices[:, 2].min()])


def surface(vertices: Array, faces: Array, **options: str) -> cs.Scene:
    options = {"material": "steel", **options}
    return cs.Scene([cs.DeformableSurface(vertices, faces, **options).body()])


def frame(vertices: Array, faces: Array, middle: Array) -> cs.DepthFrame:
    """What a camera behind the electrodes sees of a mesh."""
    at, size = np.array([middle[0], middle[1], -BELOW]), PITCH * PIXELS
    seen = render_depth(vertices - at, faces, (size, size), (PIXELS, PIXELS))
    camera = cs.OrthographicCamera(size, size, cs.Pose(tuple(at)))
    return cs.DepthFrame(seen.front[0], "steel", camera, back=seen.back[0])


def sheet(bend: float) -> tuple[Array, Array]:
    """An open sheet of 60 mm whose rim is higher than its middle by ``bend`` [m]."""
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(-0.03, 0.03, 31)] * 2))
    number = np.arange(31 * 31).reshape(31, 31)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    faces = np.stack([np.stack(t, axis=-1) for t in ((a, b, c), (a, c, d))]).reshape(-1, 3)
    return np.column_stack([x, y, bend * (x**2 + y**2) / 0.03**2]), faces


@pytest.mark.parametrize("gap", [0.1e-3, 0.3e-3, 1e-3, 2e-3, 5e-3])
@pytest.mark.parametrize("name", SHAPES)
def test_representations_agree(sim: cs.Simulator, name: str, gap: float) -> None:
    """Invariant: a rigid mesh, a surface and a depth image of a body read what it reads.

    Without a local change of their own, the last two read 70 to 94 % less at 0.1 mm.
    """
    shape, mesh = SHAPES[name]
    at = place(sim, mesh, gap)
    vertices, faces = mesh.vertices + at, mesh.faces
    exact = sim.step(cs.Scene([cs.Body(shape, cs.Pose(tuple(at)))])).delta[0, 0]
    rigid = sim.step(cs.Scene([cs.Body(cs.TriMesh(vertices, faces))])).delta[0, 0]
    assert rigid == approx(exact, rel=0.05)  # a mesh has its corners on the ball
    for scene in (surface(vertices, faces), frame(vertices, faces, at)):
        assert sim.step(scene).delta[0, 0] == approx(rigid, rel=0.03)


@pytest.mark.parametrize("grounding", ["floating", "grounded"])
def test_floating_surfaces_are_nodes(pad: cs.Simulator, grounding: str) -> None:
    """Invariant: as a rigid mesh of the same form."""
    vertices = _BLOCK.vertices + place(pad, _BLOCK, 0.2e-3)
    soft = pad.step(surface(vertices, _BLOCK.faces, grounding=grounding)).delta[0, 0]
    body = cs.Body(cs.TriMesh(vertices, _BLOCK.faces), grounding=grounding)
    assert soft == approx(pad.step(cs.Scene([body])).delta[0, 0], rel=0.02)


def test_dielectric_surfaces_follow_the_series_formula(pad: cs.Simulator) -> None:
    """Invariant: a soft ball of glass reads about what a hard one does; 31 % less without it."""
    at = place(pad, _BALL, 0.1e-3)
    soft = pad.step(surface(_BALL.vertices + at, _BALL.faces, material="glass")).delta[0, 0]
    hard = pad.step(cs.Scene([cs.Body(cs.Sphere(0.012), cs.Pose(tuple(at)), "glass")]))
    assert soft == approx(hard.delta[0, 0], rel=0.05)


def test_pressing_a_surface_onto_the_design(pad: cs.Simulator) -> None:
    """Invariant: readings rise as a sheet is laid down, and stay bounded in overlap."""
    vertices, faces = sheet(0.02)
    at = place(pad, trimesh.Trimesh(vertices, faces, process=False), 0.0)
    heights = np.array([100, 10, 5, 3, 2, 1, 0.5, 0.1, 0.03, 0, -0.03, -0.1, -0.5, -1, -2]) * 1e-3
    found = []
    for height in heights:
        found.append(pad.step(surface(vertices + at + [0, 0, height], faces)).delta[0, 0])
    assert (np.diff(found) > 0.0).all(), found
    flat = sheet(0.0)[0]
    most = pad.step(surface(flat + at, faces)).delta[0, 0]
    assert 0.9 * most < found[-1] < 1.02 * most
    for height, bound in ((-0.5e-3, 1e-3), (-1e-3, 0.02)):  # h0 is 0.37 mm
        pressed = pad.step(surface(flat + at + [0, 0, height], faces)).delta[0, 0]
        assert pressed == approx(most, rel=bound)


def test_one_vertex_comes_near(pad: cs.Simulator) -> None:
    """Invariant: no step as one vertex of a sheet far away comes nearer than 2 h0, or h0."""
    vertices, faces = sheet(0.0)
    top, h0 = lengths(pad)
    vertices = vertices + place(pad, trimesh.Trimesh(vertices, faces, process=False), 4.0 * h0)
    middle = len(vertices) // 2
    drawn = cs.DeformableSurface(vertices, faces, material="steel")

    def reading(height: float) -> float:
        moved = vertices.copy()
        moved[middle, 2] = top + height
        drawn.vertices = moved
        return float(pad.step(cs.Scene([drawn.body()])).delta[0, 0])

    for height in (2.0 * h0, h0):
        near, at, far = (reading(height + d) for d in (-1e-7, 0.0, 1e-7))
        apart = reading(height - 1e-5) - reading(height + 1e-5)
        assert abs(near - at) + abs(far - at) < 0.05 * apart


def test_nothing_changes_beyond_twice_h0(pad: cs.Simulator) -> None:
    """Invariant: no outline is made there, and readings have the bits of lifted bodies."""
    _, h0 = lengths(pad)
    for gap, near in ((2.01 * h0, False), (1.99 * h0, True)):
        scene = surface(_BALL.vertices + place(pad, _BALL, gap), _BALL.faces)
        bodies = pad._solver.pack(pad._solver.look(scene))
        assert any(isinstance(held, Boxes) for held in bodies.near) == near
        assert bool(bodies.records["outline"][0]) == near


@pytest.mark.parametrize(("pitch", "bound"), [(1.6e-3, 0.04), (3.2e-3, 0.12)])
def test_coarse_images_of_a_ball(pad: cs.Simulator, pitch: float, bound: float) -> None:
    """Invariant: pixels as wide as five and ten gaps follow a ball."""
    at = place(pad, _BALL, 0.3e-3)
    exact = pad.step(cs.Scene([cs.Body(cs.Sphere(0.012), cs.Pose(tuple(at)))])).delta[0, 0]
    count, found = round(0.05 / pitch), []
    for shift in ((0, 0), (0.3, 0.1), (0.5, 0.5)):
        camera = np.array([at[0] + pitch * shift[0], at[1] + pitch * shift[1], -BELOW])
        size = pitch * count
        seen = render_depth(_BALL.vertices + at - camera, _BALL.faces, (size, size), (count, count))
        view = cs.OrthographicCamera(size, size, cs.Pose(tuple(camera)))
        found.append(pad.step(cs.DepthFrame(seen.front[0], "steel", view)).delta[0, 0])
    np.testing.assert_allclose(found, exact, rtol=bound)


def test_what_hangs_beside_or_behind_stays_there() -> None:
    """Invariant: triangles over the face are put on it, those beside and far behind are not."""
    vertices, faces = sheet(0.0)
    rest = RestSurface(vertices, faces)
    corners = np.array([[-0.01, -0.01, 0.0], [0.01, 0.01, 0.0]])
    face = Face(corners, corners, None, 0.0, 0.0)

    def heights(z: Array) -> tuple[Array, Array]:
        moved = np.column_stack([vertices[:, :2], z])
        body = MeshBody(SurfaceMesh(moved, rest), True)
        record = body.record.copy()
        record["rotation"] = np.eye(3)
        found = near_triangles(body, record, face, 2e-3, 8e-3)
        assert found is not None
        over = np.abs(found.triangles[..., :2]).max(axis=(1, 2)) < 0.01
        return found.triangles[over, :, 2], found.triangles[~over, :, 2]

    over, beside = heights(np.where(np.abs(vertices[:, 0]) < 0.012, -1e-3, -5e-3))
    assert (over == 0.0).all()
    assert beside.min() == approx(-5e-3)
    over, _ = heights(np.where(vertices[:, 0] < 0.0, 1e-3, -0.02))
    assert over.min() == approx(-0.02)


def test_slopes_of_meshes_are_smooth(pad: cs.Simulator) -> None:
    """Invariant: the slope by an angle follows a parabola over a tenth of a degree.

    Where faces and edges of a mesh counted differently it had steps of 2 to 20 %.
    """
    form, rng = trimesh.creation.icosphere(2, 0.012), np.random.default_rng(3)
    mesh = cs.TriMesh(form.vertices * [1.0, 1.5, 0.7], form.faces)
    for _ in range(4):
        turn = Rotation.random(random_state=int(rng.integers(1 << 30)))
        turned = turn.apply(form.vertices * [1.0, 1.5, 0.7])
        at = place(pad, trimesh.Trimesh(turned, mesh.faces), 0.5e-3)
        angles = np.linspace(-2e-3, 2e-3, 17)
        found = []
        for angle in angles:
            pose = cs.Pose(tuple(at), tuple((Rotation.from_rotvec([angle, 0, 0]) * turn).as_quat()))
            found.append(pad.step(cs.Scene([cs.Body(mesh, pose)])).delta[0, 0])
        slope = np.diff(found) / np.diff(angles)
        middle = 0.5 * (angles[1:] + angles[:-1])
        rest = slope - np.polyval(np.polyfit(middle, slope, 2), middle)
        assert np.abs(rest).max() < 0.01 * np.mean(found)
