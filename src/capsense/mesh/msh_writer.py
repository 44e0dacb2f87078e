"""Write a mesh in Gmsh's text format, versions 4.1 and 2.2, with its physical groups.

A node group is written as the triangles whose three corners it holds, and any node left over as
a point, so that reading the file gives the same group.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from capsense.errors import MeshError
from capsense.mesh.tetmesh import TetMesh

MshVersion = Literal["4.1", "2.2"]

_GMSH_TYPE = {1: 15, 3: 2, 4: 4}
"""Gmsh's number for the element type with so many nodes."""


@dataclass(frozen=True)
class _Block:
    """Elements of one geometrical entity."""

    dim: int
    entity: int
    physical: int
    """Number of the physical group; 0 for none."""
    nodes: NDArray[np.int64]
    """Corners of each element, counted from 1, shape (e, 1), (e, 3) or (e, 4)."""
    bounds: NDArray[np.float64]
    """Lower and upper corner [m], shape (2, 3)."""


def write_msh(mesh: TetMesh, path: Path, version: MshVersion = "4.1") -> None:
    """Write `mesh` to `path` in metres.

    Raises:
        MeshError: If the version is unknown.
    """
    if version not in ("4.1", "2.2"):
        raise MeshError(f"unknown .msh version {version!r}; known: 4.1, 2.2")
    blocks = list(_blocks(mesh))
    names: dict[tuple[int, int], str] = {}
    cell_names = list(mesh.cell_groups)
    node_names = list(mesh.node_groups)
    for block in blocks:
        if block.physical:
            names[block.dim, block.physical] = (cell_names if block.dim == 3 else node_names)[
                block.physical - 1
            ]
    out = StringIO()
    out.write(f"$MeshFormat\n{version} 0 8\n$EndMeshFormat\n$PhysicalNames\n{len(names)}\n")
    for (dim, tag), name in sorted(names.items()):
        out.write(f'{dim} {tag} "{name}"\n')
    out.write("$EndPhysicalNames\n")
    (_write_41 if version == "4.1" else _write_22)(out, mesh, blocks)
    path.write_text(out.getvalue())


def _blocks(mesh: TetMesh) -> Iterator[_Block]:
    """Entities number from 1 in each dimension; physical groups follow the mesh's groups."""
    faces = np.concatenate(
        [mesh.tets[:, corners] for corners in ((1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2))]
    )
    faces = np.unique(np.sort(faces, axis=1), axis=0)
    points = 0
    for tag, members in enumerate(mesh.node_groups.values(), start=1):
        inside = np.zeros(mesh.n_points, dtype=bool)
        inside[members] = True
        triangles = faces[inside[faces].all(axis=1)]
        if len(triangles):
            yield _block(mesh, 2, tag, tag, triangles)
        for node in np.setdiff1d(members, triangles):
            points += 1
            yield _block(mesh, 0, points, tag, np.array([[node]]))
    free = np.ones(mesh.n_tets, dtype=bool)
    for tag, members in enumerate(mesh.cell_groups.values(), start=1):
        free[members] = False
        if len(members):
            yield _block(mesh, 3, tag, tag, mesh.tets[members])
    if free.any():
        yield _block(mesh, 3, len(mesh.cell_groups) + 1, 0, mesh.tets[free])


def _block(
    mesh: TetMesh, dim: int, entity: int, physical: int, nodes: NDArray[np.integer]
) -> _Block:
    corners = mesh.points[nodes.ravel()]
    bounds = np.array([corners.min(axis=0), corners.max(axis=0)])
    return _Block(dim, entity, physical, nodes.astype(np.int64) + 1, bounds)


def _write_41(out: StringIO, mesh: TetMesh, blocks: list[_Block]) -> None:
    out.write("$Entities\n")
    out.write(" ".join(str(sum(b.dim == dim for b in blocks)) for dim in range(4)) + "\n")
    for block in sorted(blocks, key=lambda b: (b.dim, b.entity)):
        corners = block.bounds[:1] if block.dim == 0 else block.bounds
        position = " ".join(f"{value:.16g}" for value in corners.ravel())
        physical = f"1 {block.physical}" if block.physical else "0"
        out.write(f"{block.entity} {position} {physical}{'' if block.dim == 0 else ' 0'}\n")
    out.write("$EndEntities\n")
    owner = next(block for block in blocks if block.dim == 3)
    n = mesh.n_points
    out.write(f"$Nodes\n1 {n} 1 {n}\n3 {owner.entity} 0 {n}\n")
    np.savetxt(out, np.arange(1, n + 1), fmt="%d")
    np.savetxt(out, mesh.points, fmt="%.17g")
    total = sum(len(block.nodes) for block in blocks)
    out.write(f"$EndNodes\n$Elements\n{len(blocks)} {total} 1 {total}\n")
    first = 1
    for block in blocks:
        count, corners_each = block.nodes.shape
        out.write(f"{block.dim} {block.entity} {_GMSH_TYPE[corners_each]} {count}\n")
        np.savetxt(out, np.column_stack([np.arange(first, first + count), block.nodes]), fmt="%d")
        first += count
    out.write("$EndElements\n")


def _write_22(out: StringIO, mesh: TetMesh, blocks: list[_Block]) -> None:
    n = mesh.n_points
    out.write(f"$Nodes\n{n}\n")
    np.savetxt(out, np.column_stack([np.arange(1, n + 1), mesh.points]), fmt="%d" + 3 * " %.17g")
    out.write(f"$EndNodes\n$Elements\n{sum(len(block.nodes) for block in blocks)}\n")
    first = 1
    for block in blocks:
        count, corners_each = block.nodes.shape
        head = np.tile([0, _GMSH_TYPE[corners_each], 2, block.physical, block.entity], (count, 1))
        head[:, 0] = np.arange(first, first + count)
        np.savetxt(out, np.column_stack([head, block.nodes]), fmt="%d")
        first += count
    out.write("$EndElements\n")
