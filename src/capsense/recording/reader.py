"""Reads recordings and replays them: readings of a new simulator against those recorded."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from capsense._validate import suggest
from capsense.codec import CHANGING, design_from_json, read_body, read_rest, read_shape
from capsense.errors import RecordingError, SceneError, listed
from capsense.reading import Reading, StepStats, Touch
from capsense.readout.conversions import Counts
from capsense.recording import (
    DESIGN,
    NAME,
    SESSION,
    Session,
    read_session,
    reading_of,
    versions,
)
from capsense.recording.ros import PACKAGE, decode, require
from capsense.scene import Body, Pose, RestSurface, Scene, Shape
from capsense.simulator import Method


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
    """Time on the recording's clock, which never goes back [ns]."""
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

        from capsense.recording.files import read_records

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


def open_recording(path: str | Path, sensor: str | None = None) -> Recording:
    """Open a recording.

    Args:
        path: A file that :func:`~capsense.recording.recorder.record` wrote, closed or not.
        sensor: Which sensor of a skin; of a recording of one sensor, that one.

    Raises:
        RecordingError: There is no such file or sensor, none of several was named, or the file is
            not a recording, or damaged.
        MissingDependencyError: The optional packages are not installed.
    """
    file, complete, found, folders = _said(path)
    names = [folder.removesuffix("/") for folder in folders if folder]
    if sensor is None and len(names) > 1:
        raise RecordingError(
            f"{file} holds {len(names)} sensors; name one of them: {listed(names, 8)}"
        )
    if sensor is None or not names:
        folder = folders[0]
    elif sensor in names:
        folder = f"{sensor}/"
    else:
        raise RecordingError(f"{file} has no sensor {sensor!r}; {suggest(str(sensor), names)}")
    session = read_session(found[folder + SESSION], design_from_json(found[folder + DESIGN]))
    if sensor not in (None, session.name):
        raise RecordingError(f"{file} has no sensor {sensor!r}; it is of {session.name!r}")
    return Recording(file, session, complete=complete)


def open_all(path: str | Path) -> list[Recording]:
    """The recordings of all sensors in a file.

    Raises:
        RecordingError: As by :func:`open_recording`.
    """
    names = [folder.removesuffix("/") or None for folder in _said(path)[3]]
    return [open_recording(path, name) for name in names]


def _said(path: str | Path) -> tuple[Path, bool, dict[str, bytes], list[str]]:
    """What a file says once.

    Returns:
        The file, whether it was closed, its attachments, and where those of each sensor begin.

    Raises:
        RecordingError: There is no such file, or it is not a recording, or damaged.
    """
    require()
    from mcap.records import Attachment, Message, Metadata

    from capsense.recording.files import ends_well, read_records

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
    folders = [key.removesuffix(DESIGN) for key in found if f"/{key}".endswith(f"/{DESIGN}")]
    folders = [folder for folder in folders if folder + SESSION in found]
    if not marked or not folders:
        raise RecordingError(
            f"{file} is an MCAP file, but no recording of capsense: it lacks "
            f"{'the metadata ' + NAME if not marked else 'the attachments'}"
        )
    return file, complete, found, folders


