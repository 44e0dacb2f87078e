"""A stand-in for the simulator: the same interface, a formula instead of a field."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import capsense as cs
from capsense.errors import SolveError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FakeStats:
    solver_error: float
    wall_time: float
    unknowns: int
    iterations: int


@dataclass(frozen=True)
class FakeReading:
    capacitance: Array
    delta: Array
    stats: FakeStats
    touch: None = None
    in_contact: bool = False

    @property
    def self_capacitance(self) -> Array:
        return np.diag(self.capacitance).copy()


class FakeSimulator:
    """Mutual capacitances fall off with distance; bodies draw charge to ground."""

    after_step: Callable[[int], None] | None = None
    """Called after each step with its number; tests interrupt or fail here."""

    def __init__(
        self,
        design: cs.Design | str,
        method: str = "surface",
        progress: Callable[[str, float], None] | None = None,
    ) -> None:
        self.design = cs.load_design(design) if isinstance(design, str) else design
        self.electrode_names = self.design.electrode_names
        self.steps = 0
        centers = np.array([e.surface.bounds.mean(axis=0) for e in self.design.electrodes])
        gap = np.linalg.norm(centers[:, None] - centers[None], axis=2)
        mutual = 1e-12 / (1 + (gap / 0.02) ** 3)
        np.fill_diagonal(mutual, 0.0)
        self.centers, self.mutual = centers, mutual
        self.ground = np.full(len(centers), 0.8e-12)
        self.baseline = self._maxwell(np.zeros(len(centers)))
        if progress is not None:
            progress("panels", 0.5)
            progress("fit", 1.0)

    def _maxwell(self, reach: Array) -> Array:
        mutual = self.mutual * (1 - 0.3 * np.sqrt(np.outer(reach, reach)))
        diagonal = self.ground * (1 + 0.8 * reach) + mutual.sum(axis=1)
        return np.diag(diagonal) - mutual

    def describe(self) -> dict[str, Any]:
        return {"boundary panels": 3456, "point charges": 812, "modes": 180}

    def reset(self) -> None:
        self.steps = 0

    def step(self, scene: cs.Scene, *, time: float | None = None) -> FakeReading:
        reach = np.zeros(len(self.centers))
        for body in scene:
            local = body.pose.inverse().apply(self.centers)
            distance = np.maximum(body.shape.signed_distance(local), 0.0)
            reach = np.maximum(reach, 1 / (1 + distance / 0.02) ** 2)
        capacitance = self._maxwell(reach)
        if len(scene):
            self.steps += 1
            hook = type(self).after_step
            if hook is not None:
                hook(self.steps)
        stats = FakeStats(4e-18, 1e-3, 120, 3)
        return FakeReading(capacitance, capacitance - self.baseline, stats)


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> type[FakeSimulator]:
    """Puts the stand-in in the simulator's place; returns its class."""
    monkeypatch.setitem(cs.__dict__, "Simulator", FakeSimulator)
    monkeypatch.setattr(FakeSimulator, "after_step", None)
    return FakeSimulator


@pytest.fixture
def fail_at(fake: type[FakeSimulator], monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Makes the stand-in's step number k raise."""

    def arrange(step: int) -> None:
        def hook(number: int) -> None:
            if number == step:
                raise SolveError("the residual is 1e-3 after 500 iterations")

        monkeypatch.setattr(fake, "after_step", staticmethod(hook))

    return arrange
