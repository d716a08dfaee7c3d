"""A real Chromium, a real server, and the dashboard open in it. Software rendering is slow: the window is
small, the scene is drawn coarsely, and everything is waited for, patiently.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Playwright, expect, sync_playwright

from tests.browser.dashboard import FEW_FRAMES, MIDDLE_S, PATIENCE_S, Dashboard
from tests.browser.flags import FLAGS
from tests.browser.serving import Server

PATIENCE_MS = 1000 * PATIENCE_S
expect.set_options(timeout=PATIENCE_MS)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what drives a browser, and let it come last: while Playwright runs, its event loop is the running
    one of this thread, and a test that is a coroutine could not start.
    """
    for item in items:
        if drives_browser(item):
            item.add_marker(pytest.mark.browser)
    items.sort(key=drives_browser)


def drives_browser(item: pytest.Item) -> bool:
    """Whether a test stands in this folder."""
    return Path(__file__).parent in item.path.parents


@pytest.fixture(scope="session")
def playwright() -> Iterator[Playwright]:
    with sync_playwright() as started:
        yield started


@pytest.fixture(scope="session")
def chromium(playwright: Playwright) -> Iterator[Browser]:
    path = os.environ.get("CHROMIUM", "/usr/bin/chromium")
    if not Path(path).exists():
        pytest.skip(
            f"no Chromium at {path}: install it (on Debian: sudo apt-get install chromium), "
            "or name another one with CHROMIUM=/path/to/chrome"
        )
    browser = playwright.chromium.launch(executable_path=path, headless=True, args=FLAGS)
    yield browser
    browser.close()


@pytest.fixture(scope="session")
def server(chromium: Browser) -> Iterator[Server]:
    with Server() as running:
        yield running


@contextmanager
def opened(
    chromium: Browser, link: str, width: int = 1260, height: int = 720, scene: bool = False
) -> Iterator[Dashboard]:
    """The dashboard in a browser of its own, past the card of the first visit."""
    context = chromium.new_context(viewport={"width": width, "height": height})
    try:
        context.set_default_timeout(PATIENCE_MS)
        context.add_init_script(FEW_FRAMES)
        page = context.new_page()
        dashboard = Dashboard(page, scene)
        page.goto(f"{link}&fixedDpr=0.3")
        page.locator("#welcome-on").click()
        yield dashboard
    finally:  # a page that a failed test left would go on drawing, and slow down all that come
        context.close()


@pytest.fixture(scope="module")
def dashboard(chromium: Browser, server: Server) -> Iterator[Dashboard]:
    with opened(chromium, server.link) as made:
        yield made


@pytest.fixture
def calm(dashboard: Dashboard) -> Iterator[None]:
    """Each test begins on a standing scan in the middle of the run, with the parameters of the preset."""
    dashboard.pause()
    # To a place between two scans, so that the one before it is not taken for the end of the way.
    dashboard.command({"type": "seek", "time_s": MIDDLE_S})
    there = f"it.time_s > {MIDDLE_S} - 0.08 && it.time_s < {MIDDLE_S} + 0.01"
    dashboard.until_server("/api/status", f"it.state === 'paused' && {there}")
    yield
    for dialog in dashboard.page.locator("dialog[open]").all():
        dialog.press("Escape")
