"""The page in a real browser: it loads, moves, and does what its controls say."""

from __future__ import annotations

import io
import re
import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("viser", reason='needs viser: pip install "capsense[view]"')
pytest.importorskip("playwright", reason="needs playwright: pip install playwright")

from headless_browser import BROWSERS, browser_page, browser_path
from view_sources import until

import capsense as cs
from capsense.scenario import Scenario, parse_scenario
from capsense.viewer.plane import palette
from capsense.viewer.player import Player
from capsense.viewer.source import ScenarioSource
from capsense.viewer.view import LiveView

SCENARIO = {
    "name": "a ball <goes> by",
    "design": "patch",
    "sample_rate": 25.0,
    "body": [
        {
            "name": "ball", "shape": "sphere", "radius": 0.02, "material": "steel",
            "trajectory": {"waypoints": [[-0.05, 0.0, 0.03], [0.05, 0.0, 0.03]], "speed": 0.05},
        }
    ],
}  # fmt: skip
LINES = """() => Object.values(window.__viserTestpoints?.uplots ?? {})
           .map(p => p.chart.data.map(row => Array.from(row)))"""


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return parse_scenario(SCENARIO)


@pytest.fixture(scope="module")
def shown(scenario: Scenario) -> Iterator[tuple[Player, LiveView]]:
    """A view that is served and kept up to date, on the first sample."""
    player = Player(ScenarioSource(scenario, cs.Simulator(scenario.design)))
    view, stop = LiveView(player, port=0), threading.Event()
    thread = threading.Thread(target=view.run, args=(stop,))
    thread.start()
    yield player, view
    stop.set()
    thread.join()
    view.stop()
    player.stop()


@pytest.fixture(scope="module")
def page(shown: tuple[Player, LiveView]) -> Iterator[Any]:
    """The page in a browser that has loaded it."""
    if browser_path() is None:
        pytest.skip(f"needs a browser, one of: {', '.join(BROWSERS)}")
    with browser_page(1000, 700) as page:
        page.goto(shown[1].url)
        page.get_by_text("Maxwell matrix").wait_for()
        page.get_by_text("sample 0 of").wait_for()
        yield page


def sample(page: Any) -> int:
    """Number of the sample that the page says it shows."""
    return int(re.search(r"sample (\d+) of", page.inner_text("body"))[1])


def press(page: Any, name: str) -> None:
    page.get_by_role("button", name=name, exact=True).click()


def wait_for_sample(page: Any, number: int) -> None:
    page.get_by_text(f"sample {number} of").wait_for()


def test_what_is_on_it(page: Any, scenario: Scenario) -> None:
    """Title, channels, matrix and controls; names are text, whatever they hold."""
    text = page.inner_text("body")
    last = scenario.count - 1
    assert "a ball <goes> by" in text
    assert f"sample 0 of {last}" in text
    names = scenario.design.electrode_names
    assert len(page.evaluate(LINES)) == 2
    legends = ("steel", "charge: 0.001 of", "the densest", "mV, doubling")
    controls = ("Play", "1 V at", "plane across", "sensor", "charge on the bodies")
    for name in (*names, f"{names[0]}–{names[1]}", *controls, *legends):
        assert name in text


def test_nothing_from_elsewhere(page: Any) -> None:
    """Whatever the page needs comes from its own server."""
    assert any(url.startswith("ws://127.0.0.1") for url in page.asked)
    own = ("http://127.0.0.1", "ws://127.0.0.1", "data:", "blob:")
    assert [url for url in page.asked if not url.startswith(own)] == []


