"""Electrodes from STL files: what is read, and what is refused."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from approximate import approx

from capsense.design import Design, load_design, parse_design
from capsense.design.stl import read_stl
from capsense.errors import DesignError

trimesh = pytest.importorskip("trimesh")

PUBLISHED = Path(__file__).parents[2] / "data" / "original_meshes"
DOMAIN = {"size": [0.5, 0.5, 0.5], "backplane": 0.1}


def save(folder: Path, vertices: Any, faces: Any, name: str = "part.stl", **kwargs: Any) -> str:
    """Write a mesh with trimesh and return its file name."""
    mesh = trimesh.Trimesh(np.array(vertices, dtype=float), np.array(faces), process=False)
    mesh.export(folder / name, **kwargs)
    return name


def stl(folder: Path, file: str = "part.stl", unit: str = "mm", **keys: Any) -> Design:
    """A design of one STL electrode "E"."""
    item = {"name": "E", "shape": "stl", "file": file, "unit": unit, **keys}
    data = {"name": "t", "domain": DOMAIN, "electrode": [item]}
    return parse_design(data, source="t.toml", folder=folder)


def grid(nx: int, ny: int) -> tuple[np.ndarray, np.ndarray]:
    """A regular triangulation of the unit square: points (u, v), and faces."""
    u, v = np.meshgrid(np.linspace(0, 1, nx + 1), np.linspace(0, 1, ny + 1), indexing="ij")
    index = np.arange((nx + 1) * (ny + 1)).reshape(nx + 1, ny + 1)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    return np.column_stack([u.ravel(), v.ravel()]), faces


def flat(size: tuple[float, float] = (30.0, 20.0), n: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """A flat rectangle [mm] about the origin of 2 n² triangles."""
    uv, faces = grid(n, n)
    return np.column_stack([(uv - 0.5) * size, np.zeros(len(uv))]), faces


def cylinder(n: int = 12, degrees: float = 90.0) -> tuple[np.ndarray, np.ndarray]:
    """A patch of a cylinder of radius 40 mm along y, 50 mm long, its crest at z = 0."""
    uv, faces = grid(n, 4)
    angle = np.radians(degrees) * (uv[:, 0] - 0.5)
    points = [40 * np.sin(angle), 50 * (uv[:, 1] - 0.5), 40 * np.cos(angle) - 40]
    return np.column_stack(points), faces


@pytest.mark.parametrize("kind", ["stl", "stl_ascii"])
def test_flat_sheet_is_the_same_as_a_rectangle(tmp_path: Path, kind: str) -> None:
    """Fifty triangles in a plane become one polygon, and the same content hash."""
    save(tmp_path, *flat(), file_type=kind)
    design = stl(tmp_path, center=[0.01, 0.02, 0.03])
    surface = design.electrodes[0].surface
    assert (len(surface.facets), len(surface.rims)) == (1, 4)
    item = {"name": "R", "shape": "rectangle", "size": [0.03, 0.02], "center": [0.01, 0.02, 0.03]}
    same = parse_design({"name": "t", "domain": DOMAIN, "electrode": [item]})
    assert surface.rims.mean(axis=(0, 1)) == approx([0.01, 0.02, 0.03])
    assert design.content_hash() == same.content_hash()


def test_tilted_flat_sheet_is_one_facet(tmp_path: Path) -> None:
    """Also when the file itself is tilted, single precision does not break the plane up."""
    points, faces = flat((300.0, 200.0), n=20)
    turn = trimesh.transformations.euler_matrix(0.3, 0.5, 0.7)[:3, :3]
    save(tmp_path, points @ turn.T, faces)
    surface = stl(tmp_path, z=0.15).electrodes[0].surface
    assert (len(surface.facets), len(surface.rims)) == (1, 4)
    assert surface.area == approx(0.06, rel=1e-6)


def test_sheet_with_hole(tmp_path: Path) -> None:
    """A hole stays a hole, and its edge is a rim."""
    points, faces = flat((30.0, 30.0), n=6)
    middle = np.abs(points[faces].mean(axis=1)[:, :2]).max(axis=1) < 5
    save(tmp_path, points, faces[~middle])
    surface = stl(tmp_path).electrodes[0].surface
    (facet,) = surface.facets
    assert len(facet.polygon.interiors) == 1
    assert len(surface.rims) == 8
    assert surface.area == approx(800e-6)


@pytest.mark.parametrize(
    ("unit", "scale", "metres"),
    [("mm", 1, 1e-3), ("cm", 1, 1e-2), ("in", 1, 0.0254), ("m", 0.01, 1e-2), ("mm", 2, 2e-3)],
)
def test_units_and_scale(tmp_path: Path, unit: str, scale: float, metres: float) -> None:
    """Sizes are those of the file times unit and scale."""
    save(tmp_path, *flat((3.0, 2.0)))
    surface = stl(tmp_path, unit=unit, scale=scale).electrodes[0].surface
    assert np.ptp(surface.bounds, axis=0) == approx([3 * metres, 2 * metres, 0])


def test_curved_patch_keeps_facets_and_has_boundary_rims_only(tmp_path: Path) -> None:
    """A cylinder patch: one facet a strip, rims along its boundary, area of its chords."""
    save(tmp_path, *cylinder(12))
    surface = stl(tmp_path, z=0.1, tilt=[0, 0, 30]).electrodes[0].surface
    assert len(surface.facets) == 12
    chord = 2 * 40 * math.sin(math.radians(90 / 12 / 2))
    assert surface.area == approx(12 * chord * 50e-6, rel=1e-6)
    assert len(surface.rims) == 2 * 12 + 2
    lengths = np.linalg.norm(surface.rims[:, 1] - surface.rims[:, 0], axis=1)
    assert lengths.sum() == approx((24 * chord + 100) * 1e-3, rel=1e-6)


def test_creases_are_rims(tmp_path: Path) -> None:
    """A sheet folded by 45° has its fold as a rim; one folded by 20° has not."""
    for degrees, want in ((45.0, 7), (20.0, 6)):
        c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        points = [[0, 0, 0], [0, 10, 0], [-10, 0, 0], [-10, 10, 0], [10 * c, 0, 10 * s]]
        points.append([10 * c, 10, 10 * s])
        faces = [[0, 1, 2], [1, 3, 2], [0, 4, 1], [1, 4, 5]]
        save(tmp_path, points, faces)
        surface = stl(tmp_path).electrodes[0].surface
        assert len(surface.facets) == 2
        assert len(surface.rims) == want


def test_flipped_triangles_do_not_make_creases(tmp_path: Path) -> None:
    """Senses of triangles do not matter: they are made consistent."""
    points, faces = flat(n=3)
    faces[::2] = faces[::2, ::-1]
    save(tmp_path, points, faces)
    surface = stl(tmp_path).electrodes[0].surface
    assert (len(surface.facets), len(surface.rims)) == (1, 4)


def test_closed_shells(tmp_path: Path) -> None:
    """A block has six facets and twelve rims; a sphere has no rims; both are closed."""
    box = trimesh.creation.box((20, 30, 40)).subdivide()
    save(tmp_path, box.vertices, box.faces)
    block = stl(tmp_path, z=0.1, closed=True).electrodes[0].surface
    assert (len(block.facets), len(block.rims)) == (6, 12)
    assert block.area == approx(2 * (600 + 800 + 1200) * 1e-6)
    ball = trimesh.creation.icosphere(subdivisions=3, radius=20)
    save(tmp_path, ball.vertices, ball.faces)
    sphere = stl(tmp_path, z=0.1).electrodes[0].surface
    assert len(sphere.rims) == 0
    assert sphere.area == approx(4 * math.pi * 4e-4, rel=0.02)
    assert len(sphere.facets) == len(ball.faces)


def test_own_reader_agrees_with_trimesh() -> None:
    """Differential: the published files read as trimesh reads them."""
    for name in ("stripe_geom.stl", "zack_electrodes.stl"):
        path = PUBLISHED / name
        want = trimesh.load_mesh(path, process=False).triangles
        assert read_stl(path) == approx(want)


def imprint(file: str, **keys: Any) -> dict[str, Any]:
    """Design data whose electrodes are all parts of a published file."""
    group = {"file": file, "unit": "mm", **keys}
    domain = {"size": [0.5, 0.5, 0.5], "backplane": 0.001}
    return {"name": "t", "domain": domain, "electrodes_from_stl": [group]}


def test_published_stripes() -> None:
    """Four 5 × 50 mm stripes at 10 mm pitch, 1 mm above the floor."""
    design = parse_design(imprint("stripe_geom.stl"), folder=PUBLISHED)
    assert design.electrode_names == ("E1", "E2", "E3", "E4")
    for k, electrode in enumerate(design.electrodes):
        surface = electrode.surface
        assert (len(surface.facets), len(surface.rims)) == (1, 4)
        low, high = surface.bounds * 1e3
        x = -15 + 10 * k
        assert low == approx([x - 2.5, -22.5, 0.0], abs=1e-6)
        assert high == approx([x + 2.5, 27.5, 0.0], abs=1e-6)


def test_published_six_electrodes() -> None:
    """Six 30 mm squares, sorted by y, then x; single parts are the same electrodes."""
    data = imprint("zack_electrodes.stl", name="pad{}")
    data["domain"]["backplane"] = 0.011
    design = parse_design(data, folder=PUBLISHED)
    assert design.electrode_names == tuple(f"pad{k}" for k in range(1, 7))
    centers = np.array([e.surface.bounds.mean(axis=0) for e in design.electrodes]) * 1e3
    want = [[x, y, -10.0] for x in (-30, 25) for y in (-40, 2.5, 45)]
    assert sorted(map(tuple, centers.round(4).tolist())) == sorted(map(tuple, want))
    assert [tuple(c) for c in centers[:, [1, 0]].round(4)] == sorted(
        tuple(c) for c in centers[:, [1, 0]].round(4)
    )
    item = {"shape": "stl", "file": "zack_electrodes.stl", "unit": "mm"}
    singles = [{"name": f"S{k}", "part": k, **item} for k in range(1, 7)]
    again = parse_design(
        {"name": "t", "domain": data["domain"], "electrode": singles}, folder=PUBLISHED
    )
    assert again.content_hash() == design.content_hash()


def test_stl_path_is_relative_to_the_design_file(tmp_path: Path) -> None:
    """The STL is found beside the .toml, whatever the current folder."""
    save(tmp_path, *flat())
    (tmp_path / "d.toml").write_text(
        'name = "d"\n[domain]\nsize = [0.5, 0.5, 0.5]\nbackplane = 0.01\n'
        '[[electrode]]\nname = "E"\nshape = "stl"\nfile = "part.stl"\nunit = "mm"\n'
    )
    assert load_design(tmp_path / "d.toml").electrodes[0].surface.area == approx(6e-4)


def refused(call: Any, *parts: str) -> None:
    """The call must be refused with all these parts in its message."""
    with pytest.raises(DesignError) as error:
        call()
    for part in ("t.toml: ", *parts):
        assert part in str(error.value), str(error.value)


def test_bad_meshes_are_refused(tmp_path: Path) -> None:
    """Non-manifold, one-sided, degenerate, double and open meshes name electrode and fix."""
    e = ('electrode "E"', "part.stl")
    fin = [[0, 0, 0], [10, 0, 0], [0, 10, 0], [0, -10, 0], [0, 0, 10]]
    save(tmp_path, fin, [[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    refused(lambda: stl(tmp_path), *e, "1 edges are not manifold", "has 3 faces", "plain sheet")

    flat_points = [[0, 0, 0], [10, 0, 0], [0, 10, 0], [20, 0, 0]]
    save(tmp_path, flat_points, [[0, 1, 2], [0, 1, 3]])
    refused(lambda: stl(tmp_path), *e, "1 of 2 triangles", "number 2", "repair")
    save(tmp_path, flat_points, [[0, 1, 2], [1, 1, 3]])
    refused(lambda: stl(tmp_path), *e, "degenerate", "repair")
    save(tmp_path, flat_points, [[0, 1, 2], [2, 1, 0]])
    refused(lambda: stl(tmp_path), *e, "twice", "remove double faces")

    n = 12
    turns = 2 * np.pi * np.arange(n) / n
    ring = np.column_stack([np.cos(turns), np.sin(turns), np.zeros(n)])
    lean = np.cos(turns / 2)[:, None] * ring + np.sin(turns / 2)[:, None] * [0, 0, 1]
    points = np.concatenate([30 * ring + 5 * lean, 30 * ring - 5 * lean])
    faces = []
    for k in range(n):
        a, b = k, k + n
        c, d = (k + 1, k + 1 + n) if k < n - 1 else (n, 0)
        faces += [[a, c, b], [c, d, b]]
    save(tmp_path, points, faces)
    refused(lambda: stl(tmp_path), *e, "only one side", "two-sided")

    save(tmp_path, *flat())
    refused(lambda: stl(tmp_path, closed=True), *e, "20 boundary edges", "watertight")
    refused(lambda: stl(tmp_path, part=1), *e, "is open", "watertight")
    block = trimesh.creation.box((20, 30, 40))
    save(tmp_path, block.vertices, block.faces)
    refused(lambda: stl(tmp_path, closed=False), *e, "closed shell", "drop closed")


def test_bad_files_are_refused(tmp_path: Path) -> None:
    """Missing, empty, foreign, cut-off and huge files name electrode and fix."""
    refused(lambda: stl(tmp_path), 'electrode "E"', "part.stl", "relative to the design")
    for content in (b"", b"PK\x03\x04 not a mesh", b"solid x\nvertex 0 0 0\nvertex 1 0 0\n"):
        (tmp_path / "part.stl").write_bytes(content)
        refused(lambda: stl(tmp_path), 'electrode "E"', "part.stl", "export it anew")
    for content in (b"solid empty\nendsolid\n", bytes(84)):
        (tmp_path / "part.stl").write_bytes(content)
        refused(lambda: stl(tmp_path), 'electrode "E"', "no triangles", "export it anew")
    for word in (b"x", b"nan"):
        (tmp_path / "part.stl").write_bytes(
            b"solid\n vertex 0 0 0\n vertex 1 0 0\n vertex 0 1 " + word + b"\nendsolid"
        )
        refused(lambda: stl(tmp_path), 'electrode "E"', "vertex", "export it anew")
    save(tmp_path, *flat(n=5))
    whole = (tmp_path / "part.stl").read_bytes()
    (tmp_path / "part.stl").write_bytes(whole[:-30])
    refused(lambda: stl(tmp_path), 'electrode "E"', "cut off", "export it anew")
    save(tmp_path, *flat(n=101))
    refused(lambda: stl(tmp_path), 'electrode "E"', "20402 triangles", "coarser")


def test_units_that_cannot_be_meant(tmp_path: Path) -> None:
    """A 30 mm sheet read as metres is refused with the unit to try."""
    save(tmp_path, *flat())
    refused(lambda: stl(tmp_path, unit="m"), 'electrode "E"', '30 m across with unit = "m"', '"mm"')
    refused(lambda: stl(tmp_path, unit="mm", scale=100), 'electrode "E"', "3 m", "smaller scale")


def test_metres_read_as_millimetres(tmp_path: Path) -> None:
    """A 30 mm sheet, written in metres, is refused with the unit to try."""
    save(tmp_path, *flat((0.03, 0.02)))
    refused(lambda: stl(tmp_path), 'electrode "E"', "0.03 mm across", 'did you mean unit = "m"')


def test_large_parts_in_metres_read_as_millimetres(tmp_path: Path) -> None:
    """One of a metre comes out as 1 mm, which a part may have: a warning asks."""
    save(tmp_path, *flat((1.0, 0.6)))
    with pytest.warns(UserWarning, match=r'1 mm across with unit = "mm"; .* unit = "m"'):
        stl(tmp_path)


@pytest.mark.skipif(not Path("/dev/null").exists(), reason="no devices here")
def test_devices_are_no_files(tmp_path: Path) -> None:
    """They may never end, as /dev/zero does."""
    refused(lambda: stl(tmp_path, file="/dev/null"), "it is a device and no file")
    with pytest.raises(DesignError, match="it is a device and no file"):
        load_design("/dev/null")


def test_imprints_of_a_box_that_is_off_the_middle(tmp_path: Path) -> None:
    """Invariant: wherever the file has the box, the parts come to the same place."""
    mesh = trimesh.load(PUBLISHED / "stripe_geom.stl")
    mesh.apply_translation([30.0, -20.0, 7.0]).export(tmp_path / "stripe_geom.stl")
    found, wanted = (
        parse_design(imprint("stripe_geom.stl"), source="t.toml", folder=folder).electrodes
        for folder in (tmp_path, PUBLISHED)
    )
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_allclose(one.surface.bounds, other.surface.bounds, atol=1e-6)


def test_imprints_are_placed_as_the_domain_or_refused(tmp_path: Path) -> None:
    """Imprinted boxes must be the domain; their parts are picked one by one."""
    keys = {"file": "stripe_geom.stl", "folder": PUBLISHED}
    e = ('electrode "E"', "stripe_geom.stl")
    refused(lambda: stl(**keys), *e, "as large as the domain", "part = 1")
    refused(lambda: stl(**keys, part=5), 'electrode "E"', "part = 5", "from 1 to 4")
    refused(lambda: stl(**keys, part=0), 'electrode "E"', "part = 0", "from 1 to 4")
    refused(lambda: stl(**keys, part="all"), 'electrode "E"', '"all"', "[[electrodes_from_stl]]")
    refused(lambda: stl(**keys, part=1, z=0.1), 'electrode "E"', "z = 0.1", "remove it")

    def group(**change: Any) -> Any:
        data = imprint("stripe_geom.stl", **change)
        return lambda: parse_design(data, source="t.toml", folder=PUBLISHED)

    refused(group(unit="in"), "electrodes_from_stl", "12.7 m", '"mm"')
    refused(group(name="E"), "electrodes_from_stl", "'E'", '"E{}"')
    refused(group(name="{}{}"), "electrodes_from_stl", "'{}{}'", '"E{}"')
    refused(group(part=1), "electrodes_from_stl", "'part'", "valid are file, unit, name")
    small = imprint("stripe_geom.stl")
    small["domain"]["size"] = [0.5, 0.5, 0.6]
    refused(
        lambda: parse_design(small, source="t.toml", folder=PUBLISHED),
        "electrodes_from_stl",
        "[0.5, 0.5, 0.6]",
        "set domain size = [0.5, 0.5, 0.5]",
    )
    block = trimesh.creation.box((500, 500, 500))
    save(tmp_path, block.vertices, block.faces)
    refused(lambda: stl(tmp_path, part=1), 'electrode "E"', "no flat-topped mesas", "without part")
