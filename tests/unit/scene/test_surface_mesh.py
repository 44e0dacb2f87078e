"""Deforming surfaces: what is kept, what follows the vertices, what has an inside."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from approximate import approx

from capsense.errors import SceneError
from capsense.scene import (
    Body,
    Box,
    DeformableSurface,
    Pose,
    RestSurface,
    Scene,
    ShapeKind,
    SurfaceMesh,
    TriMesh,
)

BALL = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
CORNERS = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]) * 0.1
SHEET = CORNERS, np.array([[0, 1, 2], [0, 2, 3]])


def test_faces_are_shared_and_vertices_follow():
    surface = DeformableSurface(*SHEET, material="steel", grounding=1e-10, name="foil")
    first = surface.body()
    surface.vertices = SHEET[0] + [0, 0, 0.03]
    second = surface.body()
    assert second.shape.faces is first.shape.faces is surface.faces
    assert second.shape.rest is first.shape.rest
    assert first.shape is not second.shape
    np.testing.assert_array_equal(first.shape.vertices, SHEET[0])
    np.testing.assert_array_equal(second.shape.rest.vertices, SHEET[0])
    np.testing.assert_array_equal(second.shape.vertices, surface.vertices)
    np.testing.assert_array_equal(second.shape.vertices[:, 2], 0.03)
    assert second.pose == Pose()
    assert (second.name, second.grounding, second.material.name) == ("foil", 1e-10, "steel")
    with pytest.raises(ValueError, match="read-only"):
        surface.vertices[0] = 1


def test_what_the_caller_changes_later_does_not_show():
    vertices, faces = SHEET[0].copy(), SHEET[1].copy()
    surface = DeformableSurface(vertices, faces)
    vertices[:], faces[:] = 7.0, 0
    np.testing.assert_array_equal(surface.vertices, SHEET[0])
    np.testing.assert_array_equal(surface.faces, SHEET[1])


def test_a_closed_surface_has_the_inside_of_its_mesh():
    """Differential: volume and distances of a squeezed ball, wound either way."""
    squeezed = np.array(BALL.vertices) * (1, 1.2, 0.5)
    p = np.random.default_rng(0).uniform(-0.08, 0.08, (3000, 3))
    same = TriMesh(squeezed, BALL.faces)
    for faces in (BALL.faces, BALL.faces[:, ::-1]):
        shape = SurfaceMesh(squeezed, RestSurface(BALL.vertices, faces))
        assert shape.closed
        assert shape.volume == approx(same.volume)
        np.testing.assert_allclose(shape.signed_distance(p), same.signed_distance(p), atol=1e-15)
        assert shape.to_trimesh().is_watertight


def test_open_surfaces_have_no_inside():
    turned = np.array(BALL.faces)
    turned[:5] = turned[:5, ::-1]
    for rest in (RestSurface(*SHEET), RestSurface(BALL.vertices, turned)):
        shape = SurfaceMesh(rest.vertices, rest)
        assert not shape.closed
        for ask in (lambda s: s.volume, lambda s: s.signed_distance([(0, 0, 0)])):
            with pytest.raises(SceneError, match=r"no inside, and no .*wind its faces alike"):
                ask(shape)
        assert len(shape.to_trimesh().faces) == len(rest.faces)


def test_bounds_are_those_of_vertices_that_count():
    """Analytic: a vertex that no face names is left out, in a scene too."""
    vertices = np.concatenate([SHEET[0], [[9, 9, 9]]])
    shape = SurfaceMesh(vertices + 0.1, RestSurface(vertices, SHEET[1]))
    np.testing.assert_allclose(shape.bounds(), [[0.1, 0.1, 0.1], [0.2, 0.2, 0.1]])
    packed = Scene([Body(shape, Pose((0, 0, 1)))]).pack()
    assert packed.kinds[0] == ShapeKind.SURFACE
    np.testing.assert_allclose(packed.bounds[0], [[0.1, 0.1, 1.1], [0.2, 0.2, 1.1]])
    np.testing.assert_allclose(shape.params, [0.05, 0.05, 0])


def test_a_sheet_is_a_millimetre_thick_unless_told():
    assert RestSurface(*SHEET).thickness == 1e-3
    assert RestSurface(*SHEET, thickness=2e-4).thickness == 2e-4
    assert DeformableSurface(*SHEET).body().shape.rest.thickness == 1e-3


@pytest.mark.parametrize("thickness", [0.0, -1e-3, np.nan, np.inf])
def test_a_thickness_is_a_length(thickness):
    with pytest.raises(SceneError, match="thickness is"):
        RestSurface(*SHEET, thickness=thickness)


def test_bad_surfaces_are_refused():
    vertices, faces = SHEET
    box = Box((0.1, 0.1, 0.1)).to_trimesh()
    for arguments, options, message in [
        ((vertices, faces + 5), {}, "faces name vertices 5 to 8"),
        ((vertices, faces.astype(float)), {}, "faces have type float64"),
        ((vertices[:, :2], faces), {}, r"vertices have shape \(4, 2\)"),
        (("abc", faces), {}, "vertices are not numbers"),
        ((np.full_like(vertices, np.nan), faces), {}, "vertex 0 is"),
        ((vertices, faces[:0]), {}, "faces have shape"),
        ((box.vertices, box.faces), {"grounding": "grouned"}, "grounding is 'grouned'"),
        ((box.vertices, box.faces), {"material": "stel"}, "unknown material 'stel'"),
    ]:
        with pytest.raises(SceneError, match=message):
            DeformableSurface(*arguments, **options)
    sheet = DeformableSurface(vertices, faces)
    with pytest.raises(SceneError, match=r"vertices have shape \(3, 3\), but .* with \(4, 3\)"):
        sheet.vertices = vertices[:3]
    with pytest.raises(SceneError, match="vertex 0"):
        sheet.vertices = vertices * np.nan
