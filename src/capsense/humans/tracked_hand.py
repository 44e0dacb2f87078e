"""A hand model that follows the joints of a tracker."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense.errors import SceneError
from capsense.humans.build import Build
from capsense.humans.chain import LimbPart, Segment
from capsense.humans.limb import Limb, Side, hand
from capsense.humans.tracking import (
    LANDMARKS,
    PALM,
    TIPS,
    WRIST,
    Convention,
    as_joints,
    convention,
    rigid_motion,
)
from capsense.scene import Body, Material, Pose
from capsense.scene.materials import Grounding
from capsense.scene.pose import checked_pose, matrix_to_quaternion

Array = NDArray[np.float64]

DIGITS = ("thumb", "index", "middle", "ring", "little")
BONES = (
    ("thumb_metacarpal", "thumb_proximal", "thumb_distal"),
    *((f"{f}_proximal", f"{f}_intermediate", f"{f}_distal") for f in DIGITS[1:]),
)
"""Segments of the digits, outwards; segment k of digit i is between landmarks 1 + 4i + k and the
next."""
_STARTS = 1 + 4 * np.arange(5)
_SHORT = 1e-6
"""Landmarks closer than this say nothing about the direction of a bone [m]."""
_SIZES = (0.01, 1.0)
"""From wrist to middle knuckle a hand measures some 0.1 m; beyond these [m] the unit is wrong."""
_RATIOS = (0.4, 2.5)
"""A bone that measures less or more of the model's is no bone of a hand."""


