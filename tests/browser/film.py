"""Makes the pictures of the README and a short film of the dashboard:

    python -m tests.browser.film docs

Software rendering is slow: this takes a minute or two. Nothing is staged but the clicks.
"""

from __future__ import annotations

import io
import sys
import tempfile
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

from tests.browser.conftest import PATIENCE_MS
from tests.browser.dashboard import Dashboard
from tests.browser.flags import FLAGS
from tests.browser.serving import Server

SIZE = (1440, 900)
FILM_WIDTH = 640
FILM_COLOURS = 64
SHADES = 64  # of each colour in a picture: the files stay small, and no colour is lost as in a palette
STEP_MS = 700
# The notice of software rendering then closes at once.
NOTICE_WAS_SHOWN = "localStorage.setItem('stemmap.rendering-notice', 'shown')"
_SHADE = 256 // SHADES
_ROUNDS = 6


class Camera:
    """Keeps pictures and the frames of the film."""

    def __init__(self, page: Page, folder: Path) -> None:
        self._page, self._folder = page, folder
        self._film: list[Image.Image] = []

    def picture(self, name: str) -> None:
        """Save what is seen now as NAME.png."""
        shot = self._shot().point([_SHADE * (level // _SHADE) for level in range(256)] * 3)
        shot.save(self._folder / f"{name}.png", optimize=True)

    def roll(self, frames: int = 1) -> None:
        """Take frames for the film."""
        for _ in range(frames):
            shot = self._shot()
            height = round(shot.height * FILM_WIDTH / shot.width)
            small = shot.resize((FILM_WIDTH, height), Image.Resampling.LANCZOS)
            self._film.append(
                # Refined, or a dark ground takes the tint of whatever colour is nearest.
                small.quantize(
                    FILM_COLOURS, Image.Quantize.MAXCOVERAGE, kmeans=_ROUNDS, dither=Image.Dither.NONE
                )
            )

    def save_film(self) -> None:
        """Write the film as GIF."""
        first, *others = self._film
        first.save(
            self._folder / "film.gif",
            save_all=True,
            append_images=others,
            duration=STEP_MS,
            loop=0,
            optimize=True,
        )

    def _shot(self) -> Image.Image:
        return Image.open(io.BytesIO(self._page.screenshot())).convert("RGB")


def main(folder: Path) -> None:
    """Start a server and a browser, and take all pictures."""
    with tempfile.TemporaryDirectory() as kept, sync_playwright() as playwright:
        server = Server(STEMMAP_FOLDER=kept)
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", headless=True, args=FLAGS)
        page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
        page.set_default_timeout(PATIENCE_MS)
        page.add_init_script(NOTICE_WAS_SHOWN)
        dashboard = Dashboard(page, scene=True)
        page.goto(server.link)
        page.locator("#welcome-on").click()
        camera = Camera(page, folder)
        try:
            monitor(dashboard, camera)
            tune(dashboard, camera)
            compare(dashboard, camera)
            annotate(dashboard, camera)
            camera.save_film()
        finally:
            browser.close()
            server.stop()


def stand_at(dashboard: Dashboard, time_s: float) -> None:
    """Pause, and stand at a time of the run."""
    dashboard.pause()
    dashboard.command({"type": "seek", "time_s": time_s})
    near = f"it.state === 'paused' && Math.abs(it.time_s - {time_s}) < 0.11"
    dashboard.until_server("/api/status", near)
    dashboard.page.wait_for_timeout(2000)


def monitor(dashboard: Dashboard, camera: Camera) -> None:
    """The run as it plays, and the story of a tree."""
    for time_s in (8.05, 14.05, 20.05):
        stand_at(dashboard, time_s)
        camera.roll()
    stand_at(dashboard, 30.05)
    dashboard.tab("Trees")
    camera.picture("monitor")
    dashboard.page.locator("#trees tbody tr").nth(9).click()
    dashboard.page.locator("#panel-story[data-story^=tree]").wait_for()
    dashboard.page.wait_for_timeout(2000)
    camera.picture("dashboard")
    camera.roll(2)
    dashboard.page.locator("#map").press("Escape")


def tune(dashboard: Dashboard, camera: Camera) -> None:
    """A slider moves, and the scan answers."""
    dashboard.tab("Tune")
    slider = dashboard.page.get_by_role("slider", name="Radius eps, slider")
    slider.scroll_into_view_if_needed()
    camera.roll()
    for _ in range(3):
        for _ in range(12):
            slider.press("ArrowRight")
        dashboard.page.wait_for_timeout(1500)
        camera.roll()
    camera.picture("tune")
    dashboard.page.locator("#tune-reset").click()
    dashboard.until_server("/api/parameters", "it.changed.length === 0")


def compare(dashboard: Dashboard, camera: Camera) -> None:
    """The four stages, and the paper's parameters beside ours."""
    page = dashboard.page
    page.locator("#stages-button").click()
    dashboard.until("() => document.querySelector('#over-stages').dataset.scan")
    page.wait_for_timeout(1000)
    camera.roll(2)
    page.locator("#over-stages [data-close]").click()
    page.locator("#compare-button").click()
    page.locator("[data-set=b]").select_option("paper")
    page.locator("#compare-differences").wait_for()
    page.wait_for_timeout(1000)
    camera.roll(2)
    page.locator("#over-compare [data-close]").click()


def annotate(dashboard: Dashboard, camera: Camera) -> None:
    """Trees are judged one after the other."""
    page = dashboard.page
    dashboard.tab("Annotate")
    page.locator("#annotate-next").click()
    for number in range(1, 5):  # the next tree is selected after each
        dashboard.card_shown()
        page.locator("#annotate-yes").click()
        page.locator("#annotate-count", has_text=f"{number} of").wait_for()
        camera.roll()
    page.wait_for_timeout(1500)
    camera.picture("annotate")
    camera.roll(2)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
