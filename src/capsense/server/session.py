"""One client of the server: its messages, its sensors, and what they read."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any, Protocol, TypeVar

from capsense.codec import design_to_json
from capsense.errors import CapSenseError, ProtocolError
from capsense.server import messages
from capsense.server.binary import PROTOCOL, unpack_depth
from capsense.server.connection import POLICY, Allowance, ConnectionClosed, ServerConnection
from capsense.server.messages import BodiesMessage, Open, PosesMessage, Watch
from capsense.server.options import ServerOptions
from capsense.server.sensor import Frame, ServedSensor

T = TypeVar("T")

ALLOWANCE, ALL_ALLOWANCES = 5000.0, 10000.0
"""Work that a client, and that all of them, may cause a second without being slowed, in units of a
small message, which takes the event loop some 50 µs."""
AT_ONCE, AT_FIRST = 1000.0, 100.0
"""Work that a client may cause at once, after a rest and at the start."""
BINARY_UNIT, TEXT_UNIT = 16384, 512
"""Bytes that count as much as a message: JSON takes longer to read than pixels."""
OPENING, MISTAKE = 250.0, 100.0
"""What it takes to open a sensor, and to answer an error."""


class Host(Protocol):
    """What a session needs of the server that runs it."""

    version: str

    @property
    def options(self) -> ServerOptions:
        """What is served, and to whom."""

    @property
    def clients(self) -> int:
        """How many are connected."""

    @property
    def design_names(self) -> tuple[str, ...]:
        """Names of the designs, the default first."""

    def make_sensor(self, wanted: Open) -> ServedSensor:
        """A sensor for a client."""

    def find(self, wanted: Watch) -> tuple[int, ServedSensor]:
        """A sensor that is to be watched, and the number of its client."""

    async def work(self, job: Callable[[], T]) -> T:
        """Do a job in a worker thread."""

    def log(self, event: str, **fields: Any) -> None:
        """Log an event."""

    def fault(self, event: str, **fields: Any) -> None:
        """Log the exception at hand."""


class ClientSession:
    """Serves one client until it leaves.

    The reader handles messages in their order. The solver takes the newest frames of the sensors
    in turn, one solve at a time, each in a worker thread: no client gets more of the machine than
    another, and none is held up by a client whose reader or solver waits.

    Args:
        number: Of the client, for the log.
        connection: An open connection.
        server: Runs it.
    """

    def __init__(self, number: int, connection: ServerConnection, server: Host) -> None:
        self.number = number
        self.sensors: dict[int, ServedSensor] = {}
        self.readings = 0
        self._connection = connection
        self._server = server
        self._limits = server.options.limits
        self._wake = asyncio.Event()
        self._left = False
        self._solver: asyncio.Task[None] | None = None
        self._watched: ServedSensor | None = None
        self._to_show: tuple[str | bytes, ...] = ()
        self._allowance = Allowance(AT_ONCE, ALLOWANCE, AT_FIRST)
        self._handlers: dict[str, Callable[[messages.MessageTable], Any]] = {
            "open": self._open, "close": self._close, "reset": self._reset, "watch": self._watch,
            "scene": partial(self._frame, messages.read_scene),
            "poses": partial(self._frame, messages.read_poses), "hands": self._hands,
        }  # fmt: skip

    async def run(self) -> None:
        """Serve the client; returns when the connection is closed."""
        try:
            await self._greet()
        except CapSenseError as error:
            await self.dismiss(messages.code_of(error), str(error))
            return
        except ConnectionClosed:
            return
        self._solver = asyncio.create_task(self._solve_all())
        try:
            with suppress(ConnectionClosed):
                async for message in self._connection:
                    size = BINARY_UNIT if isinstance(message, bytes) else TEXT_UNIT
                    await self._pace(1 + len(message) / size)
                    await self._handle(message)
        finally:
            self._left = True
            self._wake.set()
            self._unwatch()
            for sensor in self.sensors.values():
                sensor.leave()
            await self._solver

    async def finish(self) -> None:
        """Answer the frame that is being solved, and solve no more."""
        self._left = True
        self._wake.set()
        if self._solver is not None:
            await self._solver

    def show(self, *messages: str | bytes) -> None:
        """Send what a watched sensor sees, in place of what is not sent yet."""
        self._to_show = messages
        self._wake.set()

    async def dismiss(self, code: str, text: str, close_code: int = POLICY) -> None:
        """Say what is wrong, and close the connection."""
        self._log("dismissed", code=code, message=text[:200])
        with suppress(ConnectionClosed):
            await self._send(json.dumps(messages.error_message(code, text)))
            await self._connection.close(close_code, code)

    # -- the reader -----------------------------------------------------------------------------

    async def _greet(self) -> None:
        """Wait for the hello, and answer it.

        Raises:
            ProtocolError: It did not come, is malformed, of another version, or lacks the token.
        """
        try:
            async with asyncio.timeout(self._limits.hello_timeout):
                message = await self._connection.recv()
        except TimeoutError:
            raise ProtocolError(
                f"no hello within {self._limits.hello_timeout:g} s", "timeout"
            ) from None
        if isinstance(message, bytes):
            raise ProtocolError("a binary message comes before the hello; say hello first")
        hello = messages.read_hello(messages.parse(message))
        if not self._server.options.admits(hello.token):
            raise ProtocolError("the token is missing or wrong", "token")
        self._log("hello", name=hello.client)
        told = ("sensors", "pixels", "bodies", "message")
        await self._tell(
            "welcome", protocol=PROTOCOL, server=f"capsense {self._server.version}",
            designs=self._server.design_names,
            limits={name: getattr(self._limits, name) for name in told}, touch=True, hands=True,
        )  # fmt: skip

    async def _pace(self, cost: float) -> None:
        """Charge some work; wait while the client has caused more than its allowance."""
        self._allowance.rate = min(ALLOWANCE, ALL_ALLOWANCES / self._server.clients)
        left = self._allowance.spend(cost)
        if left < 0:
            await asyncio.sleep(-left / self._allowance.rate)

    async def _handle(self, message: str | bytes) -> None:
        """Act on one message; whatever is wrong with it is answered."""
        try:
            if isinstance(message, bytes):
                frame = unpack_depth(message, self._limits.pixels)
                self._sensor(frame.sensor).offer(frame)
                self._wake.set()
                return
            table = messages.parse(message)
            kind = table.choice("type", tuple(self._handlers))
            await self._handlers[kind](table)
        except ConnectionClosed:
            raise
        except Exception as error:
            await self._refuse(error, **messages.address_of(message))

    async def _open(self, table: messages.MessageTable) -> None:
        wanted = messages.read_open(table)
        if self._watched is not None:
            raise ProtocolError("a client that watches opens no sensors; connect again", "watch")
        if wanted.sensor in self.sensors:
            raise ProtocolError(f"sensor {wanted.sensor} is open already; close it first", "sensor")
        if len(self.sensors) >= self._limits.sensors:
            raise ProtocolError(
                f"{len(self.sensors)} sensors are open, as many as allowed", "limit"
            )
        await self._pace(OPENING)
        sensor = await self._server.work(lambda: self._server.make_sensor(wanted))
        self.sensors[wanted.sensor] = sensor
        simulator, readout = sensor.simulator, sensor.readout
        self._log("opened", sensor=wanted.sensor, design=simulator.design.name)
        domain = simulator.design.domain
        await self._tell(
            "opened", sensor=wanted.sensor, design=simulator.design.name,
            electrodes=simulator.electrode_names, baseline=simulator.baseline.tolist(),
            domain=[domain.lower.tolist(), domain.upper.tolist()],
            channels=() if readout is None else readout.channel_names,
        )  # fmt: skip

    async def _close(self, table: messages.MessageTable) -> None:
        sensor = self._sensor(messages.read_sensor(table))
        number = sensor.options.sensor
        async with sensor.lock:
            sensor.drop()
            del self.sensors[number]
        sensor.leave()
        self._log("closed", sensor=number)
        await self._tell(
            "closed", sensor=number, frames=sensor.frames, readings=sensor.readings,
            dropped=sensor.dropped,
        )  # fmt: skip

    async def _watch(self, table: messages.MessageTable) -> None:
        wanted = messages.read_watch(table)
        if self.sensors:
            raise ProtocolError("a client that has sensors watches none; close them", "watch")
        client, sensor = self._server.find(wanted)
        design = await self._server.work(lambda: design_to_json(sensor.simulator.design))
        self._unwatch()
        await self._tell(
            "watching", client=client, sensor=sensor.options.sensor, open=sensor.options.table,
            design=json.loads(design), baseline=sensor.simulator.baseline.tolist(),
        )  # fmt: skip
        self._log("watches", watched=client, sensor=sensor.options.sensor)
        self._watched = sensor
        sensor.watchers.add(self)
        if sensor.left:  # meanwhile
            sensor.leave()

    def _unwatch(self) -> None:
        if self._watched is not None:
            self._watched.watchers.discard(self)
        self._watched, self._to_show = None, ()

    async def _reset(self, table: messages.MessageTable) -> None:
        sensor = self._sensor(messages.read_sensor(table))
        async with sensor.lock:
            sensor.restart()
        await self._tell("reset", sensor=sensor.options.sensor)

    async def _frame(
        self, read: Callable[[messages.MessageTable, int], BodiesMessage | PosesMessage],
        table: messages.MessageTable,
    ) -> None:  # fmt: skip
        frame = await self._server.work(lambda: read(table, self._limits.bodies))
        self._sensor(frame.sensor).offer(frame)
        self._wake.set()

    async def _hands(self, table: messages.MessageTable) -> None:
        frame = await self._server.work(lambda: messages.read_hands(table))
        sensor = self._sensor(frame.sensor)
        await self._server.work(lambda: sensor.hands.update(frame))
        sensor.offer(frame)
        self._wake.set()

    def _sensor(self, number: int) -> ServedSensor:
        if number not in self.sensors:
            known = ", ".join(map(str, self.sensors)) or "none"
            raise ProtocolError(f"there is no sensor {number}; open are {known}", "sensor")
        return self.sensors[number]

    # -- the solver -----------------------------------------------------------------------------

    async def _solve_all(self) -> None:
        """Solve the newest frames of all sensors in turn until the client leaves."""
        with suppress(ConnectionClosed):
            while not self._left:
                await self._wake.wait()
                self._wake.clear()
                for sensor in tuple(self.sensors.values()):
                    async with sensor.lock:
                        frame = sensor.take()
                        if frame is not None:
                            self._wake.set()  # another may have come meanwhile
                            await self._solve(sensor, frame)
                    if self._left:
                        return
                shown, self._to_show = self._to_show, ()
                for message in shown:
                    await self._send(message)

    async def _solve(self, sensor: ServedSensor, frame: Frame) -> None:
        try:
            reading = await self._server.work(lambda: sensor.solve(frame))
            await self._send(reading)
            sensor.show(frame, reading)
            self.readings += 1
        except ConnectionClosed:
            raise
        except Exception as error:
            await self._refuse(error, sensor=frame.sensor, sequence=frame.sequence)

    # -- answers --------------------------------------------------------------------------------

    async def _refuse(self, error: Exception, **address: int) -> None:
        """Answer an error; one that nobody foresaw is logged in full."""
        if isinstance(error, CapSenseError):
            code, text = messages.code_of(error), str(error)
            self._log("refused", code=code, message=text[:200], **address)
        else:
            code, text = "internal", "a fault of the server; its log says more"
            self._server.fault("internal error", client=self.number, **address)
        await self._send(json.dumps(messages.error_message(code, text, **address)))
        await self._pace(MISTAKE)

    def _log(self, event: str, **fields: Any) -> None:
        self._server.log(event, client=self.number, **fields)

    async def _tell(self, kind: str, **content: Any) -> None:
        await self._send(json.dumps({"type": kind, **content}))

    async def _send(self, message: str | bytes) -> None:
        """Send, and cut off a client that does not receive.

        Raises:
            ConnectionClosed: The connection is closed.
        """
        try:
            async with asyncio.timeout(self._limits.send_timeout):
                await self._connection.send(message)
        except TimeoutError:
            self._log("too slow")
            self._connection.transport.abort()
