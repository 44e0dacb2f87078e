"""What limits the zero-mean correlation of a foretold curve with a recording of it.

Nothing here knows the scenario but :class:`Eased`: curves are functions of named values, sources
of error are functions that draw a change of the curve.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import brentq, least_squares

from capsense.readout.calibration import cross_correlation
from capsense.reproduce.harness import rmse
from capsense.reproduce.scenario1_setup import Array, Scenario1Setup
from capsense.scene import Pose

Values = Mapping[str, float]
Source = Callable[[np.random.Generator], Array]
TRIED = 80
"""Changes that :func:`tolerance` tries on each side."""


def sample_noise(curve: Array) -> float:
    """Standard deviation of white noise on a curve, from its second differences.

    Their median magnitude counts, so few steep samples do not matter. White noise of deviation σ
    has second differences of √6 σ, and 0.6745 of a normal deviation is its median magnitude.
    """
    return float(np.median(np.abs(np.diff(curve, 2))) / 0.6745 / np.sqrt(6))


def lasting(residual: Array, noise: float) -> Source:
    """A source: what a fit leaves beyond white noise, begun anywhere and as often turned over.

    Args:
        residual: Recording minus curve, shape (n,).
        noise: Standard deviation of the white noise in it.
    """
    centred = residual - residual.mean()
    share = np.sqrt(max(0.0, 1 - noise**2 / np.mean(centred**2)))

    def draw(random: np.random.Generator) -> Array:
        return random.choice([-1.0, 1.0]) * share * np.roll(centred, random.integers(len(centred)))

    return draw


@dataclass(frozen=True)
class Quantiles:
    """Of the zero-mean correlation over draws."""

    low: float
    """Undercut by 5 % of the draws."""
    median: float
    high: float
    """Exceeded by 5 % of the draws."""


@dataclass(frozen=True)
class Expected:
    """The correlation that a foretold curve may be expected to have with a recording."""

    total: Quantiles
    alone: Mapping[str, Quantiles]
    """By source, with no other one at work."""
    removed: Mapping[str, Quantiles]
    """By source, with all others at work."""


def expected(
    curve: Array, sources: Mapping[str, Source], *, draws: int = 200, seed: int = 0
) -> Expected:
    """Draw recordings, each the curve with the changes of all sources added.

    Args:
        curve: As foretold, shape (n,).
        sources: By name; each draws a change of the curve, shape (n,).
        draws: Their number.
        seed: Of the draws.
    """
    random = np.random.default_rng(seed)
    changes = {
        name: np.array([draw(random) for _ in range(draws)]) for name, draw in sources.items()
    }
    total = np.sum(list(changes.values()), axis=0)

    def likeness(added: Array) -> Quantiles:
        found = [cross_correlation(curve, curve + change) for change in added]
        return Quantiles(*np.quantile(found, [0.05, 0.5, 0.95]).tolist())

    return Expected(
        likeness(total),
        {name: likeness(change) for name, change in changes.items()},
        {name: likeness(total - change) for name, change in changes.items()},
    )


def tolerance(
    curve: Callable[[float], Array], least: float, *, largest: float = 1.0
) -> float | None:
    """The smallest change of a value, either way, that alone lowers the correlation to ``least``.

    Args:
        curve: By the change of the value; 0 gives the curve that others are compared with.
        least: Zero-mean correlation.
        largest: Change beyond which is not looked.

    Returns:
        The magnitude of the change, or none up to ``largest``.
    """
    best = curve(0.0)

    def excess(change: float) -> float:
        return cross_correlation(curve(change), best) - least

    found = []
    steps = np.geomspace(1e-4, 1.0, TRIED) * largest
    for sign in (1.0, -1.0):
        below = 0.0
        for step in steps:
            if excess(sign * step) < 0:
                found.append(brentq(lambda size, s=sign: excess(s * size), below, step))
                break
            below = step
    return min(found, default=None)


@dataclass(frozen=True)
class Ceiling:
    """How like a recording its curve becomes once some of the values are fitted to it."""

    correlation: float
    """Zero-mean."""
    error: float
    """rms"""
    values: Values
    """As fitted."""


def ceilings(
    curve: Callable[[Values], Array],
    measured: Array,
    groups: Mapping[str, Mapping[str, tuple[float, float]]],
) -> dict[str, Ceiling]:
    """Fit each group of values to a recording, the others kept: an explanation, no prediction.

    Args:
        curve: By the values that differ from the foretold ones, shape (n,).
        measured: The recording, shape (n,).
        groups: By name; of each value where the fit begins, and by how much it may be off.

    Returns:
        By group; first ``"as foretold"``, last ``"all of these"``.
    """
    whole = {key: value for group in groups.values() for key, value in group.items()}
    asked = {"as foretold": {}, **groups, "all of these": whole}
    return {name: _ceiling(curve, measured, group) for name, group in asked.items()}


def _ceiling(
    curve: Callable[[Values], Array], measured: Array, group: Mapping[str, tuple[float, float]]
) -> Ceiling:
    start = np.array([begin for begin, _ in group.values()])
    step = np.array([size for _, size in group.values()])

    def values(vector: Array) -> dict[str, float]:
        return dict(zip(group, (start + vector * step).tolist(), strict=True))

    best: dict[str, float] = {}
    if group:
        zeros = np.zeros(len(group))
        result = least_squares(lambda v: curve(values(v)) - measured, zeros, diff_step=1e-3)
        best = values(result.x)
    fitted = curve(best)
    return Ceiling(cross_correlation(fitted, measured), rmse(fitted, measured), best)


def noise_ceiling(measured: Array) -> float:
    """The zero-mean correlation of a recording with the same without its white noise."""
    share = sample_noise(measured) ** 2 / np.var(measured)
    return float(np.sqrt(max(0.0, float(1 - share))))


def eased(times: Array, legs: Sequence[float] | Array, settle: float) -> Array:
    """Times at which a body at constant speed is where one is that stops at every corner.

    Args:
        times: Since the start of a closed way, at limited acceleration [s], shape (n,).
        legs: Durations of the legs at constant speed [s].
        settle: Speed over acceleration [s].
    """
    legs = np.asarray(legs, dtype=float)
    if settle <= 0:
        return np.asarray(times, dtype=float)
    full = np.where(legs >= settle, legs + settle, 2 * np.sqrt(legs * settle))
    ends = np.concatenate([[0.0], np.cumsum(full)])
    now = np.where(times > 0, np.fmod(times, ends[-1]), 0.0)
    leg = np.clip(np.searchsorted(ends, now, side="right") - 1, 0, len(legs) - 1)
    since, last = now - ends[leg], full[leg]
    ramp = np.minimum(settle, 0.5 * last)
    way = np.where(
        since < ramp,
        0.5 * since**2 / settle,
        np.where(
            since < last - ramp,
            0.5 * ramp**2 / settle + ramp / settle * (since - ramp),
            legs[leg] - 0.5 * (last - since) ** 2 / settle,
        ),
    )
    return np.concatenate([[0.0], np.cumsum(legs)])[leg] + way


@dataclass(frozen=True)
class Eased(Scenario1Setup):
    """The set-up with a robot that stops at every corner, its acceleration limited."""

    settle: float = 0.0
    """Time to reach full speed [s]."""

    def poses(self, board: str, trajectory: str, speed: float, times: Any) -> list[Pose]:
        """Poses of the bar at times [s] since the start of a recording."""
        path = self.path(board, trajectory, speed)
        corners = np.array([pose.position for pose in path.waypoints])
        legs = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1) / speed
        since = eased(np.asarray(times, dtype=float) - self.rest, legs, self.settle)
        return [path.pose_at(time) for time in since.tolist()]
