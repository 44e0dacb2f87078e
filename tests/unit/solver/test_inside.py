"""What the inside of a surface that deforms sets against charge, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from rigged import over_square

import capsense as cs
from capsense.scene import RestSurface
from capsense.solver.tree.dynamic_surface import MeshBody, layout_of
from capsense.solver.tree.inside import table_of

LENGTH, WIDTH, THICKNESS = 0.2, 0.1, 1e-3


def strip(n: int, bend: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A strip along x of n × n/2 squares, rolled up by an angle [rad]."""
    u, v = np.meshgrid(np.linspace(0, 1, n + 1), np.linspace(0, 1, n // 2 + 1), indexing="ij")
    x, z = LENGTH * u, 0 * u
    if bend:
        radius = LENGTH / bend
        x, z = radius * np.sin(bend * u), radius * (1 - np.cos(bend * u))
    a = np.arange(u.size).reshape(u.shape)
    low = np.stack([a[:-1, :-1], a[1:, :-1], a[1:, 1:]], axis=-1).reshape(-1, 3)
    high = np.stack([a[:-1, :-1], a[1:, 1:], a[:-1, 1:]], axis=-1).reshape(-1, 3)
    return np.stack([x, WIDTH * v, z], axis=-1).reshape(-1, 3), np.concatenate([low, high])


def test_charge_from_one_half_of_a_strip_to_the_other() -> None:
    """Closed form: an even current J rises to 1/W in the middle; 4π/t ∫ J² dA = 4π L / (3 W t)."""
    for n in (2, 8, 20):  # coarse meshes are refined
        table = table_of(RestSurface(*strip(n), THICKNESS))
        assert table is not None
        wanted = 4 * np.pi * LENGTH / (3 * WIDTH * THICKNESS)
        np.testing.assert_allclose(table[1, 1], wanted, rtol=0.02)
        assert np.abs(table[0]).max() == 0.0
        assert np.linalg.eigvalsh(table.astype(float))[1] > -1e-3 * table[1, 1]


def test_bending_changes_nothing() -> None:
    """Invariant: what cloth sets against charge is the same flat and rolled up."""
    rows = [RestSurface(*strip(16, bend), THICKNESS) for bend in (0.0, 0.6)]
    flat, bent = (table_of(r) for r in rows)
    assert flat is not None
    assert bent is not None
    if (layout_of(rows[0]).tree.panel == layout_of(rows[1]).tree.panel).all():
        np.testing.assert_allclose(bent, flat, atol=0.01 * float(flat.max()))
    np.testing.assert_allclose(bent[1, 1], flat[1, 1], rtol=0.02)


def test_charge_does_not_cross_from_sheet_to_sheet() -> None:
    """Two sheets of one surface: moving charge from one to the other costs very much."""
    v, f = strip(8)
    two = np.concatenate([v, v + np.array([0.3, 0.0, 0.0])])
    table = table_of(RestSurface(two, np.concatenate([f, f + len(v)]), THICKNESS))
    assert table is not None
    assert table[1, 1] > 100 * np.median(np.diag(table)[1:])


def test_loose_triangles_have_none() -> None:
    """Pieces of a cloud of points do not touch each other."""
    v, f = strip(8)
    loose = v[f].reshape(-1, 3) * np.repeat(np.linspace(1.0, 1.001, len(f)), 3)[:, None]
    faces = np.arange(3 * len(f)).reshape(-1, 3)
    assert table_of(RestSurface(loose, faces, THICKNESS)) is None


def test_welded_and_separate_vertices_agree() -> None:
    """Soft bodies of PyBullet have three vertices for every triangle."""
    v, f = strip(8)
    faces = np.arange(3 * len(f)).reshape(-1, 3)
    one, other = (
        table_of(RestSurface(*m, THICKNESS)) for m in ((v, f), (v[f].reshape(-1, 3), faces))
    )
    assert one is not None
    assert other is not None
    np.testing.assert_allclose(other, one, rtol=1e-4, atol=1e-4 * float(one.max()))


def test_of_a_solid_it_goes_with_its_form() -> None:
    """A ball in an even field has Z = 3 F: 2 F, and as much again as half of that in the table."""
    ball = cs.Sphere(0.03).to_trimesh()
    rest = RestSurface(ball.vertices, ball.faces)
    table = table_of(rest)
    assert table is not None
    assert table[0].max() == 0.0
    assert table[1, 1] > 0.0


@pytest.mark.parametrize("thickness", [1e-4, 1e-3, 1e-2, 0.1])
def test_charge_on_both_faces(thickness: float) -> None:
    """Quadrature: half the charge on either of two squares takes less than all of it on one."""
    side = 0.01
    surface = cs.DeformableSurface(
        np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0.0]]) * side / np.sqrt(2.0),
        np.array([[0, 1, 2], [0, 2, 3]]),
        thickness=thickness,
    )  # its first function is of two triangles, each as large as the square
    body = MeshBody(surface.body().shape, False)
    record = body.record.copy()
    record["rotation"] = np.eye(3)
    found = body.enter(record, over_square(), 1.0)
    x, w = np.polynomial.legendre.leggauss(200)
    x, w = (0.5 * (x + 1)) ** 3, 1.5 * w * (0.5 * (x + 1)) ** 2
    u, v = np.meshgrid(x, x)

    def mean(off: float) -> float:
        """Mean of 1/r between two squares of side 1."""
        return float((4 * np.outer(w, w) * (1 - u) * (1 - v) / np.sqrt(u**2 + v**2 + off**2)).sum())

    wanted = 2 * (mean(1e-9) - mean(thickness / side)) / (2 * side)
    np.testing.assert_allclose(found.faces[:2], [0.0, wanted], rtol=0.05)
