"""Meshes that bones move: bodies of the SMPL family, glTF files, and any other rigged mesh.

Each is one connected surface whose vertices are replaced at every step. Model files of the SMPL
family are the user's, see :mod:`capsense.humans.formats`.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense._validate import suggest
from capsense.errors import SceneError
from capsense.scene import DeformableSurface, Pose
from capsense.scene.materials import Grounding, Material

Array = NDArray[np.float64]


def smplx_surface(
    model: Any,
    output: Any = None,
    *,
    material: Material | str = "human",
    grounding: Grounding = 100e-12,
    name: str | None = None,
) -> DeformableSurface:
    """A deforming surface from a model of the ``smplx`` package: SMPL, SMPL-H, SMPL-X, MANO, FLAME.

    ``surface.update(model(...).vertices, pose)`` poses it. Openings, such as the wrist of MANO and
    the eye sockets of SMPL-X, stay open: a person is a conductor, whose inside does not count.

    Args:
        model: What ``smplx.create`` returns: it has ``faces``, and is called for a pose.
        output: What the model returned for the person's shape in its rest pose, with the limbs
            away from each other; by default that of ``model()``.
        material: As for :class:`~capsense.scene.scene.Body`.
        grounding: Of the whole person.
        name: As for :class:`~capsense.scene.scene.Body`.

    Raises:
        SceneError: The model has no faces, gives no vertices, or those of several persons.
    """
    if getattr(model, "faces", None) is None:
        raise SceneError(
            f"model is a {type(model).__name__} without faces; pass what smplx.create returns"
        )
    made = model() if output is None else output
    vertices = getattr(made, "vertices", None)
    if vertices is None:
        raise SceneError(
            f"the model gave a {type(made).__name__} without vertices; call it with "
            "return_verts=True"
        )
    points = np.asarray(vertices.detach().cpu() if hasattr(vertices, "detach") else vertices, float)
    if points.ndim == 3 and len(points) != 1:
        raise SceneError(
            f"the model gave vertices of {len(points)} persons; make a surface for each, from "
            "vertices[k]"
        )
    faces = np.asarray(model.faces).astype(np.int64)
    return DeformableSurface(
        points.reshape(-1, 3), faces, material=material, grounding=grounding, name=name
    )


@dataclass(frozen=True, eq=False)
class RiggedMesh:
    """A triangle mesh that follows bones by linear-blend skinning.

    Attributes:
        vertices: At rest [m], shape (n, 3).
        faces: Vertex indices, shape (m, 3).
        bones: Names of the bones.
        parents: Parent of each bone, -1 for none; it comes before the bone, shape (b,).
        local: Transform of each bone at rest in the frame of its parent, shape (b, 4, 4).
        inverse: From the mesh's frame to that of each bone at rest, shape (b, 4, 4).
        weights: How much each vertex follows each bone, rows add to 1, shape (n, b).
    """

    vertices: Array
    faces: NDArray[np.int64]
    bones: tuple[str, ...]
    parents: tuple[int, ...]
    local: Array
    inverse: Array
    weights: Array

    def posed(self, turns: Mapping[str, ArrayLike] | None = None) -> Array:
        """Vertices with bones turned about their origins, from the rest pose, shape (n, 3).

        Args:
            turns: Rotation matrices (3, 3), or rotation vectors [rad] (3,), by name of the bone,
                in its own frame.

        Raises:
            SceneError: No such bone, or something that is no rotation.
        """
        given = dict(turns or {})
        for bone in given:
            if bone not in self.bones:
                raise SceneError(f"the mesh has no bone {bone!r}; {suggest(bone, self.bones)}")
        world = np.empty_like(self.local)
        for k, (bone, parent) in enumerate(zip(self.bones, self.parents, strict=True)):
            own = self.local[k].copy()
            if bone in given:
                own[:3, :3] = own[:3, :3] @ _rotation(bone, given[bone])
            world[k] = own if parent < 0 else world[parent] @ own
        return self.skinned(world)

    def skinned(self, transforms: ArrayLike) -> Array:
        """Vertices [m] with the bones where a simulator or an animation has them, shape (n, 3).

        Args:
            transforms: Of each bone to the frame wanted, shape (b, 4, 4).

        Raises:
            SceneError: Another shape, or numbers that are not finite.
        """
        world = np.asarray(transforms, float)
        if world.shape != self.local.shape or not np.isfinite(world).all():
            raise SceneError(
                f"transforms have shape {world.shape}; give finite numbers of shape "
                f"{self.local.shape}, one transform a bone"
            )
        moves = (world @ self.inverse)[:, :3]
        whole = np.concatenate([self.vertices, np.ones((len(self.vertices), 1))], axis=1)
        out = np.zeros_like(self.vertices)
        for share, move in zip(self.weights.T, moves, strict=True):
            some = np.flatnonzero(share)
            out[some] += share[some, None] * (whole[some] @ move.T)
        return out

    def surface(self, **options: Any) -> DeformableSurface:
        """The mesh at rest as a surface; ``surface.update(mesh.posed(...), pose)`` poses it.

        Args:
            **options: As for :class:`~capsense.scene.scene.DeformableSurface`.
        """
        return DeformableSurface(self.vertices, self.faces, **options)


def _rotation(bone: str, given: ArrayLike) -> Array:
    turn = np.asarray(given, float)
    if turn.shape == (3,) and np.isfinite(turn).all():
        angle = float(np.linalg.norm(turn))
        half = np.append(turn / max(angle, 1e-300) * np.sin(angle / 2), np.cos(angle / 2))
        return Pose((0.0, 0.0, 0.0), tuple(half)).rotation
    if turn.shape == (3, 3) and np.allclose(turn @ turn.T, np.eye(3), atol=1e-6):
        return turn
    raise SceneError(
        f"the turn of bone {bone!r} is {np.array2string(turn, threshold=9)}; give a rotation "
        "vector [rad] of three numbers, or a rotation matrix"
    )


# -- glTF -----------------------------------------------------------------------------------------

_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


def load_gltf(path: str | Path, mesh: str | None = None) -> RiggedMesh:
    """A mesh with a skin from a glTF 2.0 file, ``.glb`` or ``.gltf``.

    All triangles of the mesh become one surface; vertices at one place with the same weights,
    which files split for normals and textures, become one. Sparse and compressed data, and morph
    targets, are not read.

    Args:
        path: The file.
        mesh: Name of the node or mesh, where several have skins.

    Raises:
        SceneError: No such file, no mesh with a skin, several without ``mesh``, or something that
            is not read.
    """
    file = Path(path)
    if not file.is_file():
        raise SceneError(f"path is {file}; there is no such file")
    try:
        tree, buffers = _opened(file)
        return _rigged(file, tree, buffers, mesh)
    except (KeyError, IndexError, ValueError, struct.error, OSError) as error:
        raise SceneError(f"{file} is no glTF 2.0 file that can be read: {error!r}") from None


def _opened(file: Path) -> tuple[dict[str, Any], list[bytes]]:
    """The JSON of a file, and its buffers."""
    data, own = file.read_bytes(), b""
    if data[:4] == b"glTF":
        length = struct.unpack_from("<I", data, 12)[0]
        own = data[28 + length :]
        data = data[20 : 20 + length]
    tree = json.loads(data)
    buffers = []
    for buffer in tree.get("buffers", []):
        uri = buffer.get("uri")
        if uri is None:
            buffers.append(own)
        elif uri.startswith("data:"):
            buffers.append(base64.b64decode(uri.split(",", 1)[1]))
        else:
            buffers.append((file.parent / uri).read_bytes())
    return tree, buffers


def _array(tree: dict[str, Any], buffers: list[bytes], number: int) -> NDArray[Any]:
    """An accessor as an array (count, width); normalised integers as fractions."""
    accessor = tree["accessors"][number]
    if "sparse" in accessor or "bufferView" not in accessor:
        raise ValueError("sparse or compressed data")
    view = tree["bufferViews"][accessor["bufferView"]]
    kind, width = np.dtype(_TYPES[accessor["componentType"]]), _WIDTHS[accessor["type"]]
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    pitch = view.get("byteStride", kind.itemsize * width)
    out = np.ndarray(
        (accessor["count"], width), kind, buffers[view["buffer"]], start, (pitch, kind.itemsize)
    )
    if accessor.get("normalized"):
        return np.asarray(out / np.iinfo(kind).max)
    return out.copy()


def _local(node: dict[str, Any]) -> Array:
    """Transform of a node in the frame of its parent."""
    if "matrix" in node:
        return np.array(node["matrix"], float).reshape(4, 4).T
    out = np.eye(4)
    turn = Pose((0.0, 0.0, 0.0), tuple(node.get("rotation", (0.0, 0.0, 0.0, 1.0)))).rotation
    out[:3, :3] = turn * node.get("scale", (1.0, 1.0, 1.0))
    out[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return out


def _rigged(file: Path, tree: dict[str, Any], buffers: list[bytes], mesh: str | None) -> RiggedMesh:
    nodes = tree["nodes"]
    found = {
        n.get("name") or tree["meshes"][n["mesh"]].get("name") or f"node {k}": n
        for k, n in enumerate(nodes) if "mesh" in n and "skin" in n
    }  # fmt: skip
    if not found or (mesh is None and len(found) > 1) or (mesh is not None and mesh not in found):
        wanted = "no mesh with a skin" if not found else f"meshes with skins named {list(found)}"
        raise SceneError(f"{file} has {wanted}; mesh is {mesh!r}; name one of the file's")
    node = found[mesh] if mesh is not None else next(iter(found.values()))
    skin, points, faces, weights, first = tree["skins"][node["skin"]], [], [], [], 0
    joints = skin["joints"]
    for part in tree["meshes"][node["mesh"]]["primitives"]:
        if part.get("mode", 4) != 4 or part.get("extensions"):
            raise ValueError("a part that is no list of plain triangles")
        names = part["attributes"]
        points.append(_array(tree, buffers, names["POSITION"]))
        count = len(points[-1])
        share = np.zeros((count, len(joints)))
        for k in range(len([n for n in names if n.startswith("JOINTS_")])):
            bone = _array(tree, buffers, names[f"JOINTS_{k}"]).astype(np.int64)
            at = np.arange(count)[:, None] + 0 * bone
            np.add.at(share, (at, bone), _array(tree, buffers, names[f"WEIGHTS_{k}"]))
        weights.append(share / share.sum(axis=1, keepdims=True))
        corner = _array(tree, buffers, part["indices"]) if "indices" in part else np.arange(count)
        faces.append(corner.reshape(-1, 3).astype(np.int64) + first)
        first += count
    parent = {child: k for k, n in enumerate(nodes) for child in n.get("children", [])}
    above = {k: parent.get(k, -1) for k in joints}
    local = {k: _local(nodes[k]) for k in joints}
    order: list[int] = []
    for k in joints:  # what hangs between two joints, or above the first one, is part of a joint
        while above[k] >= 0 and above[k] not in local:
            local[k] = _local(nodes[above[k]]) @ local[k]
            above[k] = parent.get(above[k], -1)
    while len(order) < len(joints):
        order += [k for k in joints if k not in order and (above[k] < 0 or above[k] in order)]
    place = {k: order.index(k) for k in order}
    of = [joints.index(k) for k in order]
    inverse = np.tile(np.eye(4), (len(joints), 1, 1))
    if "inverseBindMatrices" in skin:
        rows = _array(tree, buffers, skin["inverseBindMatrices"]).astype(float)
        inverse = rows.reshape(-1, 4, 4).transpose(0, 2, 1)
    whole = np.concatenate([np.concatenate(points).astype(float), np.concatenate(weights)], axis=1)
    _, kept, number = np.unique(np.round(whole, 7), axis=0, return_index=True, return_inverse=True)
    corners: NDArray[np.int64] = number.reshape(-1)[np.concatenate(faces)]
    alike = (corners == np.roll(corners, 1, axis=1)).any(axis=1)
    return RiggedMesh(
        whole[kept, :3], corners[~alike], tuple(nodes[k].get("name", f"joint {k}") for k in order),
        tuple(-1 if above[k] < 0 else place[above[k]] for k in order),
        np.stack([local[k] for k in order]), inverse[of], whole[kept, 3:][:, of],
    )  # fmt: skip
