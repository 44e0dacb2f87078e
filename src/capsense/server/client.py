"""A client of the server, for programs and tests: :class:`Client`."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capsense.errors import ProtocolError, require_package
from capsense.server.binary import (
    PROTOCOL,
    DepthMessage,
    ReadingMessage,
    is_depth,
    pack_depth,
    unpack_depth,
    unpack_reading,
)

Array = NDArray[np.float64]


FIRST_PAUSE, LONGEST_PAUSE = 0.25, 5.0
"""Between attempts to connect anew [s]."""


class Client:
    """A connection to a server; use it in a ``with`` block.

    When it is lost, the call at hand fails with code ``closed``; the next one connects anew, within
    ``timeout``, and opens the sensors again, under their numbers.

    Args:
        url: The server's address, such as ``ws://127.0.0.1:8765``.
        token: What the server was told to ask for.
        timeout: Longest wait for an answer [s].
        name: Told to the server, for its log.

    Raises:
        ProtocolError: The server refused the connection; ``code`` says why. Or it is no server of
            this kind.
        OSError: There is no server.
    """

    def __init__(
        self, url: str = "ws://127.0.0.1:8765", *, token: str = "", timeout: float = 10.0,
        name: str = "python",
    ) -> None:  # fmt: skip
        require_package("websockets", "websockets, which the client needs,", "serve")
        self.timeout = timeout
        self.sensors: dict[int, RemoteSensor] = {}
        """Open sensors, by number."""
        self._url, self._token, self._name = url, token, name
        self._lost = False
        self._connect()

    def _connect(self) -> None:
        from websockets.exceptions import WebSocketException
        from websockets.sync.client import connect

        try:
            self.connection = connect(
                self._url, compression=None, open_timeout=self.timeout, close_timeout=1.0,
                max_size=None,
            )  # fmt: skip
        except WebSocketException as error:
            what = f"{self._url} is no server for this client: {error}"
            raise ProtocolError(what, "closed") from None
        self._lost = False
        try:
            self.welcome = self.ask("welcome", type="hello", protocol=PROTOCOL, token=self._token,
                                    client=self._name)  # fmt: skip
            """The server's answer to the hello: its version, designs and limits."""
        except BaseException:
            self.close()
            raise

    def _connect_again(self) -> None:
        """Connect, and open all sensors anew; try again and again until the timeout.

        Raises:
            ProtocolError: The server refuses.
            OSError: There is no server.
        """
        limit, pause = time.monotonic() + self.timeout, FIRST_PAUSE
        while True:
            try:
                self._connect()
                for number, sensor in list(self.sensors.items()):
                    sensor.opened(self.ask("opened", type="open", sensor=number, **sensor.options))
                return
            except (OSError, ProtocolError) as error:
                self._lost = True
                final = isinstance(error, ProtocolError) and error.code not in ("closed", "timeout")
                if final or time.monotonic() + pause > limit:
                    raise
            time.sleep(pause)
            pause = min(2 * pause, LONGEST_PAUSE)

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self.connection.close()

    def open(self, sensor: int | None = None, **options: Any) -> RemoteSensor:
        """Open a sensor.

        Args:
            sensor: Its number; by default the first that is free.
            options: ``design``, ``camera``, ``material``, ``grounding``, ``back`` and ``touch``, as
                in the protocol's ``open``; ``touch`` is on by default, where the server knows it.

        Raises:
            ProtocolError: The server refused.
        """
        if sensor is None:
            sensor = next(k for k in range(len(self.sensors) + 1) if k not in self.sensors)
        if self.welcome.get("touch"):
            options = {"touch": True, **options}
        answer = self.ask("opened", type="open", sensor=sensor, **options)
        self.sensors[sensor] = RemoteSensor(self, answer, options)
        return self.sensors[sensor]

    def send(self, message: str | bytes) -> None:
        """Send a message as it is; a closed connection shows at the next :meth:`receive`.

        One that has shown already is made anew if there are sensors.

        Raises:
            ProtocolError, OSError: That failed.
        """
        from websockets.exceptions import ConnectionClosed

        if self._lost and self.sensors:
            self._connect_again()
        with suppress(ConnectionClosed):  # what the server said before it closed is yet to be read
            self.connection.send(message)

    def ask(self, answer: str, **message: Any) -> dict[str, Any]:
        """Send a control message, and wait for its answer.

        Args:
            answer: The answer's type.
            message: The content.

        Raises:
            ProtocolError: The server answered an error, or nothing in time.
        """
        self.send(json.dumps(message))
        return self._receive_until(lambda m: isinstance(m, dict) and m["type"] == answer)

    def receive(
        self, timeout: float | None = None
    ) -> ReadingMessage | DepthMessage | dict[str, Any]:
        """The next message: a reading, a control message, or what a watched sensor sees.

        Raises:
            ProtocolError: Nothing came in time, or the connection is closed.
        """
        from websockets.exceptions import ConnectionClosed

        wait = max(self.timeout if timeout is None else timeout, 0.0)
        try:
            message = self.connection.recv(wait)
        except TimeoutError:
            raise ProtocolError(f"no answer within {self.timeout:g} s", "timeout") from None
        except ConnectionClosed as error:
            self._lost = True
            raise _closed(error) from None
        if isinstance(message, str):
            return json.loads(message)
        return unpack_depth(message) if is_depth(message) else unpack_reading(message)

    def reading(self, sensor: int, sequence: int) -> ReadingMessage:
        """Wait for the reading of a frame; readings of other sensors are kept for their turn.

        Raises:
            ProtocolError: The server answered that frame with an error, or not in time.
        """
        kept = self.sensors[sensor].kept
        while kept:
            reading = kept.popleft()
            if reading.sequence == sequence:
                return reading
        wanted = sensor, sequence
        return self._receive_until(
            lambda m: isinstance(m, ReadingMessage) and (m.sensor, m.sequence) == wanted, sensor
        )

    def _receive_until(self, wanted: Callable[[Any], bool], sensor: int | None = None) -> Any:
        """The first message that is wanted; readings of other sensors are kept.

        Raises:
            ProtocolError: The server answered an error, to this sensor if one is given, or nothing
                in time.
        """
        limit = time.monotonic() + self.timeout
        while True:
            found = self.receive(limit - time.monotonic())
            if wanted(found):
                return found
            if isinstance(found, ReadingMessage):
                if found.sensor in self.sensors and found.sensor != sensor:
                    self.sensors[found.sensor].kept.append(found)
            elif isinstance(found, dict) and (
                found["type"] == "error" and sensor in (None, found.get("sensor", sensor))
            ):
                raise ProtocolError(found["message"], found["code"])


