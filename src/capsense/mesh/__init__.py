"""Tetrahedral meshes: the {P, E, T} data, lattices, the Gmsh mesher, import and export.

Gmsh and meshio are imported where they are used. Files are Gmsh's ``.msh``, VTK's ``.vtu`` and the
published ``.mat``. MATLAB's files of version 5 (``-v6``, ``-v7``) are read here and not by SciPy,
where a damaged file may end the process.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense.errors import MeshError, MissingDependencyError, require_package
from capsense.mesh.gmsh_mesher import mesh_design
from capsense.mesh.msh import MshVersion, parse_msh, write_msh
from capsense.mesh.tetmesh import GROUND, IntArray, MeshQuality, TetMesh, kuhn_tets

Numbers = NDArray[Any]

_HEAD = 128
_TYPES = {
    1: "<i1", 2: "<u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 9: "<f8", 12: "<i8",
    13: "<u8",
}  # fmt: skip
_MATRIX, _COMPRESSED = 14, 15
_CELLS, _NUMBERS = 1, range(6, 16)
"""Classes of arrays."""
_MOST = 1_000_000_000
"""A compressed array may become so large [bytes]: small files may hold very large ones."""


def parse_mat(content: bytes) -> dict[str, Numbers | list[Numbers]]:
    """Arrays of numbers by name, those of cells as lists; what is neither is left out.

    After *MAT-File Format*, MathWorks, version R2024a.

    Raises:
        MeshError: The file is of another version, damaged, or inflates beyond 1 GB.
    """
    if content[124:128] != b"\x00\x01IM":
        raise MeshError("it is no MAT-file of version 5, little-endian; save it with '-v7'")
    found = {}
    for kind, data in _elements(memoryview(content)[_HEAD:]):
        if kind == _COMPRESSED:
            kind, data = next(_elements(_inflated(data)), (0, data))
        if kind == _MATRIX:
            name, value = _matrix(data)
            if value is not None:
                found[name] = value
    return found


def _elements(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Type and content of the elements in a row."""
    at = 0
    while at < len(data):
        kind, size = struct.unpack_from("<II", data, at)
        start = at + 8
        after = start + size if kind == _COMPRESSED else start + -(-size // 8) * 8
        if kind >> 16:  # up to four bytes, packed with their type
            kind, size, start, after = kind & 0xFFFF, kind >> 16, at + 4, start
        if start + size > len(data):
            raise MeshError("an array is cut off")
        yield kind, data[start : start + size]
        at = after


def _inflated(data: memoryview) -> memoryview:
    out = zlib.decompressobj().decompress(data, _MOST + 1)
    if len(out) > _MOST:
        raise MeshError(f"an array inflates to more than {_MOST:,} bytes; save it uncompressed")
    return memoryview(out)


def _matrix(data: memoryview) -> tuple[str, Numbers | list[Numbers] | None]:
    """Name and content of an array; no content where it holds something else."""
    parts = _elements(data)
    flags, shape, name = (next(parts, (0, memoryview(b"")))[1] for _ in range(3))
    kind = struct.unpack_from("<I", flags)[0] & 0xFF
    label = bytes(name).decode("latin-1")
    if kind == _CELLS:
        cells = [_matrix(part)[1] for sort, part in parts if sort == _MATRIX]
        return label, [c for c in cells if isinstance(c, np.ndarray)]
    if kind not in _NUMBERS:
        return label, None
    sort, values = next(parts)
    if sort not in _TYPES:
        raise MeshError(f"array {label!r} has numbers of an unknown type, {sort}")
    size = np.frombuffer(shape, "<i4").tolist()
    return label, np.frombuffer(values, _TYPES[sort]).reshape(size, order="F")


Unit = Literal["m", "mm", "cm"]

METRES_PER: dict[str, float] = {"m": 1.0, "mm": 1e-3, "cm": 1e-2}
"""Metres in one unit of length of a file."""

SUFFIXES = (".msh", ".vtu", ".mat")
"""File types that meshes are read from and written to."""

_TETRAHEDRA = ("tetra", "tetra10")
_OTHER_SOLIDS = ("hexahedron", "wedge", "pyramid", "hexahedron20", "hexahedron27", "polyhedron")
_NODE_PREFIX, _CELL_PREFIX = "node_group:", "cell_group:"


def load_mesh(path: str | Path, unit: Unit | None = None) -> TetMesh:
    """Read a mesh from a `.msh`, `.vtu` or `.mat` file.

    Args:
        path: The file. Physical groups of a `.msh` become groups of the mesh: those of volumes cell
            groups, those of surfaces, curves and points node groups; a group without a name is
            called ``physical_<dimension>_<number>``. Nodes outside every tetrahedron are dropped,
            and only the corners of quadratic tetrahedra are kept.
        unit: Unit of length of the file: "m" (the default for `.msh` and `.vtu`), "mm" or "cm" (the
            default for `.mat`).

    Raises:
        MeshError: If the suffix is not one of `SUFFIXES`, or the file is missing, unreadable,
            inconsistent, holds no tetrahedra or holds other solids.
        MissingDependencyError: If the file is a `.vtu` and meshio is not installed.
    """
    path = Path(path)
    suffix = _suffix(path)
    if unit is not None and unit not in METRES_PER:
        raise MeshError(f"unknown unit {unit!r}; known: {', '.join(METRES_PER)}")
    scale = METRES_PER[unit or ("cm" if suffix == ".mat" else "m")]
    if not path.is_file():
        raise MeshError(f"there is no mesh file {path}")
    load = {".msh": _load_msh, ".vtu": _load_vtu, ".mat": _load_mat}[suffix]
    try:
        return load(path, scale)
    except MissingDependencyError:
        raise
    except (Exception, SystemExit) as error:  # whatever readers of others make of damage
        why = str(error) or repr(error)
        raise MeshError(f"{path} is not a readable {suffix} file: {why}") from error


def save_mesh(
    mesh: TetMesh,
    path: str | Path,
    *,
    point_data: Mapping[str, ArrayLike] | None = None,
    cell_data: Mapping[str, ArrayLike] | None = None,
    msh_version: MshVersion = "4.1",
) -> None:
    """Write a mesh to a `.msh` (metres), `.vtu` (metres) or `.mat` (centimetres) file.

    Args:
        mesh: The mesh, groups included. In `.mat` files the group "ground" joins the electrodes in
            the list of Dirichlet nodes, every other node group is an electrode, and neither names
            nor cell groups are kept.
        path: The file to write.
        point_data: Only for `.vtu`: named arrays of shape (n, …), stored with the mesh.
        cell_data: Only for `.vtu`: named arrays of shape (k, …), stored with the mesh.
        msh_version: Only for `.msh`: format "4.1" or "2.2", both as text.

    Raises:
        MeshError: If the suffix is not one of `SUFFIXES`, data does not fit the mesh or the file
            type, or the file cannot be written.
        MissingDependencyError: If the file is a `.vtu` and meshio is not installed.
    """
    path = Path(path)
    suffix = _suffix(path)
    if suffix != ".vtu" and (point_data or cell_data):
        raise MeshError(f"point and cell data can be stored in .vtu files only, not {suffix}")
    try:
        if suffix == ".msh":
            write_msh(mesh, path, msh_version)
        elif suffix == ".mat":
            _save_mat(mesh, path)
        else:
            _save_vtu(mesh, path, point_data or {}, cell_data or {})
    except OSError as error:
        raise MeshError(f"cannot write {path}: {error}") from error


def _suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise MeshError(
            f"{path.name}: unknown mesh file type {suffix or '(no suffix)'!r}; "
            f"known: {', '.join(SUFFIXES)}"
        )
    return suffix


def _compact(
    points: NDArray[np.float64],
    tets: NDArray[np.integer],
    nodes: Mapping[str, NDArray[np.integer]],
    cells: Mapping[str, NDArray[np.integer]],
) -> TetMesh:
    """Build a mesh without the points that no tetrahedron uses."""
    if tets.size and (tets.min() < 0 or tets.max() >= len(points)):
        return TetMesh(points, tets.astype(np.int32))  # refuses the mesh and counts the indices
    used = np.unique(tets)
    number = np.full(len(points), -1, dtype=np.int32)
    number[used] = np.arange(len(used), dtype=np.int32)
    groups = {name: number[members] for name, members in nodes.items()}
    return TetMesh(
        points[used],
        number[tets],
        {name: members[members >= 0] for name, members in groups.items()},
        {name: members.astype(np.int32) for name, members in cells.items()},
    )


def _load_msh(path: Path, scale: float) -> TetMesh:
    data = parse_msh(path.read_bytes())
    if len(data.tets) == 0:
        raise MeshError("it holds no tetrahedra")
    return _compact(data.points * scale, data.tets, data.nodes, data.cells)


def _load_vtu(path: Path, scale: float) -> TetMesh:
    require_package("meshio", "meshio, which .vtu files need,", "mesh")
    from meshio import vtu

    if b"vtkLZMADataCompressor" in path.read_bytes():
        raise MeshError("it is compressed by LZMA, to a size that nothing tells; save it by zlib")
    data = vtu.read(path)  # meshio.read prints what goes wrong, and ends the process
    counts = Counter({block.type: len(block.data) for block in data.cells})
    if others := {kind: n for kind, n in counts.items() if kind in _OTHER_SOLIDS}:
        raise MeshError(f"it holds solids that are not tetrahedra: {others}")
    kept = [i for i, block in enumerate(data.cells) if block.type in _TETRAHEDRA]
    if not kept:
        raise MeshError(f"it holds no tetrahedra (it holds: {', '.join(counts) or 'nothing'})")
    return _compact(
        np.asarray(data.points, dtype=float) * scale,
        np.concatenate([data.cells[i].data[:, :4] for i in kept]),
        {
            name.removeprefix(_NODE_PREFIX): np.flatnonzero(values)
            for name, values in data.point_data.items()
            if name.startswith(_NODE_PREFIX)
        },
        {
            name.removeprefix(_CELL_PREFIX): np.flatnonzero(
                np.concatenate([values[i] for i in kept])
            )
            for name, values in data.cell_data.items()
            if name.startswith(_CELL_PREFIX)
        },
    )


def _save_vtu(
    mesh: TetMesh,
    path: Path,
    point_data: Mapping[str, ArrayLike],
    cell_data: Mapping[str, ArrayLike],
) -> None:
    require_package("meshio", "meshio, which .vtu files need,", "mesh")
    import meshio

    stored: dict[str, dict[str, NDArray[Any]]] = {}
    for kind, prefix, groups, extra, count in (
        ("point", _NODE_PREFIX, mesh.node_groups, point_data, mesh.n_points),
        ("cell", _CELL_PREFIX, mesh.cell_groups, cell_data, mesh.n_tets),
    ):
        arrays: dict[str, NDArray[Any]] = {}
        for name, members in groups.items():
            arrays[prefix + name] = np.isin(np.arange(count), members).astype(np.int8)
        for name, values in extra.items():
            array = np.asarray(values)
            if array.ndim == 0 or len(array) != count:
                raise MeshError(
                    f"{kind} data {name!r} has shape {array.shape}; {count} rows are needed"
                )
            arrays[name] = array
        stored[kind] = arrays
    meshio.Mesh(
        mesh.points,
        [("tetra", mesh.tets)],
        point_data=stored["point"],
        cell_data={name: [values] for name, values in stored["cell"].items()},
    ).write(path)


def _load_mat(path: Path, scale: float) -> TetMesh:
    data: dict[str, Any] = parse_mat(path.read_bytes())
    needed = ("node", "inzid", "AllNodes", "elecNodes")
    if missing := [name for name in needed if name not in data]:
        raise MeshError(f"it lacks the variables {', '.join(missing)}")
    points = np.asarray(data["node"], dtype=float)
    tets = _zero_based(data["inzid"])
    if tets.ndim != 2 or tets.shape[1] != 4 or points.ndim != 2 or points.shape[1] != 3:
        raise MeshError("inzid must have shape (k, 4) and node (n, 3)")
    for name, count in (("NrElements", len(tets)), ("NrNodes", len(points))):
        if name in data and int(data[name].ravel()[0]) != count:
            raise MeshError(f"{name} says {data[name].ravel()[0]}, but there are {count}")
    electrodes = {
        f"E{number}": _zero_based(members).ravel()
        for number, members in enumerate(data["elecNodes"], start=1)
    }
    driven = np.concatenate([np.empty(0, np.int64), *electrodes.values()])
    nodes = {GROUND: np.setdiff1d(_zero_based(data["AllNodes"]).ravel(), driven), **electrodes}
    for name, members in nodes.items():
        if members.size and (members.min() < 0 or members.max() >= len(points)):
            raise MeshError(f"nodes of {name} outside 1…{len(points)}")
    return _compact(points * scale, tets, nodes, {})


def _zero_based(values: ArrayLike) -> NDArray[np.int64]:
    return np.asarray(values).astype(np.int64) - 1


def _save_mat(mesh: TetMesh, path: Path) -> None:
    from scipy.io import savemat

    def one_based(values: IntArray) -> NDArray[np.uint32]:
        return values.astype(np.uint32) + np.uint32(1)

    names = [name for name in mesh.node_groups if name != GROUND]
    electrodes = np.empty((1, len(names)), dtype=object)
    for column, name in enumerate(names):
        electrodes[0, column] = one_based(mesh.node_groups[name])[None, :]
    with path.open("wb") as file:
        savemat(
            file,
            {
                "NrElements": np.uint32(mesh.n_tets),
                "NrNodes": np.uint32(mesh.n_points),
                "inzid": one_based(mesh.tets),
                "node": mesh.points / METRES_PER["cm"],
                "s": mesh.centroids / METRES_PER["cm"],
                "AllNodes": one_based(mesh.group_nodes(mesh.node_groups))[None, :],
                "elecNodes": electrodes,
            },
            do_compression=True,
        )
