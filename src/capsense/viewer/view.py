"""A page in a browser that shows what a player plays, to whom the page is for."""

from __future__ import annotations

import asyncio
import contextlib
import html
import io
import ipaddress
import logging
import socket
import threading
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping
from http import HTTPStatus
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from capsense.errors import MissingDependencyError, ServerError
from capsense.viewer.appearance import matter_legend
from capsense.viewer.charts import STYLE, PlaneControls, heat_map, make_charts, strip, touch_table
from capsense.viewer.player import Playback, Player

try:
    from viser import ViserServer
    from websockets.asyncio import server as websockets_server
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response
except ImportError as error:
    raise MissingDependencyError(
        'the view needs viser; install it with: pip install "capsense[view]"'
    ) from error

if TYPE_CHECKING:
    from viser import GuiApi

    from capsense.viewer.source import Frame

_log = logging.getLogger("capsense.viewer")
Handler = Callable[[ServerConnection], Awaitable[None]]

SPEEDS = {"0.1 ×": 0.1, "0.3 ×": 0.3, "1 ×": 1.0, "3 ×": 3.0, "as fast as it goes": 0.0}


class TimeControls:
    """Play and pause, one sample on or back, and a slider over all of them."""

    def __init__(self, gui: GuiApi, player: Playback) -> None:
        self._player = player
        self._names = ("Hold", "Follow") if player.live else ("Pause", "Play")
        with gui.add_folder("time"):
            self.play = gui.add_button(self._names[1])
            """The button that holds and follows, or pauses and plays."""
            steps = gui.add_button_group("step", ("|<", "<", ">", ">|"))
            self.slider: Any = gui.add_slider("sample", 0, 1, 1, 0)
            """The number of the sample that is shown."""
            if isinstance(player, Player):
                speed = gui.add_dropdown("speed", tuple(SPEEDS), initial_value="1 ×")
                speed.on_update(lambda _: player.set_speed(SPEEDS[speed.value]))
                loop = gui.add_checkbox("loop", player.loop)
                loop.on_update(lambda _: setattr(player, "loop", loop.value))
        moves = {
            "|<": lambda: player.go(player.span[0]),
            "<": lambda: player.step(-1),
            ">": lambda: player.step(1),
            ">|": lambda: player.go(player.span[1]),
        }
        self.play.on_click(lambda _: player.pause() if player.playing else player.play())
        steps.on_click(lambda _: moves[steps.value]())
        self.slider.on_update(self._scrub)

    def show(self, frame: Frame) -> None:
        """Follow the player."""
        label = self._names[0] if self._player.playing else self._names[1]
        if self.play.label != label:
            self.play.label = label
        first, last = self._player.span
        if (self.slider.min, self.slider.max) != (first, max(last, first + 1)):
            self.slider.min, self.slider.max = first, max(last, first + 1)
        if self.slider.value != frame.index:
            self.slider.value = frame.index

    def _scrub(self, event: Any) -> None:
        if event.client is not None:  # moved by somebody, not by show()
            self._player.go(int(self.slider.value))


def status(player: Playback, frame: Frame, largest: float) -> str:
    """What is shown, as HTML.

    Args:
        player: Shows it.
        frame: Is shown.
        largest: Change of an electrode that colours it fully [F].
    """
    stats, (_, last) = frame.reading.stats, player.span
    lines = [
        f"<b>{html.escape(player.source.title)}</b>",
        f"t = {frame.time:.3f} s, sample {frame.index} of {last}",
        f"step {1e3 * stats.wall_time:.1f} ms"
        + (f", {stats.unknowns} unknowns" if stats.unknowns else ""),
        'electrodes: <span style="background:linear-gradient(90deg,rgb(214,219,222),'
        'rgb(213,94,0));padding:0 2.5em;border-radius:2px">&nbsp;</span> '
        f"0 to {1e15 * largest:.3g} fF",
    ]
    if matter := matter_legend(b.material for b in frame.around or frame.scene):
        lines.append(f"bodies: {matter}")
    if player.failure is not None:
        lines.append(f'<b style="color:#b00020">{html.escape(str(player.failure))}</b>')
    return f'{STYLE}<div style="padding:0.4em 0.8em;font-size:13px">{"<br>".join(lines)}</div>'


