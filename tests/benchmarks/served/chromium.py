"""A real Chromium with the page open: time until it is ready, and delay of a scan."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from playwright.sync_api import Browser, Page, sync_playwright

from tests.browser.flags import FLAGS

LONGEST_MS = 90_000
# The table of trees has rows, the strip its figures, and the map is painted.
READY = "() => document.querySelectorAll('#trees tbody tr').length > 0"
DRAWN = """() => { let points = 0;
  window.__viserMutable?.scene?.traverse(node => {
    if (node.isPoints) points += node.geometry.attributes.position.count;
  });
  return points > 1000; }"""
# Records the arrival of a map, with the same clock as Python.
NOTE_MAPS = """window.__maps = [];
  const Plain = WebSocket;
  window.WebSocket = class extends Plain {
    constructor(...given) {
      super(...given);
      this.addEventListener('message', ({ data }) => {
        if (typeof data !== 'string' || !data.startsWith('{"type":"map"')) return;
        window.__maps.push([JSON.parse(data).index, Date.now() / 1000]);
      });
    }
  };"""


def where() -> Path | None:
    """Return the program of Chromium; None if it is not installed."""
    path = Path(os.environ.get("CHROMIUM", "/usr/bin/chromium"))
    return path if path.exists() else None


@contextmanager
def chromium(program: Path) -> Iterator[Browser]:
    """A browser, which is closed at the end."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=str(program), headless=True, args=FLAGS)
        yield browser
        browser.close()


@contextmanager
def page_of(browser: Browser, link: str) -> Iterator[tuple[Page, float, float]]:
    """A new page at a link, and the seconds until it is ready: until the trees are listed and the map is
    drawn, and until points are in the 3D scene."""
    context = browser.new_context(viewport={"width": 1000, "height": 640})
    context.set_default_timeout(LONGEST_MS)
    context.add_init_script(NOTE_MAPS)
    context.add_init_script("localStorage.setItem('stemmap.welcomed', 'yes')")
    page = context.new_page()
    start = time.perf_counter()
    page.goto(link)
    page.wait_for_function(READY, polling=10)
    ready = time.perf_counter() - start
    page.wait_for_function(
        "() => document.querySelector('#scene').contentWindow?.location.pathname === '/viser/'"
    )
    scene = next(frame for frame in page.frames if "/viser/" in frame.url)
    scene.wait_for_function(DRAWN, polling=50)
    drawn = time.perf_counter() - start
    try:
        yield page, ready, drawn
    finally:
        context.close()
