"""The orthographic rasteriser against trying every triangle; refusals."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from approximate import approx
from layered_views import unite

from capsense.errors import SceneError
from capsense.scene import (
    Box,
    Capsule,
    Layers,
    Pose,
    render_depth,
)
from capsense.scene.image_kernels import LEAST_COSINE


def render_slowly(vertices, faces, size, resolution, thickness=0.0):
    """Intervals that the rays through all pixels meet, ``[row][column]``, by trying every triangle.

    Rays that meet an edge within rounding may count it twice or not at all.
    """
    rows, columns = resolution
    xs = ((np.arange(columns) + 0.5) / columns - 0.5) * size[0]
    ys = ((np.arange(rows) + 0.5) / rows - 0.5) * size[1]
    a, e1, e2 = vertices[faces[:, 0]], *(vertices[faces[:, k]] - vertices[faces[:, 0]]
                                         for k in (1, 2))  # fmt: skip
    normal = np.cross(e1, e2)
    facing = normal[:, 2] != 0
    a, e1, e2, normal = a[facing], e1[facing], e2[facing], normal[facing]
    cosine = np.abs(normal[:, 2]) / np.linalg.norm(normal, axis=1)
    out = []
    for y in ys:
        out.append([])
        for x in xs:
            s = np.array([x, y]) - a[:, :2]
            u = (s[:, 0] * e2[:, 1] - s[:, 1] * e2[:, 0]) / normal[:, 2]
            v = (e1[:, 0] * s[:, 1] - e1[:, 1] * s[:, 0]) / normal[:, 2]
            met = (u >= 0) & (v >= 0) & (u + v <= 1)
            z = (a[:, 2] + u * e1[:, 2] + v * e2[:, 2])[met]
            if thickness > 0:
                half = thickness / 2 / np.maximum(cosine[met], LEAST_COSINE)
                out[-1].append(unite(list(zip(z - half, z + half, strict=True))))
            else:
                order = np.argsort(z)
                winding = np.cumsum(np.sign(normal[met, 2])[order])
                ends = z[order].tolist()
                out[-1].append(unite([(ends[k], ends[k + 1]) for k in range(len(ends) - 1)
                                      if winding[k] != 0]))  # fmt: skip
    return out


def intervals(raster, j, i):
    """Sorted disjoint intervals of a pixel; layers that touch are one."""
    ends = zip(raster.front[:, j, i], raster.back[:, j, i], strict=True)
    return unite([(a, b) for a, b in ends if a < b])


def random_closed(rng):
    """A few overlapping closed bodies, of few or of many faces, all wound alike."""
    parts = []
    for _ in range(rng.integers(1, 4)):
        kind = rng.integers(0, 3)
        part = (
            trimesh.creation.icosphere(subdivisions=int(rng.integers(0, 4))),
            trimesh.creation.box(),
            trimesh.creation.torus(1.0, 0.35, major_sections=17, minor_sections=9),
        )[kind]
        part.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)))
        part.apply_scale(rng.uniform(0.01, 0.05))
        part.apply_translation(rng.uniform(-0.04, 0.04, 3) + np.array([0, 0, 0.1]))
        parts.append(part)
    mesh = trimesh.util.concatenate(parts)
    flip = rng.random() < 0.3
    return mesh.vertices, mesh.faces[:, ::-1] if flip else mesh.faces


def test_closed_meshes_match_the_slow_twin():
    """Differential: every interval of every pixel, for overlapping bodies that leave the view."""
    hits = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        vertices, faces = random_closed(rng)
        size, resolution = (0.12, 0.1), (int(rng.integers(5, 25)), int(rng.integers(5, 25)))
        raster = render_depth(vertices, faces, size, resolution)
        slow = render_slowly(vertices, faces, size, resolution)
        for j, i in np.ndindex(*resolution):
            got = [s for s in intervals(raster, j, i) if s[1] - s[0] > 1e-6]
            expected = [s for s in slow[j][i] if s[1] - s[0] > 1e-6]
            np.testing.assert_allclose(got, expected, atol=1e-7)
            hits += len(got)
    assert hits > 500


def test_sheets_match_the_slow_twin():
    """Differential: crumpled sheets, thickened as they are inclined, up to five times."""
    hits = 0
    for seed in range(8):
        rng = np.random.default_rng([9, seed])
        vertices, faces = cloth(9, 0.1)
        vertices = vertices + rng.normal(scale=0.01, size=vertices.shape) + np.array([0, 0, 0.1])
        raster = render_depth(vertices, faces, (0.12, 0.12), (20, 17), thickness=0.002)
        slow = render_slowly(vertices, faces, (0.12, 0.12), (20, 17), 0.002)
        for j, i in np.ndindex(20, 17):
            np.testing.assert_allclose(intervals(raster, j, i), slow[j][i], atol=1e-7)
            hits += len(slow[j][i])
    assert hits > 1000


def cloth(n, width):
    """A flat square of n by n cells at z = 0."""
    c = np.linspace(-width / 2, width / 2, n + 1)
    x, y = np.meshgrid(c, c)
    corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    faces = np.concatenate([
        np.column_stack([corner, corner + 1, corner + n + 2]),
        np.column_stack([corner, corner + n + 2, corner + n + 1]),
    ])  # fmt: skip
    return np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()]), faces


def test_shared_edges_leave_no_gaps():
    """Invariant: with vertices and edges exactly on rays, each ray of a cloth meets it once."""
    vertices, faces = cloth(16, 0.16)
    for shift in (0.0, 0.005, 0.0025):
        raster = render_depth(vertices + np.array([shift, shift, 0.1]), faces, (0.2, 0.2), (20, 20),
                           thickness=0.001)  # fmt: skip
        met = np.isfinite(raster.front).sum(axis=0)
        assert met.max() == 1
        assert met.sum() == 16 * 16


def test_closed_meshes_on_rays_are_met_in_pairs():
    """Invariant: boxes whose edges lie on rays, in every direction, are whole solids."""
    box = Box((0.08, 0.06, 0.04)).to_trimesh()
    for _ in range(2):
        raster = render_depth(box.vertices + np.array([0, 0, 0.1]), box.faces, (0.1, 0.1), (10, 10))
        volume = np.nansum(raster.back - raster.front) * 0.01**2
        np.testing.assert_allclose(volume, 0.08 * 0.06 * 0.04, rtol=1e-6)
        box.apply_translation((0.005, 0.005, 0))


def test_mixed_winding_counts_every_second_stretch():
    """Analytic: a box with one side turned is the same box."""
    box = Box((0.08, 0.06, 0.04)).to_trimesh()
    faces = np.array(box.faces)
    upward = box.face_normals[:, 2] > 0.5
    faces[upward] = faces[upward][:, ::-1]
    raster = render_depth(box.vertices + np.array([0, 0, 0.1]), faces, (0.1, 0.1), (21, 21))
    hit = np.isfinite(raster.front[0])
    assert hit.any()
    np.testing.assert_allclose(raster.front[0][hit], 0.08)
    np.testing.assert_allclose(raster.back[0][hit], 0.12)


def test_many_layers():
    """Analytic: a stack of more plates than the rasteriser first makes room for."""
    plates = [Box((0.05, 0.05, 0.004)).to_trimesh() for _ in range(9)]
    for k, plate in enumerate(plates):
        plate.apply_translation((0, 0, 0.1 + 0.01 * k))
    stack = trimesh.util.concatenate(plates)
    raster = render_depth(stack.vertices, stack.faces, (0.1, 0.1), (9, 9))
    np.testing.assert_allclose(raster.front[:, 4, 4], 0.098 + 0.01 * np.arange(9), atol=1e-8)
    np.testing.assert_allclose(raster.depth[4, 4], 0.098, atol=1e-8)
    assert raster.depth[0, 0] == np.inf
    assert len(raster.layers().front) == 9


def test_bad_views_are_refused():
    vertices, faces = cloth(2, 0.1)
    for arguments, options, message in [
        ((vertices, faces), {"thickness": 0}, "thickness is 0; give a positive length"),
        ((vertices, faces), {"thickness": np.nan}, "thickness is nan"),
        ((vertices, faces + 5), {}, "faces name vertices 5 to 13"),
        ((vertices, faces.astype(float)), {}, "faces have type float64"),
        ((vertices[:, :2], faces), {}, r"vertices have shape \(9, 2\)"),
        ((np.full_like(vertices, np.nan), faces), {}, "vertex 0 is"),
        ((vertices, faces[:0]), {}, "faces have shape"),
    ]:
        with pytest.raises(SceneError, match=message):
            render_depth(*arguments, (0.1, 0.1), (4, 4), **options)
    for size, resolution, message in [
        ((0.1, -1), (4, 4), "size is"),
        ((0.0, 0.1), (4, 4), "size is"),
        ((0.1, 0.1), (0, 4), "resolution is"),
        ((0.1, 0.1), (4.5, 4), "resolution is"),
        ((0.1, 0.1), (4000, 4000), "resolution is"),
    ]:
        with pytest.raises(SceneError, match=message):
            render_depth(vertices, faces, size, resolution)
    empty = render_depth(vertices + np.array([5, 0, 0]), faces, (0.1, 0.1), (4, 4), thickness=1e-3)
    assert not np.isfinite(empty.depth).any()
    with pytest.raises(SceneError, match="no pixel holds an interval"):
        empty.layers()


def test_volumes_converge():
    """Analytic: a capsule, through its layers; measured 0.3 % at 128 pixels."""
    shape, pose = Capsule(0.03, 0.06), Pose.from_euler((0, 0, 0.2), (0.4, 1.2, 0.3))
    mesh = shape.to_trimesh()
    errors = []
    for n in (32, 128):
        raster = render_depth(pose.apply(mesh.vertices), mesh.faces, (0.16, 0.16), (n, n))
        layers = raster.layers()
        assert isinstance(layers, Layers)
        assert layers.volume == approx(
            np.nansum(raster.back - raster.front) * (0.16 / n) ** 2, rel=1e-5
        )
        errors.append(abs(layers.volume / mesh.volume - 1))
    assert errors[0] < 0.02
    assert errors[1] < 0.004
