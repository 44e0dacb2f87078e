"""Shows instants in the order and at the pace that was asked for: :class:`Player`."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from capsense.errors import CapSenseError
from capsense.viewer.source import Frame, Seekable, Source

if TYPE_CHECKING:
    from capsense.viewer.charts import Plane

Array = NDArray[np.float64]

LATE = 0.25
"""A player that is this late [s] does not try to make up for it."""
FIELD_PERIOD = 0.1
"""While time runs, potentials are taken no more often [s]."""


class Playback(Protocol):
    """What a page shows, and how it is moved about in.

    Whoever watches looks at :attr:`newest`; what comes between two looks is not shown, and nobody
    who watches holds anything up. All methods may be called from any thread.
    """

    live: bool
    """Whether time goes on by itself, so that there is no speed and no end."""
    loop: bool
    """Whether the end is followed by the beginning."""
    plane: Plane | None
    """Where potentials are wanted; None where they are not."""
    with_field: Frame | None
    """The last one whose potentials were taken."""
    failure: CapSenseError | None
    """What stopped it; None again once it goes on."""

    @property
    def newest(self) -> Frame | None:
        """What is to be shown; None before there is any."""

    @property
    def source(self) -> Source:
        """Where instants come from."""

    @property
    def playing(self) -> bool:
        """Whether time runs."""

    @property
    def span(self) -> tuple[int, int]:
        """Numbers of the first and the last sample."""

    def history(self, index: int) -> tuple[Array, Array]:
        """The samples known up to one, for charts.

        Returns:
            Times [s], shape (n,), and changes of the channels from the empty scene [F], shape
            (n, K).
        """

    def play(self) -> None:
        """Let time run."""

    def pause(self) -> None:
        """Stop time."""

    def go(self, index: int) -> None:
        """Stop time, and show a sample, or the first or last if there is none of that number."""

    def step(self, count: int) -> None:
        """Stop time, and go ``count`` samples on, or back."""

    def set_speed(self, speed: float) -> None:
        """Set how many seconds of the source pass a second; 0 for as fast as it goes."""

    def stop(self) -> None:
        """End it, and close the source."""


class Player:
    """Asks a source for its samples, in a thread of its own. A :class:`Playback`.

    Args:
        source: Used by the player's thread alone from now on; closed by :meth:`stop`.
        speed: Seconds of the source a second; 0 for as fast as it goes.
    """

    live = False

    def __init__(self, source: Seekable, *, speed: float = 1.0) -> None:
        self.source = source
        self.loop = True
        self.plane: Plane | None = None
        self.newest: Frame | None = None
        self.with_field: Frame | None = None
        self.failure: CapSenseError | None = None
        self._changes: Array = np.full((len(source.times), len(source.channels)), np.nan)
        self._levels = np.array([c.read(source.empty) for c in source.channels])
        self._speed, self._playing, self._stopped = speed, False, False
        self._target: int | None = 0
        self._position = 0
        self._anchor = (0.0, 0.0)
        self._field_taken = -np.inf
        self._wake = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="capsense player", daemon=True)
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
        """See :class:`Playback`; samples that were skipped are not among them."""
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
        """Stop time, and step sample ``index``, or the first or last if there is none."""
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

    # -- the thread -----------------------------------------------------------------------------

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
        values = [c.read(frame.reading) for c in self.source.channels]
        self._changes[index] = np.array(values) - self._levels
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
