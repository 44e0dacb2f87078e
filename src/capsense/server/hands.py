"""Hands that a client tracks: their model, their filter, and the bodies that they are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from capsense.humans import Build, HandFilter, OneEuroFilter, TrackedHand
from capsense.humans.limb import Side
from capsense.scene import Body, Capsule, Material
from capsense.scene.materials import Grounding

CONDUCTOR = "hands"
"""The conductor that both hands of a client are."""


@dataclass(frozen=True)
class HandOptions:
    """Whose hands they are, and how they are filtered."""

    build: Build = field(default_factory=Build)
    smooth: Mapping[str, float] = field(default_factory=dict)
    """Arguments of :class:`~capsense.humans.OneEuroFilter`."""
    gaps: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of :class:`~capsense.humans.HandFilter`."""

    def make_filter(self) -> HandFilter:
        """A filter of its own for a hand."""
        return HandFilter(OneEuroFilter(**self.smooth), **self.gaps)


@dataclass(frozen=True, eq=False)
class SeenHand:
    """One hand in a frame of a tracker."""

    side: Side
    convention: str
    tip: Literal["skin", "inside"] | None
    joints: NDArray[np.float64] | None
    """In the sensor frame, in the convention's order and unit, shape (k, 3), NaN for joints that
    were not seen; None for a hand that was not."""
    radii: NDArray[np.float64] | None
    wrist: tuple[float, ...] | None
    confidence: float


@dataclass(frozen=True, eq=False)
class HandsMessage:
    """Tracked hands have moved."""

    sensor: int
    sequence: int
    time: float
    hands: tuple[SeenHand, ...]


class ServedHands:
    """The hands in front of one sensor.

    Args:
        options: Whose, and how they are filtered.
        material: What they are made of.
        grounding: Of the person.
        table: Material and grounding as the client said them.
    """

    def __init__(
        self, options: HandOptions, material: Material | str, grounding: Grounding,
        table: Mapping[str, Any],
    ) -> None:  # fmt: skip
        self._options, self._material, self._grounding = options, material, grounding
        self._table = dict(table)
        self._models: dict[tuple[str, ...], TrackedHand] = {}
        self.reset()

    def reset(self) -> None:
        """Forget the hands."""
        self._filters: dict[Side, HandFilter] = {}
        self.bodies: tuple[Body, ...] = ()
        """What the hands are at present."""
        self.tables: tuple[Mapping[str, Any], ...] = ()
        """The same as a ``scene`` would say it, without poses."""

    def update(self, message: HandsMessage) -> None:
        """Take a frame of the tracker in; hands that are not in it were not seen.

        Raises:
            SceneError: The joints are wrong.
        """
        seen = {hand.side: hand for hand in message.hands}
        found = {side: self._landmarks(hand) for side, hand in seen.items()}
        bodies: list[Body] = []
        for side in ("left", "right"):
            key = cast(Side, side)
            if key not in seen and key not in self._filters:
                continue
            tracker = self._filters.setdefault(key, self._options.make_filter())
            sure = seen[key].confidence if key in seen else 0.0
            sample = tracker.update(message.time, found.get(key), sure)
            if sample.landmarks is not None:
                model = self._model(key, "mediapipe", None)  # landmarks are of no convention
                bodies += model.bodies(
                    sample.landmarks, material=self._material, grounding=self._grounding,
                    conductor=CONDUCTOR,
                )  # fmt: skip
        self.bodies = tuple(bodies)
        self.tables = tuple(self._described(body) for body in bodies)

    def _landmarks(self, hand: SeenHand) -> NDArray[np.float64] | None:
        if hand.joints is None:
            return None
        model = self._model(hand.side, hand.convention, hand.tip)
        return model.landmarks(hand.joints, hand.radii, wrist=hand.wrist)

    def _model(
        self, side: Side, convention: str, tip: Literal["skin", "inside"] | None
    ) -> TrackedHand:
        key = side, convention, str(tip)
        if key not in self._models:
            self._models[key] = TrackedHand(self._options.build, side, convention, tip)
        return self._models[key]

    def _described(self, body: Body) -> Mapping[str, Any]:
        assert isinstance(body.shape, Capsule)
        return {
            "name": body.name, "shape": "capsule", "radius": body.shape.radius,
            "length": body.shape.length, "conductor": CONDUCTOR, **self._table,
        }  # fmt: skip
