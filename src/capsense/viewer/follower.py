"""Shows instants as they come, and keeps them to look at again: :class:`Follower`."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from capsense.errors import CapSenseError
from capsense.viewer.player import FIELD_PERIOD
from capsense.viewer.source import Frame, Stream

if TYPE_CHECKING:
    from capsense.viewer.plane import Plane

Array = NDArray[np.float64]

KEPT = 3000
"""At least so many samples are kept, and up to twice as many."""
WAIT = 0.05
"""Longest wait for a sample before potentials are looked after [s]."""
RETRY = 0.5
"""Pause after a failure [s]."""


class Follower:
    """Takes what a stream brings, in a thread of its own. A playback of live data.

    Samples come in and are kept whether time runs or not; what :meth:`pause` stops is the page.

    Args:
        source: Used by the follower's thread alone from now on; closed by :meth:`stop`.
    """

    live = True

    def __init__(self, source: Stream) -> None:
        self.source = source
        self.loop = False
        self.plane: Plane | None = None
        self.with_field: Frame | None = None
        self.failure: CapSenseError | None = None
        self._frames: list[Frame] = []
        self._first = 0
        self._shown: int | None = None
        self._times = np.empty(2 * KEPT)
        self._changes = np.empty((2 * KEPT, len(source.channels)))
        self._levels = np.array([c.read(source.empty) for c in source.channels])
        self._field_taken = -np.inf
        self._lock = threading.Lock()
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="capsense follower", daemon=True)
        self._thread.start()

    @property
    def playing(self) -> bool:
        """Whether the newest sample is shown."""
        return self._shown is None

    @property
    def span(self) -> tuple[int, int]:
        """Numbers of the first and the last sample that are kept."""
        with self._lock:
            return self._first, self._first + max(len(self._frames) - 1, 0)

    @property
    def newest(self) -> Frame | None:
        """What is to be shown; None before there is any."""
        with self._lock:
            if not self._frames:
                return None
            if self._shown is None:
                return self._frames[-1]
            return self._frames[max(self._shown - self._first, 0)]

    def history(self, index: int) -> tuple[Array, Array]:
        """See :class:`~capsense.viewer.player.Playback`."""
        with self._lock:
            stop = max(index - self._first, 0) + 1
            return self._times[:stop].copy(), self._changes[:stop].copy()

    def play(self) -> None:
        """Show the newest, always."""
        self._shown = None

    def pause(self) -> None:
        """Keep showing what is shown."""
        self.go(self._position())

    def go(self, index: int) -> None:
        """Show one sample, or the first or last if there is none of that number."""
        first, last = self.span
        self._shown = min(max(index, first), last)

    def step(self, count: int) -> None:
        """Show the sample ``count`` on, or back."""
        self.go(self._position() + count)

    def set_speed(self, speed: float) -> None:
        """Live data have a speed of their own."""

    def stop(self) -> None:
        """End the thread, and close the source."""
        self._stopped.set()
        self._thread.join()
        self.source.close()

    def _position(self) -> int:
        shown = self._shown
        return self.span[1] if shown is None else shown

    # -- the thread -----------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._stopped.is_set():
            try:
                self._take_potentials()
                frame = self.source.next(WAIT)
                if frame is not None:
                    self._keep(frame)
                self.failure = None
            except CapSenseError as error:
                self.failure = error
                self._stopped.wait(RETRY)

    def _keep(self, frame: Frame) -> None:
        values = [c.read(frame.reading) for c in self.source.channels]
        with self._lock:
            count = len(self._frames)
            if count == 2 * KEPT:
                count = KEPT
                self._first += KEPT
                del self._frames[:KEPT]
                self._times[:KEPT] = self._times[KEPT:]
                self._changes[:KEPT] = self._changes[KEPT:]
            self._times[count] = frame.time
            self._changes[count] = np.array(values) - self._levels
            self._frames.append(frame)

    def _take_potentials(self) -> None:
        """Take those of what is shown, when they are wanted and it is time."""
        frame, plane, now = self.newest, self.plane, time.monotonic()
        if plane is None or frame is None:
            return
        last = self.with_field
        taken = last is not None and (last.index, last.plane) == (frame.index, plane)
        if not taken and now - self._field_taken >= FIELD_PERIOD:
            found = self.source.potentials(frame, plane)
            self.with_field = replace(frame, plane=plane, potentials=found)
            self._field_taken = now
