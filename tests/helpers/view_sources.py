"""Made-up sources of a view, and patience."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable
from typing import Any

import numpy as np

import capsense as cs
from capsense.errors import ProtocolError, SolveError
from capsense.recording import reading_of
from capsense.scenario.model import Excitation, channels_of
from capsense.viewer.source import Frame

WAIT = 10.0
"""Longest wait for anything [s]."""


class Stated:
    """What sources have in common; sample k has k + 1 farads in every entry."""

    def __init__(self, title: str, design: str = "patch") -> None:
        self.title, self.design = title, cs.load_design(design)
        self.channels = channels_of(Excitation.MATRIX, self.design.electrode_names)
        self.empty = self.reading(-1)
        self.green, self.cover = None, self.design.cover
        self.closed = False

    def stage(self, server: Any) -> Any:
        from capsense.viewer.scene_drawing import SceneDrawing

        return SceneDrawing(server, self.design)

    def reading(self, k: int) -> cs.Reading:
        n = len(self.design.electrodes)
        return reading_of(
            self.design, np.full((n, n), k + 1.0), np.full((n, n), k + 1.0), np.zeros(n)
        )

    def close(self) -> None:
        self.closed = True


class Counting(Stated):
    """A source of ``count`` samples."""

    def __init__(self, count: int = 20, period: float = 1e-3) -> None:
        super().__init__("counting")
        self.times = period * np.arange(count)
        self.asked: list[tuple[int, object]] = []
        self.broken: set[int] = set()

    def frame(self, index: int, plane: object = None) -> Frame:
        self.asked.append((index, plane))
        if index in self.broken:
            raise SolveError(f"sample {index} was not solved")
        potentials = None if plane is None else np.full((3, 2), float(index))
        time = float(self.times[index])
        return Frame(index, time, cs.Scene(), self.reading(index), plane, potentials)


class Queued(Stated):
    """A stream of what tests put in."""

    def __init__(self) -> None:
        super().__init__("queued")
        self.items: queue.Queue[Frame | ProtocolError] = queue.Queue()
        self.count = 0

    def put(self, count: int = 1) -> None:
        for k in range(self.count, self.count + count):
            self.items.put(Frame(k, 0.1 * k, cs.Scene(), self.reading(k)))
        self.count += count

    def next(self, timeout: float) -> Frame | None:
        try:
            item = self.items.get(timeout=timeout)
        except queue.Empty:
            return None
        if isinstance(item, ProtocolError):
            raise item
        return item

    def potentials(self, frame: Frame, plane: object) -> np.ndarray:
        return np.full((3, 2), float(frame.index))


def until(condition: Callable[[], bool]) -> None:
    limit = time.monotonic() + WAIT
    while not condition():
        assert time.monotonic() < limit
        time.sleep(1e-3)
