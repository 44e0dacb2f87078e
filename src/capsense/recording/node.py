"""Sensors among the frames of ROS 2: poses come from transforms, readings go out as messages.

:class:`RosSensors` knows nothing of where messages come from and go to: :func:`follow` carries them
over DDS, :func:`convert` from a bag to an MCAP file.
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from capsense._validate import suggest
from capsense.design import Design
from capsense.errors import (
    AdapterError,
    RecordingError,
    ScenarioError,
    SceneError,
    SolveError,
    listed,
)
from capsense.reading import Reading
from capsense.readout import SEED_STRIDE, Readout
from capsense.readout.config import make_readout
from capsense.recording import check_name, ros
from capsense.recording import make_readout as choose_readout
from capsense.recording.dds import RosDomain
from capsense.recording.files import McapFile, check_target
from capsense.recording.transforms import TransformTree
from capsense.scenario import Scenario
from capsense.scene import Body, Scene
from capsense.simulator import Simulator

_SECOND = 10**9
TF, CLOCK = "tf2_msgs/msg/TFMessage", "rosgraph_msgs/msg/Clock"
_DIAGNOSTICS = 1.0
"""Time between two messages on ``/diagnostics`` where nothing changes [s]."""
_KEPT = 100
"""Messages of transforms that are kept until they are taken, as tf2's listener does."""
_LOOK = 0.1
"""Longest time between two looks at whether to stop [s]."""
_OK, _WARN, _ERROR, _STALE = 0, 1, 2, 3
"""Levels of ``diagnostic_msgs/DiagnosticStatus``."""
_TYPES = {"<f4": 7, "<f8": 8, "<u1": 2}
"""NumPy's names of numbers → those of ``sensor_msgs/PointField``."""
_SHOWN = 8
"""Names of frames that are listed in a message."""
_TIME = re.compile(r"[-+.e\d]+ s\b")
"""A time in a message."""


@dataclass(eq=False)
class _Site:
    """One sensor."""

    name: str
    frame: str
    simulator: Simulator
    readout: Readout | None
    last: float | None = None
    """Time of its last reading since it has read without a break [s]."""
    level: int = _OK
    told: tuple[str, ...] = ()
    """What was wrong at the last tick."""
    kinds: set[str] = field(default_factory=set)
    """The same without times, as it was when somebody was last told of it."""
    ages: dict[str, float] = field(default_factory=dict)
    """Ages of the bodies' transforms [s]."""


