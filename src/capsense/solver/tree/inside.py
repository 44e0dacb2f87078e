"""What the inside of a surface that deforms sets against charge, from the form it had first.

Cloth bends and hardly stretches. What a thin sheet sets against charge that moves along it depends
on lengths within the sheet alone, and not at all on its scale, so that it stays while cloth bends,
folds, or grows evenly. That of a solid stays as far as its form does.
"""

from __future__ import annotations

import math
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

from capsense.scene import RestSurface, TriMesh
from capsense.scene.surface import enclosed_volume
from capsense.solver.bodies.blocks import free_block, impedance
from capsense.solver.bodies.panels import SurfacePanels, panels_of
from capsense.solver.tree.dynamic_surface import PieceLayout, layout_of, normals_of
from capsense.solver.tree.rigid import HALF_SPACE, Clusters, features

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Ints = NDArray[np.int64]

_FUNCTIONS = 800
"""So many charge functions, the coarsest, have a known impedance."""
_NODES, _REFINED = 500, 4
"""The mesh of a sheet is refined until it has so many nodes, so often at most."""
_APART = 1e3
"""Impedance between unconnected parts of a sheet, over the mean of the diagonal."""
_PANELS = 700
"""Panels from which that of a solid is found."""
_PLANAR = 1e-9
"""Least area of a triangle over the square of its longest edge."""

_TABLES: WeakKeyDictionary[RestSurface, Array32 | None] = WeakKeyDictionary()


def table_of(rest: RestSurface) -> Array32 | None:
    """Impedance of the charge functions of a surface that deforms; worked out once.

    Returns:
        Shape (f, f): of an open sheet Z, over the scale of lengths as ``BODY`` has them; of a
        closed surface what Z has beyond :data:`HALF_SPACE` times the energies. None where the
        triangles are not connected, as of point clouds.
    """
    if rest not in _TABLES:
        _TABLES[rest] = _solid(rest) if rest.closed else _sheet(rest)
    return _TABLES[rest]


# -- thin sheets ----------------------------------------------------------------------------------


