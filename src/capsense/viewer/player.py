"""Shows instants of a source: :class:`Player` at a pace, :class:`Follower` as they come."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from capsense.errors import CapSenseError
from capsense.scenario.model import read_channels
from capsense.viewer.plane import Plane
from capsense.viewer.source import Frame, Seekable, Source, Stream

Array = NDArray[np.float64]

LATE = 0.25
"""A player that is this late [s] does not try to make up for it."""
FIELD_PERIOD = 0.1
"""While time runs, potentials are taken no more often [s]; nor sooner than after as long as they
took, so that whatever else the program does has half of a processor."""
KEPT = 3000
"""A follower keeps at least so many samples, and up to twice as many."""
WAIT = 0.05
"""Longest wait for a sample before potentials are looked after [s]."""
RETRY = 0.5
"""Pause after a failure [s]."""


class _Playing:
    """What both have in common: a thread that takes instants, and what a page shows of them.

    Whoever watches looks at ``newest``; what comes between two looks is not shown, and nobody who
    watches holds anything up. All methods may be called from any thread.

    Args:
        source: Used by the thread alone from now on; closed by ``stop``.
    """

    live: ClassVar[bool]
    """Whether time goes on by itself, so that there is no speed and no end."""

    def __init__(self, source: Source, run: Callable[[], None]) -> None:
        self.loop = not self.live
        """Whether the end is followed by the beginning."""
        self.plane: Plane | None = None
        """Where potentials are wanted; None where they are not."""
        self.with_field: Frame | None = None
        """The last one whose potentials were taken."""
        self.failure: CapSenseError | None = None
        """What stopped it; None again once it goes on."""
        self._channels = source.channels
        self._levels = read_channels(source.channels, source.empty)
        self._field_taken = -np.inf
        name = f"capsense {type(self).__name__.lower()}"
        self._thread = threading.Thread(target=run, name=name, daemon=True)

    def _changes_of(self, frame: Frame) -> Array:
        """Changes of the channels from the empty scene [F], shape (K,)."""
        return read_channels(self._channels, frame.reading) - self._levels


class Player(_Playing):
    """Asks a source for its samples, in their order.

    Args:
        source: Used by the player's thread alone from now on; closed by :meth:`stop`.
        speed: Seconds of the source a second; 0 for as fast as it goes.
    """

    live = False

    def __init__(self, source: Seekable, *, speed: float = 1.0) -> None:
        super().__init__(source, self._run)
        self.source = source
        """Where instants come from."""
        self.newest: Frame | None = None
        """What is to be shown; None before there is any."""
        self._changes: Array = np.full((len(source.times), len(source.channels)), np.nan)
        self._speed, self._playing, self._stopped = speed, False, False
        self._target: int | None = 0
        self._position = 0
        self._anchor = (0.0, 0.0)
        self._wake = threading.Condition()
        self._thread.start()

    @property
    def playing(self) -> bool:
        """Whether time runs."""
        return self._playing

    @property
    def span(self) -> tuple[int, int]:
        """Numbers of the first and the last sample."""
        return 0, len(self.source.times) - 1

    def history(self, index: int) -> tuple[Array, Array]:
        """The samples known up to one, for charts; those that were skipped are not among them.

        Returns:
            Times [s], shape (n,), and changes of the channels from the empty scene [F], shape
            (n, K).
        """
        known = np.flatnonzero(~np.isnan(self._changes[: index + 1, 0]))
        return self.source.times[known], self._changes[known]

    def play(self) -> None:
        """Let time run; from the beginning, where it had run out."""
        with self._wake:
            if self._position == len(self.source.times) - 1:
                self._target = 0
            self._playing = True
            self._set_anchor()
            self._wake.notify()

    def pause(self) -> None:
        """Stop time; the sample at hand is stepped once more, so that its potentials are there."""
        with self._wake:
            self.go(self._position)

    def go(self, index: int) -> None:
        """Stop time, and show a sample, or the first or last if there is none of that number."""
        with self._wake:
            self._playing = False
            self._target = min(max(index, 0), len(self.source.times) - 1)
            self._wake.notify()

    def step(self, count: int) -> None:
        """Stop time, and go ``count`` samples on, or back."""
        with self._wake:
            start = self._position if self._target is None else self._target
            self.go(start + count)

    def set_speed(self, speed: float) -> None:
        """Set how many seconds of the source pass a second; 0 for as fast as it goes."""
        with self._wake:
            self._speed = speed
            self._set_anchor()
            self._wake.notify()

    def stop(self) -> None:
        """End the thread, and close the source."""
        with self._wake:
            self._stopped = True
            self._wake.notify()
        self._thread.join()
        self.source.close()

    def _run(self) -> None:
        while (index := self._next()) is not None:
            try:
                self._take(index)
            except CapSenseError as error:
                with self._wake:
                    self.failure, self._playing = error, False

    def _take(self, index: int) -> None:
        now = time.monotonic()
        due = not self._playing or now - self._field_taken >= FIELD_PERIOD
        frame = self.source.frame(index, self.plane if due else None)
        self._changes[index] = self._changes_of(frame)
        if frame.potentials is not None:
            self.with_field, self._field_taken = frame, now
        self.newest, self.failure = frame, None

    def _next(self) -> int | None:
        """Wait until a sample is due; None to end."""
        with self._wake:
            while not self._stopped:
                if self._target is not None:
                    self._position, self._target = self._target, None
                    self._set_anchor()
                    return self._position
                wait = self._until_due()
                if wait is not None and wait <= 0:
                    return self._advance()
                self._wake.wait(wait)
            return None

    def _until_due(self) -> float | None:
        """Time until the next sample [s]; None while time stands still."""
        following = self._position + 1
        if self._playing and following == len(self.source.times) and not self.loop:
            self._playing = False
        if not self._playing:
            return None
        if not self._speed or following == len(self.source.times):
            return 0.0
        began, at = self._anchor
        return began + (float(self.source.times[following]) - at) / self._speed - time.monotonic()

    def _advance(self) -> int:
        wait = self._until_due()
        self._position += 1
        if self._position == len(self.source.times):
            self._position = 0
        if self._position == 0 or (wait is not None and wait < -LATE):
            self._set_anchor()
        return self._position

    def _set_anchor(self) -> None:
        self._anchor = (time.monotonic(), float(self.source.times[self._position]))


class Follower(_Playing):
    """Takes what a stream brings, and shows the newest.

    Samples come in and are kept whether time runs or not; what :meth:`pause` stops is the page.

    Args:
        source: Used by the follower's thread alone from now on; closed by :meth:`stop`.
    """

    live = True

    def __init__(self, source: Stream) -> None:
        super().__init__(source, self._run)
        self.source = source
        """Where instants come from."""
        self._frames: list[Frame] = []
        self._first = 0
        self._shown: int | None = None
        self._times = np.empty(2 * KEPT)
        self._changes = np.empty((2 * KEPT, len(source.channels)))
        self._lock = threading.Lock()
        self._stopped = threading.Event()
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
        """The samples kept up to one, for charts; as of :meth:`Player.history`."""
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

    def stop(self) -> None:
        """End the thread, and close the source."""
        self._stopped.set()
        self._thread.join()
        self.source.close()

    def _position(self) -> int:
        shown = self._shown
        return self.span[1] if shown is None else shown

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
        with self._lock:
            count = len(self._frames)
            if count == 2 * KEPT:
                count = KEPT
                self._first += KEPT
                del self._frames[:KEPT]
                self._times[:KEPT] = self._times[KEPT:]
                self._changes[:KEPT] = self._changes[KEPT:]
            self._times[count] = frame.time
            self._changes[count] = self._changes_of(frame)
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
            done = time.monotonic()
            self._field_taken = max(now, 2.0 * done - now - FIELD_PERIOD)


Playback = Player | Follower
"""What a page shows, and how it is moved about in."""