class RemoteSensor:
    """A sensor that a server simulates; made by :meth:`Client.open`."""

    def __init__(
        self, client: Client, opened: Mapping[str, Any], options: Mapping[str, Any]
    ) -> None:
        self.client, self.options = client, dict(options)
        self.number: int = opened["sensor"]
        self.sequence = 0
        """Number of the next frame."""
        self.kept: deque[ReadingMessage] = deque(maxlen=64)
        """Readings that came while something else was waited for."""
        self.opened(opened)

    def opened(self, opened: Mapping[str, Any]) -> None:
        """Take over what the server said when it opened the sensor."""
        self.design: str = opened["design"]
        self.electrode_names: tuple[str, ...] = tuple(opened["electrodes"])
        """In matrix order."""
        self.channel_names: tuple[str, ...] = tuple(opened["channels"])
        """Of the readout; empty without one."""
        self.baseline: Array = np.array(opened["baseline"])
        """Maxwell matrix of the empty scene [F], shape (M, M)."""
        self.domain: Array = np.array(opened["domain"])
        """Lower and upper corner of what the sensor sees [m], shape (2, 3)."""

    def step(
        self, depth: ArrayLike, eps_r: ArrayLike | None = None, time: float = 0.0
    ) -> ReadingMessage:
        """Send a depth image and wait for its reading.

        Args:
            depth: [m], shape (rows, columns).
            eps_r: Permittivity codes, type uint8, or relative permittivities; same shape.
            time: Of the image [s].

        Raises:
            ProtocolError: The image is malformed, or the server answered an error.
        """
        return self.client.reading(self.number, self.send(depth, eps_r, time))

    def step_scene(self, body: Sequence[Mapping[str, Any]], time: float = 0.0) -> ReadingMessage:
        """Send bodies and wait for the reading.

        Args:
            body: Tables as in a scenario file: ``{"name": "ball", "shape": "sphere", …}``.
            time: [s].

        Raises:
            ProtocolError: The server answered an error.
        """
        return self._control("scene", time, body=list(body))

    def step_poses(
        self, poses: Mapping[str, Any], time: float = 0.0, *,
        forces: Mapping[str, float | None] | None = None,
    ) -> ReadingMessage:  # fmt: skip
        """Move bodies of the last scene and wait for the reading.

        Args:
            poses: Name of a body to ``{"position": [x, y, z], "quaternion": [x, y, z, w]}``.
            time: [s].
            forces: Name of a body to the normal force that presses it onto the design's cover [N],
                or None to let its overlap count; others keep theirs.

        Raises:
            ProtocolError: The server answered an error.
        """
        more = {"forces": dict(forces)} if forces else {}
        return self._control("poses", time, poses=dict(poses), **more)

    def step_hands(
        self, joints: Mapping[str, ArrayLike | None], time: float, **options: Any
    ) -> ReadingMessage:
        """Send the joints of tracked hands and wait for the reading; the server has the model.

        Args:
            joints: Side (``"left"``, ``"right"``) to positions in the sensor frame, in the order
                and unit of the convention, shape (k, 3), NaN for joints that were not seen; None
                for a hand that was not.
            time: [s]; later than that of the hands before.
            options: Of each hand: ``convention``, ``confidence``, ``tip``, ``radii``, ``wrist``, as
                in the protocol's ``hands``.

        Raises:
            ProtocolError: The server answered an error.
        """
        hands = [{"side": side, "joints": _listed(j), **options} for side, j in joints.items()]
        return self._control("hands", time, hands=hands)

    def send(self, depth: ArrayLike, eps_r: ArrayLike | None = None, time: float = 0.0) -> int:
        """Send a depth image, as :meth:`step` does, but do not wait; returns its number."""
        self.client.send(pack_depth(self.number, self.sequence, time, depth, eps_r))
        self.sequence += 1
        return self.sequence - 1

    def reset(self) -> None:
        """Forget the step before; the readout and the numbers of frames begin anew."""
        self.client.ask("reset", type="reset", sensor=self.number)
        self.sequence = 0
        self.kept.clear()

    def close(self) -> dict[str, int]:
        """Close the sensor; returns how many frames were taken, solved and dropped."""
        told = self.client.ask("closed", type="close", sensor=self.number)
        del self.client.sensors[self.number]
        return {key: told[key] for key in ("frames", "readings", "dropped")}

    def _control(self, kind: str, time: float, **content: Any) -> ReadingMessage:
        sequence = self.sequence
        self.sequence += 1
        message = {"type": kind, "sensor": self.number, "sequence": sequence, "time": time}
        self.client.send(json.dumps({**message, **content}))
        return self.client.reading(self.number, sequence)


def _listed(joints: ArrayLike | None) -> list[list[float] | None] | None:
    """Positions as JSON has them: null for what is not finite."""
    if joints is None:
        return None
    rows = np.asarray(joints, dtype=float).reshape(-1, 3)
    return [row.tolist() if np.isfinite(row).all() else None for row in rows]


def _closed(error: Any) -> ProtocolError:
    """What a closed connection means; its reason is the code of the error that closed it."""
    close = error.rcvd
    reason = close.reason if close is not None else ""
    code = close.code if close is not None else 1006
    return ProtocolError(f"the server closed the connection ({code} {reason})".strip(), reason
                         or "closed")  # fmt: skip