class RosSensors:
    """Sensors of one design at several frames, which see the same bodies at frames of their own.

    Args:
        scenario: The design, the method, and the bodies; where these are is not taken from it.
        sensors: Frame of each sensor, by its name; the name begins its topics.
        frames: Frame of each body that is not called as the body is, by the body's name.
        readout: A chip's name, or a readout file; None for none.
        seed: Of the chips.
        timeout: Transforms older than this are too old [s].
        leave_out: Whether bodies whose place is not known, or was known too long ago, are left out.
            By default a sensor then reads nothing.
        simulator: Makes the simulator, once all else is known to be right.

    Raises:
        RecordingError: A name is none, or the time-out no positive number.
        ScenarioError: A frame is given for a body that the scenario does not have.
        ReadoutError: There is no such chip or file, or the file is wrong.
        MissingDependencyError: ``rosbags`` is not installed.
    """

    def __init__(
        self, scenario: Scenario, sensors: Mapping[str, str], frames: Mapping[str, str], *,
        readout: str | Path | None = None, seed: int = 0, timeout: float = 0.5,
        leave_out: bool = False, simulator: Callable[[], Simulator] | None = None,
    ) -> None:  # fmt: skip
        ros.require()
        for name in sensors:
            check_name(name)
        if not 0 < timeout < 1e6:
            raise RecordingError(f"the time-out is {timeout!r} s; give a positive number")
        self._bodies = tuple(b.body for b in scenario.bodies)
        known = [str(b.name) for b in self._bodies]
        for body in frames:
            if body not in known:
                raise ScenarioError(f"frame of body {body!r}: {suggest(body, known)}")
        self._frames = {name: frames.get(name, name).lstrip("/") for name in known}
        if readout is not None:
            choose_readout(readout, scenario.design.electrode_names)
        self.warn: Callable[[str], object] = lambda _: None
        """Called with what is wrong, once when it begins."""
        self._timeout, self._leave_out = timeout, leave_out
        first = simulator() if simulator else Simulator(scenario.design, method=scenario.method)
        self._sites = []
        for number, (name, frame) in enumerate(sensors.items()):
            own = first if number == 0 else first.copy()
            chip = None if readout is None else make_readout(readout, own)
            if chip is not None:
                chip.reset(seed=seed + number * SEED_STRIDE)
            self._sites.append(_Site(name, frame.lstrip("/"), own, chip))
        self._places = _centres(scenario.design)
        self._tree = TransformTree()
        self._begin: int | None = None
        self._now = self._told = 0
        self._introduced = False
        self.count = 0
        """Readings so far, of all sensors."""

    def hear(self, message: Any, *, fixed: bool) -> None:
        """Take a message of ``/tf``, or of ``/tf_static`` if ``fixed``; a wrong one is warned of.

        Args:
            message: ``tf2_msgs/TFMessage``.
            fixed: Whether its transforms hold at any time.
        """
        try:
            self._tree.add(message, fixed=fixed)
        except ValueError as error:
            self.warn(f"{error}; it is ignored")

    def tick(self, now: int) -> ros.Topics:
        """Read all sensors.

        Args:
            now: Time on the clock that stamps transforms [ns]. If it goes back, all begins anew.

        Returns:
            What there is to publish, each with its topic.
        """
        if self._begin is not None and now < self._now:
            self.warn(f"time went back by {(self._now - now) / _SECOND:.3g} s; all begins anew")
            self._restart()
        if self._begin is None:
            self._begin = now
        self._now, out = now, ros.Topics()
        if not self._introduced:
            self._introduced = True
            out += [self._about(site) for site in self._sites]
        changed = [self._read(site, now, out) for site in self._sites]
        if any(changed) or now - self._told >= _DIAGNOSTICS * _SECOND:
            self._told = now
            out.append(("/diagnostics", self._diagnostics(now)))
        return out

    def _restart(self) -> None:
        self._begin, self._told = None, 0
        self._tree.forget()
        for site in self._sites:
            site.simulator.reset()
            site.last = None

    def _read(self, site: _Site, now: int, out: ros.Topics) -> bool:
        """Read a sensor; whether what is wrong with it has changed."""
        assert self._begin is not None
        at = (now - self._begin) / _SECOND
        bodies, wrong = self._seen(site, now)
        level = _STALE if wrong else _OK
        if wrong and self._leave_out:
            level = _WARN
        if level != _STALE:
            try:
                reading = site.simulator.step(Scene(bodies), time=at)
            except (SceneError, SolveError) as error:
                level, wrong = _ERROR, [str(error)]
            else:
                self.count += 1
                out += self._messages(site, now, at, reading)
        site.last = None if level in (_ERROR, _STALE) else at
        # ages grow from tick to tick: who is wrong, and how, is what may change
        kinds = {_TIME.sub("", text) for text in wrong}
        site.told = tuple(wrong)
        if (level, kinds) == (site.level, site.kinds):
            return False
        if level in (_WARN, _STALE) and at < self._timeout:
            return False  # they may be on their way
        site.level, site.kinds = level, kinds
        if wrong:
            then = "left out" if level == _WARN else "nothing is read"
            self.warn(f"sensor {site.name}: {'; '.join(wrong)}: {then}")
        else:
            self.warn(f"sensor {site.name}: all transforms are there again")
        return True

    def _seen(self, site: _Site, now: int) -> tuple[list[Body], list[str]]:
        """Bodies whose place is known, in the sensor's frame; and what is wrong with the others."""
        bodies, wrong = [], []
        for body in self._bodies:
            name = str(body.name)
            site.ages.pop(name, None)
            try:
                found = self._tree.find(site.frame, self._frames[name])
            except LookupError as error:
                wrong.append(f"body {name}: {error.args[0]}")
                continue
            age = 0.0 if found.stamp is None else (now - found.stamp) / _SECOND
            site.ages[name] = age
            if age > self._timeout:
                wrong.append(f"body {name}: its transform is {age:.3g} s old")
            elif age < -self._timeout:
                wrong.append(
                    f"body {name}: its transform is {-age:.3g} s ahead of this clock; set the "
                    "clocks alike, or take the simulator's (--sim-time)"
                )
            else:
                bodies.append(body.moved(found.pose))
        return bodies, wrong

    def _messages(self, site: _Site, now: int, at: float, reading: Reading) -> ros.Topics:
        """What a reading is for others."""
        head, name = (divmod(now, _SECOND), site.frame), f"/{site.name}"
        m = len(reading.electrode_names)
        square = [("row", m, m * m), ("column", m, m)]
        cloud = {"capacitance": np.diag(reading.capacitance), "change": np.diag(reading.delta)}
        touch = reading.touch
        if touch is not None:
            cloud |= {"force": touch.force, "compression": touch.compression}
        places = self._places
        out: ros.Topics = [
            (f"{name}/points", _cloud(head, np.array(list(places.values())), cloud)),
            (f"{name}/capacitance", _array("Float64", square, reading.capacitance)),
            (f"{name}/delta", _array("Float64", square, reading.delta)),
        ]
        if touch is not None:
            rows = [("force, compression", 2, 2 * m), ("electrode", m, m)]
            values = np.array([touch.force, touch.compression])
            out += [
                (f"{name}/touch", _array("Float64", rows, values)),
                (f"{name}/touch_total", ros.make("std_msgs/msg/Float64", data=touch.total)),
            ]
        if site.readout is not None:
            out += self._counts(site, head, at, reading)
        return out

    def _counts(self, site: _Site, head: Any, at: float, reading: Reading) -> ros.Topics:
        """What the registers of the chip hold."""
        chip, name = site.readout, f"/{site.name}"
        assert chip is not None
        if site.last is None:  # it has seen nothing for a while: nothing to interpolate from
            chip.reset(start=at)
        counts = chip.sample(at, reading)
        held, last = counts.held(), counts.last()
        k = len(counts.channel_names)
        flags, touched = np.zeros(k, np.uint8), np.zeros(k, np.uint8)
        flags[last.channel] = last.flags
        row = [("channel", k, k)]
        cloud: dict[str, NDArray[Any]] = {
            "capacitance": held.capacitance, "code": held.code, "age": held.age, "flags": flags,
        }  # fmt: skip
        out: ros.Topics = [(f"{name}/counts", _array("Int64", row, held.code))]
        if last.touched is not None:
            touched[last.channel] = last.touched
            cloud["touched"] = touched
            out.append((f"{name}/touched", _array("UInt8", row, touched)))
        out.append(
            (f"{name}/channel_points", _cloud(head, _channel_centres(chip, self._places), cloud))
        )
        return out

    def _about(self, site: _Site) -> tuple[str, Any]:
        """What does not change, as JSON in a string that latecomers get too."""
        chip = site.readout
        told = {
            "design": site.simulator.design.name, "frame": site.frame, "unit": "F",
            "electrodes": site.simulator.electrode_names,
            "baseline": site.simulator.baseline.tolist(),
            "chip": None if chip is None else chip.name,
            "channels": [] if chip is None else chip.channel_names,
            "bodies": self._frames,
        }  # fmt: skip
        text = json.dumps(told)
        return f"/{site.name}/about", ros.make("std_msgs/msg/String", data=text)

    def _diagnostics(self, now: int) -> Any:
        status = [
            {
                "level": s.level, "name": f"capsense: {s.name}",
                "message": "; ".join(s.told) or "all transforms are there",
                "hardware_id": s.simulator.design.name,
                "values": [(f"age of {n} [s]", f"{a:.3f}") for n, a in s.ages.items()],
            }
            for s in self._sites
        ]  # fmt: skip
        kind = "diagnostic_msgs/msg/DiagnosticArray"
        return ros.make(kind, header=(divmod(now, _SECOND), ""), status=status)

    @property
    def problems(self) -> str:
        """What is wrong now, of all sensors; and which frames have been heard of."""
        wrong = [f"sensor {s.name}: {'; '.join(s.told)}" for s in self._sites if s.told]
        heard = self._tree.frames
        known = f"frames are {listed(heard, _SHOWN)}" if heard else "no transform has been heard"
        return "; ".join([*wrong, known])


