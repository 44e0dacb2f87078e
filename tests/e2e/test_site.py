"""The documentation as a site, in a browser: what a page's text alone does not show."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from headless_browser import browser_path

ROOT = Path(__file__).parents[2]
PHONE, DESKTOP = {"width": 390, "height": 844}, {"width": 1400, "height": 900}


class Quiet(SimpleHTTPRequestHandler):
    """Serves files and logs nothing."""

    def log_message(self, *_: Any) -> None:
        pass


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of the built site."""
    for package in ("material", "mkdocstrings"):
        pytest.importorskip(package, reason='needs pip install "capsense[docs]"')
    folder = tmp_path_factory.mktemp("site")
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", folder]
    env = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    subprocess.run(build, check=True, cwd=ROOT, env=env)
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder)))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    api = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    path = browser_path()
    if path is None:
        pytest.skip("needs Chromium")
    with api.sync_playwright() as driver:
        found = driver.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield found
        found.close()


def test_first_page(site: str, browser: Any) -> None:
    """The animation is loaded; the button leads through the themes of system, light and dark."""
    page = browser.new_page(viewport=DESKTOP, color_scheme="dark")
    page.goto(site)
    assert page.evaluate("document.querySelector('.hero img').naturalWidth") > 400
    schemes = []
    for _ in range(3):
        schemes.append(page.get_attribute("body", "data-md-color-scheme"))
        page.locator("label[for^=__palette]:not([hidden])").click()
    assert schemes == ["slate", "default", "slate"]
    page.close()


def test_commands_are_copied_without_prompts(site: str, browser: Any) -> None:
    """Neither prompts nor output; Python is copied as it stands."""
    context = browser.new_context(permissions=["clipboard-read", "clipboard-write"])
    page = context.new_page()
    page.goto(f"{site}/viewer/")
    copied = []
    for block in (".highlight:has(.gp)", ".highlight:not(:has(.gp))"):
        page.locator(f"{block} button[data-md-type=copy]").first.click()
        copied.append(page.evaluate("navigator.clipboard.readText()"))
    console, python = copied
    assert [line for line in console.splitlines() if line] == [
        'pip install "capsense[view]"', "capsense view examples/hand_approach.toml",
    ]  # fmt: skip
    assert "\n    while data.time < 10.0:\n" in python
    context.close()


@pytest.mark.parametrize("size", [PHONE, DESKTOP], ids=["phone", "desktop"])
@pytest.mark.parametrize(
    "path", ["", "theory/", "api/simulator/", "cli/", "notebooks/", "materials/"]
)
def test_pages_fit_their_window(site: str, browser: Any, path: str, size: dict[str, int]) -> None:
    """No page is wider than its window; signatures wrap; equations are typeset."""
    page = browser.new_page(viewport=size)
    page.goto(f"{site}/{path}", wait_until="networkidle")
    assert page.evaluate("document.documentElement.scrollWidth") == size["width"]
    cut = "e => [...e].filter(c => c.scrollWidth > c.clientWidth).map(c => c.textContent)"
    assert page.eval_on_selector_all(".doc-signature code", cut) == []
    raw = "e => [...e].filter(c => !c.querySelector('.katex')).map(c => c.textContent)"
    assert page.eval_on_selector_all(".arithmatex", raw) == []
    page.close()


def test_notebooks_are_shown_and_offered(site: str, browser: Any) -> None:
    page = browser.new_page()
    page.goto(f"{site}/notebooks/", wait_until="networkidle")
    widths = page.eval_on_selector_all("img[src^='data:']", "e => e.map(i => i.naturalWidth)")
    assert len(widths) == 3
    assert min(widths) > 300
    for name in ("first_sensor", "chip_readout"):
        got = page.request.get(f"{site}/notebooks/{name}.ipynb")
        assert got.ok
        assert got.json()["nbformat"] == 4
    page.close()


def test_pages_lead_to_their_neighbours(site: str, browser: Any) -> None:
    """Previous and next, in the order of ``mkdocs.yml``."""
    order = re.findall(r"- (\S+)\.md", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    page = browser.new_page()
    page.goto(f"{site}/cli/")
    links = page.eval_on_selector_all(".md-footer__link", "e => e.map(a => a.href)")
    here = order.index("cli")
    assert links == [f"{site}/{order[here - 1]}/", f"{site}/{order[here + 1]}/"]
    page.close()
