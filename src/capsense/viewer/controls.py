"""Buttons and sliders: time, and the plane of the potential."""

from __future__ import annotations

import html
from typing import TYPE_CHECKING, Any

import numpy as np

from capsense.viewer.plane import OCTAVES, Plane, palette, region
from capsense.viewer.player import Playback

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
            self._play = gui.add_button(self._names[1])
            steps = gui.add_button_group("step", ("|<", "<", ">", ">|"))
            self._slider: Any = gui.add_slider("sample", 0, 1, 1, 0)
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
        self._play.on_click(lambda _: player.pause() if player.playing else player.play())
        steps.on_click(lambda _: moves[steps.value]())
        self._slider.on_update(self._scrub)

    def show(self, frame: Frame) -> None:
        """Follow the player."""
        label = self._names[0] if self._player.playing else self._names[1]
        if self._play.label != label:
            self._play.label = label
        first, last = self._player.span
        if (self._slider.min, self._slider.max) != (first, max(last, first + 1)):
            self._slider.min, self._slider.max = first, max(last, first + 1)
        if self._slider.value != frame.index:
            self._slider.value = frame.index

    def _scrub(self, event: Any) -> None:
        if event.client is not None:  # moved by somebody, not by show()
            self._player.go(int(self._slider.value))


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
