"""Bodies: a shape of some material, standing somewhere, tied to ground or not."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from capsense.errors import SceneError
from capsense.scene.materials import Material
from capsense.scene.materials import material as find_material
from capsense.scene.pose import Pose
from capsense.scene.shape import Shape

_LARGEST = 1e-3
"""Capacitances to ground beyond this [F] are slips of the pen."""

Grounding = Literal["grounded", "floating"] | float


@dataclass(frozen=True, init=False, eq=False)
class Body:
    """One object of the scene.

    Args:
        shape: The solid.
        pose: Where it stands in the sensor frame.
        material: A :class:`Material`, or the name of a known one.
        grounding: ``"grounded"``, ``"floating"``, or the capacitance [F] that ties the body to
            ground. It matters for conductors only.
        name: Optional; unique within a scene.

    Raises:
        SceneError: An argument is of the wrong kind or out of range.
    """

    shape: Shape
    pose: Pose
    material: Material
    grounding: Grounding
    name: str | None

    def __init__(
        self,
        shape: Shape,
        pose: Pose = Pose(),  # noqa: B008, a pose is immutable
        material: Material | str = "steel",
        grounding: Grounding = "grounded",
        name: str | None = None,
    ) -> None:
        if not isinstance(shape, Shape):
            raise SceneError(
                f"shape is {shape!r}; give a Box, Sphere, Capsule, Cylinder, Ellipsoid or TriMesh"
            )
        if not (name is None or (isinstance(name, str) and name)):
            raise SceneError(f"body name is {name!r}; give a non-empty string or None")
        fields = self.__dict__
        fields["shape"] = shape
        fields["pose"] = _checked_pose(pose)
        fields["material"] = material if isinstance(material, Material) else find_material(material)
        fields["grounding"] = checked_grounding(grounding)
        fields["name"] = name

    def moved(self, pose: Pose) -> Body:
        """Return the same body at another pose; shape and material are shared.

        Raises:
            SceneError: ``pose`` is not a :class:`Pose`.
        """
        body = object.__new__(Body)
        body.__dict__.update(self.__dict__)
        body.__dict__["pose"] = _checked_pose(pose)
        return body


def _checked_pose(pose: object) -> Pose:
    if not isinstance(pose, Pose):
        raise SceneError(f"pose is {pose!r}; give a Pose(position, quaternion)")
    return pose


def checked_grounding(grounding: object) -> Grounding:
    """Check a grounding.

    Raises:
        SceneError: Neither one of the two words nor a positive capacitance up to 1 mF.
    """
    mend = 'give "grounded", "floating", or a capacitance to ground in farads, like 100e-12'
    if isinstance(grounding, str):
        if grounding == "grounded":
            return "grounded"
        if grounding == "floating":
            return "floating"
        raise SceneError(f"grounding is {grounding!r}; {mend}")
    if isinstance(grounding, bool):
        raise SceneError(f"grounding is {grounding!r}; {mend}")
    try:
        farads = float(grounding)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        raise SceneError(f"grounding is {grounding!r}; {mend}") from None
    if not (math.isfinite(farads) and farads > 0):
        raise SceneError(f"grounding is {farads} F, not a positive finite capacitance; {mend}")
    if farads > _LARGEST:
        raise SceneError(
            f"grounding is {farads:g} farads, more than anything has; 100 pF are 100e-12, and a "
            'body of a large capacitance to ground is "grounded"'
        )
    return farads
