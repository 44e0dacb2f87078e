"""Reading recordings: the session at once, the steps one after another."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from capsense.errors import RecordingError, SceneError
from capsense.reading import Reading, StepStats
from capsense.readout.counts import Counts
from capsense.recording.design_json import design_from_json
from capsense.recording.messages import PACKAGE, Messages, require
from capsense.recording.parts import CHANGING, read_body, read_rest, read_shape
from capsense.recording.session import DESIGN, NAME, SESSION, Session, read_session, reading_of
from capsense.scene import Body, Pose, RestSurface, Scene, Shape


@dataclass(frozen=True, eq=False)
class Step:
    """One recorded step."""

    index: int
    """Number of the step, from 0."""
    episode: int
    """How often the simulator had been reset since the recording began."""
    time: float
    """Its time [s]; it starts anew in each episode."""
    stamp: int
    """The same on the recording's clock, which never goes back [ns]."""
    scene: Scene
    """What the simulator was given, to the last bit."""
    reading: Reading
    """What it returned."""

    @property
    def clock(self) -> float:
        """Time on the recording's clock [s]; the same as ``time`` in the first episode."""
        return self.time + 1e-9 * (self.stamp - round(1e9 * self.time))


class Recording:
    """A recording, opened by :func:`open_recording`."""

    def __init__(self, path: Path, session: Session, *, complete: bool) -> None:
        self.path = path
        self.session = session
        """The sensor, the simulator's settings, and versions."""
        self.complete = complete
        """Whether it was closed. One that was not holds what was written until then."""

    def steps(self) -> Iterator[Step]:
        """The steps in order, read from the file as they are asked for.

        Raises:
            RecordingError: The file is damaged.
        """
        from mcap.records import Channel, Message, Schema

        from capsense.recording.records import read_records

        build = _Builder(self.session)
        types: dict[int, str] = {}
        topics: dict[int, tuple[str, str]] = {}
        for record in read_records(self.path):
            if isinstance(record, Schema):
                types[record.id] = record.name
            elif isinstance(record, Channel):
                topics[record.id] = (record.topic, types.get(record.schema_id, ""))
            elif isinstance(record, Message):
                topic, type_name = topics.get(record.channel_id, ("", ""))
                own = type_name.startswith(PACKAGE) and topic.startswith(f"/{self.session.name}/")
                step = build.take(record, type_name) if own else None
                if step is not None:
                    yield step


def open_recording(path: str | Path) -> Recording:
    """Open a recording.

    Args:
        path: A file that :class:`~capsense.recording.recorder.Recorder` wrote, closed or not.

    Raises:
        RecordingError: There is no such file, or it is not a recording, or damaged.
        MissingDependencyError: The optional packages are not installed.
    """
    require()
    from mcap.records import Attachment, Message, Metadata

    from capsense.recording.records import ends_well, read_records

    file = Path(path)
    complete = ends_well(file)
    marked, found = False, dict[str, bytes]()
    for record in read_records(file):
        if isinstance(record, Metadata) and record.name == NAME:
            marked = True
        elif isinstance(record, Attachment):
            found[record.name] = record.data
        elif isinstance(record, Message):
            break
        if DESIGN in found and SESSION in found:
            break
    if not marked or DESIGN not in found or SESSION not in found:
        raise RecordingError(
            f"{file} is an MCAP file, but no recording of capsense: it lacks "
            f"{'the metadata ' + NAME if not marked else 'the attachments'}"
        )
    session = read_session(found[SESSION], design_from_json(found[DESIGN]))
    return Recording(file, session, complete=complete)


class _Builder:
    """Makes steps of messages."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._messages = Messages()
        self._shapes: dict[int, Shape] = {}
        self._rests: dict[int, RestSurface] = {}
        self._bodies: dict[int, Body] = {}
        self._counts: Counts | None = None
        self._next = 0

    def take(self, record: Any, type_name: str) -> Step | None:
        """The step that a message completes, if it does."""
        m = self._messages.decode(record.data, type_name)
        match type_name.rpartition("/")[2]:
            case "Shape":
                if m.kind == "rest":
                    self._rests[m.id] = read_rest(m)
                else:
                    self._shapes[m.id] = read_shape(m, self._rests)
            case "Body":
                self._bodies[m.id] = read_body(m, self._shapes)
            case "Counts":
                self._counts = _counts(m)
            case "Step":
                if record.sequence != self._next:
                    raise RecordingError(
                        f"step {self._next} is missing from the recording; it is damaged"
                    )
                self._next += 1
                return self._step(m, record.log_time)
        return None

    def _step(self, m: Any, stamp: int) -> Step:
        stats = StepStats(m.error_estimate, m.wall_time, iterations=m.iterations)
        reading = reading_of(self._session.design, m.capacitance, m.delta, m.shield_coupling, stats)
        counts, self._counts = self._counts, None
        if counts is not None:
            reading = replace(reading, counts=counts)
        return Step(self._next - 1, m.episode, m.time, stamp, self._scene(m), reading)

    def _scene(self, m: Any) -> Scene:
        bodies = []
        try:
            for number, p in zip(m.bodies.tolist(), m.poses, strict=True):
                q = p.orientation
                pose = Pose.from_unit(
                    (p.position.x, p.position.y, p.position.z), (q.x, q.y, q.z, q.w)
                )
                bodies.append(self._bodies[number].moved(pose))
            scene = Scene(bodies)
        except (KeyError, ValueError, SceneError) as error:
            raise RecordingError(
                f"the scene of step {self._next - 1} is damaged: {error!r}"
            ) from None
        self._forget(set(m.bodies.tolist()))
        return scene

    def _forget(self, used: set[int]) -> None:
        """Let go of shapes that are in one step only."""
        for number in [n for n in used if isinstance(self._bodies[n].shape, CHANGING)]:
            shape = self._bodies.pop(number).shape
            self._shapes = {n: s for n, s in self._shapes.items() if s is not shape}


def _counts(m: Any) -> Counts:
    n, k = len(m.time), len(m.channel_names)
    columns = (m.time, m.channel, m.code, m.capacitance, m.flags)
    logic = (m.baseline, m.touched)
    if any(len(c) != n for c in columns) or any(len(c) not in (0, n) for c in logic):
        raise RecordingError("counts in the recording are damaged: columns of different lengths")
    if n and int(m.channel.max()) >= k:
        raise RecordingError("counts in the recording are damaged: no such channel")
    baseline, touched = (c if len(c) and n else None for c in logic)
    return Counts(
        tuple(m.channel_names), m.time, m.channel.astype(np.int64), m.code, m.capacitance, m.flags,
        baseline, touched,
    )  # fmt: skip
