"""One sensor of one client: takes frames, keeps the newest, answers with readings."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from capsense.errors import ProtocolError, ReadoutError
from capsense.reading import Reading
from capsense.readout import Readout
from capsense.readout.conversions import Counts
from capsense.scene import Body, Scene
from capsense.server.binary import (
    CONVERSION,
    NO_DETECTOR,
    DepthMessage,
    ReadingMessage,
    pack_depth,
    pack_reading,
)
from capsense.server.hands import HandsMessage, ServedHands
from capsense.server.messages import BodiesMessage, Open, PosesMessage
from capsense.simulator import Simulator

MAX_CONVERSIONS = 10_000
"""A step in time that spans more conversions of the readout than this is refused."""
Frame = DepthMessage | BodiesMessage


class Watcher(Protocol):
    """Somebody who watches a sensor."""

    def show(self, *messages: str | bytes) -> None:
        """Send these, in place of any that are not sent yet."""


class ServedSensor:
    """A simulator, its readout, and the newest frame that waits for it.

    :meth:`offer`, :meth:`take`, :meth:`drop` and :meth:`restart` belong to the event loop;
    :meth:`solve` may run in any thread, one call at a time, with :attr:`lock` held.

    Args:
        options: What the client asked for.
        simulator: Of its own.
        readout: Of its own, or None.
    """

    def __init__(self, options: Open, simulator: Simulator, readout: Readout | None) -> None:
        self.options = options
        self.simulator = simulator
        self.readout = readout
        self.lock = asyncio.Lock()
        """Held while a frame is solved and its reading sent."""
        self.frames = 0
        """Frames taken in."""
        self.readings = 0
        """Frames solved."""
        self.dropped = 0
        """Frames that newer ones replaced, or a reset or the end overtook."""
        self._waiting: Frame | None = None
        self._last = -1
        self.watchers: set[Watcher] = set()
        """Who is shown what this sensor sees and reads."""
        self.left = False
        """Whether it was closed."""
        self._bodies: dict[str, Body] = {}
        self._tables: tuple[Mapping[str, Any], ...] = ()
        self._time: float | None = None
        said = {k: v for k, v in options.table.items() if k in ("material", "grounding")}
        self.hands = ServedHands(
            options.hands, options.material, options.grounding, {"material": "steel", **said}
        )
        """What the client tracks; frames of shapes hold them too."""

    def offer(self, frame: Frame | PosesMessage | HandsMessage) -> None:
        """Take a frame in; one that still waits is dropped for it.

        Of tracked hands, :attr:`hands` must have been updated before.

        Raises:
            ProtocolError: Its number does not exceed the one before, or it moves an unknown body.
        """
        if frame.sequence <= self._last:
            raise ProtocolError(
                f"frame {frame.sequence} comes after frame {self._last}; numbers must rise, "
                "until a reset",
                "sequence",
            )
        self._last = frame.sequence
        if isinstance(frame, PosesMessage):
            frame = self._moved(frame)
        if isinstance(frame, BodiesMessage):
            self._bodies = {str(b.name): b for b in frame.bodies}
            self._tables = frame.tables
        if not isinstance(frame, DepthMessage):
            frame = BodiesMessage(
                frame.sensor, frame.sequence, frame.time,
                (*self._bodies.values(), *self.hands.bodies), (*self._tables, *self.hands.tables),
            )  # fmt: skip
        self.frames += 1
        self.drop()
        self._waiting = frame

    def take(self) -> Frame | None:
        """The frame that waits, if any; it waits no longer."""
        frame, self._waiting = self._waiting, None
        return frame

    def drop(self) -> None:
        """Drop the frame that waits, if any."""
        self.dropped += self.take() is not None

    def restart(self) -> None:
        """Forget everything but the bodies; the lock must be held."""
        self.drop()
        self.hands.reset()
        self._last, self._time = -1, None
        self.simulator.reset()

    def solve(self, frame: Frame) -> bytes:
        """The message that answers a frame.

        Raises:
            SceneError: The frame is wrong.
            SolveError: The solver did not reach its tolerance.
            ReadoutError: Time goes back, or leaps ahead.
        """
        self._check_time(frame.time)
        try:
            if isinstance(frame, BodiesMessage):
                reading = self.simulator.step(Scene(frame.bodies), time=frame.time)
            else:
                reading = self.simulator.step(self.options.seen(frame), time=frame.time)
        except Exception:
            self.simulator.reset()  # a step that failed is no starting point for the next one
            raise
        if self.readout is not None:
            reading = replace(reading, counts=self._sample(frame.time, reading))
        self.readings += 1
        return pack_reading(
            ReadingMessage(
                frame.sensor, frame.sequence, frame.time, reading.capacitance, reading.delta,
                reading.self_capacitance, reading.stats.iterations, self.dropped,
                reading.stats.solver_error, reading.stats.wall_time,
                _conversions(reading.counts), reading.touch if self.options.touch else None,
            )
        )  # fmt: skip

    def show(self, frame: Frame, reading: bytes) -> None:
        """Let all who watch see a frame, and the reading that answers it."""
        if self.watchers:
            seen = scene_message(frame) if isinstance(frame, BodiesMessage) else pack_depth(
                frame.sensor, frame.sequence, frame.time, frame.depth, frame.eps_r
            )  # fmt: skip
            for watcher in self.watchers:
                watcher.show(seen, reading)

    def leave(self) -> None:
        """Tell all who watch that there is nothing more to see."""
        self.left = True
        gone = json.dumps({"type": "unwatched", "sensor": self.options.sensor})
        for watcher in self.watchers:
            watcher.show(gone)
        self.watchers.clear()

    def _moved(self, message: PosesMessage) -> BodiesMessage:
        for name in (*message.poses, *message.forces):
            if name not in self._bodies:
                known = ", ".join(self._bodies) or "none"
                raise ProtocolError(f"the last scene has no body {name!r}; it has {known}", "scene")
        moved = {name: self._bodies[name].moved(pose) for name, pose in message.poses.items()}
        now = {**self._bodies, **moved}
        now |= {name: now[name].pressed(force) for name, force in message.forces.items()}
        bodies = tuple(now.values())
        return BodiesMessage(message.sensor, message.sequence, message.time, bodies, self._tables)

    def _check_time(self, time: float) -> None:
        """Refuse a time that the readout cannot go to."""
        if self.readout is None or self._time is None:
            return
        period = self.readout.schedule.period / len(self.readout.channel_names)
        if (time - self._time) / period > MAX_CONVERSIONS:
            raise ReadoutError(
                f"time leaps from {self._time:g} to {time:g} s, over more than {MAX_CONVERSIONS} "
                "conversions; send a reset first"
            )

    def _sample(self, time: float, reading: Reading) -> Counts:
        assert self.readout is not None
        if self._time is None:
            self.readout.reset(start=time)
        counts = self.readout.sample(time, reading)
        self._time = time
        return counts


def scene_message(frame: BodiesMessage) -> str:
    """The ``scene`` that is these bodies where they stand."""
    bodies = [
        {key: value for key, value in table.items() if key not in ("pose", "force")}
        | {
            "pose": {
                "position": list(map(float, body.pose.position)),
                "quaternion": list(map(float, body.pose.quaternion)),
            }
        }
        | ({} if body.force is None else {"force": body.force})
        for table, body in zip(frame.tables, frame.bodies, strict=True)
    ]
    address = {"sensor": frame.sensor, "sequence": frame.sequence, "time": frame.time}
    return json.dumps({"type": "scene", **address, "body": bodies})


def _conversions(counts: Counts | None) -> NDArray[np.void]:
    """Counts as the records of a message, shape (n,)."""
    out = np.zeros(0 if counts is None else len(counts), CONVERSION)
    if counts is None or not len(counts):
        return out
    for key in ("time", "code", "capacitance", "channel", "flags"):
        out[key] = getattr(counts, key)
    out["state"] = NO_DETECTOR
    if counts.baseline is not None and counts.touched is not None:
        out["baseline"], out["state"] = counts.baseline, counts.touched
    return out