def _sheet(rest: RestSurface) -> Array32 | None:
    """Z of a thin sheet of thickness t, 4π/t times the inverse of its Laplacian.

    A charge x per area flows into the sheet as a current of polarisation J, ∇·J = −x, of energy
    4π/(t (eps − 1)) ∫ J² dA, and not over its rim. Finite elements of first order on its triangles.
    """
    layout = layout_of(rest)
    mesh = _welded(rest.vertices), rest.faces
    v, faces = mesh[0][0], mesh[0][1][mesh[1]]
    nodes = _shares(layout)
    place = layout.face
    for _ in range(_REFINED):
        if len(v) >= _NODES:
            break
        v, faces, place, nodes = _refined(v, faces, place, nodes)
    whole = _laplacian(v, faces)
    count, part = connected_components(whole, directed=False)
    used = np.unique(faces)
    if len(np.unique(part[used])) > max(1, len(rest.faces) // 4):
        return None
    rows = np.repeat(np.arange(len(place)), 3)
    spread = csr_array((nodes.ravel(), (rows, faces[place].ravel())), (len(place), len(v)))
    means, area = _cluster_means(layout, spread)
    load = _differences(layout.tree, means, area)
    first = np.unique(part, return_index=True)[1]
    free = np.setdiff1d(np.arange(len(v)), first)
    factor = splu(csc_array(whole[free][:, free]))
    right = np.ascontiguousarray(load[:, free].T)
    z = right.T @ factor.solve(right)
    z *= 4.0 * math.pi / rest.thickness
    if len(first) > 1:  # charge does not cross
        net = np.stack([load[:, part == p].sum(axis=1) for p in range(count)], axis=1)
        z += _APART * float(np.diag(z).mean()) * net @ net.T
    out = np.zeros((len(z), len(z)), np.float32)
    out[1:, 1:] = 0.5 * (z + z.T)[1:, 1:]
    return out


def _welded(vertices: Array) -> tuple[Array, Ints]:
    """Vertices without those that coincide, and which of them each was."""
    grain = 1e-7 * float(np.ptp(vertices, axis=0).max())
    keys = np.round(vertices / grain).astype(np.int64)
    _, first, place = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return vertices[first], place.reshape(-1).astype(np.int64)


def _shares(layout: PieceLayout) -> Array:
    """Middles of the pieces as shares of their triangles' corners, shape (n, 3)."""
    if not len(layout.shares):
        return np.full((len(layout.face), 3), 1.0 / 3.0)
    return np.asarray(layout.shares.mean(axis=1))


def _refined(v: Array, faces: Ints, place: Ints, share: Array) -> tuple[Array, Ints, Ints, Array]:
    """Cut triangles into four; find the points that lie in them, given by shares, again."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, at = np.unique(edges, axis=0, return_inverse=True)
    a, b, c = (len(v) + at.reshape(-1, 3)).T
    x, y, z = faces.T
    parts = ((x, a, c), (a, y, b), (c, b, z), (a, b, c))
    corner = np.where(share.max(axis=1) > 0.5, share.argmax(axis=1), 3)
    new = 2.0 * share
    row = np.flatnonzero(corner < 3)
    new[row, corner[row]] -= 1.0
    middle = corner == 3
    new[middle] = 1.0 - 2.0 * share[middle][:, [2, 0, 1]]
    return (
        np.concatenate([v, v[unique].mean(axis=1)]),
        np.concatenate([np.stack(p, axis=1) for p in parts]),
        corner * len(faces) + place, new,
    )  # fmt: skip


def _laplacian(v: Array, faces: Ints) -> csr_array:
    """Stiffness matrix of linear elements on triangles (the cotangents of their angles)."""
    corners = v[faces]
    sides = np.roll(corners, -1, axis=1) - np.roll(corners, 1, axis=1)  # against each corner
    double = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    double = np.maximum(double, _PLANAR * (sides**2).sum(axis=2).max(axis=1))
    values = (sides[:, :, None] * sides[:, None, :]).sum(axis=3) / (2.0 * double)[:, None, None]
    rows, columns = np.repeat(faces, 3, axis=1), np.tile(faces, (1, 3))
    out = coo_array((values.ravel(), (rows.ravel(), columns.ravel())), (len(v), len(v)))
    lone = np.setdiff1d(np.arange(len(v)), faces)
    return csr_array(out.tocsr() + coo_array((np.ones(len(lone)), (lone, lone)), out.shape).tocsr())


def _cluster_means(layout: PieceLayout, spread: csr_array) -> tuple[Array, Array]:
    """Means over the first clusters of what pieces carry to nodes, (k, nodes), and areas (k,)."""
    tree = layout.tree
    areas = _areas(layout)
    count = min(2 * min(len(areas), _FUNCTIONS) - 1, len(tree.children))
    parent = np.zeros(len(tree.children), np.int64)
    wholes = np.flatnonzero(tree.panel < 0)
    parent[tree.children[wholes]] = wholes[:, None]
    at = np.flatnonzero(tree.panel >= 0)
    piece, rows, columns = tree.panel[at], [], []
    while True:
        known = at < count
        rows.append(at[known])
        columns.append(piece[known])
        going = at > 0
        if not going.any():
            break
        at, piece = parent[at[going]], piece[going]
    row, column = np.concatenate(rows), np.concatenate(columns)
    member = csr_array((areas[column], (row, column)), (count, len(areas)))
    area = np.asarray(member.sum(axis=1)).ravel()
    return np.asarray((diags_array(1.0 / area) @ member @ spread).toarray()), area


def _areas(layout: PieceLayout) -> Array:
    """Areas of the pieces of a surface in its first form, shape (n,)."""
    corners = layout.first
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double = np.linalg.norm(cross, axis=1)
    return np.maximum(double, 1e-9 * double.mean()) / 2


def _differences(tree: Clusters, means: Array, area: Array) -> Array:
    """What functions carry to nodes, from that of clusters: (k, nodes) -> (f, nodes)."""
    wholes = np.flatnonzero(tree.panel < 0)
    wholes = wholes[tree.children[wholes].max(axis=1) < len(area)]
    functions = tree.function[wholes]
    out = np.zeros((int(functions.max(initial=0)) + 1, means.shape[1]))
    first, second = tree.children[wholes].T
    out[functions] = means[first] - means[second]
    return out


# -- solids ---------------------------------------------------------------------------------------


def _solid(rest: RestSurface) -> Array32:
    """Z − 2F of a closed surface: smooth, so that it follows from a few panels."""
    layout = layout_of(rest)
    panels = panels_of(TriMesh(rest.vertices, rest.faces), _PANELS)
    with threadpool_limits(1, "blas"):  # bits depend on how many threads a BLAS has
        free = free_block(panels)
        more = impedance(panels, free) - HALF_SPACE * free
    return _carried(panels, more, layout, rest)


def _carried(
    panels: SurfacePanels, block: Array, layout: PieceLayout, rest: RestSurface
) -> Array32:
    """A block of some panels (p, p) on the charge functions of a surface, (f, f)."""
    corners = layout.first
    normals = normals_of(corners)
    if enclosed_volume(rest.vertices, rest.faces) < 0.0:  # they wind the other way round
        normals = -normals
    on = cKDTree(features(panels.centers, panels.normals)).query(
        features(corners.mean(axis=1), normals)
    )[1]
    shares = csr_array((np.ones(len(on)), (np.arange(len(on)), on)), (len(on), len(panels)))
    means, area = _cluster_means(layout, shares)
    load = _differences(layout.tree, means, area)
    out = np.asarray(load @ block @ load.T)
    out[0] = out[:, 0] = 0.0
    return np.ascontiguousarray(0.5 * (out + out.T), np.float32)
