"""Body meshes of the SMPL family, from model files that the user has.

The files are licensed by their makers and are not part of CapSense: see smpl-x.is.tue.mpg.de.
"""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense._validate import suggest
from capsense.errors import MissingDependencyError, SceneError
from capsense.scene import TriMesh

Array = NDArray[np.float64]


def load_smplx(
    model_path: str | Path,
    *,
    model_type: str = "smplx",
    gender: str = "neutral",
    **parameters: ArrayLike,
) -> TriMesh:
    """A body of the SMPL family as a solid.

    Its frame is that of the model: y up, z forwards, metres, origin near the chest or pelvis.
    Openings, such as the eye sockets of SMPL-X, are closed with flat fans.

    Args:
        model_path: A model file, or the folder that holds the models, as ``smplx.create`` takes.
        model_type: ``"smplx"``, ``"smplh"``, ``"smpl"``, ``"mano"`` …, as ``smplx.create`` takes.
        gender: ``"neutral"``, ``"female"`` or ``"male"``.
        **parameters: What the model is called with: ``betas``, ``body_pose``, ``global_orient``,
            ``transl`` …; each of the shape that the model wants, without the batch axis.

    Raises:
        MissingDependencyError: ``smplx`` is not installed.
        SceneError: The model files are not there, or the model has no such parameter, or one of
            another size.
    """
    try:
        import smplx
        import torch
    except ImportError:
        raise MissingDependencyError(
            "smplx is not installed; pip install smplx torch, and get the model files from "
            "smpl-x.is.tue.mpg.de"
        ) from None
    path = Path(model_path)
    if not path.exists():
        raise SceneError(f"model_path is {path}; there are no model files; give their folder")
    try:
        model = smplx.create(str(path), model_type=model_type, gender=gender)
    except (AssertionError, OSError, ValueError, KeyError) as error:
        raise SceneError(f"{path} holds no {gender} {model_type} model: {error}") from None
    known = inspect.signature(model.forward).parameters.values()
    names = [p.name for p in known if p.default is None]  # others are switches, or **kwargs
    tensors: dict[str, Any] = {}
    for name, value in parameters.items():
        if name not in names:
            raise SceneError(
                f"the {model_type} model has no parameter {name!r}; {suggest(name, names)}"
            )
        array = np.asarray(value, dtype=np.float32)
        if not np.isfinite(array).all():
            raise SceneError(f"{name} holds a number that is not finite")
        tensors[name] = torch.from_numpy(array.reshape(1, -1))
    try:
        output = model(return_verts=True, **tensors)
    except (RuntimeError, TypeError, ValueError) as error:
        raise SceneError(f"the {model_type} model refuses {sorted(tensors)}: {error}") from None
    vertices = np.asarray(output.vertices.detach().cpu().numpy(), dtype=float)[0]
    faces = np.asarray(model.faces, dtype=np.int64)
    return TriMesh(*close_openings(vertices, faces))


def close_openings(vertices: ArrayLike, faces: ArrayLike) -> tuple[Array, NDArray[np.int64]]:
    """Close every opening of a consistently wound mesh with a fan around its middle.

    Args:
        vertices: Points [m], shape (n, 3).
        faces: Vertex indices, shape (m, 3).

    Returns:
        Vertices, with one more for every opening, and faces.

    Raises:
        SceneError: Two openings meet in one vertex.
    """
    v, f = np.asarray(vertices, dtype=float), np.asarray(faces, dtype=np.int64)
    start, end = f.reshape(-1), np.roll(f, -1, axis=1).reshape(-1)
    there = set(zip(start.tolist(), end.tolist(), strict=True))
    after = {}
    for a, b in there:
        if (b, a) not in there:
            if b in after:
                raise SceneError(f"two openings of the mesh meet in vertex {b}; repair the mesh")
            after[b] = a
    new_vertices, new_faces = list(v), list(f)
    while after:
        first, here = next(iter(after.items()))
        rim = [first]
        del after[first]
        while here != first:
            rim.append(here)
            here = after.pop(here)
        middle = len(new_vertices)
        new_vertices.append(v[rim].mean(axis=0))
        ahead = [*rim[1:], rim[0]]
        new_faces += [np.array([a, b, middle]) for a, b in zip(rim, ahead, strict=True)]
    return np.array(new_vertices), np.array(new_faces)