def test_scrub(page: Any, shown: tuple[Player, LiveView], scenario: Scenario) -> None:
    """The sample that is typed in is shown: in words, in the matrix, in the charts."""
    player, _ = shown
    box = page.locator("input[inputmode]").first
    box.fill("20")
    box.press("Enter")
    wait_for_sample(page, 20)
    assert not player.playing
    expected = cs.Simulator(scenario.design).step(scenario.scene_at(20 / 25.0)).delta * 1e15
    numbers = page.locator("table.matrix td").all_inner_texts()
    found = np.array([float(n) for n in numbers]).reshape(expected.shape)
    np.testing.assert_allclose(found, expected, rtol=0.01, atol=0.01)
    page.wait_for_function(f"() => ({LINES})()[0][0].at(-1) == 0.8")
    own = page.evaluate(LINES)[0]
    np.testing.assert_allclose(
        [line[-1] for line in own[1:]], np.diag(expected), rtol=0.01, atol=0.01
    )


def test_step(page: Any) -> None:
    """One on, one back, to both ends."""
    start = sample(page)
    press(page, ">")
    wait_for_sample(page, start + 1)
    press(page, "<")
    wait_for_sample(page, start)
    press(page, ">|")
    wait_for_sample(page, int(re.search(r"of (\d+)", page.inner_text("body"))[1]))
    press(page, "|<")
    wait_for_sample(page, 0)


def test_play_and_pause(page: Any, shown: tuple[Player, LiveView]) -> None:
    """Time runs, charts grow and vary; then it stands still, and goes on by one when told."""
    player, _ = shown
    press(page, "Play")
    page.wait_for_function(
        "() => Number(document.body.innerText.match(/sample (\\d+) of/)[1]) > 15"
    )
    page.wait_for_function(f"() => ({LINES})().every(chart => chart[0].length > 10)")
    varies = "line => Math.max(...line) > Math.min(...line)"
    page.wait_for_function(f"() => ({LINES})().every(chart => chart.slice(1).some({varies}))")
    press(page, "Pause")
    page.get_by_role("button", name="Play", exact=True).wait_for()
    assert not player.playing
    # What was being taken when it was told to pause is the last.
    until(lambda: player.newest is not None and player.newest.index == player._position)
    assert player.newest is not None
    stood = player.newest.index
    for number in (stood, stood + 1):
        wait_for_sample(page, number)
        page.wait_for_function(
            f"at => ({LINES})().every(chart => Math.abs(chart[0].at(-1) - at) < 1e-9)",
            arg=number / 25.0,
        )
        for chart in page.evaluate(LINES):
            assert (np.diff(chart[0]) > 0).all()
        if number == stood:
            press(page, ">")


def test_the_potential_is_drawn(page: Any) -> None:
    """The picture holds a colour of the potential, until it is not wanted."""
    press(page, "|<")
    wait_for_sample(page, 0)
    full = painted(page, lambda count: count > 25)
    assert full > 25
    page.get_by_role("checkbox").nth(-2).click()
    assert painted(page, lambda count: count < full / 2) < full / 2
    page.get_by_role("checkbox").nth(-2).click()
    assert painted(page, lambda count: count > 0.7 * full) > 0.7 * full


def test_pictures_are_handed_over(page: Any) -> None:
    """A picture of the size promised, on white as on the page."""
    page.get_by_text("export", exact=True).click()
    with page.expect_download() as found:
        press(page, "Picture (.png)")
    with Image.open(found.value.path()) as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    assert pixels.shape == (720, 1280, 3)
    assert (pixels[0, 0] > 250).all()
    assert np.ptp(pixels, axis=(0, 1)).min() > 100


def painted(page: Any, enough: Callable[[int], bool]) -> int:
    """How many pixels have a colour that only potentials have, as soon as that is enough."""
    colours = palette()[6:12].astype(int)
    for _ in range(20):
        picture = Image.open(io.BytesIO(page.locator("canvas").first.screenshot()))
        pixels = np.asarray(picture.convert("RGB")).astype(int)
        away = [np.abs(pixels - colour).max(axis=-1) for colour in colours]
        count = int((np.min(away, axis=0) < 40).sum())  # thin lines fade into what is behind
        if enough(count):
            break
        page.wait_for_timeout(500)
    return count