def _array(kind: str, dims: Sequence[tuple[str, int, int]], values: NDArray[Any]) -> Any:
    """A ``std_msgs/…MultiArray``."""
    return ros.make(f"std_msgs/msg/{kind}MultiArray", layout=(dims, 0), data=values.ravel())


def _cloud(head: Any, places: NDArray[np.float64], values: Mapping[str, NDArray[Any]]) -> Any:
    """A ``sensor_msgs/PointCloud2``: points in the sensor's frame [m], with numbers at each."""
    kinds = {n: "<u1" if v.dtype == np.uint8 else "<f8" for n, v in values.items()}
    names = [(axis, "<f4") for axis in "xyz"] + list(kinds.items())
    points = np.zeros(len(places), np.dtype(names))
    for k, axis in enumerate("xyz"):
        points[axis] = places[:, k]
    for name, column in values.items():
        points[name] = column
    kind: Any = points.dtype
    fields = [(n, kind.fields[n][1], _TYPES[what], 1) for n, what in names]
    return ros.make(
        "sensor_msgs/msg/PointCloud2", header=head, height=1, width=len(points), fields=fields,
        is_bigendian=False, point_step=kind.itemsize, row_step=points.nbytes,
        data=points.view(np.uint8).ravel(), is_dense=True,
    )  # fmt: skip


