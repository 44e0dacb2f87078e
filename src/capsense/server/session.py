"""One client of the server: its connection, which bounds what it can do, and its messages."""

from __future__ import annotations

import asyncio
import json
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, cast

from capsense.codec import design_to_json
from capsense.errors import CapSenseError, MissingDependencyError, ProtocolError
from capsense.server import PROTOCOL, messages, unpack_depth
from capsense.server.messages import BodiesMessage, PosesMessage
from capsense.server.sensor import Frame, ServedSensor

try:
    from websockets.asyncio.server import ServerConnection, serve
    from websockets.datastructures import Headers
    from websockets.exceptions import ConnectionClosed
    from websockets.frames import Frame as WebSocketFrame
    from websockets.frames import Opcode
    from websockets.http11 import Request, Response
except ImportError as error:
    raise MissingDependencyError(
        'the server needs websockets; install it with: pip install "capsense[serve]"'
    ) from error

if TYPE_CHECKING:
    from capsense.server.server import Server

__all__ = ["Headers", "Request", "Response", "ServerConnection", "serve"]  # for the server

POLICY, TRY_LATER = 1008, 1013
"""Codes with which connections are closed on errors, and when there are too many."""
FLOOD = "flood"
"""Reason with which a client that talks idly is cut off."""
READ_SIZE = 16384
"""Bytes that are read at a time: then it is the others' turn."""
SEND_BUFFER = 262144
"""What the system may hold for a client that does not receive [bytes]."""
SMALL = 1024
"""Size [bytes] from which on a fragment of a message counts as content."""
ARRIVALS = 100.0
"""Connections that a server takes at once, and again every second; others are closed."""
IDLE_FRAMES = 100.0
"""Pings, pongs and small fragments that a client may send at once, and again every second."""
ALLOWANCE, ALL_ALLOWANCES = 5000.0, 10000.0
"""Work that a client, and that all of them, may cause a second without being slowed, in units of a
small message, which takes the event loop some 50 µs."""
AT_ONCE, AT_FIRST = 1000.0, 100.0
"""Work that a client may cause at once, after a rest and at the start."""
BINARY_UNIT, TEXT_UNIT = 16384, 512
"""Bytes that count as much as a message: JSON takes longer to read than pixels."""
OPENING, MISTAKE = 250.0, 100.0
"""What it takes to open a sensor, and to answer an error."""


class Allowance:
    """A token bucket that can be overdrawn.

    Args:
        most: What can be spent at once, after a rest.
        rate: What comes back a second.
        first: What can be spent at the start; by default ``most``.
    """

    def __init__(self, most: float, rate: float, first: float | None = None) -> None:
        self.most, self.rate = most, rate
        self._left = most if first is None else first
        self._counted = time.monotonic()

    def spend(self, cost: float) -> float:
        """Spend some, and return what is left: below zero, more was spent than there was."""
        now = time.monotonic()
        regained = (now - self._counted) * self.rate
        self._counted = now
        self._left = min(self.most, self._left + regained) - cost
        return self._left


@dataclass
class AdmissionControl:
    """Connections of a server, those that still shake hands included."""

    most: int
    """More are closed at once."""
    open: int = 0
    arrivals: Allowance = field(default_factory=lambda: Allowance(ARRIVALS, ARRIVALS))

    def admits(self) -> bool:
        """Whether the connection that was just made may stay."""
        if self.open > self.most:
            return False
        if self.arrivals.spend(1) < 0:
            self.arrivals.spend(-1)  # those that are turned away keep nobody out
            return False
        return True


class RateLimitedConnection(ServerConnection, asyncio.BufferedProtocol):
    """A connection that reads a little at a time, and is cut off when its client talks idly.

    Whole messages are paced by their session. Pings, pongs and fragments of a message that never
    ends do not get that far, yet would keep the event loop busy and fill the memory.
    """

    def __init__(self, *args: Any, admission: AdmissionControl, **options: Any) -> None:
        super().__init__(*args, **options)
        self.flooded = False
        """Whether it was cut off."""
        self._admission = admission
        self._buffer = bytearray(READ_SIZE)
        self._idle_frames = Allowance(IDLE_FRAMES, IDLE_FRAMES)

    # -- called by asyncio ------------------------------------------------------------------------

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._admission.open += 1
        super().connection_made(transport)
        raw = transport.get_extra_info("socket")
        if raw is not None:
            raw.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        if not self._admission.admits():
            cast(asyncio.Transport, transport).abort()

    def connection_lost(self, exc: Exception | None) -> None:
        self._admission.open -= 1
        super().connection_lost(exc)

    def get_buffer(self, sizehint: int) -> bytearray:
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        self.data_received(bytes(memoryview(self._buffer)[:nbytes]))

    # -- called by websockets ---------------------------------------------------------------------

    def process_event(self, event: Any) -> None:
        if self.flooded:
            return
        if isinstance(event, WebSocketFrame) and _idle(event) and self._idle_frames.spend(1) < 0:
            self.flooded = True
            self.protocol.fail(POLICY, FLOOD)
            for data in filter(None, self.protocol.data_to_send()):
                self.transport.write(data)
            self.transport.close()
            return
        super().process_event(event)


def _idle(frame: WebSocketFrame) -> bool:
    """Whether a frame is none that sessions hear of; what ends a message is."""
    return frame.opcode in (Opcode.PING, Opcode.PONG) or (not frame.fin and len(frame.data) < SMALL)


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

    def __init__(self, number: int, connection: ServerConnection, server: Server) -> None:
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
            "poses": partial(self._frame, messages.read_poses),
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
            limits={name: getattr(self._limits, name) for name in told}, touch=True,
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
