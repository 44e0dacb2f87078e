"""Meshes that follow bones: the smplx package's models, glTF files, linear-blend skinning."""

from __future__ import annotations

import json
import struct
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rigged import rig
from scipy.spatial.transform import Rotation

import capsense as cs
from capsense.humans import RiggedMesh, load_gltf, smplx_surface

Array = NDArray[np.float64]


class Model:
    """A stand-in of what ``smplx.create`` returns, of MANO's size."""

    faces = rig(hand_only=True).faces.astype(np.uint32)

    def __init__(self, persons: int = 1) -> None:
        self.persons = persons

    def __call__(self, return_verts: bool = True) -> Any:
        import torch

        vertices = torch.tensor(rig(hand_only=True).vertices, dtype=torch.float32)
        whole = vertices.repeat(self.persons, 1, 1).requires_grad_()
        return types.SimpleNamespace(vertices=whole if return_verts else None)


def test_a_model_of_smplx() -> None:
    """The surface has the model's vertices and faces; tensors with gradients pose it."""
    pytest.importorskip("torch")
    model = Model()
    surface = smplx_surface(model, name="hand")
    np.testing.assert_array_equal(surface.faces, model.faces)
    np.testing.assert_allclose(surface.vertices, rig(hand_only=True).vertices, atol=1e-6)
    assert surface.grounding == 100e-12
    moved = model().vertices * 1.01
    body = surface.update(moved, cs.Pose((0.0, 0.0, 0.2)))
    np.testing.assert_array_equal(body.shape.vertices, moved.detach().numpy()[0])
    assert (body.name, body.pose.position[2]) == ("hand", 0.2)
    with pytest.raises(cs.SceneError, match="vertices of 3 persons"):
        smplx_surface(Model(3))
    with pytest.raises(cs.SceneError, match="return_verts=True"):
        smplx_surface(model, model(return_verts=False))
    with pytest.raises(cs.SceneError, match="object without faces"):
        smplx_surface(object())


def test_updates_are_checked() -> None:
    """Another topology and numbers that are not finite are refused; the surface stays as it was."""
    hand = rig(hand_only=True)
    surface = cs.DeformableSurface(hand.vertices, hand.faces)
    wrong = hand.vertices.copy()
    wrong[7, 1] = np.nan
    for vertices, words in (
        (hand.vertices[:-1], "make a new one"),
        (wrong, "finite"),
        (np.stack([hand.vertices] * 2), "shape"),
    ):
        with pytest.raises(cs.SceneError, match=words):
            surface.update(vertices)
    with pytest.raises(cs.SceneError, match="Pose"):
        surface.update(hand.vertices, (0.0, 0.0, 0.1))  # type: ignore[arg-type]
    np.testing.assert_array_equal(surface.vertices, hand.vertices)


def glb(path: Path) -> None:
    """A tube along x of two bones as a binary file; its last ring comes twice."""
    turn = np.arange(6) * np.pi / 3
    x = np.repeat(np.linspace(0.0, 0.2, 5), 6)
    vertices = np.stack([x, 0.02 * np.tile(np.cos(turn), 5), 0.02 * np.tile(np.sin(turn), 5)], 1)
    faces = []
    for k in range(4):
        for i in range(6):
            a, b = 6 * k + i, 6 * k + (i + 1) % 6
            faces += [[a, b, b + 6], [a, b + 6, a + 6]]
    share = np.clip(x / 0.2, 0.0, 1.0)
    weights = np.stack([1 - share, share, 0 * share, 0 * share], axis=1)
    corners = np.array(faces)
    vertices, weights = (np.concatenate([a, a[24:]]) for a in (vertices, weights))
    corners[-6:][corners[-6:] >= 24] += 6
    joints = np.tile(np.array([1, 0, 0, 0], np.uint8), (len(vertices), 1))
    inverse = np.tile(np.eye(4), (2, 1, 1))
    inverse[0, 0, 3] = -0.1  # joint 0 of the skin is the far bone
    blocks = [
        (vertices.astype("<f4"), "VEC3", 5126), (joints, "VEC4", 5121),
        (np.round(65535 * weights).astype("<u2"), "VEC4", 5123),
        (corners.astype("<u2").reshape(-1, 1), "SCALAR", 5123),
        (inverse.transpose(0, 2, 1).astype("<f4").reshape(2, 16), "MAT4", 5126),
    ]  # fmt: skip
    views, accessors, data = [], [], b""
    for k, (block, kind, code) in enumerate(blocks):
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": block.nbytes})
        accessors.append({"bufferView": k, "componentType": code, "count": len(block),
                          "type": kind, "normalized": code == 5123 and k == 2})  # fmt: skip
        data += block.tobytes() + bytes(-block.nbytes % 4)
    tree = {
        "asset": {"version": "2.0"}, "buffers": [{"byteLength": len(data)}],
        "bufferViews": views, "accessors": accessors,
        "meshes": [{"name": "tube", "primitives": [
            {"attributes": {"POSITION": 0, "JOINTS_0": 1, "WEIGHTS_0": 2}, "indices": 3}]}],
        "skins": [{"joints": [1, 0], "inverseBindMatrices": 4}],
        "nodes": [{"name": "near", "children": [1]},
                  {"name": "far", "translation": [0.1, 0.0, 0.0]}, {"mesh": 0, "skin": 0}],
    }  # fmt: skip
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(data))
    path.write_bytes(head + struct.pack("<I4s", len(text), b"JSON") + text
                     + struct.pack("<I4s", len(data), b"BIN\0") + data)  # fmt: skip


