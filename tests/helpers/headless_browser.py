"""A headless Chromium that draws without a graphics card."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

BROWSERS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
"""Programs that will do."""
OPTIONS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader",
           "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")  # fmt: skip
PATIENCE = 60_000.0
"""Longest wait for a page [ms]; a software renderer is slow."""


def browser_path() -> str | None:
    """Where one is installed; None if none is."""
    return next(filter(None, map(shutil.which, BROWSERS)), None)


@contextmanager
def browser_page(width: int, height: int) -> Iterator[Any]:
    """An empty page; ``page.asked`` collects all addresses that it asks for."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=browser_path(), args=OPTIONS)
        page = browser.new_page(viewport={"width": width, "height": height})
        page.set_default_timeout(PATIENCE)
        page.asked = []
        page.on("request", lambda request: page.asked.append(request.url))
        page.on("websocket", lambda opened: page.asked.append(opened.url))
        yield page
        browser.close()
