"""Takes the picture of the page on the live view.

``python tests/helpers/view_picture.py docs/images/view.png``, from the repository's root. Needs
Chromium and playwright.
"""

from __future__ import annotations

import io
import sys
import threading
import time
from pathlib import Path

from headless_browser import browser_page
from PIL import Image

import capsense as cs
from capsense.scenario import load_scenario
from capsense.viewer.player import Player
from capsense.viewer.source import ScenarioSource
from capsense.viewer.view import LiveView

SCENARIO = Path("examples/hand_approach.toml")
SAMPLE = 130
SIZE = (1440, 820)


def main(target: Path) -> None:
    """Step through the scenario to a sample, and photograph the page."""
    scenario = load_scenario(SCENARIO)
    player = Player(ScenarioSource(scenario, cs.Simulator(scenario.design)))
    for index in range(SAMPLE + 1):
        player.go(index)
        while player.newest is None or player.newest.index != index:
            time.sleep(1e-3)
    view, stop = LiveView(player, port=0), threading.Event()
    thread = threading.Thread(target=view.run, args=(stop,))
    thread.start()
    with browser_page(*SIZE) as page:
        page.goto(view.url)
        note = page.get_by_text("Software WebGL rendering detected")  # not so where people look
        note.wait_for()
        page.locator(".mantine-Notification-closeButton").first.click()
        note.wait_for(state="detached")
        page.wait_for_timeout(4000)
        picture = Image.open(io.BytesIO(page.screenshot()))
    picture.convert("RGB").save(target, optimize=True)
    stop.set()
    thread.join()
    view.stop()
    player.stop()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