@dataclass(frozen=True)
class TrackedHand:
    """A hand of fixed size whose segments follow the landmarks of a tracker.

    The palm is placed by least squares on the wrist and the five points where digits start. Each
    bone of a digit lies along the line between its two landmarks: the last one with its tip on the
    tracked tip, the others in the middle between theirs. So fingertips are exact, even where the
    lengths of the model differ from those of the person, and no error adds up along a finger. A
    bone that is too short or too long by d leaves d/2 at each of its ends, which the round ends of
    the capsules cover. :meth:`fit` takes the lengths from the tracker.

    Sizes do not change from frame to frame: a new size costs a new geometry, a new pose does not.

    Raises:
        SceneError: There is no such side or convention, or the model is no hand.
    """

    model: Build | Limb = Build()  # noqa: RUF009, it is immutable
    """Size of the person; or a hand, as :func:`~capsense.humans.hand` makes it."""
    side: Side = "right"
    """``"left"`` or ``"right"``; of a model that is given, its own is taken."""
    convention: str = "openxr"
    """``"openxr"``, 26 joints; ``"mediapipe"``, 21; ``"leap"``, 26; see
    :mod:`capsense.humans.tracking`."""
    tip: Literal["skin", "inside"] | None = None
    """Where the tracker's tips lie: on the skin, or inside by the radius of the finger. By default
    inside for OpenXR, as it specifies, else on the skin. Some OpenXR runtimes report the skin."""

    def __post_init__(self) -> None:
        convention(self.convention)
        if self.tip not in (None, "skin", "inside"):
            raise SceneError(f'tip is {self.tip!r}; choose "skin" or "inside"')
        if isinstance(self.model, Build):
            object.__setattr__(self, "model", hand(self.model, self.side))
        elif not isinstance(self.model, Limb):
            raise SceneError(f"model is {self.model!r}; give a Build, or a hand of humans.hand()")
        names = {s.name for s in self.limb.segments}
        if names != {"palm", *(name for digit in BONES for name in digit)}:
            raise SceneError(
                f"{self.limb.name} is no hand; give a Build, or what humans.hand() returns"
            )
        side = "left" if self.limb.name.startswith("left") else "right"
        object.__setattr__(self, "side", side)

    @property
    def limb(self) -> Limb:
        """The hand model."""
        assert isinstance(self.model, Limb)
        return self.model

    # -- from a tracker --------------------------------------------------------------------------

    def landmarks(
        self, joints: ArrayLike, radii: ArrayLike | None = None, *,
        pose: Pose = Pose(), wrist: ArrayLike | None = None,  # noqa: B008, a pose is immutable
    ) -> Array:  # fmt: skip
        """The landmarks of a frame of the tracker, in the sensor frame.

        Args:
            joints: Positions in the convention's order and unit, shape (k, 3); NaN for those that
                were not seen. Of MediaPipe give the *world* landmarks: those of the image are no
                lengths.
            radii: Distance of each joint from the skin, in the convention's unit, shape (k,), as
                OpenXR gives it; only those of the tips are used, where ``tip`` is ``"inside"``. By
                default the radii of the model.
            pose: The tracker's frame in the sensor frame.
            wrist: Where the wrist is [m] in the sensor frame, shape (3,); the hand is moved there.
                MediaPipe's world landmarks need it: they have their origin in the hand, so their
                place must come from elsewhere, a depth camera say.

        Returns:
            Landmarks [m], shape (21, 3).

        Raises:
            SceneError: The shape is another, or the unit cannot be metres.
        """
        form = convention(self.convention)
        given = as_joints(joints, form.count, f"joints ({self.convention})")
        out = given[list(form.landmarks)] * form.unit
        size = float(np.linalg.norm(out[9] - out[WRIST]))
        if size < _SIZES[0] or size > _SIZES[1]:
            raise SceneError(
                f"joints: the hand measures {size:.3g} m from the wrist to the middle knuckle; "
                f"{self.convention} gives {'metres' if form.unit == 1 else 'millimetres'}"
            )
        if self._tip(form) == "inside":
            out[list(TIPS)] += self._inset(form, radii)[:, None] * _directions(out)
        out = checked_pose(pose).apply(out)
        if wrist is not None:
            place = np.asarray(wrist, dtype=float)
            if place.shape != (3,):
                raise SceneError(f"wrist has shape {place.shape}; give three numbers in metres")
            out += place - out[WRIST]
        return out

    def poses(self, landmarks: ArrayLike) -> dict[str, Pose]:
        """Poses of the segments.

        Args:
            landmarks: [m], shape (21, 3), all finite; a :class:`~capsense.humans.HandFilter`
                makes them so.

        Returns:
            The pose of each segment by name, in the frame of the landmarks.

        Raises:
            SceneError: The shape is another, or a landmark is missing.
        """
        points = _whole(landmarks)
        rotation, shift = rigid_motion(self._palm_points, points[list(PALM)])
        out = {"palm": _pose(rotation, shift)}
        above = np.broadcast_to(rotation, (5, 3, 3))
        for k in range(3):
            start, end = points[_STARTS + k], points[_STARTS + k + 1]
            rest = above @ self._ahead[:, k, :, None]
            bone = end - start
            length = np.linalg.norm(bone, axis=1)
            known = length > _SHORT
            along = np.where(
                known[:, None], bone / np.maximum(length, _SHORT)[:, None], rest[..., 0]
            )
            if k == 0:
                above = above @ self._first_turn(along @ rotation)
            above = _swing((above @ self._ahead[:, k, :, None])[..., 0], along) @ above
            excess = length - self._lengths[:, k]
            share = 1.0 if k == 2 else 0.5  # the tip is where it was tracked
            origin = start + (share * excess)[:, None] * along
            for i in range(5):
                out[BONES[i][k]] = _pose(above[i], origin[i])
        return out

    def bodies(
        self, landmarks: ArrayLike | None, *, material: Material | str = "human",
        grounding: Grounding = 100e-12, conductor: str | None = None,
    ) -> list[Body]:  # fmt: skip
        """The hand as bodies of a scene.

        Args:
            landmarks: [m] in the sensor frame, shape (21, 3); None for a hand that is absent.
            material: What it is made of.
            grounding: ``"grounded"``, ``"floating"``, or the capacitance [F] that ties the whole
                person to ground.
            conductor: Bodies of one name are one conductor; give it to both hands of a person. By
                default the name of the hand, ``"right_hand"``.

        Returns:
            The bodies, always of the same shapes; none of an absent hand.

        Raises:
            SceneError: The landmarks, the material or the grounding are wrong.
        """
        if landmarks is None:
            return []
        where = self.poses(landmarks)
        made = self._made(material, grounding, conductor or self.limb.name)
        return [body.moved(where[name] @ part.pose) for name, part, body in made]

    def fit(self, frames: ArrayLike) -> TrackedHand:
        """The same hand with the lengths of bones and the palm that a tracker reports.

        Lengths are medians over the frames, so noise and single outliers matter little. Thicknesses
        remain those of the model: trackers do not measure them.

        Args:
            frames: Landmarks [m], shape (n, 21, 3), best filtered, of a hand that opens and
                closes; frames in which landmarks are missing (NaN) are left out.

        Raises:
            SceneError: No frame is whole, a bone has a length that no hand has, or the fingers
                bend backwards: then it is the other hand, or a mirrored image.
        """
        given = np.asarray(frames, dtype=float)
        if given.ndim != 3 or given.shape[1:] != (LANDMARKS, 3):
            raise SceneError(f"frames has shape {given.shape}; give (n, {LANDMARKS}, 3)")
        whole = given[np.isfinite(given).all(axis=(1, 2))]
        if not len(whole):
            raise SceneError(f"frames: none of {len(given)} is whole; give one without NaN")
        self._check_side(whole)
        ends = np.linalg.norm(np.diff(whole[:, 1:].reshape(-1, 5, 4, 3), axis=2), axis=3)
        lengths = np.median(ends, axis=0)
        for i, k in np.ndindex(5, 3):
            ratio = lengths[i, k] / self._lengths[i, k]
            if not _RATIOS[0] < ratio < _RATIOS[1]:
                raise SceneError(
                    f"{BONES[i][k]} measures {1e3 * lengths[i, k]:.3g} mm, in the model "
                    f"{1e3 * self._lengths[i, k]:.3g} mm; check the frames, or give another Build"
                )
        return replace(self, model=self._resized(lengths, self._mean_palm(whole)))

    def joints(
        self, angles: Mapping[str, float] | None = None, pose: Pose = Pose(), *,  # noqa: B008
        degrees: bool = False,
    ) -> Array:  # fmt: skip
        """What a tracker without errors would report of the model: the inverse of :meth:`poses`.

        Args:
            angles: Angle of each joint by name [rad]; those not given are zero.
            pose: The model's frame, at the wrist, in the tracker's frame.
            degrees: Whether the angles are in degrees.

        Returns:
            Joints in the convention's order and unit, shape (k, 3). OpenXR's palm is the middle of
            the middle metacarpal, and Leap's thumb metacarpal has no length.

        Raises:
            SceneError: There is no such joint, or it does not bend so far.
        """
        form, where = convention(self.convention), self.limb.forward(angles, degrees=degrees)
        points = np.empty((LANDMARKS, 3))
        points[WRIST] = where["palm"].position
        for i, names in enumerate(BONES):
            for k, name in enumerate(names):
                points[1 + 4 * i + k] = where[name].position
            tip = self._lengths[i, 2]
            if self._tip(form) == "inside":
                tip -= self._tip_radii[i]
            points[4 + 4 * i] = where[names[2]].apply(tip * self._ahead[i, 2])
        out = np.empty((form.count, 3))
        if form.count > LANDMARKS:
            bases = where["palm"].apply([p.start for p in self._segments["palm"].parts])
            out[[6, 11, 16, 21]] = bases
            if self.convention == "openxr":
                out[0] = 0.5 * (bases[1] + points[9])
            else:
                out[1] = points[1]
        out[list(form.landmarks)] = points
        return pose.apply(out) / form.unit

    # -- the model -------------------------------------------------------------------------------

    def _made(
        self, material: Material | str, grounding: Grounding, conductor: str
    ) -> list[tuple[str, LimbPart, Body]]:
        """Each part with the name of its segment and its body; made once."""
        kept = self.__dict__.get("_kept")
        if kept is None or kept[0] != (material, grounding, conductor):
            made = [
                (s.name, part, Body(part.shape, Pose(), material, grounding, name,
                                    conductor=conductor))
                for s in self.limb.segments
                for name, part in self.limb.named_parts(s)
            ]  # fmt: skip
            kept = self.__dict__["_kept"] = (material, grounding, conductor), made
        found: list[tuple[str, LimbPart, Body]] = kept[1]
        return found

    @cached_property
    def _segments(self) -> dict[str, Segment]:
        return {s.name: s for s in self.limb.segments}

    @cached_property
    def _palm_points(self) -> Array:
        """Landmarks of the palm in its frame [m], shape (6, 3)."""
        return np.array([(0.0, 0.0, 0.0), *(self._segments[d[0]].origin for d in BONES)])

    @cached_property
    def _vectors(self) -> Array:
        """From the start of each bone to its end, of the last to the skin [m], shape (5, 3, 3)."""
        out = np.empty((5, 3, 3))
        for i, names in enumerate(BONES):
            for k, name in enumerate(names):
                if k < 2:
                    out[i, k] = self._segments[names[k + 1]].origin
                else:
                    (part,) = self._segments[name].parts
                    end = np.array(part.end)
                    out[i, k] = end * (1.0 + part.radius / np.linalg.norm(end))
        return out

    @cached_property
    def _lengths(self) -> Array:
        """Lengths of the bones [m], shape (5, 3)."""
        return np.linalg.norm(self._vectors, axis=2)

    @cached_property
    def _ahead(self) -> Array:
        """Directions of the bones in their frames, shape (5, 3, 3)."""
        return self._vectors / self._lengths[..., None]

    @cached_property
    def _tip_radii(self) -> Array:
        """Radii of the last bones [m], shape (5,)."""
        return np.array([self._segments[names[2]].parts[0].radius for names in BONES])

    @cached_property
    def _axes(self) -> Array:
        """Axes of the two joints where each digit starts, shape (5, 2, 3)."""
        return np.array([[j.axis for j in self._segments[names[0]].joints] for names in BONES])

    def _first_turn(self, along: Array) -> Array:
        """Turns about the first joint of each digit that bring its plane to a direction.

        The second axis is at right angles to the first one and to the bone, so it is where the
        bone stays in the plane that the second joint turns it in.

        Args:
            along: Directions of the first bones in the frame of the palm, shape (5, 3).

        Returns:
            Rotations, shape (5, 3, 3).
        """
        first, second = self._axes[:, 0], self._axes[:, 1]
        turned = np.cross(along, first)
        sign = np.einsum("ij,ij->i", second, np.cross(self._ahead[:, 0], first))
        size = np.linalg.norm(turned, axis=1)
        turned = np.sign(sign)[:, None] * turned / np.maximum(size, _SHORT)[:, None]
        turned = np.where((size > _SHORT)[:, None], turned, second)
        before = np.stack([first, second, np.cross(first, second)], axis=2)
        after = np.stack([first, turned, np.cross(first, turned)], axis=2)
        return after @ before.transpose(0, 2, 1)

    def _tip(self, form: Convention) -> str:
        return form.tip if self.tip is None else self.tip

    def _inset(self, form: Convention, radii: ArrayLike | None) -> Array:
        """How far inside the tips lie [m], shape (5,)."""
        if radii is None:
            return self._tip_radii
        given = np.asarray(radii, dtype=float)
        if given.shape != (form.count,):
            raise SceneError(f"radii has shape {given.shape}; give ({form.count},)")
        found = given[[form.landmarks[k] for k in TIPS]] * form.unit
        return np.where(np.isfinite(found) & (found > 0), found, self._tip_radii)

    def _check_side(self, whole: Array) -> None:
        """Refuse a hand whose fingers bend backwards."""
        bends = []
        for frame in whole[:: max(1, len(whole) // 100)]:
            rotation, _ = rigid_motion(self._palm_points, frame[list(PALM)])
            bones = np.diff(frame[1:].reshape(5, 4, 3), axis=1)[1:] @ rotation
            bends.append(np.cross(bones[:, 0], bones[:, 1]) @ self._axes[1, 0])
        if np.sum(bends) < 0:
            other = "left" if self.side == "right" else "right"
            raise SceneError(
                f"frames: the fingers of this {self.side} hand bend backwards; is it a {other} "
                "one, or seen in a mirrored image?"
            )

    def _mean_palm(self, whole: Array) -> Array:
        """Where digits start, in the frame of the palm [m], shape (5, 3)."""
        mean = self._palm_points
        for _ in range(3):  # the mean shape settles at once: frames differ by noise
            placed = []
            for frame in whole[:, list(PALM)]:
                rotation, shift = rigid_motion(frame, mean)
                placed.append(frame @ rotation.T + shift)
            mean = np.median(placed, axis=0)
        return mean[1:] - mean[0]

    def _resized(self, lengths: Array, starts: Array) -> Limb:
        """The model with other lengths of bones, and other places where digits start."""
        old = self._palm_points[1:]
        broad = np.ptp(starts[1:, 0]) / np.ptp(old[1:, 0])
        made = []
        for segment in self.limb.segments:
            if segment.name == "palm":
                parts = []
                for part, was, now in zip(segment.parts, old[1:], starts[1:], strict=True):
                    start = np.array(part.start) * (broad, 1.0, now[2] / was[2])
                    parts.append(LimbPart(_vec(start), _vec(now), part.radius))
                made.append(replace(segment, parts=tuple(parts)))
                continue
            i = DIGITS.index(segment.name.split("_")[0])
            k = BONES[i].index(segment.name)
            (part,) = segment.parts
            length = lengths[i, k] - (part.radius if k == 2 else 0.0)
            if length <= 0.1 * part.radius:
                raise SceneError(
                    f"{segment.name} measures {1e3 * lengths[i, k]:.3g} mm, no more than its "
                    f"radius of {1e3 * part.radius:.3g} mm; check the frames"
                )
            end = _vec(length * self._ahead[i, k])
            origin = starts[i] if k == 0 else lengths[i, k - 1] * self._ahead[i, k - 1]
            made.append(
                replace(
                    segment,
                    origin=_vec(origin),
                    parts=(LimbPart((0.0, 0.0, 0.0), end, part.radius),),
                )
            )
        return replace(self.limb, segments=tuple(made))


def _whole(landmarks: ArrayLike) -> Array:
    points = as_joints(landmarks, LANDMARKS, "landmarks")
    if not np.isfinite(points).all():
        k = int(np.argmin(np.isfinite(points).all(axis=1)))
        raise SceneError(f"landmark {k} is missing; let a HandFilter fill gaps in")
    return points


def _directions(points: Array) -> Array:
    """Directions of the last bones, shape (5, 3)."""
    bones = points[list(TIPS)] - points[[k - 1 for k in TIPS]]
    return bones / np.maximum(np.linalg.norm(bones, axis=1, keepdims=True), _SHORT)


def _swing(source: Array, target: Array) -> Array:
    """Shortest rotations between unit vectors, shape (n, 3, 3)."""
    cosine = np.einsum("ij,ij->i", source, target)
    x, y, z = np.cross(source, target).T
    zero = np.zeros_like(x)
    cross = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    back = 1.0 + cosine < _SHORT  # half a turn, about any axis at right angles
    factor = 1.0 / np.where(back, 1.0, 1.0 + cosine)
    out: Array = np.eye(3) + cross + factor[:, None, None] * (cross @ cross)
    for i in np.flatnonzero(back):
        axis = np.cross(source[i], np.eye(3)[np.argmin(np.abs(source[i]))])
        axis /= np.linalg.norm(axis)
        out[i] = 2.0 * np.outer(axis, axis) - np.eye(3)
    return out


def _pose(rotation: Array, position: Array) -> Pose:
    return Pose(position, matrix_to_quaternion(rotation))


def _vec(values: ArrayLike) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in np.asarray(values))
    return x, y, z
