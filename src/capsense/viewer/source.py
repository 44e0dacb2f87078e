"""Where the viewer's instants come from: scenarios, recordings, and sensors of a server."""

from __future__ import annotations

import json
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from capsense.codec import design_from_json
from capsense.errors import ProtocolError, RecordingError, ServerError
from capsense.reading import Reading, StepStats
from capsense.recording import GONE, reading_of
from capsense.scenario import Channel, Scenario
from capsense.scenario.model import Excitation, channels_of
from capsense.scene import Body, Scene
from capsense.server import DepthMessage, ReadingMessage
from capsense.server.client import Client
from capsense.server.messages import MessageTable, Open, read_open, read_scene
from capsense.simulator import Simulator
from capsense.viewer.frame import Frame
from capsense.viewer.plane import Plane

if TYPE_CHECKING:
    from viser import ViserServer

    from capsense.recording.reader import Recording


Array = NDArray[np.float64]


class Source:
    """A sensor, and instants of it.

    Args:
        simulator: Potentials come from it.
    """

    title: str
    channels: tuple[Channel, ...]
    """What charts show."""
    empty: Reading
    """The reading with nothing in front of the sensor."""

    def __init__(self, simulator: Simulator) -> None:
        self.design = simulator.design
        self.cover = self.design.cover
        """Of the sensor; None where it tells no touch."""
        self.green = simulator.background.green if simulator.method == "surface" else None
        """Of the sensor, where potentials can be had; None where they cannot."""
        self._simulator = simulator

    def stage(self, server: ViserServer) -> Any:
        """What draws its instants into a server."""
        from capsense.viewer.scene_drawing import SceneDrawing

        return SceneDrawing(server, self.design)

    def potentials(self, frame: Frame, plane: Plane) -> Array:
        """Potentials of an instant at a plane's points [V], shape (n, terminals).

        Raises:
            CapSenseError: They could not be had.
        """
        return self._solved(frame.scene).potentials(plane.points)

    def _solved(self, scene: Scene) -> Reading:
        """A reading that keeps its field."""
        return self._simulator.solved(scene, keep_field=True)

    def close(self) -> None:
        """Let go of what is held."""


class Stream(Source, ABC):
    """Instants that come by themselves."""

    @abstractmethod
    def next(self, timeout: float) -> Frame | None:
        """The next one; None if none came within a time [s].

        Raises:
            CapSenseError: There will be none, or not before another call finds a new beginning.
        """


class Seekable(Source, ABC):
    """A row of instants, any of which can be asked for."""

    times: Array
    """Of the instants [s], increasing, shape (N,)."""

    @abstractmethod
    def frame(self, index: int, plane: Plane | None = None) -> Frame:
        """The instant of a number.

        Args:
            index: Its number.
            plane: Where potentials are wanted, if they are; ``green`` is not None then.

        Raises:
            CapSenseError: It could not be had.
        """


class ScenarioSource(Seekable):
    """Simulates a scenario, sample by sample as they are asked for.

    Args:
        scenario: What happens.
        simulator: Of the scenario's design.
    """

    def __init__(self, scenario: Scenario, simulator: Simulator) -> None:
        super().__init__(simulator)
        self.title, self._scenario = scenario.name, scenario
        self.times, self.channels = scenario.times, scenario.channels
        self.empty = simulator.empty

    def frame(self, index: int, plane: Plane | None = None) -> Frame:
        time = float(self.times[index])
        scene = self._scenario.scene_at(time)
        reading = self._simulator.step(scene, time=time, keep_field=plane is not None)
        if plane is None:
            return Frame(index, time, scene, reading)
        found, charges = reading.potentials(plane.points), reading.charges()
        return Frame(index, time, scene, reading, plane, found, charges)


class RecordingSource(Seekable):
    """Shows what a recording holds; the simulator is asked for potentials only.

    Those of a recording of a method that is gone come from ``"surface"``.

    Args:
        recording: Is read as a whole.
        progress: As for :class:`capsense.Simulator`.

    Raises:
        RecordingError: The recording is empty, or damaged.
        FieldError: The background field could not be built.
    """

    def __init__(
        self, recording: Recording, progress: Callable[[str, float], None] | None = None
    ) -> None:
        session = recording.session
        gone = session.method in GONE
        self._steps = list(recording.steps())
        if not self._steps:
            raise RecordingError(f"{recording.path} holds no steps; record some")
        super().__init__(session.simulator(method="surface" if gone else None, progress=progress))
        self.title = session.title or session.name
        self.times = np.array([step.clock for step in self._steps])
        self.channels, self.empty = session.channels, session.empty

    def frame(self, index: int, plane: Plane | None = None) -> Frame:
        step = self._steps[index]
        frame = Frame(index, float(self.times[index]), step.scene, step.reading)
        if plane is None:
            return frame
        kept = self._solved(step.scene)
        found, charges = kept.potentials(plane.points), kept.charges()
        return replace(frame, plane=plane, potentials=found, charges=charges)


Address = tuple[int, int]
Progress = Callable[[str, float], None]

RETRY = 0.5
"""While there is nothing to watch, the server is asked so often [s]."""


