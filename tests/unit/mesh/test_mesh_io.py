"""Import and export: .msh, .vtu, and the published .mat meshes."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from approximate import approx

from capsense.errors import MeshError, MissingDependencyError
from capsense.mesh import TetMesh, kuhn_tets, load_mesh, save_mesh

meshio = pytest.importorskip("meshio", reason='needs pip install "capsense[mesh]"')
PUBLISHED = Path(__file__).parents[2] / "data/published_meshes/mesh_data_3stripe_electrodes.mat"


@pytest.fixture
def mesh() -> TetMesh:
    """A lattice with sheets, a lone node, overlapping groups and two regions."""
    lattice = kuhn_tets([0, 0.1, 0.3, 0.7], [0, 0.2, 0.5, 0.6], [0, 0.1, 0.2])
    at = lattice.points
    low = lattice.centroids[:, 2] < 0.1
    return lattice.with_groups(
        node_groups={
            "E1": np.flatnonzero((at[:, 2] == 0.1) & (at[:, 0] < 0.2) & (at[:, 1] < 0.3)),
            "pin": [lattice.n_points // 2],
            "floor": np.flatnonzero(at[:, 2] == 0.0),
        },
        cell_groups={
            "plate": np.flatnonzero(low & (lattice.centroids[:, 0] < 0.3)),
            "a b": np.flatnonzero(~low)[:7],
        },
    )


def assert_same(got: TetMesh, mesh: TetMesh) -> None:
    """Same nodes, and the same tetrahedra, links and groups whatever the order of the cells."""
    np.testing.assert_allclose(got.points, mesh.points, rtol=1e-15)

    def cells(m: TetMesh, members: np.ndarray) -> list[tuple[int, ...]]:
        return sorted(tuple(sorted(tet)) for tet in m.tets[members].tolist())

    assert cells(got, np.arange(got.n_tets)) == cells(mesh, np.arange(mesh.n_tets))
    assert got.node_groups.keys() == mesh.node_groups.keys()
    for name, members in mesh.node_groups.items():
        np.testing.assert_array_equal(got.node_groups[name], members)
    assert got.cell_groups.keys() == mesh.cell_groups.keys()
    for name, members in mesh.cell_groups.items():
        assert cells(got, got.cell_groups[name]) == cells(mesh, members)


@pytest.mark.parametrize("version", ["4.1", "2.2"])
def test_msh_round_trip(mesh, tmp_path, version):
    path = tmp_path / "mesh.msh"
    save_mesh(mesh, path, msh_version=version)
    assert path.read_text().startswith(f"$MeshFormat\n{version} 0 8\n")
    assert_same(load_mesh(path), mesh)


@pytest.mark.parametrize("version", ["4.1", "2.2"])
@pytest.mark.usefixtures("broken_pipes_ignored")
def test_gmsh_reads_and_rewrites_our_msh(mesh, tmp_path, version):
    gmsh = pytest.importorskip("gmsh", exc_type=(ImportError, OSError))
    save_mesh(mesh, tmp_path / "ours.msh", msh_version=version)
    gmsh.initialize(interruptible=False, readConfigFiles=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.open(str(tmp_path / "ours.msh"))
        groups = {gmsh.model.getPhysicalName(*g): g for g in gmsh.model.getPhysicalGroups()}
        assert set(groups) == {"ground", "E1", "pin", "floor", "plate", "a b"}
        # Gmsh drops what is in no group from 2.2, or with SaveAll all groups.
        gmsh.option.setNumber("Mesh.SaveAll", int(version == "4.1"))
        gmsh.option.setNumber("Mesh.MshFileVersion", float(version))
        gmsh.option.setNumber("Mesh.Binary", 1)
        gmsh.write(str(tmp_path / "theirs.msh"))
    finally:
        gmsh.finalize()
    got = load_mesh(tmp_path / "theirs.msh")
    grouped = sum(len(members) for members in mesh.cell_groups.values())
    assert got.n_tets == (mesh.n_tets if version == "4.1" else grouped)
    kept = np.unique(mesh.tets[np.concatenate(list(mesh.cell_groups.values()))])
    kept = kept if version == "2.2" else np.arange(mesh.n_points)
    for name, group in mesh.node_groups.items():
        members = np.intersect1d(group, kept)
        assert len(got.node_groups[name]) == len(members)
        np.testing.assert_allclose(
            got.points[got.node_groups[name]].sum(axis=0), mesh.points[members].sum(axis=0)
        )
    for name, members in mesh.cell_groups.items():
        volume = mesh.volumes[members].sum()
        assert got.volumes[got.cell_groups[name]].sum() == approx(volume, rel=1e-12)


def test_msh_of_another_program(tmp_path):
    """Millimetres, a quadratic tetrahedron, an unused node, a surface without a name."""
    points = np.array([[9, 9, 9], [0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, 2]], dtype=float)
    middles = [(1, 2), (2, 3), (1, 3), (1, 4), (3, 4), (2, 4)]
    points = np.vstack([points, [(points[a] + points[b]) / 2 for a, b in middles]])
    foreign = meshio.Mesh(
        points,
        [("triangle", np.array([[1, 2, 3]])), ("tetra10", np.array([[1, 2, 3, 4, *range(5, 11)]]))],
        cell_data={
            "gmsh:physical": [np.array([7]), np.array([3])],
            "gmsh:geometrical": [np.array([1]), np.array([1])],
        },
        field_data={"wood": np.array([3, 3])},
    )
    meshio.write(tmp_path / "foreign.msh", foreign, file_format="gmsh22", binary=False)
    got = load_mesh(tmp_path / "foreign.msh", unit="mm")
    assert got.n_points == 4
    np.testing.assert_allclose(got.points.max(axis=0), [2e-3, 2e-3, 2e-3])
    assert got.node_groups["physical_2_7"].tolist() == [0, 1, 2]
    assert got.cell_groups["wood"].tolist() == [0]


@pytest.mark.parametrize("version", ["4.1", "2.2"])
def test_a_damaged_msh_is_refused_or_read_but_never_crashes(mesh, tmp_path, version):
    path = tmp_path / "mesh.msh"
    save_mesh(mesh, path, msh_version=version)
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(150):
        damaged = bytearray(whole[: rng.integers(len(whole))] if rng.random() < 0.5 else whole)
        for at in rng.integers(len(damaged), size=2) if len(damaged) else ():
            damaged[at] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            load_mesh(path)
        except MeshError:
            refused += 1
    assert refused > 75


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("$MeshFormat\n4.0 0 8\n$EndMeshFormat\n", "version 4.0 is not supported"),
        ("$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$Nodes\n1 1 1 1\n", r"\$Nodes does not end"),
        ("$MeshFormat\n4.1 0 8\n$EndMeshFormat\n", "holds no nodes"),
        (
            "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n1\n1 0 0 0\n$EndNodes\n"
            "$Elements\n1\n1 4 2 0 1 1 2 3 4\n$EndElements\n",
            "nodes that it does not hold",
        ),
        (
            "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n1\n1 0 0 0\n$EndNodes\n"
            "$Elements\n1\n1 5 2 0 1 1 1 1 1 1 1 1 1\n$EndElements\n",
            "1 solids that are not tetrahedra",
        ),
        (
            "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n1\n1 0 0 0\n$EndNodes\n"
            "$Elements\n1\n1 15 2 0 1 1\n$EndElements\n",
            "holds no tetrahedra",
        ),
    ],
)
def test_msh_files_that_cannot_be_used(tmp_path, content, message):
    (tmp_path / "a.msh").write_text(content)
    with pytest.raises(MeshError, match=message):
        load_mesh(tmp_path / "a.msh")


def test_vtu_round_trip_with_data(mesh, tmp_path):
    path = tmp_path / "mesh.vtu"
    potential = np.arange(mesh.n_points) / 7
    field = np.random.default_rng(0).normal(size=(mesh.n_tets, 3))
    save_mesh(mesh, path, point_data={"phi": potential}, cell_data={"E": field})
    assert_same(load_mesh(path), mesh)
    raw = meshio.read(path)
    np.testing.assert_array_equal(raw.point_data["phi"], potential)
    np.testing.assert_array_equal(raw.cell_data["E"][0], field)


def test_published_mesh():
    """Units, index base and groups of a mesh that goes with the paper."""
    mesh = load_mesh(PUBLISHED)
    assert (mesh.n_tets, mesh.n_points) == (17822, 3643)
    np.testing.assert_allclose(mesh.points.min(axis=0), 0.0, atol=1e-15)
    np.testing.assert_allclose(mesh.points.max(axis=0), 0.5, rtol=1e-15)
    raw = scipy.io.loadmat(PUBLISHED)
    np.testing.assert_allclose(mesh.centroids, raw["s"] / 100, rtol=1e-12)
    # Three raised steps of 100 mm × 20 mm × 2.5 mm are left out of the 0.5 m cube.
    steps = 3 * 0.1 * 0.02 * 0.0025
    assert mesh.volumes.sum() == approx(0.125 - steps, rel=1e-12)
    assert list(mesh.node_groups) == ["ground", "E1", "E2", "E3"]
    for number in (1, 2, 3):
        nodes = mesh.points[mesh.node_groups[f"E{number}"]]
        np.testing.assert_allclose(np.ptp(nodes, axis=0), [0.1, 0.02, 0.0], atol=1e-12)
        np.testing.assert_allclose(nodes[:, 2], 0.0025, rtol=1e-12)
        assert nodes[:, 1].min() == approx(0.21 + 0.03 * (number - 1), rel=1e-12)
    ground = mesh.points[mesh.node_groups["ground"]]
    on_box = (np.abs(ground - 0.25) > 0.25 - 1e-9).any(axis=1)
    assert on_box.all()
    assert len(ground) == 1255 - 3 * 14


def test_published_mesh_round_trip(tmp_path):
    mesh = load_mesh(PUBLISHED)
    path = tmp_path / "copy.mat"
    save_mesh(mesh, path)
    assert_same(load_mesh(path), mesh)
    raw, again = scipy.io.loadmat(PUBLISHED), scipy.io.loadmat(path)
    for name in ("NrElements", "NrNodes", "AllNodes"):
        np.testing.assert_array_equal(again[name], raw[name])
    np.testing.assert_allclose(again["node"], raw["node"], rtol=1e-14)
    assert again["elecNodes"].shape == (1, 3)
    for got, expected in zip(again["elecNodes"][0], raw["elecNodes"][0], strict=True):
        np.testing.assert_array_equal(got, expected)


@pytest.mark.parametrize("name", ["mesh.stl", "mesh"])
def test_unknown_suffix(mesh, tmp_path, name):
    with pytest.raises(MeshError, match=r"unknown mesh file type.*\.msh, \.vtu, \.mat"):
        save_mesh(mesh, tmp_path / name)
    with pytest.raises(MeshError, match=r"unknown mesh file type.*\.msh, \.vtu, \.mat"):
        load_mesh(tmp_path / name)


@pytest.mark.parametrize("suffix", ["msh", "vtu", "mat"])
def test_missing_and_unreadable_files(mesh, tmp_path, suffix):
    path = tmp_path / f"mesh.{suffix}"
    with pytest.raises(MeshError, match="there is no mesh file"):
        load_mesh(path)
    path.write_text("not a mesh")
    with pytest.raises(MeshError, match="not a readable"):
        load_mesh(path)
    with pytest.raises(MeshError, match="cannot write"):
        save_mesh(mesh, tmp_path / "absent" / f"mesh.{suffix}")


def test_readers_of_damaged_files_print_nothing(tmp_path, capfd):
    """What is wrong is in the error alone."""
    path = tmp_path / "mesh.vtu"
    path.write_text('<VTKFile type="ImageData" version="0.1"></VTKFile>')
    with pytest.raises(MeshError, match=r"not a readable \.vtu file"):
        load_mesh(path)
    assert capfd.readouterr() == ("", "")


def test_a_file_without_tetrahedra(tmp_path):
    triangle = meshio.Mesh(np.eye(3), [("triangle", np.array([[0, 1, 2]]))])
    triangle.write(tmp_path / "flat.vtu")
    with pytest.raises(MeshError, match=r"no tetrahedra \(it holds: triangle\)"):
        load_mesh(tmp_path / "flat.vtu")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"inzid": None}, "lacks the variables inzid"),
        ({"NrNodes": 5}, "NrNodes says 5, but there are 48"),
        ({"AllNodes": np.array([[0, 3]])}, "nodes of ground outside 1…48"),
        ({"inzid": np.array([[1, 2, 3]])}, "inzid must have shape"),
    ],
)
def test_an_inconsistent_mat_file_is_refused(mesh, tmp_path, change, message):
    save_mesh(mesh, tmp_path / "good.mat")
    data = {k: v for k, v in scipy.io.loadmat(tmp_path / "good.mat").items() if k[0] != "_"}
    data = {k: v for k, v in (data | change).items() if v is not None}
    scipy.io.savemat(tmp_path / "bad.mat", data)
    with pytest.raises(MeshError, match=message):
        load_mesh(tmp_path / "bad.mat")


def test_options_that_do_not_fit(mesh, tmp_path):
    with pytest.raises(MeshError, match="unknown unit 'inch'"):
        load_mesh(tmp_path / "a.msh", unit="inch")  # type: ignore[arg-type]
    with pytest.raises(MeshError, match=r"unknown \.msh version"):
        save_mesh(mesh, tmp_path / "a.msh", msh_version="3")  # type: ignore[arg-type]
    with pytest.raises(MeshError, match=r"in \.vtu files only"):
        save_mesh(mesh, tmp_path / "a.msh", point_data={"phi": np.zeros(mesh.n_points)})
    with pytest.raises(MeshError, match="point data 'phi' has shape"):
        save_mesh(mesh, tmp_path / "a.vtu", point_data={"phi": np.zeros(3)})


def test_missing_meshio_names_the_install(mesh, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "meshio", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'capsense\[mesh\]'"):
        save_mesh(mesh, tmp_path / "a.vtu")
    save_mesh(mesh, tmp_path / "a.msh")
    save_mesh(mesh, tmp_path / "a.mat")
    assert load_mesh(tmp_path / "a.mat").n_tets == mesh.n_tets
