"""axe-core finds no violation on any tab, dialog and page, in both themes."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, Frame, Page, expect

from tests.browser.conftest import opened
from tests.browser.dashboard import Dashboard
from tests.browser.serving import Server
from tests.browser.test_contrast import DIALOGS, TABS

THEMES = ("dark", "light")
OVERLAYS = ("layers-button", "stages-button", "compare-button", "layout-button")
# viser's client in the frame of the scene; listed apart, because its elements are not ours.
SCENE = "#scene"
VISER = {"button-name", "landmark-one-main", "page-has-heading-one", "region"}


def violations(page: Page | Frame) -> list[str]:
    """The violations in a page without the frame of the scene: rule and element of each."""
    found = Axe().run(page, {"exclude": [[SCENE]]}).response["violations"]
    return [f"{rule['id']}: {node['target'][0]}" for rule in found for node in rule["nodes"]]


def in_both_themes(page: Page) -> list[str]:
    """The violations in a page, under each theme."""
    found = []
    for theme in THEMES:
        page.evaluate("theme => { document.documentElement.dataset.theme = theme; }", theme)
        page.wait_for_timeout(300)  # transitions of colours
        found += [f"{theme} {each}" for each in violations(page)]
    return found


@pytest.fixture(params=[(1440, 900), (390, 844)], ids=["desk", "phone"])
def page_of_a_run(request: pytest.FixtureRequest, chromium: Browser, server: Server) -> Iterator[Dashboard]:
    with opened(chromium, server.link, *request.param) as dashboard:
        dashboard.until("() => document.querySelectorAll('#trees tbody tr').length > 0")
        dashboard.pause()
        yield dashboard


def test_no_tab_no_dialog_and_no_page_has_a_violation(page_of_a_run: Dashboard):
    dashboard, page = page_of_a_run, page_of_a_run.page
    found: dict[str, list[str]] = {}
    page.locator("#map").press("Escape")  # what was selected before
    expect(page.locator("#trees [aria-selected=true]")).to_have_count(0)
    page.locator("#trees tbody tr").first.click()
    expect(page.locator("#panel-story .verdict")).to_be_visible()
    for tab in TABS:
        dashboard.tab(tab)
        found[tab] = in_both_themes(page)
    for button in DIALOGS:
        if page.locator(f"#{button}").is_visible():
            page.locator(f"#{button}").click()
            expect(page.locator("dialog[open]")).to_be_visible()
            found[button] = in_both_themes(page)
            page.keyboard.press("Escape")
    for button in OVERLAYS:
        if page.locator(f"#{button}").is_visible():
            page.locator(f"#{button}").click()
            found[button] = in_both_themes(page)
            page.locator(f"#{button}").dispatch_event("click")
    page.goto(page.url.split("?")[0] + "runs")
    page.locator("#runs tbody tr button").first.click()
    expect(page.locator(".run-map canvas")).to_be_visible()
    found["runs"] = in_both_themes(page)
    violations = [f"{where}: {each}" for where, rules in found.items() for each in rules]
    assert not violations, "\n".join(violations)


def test_the_card_of_the_first_visit_and_a_lost_link(chromium: Browser, server: Server):
    context = chromium.new_context()
    try:
        page = context.new_page()
        page.goto(server.link)
        expect(page.locator("#welcome")).to_be_visible()
        found = in_both_themes(page)
        page.goto(server.link.split("?")[0] + "?token=another")
        found += violations(page)
    finally:
        context.close()
    assert found == []


def test_what_axe_says_of_the_frame_of_viser(chromium: Browser, server: Server):
    """The elements are those of viser's client; the list tells when that changes."""
    with opened(chromium, server.link, scene=True) as dashboard:
        rules = {each.split(":")[0] for each in violations(dashboard.scene)}
    assert rules <= VISER, rules


def test_axe_finds_a_button_without_a_name(chromium: Browser):
    context = chromium.new_context()
    try:
        page = context.new_page()
        page.set_content("<html lang=en><title>t</title><main><h1>h</h1><button></button></main></html>")
        assert violations(page) == ["button-name: button"]
    finally:
        context.close()