class Watched(Stream):
    """Watches a sensor that a client of a server opened.

    Nothing is sent to the server but the wish to watch. Times are those of arrival, since clients
    need not give any. When the client leaves, or the server stops, the next sensor of the same
    design is waited for.

    Args:
        url: The server's address.
        token: What the server was told to ask for.
        which: Numbers of the client and its sensor; None for whichever was opened last.
        waiting: Called once if no client has opened a sensor yet, before that is waited for.
        progress: As for :class:`capsense.Simulator`, which gives the potentials.

    Raises:
        ServerError: There is no server at the address.
        ProtocolError: The server refuses.
        FieldError: The background field could not be built.
    """

    def __init__(
        self, url: str, *, token: str = "", which: Address | None = None,
        waiting: Callable[[], None] = lambda: None, progress: Progress | None = None,
    ) -> None:  # fmt: skip
        self._url, self._token, self._which = url, token, which
        self._client: Client | None = self._connect()
        told = self._wait(self._client, waiting)
        self._open = _opened(told)
        design = design_from_json(json.dumps(told["design"]))
        super().__init__(Simulator(design, progress=progress))
        self.title = f"{self.design.name}, sensor {told['client']}:{told['sensor']} of {url}"
        self.channels = channels_of(Excitation.MATRIX, self.design.electrode_names)
        baseline = np.array(told["baseline"])
        nothing = np.zeros_like(baseline)
        self.empty = reading_of(self.design, baseline, nothing, nothing[0])
        self._began, self._count = time.monotonic(), 0
        self._seen: DepthMessage | dict[str, Any] | None = None
        self._scene = Scene()

    def next(self, timeout: float) -> Frame | None:
        try:
            if self._client is None:
                self._client = self._begin_anew()
            return self._receive(self._client, timeout)
        except (ProtocolError, ServerError):
            self.close()
            raise

    def close(self) -> None:
        """Close the connection."""
        if self._client is not None:
            self._client.close()
        self._client = None

    def _connect(self) -> Client:
        try:
            return Client(self._url, token=self._token, name="capsense view")
        except OSError as error:
            raise ServerError(
                f"there is no server to watch at {self._url}: {error}; start one with: capsense "
                "serve --design NAME --watch"
            ) from None

    def _ask(self, client: Client) -> dict[str, Any]:
        if self._which is None:
            return client.ask("watching", type="watch")
        number, sensor = self._which
        return client.ask("watching", type="watch", client=number, sensor=sensor)

    def _wait(self, client: Client, waiting: Callable[[], None]) -> dict[str, Any]:
        """Ask until there is something to watch."""
        told = False
        while True:
            try:
                return self._ask(client)
            except BaseException as error:
                nothing_yet = isinstance(error, ProtocolError) and error.code == "sensor"
                if not nothing_yet or self._which is not None:
                    client.close()
                    raise
            if not told:
                told = True
                waiting()
            time.sleep(RETRY)

    def _begin_anew(self) -> Client:
        """Find the next sensor of the same design."""
        client = self._connect()
        try:
            told = self._ask(client)
            if told["design"]["content_hash"] != self.design.content_hash():
                raise ProtocolError(
                    f"the sensor now has design {told['design']['name']!r}; start the view anew"
                )
        except BaseException:
            client.close()
            raise
        self._open, self._seen = _opened(told), None
        return client

    def _receive(self, client: Client, timeout: float) -> Frame | None:
        limit = time.monotonic() + timeout
        while True:
            try:
                found = client.receive(limit - time.monotonic())
            except ProtocolError as error:
                if error.code == "timeout":
                    return None
                raise
            if isinstance(found, ReadingMessage):
                if self._seen is not None:
                    return self._frame(found)
            elif isinstance(found, DepthMessage) or found["type"] == "scene":
                self._seen = found
            elif found["type"] == "unwatched":
                raise ProtocolError("the client has closed its sensor; waiting for another")

    def _frame(self, answer: ReadingMessage) -> Frame:
        assert self._seen is not None
        if isinstance(self._seen, DepthMessage):
            self._scene = self._open.seen(self._seen).scene()
        else:
            bodies = read_scene(
                MessageTable(self._seen, "message", "scene"), len(self._seen["body"])
            )
            self._scene = _alike(self._scene, Scene(bodies.bodies))
        coupling = answer.self_capacitance - np.diag(answer.capacitance)
        stats = StepStats(answer.solver_error, answer.wall_time, iterations=answer.iterations)
        reading = reading_of(self.design, answer.capacitance, answer.delta, coupling, stats)
        reading = replace(reading, touch=answer.touch)
        self._count += 1
        return Frame(self._count - 1, time.monotonic() - self._began, self._scene, reading)


def _opened(told: Mapping[str, Any]) -> Open:
    return read_open(MessageTable(told["open"], "message", "open"))


def _alike(old: Scene, new: Scene) -> Scene:
    """The new scene, made of the bodies of the old one where these have only moved.

    Shapes that are the same object need not be sent to the page, nor measured, again.
    """
    before = {b.name: b for b in old}

    def known(body: Body) -> Body:
        b = before.get(body.name, body)
        same = all(
            getattr(b, what) == getattr(body, what)
            for what in ("shape", "material", "grounding", "conductor")
        )
        return b.moved(body.pose).pressed(body.force) if same else body

    return Scene([known(body) for body in new])
