"""A page in a browser that shows what a player plays."""

from __future__ import annotations

import contextlib
import io
import socket
import threading

import numpy as np

from capsense.errors import MissingDependencyError, ServerError
from capsense.scene import Scene
from capsense.viewer.charts import heat_map, make_charts, strip
from capsense.viewer.controls import PlaneControls, TimeControls, status
from capsense.viewer.export import ExportControls
from capsense.viewer.player import Playback
from capsense.viewer.scene_drawing import SceneDrawing

try:
    from viser import ViserServer

    from capsense.viewer.visitors import guarded
except ImportError as error:
    raise MissingDependencyError(
        'the view needs viser; install it with: pip install "capsense[view]"'
    ) from error

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
            self._server = _Server(host=host, port=port, verbose=False)
        gui, source = self._server.gui, player.source
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.set_panel_label("capsense")
        gui.main_panel.dock_right()
        self._stage = SceneDrawing(self._server, source.design)
        self._status = gui.add_html("")
        self._time = TimeControls(gui, player)
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
        host = self._server.get_host()
        return f"http://{f'[{host}]' if ':' in host else host}:{self._server.get_port()}"

    def run(self, stop: threading.Event) -> None:
        """Keep the page up to date until told to stop."""
        while not stop.wait(PERIOD):
            if self._server.get_clients():
                self.refresh()

    def refresh(self) -> None:
        """Show the newest, if it is not shown already."""
        player, frame = self._player, self._player.newest
        state = (frame, player.playing, player.failure)
        if frame is not None and state != self._drawn:
            self._drawn = state
            with self._server.atomic():
                self._time.show(frame)
                self._stage.show_bodies(Scene() if frame.around else frame.scene)
                self._stage.show_around(frame.around)
                times, changes = player.history(frame.index)
                window = strip(times, changes)
                for chart in self._charts:
                    chart.show(*window)
                own = np.abs(np.diag(frame.reading.delta))
                before = np.abs(changes[:, self._own]).max(initial=0.0)
                self._loudest = max(self._loudest, float(own.max()), float(before))
                self._status.content = status(player, frame, self._loudest)
                self._stage.show_signals(own / self._loudest)
                self._matrix.content = heat_map(frame.reading.electrode_names, frame.reading.delta)
        self._paint()

    def stop(self) -> None:
        """Close the page."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

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
