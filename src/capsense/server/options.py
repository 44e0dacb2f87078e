"""What a server serves, to whom, and what its clients may use."""

from __future__ import annotations

import hmac
import ipaddress
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING

from capsense.errors import ServerError
from capsense.server.binary import HEADER
from capsense.server.messages import MAX_TEXT

if TYPE_CHECKING:
    from capsense.readout import Readout


@dataclass(frozen=True)
class Limits:
    """What one client may use; all above zero.

    Raises:
        ServerError: One is not.
    """

    connections: int = 16
    """Clients at once."""
    sensors: int = 8
    """Sensors of one client."""
    pixels: int = 65536
    """Pixels of an image."""
    bodies: int = 64
    """Bodies of a scene."""
    hello_timeout: float = 5.0
    """Time for the handshake, and again for the hello [s]."""
    send_timeout: float = 10.0
    """Time a client may take to receive a message before it is cut off [s]."""

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not value > 0:
                raise ServerError(f"{item.name} is {value!r}; give a number above zero")

    @property
    def message(self) -> int:
        """Largest message [bytes]."""
        return max(MAX_TEXT, HEADER.size + 8 * self.pixels)


@dataclass(frozen=True)
class ServerOptions:
    """A server's options.

    Raises:
        ServerError: Nothing is served, a port is out of range, or others than this machine could
            connect without a token.
    """

    designs: tuple[str | Path, ...]
    """Packaged names or design files; the first is the default."""
    readout: Readout | str | Path | None = None
    """A chip's name, a readout file, or a readout, of which every sensor has a copy; none:
    capacitances only."""
    host: str = "127.0.0.1"
    port: int = 8765
    """0 for any free one."""
    token: str | None = field(default=None, repr=False)
    """What clients must say; None for no token."""
    origins: tuple[str, ...] = ()
    """Web pages that may connect, such as ``http://localhost:3000``; other programs always may."""
    limits: Limits = field(default_factory=Limits)
    watch: bool = False
    """Whether clients may watch the sensors of others."""

    def __post_init__(self) -> None:
        if not self.designs:
            raise ServerError("no design is given; name at least one")
        if not 0 <= self.port <= 65535:
            raise ServerError(f"port is {self.port}; give 0 to 65535")
        if self.token is not None and len(self.token) < 8:
            raise ServerError("the token has fewer than 8 characters; give a longer one")
        if self.token is None and not _loopback(self.host):
            raise ServerError(
                f"host {self.host} lets other machines connect; give a token, or use 127.0.0.1"
            )

    def admits(self, token: str) -> bool:
        """Whether a client that says ``token`` may come in; takes the same time for any."""
        if self.token is None:
            return True
        return hmac.compare_digest(self.token.encode(), token.encode("utf-8", "surrogatepass"))


def _loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
