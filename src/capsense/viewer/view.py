"""A page in a browser that shows what a player plays."""

from __future__ import annotations

import contextlib
import html
import io
import socket
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from capsense.errors import MissingDependencyError, ServerError
from capsense.scene import Scene
from capsense.viewer.charts import OCTAVES, Plane, heat_map, make_charts, palette, region, strip
from capsense.viewer.player import Playback
from capsense.viewer.scene_drawing import SceneDrawing

try:
    from viser import ViserServer

    from capsense.viewer.visitors import guarded
except ImportError as error:
    raise MissingDependencyError(
        'the view needs viser; install it with: pip install "capsense[view]"'
    ) from error

if TYPE_CHECKING:
    from viser import GuiApi

    from capsense.viewer.source import Frame


SPEEDS = {"0.1 ×": 0.1, "0.3 ×": 0.3, "1 ×": 1.0, "3 ×": 3.0, "as fast as it goes": 0.0}
AXES = ("x", "y", "z")


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
            if not player.live:
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


class PlaneControls:
    """Which plane, and whose potential."""

    def __init__(self, gui: GuiApi, player: Playback) -> None:
        assert player.source.green is not None
        self._player, self._green = player, player.source.green
        design = player.source.design
        self._names = design.electrode_names
        self._region = region(design)
        self._centres = [1e3 * e.surface.bounds.mean(axis=0) for e in design.electrodes]
        self._plane: Plane | None = None
        middle = np.mean(self._centres, axis=0)
        first = int(np.argmin(np.linalg.norm(self._centres - middle, axis=1).round(3)))
        with gui.add_folder("potential"):
            self._on = gui.add_checkbox("shown", True)
            self._charge = gui.add_checkbox("charge on the bodies", True)
            self._driven = gui.add_dropdown("1 V at", self._names, initial_value=self._names[first])
            self._across = gui.add_dropdown("plane across", AXES, initial_value="y")
            self._at: list[Any] = [
                gui.add_slider(f"{a} [mm]", low, high, 0.5, place, visible=a == "y")
                for a, (low, high), place in zip(
                    AXES, np.round(1e3 * self._region, 1).tolist(), self._places(), strict=True
                )
            ]
            gui.add_html(legend())
        self._lay()
        self._on.on_update(self._ask)
        self._driven.on_update(self._centre)
        self._across.on_update(lambda _: self._lay())
        for slider in self._at:
            slider.on_update(lambda _: self._lay())

    @property
    def driven(self) -> int:
        """Number of the electrode at 1 V."""
        return self._names.index(self._driven.value)

    @property
    def charge(self) -> bool:
        """Whether charges are wanted, too."""
        return bool(self._charge.value and self._on.value)

    @property
    def plane(self) -> Plane | None:
        """The plane; None where it is not wanted."""
        return self._plane if self._on.value else None

    def _places(self) -> list[float]:
        """Where planes cross the middle of the driven electrode, or 20 mm above it [mm]."""
        x, y, z = self._centres[self.driven]
        return [round(2 * v) / 2 for v in (x, y, min(z + 20.0, 1e3 * self._region[2, 1]))]

    def _centre(self, _: object) -> None:
        for slider, place in zip(self._at, self._places(), strict=True):
            slider.value = place
        self._lay()

    def _lay(self) -> None:
        axis = AXES.index(self._across.value)
        for k, slider in enumerate(self._at):
            if slider.visible != (k == axis):
                slider.visible = k == axis
        at = 1e-3 * float(self._at[axis].value)
        if self._plane is None or (self._plane.axis, self._plane.at) != (axis, at):
            self._plane = Plane(self._green, self._region, axis, at)
            self._ask()

    def _ask(self, _: object = None) -> None:
        """Tell the player where potentials are wanted, and to take them while time stands still."""
        self._player.plane = self.plane
        if self._player.plane is not None and not self._player.playing:
            self._player.pause()


def legend() -> str:
    """The colours of the potential, as HTML."""
    cells = "".join(
        f'<td style="background:rgb({r},{g},{b})">&nbsp;</td>' for r, g, b in palette().tolist()
    )
    return (
        '<div style="padding:0 0.8em 0.6em;font-size:12px"><table style="width:100%;'
        f'border-spacing:0;line-height:0.8"><tr>{cells}</tr></table><span style="float:right">1 V'
        f"</span>{1e3 * 2.0**-OCTAVES:.0f} mV, doubling from line to second next</div>"
    )


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
    if player.failure is not None:
        lines.append(f'<b style="color:#b00020">{html.escape(str(player.failure))}</b>')
    return f'<div style="padding:0.4em 0.8em;font-size:13px">{"<br>".join(lines)}</div>'


SIZE = (720, 1280)
"""Rows and columns of pictures and videos."""
MOST = 200
"""Frames of a video; of longer recordings every so many samples are taken."""
PATIENCE = 5.0
"""Longest wait for a sample [s]."""
SETTLE = 0.12
"""Time for a sample to reach the page [s]."""


class ExportControls:
    """Buttons that hand the picture, or a video from the first sample to the last, to a browser."""

    def __init__(self, gui: GuiApi, player: Playback) -> None:
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
        self._stage = SceneDrawing(self.server, source.design)
        self.status = gui.add_html("")
        """The line of text about what is shown."""
        self.time = TimeControls(gui, player)
        """The controls of time."""
        self._plane = PlaneControls(gui, player) if source.green is not None else None
        ExportControls(gui, player)
        panel = gui.add_panel()
        tab = panel.add_tab("signals")
        self._charts = make_charts(gui, tab, source.channels)
        with tab:
            self._matrix = gui.add_html("")
        panel.dock_left()
        self._own = [k for k, c in enumerate(source.channels) if c.row == c.column]
        self._loudest = 1e-21
        self._drawn: tuple[object, ...] = ()
        self._painted: tuple[object, ...] = ()

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
        if frame is not None and state != self._drawn:
            self._drawn = state
            with self.server.atomic():
                self.time.show(frame)
                self._stage.show_bodies(Scene() if frame.around else frame.scene)
                self._stage.show_around(frame.around)
                times, changes = player.history(frame.index)
                window = strip(times, changes)
                for chart in self._charts:
                    chart.show(*window)
                own = np.abs(np.diag(frame.reading.delta))
                before = np.abs(changes[:, self._own]).max(initial=0.0)
                self._loudest = max(self._loudest, float(own.max()), float(before))
                self.status.content = status(player, frame, self._loudest)
                self._stage.show_signals(own / self._loudest)
                self._matrix.content = heat_map(frame.reading.electrode_names, frame.reading.delta)
        self._paint()

    def stop(self) -> None:
        """Close the page."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

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
