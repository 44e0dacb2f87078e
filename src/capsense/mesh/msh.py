"""Gmsh's mesh format, versions 2.2 and 4.1, with its physical groups.

It is read as text or binary and written as text. A node group is written as the triangles whose
three corners it holds, and any node left over as a point, so that reading the file gives the same
group.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import StringIO
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from capsense.errors import MeshError
from capsense.mesh.tetmesh import TetMesh

IntArray = NDArray[np.int64]

_NODE_COUNTS = (
    *(2, 3, 4, 4, 8, 6, 5, 3, 6, 9, 10, 27, 18, 14, 1, 8, 20, 15, 13, 9, 10, 12, 15, 15, 21, 4, 5),
    *(6, 20, 35, 56),
)
_NODES_OF = dict(enumerate(_NODE_COUNTS, start=1))
"""Number of nodes of each of Gmsh's element types."""
_TETRAHEDRA = (4, 11, 29, 30, 31)
_LOW_DIM = {15: 0, 1: 1, 8: 1, 26: 1, 27: 1, 28: 1} | dict.fromkeys(
    (2, 3, 9, 10, 16, 20, 21, 22, 23, 24, 25), 2
)
"""Dimension of the element types of points, curves and surfaces; all others are solids."""


@dataclass
class MshData:
    """What a .msh file holds, in its own unit of length."""

    points: NDArray[np.float64]
    """Shape (n, 3)."""
    tets: IntArray
    """Corners of the tetrahedra as rows of `points`, shape (k, 4)."""
    nodes: dict[str, IntArray] = field(default_factory=dict)
    """Nodes of each physical group of points, curves or surfaces."""
    cells: dict[str, IntArray] = field(default_factory=dict)
    """Tetrahedra of each physical group of volumes."""


@dataclass
class _ElementGroup:
    """Elements of one type that are in the same physical groups."""

    kind: int
    physical: list[int]
    corners: IntArray
    """Node tags, shape (e, nodes of the type)."""


class _Numbers:
    """A section's numbers in order, from text or from binary."""

    def __init__(self, content: bytes, start: int, end: int, binary: bool) -> None:
        self._content, self.at, self._binary = content, start, binary
        if not binary:
            self._text = np.fromstring(content[start:end].decode("ascii"), sep=" ")
            self._next = 0

    def take(self, count: int, dtype: str) -> NDArray:
        """The next `count` numbers of a binary type ("i4", "u8" or "f8")."""
        if count < 0:
            raise MeshError("a count is negative")
        if self._binary:
            out = np.frombuffer(self._content, "<" + dtype, count, self.at)
            self.at += out.nbytes
            return out.astype(np.int64) if dtype != "f8" else out
        out = self._text[self._next : self._next + count]
        if len(out) < count:
            raise MeshError("a section ends early")
        self._next += count
        return out.astype(np.int64) if dtype != "f8" else out

    def records(self, count: int, fields: list[tuple]) -> NDArray:
        """The next `count` records of a binary section."""
        out = np.frombuffer(self._content, np.dtype(fields), count, self.at)
        self.at += out.nbytes
        return out

    def rest(self) -> NDArray[np.float64]:
        """All numbers that are left, of a text section."""
        return self._text[self._next :]


def parse_msh(content: bytes) -> MshData:
    """Parse the bytes of a .msh file.

    Raises:
        MeshError: If the file is not of version 2.2 or 4.1, is partitioned or damaged, or holds
            solids other than tetrahedra.
    """
    head = re.match(rb"\$MeshFormat\s+([\d.]+)\s+([01])\s+(\d+)[^\n]*\n", content)
    if head is None:
        raise MeshError("it does not begin with $MeshFormat")
    version, binary = head[1].decode(), head[2] == b"1"
    if version not in ("2.2", "4.1") or head[3] != b"8":
        raise MeshError(f"version {version} is not supported; save it as 4.1 or 2.2")
    at = head.end()
    if binary and content[at : at + 4] != b"\x01\x00\x00\x00":
        raise MeshError("it is big-endian")
    names: dict[tuple[int, int], str] = {}
    physical: dict[tuple[int, int], list[int]] = {}
    tags, points, blocks = np.empty(0, np.int64), np.empty((0, 3)), []
    at = content.find(b"$EndMeshFormat", at) + len("$EndMeshFormat")
    while (section := re.compile(rb"\s*\$(\w+)[^\n]*\n").match(content, at)) is not None:
        name, start = section[1], section.end()
        numeric = name in (b"Entities", b"Nodes", b"Elements")
        if name == b"PartitionedEntities":
            raise MeshError("it is partitioned; save it unpartitioned")
        end = content.find(b"$End" + name, start)
        if end < 0:
            raise MeshError(f"section ${name.decode()} does not end")
        if name == b"PhysicalNames":
            names = _names(content[start:end].decode())
        elif numeric:
            count = -1
            if version == "2.2":
                line = content.index(b"\n", start)
                count, start = int(content[start:line]), line + 1
            numbers = _Numbers(content, start, end, binary)
            if name == b"Entities":
                physical = _entities(numbers)
            elif name == b"Nodes":
                tags, points = (
                    _nodes_41(numbers) if count < 0 else _nodes_22(numbers, count, binary)
                )
            else:
                blocks = (
                    _elements_41(numbers, physical)
                    if count < 0
                    else _elements_22(numbers, count, binary)
                )
            end = content.find(b"$End" + name, numbers.at)
        at = end + len(b"$End" + name)
    return _assemble(tags, points, blocks, names)


