"""The WebSocket server: what it serves and to whom; many clients, each with sensors of its own."""

from __future__ import annotations

import asyncio
import copy
import json
import logging
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from http import HTTPStatus
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np

from capsense._validate import suggest
from capsense.design import load_design
from capsense.design.model import Design
from capsense.errors import ProtocolError, ServerError
from capsense.readout import SEED_STRIDE, Readout
from capsense.readout.config import file_content, make_readout, parse_readout
from capsense.scene import Body, Pose, Scene, Sphere
from capsense.scene.depth import DepthFrame
from capsense.server.binary import PROTOCOL
from capsense.server.connection import (
    FLOOD,
    TRY_LATER,
    AdmissionControl,
    Headers,
    RateLimitedConnection,
    Request,
    Response,
    ServerConnection,
    serve,
)
from capsense.server.messages import Open, Watch
from capsense.server.options import ServerOptions
from capsense.server.sensor import ServedSensor
from capsense.server.session import ClientSession
from capsense.simulator import Simulator

if TYPE_CHECKING:
    from websockets.typing import Origin

T = TypeVar("T")
CLOSING = 2.0
"""Longest time for answers to frames at hand, and again for connections to close [s]."""
Progress = Callable[[str, float], None]


_FIRST_VIEWS = (
    DepthFrame(np.full((8, 8), 0.1)),
    Scene([Body(Sphere(0.03), Pose((0.0, 0.0, 0.1)), material) for material in ("steel", "water")]),
)
"""Solved before the server listens: no client waits for kernels to be compiled."""


