"""Pictures of the page of two robots: `python -m tests.browser.extensions.survey_fleet FOLDER`."""

from __future__ import annotations

import sys
from pathlib import Path

from playwright.sync_api import Browser, sync_playwright

from tests.browser.flags import FLAGS
from tests.browser.serving import Server
from tests.browser.survey import SIZES, Survey


def main(folder: Path) -> None:
    """Start a server and a browser, and take all pictures."""
    folder.mkdir(parents=True, exist_ok=True)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", headless=True, args=FLAGS)
        with Server("sim:paper?duration=20 sim:stand?duration=20") as fleet:
            for size in SIZES:
                survey_fleet(browser, fleet.link, folder, size, [])
        browser.close()


def survey_fleet(browser: Browser, link: str, folder: Path, size: str, wanted: list[str]) -> None:
    """The page of two robots."""
    context = browser.new_context(viewport={"width": SIZES[size][0], "height": SIZES[size][1]})
    page = context.new_page()
    survey = Survey(page, folder, size, wanted)
    if survey.takes("fleet"):
        page.goto(link)
        page.locator(".card").nth(1).wait_for()
        page.wait_for_timeout(4000)
        survey.picture("fleet")
    context.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
