"""Copies: what goes to another process and comes back, and what stays as it was made."""

from __future__ import annotations

import copy
import inspect
import multiprocessing
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import trimesh
from tiny_field import SETTINGS, tiny_design

import capsense as cs
from capsense import errors
from capsense.mesh import kuhn_tets
from capsense.solver.surface_solver import SurfaceSolver, View

DUPLICATES = [copy.copy, copy.deepcopy, lambda thing: pickle.loads(pickle.dumps(thing))]
ERRORS = [
    e for _, e in inspect.getmembers(errors, inspect.isclass) if e.__module__ == errors.__name__
]


def made(kind: type[Exception]) -> Exception:
    """An error of a kind, with everything that it can hold."""
    if issubclass(kind, errors.PartialError):
        return kind("no", {"a": np.eye(2)}, {"b": errors.SolveError("none")})
    return kind("no", "busy") if kind is errors.ProtocolError else kind("no")


def fail(name: str) -> None:
    raise made(getattr(errors, name))


def read_some(_: int) -> cs.Reading:
    """A batch of which one scene fails, in another process."""
    sim = cs.Simulator(tiny_design(), settings=SETTINGS)
    pair = [cs.Body(cs.Sphere(0.01), cs.Pose((0, 0, 0.03)), "glass") for _ in range(2)]
    odd = cs.Scene(pair)
    look = SurfaceSolver.look

    def some(self: SurfaceSolver, scene: cs.Scene) -> View:
        if scene is odd:
            raise errors.SolveError("none")
        return look(self, scene)

    SurfaceSolver.look = some  # type: ignore[method-assign]
    try:
        return sim.step_batch([cs.Scene(pair[:1]), odd])[0]
    finally:
        SurfaceSolver.look = look  # type: ignore[method-assign]


@pytest.mark.parametrize("duplicate", DUPLICATES)
@pytest.mark.parametrize("kind", ERRORS)
def test_errors(kind: type[Exception], duplicate: Callable[[Any], Any]) -> None:
    """Type, message and what they hold."""
    error = made(kind)
    again = duplicate(error)
    assert type(again) is kind
    assert str(again) == str(error) == "no"
    assert repr(vars(again)) == repr(vars(error))


def test_errors_come_out_of_a_pool() -> None:
    """One that could not be read back would hang the parent for ever."""
    with multiprocessing.get_context("fork").Pool(1) as pool:
        for kind in ERRORS:
            with pytest.raises(kind, match="no"):
                pool.apply_async(fail, (kind.__name__,)).get(120)


def test_a_batch_that_fails_in_a_pool() -> None:
    """The readings of the others come with the error."""
    with multiprocessing.get_context("fork").Pool(1) as pool:
        found = pool.apply_async(read_some, (0,))
        with pytest.raises(errors.BatchError, match="1 of 2 scenes failed; 1: none") as caught:
            found.get(240)
    assert caught.value.readings[0].delta[0, 0] > 0


def results() -> dict[str, Any]:
    """What users hold in their hands, after use."""
    sim = cs.Simulator(tiny_design(), settings=SETTINGS)
    ball = trimesh.creation.icosphere(2, 0.01)
    mesh = cs.Body(cs.TriMesh(ball.vertices, ball.faces), cs.Pose((0, 0, 0.03)), "glass")
    scene = cs.Scene([mesh, cs.Body(cs.Sphere(0.01), cs.Pose((0.03, 0, 0.03)))])
    reading = sim.step(scene, jacobian=True)
    chip = cs.Readout.preset("fdc1004", sim.electrode_names)
    camera = cs.OrthographicCamera(0.1)
    frame = cs.DepthFrame(np.full((8, 8), 0.02), 10.0, camera)
    sim.step(frame)
    cloth = cs.DeformableSurface(ball.vertices, ball.faces)
    grid = kuhn_tets(*[np.linspace(0, 1, 3)] * 3)
    return {
        "simulator": sim, "design": sim.design, "scene": scene, "reading": reading,
        "counts": chip.sample(0.1, reading), "frame": frame, "layers": frame.scene()[0].shape,
        "cloth": cloth, "tetrahedra": grid,
    }  # fmt: skip


@pytest.mark.parametrize("duplicate", DUPLICATES[1:])
def test_results(duplicate: Callable[[Any], Any]) -> None:
    """Each can be copied, and a copied sensor reads a copied scene as before, to the last bit."""
    kept = results()
    again = {name: duplicate(thing) for name, thing in kept.items()}
    for name in ("reading", "counts"):
        assert repr(again[name]) == repr(kept[name])
    reading = again["simulator"].step(again["scene"])
    np.testing.assert_array_equal(reading.delta, kept["reading"].delta)
    assert again["tetrahedra"].volumes.sum() == kept["tetrahedra"].volumes.sum()


@pytest.mark.parametrize("duplicate", DUPLICATES)
def test_what_cannot_change_stays_so(duplicate: Callable[[Any], Any]) -> None:
    """Arrays of copies are read-only too; else a volume would be that of other vertices."""
    kept = results()
    mesh, layers = duplicate(kept["scene"][0].shape), duplicate(kept["layers"])
    pose = duplicate(kept["scene"][0].pose)
    cloth = duplicate(kept["cloth"].body().shape)
    for array in (
        mesh.vertices, mesh.faces, mesh.bounds(), mesh.params, layers.front, layers.back,
        pose.rotation, cloth.vertices, cloth.faces, cloth.rest.faces,
        duplicate(kept["tetrahedra"]).points,
    ):  # fmt: skip
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    assert mesh.volume == kept["scene"][0].shape.volume
    assert mesh.closed


def test_a_shape_travels_light() -> None:
    """The charge functions of a body that was in a scene are not sent along with it."""
    kept = results()
    assert len(pickle.dumps(kept["scene"])) < 20_000


def test_a_simulator_takes_no_shapes_along() -> None:
    """Its pickle is hardly larger after a step: charge functions are worked out anew."""
    sim = cs.Simulator(tiny_design(), settings=SETTINGS)
    scene = cs.Scene([cs.Body(cs.Box((0.01, 0.02, 0.01)), cs.Pose((0, 0, 0.03)), "glass")])
    before = len(pickle.dumps(sim))
    expected = sim.step(scene).delta
    after = pickle.dumps(sim)
    assert len(after) < before + 200_000
    np.testing.assert_array_equal(pickle.loads(after).step(scene).delta, expected)
