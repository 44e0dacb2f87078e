"""Buttons and sliders: time, and the plane of the potential."""

from __future__ import annotations

import html
from typing import TYPE_CHECKING, Any

from capsense.viewer.plane import Plane
from capsense.viewer.player import Player

if TYPE_CHECKING:
    from viser import GuiApi

    from capsense.viewer.source import Shot

SPEEDS = {"0.1 ×": 0.1, "0.3 ×": 0.3, "1 ×": 1.0, "3 ×": 3.0, "as fast as it goes": 0.0}
AXES = ("x", "y", "z")


class TimeControls:
    """Play and pause, one sample on or back, and a slider over all of them."""

    def __init__(self, gui: GuiApi, player: Player) -> None:
        self._player = player
        last = len(player.source.times) - 1
        with gui.add_folder("time"):
            self._play = gui.add_button("Play")
            steps = gui.add_button_group("step", ("⏮", "◀", "▶", "⏭"))
            self._slider: Any = gui.add_slider("sample", 0, max(last, 1), 1, 0, disabled=last == 0)
            speed = gui.add_dropdown("speed", tuple(SPEEDS), initial_value="1 ×")
            loop = gui.add_checkbox("again from the start", player.loop)
        moves = {"⏮": -last, "◀": -1, "▶": 1, "⏭": last}
        self._play.on_click(lambda _: player.pause() if player.playing else player.play())
        steps.on_click(lambda _: player.step(moves[steps.value]))
        self._slider.on_update(self._scrub)
        speed.on_update(lambda _: player.set_speed(SPEEDS[speed.value]))
        loop.on_update(lambda _: setattr(player, "loop", loop.value))

    def show(self, shot: Shot) -> None:
        """Follow the player."""
        label = "Pause" if self._player.playing else "Play"
        if self._play.label != label:
            self._play.label = label
        if self._slider.value != shot.index:
            self._slider.value = shot.index

    def _scrub(self, event: Any) -> None:
        if event.client is not None:  # moved by somebody, not by show()
            self._player.go(self._slider.value)


class PlaneControls:
    """Which plane, and whose potential."""

    def __init__(self, gui: GuiApi, player: Player) -> None:
        assert player.source.lattice is not None
        self._player, self._lattice = player, player.source.lattice
        self._names = player.source.design.electrode_names
        bounds = [[round(1e3 * v, 1) for v in b] for b in self._lattice.bounds]
        self._places = [0.0, 0.0, min(20.0, bounds[2][1])]
        with gui.add_folder("potential"):
            self._on = gui.add_checkbox("shown", True)
            self._driven = gui.add_dropdown("1 V at", self._names, initial_value=self._names[0])
            self._across = gui.add_dropdown("plane across", AXES, initial_value="y")
            self._at = [
                gui.add_slider(f"{a} [mm]", low, high, 0.5, place, visible=a == "y")
                for a, (low, high), place in zip(AXES, bounds, self._places, strict=True)
            ]
        self._lay()
        self._on.on_update(self._switch)
        self._across.on_update(lambda _: self._lay())
        for slider in self._at:
            slider.on_update(lambda _: self._lay())

    @property
    def driven(self) -> int:
        """Number of the electrode at 1 V."""
        return self._names.index(self._driven.value)

    @property
    def plane(self) -> Plane | None:
        """The plane; None where it is not wanted."""
        return self._plane if self._on.value else None

    def _lay(self) -> None:
        axis = AXES.index(self._across.value)
        for k, slider in enumerate(self._at):
            if slider.visible != (k == axis):
                slider.visible = k == axis
        self._plane = Plane(self._lattice, axis, 1e-3 * float(self._at[axis].value))

    def _switch(self, _: object) -> None:
        self._player.field = self._on.value
        if self._on.value and not self._player.playing:
            self._player.pause()


def status(player: Player, shot: Shot) -> str:
    """What is shown, as HTML."""
    stats, count = shot.reading.stats, len(player.source.times)
    lines = [
        f"<b>{html.escape(player.source.title)}</b>",
        f"t = {shot.time:.3f} s, sample {shot.index + 1} of {count}",
        f"step {1e3 * stats.wall_time:.1f} ms, {stats.iterations} iterations, "
        f"error {1e18 * stats.error_estimate:.2g} aF",
    ]
    if player.failure is not None:
        lines.append(f'<b style="color:#b00020">{html.escape(str(player.failure))}</b>')
    return f'<div style="padding:0.4em 0.8em;font-size:13px">{"<br>".join(lines)}</div>'