def _names(text: str) -> dict[tuple[int, int], str]:
    found = re.findall(r'^\s*(\d)\s+(\d+)\s+"(.*)"\s*$', text, flags=re.MULTILINE)
    return {(int(dim), int(tag)): name for dim, tag, name in found}


def _entities(numbers: _Numbers) -> dict[tuple[int, int], list[int]]:
    physical = {}
    for dim, count in enumerate(numbers.take(4, "u8")):
        for _ in range(count):
            tag = int(numbers.take(1, "i4")[0])
            numbers.take(3 if dim == 0 else 6, "f8")
            groups = numbers.take(int(numbers.take(1, "u8")[0]), "i4")
            physical[dim, tag] = sorted({abs(int(group)) for group in groups})
            if dim > 0:
                numbers.take(int(numbers.take(1, "u8")[0]), "i4")
    return physical


def _nodes_41(numbers: _Numbers) -> tuple[IntArray, NDArray[np.float64]]:
    tags, points = [np.empty(0, np.int64)], [np.empty((0, 3))]
    for _ in range(int(numbers.take(4, "u8")[0])):
        dim, _, parametric = numbers.take(3, "i4")
        count = int(numbers.take(1, "u8")[0])
        tags.append(numbers.take(count, "u8"))
        width = 3 + (int(dim) if parametric else 0)
        points.append(numbers.take(count * width, "f8").reshape(count, width)[:, :3])
    return np.concatenate(tags), np.concatenate(points)


def _nodes_22(numbers: _Numbers, count: int, binary: bool) -> tuple[IntArray, NDArray[np.float64]]:
    if binary:
        rows = numbers.records(count, [("tag", "<i4"), ("x", "<f8", 3)])
        return rows["tag"].astype(np.int64), rows["x"]
    table = numbers.take(4 * count, "f8").reshape(count, 4)
    return table[:, 0].astype(np.int64), table[:, 1:]


def _node_count(kind: int) -> int:
    if kind not in _NODES_OF:
        raise MeshError(f"Gmsh element type {kind} is not supported")
    return _NODES_OF[kind]


def _elements_41(
    numbers: _Numbers, physical: dict[tuple[int, int], list[int]]
) -> list[_ElementGroup]:
    blocks = []
    for _ in range(int(numbers.take(4, "u8")[0])):
        dim, entity, kind = (int(value) for value in numbers.take(3, "i4"))
        count, width = int(numbers.take(1, "u8")[0]), 1 + _node_count(kind)
        table = numbers.take(count * width, "u8").reshape(count, width)
        blocks.append(_ElementGroup(kind, physical.get((dim, entity), []), table[:, 1:]))
    return blocks


