"""What a browser paints, frame by frame: electrodes never vanish, charts are never squeezed."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser", reason='needs viser: pip install "capsense[view]"')
pytest.importorskip("playwright", reason="needs playwright: pip install playwright")

from headless_browser import BROWSERS, browser_page, browser_path
from view_sources import Stated, until

import capsense as cs
from capsense._style import LOUD, QUIET
from capsense.recording import reading_of
from capsense.viewer.player import Follower
from capsense.viewer.source import Frame
from capsense.viewer.view import LiveView

if browser_path() is None:
    pytest.skip(f"needs a browser, one of: {', '.join(BROWSERS)}", allow_module_level=True)

STEPS = 60
"""Samples of the rise."""
LOUDEST = 1e-12
"""Change of the last sample [F]."""

TONE = 15
"""So much the page's tone mapping may change a colour, of 255."""

WATCH = """
window.widths = {};
window.seen = [];
window.places = [];
const look = () => {
  document.querySelectorAll('.uplot').forEach((chart, n) => {
    const wide = chart.getBoundingClientRect().width;
    (window.widths[n] ??= []).push(wide);
  });
  if (window.places.length) {
    const canvas = document.querySelector('canvas[data-engine]');
    const gl = canvas.getContext('webgl2');
    const bound = gl.getParameter(gl.FRAMEBUFFER_BINDING);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    const pixel = new Uint8Array(4);
    window.seen.push(window.places.map(([x, y]) => {
      gl.readPixels(x * canvas.width, y * canvas.height, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
      return Array.from(pixel);
    }));
    gl.bindFramebuffer(gl.FRAMEBUFFER, bound);
  }
  requestAnimationFrame(look);
};
requestAnimationFrame(look);
"""
"""Notes at every frame of the browser how wide each chart is, and the colours at ``places``."""


class Rising(Stated):
    """A stream of what is put in: electrodes whose changes rise one after the other."""

    def __init__(self, design: str) -> None:
        super().__init__("rising", design)
        self.items: queue.Queue[int] = queue.Queue()
        self.count = 0

    def changes(self, step: int) -> np.ndarray:
        """Those of the electrodes [F]; all of the largest at step ``STEPS``."""
        late = np.linspace(0.5, 0.0, len(self.design.electrodes))
        return LOUDEST * np.clip((step / STEPS - late) / (1.0 - late), 0.0, 1.0)

    def next(self, timeout: float) -> Frame | None:
        try:
            step = self.items.get(timeout=timeout)
        except queue.Empty:
            return None
        own = self.changes(step)
        delta = np.diag(own) - 0.1 * np.outer(own, own) / LOUDEST
        reading = reading_of(self.design, delta, delta, np.zeros(len(delta)))
        self.count += 1
        return Frame(self.count - 1, 0.05 * self.count, cs.Scene(), reading)


@contextmanager
def served(source: Any) -> Iterator[tuple[Follower, LiveView]]:
    """A view that is kept up to date."""
    player = Follower(source)
    view, stop = LiveView(player, port=0), threading.Event()
    thread = threading.Thread(target=view.run, args=(stop,))
    thread.start()
    try:
        yield player, view
    finally:
        stop.set()
        thread.join()
        view.stop()
        player.stop()


def inside(design: cs.Design) -> np.ndarray:
    """A point of each electrode away from its name in the middle [m], shape (M, 3)."""
    points = []
    for electrode in design.electrodes:
        centres = electrode.surface.triangles.mean(axis=1)
        middle = electrode.surface.bounds.mean(axis=0)
        points.append(centres[np.argmax(np.linalg.norm(centres - middle, axis=1))])
    return np.array(points)


def projected(camera: Any, points: np.ndarray) -> np.ndarray:
    """Where points [m] are in the picture: shares of its width and, from below, of its height."""
    w, x, y, z = camera.wxyz
    away = cs.Pose(tuple(camera.position), (x, y, z, w)).inverse().apply(points)
    scale = 2.0 * np.tan(camera.fov / 2)
    share = away[:, :2] / away[:, 2:] / scale * [1.0 / camera.aspect, -1.0]
    return 0.5 + share


@pytest.mark.parametrize("design", ["six_patch", "arm_segment"])
def test_electrodes_stay_while_their_signals_rise(design: str) -> None:
    """In every frame of the browser each electrode has a colour of the scale, up to the last."""
    source = Rising(design)
    with served(source) as (_, view), browser_page(900, 600) as page:
        page.add_init_script(WATCH)
        source.items.put(STEPS)
        page.goto(view.url)
        page.get_by_text("sample 0 of").wait_for()
        until(lambda: len(view.server.get_clients()) == 1)
        (client,) = view.server.get_clients().values()
        until(lambda: client.camera.update_timestamp > 0)
        places = projected(client.camera, inside(source.design))
        assert ((places > 0.02) & (places < 0.98)).all()
        source.items.put(0)
        page.get_by_text("sample 1 of").wait_for()
        page.evaluate("places => { window.places = places; }", places.tolist())
        quiet = f"p => p[2] > {QUIET[2] - TONE} && p[2] < {QUIET[2] + TONE}"
        page.wait_for_function(f"() => window.seen.length && window.seen.at(-1).every({quiet})")
        page.evaluate("() => { window.seen = []; }")
        for step in range(1, STEPS + 1):
            source.items.put(step)
            page.wait_for_timeout(60)
        page.get_by_text(f"sample {STEPS + 1} of").wait_for()
        loud = f"p => p[2] < {LOUD[2] + TONE}"
        page.wait_for_function(f"() => window.seen.at(-1).every({loud})")
        seen = np.array(page.evaluate("() => window.seen"))
    alpha = seen[..., 3]
    # a pixel at a rim is covered in part, and has that part of the colour
    red, blue = np.rint(seen[..., 0] * 255.0 / alpha), np.rint(seen[..., 2] * 255.0 / alpha)
    assert len(seen) > STEPS / 2
    assert alpha.min() >= 128, "where an electrode was there is nothing"
    assert red.min() > min(QUIET[0], LOUD[0]) - TONE
    assert red.max() < max(QUIET[0], LOUD[0]) + TONE, "an electrode shows what is behind it"
    assert (np.diff(blue, axis=0) <= 2).all(), "it rises, from grey to orange"
    assert min(len(np.unique(b)) for b in blue.T) > 5


def test_charts_are_wide_from_the_first() -> None:
    """In every frame of the browser, also while lines are handed over to stronger pairs."""
    source = Rising("six_patch")
    with served(source) as (_, view), browser_page(900, 600) as page:
        page.add_init_script(WATCH)
        source.items.put(0)
        page.goto(view.url)
        page.get_by_text("sample 0 of").wait_for()
        first = page.locator(".lines").inner_text()
        for step in range(1, 11):
            source.items.put(step)
            page.get_by_text(f"sample {step} of").wait_for()
        assert page.locator(".lines").inner_text() != first
        widths = page.evaluate("() => window.widths")
    assert len(widths) == 2
    for found in widths.values():
        assert len(found) > 10
        assert min(found) > 0.9 * max(found) > 200