SIZE = (720, 1280)
"""Rows and columns of pictures and videos."""
MOST = 200
"""Frames of a video; of longer recordings every so many samples are taken."""
PATIENCE = 5.0
"""Longest wait for a sample [s]."""
SETTLE = 0.12
"""Time for a sample to reach the page [s]."""


def add_exports(gui: GuiApi, player: Playback) -> None:
    """Buttons that hand the picture, or a video from the first sample to the last, to a browser."""
    with gui.add_folder("export", expand_by_default=False):
        picture = gui.add_button("Picture (.png)")
        picture.on_click(lambda event: send_picture(event.client))
        if not player.live:
            video = gui.add_button("Video (.webp)")
            video.on_click(lambda event: send_video(event.client, player))


def send_picture(client: Any) -> None:
    """Render what a client sees, and hand it over."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(_seen(client)).save(file, "png")
    client.send_file_download("capsense.png", file.getvalue(), save_immediately=True)


def send_video(client: Any, player: Playback, wait: Callable[[float], None] = time.sleep) -> None:
    """Render the samples one after the other as a client sees them, and hand them over."""
    from PIL import Image

    first, last = player.span
    frames = []
    for index in np.unique(np.linspace(first, last, min(MOST, last - first + 1)).astype(int)):
        player.go(int(index))
        for _ in range(round(PATIENCE / 0.01)):
            if player.newest is not None and player.newest.index == index:
                break
            wait(0.01)
        wait(SETTLE)
        try:
            frames.append(Image.fromarray(_seen(client)))
        except RuntimeError:  # the client has left
            return
    times, _ = player.history(last)
    long = float(times[-1] - times[0]) / max(len(frames) - 1, 1)
    file = io.BytesIO()
    frames[0].save(
        file, "webp", save_all=True, append_images=frames[1:], quality=80, loop=0,
        duration=max(20, round(1e3 * long)),
    )  # fmt: skip
    client.send_file_download("capsense.webp", file.getvalue(), save_immediately=True)


def _seen(client: Any) -> Any:
    """What a client sees, on white: where nothing is, a picture is transparent black."""
    picture = client.get_render(*SIZE, transport_format="png").astype(float)
    cover = picture[..., 3:] / 255
    return np.rint(cover * picture[..., :3] + 255 * (1 - cover)).astype(np.uint8)


def add_views(gui: GuiApi, views: Mapping[str, tuple[Any, Any]]) -> None:
    """Buttons that let the one who presses them look at the sensor, or at all of the robot.

    Args:
        gui: Where they are drawn.
        views: Name → where the camera is, and what it looks at [m].
    """
    buttons = gui.add_button_group("look at", tuple(views))

    def look(event: Any) -> None:
        camera = event.client.camera
        camera.position, camera.look_at = views[buttons.value]

    buttons.on_click(look)


PERIOD = 0.05
"""The page changes no more often [s]."""


class LiveView:
    """Serves a page until :meth:`stop`; :meth:`run` keeps it up to date.

    Args:
        player: What is shown; whoever sees the page can pause and move it.
        host: Address that it listens at.
        port: Its port; 0 for any free one.

    Raises:
        ServerError: The address or port cannot be had.
    """

    def __init__(self, player: Playback, *, host: str = "127.0.0.1", port: int = 8080) -> None:
        check_address(host, port)
        self._player = player
        with contextlib.redirect_stdout(io.StringIO()), guarded(host):  # viser's words
            self.server = _Server(host=host, port=port, verbose=False)
            """viser's server of the page."""
        gui, source = self.server.gui, player.source
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.set_panel_label("capsense")
        gui.main_panel.dock_right()
        self._stage = source.stage(self.server)
        self.status = gui.add_html(STYLE)
        """The line of text about what is shown."""
        add_views(gui, self._stage.views)
        self.time = TimeControls(gui, player)
        """The controls of time."""
        self._plane = PlaneControls(gui, player) if source.green is not None else None
        add_exports(gui, player)
        panel = gui.add_panel()
        tab = panel.add_tab("signals")
        self._charts = make_charts(gui, tab, source.channels)
        with tab:
            self._matrix = gui.add_html("")
            cover = source.cover
            self._touch = None if cover is None else (gui.add_html(""), cover.limit)
        panel.dock_left()
        self._own = [k for k, c in enumerate(source.channels) if c.row == c.column]
        self._loudest = 1e-21
        self._drawn: tuple[object, ...] = ()
        self._painted: tuple[object, ...] = ()
        self._eyes = np.empty((0, 3))

    @property
    def url(self) -> str:
        """Address of the page."""
        host = self.server.get_host()
        return f"http://{f'[{host}]' if ':' in host else host}:{self.server.get_port()}"

    def run(self, stop: threading.Event) -> None:
        """Keep the page up to date until told to stop."""
        while not stop.wait(PERIOD):
            if self.server.get_clients():
                self.refresh()

    def refresh(self) -> None:
        """Show the newest, if it is not shown already."""
        player, frame = self._player, self._player.newest
        state = (frame, player.playing, player.failure)
        changed = frame is not None and state != self._drawn
        if frame is not None and changed:
            self._drawn = state
            with self.server.atomic():
                self.time.show(frame)
                times, changes = player.history(frame.index)
                window = strip(times, changes)
                for chart in self._charts:
                    chart.show(*window)
                own = np.abs(np.diag(frame.reading.delta))
                before = np.abs(changes[:, self._own]).max(initial=0.0)
                self._loudest = max(self._loudest, float(own.max()), float(before))
                self.status.content = status(player, frame, self._loudest)
                self._stage.show(frame, self._loudest)
                self._matrix.content = heat_map(frame.reading.electrode_names, frame.reading.delta)
                if self._touch is not None and frame.reading.touch is not None:
                    names, (table, limit) = frame.reading.electrode_names, self._touch
                    table.content = touch_table(names, frame.reading.touch, limit)
        self._paint()
        eyes = self._where_eyes_are()
        if changed or not np.array_equal(eyes, self._eyes):
            self._eyes = eyes
            self._stage.reveal(eyes)

    def stop(self) -> None:
        """Close the page."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def _where_eyes_are(self) -> NDArray[np.float64]:
        """Cameras of all who look [m], shape (e, 3)."""
        cameras = [client.camera for client in self.server.get_clients().values()]
        places = [camera.position for camera in cameras if camera.update_timestamp > 0]
        return np.array(places).reshape(-1, 3)

    def _paint(self) -> None:
        """Show the potential, where there is one and it is wanted."""
        if self._plane is None:
            return
        plane, frame, driven = self._plane.plane, self._player.with_field, self._plane.driven
        state = (plane, frame, driven, self._plane.charge)
        if state == self._painted:
            return
        self._painted = state
        with_charge = self._plane.charge and frame is not None
        self._stage.show_charges(frame.charges if frame and with_charge else None, driven)
        if plane is None:
            self._stage.hide("/potential")
        elif frame is not None and frame.plane is plane and frame.potentials is not None:
            self._stage.show_plane(plane, frame.potentials[:, driven])


class _Server(ViserServer):
    """Without viser's tunnel to a public host, which any client could ask for."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Refuse."""


def check_address(host: str, port: int) -> None:
    """Raise unless one can listen there.

    Raises:
        ServerError: One cannot.
    """
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        with socket.socket(family) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except (OSError, OverflowError) as error:
        raise ServerError(
            f"cannot listen at {host}, port {port}: {error}; give another --host or --port, or "
            "--port 0 for any free one"
        ) from None


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
