"""Joints of hands as trackers report them: their order, their noise, their gaps.

All of CapSense's own functions take 21 *landmarks* of a hand, in MediaPipe's order: the wrist; of
the thumb its carpometacarpal, metacarpophalangeal and interphalangeal joint and its tip; of index,
middle, ring and little finger the knuckle (metacarpophalangeal), the proximal and the distal
interphalangeal joint, and the tip. A tip is where the finger ends, on the skin.

Sources of the orders: ``XrHandJointEXT`` of the OpenXR specification (XR_EXT_hand_tracking),
``HandLandmark`` of MediaPipe, ``LEAP_HAND`` and ``LEAP_DIGIT`` of Ultraleap's LeapC.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense._frozen import read_only
from capsense._validate import as_number, suggest
from capsense.errors import SceneError

Array = NDArray[np.float64]

LANDMARKS = 21
"""Landmarks of a hand: the wrist, then four of each finger, from the thumb to the little finger."""
WRIST = 0
TIPS = (4, 8, 12, 16, 20)
"""Landmarks that are tips."""
PALM = (0, 1, 5, 9, 13, 17)
"""Landmarks that keep their distances when the fingers bend: the wrist and where fingers start."""
MIN_PALM = 3
"""Fewest landmarks of the palm that say how a hand has moved."""
REACH, FARTHEST = 0.5, 1e3
"""A landmark farther from the middle of the others than this [m], or from the origin than that, is
no landmark of a hand that a tracker sees."""


@dataclass(frozen=True)
class Convention:
    """How a tracker lists the joints of a hand."""

    count: int
    """How many joints it lists."""
    landmarks: tuple[int, ...]
    """Where each of the 21 landmarks stands in its list."""
    unit: float
    """Metres to its unit of length."""
    tip: Literal["skin", "inside"]
    """Where a tip lies: on the skin, or inside by the radius of the finger."""


_FINGERS_OF_26 = tuple(first + k for first in (2, 7, 12, 17, 22) for k in range(4))
CONVENTIONS: Mapping[str, Convention] = MappingProxyType({
    "openxr": Convention(26, (1, *_FINGERS_OF_26), 1.0, "inside"),
    "mediapipe": Convention(21, tuple(range(LANDMARKS)), 1.0, "skin"),
    "leap": Convention(26, (0, *_FINGERS_OF_26), 1e-3, "skin"),
})  # fmt: skip
"""OpenXR lists the palm, the wrist, four joints of the thumb and five of each finger, in metres.
MediaPipe's are the landmarks, in metres. Leap lists bones: here the wrist (``arm.next_joint``),
then of each digit ``prev_joint`` of its metacarpal and ``next_joint`` of its four bones, in
millimetres; the metacarpal of the thumb has no length."""


def convention(name: str) -> Convention:
    """A convention by name.

    Raises:
        SceneError: There is none of that name.
    """
    if name not in CONVENTIONS:
        raise SceneError(f"convention is {name!r}; {suggest(str(name), CONVENTIONS)}")
    return CONVENTIONS[name]


def as_joints(joints: ArrayLike, count: int, what: str) -> Array:
    """Positions of joints, shape (count, 3); NaN where there is none, also for one that is None.

    Raises:
        SceneError: The shape is another, or there is something that is no number.
    """
    rows: Any = joints
    try:
        if not isinstance(rows, np.ndarray):
            rows = [(math.nan,) * 3 if r is None else r for r in rows]
        found = np.array(rows, dtype=float)
    except (TypeError, ValueError):
        raise SceneError(
            f"{what} holds something that is no position; give ({count}, 3) numbers, NaN for a "
            "joint that was not seen"
        ) from None
    if found.shape != (count, 3):
        raise SceneError(f"{what} has shape {found.shape}; give ({count}, 3)")
    found[~np.isfinite(found).all(axis=1)] = math.nan
    return found


def rigid_motion(source: Array, target: Array) -> tuple[Array, Array]:
    """The rotation and translation that take points nearest to others, by least squares.

    W. Kabsch, "A solution for the best rotation to relate two sets of vectors", Acta Cryst. A32,
    1976.

    Args:
        source: Points [m], shape (n, 3), n at least 3 and not on one line.
        target: Where they are wanted [m], shape (n, 3).

    Returns:
        Rotation, shape (3, 3), and translation [m], shape (3,): ``target ≈ source @ R.T + t``.
    """
    a, b = source.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((target - b).T @ (source - a))
    flip = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * flip) @ vt
    return rotation, b - rotation @ a


class OneEuroFilter:
    """A low-pass filter of points that smooths more the slower a point moves.

    G. Casiez, N. Roussel and D. Vogel, "1€ Filter: A Simple Speed-based Low-pass Filter for Noisy
    Input in Interactive Systems", CHI 2012. The cutoff of a point is
    ``min_cutoff + beta · speed``; the speed is that between consecutive measurements, low-passed
    at ``derivative_cutoff``. It is the speed of the point in space, not one of each coordinate, so
    that the result does not depend on how the axes are turned.

    Args:
        min_cutoff: Cutoff of a point at rest [Hz]; lower is smoother.
        beta: Increase of the cutoff with speed [Hz/(m/s)]; higher lags less.
        derivative_cutoff: Cutoff of the velocity [Hz].

    Raises:
        SceneError: A number is not positive; ``beta`` may be 0.
    """

    def __init__(
        self, min_cutoff: float = 1.5, beta: float = 80.0, derivative_cutoff: float = 3.0
    ) -> None:
        self.min_cutoff = _positive("min_cutoff", min_cutoff, "Hz")
        self.beta = _positive("beta", beta, "Hz/(m/s)", zero=True)
        self.derivative_cutoff = _positive("derivative_cutoff", derivative_cutoff, "Hz")
        self.reset()

    def reset(self) -> None:
        """Forget all points; the next ones pass unchanged."""
        self._time = math.nan
        self._raw: Array | None = None
        self._smooth = np.empty(0)
        self._velocity = np.empty(0)

    def __call__(self, time: float, points: Array) -> Array:
        """The smoothed points.

        Args:
            time: [s]; later than that of the points before.
            points: [m], shape (n, 3).

        Raises:
            SceneError: Time does not go on.
        """
        if self._raw is None:
            self._smooth, self._velocity = points.copy(), np.zeros_like(points)
        else:
            step = time - self._time
            if not step > 0:
                raise SceneError(
                    f"time is {time:g} s after {self._time:g} s; give points in order of time"
                )
            velocity = (points - self._raw) / step
            self._velocity += _gain(self.derivative_cutoff, step) * (velocity - self._velocity)
            speed = np.linalg.norm(self._velocity, axis=1, keepdims=True)
            gain = _gain(self.min_cutoff + self.beta * speed, step)
            self._smooth = self._smooth + gain * (points - self._smooth)
        self._time, self._raw = time, points.copy()
        return self._smooth.copy()


def _gain(cutoff: ArrayLike, step: float) -> Array:
    """Weight of a new value in a first-order low-pass of some cutoff [Hz] after a step [s]."""
    rate = 2 * math.pi * step * np.asarray(cutoff, dtype=float)
    return rate / (1.0 + rate)


Status = Literal["tracked", "returning", "held", "leaving", "absent"]


@dataclass(frozen=True)
class HandSample:
    """A hand at one time, as :class:`HandFilter` reports it."""

    time: float
    """[s]."""
    status: Status
    """``"tracked"``; ``"returning"``, on the way back to what is seen; ``"held"``, where it was
    last seen; ``"leaving"``, on its way out; ``"absent"``."""
    landmarks: Array | None
    """[m], shape (21, 3); None while the hand is absent."""


class HandFilter:
    """Smooths the landmarks of one hand, and bridges what the tracker has missed.

    - A frame counts as missed where it is None, its confidence is too low, it shows fewer than
      three landmarks of the palm, or landmarks that were never seen are missing in it. Single
      landmarks that are missing move along with the palm. A silence of more than ``hold`` counts
      as missed frames too.
    - A landmark more than 0.5 m from the middle of the hand counts as missing.
    - Missed frames: for ``hold`` seconds the hand stays where it was. Then it moves along
      ``retreat`` within ``fade`` seconds, and is absent.
    - When it is seen again, it moves to where it is seen within ``fade`` seconds: from where it
      was held; or, if it was absent, from ``retreat`` beside where it is seen. So the hand never
      jumps, and where ``retreat`` leads out of the sensor's domain, neither do the signals.
    - Frames that are not later than the one before are dropped, and counted in ``dropped``.

    Args:
        smooth: Smooths the landmarks; by default a new :class:`OneEuroFilter`; False for none.
        hold: How long a hand that is not seen stays [s]; longer than the tracker's period.
        fade: How long it takes to leave or to come back [s].
        retreat: How it leaves [m], in the frame of the landmarks; None: it vanishes, and appears.
        min_confidence: Frames of less are missed.

    Raises:
        SceneError: A number is out of range.
    """

    def __init__(
        self, smooth: OneEuroFilter | Literal[False] | None = None, *, hold: float = 0.25,
        fade: float = 0.2, retreat: tuple[float, float, float] | None = (0.0, 0.0, 0.5),
        min_confidence: float = 0.5,
    ) -> None:  # fmt: skip
        if not (smooth is None or smooth is False or isinstance(smooth, OneEuroFilter)):
            raise SceneError(f"smooth is {smooth!r}; give a OneEuroFilter, False or None")
        self._smooth = OneEuroFilter() if smooth is None else smooth
        self.hold = _positive("hold", hold, "s")
        self.fade = _positive("fade", fade, "s", zero=True)
        self.retreat = None if retreat is None else _vector("retreat", retreat)
        self.min_confidence = _positive("min_confidence", min_confidence, "", zero=True)
        if self.min_confidence > 1:
            raise SceneError(f"min_confidence is {min_confidence!r}; give a number from 0 to 1")
        self.dropped = 0
        """Frames that came too late."""
        self.reset()

    def reset(self) -> None:
        """Forget the hand; time may begin anew."""
        self.sample = HandSample(-math.inf, "absent", None)
        """The last sample."""
        self._seen = -math.inf  # time of the last frame that was not missed
        self._missed = False
        self._known: Array | None = None  # landmarks of that frame, completed, before smoothing
        self._lost: Array | None = None  # where the hand was when it was lost
        self._offset: Array
        self._offset, self._since = np.zeros((LANDMARKS, 3)), -math.inf
        if self._smooth:
            self._smooth.reset()

    def update(
        self, time: float, landmarks: ArrayLike | None, confidence: float = 1.0
    ) -> HandSample:
        """Take a frame in.

        Args:
            time: [s].
            landmarks: [m], shape (21, 3); NaN for those that were not seen; None for no hand.
            confidence: Of the tracker, from 0 to 1.

        Returns:
            The hand at that time; the last sample again where the frame came too late.

        Raises:
            SceneError: The time is no number, or the landmarks have another shape.
        """
        if not math.isfinite(now := as_number(time)):
            raise SceneError(f"time is {time!r}; give seconds, a finite number")
        found = None if landmarks is None else _plausible(landmarks)
        if now <= self.sample.time:
            self.dropped += 1
            return self.sample
        sure = as_number(confidence) >= self.min_confidence
        whole = self._completed(found) if found is not None and sure else None
        self.sample = self._lose(now) if whole is None else self._follow(now, whole)
        return self.sample

    def _follow(self, now: float, whole: Array) -> HandSample:
        """The hand is seen."""
        shown = self.sample.landmarks
        again = self._missed or now - self._seen > self.hold
        first = not math.isfinite(self._seen)
        if again and self._smooth and not first:
            self._smooth.reset()
        smooth = self._smooth(now, whole) if self._smooth else whole
        if again and not first:
            self._since = now
            if shown is not None:
                self._offset = shown - smooth
            else:
                beside = np.zeros(3) if self.retreat is None else self.retreat
                self._offset = np.broadcast_to(beside, smooth.shape)
        weight = 1.0 - _smoothstep((now - self._since) / self.fade if self.fade else 1.0)
        self._seen, self._missed, self._known, self._lost = now, False, whole, None
        status: Status = "returning" if weight > 0 and self._offset.any() else "tracked"
        return HandSample(now, status, read_only(smooth + weight * self._offset))

    def _lose(self, now: float) -> HandSample:
        """The hand is not seen."""
        shown, self._missed = self.sample.landmarks, True
        if shown is None:
            return HandSample(now, "absent", None)
        if self._lost is None:
            self._lost = shown
        late = now - self._seen - self.hold
        if late <= 0:
            return HandSample(now, "held", self._lost)
        if self.retreat is None or late >= self.fade:
            return HandSample(now, "absent", None)
        return HandSample(
            now, "leaving", read_only(self._lost + _smoothstep(late / self.fade) * self.retreat)
        )

    def _completed(self, found: Array) -> Array | None:
        """Landmarks with those that are missing moved along with the palm; None: too few."""
        there = np.asarray(np.isfinite(found).all(axis=1))
        if there.all():
            return found
        palm = [k for k in PALM if there[k]]
        if self._known is None or len(palm) < MIN_PALM:
            return None
        rotation, shift = rigid_motion(self._known[palm], found[palm])
        return np.where(there[:, None], found, self._known @ rotation.T + shift)


def _plausible(landmarks: ArrayLike) -> Array:
    """Landmarks, NaN for those that cannot be of a hand."""
    found = as_joints(landmarks, LANDMARKS, "landmarks")
    found[(np.abs(found) > FARTHEST).any(axis=1)] = math.nan
    there = np.isfinite(found[:, 0])
    if there.any():
        away = np.linalg.norm(found - np.median(found[there], axis=0), axis=1)
        found[away > REACH] = math.nan
    return found


def _smoothstep(x: float) -> float:
    """From 0 to 1, level at both ends."""
    x = min(max(x, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)


def _positive(name: str, value: object, unit: str, *, zero: bool = False) -> float:
    number = as_number(value)
    if not (number > 0 or (zero and number == 0)) or not math.isfinite(number):
        low = "0 or a positive number" if zero else "a positive number"
        raise SceneError(f"{name} is {value!r}; give {low}{unit and ' of ' + unit}")
    return number


def _vector(name: str, value: object) -> Array:
    try:
        found = np.array(value, dtype=float)
    except (TypeError, ValueError):
        found = np.empty(0)
    if found.shape != (3,) or not np.isfinite(found).all():
        raise SceneError(f"{name} is {value!r}; give three numbers (x, y, z) in metres")
    return found