def _elements_22(numbers: _Numbers, count: int, binary: bool) -> list[_ElementGroup]:
    """Records of one type and tag count come in runs; a run is cut up by physical group."""
    blocks: list[_ElementGroup] = []
    done = 0
    while done < count:
        if binary:
            kind, run, n_tags = (int(value) for value in numbers.take(3, "i4"))
            width = 1 + n_tags + _node_count(kind)
            table = numbers.take(run * width, "i4").reshape(run, width)
            lead = 1
        else:
            rest = numbers.rest()
            if len(rest) < 3:
                raise MeshError("a section ends early")
            kind, n_tags = int(rest[1]), int(rest[2])
            lead, width = 3, 3 + n_tags + _node_count(kind)
            most = min(len(rest) // width, count - done)
            rows = rest[: most * width].reshape(most, width)
            same = (rows[:, 1] == kind) & (rows[:, 2] == n_tags)
            run = most if same.all() else int(np.argmin(same))
            table = numbers.take(run * width, "u8").reshape(run, width)
        if run < 1:
            raise MeshError("a section ends early")
        groups = np.abs(table[:, lead]) if n_tags else np.zeros(run, np.int64)
        for group in np.unique(groups):
            corners = table[groups == group, lead + n_tags :]
            blocks.append(_ElementGroup(kind, [int(group)] if group else [], corners))
        done += run
    return blocks


def _assemble(
    tags: IntArray,
    points: NDArray[np.float64],
    blocks: list[_ElementGroup],
    names: dict[tuple[int, int], str],
) -> MshData:
    if len(tags) == 0:
        raise MeshError("it holds no nodes")
    order = np.argsort(tags)
    known = tags[order]
    tets = [np.empty((0, 4), np.int64)]
    nodes: dict[str, list[IntArray]] = {}
    cells: dict[str, list[IntArray]] = {}
    first = 0
    for block in blocks:
        found = np.minimum(np.searchsorted(known, block.corners), len(known) - 1)
        if (known[found] != block.corners).any():
            raise MeshError("elements refer to nodes that it does not hold")
        corners = order[found]
        dim = _LOW_DIM.get(block.kind, 3)
        if dim == 3 and block.kind not in _TETRAHEDRA:
            raise MeshError(f"it holds {len(corners)} solids that are not tetrahedra")
        for group in block.physical:
            name = names.get((dim, group), f"physical_{dim}_{group}")
            if dim == 3:
                cells.setdefault(name, []).append(np.arange(first, first + len(corners)))
            else:
                nodes.setdefault(name, []).append(corners.ravel())
        if dim == 3:
            tets.append(corners[:, :4])
            first += len(corners)
    return MshData(
        points,
        np.concatenate(tets),
        {name: np.concatenate(parts) for name, parts in nodes.items()},
        {name: np.concatenate(parts) for name, parts in cells.items()},
    )


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
    name: str
    nodes: NDArray[np.integer]
    """Corners of each element, counted from 1, shape (e, 1), (e, 3) or (e, 4)."""


def write_msh(mesh: TetMesh, path: Path, version: MshVersion = "4.1") -> None:
    """Write `mesh` to `path` in metres.

    Raises:
        MeshError: If the version is unknown.
    """
    if version not in ("4.1", "2.2"):
        raise MeshError(f"unknown .msh version {version!r}; known: 4.1, 2.2")
    blocks = list(_blocks(mesh))
    names = sorted({(b.dim, b.physical, b.name) for b in blocks if b.physical})
    out = StringIO()
    out.write(f"$MeshFormat\n{version} 0 8\n$EndMeshFormat\n$PhysicalNames\n{len(names)}\n")
    for dim, tag, name in names:
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
    for tag, (name, members) in enumerate(mesh.node_groups.items(), start=1):
        inside = np.zeros(mesh.n_points, dtype=bool)
        inside[members] = True
        triangles = faces[inside[faces].all(axis=1)]
        if len(triangles):
            yield _Block(2, tag, tag, name, triangles + 1)
        for node in np.setdiff1d(members, triangles):
            points += 1
            yield _Block(0, points, tag, name, np.array([[node + 1]]))
    free = np.ones(mesh.n_tets, dtype=bool)
    for tag, (name, members) in enumerate(mesh.cell_groups.items(), start=1):
        free[members] = False
        if len(members):
            yield _Block(3, tag, tag, name, mesh.tets[members] + 1)
    if free.any():
        yield _Block(3, len(mesh.cell_groups) + 1, 0, "", mesh.tets[free] + 1)


def _write_41(out: StringIO, mesh: TetMesh, blocks: list[_Block]) -> None:
    out.write("$Entities\n")
    out.write(" ".join(str(sum(b.dim == dim for b in blocks)) for dim in range(4)) + "\n")
    for block in sorted(blocks, key=lambda b: (b.dim, b.entity)):
        corners = mesh.points[block.nodes.ravel() - 1]
        bounds = [corners.min(axis=0), corners.max(axis=0)][: 1 if block.dim == 0 else 2]
        position = " ".join(f"{value:.16g}" for value in np.ravel(bounds))
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
