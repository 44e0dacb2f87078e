"""A sensor of a running server, as its client sees it: :class:`Watched`."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from capsense.codec import design_from_json
from capsense.errors import ProtocolError, ServerError
from capsense.reading import Reading, StepStats
from capsense.recording.session import reading_of
from capsense.scenario.model import Excitation, channels_of
from capsense.scene import Body, DepthFrame, Scene
from capsense.server.client import Client
from capsense.server.frames import DepthMessage, ReadingMessage
from capsense.server.messages import MessageTable, Open, read_open, read_scene
from capsense.simulator import Simulator
from capsense.viewer.source import Frame, green_of

if TYPE_CHECKING:
    from capsense.viewer.charts import Plane

Array = NDArray[np.float64]
Address = tuple[int, int]
Progress = Callable[[str, float], None]

RETRY = 0.5
"""While there is nothing to watch, the server is asked so often [s]."""


class Watched:
    """Watches a sensor that a client of a server opened. A :class:`~capsense.viewer.source.Stream`.

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
        self.design = design_from_json(json.dumps(told["design"]))
        self.title = f"{self.design.name}, sensor {told['client']}:{told['sensor']} of {url}"
        self.channels = channels_of(Excitation.MATRIX, self.design.electrode_names)
        baseline = np.array(told["baseline"])
        nothing = np.zeros_like(baseline)
        self.empty = reading_of(self.design, baseline, nothing, nothing[0])
        self._simulator = Simulator(self.design, progress=progress)
        self.green = green_of(self._simulator)
        self._began, self._count = time.monotonic(), 0
        self._seen: DepthMessage | dict[str, Any] | None = None
        self._scene = Scene()

    def next(self, timeout: float) -> Frame | None:
        """See :class:`~capsense.viewer.source.Stream`."""
        try:
            if self._client is None:
                self._client = self._begin_anew()
            return self._receive(self._client, timeout)
        except (ProtocolError, ServerError):
            self.close()
            raise

    def potentials(self, frame: Frame, plane: Plane) -> Array:
        """See :class:`~capsense.viewer.source.Stream`."""
        self._simulator.step(frame.scene)
        return self._simulator.potentials(plane.points)

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
            self._scene = self._depth_scene(self._seen)
        else:
            bodies = read_scene(
                MessageTable(self._seen, "message", "scene"), len(self._seen["body"])
            )
            self._scene = _alike(self._scene, Scene(bodies.bodies))
        coupling = answer.self_capacitance - np.diag(answer.capacitance)
        stats = StepStats(answer.solver_error, answer.wall_time, iterations=answer.iterations)
        reading: Reading = reading_of(
            self.design, answer.capacitance, answer.delta, coupling, stats
        )
        self._count += 1
        return Frame(self._count - 1, time.monotonic() - self._began, self._scene, reading)

    def _depth_scene(self, seen: DepthMessage) -> Scene:
        o = self._open
        matter = o.material if seen.eps_r is None else seen.eps_r
        return DepthFrame(seen.depth, matter, o.camera, grounding=o.grounding, back=o.back).scene()


def _opened(told: Mapping[str, Any]) -> Open:
    return read_open(MessageTable(told["open"], "message", "open"))


def _alike(old: Scene, new: Scene) -> Scene:
    """The new scene, made of the bodies of the old one where these have only moved.

    Shapes that are the same object need not be sent to the page, nor measured, again.
    """
    before = {b.name: b for b in old}

    def known(body: Body) -> Body:
        b = before.get(body.name, body)
        same = (b.shape, b.material, b.grounding) == (body.shape, body.material, body.grounding)
        return b.moved(body.pose) if same else body

    return Scene([known(body) for body in new])