class _Builder:
    """Makes steps of messages."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._shapes: dict[int, Shape] = {}
        self._rests: dict[int, RestSurface] = {}
        self._bodies: dict[int, Body] = {}
        self._counts: Counts | None = None
        self._touch: Any = None
        self._next = 0

    def take(self, record: Any, type_name: str) -> Step | None:
        """The step that a message completes, if it does."""
        m = decode(record.data, type_name)
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
            case "Touch":
                self._touch = m
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
        touch, self._touch = self._touch, None
        forces: list[float] | None = None
        if touch is not None:
            reading = replace(reading, touch=_touch(touch, len(reading.electrode_names)))
            forces = touch.body_forces.tolist()
        return Step(self._next - 1, m.episode, m.time, stamp, self._scene(m, forces), reading)

    def _scene(self, m: Any, forces: list[float] | None) -> Scene:
        bodies = []
        forces = [math.nan] * len(m.bodies) if forces is None else forces
        try:
            for number, p, force in zip(m.bodies.tolist(), m.poses, forces, strict=True):
                q = p.orientation
                pose = Pose.from_unit(
                    (p.position.x, p.position.y, p.position.z), (q.x, q.y, q.z, q.w)
                )
                body = self._bodies[number].moved(pose)
                bodies.append(body if math.isnan(force) else body.pressed(force))
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


def _touch(m: Any, electrodes: int) -> Touch | None:
    if not len(m.force):
        return None
    if len(m.force) != electrodes or len(m.compression) != electrodes:
        raise RecordingError(f"a touch is not one of {electrodes} electrodes; it is damaged")
    return Touch(m.force, m.compression, m.total)


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
    """Conversions of the readout that were repeated; None where that cannot be built again, or
    where there was none: :attr:`recorded_counts` tells these apart."""
    recorded_counts: int
    """Conversions that the recording holds."""
    changed: dict[str, tuple[str, str]]
    """Versions and the processor, where they are others: as recorded, and here."""

    @property
    def same(self) -> bool:
        """Whether all numbers were the same, or within what was allowed."""
        return self.first is None

    def __str__(self) -> str:
        """What was compared, and what came of it, in a few lines."""
        lines = [f"steps        {self.steps}"]
        if self.counts is not None:
            lines.append(f"conversions  {self.counts}")
        elif self.recorded_counts:
            lines.append(
                f"conversions  {self.recorded_counts} recorded, not compared: the recording cannot "
                "build its readout again; give Recorder(readout=…) a chip's name or a file"
            )
        verdict = "same to the last bit"
        if self.largest > 0 or not self.same:
            verdict = "" if self.same else f"{self.differing} steps differ; "
            verdict += f"capacitances by at most {self.largest:.3g} F"
        return "\n".join([*lines, f"readings     {verdict}"])


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
    compare = _Comparison(session.design.electrode_names, tolerance)
    compare.readings(-1, 0.0, session.empty, simulator.empty)
    episode, n, conversions, held = 0, 0, 0, 0
    for step in recording.steps():
        if step.episode != episode:
            episode = step.episode
            simulator.reset()
            if readout is not None:
                readout.reset()
        reading = simulator.step(step.scene, time=step.time)
        compare.readings(step.index, step.time, step.reading, reading)
        held += 0 if step.reading.counts is None else len(step.reading.counts)
        if readout is not None:
            counts = readout.sample(step.time, reading)
            conversions += len(counts)
            compare.counts(step.index, step.time, step.reading.counts, counts)
        n += 1
        if each is not None:
            each(n)
    return Replay(
        n, recording.complete, len(compare.differing), compare.first, compare.largest,
        None if readout is None else conversions, held, _changed(session),
    )  # fmt: skip


class _Comparison:
    """Compares numbers, and remembers the first that differs."""

    def __init__(self, electrodes: Sequence[str], tolerance: float) -> None:
        pairs = [f"({a}, {b}) [F]" for a in electrodes for b in electrodes]
        self._names = [f"{what}{pair}" for what in ("C", "delta") for pair in pairs]
        self._names += [f"shield coupling of {n} [F]" for n in electrodes]
        self._touch = [f"force on {n} [N]" for n in electrodes]
        self._touch += [*(f"compression above {n} [m]" for n in electrodes), "total force [N]"]
        self._tolerance = tolerance
        self.first: Difference | None = None
        self.largest = 0.0
        self.differing: set[int] = set()

    def readings(self, index: int, time: float, recorded: Reading, replayed: Reading) -> None:
        """Compare two readings; what is pressed on bit by bit, unless there is a tolerance."""
        if self._tolerance == 0 and recorded.touch is not None and replayed.touch is not None:
            pairs = zip(_touch_row(recorded.touch), _touch_row(replayed.touch), strict=True)
            for name, (a, b) in zip(self._touch, pairs, strict=True):
                if a != b:
                    self._differs(index, time, name, a, b)
                    break
        was, now = (
            np.concatenate([r.capacitance.ravel(), r.delta.ravel(), r.shield_coupling])
            for r in (recorded, replayed)
        )
        if np.array_equal(was, now):
            return
        gap = np.abs(now - was)
        self.largest = max(self.largest, float(np.max(gap)))
        for k in np.flatnonzero(~(gap <= self._tolerance))[:1].tolist():
            self._differs(index, time, self._names[k], float(was[k]), float(now[k]))

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

    def _differs(self, index: int, time: float, what: str, was: float, now: float) -> None:
        if index >= 0:
            self.differing.add(index)
        if self.first is None:
            self.first = Difference(index, time, what, was, now)


def _touch_row(touch: Touch) -> list[float]:
    """Forces [N], compressions [m], and the total force [N]."""
    return [*touch.force.tolist(), *touch.compression.tolist(), touch.total]


def _changed(session: Session) -> dict[str, tuple[str, str]]:
    """What the numbers depend on, where it is not as it was."""
    then = session.versions
    return {
        key: (then.get(key, "unknown"), value)
        for key, value in versions().items()
        if key != "platform" and then.get(key) != value
    }