def test_a_gltf_file(tmp_path: Path) -> None:
    """Analytic: a tube bends about its middle; split vertices become one."""
    glb(tmp_path / "tube.glb")
    mesh = load_gltf(tmp_path / "tube.glb")
    assert (mesh.bones, mesh.parents) == (("near", "far"), (-1, 0))
    assert (len(mesh.vertices), len(mesh.faces)) == (30, 48)
    np.testing.assert_allclose(mesh.posed(), mesh.vertices, atol=1e-7)
    turn = Rotation.from_rotvec([0.0, 0.0, 1.1]).as_matrix()
    middle = np.array([0.1, 0.0, 0.0])
    moved = (mesh.vertices - middle) @ turn.T + middle
    part = np.clip(mesh.vertices[:, :1] / 0.2, 0.0, 1.0)
    wanted = (1 - part) * mesh.vertices + part * moved
    for given in ([0.0, 0.0, 1.1], turn):
        np.testing.assert_allclose(mesh.posed({"far": given}), wanted, atol=1e-5)
    ends = cs.TriMesh(mesh.vertices, mesh.faces).bounds()
    np.testing.assert_allclose(ends[:, 0], [0.0, 0.2], atol=1e-7)
    surface = mesh.surface(material="steel")
    surface.update(wanted)
    np.testing.assert_allclose(surface.vertices, wanted)
    with pytest.raises(cs.SceneError, match="no bone 'fra'; did you mean 'far'"):
        mesh.posed({"fra": [0.0, 0.0, 0.0]})
    with pytest.raises(cs.SceneError, match="rotation vector"):
        mesh.posed({"far": 2.0 * np.eye(3)})
    with pytest.raises(cs.SceneError, match="one transform a bone"):
        mesh.skinned(np.eye(4))


def test_files_that_are_none(tmp_path: Path) -> None:
    """What is not read is said to be so."""
    with pytest.raises(cs.SceneError, match="no such file"):
        load_gltf(tmp_path / "none.glb")
    (tmp_path / "bad.gltf").write_text('{"nodes": [{"mesh": 0}]}')
    with pytest.raises(cs.SceneError, match="no mesh with a skin"):
        load_gltf(tmp_path / "bad.gltf")
    (tmp_path / "worse.glb").write_bytes(b"glTF")
    with pytest.raises(cs.SceneError, match=r"no glTF 2\.0 file"):
        load_gltf(tmp_path / "worse.glb")
    glb(tmp_path / "tube.glb")
    with pytest.raises(cs.SceneError, match="named \\['tube'\\]"):
        load_gltf(tmp_path / "tube.glb", "arm")


def test_a_rig_of_ones_own_follows_its_bones() -> None:
    """Differential: the hand's own skinning against :class:`RiggedMesh`."""
    hand = rig(hand_only=True)
    names = tuple(b.name for b in hand.bones)
    parents = tuple(names.index(b.parent) if b.parent else -1 for b in hand.bones)
    starts = np.array([b.start for b in hand.bones])
    local, inverse = (np.tile(np.eye(4), (len(names), 1, 1)) for _ in range(2))
    for k, parent in enumerate(parents):
        local[k, :3, 3] = starts[k] - (starts[parent] if parent >= 0 else 0.0)
        inverse[k, :3, 3] = -starts[k]
    mesh = RiggedMesh(hand.vertices, hand.faces, names, parents, local, inverse, hand.weights)
    turns = {"right_index_0": (5.0, -60.0, 3.0), "wrist": (10.0, 0.0, -20.0)}
    found = mesh.posed({k: np.radians(v) for k, v in turns.items()})
    np.testing.assert_allclose(found, hand.posed(turns), atol=1e-12)
