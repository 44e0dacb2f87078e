"""Replaying: step a new simulator through a recording, and compare the readings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from capsense.errors import RecordingError
from capsense.reading import Reading
from capsense.readout.counts import Counts
from capsense.recording.reader import Recording, open_recording
from capsense.recording.session import Session, shield_coupling
from capsense.recording.versions import versions
from capsense.simulator import Method

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Difference:
    """The first number that came out otherwise."""

    step: int
    """Number of the step, from 0; −1 for the empty domain."""
    time: float
    """Its time [s]."""
    what: str
    """Which number."""
    recorded: float
    replayed: float

    def __str__(self) -> str:
        where = f"step {self.step} at {self.time:g} s" if self.step >= 0 else "the empty domain"
        return f"{where}: {self.what} was {self.recorded!r}, is {self.replayed!r}"


@dataclass(frozen=True)
class Replay:
    """What came of a replay."""

    steps: int
    """Steps replayed."""
    complete: bool
    """Whether the recording had been closed."""
    differing: int
    """Steps in which a number differed by more than was allowed."""
    first: Difference | None
    """The first of those numbers."""
    largest: float
    """Largest difference of a capacitance [F], allowed or not."""
    counts: int | None
    """Conversions of the readout that were compared; None where it cannot be built again."""
    changed: dict[str, tuple[str, str]]
    """Versions and the processor, where they are others: as recorded, and here."""

    @property
    def same(self) -> bool:
        """Whether all numbers were the same, or within what was allowed."""
        return self.first is None


def replay(
    path: str | Path | Recording,
    *,
    method: Method | None = None,
    tolerance: float = 0.0,
    cache_dir: Path | None = None,
    progress: Callable[[str, float], None] | None = None,
    each: Callable[[int], None] | None = None,
) -> Replay:
    """Simulate a recording again, and compare every reading.

    The simulator is built from the recorded design and settings, and is reset where the recorded
    one was. On the same versions and processor, all readings come out the same to the last bit.

    Args:
        path: The recording.
        method: Simulate with this method instead of the recorded one.
        tolerance: Difference of a capacitance that is allowed [F]; counts must be the same, unless
            it is above zero.
        cache_dir: As for :class:`capsense.Simulator`.
        progress: As for :class:`capsense.Simulator`.
        each: Called after every step with how many were replayed.

    Raises:
        RecordingError: The file is no recording, or damaged, or made by a method that is gone.
        FieldError: The background field could not be built.
        SolveError: A step could not be solved.
    """
    if not (np.isfinite(tolerance) and tolerance >= 0):
        raise RecordingError(f"tolerance is {tolerance!r} F; give zero or more")
    recording = path if isinstance(path, Recording) else open_recording(path)
    session = recording.session
    simulator = session.simulator(method=method, cache_dir=cache_dir, progress=progress)
    simulator.reset()  # as the recorder did; the masked method keeps a solution from its making
    readout = session.new_readout()
    compare = _Comparison(session, tolerance)
    compare.baseline(simulator.baseline)
    episode, n, conversions = 0, 0, 0
    for step in recording.steps():
        if step.episode != episode:
            episode = step.episode
            simulator.reset()
            if readout is not None:
                readout.reset()
        reading = simulator.step(step.scene)
        compare.step(step.index, step.time, step.reading, reading)
        if readout is not None:
            counts = readout.sample(step.time, reading)
            conversions += len(counts)
            compare.counts(step.index, step.time, step.reading.counts, counts)
        n += 1
        if each is not None:
            each(n)
    return Replay(
        n, recording.complete, len(compare.differing), compare.first, compare.largest,
        None if readout is None else conversions, _changed(session),
    )  # fmt: skip


class _Comparison:
    """Compares numbers, and remembers the first that differs."""

    def __init__(self, session: Session, tolerance: float) -> None:
        self._session, self._tolerance = session, tolerance
        self._names = session.design.electrode_names
        self.first: Difference | None = None
        self.largest = 0.0
        self.differing: set[int] = set()

    def baseline(self, baseline: Array) -> None:
        """Compare the matrix of the empty domain."""
        self._matrices(-1, 0.0, "C", self._session.empty.capacitance, baseline)

    def step(self, index: int, time: float, recorded: Reading, replayed: Reading) -> None:
        """Compare two readings."""
        self._matrices(index, time, "C", recorded.capacitance, replayed.capacitance)
        self._matrices(index, time, "delta", recorded.delta, replayed.delta)
        was, now = shield_coupling(recorded), shield_coupling(replayed)
        names = [f"shield coupling of {n} [F]" for n in self._names]
        self._farads(index, time, names, was, now)

    def counts(self, index: int, time: float, recorded: Counts | None, replayed: Counts) -> None:
        """Compare what a readout reported; bit by bit, as codes are whole numbers."""
        if self._tolerance > 0:
            return
        was = 0 if recorded is None else len(recorded)
        if was != len(replayed):
            self._differs(index, time, "number of conversions", was, len(replayed))
        elif recorded is not None:
            for name in ("time", "channel", "code", "capacitance", "flags", "baseline", "touched"):
                a, b = getattr(recorded, name), getattr(replayed, name)
                if a is not None and b is not None and (a != b).any():
                    k = int(np.flatnonzero(a != b)[0])
                    channel = recorded.channel_names[int(recorded.channel[k])]
                    self._differs(index, time, f"{name} of {channel}", float(a[k]), float(b[k]))
                    return

    def _matrices(self, index: int, time: float, what: str, was: Array, now: Array) -> None:
        names = [f"{what}({a}, {b}) [F]" for a in self._names for b in self._names]
        self._farads(index, time, names, was.ravel(), now.ravel())

    def _farads(self, index: int, time: float, names: list[str], was: Array, now: Array) -> None:
        if np.array_equal(was, now):
            return
        gap = np.abs(now - was)
        self.largest = max(self.largest, float(np.max(gap)))
        wrong = np.flatnonzero(~(gap <= self._tolerance))
        if len(wrong):
            k = int(wrong[0])
            self._differs(index, time, names[k], float(was[k]), float(now[k]))

    def _differs(self, index: int, time: float, what: str, was: float, now: float) -> None:
        if index >= 0:
            self.differing.add(index)
        if self.first is None:
            self.first = Difference(index, time, what, was, now)


def _changed(session: Session) -> dict[str, tuple[str, str]]:
    """What the numbers depend on, where it is not as it was."""
    then = session.versions
    return {
        key: (then.get(key, "unknown"), value)
        for key, value in versions().items()
        if key != "platform" and then.get(key) != value
    }
