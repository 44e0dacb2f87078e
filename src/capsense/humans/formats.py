"""Human bodies in other formats: SMPL models in, MJCF and URDF out.

Model files of the SMPL family are the user's: they are licensed by their makers and are not part of
CapSense, see smpl-x.is.tue.mpg.de.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense._validate import suggest
from capsense.errors import MissingDependencyError, SceneError
from capsense.humans.chain import Chain, LimbPart, Segment
from capsense.scene import Material, Pose, TriMesh, material
from capsense.scene.materials import Grounding, Ties, checked_grounding

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


_ALONG = 17
"""Points along the axis of a capsule that are compared with those of others."""
_BETWEEN_MASS = 1e-3
"""Mass [kg] of the shapeless links between the hinges of one joint in a URDF."""


def to_mjcf(
    limb: Chain,
    pose: Pose = Pose(),  # noqa: B008, a pose is immutable
    *,
    material_name: str = "human",
    grounding: Grounding = 100e-12,
    damping: float = 1.0,
    free: bool = False,
) -> str:
    """A complete MuJoCo model of a limb or person.

    Its frame (shoulder, hip or wrist centre; of a person, between the hips) is fixed to the world,
    or floats on a free joint. Segments that overlap at ease do not collide.

    Bodies are named ``right_arm_forearm``, geoms ``right_arm_forearm_1``, joints
    ``right_arm_elbow_flexion``. Texts in ``<custom>`` tell an attached sensor the material and
    the grounding. To put the limb into a model of one's own, attach it:
    ``spec.worldbody.add_frame().attach_body(mujoco.MjSpec.from_string(text).body("right_arm"))``,
    or paste :func:`mjcf_body`.

    Args:
        limb: The limb or person.
        pose: Its frame in the world.
        material_name: Name of a known material.
        grounding: ``"grounded"``, ``"floating"`` or the capacitance [F] to ground of the person.
        damping: Damping of all joints [N m s/rad].
        free: Whether a person floats; joint ``person_free``.

    Raises:
        SceneError: No such material, a wrong grounding, or a free limb: MuJoCo wants mass that the
            frame carries along, as that of a person's pelvis.
    """
    known: Material = material(material_name)
    root = Element("mujoco", model=limb.name)
    custom = SubElement(root, "custom")
    tie = checked_grounding(grounding)
    if isinstance(tie, Ties):
        raise SceneError(
            f"grounding is {tie!r}, which a MuJoCo model cannot say; give one capacitance here, "
            "and the ties to attach(…, grounding=…)"
        )
    for key, value in (("material", known.name), ("grounding", tie)):
        SubElement(custom, "text", name=f"capsense.{key}:{limb.name}_*", data=str(value))
    world = SubElement(root, "worldbody")
    base = _mjcf_element(limb, pose, damping)
    world.append(base)
    if free:
        if not any(s.parent is None and not s.joints for s in limb.segments):
            raise SceneError(
                f"free is True, but nothing of {limb.name} is fixed to its frame; leave it False, "
                "or attach the limb to a body that moves"
            )
        base.insert(0, Element("freejoint", name=f"{limb.name}_free"))
    overlapping = _overlapping(limb)
    if overlapping:
        contact = SubElement(root, "contact")
        for first, second in overlapping:
            SubElement(
                contact, "exclude",
                body1=f"{limb.name}_{first}", body2=f"{limb.name}_{second}",
            )  # fmt: skip
    return _text(root)


def mjcf_body(limb: Chain, pose: Pose = Pose(), *, damping: float = 1.0) -> str:  # noqa: B008
    """The ``<body>`` element of a limb, to be pasted into a model that counts in degrees.

    Other than in :func:`to_mjcf`, segments that overlap at ease collide.

    Args:
        limb: The limb.
        pose: Its frame in that of the body it is pasted into.
        damping: Damping of all joints [N m s/rad].
    """
    return _text(_mjcf_element(limb, pose, damping))


def to_urdf(limb: Chain) -> str:
    """A URDF of a limb or person; its base link is its frame.

    Links are named ``right_arm_forearm``, joints ``right_arm_elbow_flexion``. Where a segment has
    several hinges, they are joined by light links without a shape. Capsules are written as
    ``<capsule radius length>``, which Bullet reads and the URDF standard does not know. PyBullet
    takes 127 links; a person with detailed hands has 74.

    Args:
        limb: The limb or person.
    """
    root = Element("robot", name=limb.name)
    _urdf_link(root, limb.name, None)
    for segment in limb.segments:
        name = f"{limb.name}_{segment.name}"
        above = limb.name if segment.parent is None else f"{limb.name}_{segment.parent}"
        if not segment.joints:
            _urdf_link(root, name, segment)
            fixed = SubElement(root, "joint", name=f"{name}_fixed", type="fixed")
            SubElement(fixed, "origin", xyz=_numbers(segment.origin), rpy="0 0 0")
            SubElement(fixed, "parent", link=above)
            SubElement(fixed, "child", link=name)
        for k, joint in enumerate(segment.joints):
            last = k == len(segment.joints) - 1
            link = name if last else f"{limb.name}_{joint.name}"
            _urdf_link(root, link, segment if last else None)
            hinge = SubElement(root, "joint", name=f"{limb.name}_{joint.name}", type="revolute")
            origin = segment.origin if k == 0 else (0.0, 0.0, 0.0)
            SubElement(hinge, "origin", xyz=_numbers(origin), rpy="0 0 0")
            SubElement(hinge, "parent", link=above)
            SubElement(hinge, "child", link=link)
            SubElement(hinge, "axis", xyz=_numbers(joint.axis))
            SubElement(
                hinge, "limit", lower=_number(joint.lower), upper=_number(joint.upper),
                effort="100", velocity="10",
            )  # fmt: skip
            above = link
    return _text(root)


def _mjcf_element(limb: Chain, pose: Pose, damping: float) -> Element:
    x, y, z, w = pose.quaternion
    base = Element("body", name=limb.name, pos=_numbers(pose.position), quat=_numbers((w, x, y, z)))
    bodies: dict[str | None, Element] = {None: base}
    for segment in limb.segments:
        above = bodies[segment.name] = SubElement(
            bodies[segment.parent], "body",
            name=f"{limb.name}_{segment.name}", pos=_numbers(segment.origin),
        )  # fmt: skip
        for joint in segment.joints:
            bounds = [math.degrees(joint.lower), math.degrees(joint.upper)]
            SubElement(
                above, "joint", name=f"{limb.name}_{joint.name}", type="hinge",
                axis=_numbers(joint.axis), range=_numbers(bounds), limited="true",
                damping=_number(damping),
            )  # fmt: skip
        for name, part in limb.named_parts(segment):
            SubElement(
                above, "geom", name=name, type="capsule", size=_number(part.radius),
                fromto=_numbers((*part.start, *part.end)),
                mass=_number(segment.mass * part.shape.volume / segment.volume),
            )  # fmt: skip
    return base


def _overlapping(limb: Chain) -> list[tuple[str, str]]:
    """Segments that overlap at ease, without those that hang on each other."""
    where, points, radii, owner = limb.forward(limb.neutral), [], [], []
    for k, segment in enumerate(limb.segments):
        for part in segment.parts:
            points.append(where[segment.name].apply(np.linspace(part.start, part.end, _ALONG)))
            radii.append(part.radius)
            owner.append(k)
    near = [np.linalg.norm(a - points, axis=-1) for a in np.reshape(points, (-1, 3))]
    gaps = np.reshape(near, (len(radii), _ALONG, len(radii), _ALONG)).min(axis=(1, 3))
    met = {(owner[a], owner[b]) for a, b in np.argwhere(gaps < np.add.outer(radii, radii)).tolist()}
    pairs = [(limb.segments[a], limb.segments[b]) for a, b in sorted(met) if a < b]
    return [(a.name, b.name) for a, b in pairs if a.name != b.parent]


def _urdf_link(root: Element, name: str, segment: Segment | None) -> None:
    link = SubElement(root, "link", name=name)
    mass = _BETWEEN_MASS if segment is None else segment.mass
    centre = (0.0, 0.0, 0.0) if segment is None else _centre(segment.parts)
    size = 0.01 if segment is None else max(p.shape.length for p in segment.parts)
    inertial = SubElement(link, "inertial")
    SubElement(inertial, "origin", xyz=_numbers(centre), rpy="0 0 0")
    SubElement(inertial, "mass", value=_number(mass))
    moment = _number(mass * size**2 / 12)  # of a rod
    SubElement(inertial, "inertia", ixx=moment, iyy=moment, izz=moment, ixy="0", ixz="0", iyz="0")
    for part in () if segment is None else segment.parts:
        for kind in ("visual", "collision"):
            shape = SubElement(link, kind)
            SubElement(
                shape, "origin", xyz=_numbers(part.pose.position), rpy=_numbers(_euler(part.pose))
            )
            geometry = SubElement(shape, "geometry")
            SubElement(
                geometry, "capsule", radius=_number(part.radius), length=_number(part.shape.length)
            )


def _centre(parts: tuple[LimbPart, ...]) -> tuple[float, ...]:
    """Centre of volume [m] of the parts."""
    volume = sum(p.shape.volume for p in parts)
    return tuple(sum(p.shape.volume * p.pose.position[k] for p in parts) / volume for k in range(3))


def _euler(pose: Pose) -> tuple[float, float, float]:
    """Roll, pitch, yaw [rad] of ``R = Rz(yaw) Ry(pitch) Rx(roll)``."""
    r = pose.rotation
    pitch = math.asin(max(-1.0, min(1.0, -r[2, 0])))
    if abs(r[2, 0]) > 1 - 1e-12:  # roll and yaw turn about one axis; yaw is taken as zero
        return math.atan2(-r[1, 2], r[1, 1]), pitch, 0.0
    return math.atan2(r[2, 1], r[2, 2]), pitch, math.atan2(r[1, 0], r[0, 0])


def _number(value: float) -> str:
    return repr(round(float(value), 12) + 0.0)


def _numbers(values: Iterable[float]) -> str:
    return " ".join(_number(v) for v in values)


def _text(element: Element) -> str:
    indent(element)
    return tostring(element, encoding="unicode")
