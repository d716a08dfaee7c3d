"""One Chromium and one server for all browser tests, and the dashboard open in it.

Software rendering is slow: the window is small and the scene has a coarse resolution.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, Playwright, expect, sync_playwright

from tests.browser.dashboard import FEW_FRAMES, PATIENCE_S, RUN, Dashboard
from tests.browser.flags import FLAGS
from tests.browser.serving import Server

PATIENCE_MS = 1000 * PATIENCE_S
expect.set_options(timeout=PATIENCE_MS)


# Files, and tests of other files, of the default run: what each user does on each visit, and answers that
# must belong to the tree that was shown. All tests of this folder take longer than the default run may.
_DEFAULT = {
    "test_first_page.py",
    "test_dashboard.py",
    "test_the_strip_of_a_live_run_is_whole_and_nothing_in_it_moves",
    "test_a_person_in_the_way_is_reported",
    "test_trees_are_reviewed_added_edited_and_undone",
    "test_quick_answers_belong_to_the_tree_on_the_card",
}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of this folder; those that do not belong to the default run are slow."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.browser)
            if not _DEFAULT & {item.path.name, item.name.split("[")[0]}:
                item.add_marker(pytest.mark.slow)


# Not of the session: while Playwright runs, its event loop is the running one of the thread, and an
# asynchronous test of another folder could not start.
@pytest.fixture(scope="package")
def playwright() -> Iterator[Playwright]:
    with sync_playwright() as started:
        yield started


@pytest.fixture(scope="package")
def chromium(playwright: Playwright) -> Iterator[Browser]:
    path = os.environ.get("CHROMIUM", "/usr/bin/chromium")
    if not Path(path).exists():
        pytest.skip(
            f"no Chromium at {path}: install it (on Debian: sudo apt-get install chromium), "
            "or name another one with CHROMIUM=/path/to/chrome"
        )
    browser = playwright.chromium.launch(executable_path=path, headless=True, args=FLAGS)
    shared = browser.new_context(color_scheme="dark").new_page()  # the tab of `opened`
    shared.set_default_timeout(PATIENCE_MS)
    shared.add_init_script(FEW_FRAMES)
    yield browser
    browser.close()


@pytest.fixture(scope="package")
def server(chromium: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with Server(STEMMAP_FOLDER=str(tmp_path_factory.mktemp("stemmap"))) as running:
        yield running


@contextmanager
def opened(
    chromium: Browser, link: str, width: int = 1260, height: int = 720, scene: bool = False
) -> Iterator[Dashboard]:
    """Open the dashboard in the shared tab, which is free again afterwards, and close the card of the first
    visit.

    A tab of its own would cost more than twice the time, because each starts a process that compiles every
    script.
    """
    page = chromium.contexts[0].pages[0]
    assert page.url == "about:blank", "another test still uses the tab; see opened_by_another"
    with _visited(page, link, width, height, scene) as dashboard:
        yield dashboard


@contextmanager
def opened_by_another(chromium: Browser, link: str) -> Iterator[Dashboard]:
    """Open the dashboard as another person: in a browser context of its own, at the same time."""
    context = chromium.new_context(color_scheme="dark")
    context.set_default_timeout(PATIENCE_MS)
    try:
        with _visited(context.new_page(), link, 1260, 720, scene=False) as dashboard:
            yield dashboard
    finally:
        context.close()


@contextmanager
def _visited(page: Page, link: str, width: int, height: int, scene: bool) -> Iterator[Dashboard]:
    page.set_viewport_size({"width": width, "height": height})
    dashboard = Dashboard(page, scene)
    try:
        page.goto(f"{link}&fixedDpr=0.3")
        page.locator("#welcome-on").click()
        yield dashboard
    finally:  # the page of a failed test would otherwise continue to draw
        dashboard.leave()


@pytest.fixture(scope="module")
def dashboard(chromium: Browser, server: Server) -> Iterator[Dashboard]:
    """A page on the default run and the preset, without annotations."""
    with opened(chromium, server.link) as made:
        made.reset()
        yield made
        made.open(RUN)
        assert made.errors == [], "the page reported errors that no test expected"


@pytest.fixture
def calm(dashboard: Dashboard) -> Iterator[None]:
    """Begin a test on a paused scan in the middle of the run with the parameters of the preset."""
    dashboard.stand()
    yield
    for dialog in dashboard.page.locator("dialog[open]").all():
        dialog.press("Escape")


@pytest.fixture
def mapped(chromium: Browser, server: Server) -> Iterator[Dashboard]:
    """The whole map of a run that stands, without annotations."""
    with opened(chromium, server.link) as dashboard:
        dashboard.reset()
        dashboard.stand()
        dashboard.until_server("/api/trees", "it.trees.length > 20")
        yield dashboard