def _centres(design: Design) -> dict[str, NDArray[np.float64]]:
    """Centroids of the electrodes [m], shape (3,), by name."""
    out = {}
    for electrode in design.electrodes:
        corners = electrode.surface.triangles
        areas = np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        )
        out[electrode.name] = areas @ corners.mean(axis=1) / areas.sum()
    return out


def _channel_centres(
    chip: Readout, places: Mapping[str, NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Means of the centroids of the electrodes that each channel drives or reads [m], (K, 3)."""
    return np.array(
        [
            np.mean(
                [places[e] for e in {*p.weights, *(n for n, v in p.drive.items() if v)}], axis=0
            )
            for p in chip.bank.patterns
        ]
    )


def follow(
    sensors: RosSensors, domain: RosDomain, rate: float, stopped: Callable[[], bool], *,
    sim_time: bool = False,
) -> None:  # fmt: skip
    """Read sensors in time, at the transforms that come in, and publish what they read.

    Args:
        sensors: The sensors.
        domain: Where transforms come from and readings go to.
        rate: Readings of each sensor a second [Hz]. Where that is too fast, readings are left out.
        stopped: Whether to stop; asked several times a second.
        sim_time: Whether the time is that of ``/clock``, and not the system's.

    Raises:
        AdapterError: Publishing failed.
        RecordingError: A message that came in is damaged.
    """
    from cyclonedds.core import DDSException

    moving = domain.subscribe("/tf", TF, depth=_KEPT)
    fixed = domain.subscribe("/tf_static", TF, depth=_KEPT, lasting=True)
    clock = domain.subscribe("/clock", CLOCK, depth=1, reliable=False) if sim_time else None
    now: int | None = None
    due: int | None = None
    period = round(_SECOND / rate)
    while not stopped():
        for subscription in (fixed, moving):
            for message in subscription.take():
                sensors.hear(message, fixed=subscription is fixed)
        if clock is None:
            now = time.time_ns()
        else:
            for message in clock.take():
                now = message.clock.sec * _SECOND + message.clock.nanosec
        if now is not None and (due is None or now >= due or now < due - 2 * period):
            due = (now if due is None or abs(now - due) > period else due) + period
            try:
                for topic, message in sensors.tick(now):
                    domain.publish(topic, message)
            except DDSException as error:
                raise AdapterError(f"publishing to ROS failed: {error}") from None
        left = _LOOK if clock is not None or due is None else (due - time.time_ns()) / _SECOND
        domain.wait(min(max(left, 0.0), _LOOK))


def convert(
    sensors: RosSensors, source: Path, target: Path, rate: float, *, sim_time: bool = False,
    overwrite: bool = False, stopped: Callable[[], bool] = lambda: False,
) -> int:  # fmt: skip
    """Read sensors at the transforms of a bag, and write these and the readings into an MCAP file.

    Args:
        sensors: The sensors.
        source: The bag: an ``.mcap`` file, a folder of rosbag2, or a ``.bag`` of ROS 1.
        target: The MCAP file.
        rate: Readings of each sensor a second of the bag's time [Hz], from its first transform on.
        sim_time: Whether the time is that of ``/clock`` in the bag; by default when messages were
            recorded.
        overwrite: Whether a file that is there may be replaced.
        stopped: Whether to stop; asked at every reading.

    Returns:
        How many readings were written.

    Raises:
        RecordingError: The bag cannot be read, lacks ``/tf`` or, with ``sim_time``, ``/clock``, or
            no sensor could read anything.
        OSError: The file could not be written.
    """
    check_target(target, overwrite=overwrite)
    if target.exists() and source.exists() and target.samefile(source):
        raise RecordingError(f"{target} is the bag itself; give another name")
    with _opened(source) as (bag, topics):
        wanted = {name for name in ("/tf", "/clock" if sim_time else "/tf") if name not in topics}
        if wanted:
            raise RecordingError(
                f"{source} has no topic {', '.join(sorted(wanted))}; it has "
                f"{listed(sorted(topics), _SHOWN)}"
            )
        file = McapFile(target, overwrite=overwrite)
        try:
            _play(sensors, bag, topics, file, rate, sim_time, stopped)
        finally:
            file.close()
    if not sensors.count and not stopped():
        target.unlink()
        raise RecordingError(f"nothing could be read: {sensors.problems}")
    return sensors.count


class _opened:
    """A bag while it is read, and its connections by topic; what is wrong is one kind of error."""

    def __init__(self, source: Path) -> None:
        self._source = source

    def __enter__(self) -> tuple[Any, dict[str, list[Any]]]:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore

        try:
            self._bag = AnyReader(
                [self._source], default_typestore=get_typestore(Stores.ROS2_HUMBLE)
            )
            self._bag.open()
        except FileNotFoundError:
            raise RecordingError(f"there is no bag {self._source}; check the path") from None
        except (AnyReaderError, OSError) as error:
            raise RecordingError(f"{self._source} is no bag that can be read: {error}") from None
        topics: dict[str, list[Any]] = {}
        for connection in self._bag.connections:
            if connection.msgtype in (TF, CLOCK):
                topics.setdefault(connection.topic, []).append(connection)
        return self._bag, topics

    def __exit__(self, *_: object) -> None:
        self._bag.close()


def _play(
    sensors: RosSensors, bag: Any, topics: Mapping[str, list[Any]], file: McapFile, rate: float,
    sim_time: bool, stopped: Callable[[], bool],
) -> None:  # fmt: skip
    """Read at every period of the bag's time."""
    fixed = topics.get("/tf_static", [])
    for connection, stamp, raw in bag.messages(fixed) if fixed else ():
        message = bag.deserialize(raw, connection.msgtype)
        sensors.hear(message, fixed=True)
        file.write(stamp, [("/tf_static", message)])
    heard = [c for name in ("/tf", "/clock") if name in topics for c in topics[name]]
    begin: int | None = None
    number = 0

    def read_until(now: int, *, including: bool) -> None:
        nonlocal number
        assert begin is not None
        while (due := begin + round(number * _SECOND / rate)) < now + including:
            file.write(due, sensors.tick(due))
            number += 1
            if stopped():
                return

    last: int | None = None
    for connection, stamp, raw in bag.messages(heard):
        message = bag.deserialize(raw, connection.msgtype)
        is_clock = connection.topic == "/clock"
        if is_clock and sim_time:
            stamp = message.clock.sec * _SECOND + message.clock.nanosec
        if is_clock == sim_time:
            if begin is None or (last is not None and stamp < last):
                begin, number = stamp, 0
            read_until(stamp, including=False)
            last = stamp
        if not is_clock:
            sensors.hear(message, fixed=False)
            file.write(stamp if not sim_time or last is None else last, [("/tf", message)])
        if stopped():
            return
    if last is not None:
        read_until(last, including=True)
