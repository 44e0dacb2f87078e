"""Who may talk to the view's page: browsers that loaded the page itself, and programs."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import logging
import socket
from collections.abc import Awaitable, Callable, Iterator
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

from websockets.asyncio import server as websockets_server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

_log = logging.getLogger("capsense.viewer")

Handler = Callable[[ServerConnection], Awaitable[None]]


def welcome(host: str, origin: str | None, listening: str) -> bool:
    """Whether a request is one that the page's own user can have made.

    Another page that is open in the user's browser sends its own ``Origin``; a name that was made
    to point to this machine shows in ``Host``. Programs other than browsers send no ``Origin``.

    Args:
        host: Header ``Host``.
        origin: Header ``Origin``, if there is one.
        listening: Address or name that the server listens at.
    """
    try:
        name = urlsplit(f"//{host}").hostname or ""
        own = origin is None or urlsplit(origin).netloc.lower() == host.lower()
    except ValueError:
        return False
    own_name = socket.gethostname().lower()
    known = {"localhost", listening.lower(), own_name, f"{own_name}.local"}
    return own and (name in known or _is_address(name))


def _is_address(name: str) -> bool:
    """Whether a host is given by its number, which no other page can make point elsewhere."""
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


@contextlib.contextmanager
def guarded(listening: str) -> Iterator[None]:
    """Servers of viser that start meanwhile refuse strangers, and say little of broken messages.

    Viser has no place for that, so what it starts its server with is replaced.
    """
    serve = websockets_server.serve
    quiet = _log.getChild("websockets")  # broken handshakes are the clients' fault
    quiet.setLevel(logging.CRITICAL)

    def start(handler: Handler, *address: Any, process_request: Any, **options: Any) -> Any:
        def check(connection: ServerConnection, request: Request) -> Response | None:
            hosts, origins = (request.headers.get_all(k) for k in ("Host", "Origin"))
            single = len(hosts) == 1 and len(origins) < 2
            if single and welcome(hosts[0], origins[0] if origins else None, listening):
                return process_request(connection, request)
            return connection.respond(
                HTTPStatus.FORBIDDEN, "This page is for its own user; open it by its address.\n"
            )

        return serve(_patient(handler), *address, process_request=check, logger=quiet, **options)

    websockets_server.serve = start  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        websockets_server.serve = serve  # type: ignore[misc]


def _patient(handler: Handler) -> Handler:
    """``handler``, with one line for a client whose messages make no sense, in place of a trace."""

    def complain(_: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        _log.warning("a message to the view failed: %.200s", repr(context.get("exception")))

    async def handle(connection: ServerConnection) -> None:
        asyncio.get_running_loop().set_exception_handler(complain)
        try:
            await handler(connection)
        except Exception as error:
            _log.warning("a client of the view sent no message of its page: %.200s", repr(error))
            await connection.close(1002, "no message of the page")

    return handle