class Server:
    """Serves sensors of some designs until it is told to stop.

    Making it builds, or loads from the cache, the field of every design, and takes one step of
    each, so that no client waits for that.

    Args:
        options: What is served, and to whom.
        progress: Called with a stage's name and the fraction done while fields are built.
        logger: Gets one record an event: its name as the message, its fields as ``record.fields``.

    Raises:
        DesignError: A design is wrong.
        FieldError: A field could not be built.
        ReadoutError: There is no such readout.
        ServerError: Two designs have one name.
    """

    def __init__(
        self, options: ServerOptions, *, progress: Progress | None = None,
        logger: logging.Logger | None = None,
    ) -> None:  # fmt: skip
        self.options = options
        self.version = version("capsense")
        self.url = ""
        """Where it listens; empty before."""
        self._logger = logger or logging.getLogger("capsense.server")
        self._templates: dict[str, Simulator] = {}
        for design in self._load_designs():
            simulator = Simulator(design, progress=progress)
            self._templates[design.name] = simulator
            for view in _FIRST_VIEWS:
                simulator.step(view)
            self._make_readout(simulator, 0)
        self._sessions: dict[int, ClientSession] = {}
        self._counter = 0
        self._readings = 0
        self._started = time.monotonic()
        self._stopping = False
        # Every client has at most one solve and one message in work.
        self._pool = ThreadPoolExecutor(2 * options.limits.connections, "capsense")

    @property
    def clients(self) -> int:
        """How many are connected."""
        return len(self._sessions)

    @property
    def design_names(self) -> tuple[str, ...]:
        """Names of the designs, the default first."""
        return tuple(self._templates)

    async def run(self, stop: asyncio.Event) -> None:
        """Listen and serve until ``stop`` is set; then finish what is in work, and close.

        Raises:
            OSError: The address is taken or not this machine's.
        """
        options, limits = self.options, self.options.limits
        admission = AdmissionControl(2 * limits.connections + 16)
        listener = serve(
            self._serve, options.host, options.port,
            process_request=self._process_request,
            origins=cast("list[Origin | None]", [None, *options.origins]),
            compression=None, server_header=None,
            open_timeout=limits.hello_timeout, close_timeout=CLOSING,
            max_size=limits.message, max_queue=4,
            logger=_quiet(self._logger),
            create_connection=cast(
                "type[ServerConnection]", partial(RateLimitedConnection, admission=admission)
            ),
        )  # fmt: skip
        try:
            async with listener as server:
                host, port = next(iter(server.sockets)).getsockname()[:2]
                self.url = f"ws://[{host}]:{port}" if ":" in host else f"ws://{host}:{port}"
                self.log("listening", url=self.url, designs=self.design_names)
                await stop.wait()
                self._stopping = True
                self.log("stopping", clients=len(self._sessions))
                await self._finish()
        finally:
            self._pool.shutdown()
        self.log("stopped", readings=self.health()["readings"])

    def health(self) -> dict[str, Any]:
        """What ``GET /health`` answers."""
        sessions = tuple(self._sessions.values())
        return {
            "status": "stopping" if self._stopping else "ok",
            "version": self.version,
            "protocol": PROTOCOL,
            "designs": self.design_names,
            "clients": len(sessions),
            "sensors": sum(len(s.sensors) for s in sessions),
            "readings": self._readings + sum(s.readings for s in sessions),
            "uptime_s": round(time.monotonic() - self._started, 3),
        }

    async def _finish(self) -> None:
        """Let all clients have the answers to their frames at hand, if that is soon."""
        work = [asyncio.create_task(s.finish()) for s in self._sessions.values()]
        if work:
            await asyncio.wait(work, timeout=CLOSING)

    # -- what sessions need -----------------------------------------------------------------------

    def make_sensor(self, wanted: Open) -> ServedSensor:
        """A sensor for a client; runs in a worker thread.

        Raises:
            ProtocolError: The design is not served.
        """
        name = wanted.design or self.design_names[0]
        if name not in self._templates:
            raise ProtocolError(
                f"design {name!r} is not served; {suggest(name, self.design_names)}", "scene"
            )
        simulator = self._templates[name].copy()
        return ServedSensor(wanted, simulator, self._make_readout(simulator, wanted.sensor))

    def find(self, wanted: Watch) -> tuple[int, ServedSensor]:
        """A sensor that is to be watched, and the number of its client.

        Raises:
            ProtocolError: It is not open, or none may be watched.
        """
        if not self.options.watch:
            raise ProtocolError(
                "sensors of this server may not be watched; start it with --watch", "watch"
            )
        there = [(n, s) for n, c in self._sessions.items() for s in c.sensors.values()]
        address = wanted.client, wanted.sensor
        found = [
            p for p in there if wanted.client is None or address == (p[0], p[1].options.sensor)
        ]
        if not found:
            what = "sensor" if wanted.client is None else f"sensor {address[0]}:{address[1]}"
            known = ", ".join(f"{n}:{s.options.sensor}" for n, s in there) or "none"
            raise ProtocolError(f"there is no {what} to watch; open are {known}", "sensor")
        return found[-1]

    async def work(self, job: Callable[[], T]) -> T:
        """Do a job in a worker thread."""
        return await asyncio.get_running_loop().run_in_executor(self._pool, job)

    def log(self, event: str, **fields: Any) -> None:
        """Log an event."""
        self._logger.info(event, extra={"fields": fields})

    def fault(self, event: str, **fields: Any) -> None:
        """Log the exception at hand."""
        self._logger.exception(event, extra={"fields": fields})

    # -- connections ------------------------------------------------------------------------------

    async def _serve(self, connection: ServerConnection) -> None:
        """Serve one client, from its handshake to its end."""
        self._counter += 1
        session = ClientSession(self._counter, connection, self)
        peer = connection.remote_address
        if len(self._sessions) >= self.options.limits.connections:
            await session.dismiss(
                "full",
                f"{len(self._sessions)} clients are connected, as many as allowed",
                TRY_LATER,
            )
            return
        self._sessions[session.number] = session
        self.log("connected", client=session.number, peer=f"{peer[0]}:{peer[1]}")
        try:
            await session.run()
        except Exception:
            self.fault("internal error", client=session.number)
            raise
        finally:
            del self._sessions[session.number]
            if cast(RateLimitedConnection, connection).flooded:
                self.log("dismissed", client=session.number, code=FLOOD)
            self._readings += session.readings
            self.log("disconnected", client=session.number, readings=session.readings)

    def _process_request(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answer plain HTTP; let the handshake of a WebSocket go on."""
        path = request.path.partition("?")[0]
        status = HTTPStatus.SERVICE_UNAVAILABLE if self._stopping else HTTPStatus.OK
        if path == "/health" or self._stopping:
            return _json(status, self.health())
        if path != "/":
            return _json(HTTPStatus.NOT_FOUND, {"error": "there are / (WebSocket) and /health"})
        return None

    def _load_designs(self) -> list[Design]:
        """All designs, once none of them nor the readout is found wrong."""
        designs: dict[str, Design] = {}
        for name in self.options.designs:
            design = load_design(name)
            if design.name in designs:
                raise ServerError(f"two designs are named {design.name!r}")
            designs[design.name] = design
            choice = self.options.readout
            if choice is not None and not isinstance(choice, Readout):
                content = file_content(choice, design.electrode_names)
                parse_readout(content, design.electrode_names, source=str(choice))
        return list(designs.values())

    def _make_readout(self, simulator: Simulator, number: int) -> Readout | None:
        """The readout of a client's sensor; by their numbers, sensors have noise of their own."""
        choice = self.options.readout
        if choice is None:
            return None
        readout = copy.deepcopy(make_readout(choice, simulator))
        readout.reset(seed=readout.seed + number * SEED_STRIDE)
        return readout


def _json(status: HTTPStatus, content: dict[str, Any]) -> Response:
    body = json.dumps(content).encode() + b"\n"
    headers = Headers(
        {"Content-Type": "application/json", "Content-Length": str(len(body)),
         "Cache-Control": "no-store", "Connection": "close"}
    )  # fmt: skip
    return Response(status.value, status.phrase, headers, body)


def _quiet(logger: logging.Logger) -> logging.Logger:
    """A child for what websockets says of broken handshakes: that is the clients' fault."""
    child = logger.getChild("websockets")
    child.setLevel(logging.CRITICAL)
    return child
