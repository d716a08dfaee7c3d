"""Takes pictures of every screen of the page, at each size of a window and in both themes, to look at them:

    python -m tests.browser.survey FOLDER [NAME ...]

With names, only the screens whose names begin with one of them are taken. The pictures are named
SCREEN-SIZE-THEME.png; `film.py` makes those of the documentation.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from playwright.sync_api import Browser, Page, sync_playwright

from tests.browser.conftest import PATIENCE_MS
from tests.browser.dashboard import FEW_FRAMES, Dashboard
from tests.browser.film import NOTICE_WAS_SHOWN, stand_at
from tests.browser.flags import FLAGS
from tests.browser.serving import Server
from tests.browser.test_accessibility import DIALOGS, OVERLAYS, THEMES

# A desk, a small desk, a tablet, a phone, and 1600 x 900 at a zoom of 200 %.
SIZES = {"1600": (1600, 900), "1280": (1280, 720), "820": (820, 1180), "390": (390, 844), "zoom": (800, 450)}
# What a picture waits for after a change: the plots and the canvases are drawn again.
SETTLE_MS = 500
# For so long after a click in the scene the camera does not fly to a selection (scene/focus.js).
CLICK_MS = 6500


class Survey:
    """Takes the pictures of a window of one size.

    Args:
        page: The page in the window.
        folder: Where the pictures are written.
        size: A name in `SIZES`.
        wanted: Beginnings of the names of the screens that are taken; empty for all.
    """

    def __init__(self, page: Page, folder: Path, size: str, wanted: list[str]) -> None:
        self.page = page
        self._folder, self._size, self._wanted = folder, size, wanted

    def takes(self, screen: str) -> bool:
        return not self._wanted or any(screen.startswith(name) for name in self._wanted)

    def picture(self, screen: str) -> None:
        """Take the screen in both themes; the whole length of the page on a phone."""
        if not self.takes(screen):
            return
        for theme in THEMES:
            self.page.evaluate(SHOW_THEME, theme)
            self.page.wait_for_timeout(SETTLE_MS)
            path = self._folder / f"{screen}-{self._size}-{theme}.png"
            self.page.screenshot(path=path, full_page=self._size == "390" and "dialog" not in screen)

    def picture_of(self, screen: str, show: Callable[[], object], leave: Callable[[], object]) -> None:
        """Take a screen that is shown first and left afterwards."""
        if self.takes(screen):
            show()
            self.page.wait_for_timeout(SETTLE_MS)
            self.picture(screen)
            leave()


# A click where the page has the button, else the theme of the page is set as the button does.
SHOW_THEME = """theme => { if (document.documentElement.dataset.theme !== theme)
  document.querySelector('#theme-button')?.dispatchEvent(new MouseEvent('click', { bubbles: true })); }"""


def main(folder: Path, wanted: list[str]) -> None:
    """Start the servers and a browser, and take all pictures."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as kept, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", headless=True, args=FLAGS)
        with Server(STEMMAP_FOLDER=kept) as server:
            for size in SIZES:
                survey_run(browser, server.link, folder, size, wanted)
        browser.close()


def survey_run(browser: Browser, link: str, folder: Path, size: str, wanted: list[str]) -> None:
    """The dashboard with its tabs, dialogs and overlays, the report, and the page of all runs."""
    context = browser.new_context(viewport={"width": SIZES[size][0], "height": SIZES[size][1]})
    context.set_default_timeout(PATIENCE_MS)
    page = context.new_page()
    page.add_init_script(FEW_FRAMES)
    page.add_init_script(NOTICE_WAS_SHOWN)
    dashboard = Dashboard(page, scene=True)
    page.goto(f"{link}&fixedDpr=0.5")
    survey = Survey(page, folder, size, wanted)
    page.locator("#welcome-on").wait_for()
    survey.picture("dialog-welcome")
    page.locator("#welcome-on").click()
    dashboard.pause()
    stand_at(dashboard, 30.05)
    if page.locator("#scene-show").is_visible():
        page.locator("#scene-show").click()
    page.wait_for_timeout(CLICK_MS)
    survey.picture("page")
    page.locator("#map").press("Escape")  # the selection of the size before, which the server keeps
    if not page.locator("#side").is_visible():
        page.locator("#drawer-button").click()
    page.locator("#trees tbody tr").nth(4).click()
    page.locator("#panel-story[data-story^=tree]").wait_for()
    for tab in dashboard.tabs():
        name = f"tab-{tab.lower()}"
        survey.picture_of(name, lambda tab=tab: dashboard.tab(tab), lambda: None)  # type: ignore[misc]
    dashboard.tab("Annotate")
    survey.picture_of(
        "tab-review", page.locator("#annotate-next").click, lambda: page.keyboard.press("Escape")
    )
    dashboard.tab("Trees")
    if page.locator("#drawer-button").is_visible():
        page.locator("#drawer-button").click()
    for button in DIALOGS:
        if page.locator(f"#{button}").is_visible():
            survey.picture_of(
                f"dialog-{button.removesuffix('-button')}",
                page.locator(f"#{button}").click,
                lambda: page.keyboard.press("Escape"),
            )
    for button, part in OVERLAYS.items():
        if page.locator(f"#{button}").is_visible():
            press = page.locator(f"#{button}")
            survey.picture_of(
                f"over-{part.removeprefix('#over-').removeprefix('#')}",
                press.click,
                lambda press=press: press.dispatch_event("click"),  # type: ignore[misc]
            )
    page.locator("#trees tbody tr").nth(4).dispatch_event("click")  # all windows share the selection
    if survey.takes("runs"):
        survey_runs(survey, link)
    context.close()


def survey_runs(survey: Survey, link: str) -> None:
    """The page of all runs, and a run."""
    page = survey.page
    page.goto(link.split("?")[0] + "runs")
    page.locator("#runs tbody tr").first.wait_for()
    survey.picture("runs")
    page.locator("#runs tbody tr button").first.click()
    page.locator(".run-map canvas").wait_for()
    survey.picture("runs-detail")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
