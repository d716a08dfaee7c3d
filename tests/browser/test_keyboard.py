"""By keyboard alone: a source is opened, eps tuned, three trees annotated, the map exported."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Locator, Page, expect

from tests.browser.conftest import opened
from tests.browser.dashboard import Dashboard
from tests.browser.serving import Server

SOURCE = "sim:paper?duration=6"


def tab_to(page: Page, target: Locator, key: str = "Tab") -> None:
    """Press Tab until an element has the focus."""
    for _ in range(80):
        if target.evaluate("node => node === document.activeElement"):
            return
        page.keyboard.press(key)
    raise AssertionError(f"{target} is not reached")


def test_a_run_is_opened_tuned_annotated_and_exported(chromium: Browser, server: Server, tmp_path: Path):
    with opened(chromium, server.link) as dashboard:
        page = dashboard.page
        page.locator("body").evaluate("() => document.activeElement?.blur()")
        # Open a source.
        tab_to(page, page.locator("#source-button"))
        page.keyboard.press("Enter")
        tab_to(page, page.locator("#source-uri"))
        page.keyboard.press("Control+a")
        page.keyboard.type(SOURCE)
        page.keyboard.press("Enter")
        dashboard.until_server("/api/status", f"it.source === '{SOURCE}' && it.state === 'finished'")
        # Tune eps.
        tab_to(page, page.locator("[role=tab][aria-selected=true]"))
        while page.locator("#tab-tune").get_attribute("aria-selected") != "true":
            page.keyboard.press("ArrowRight")
        before = dashboard.ask("/api/parameters")["values"]["clustering.eps"]
        tab_to(page, page.locator("#panel-tune [data-parameter='clustering.eps'] input[type=range]").first)
        page.keyboard.press("ArrowRight")
        dashboard.until_server("/api/parameters", f"it.values['clustering.eps'] > {before}")
        dashboard.until_server("/api/status", "it.remapped === null")
        # Annotate three trees.
        tab_to(page, page.locator("#tab-tune"), "Shift+Tab")
        page.keyboard.press("ArrowRight")
        expect(page.locator("#panel-annotate")).to_be_visible()
        chosen, number = page.locator("#trees tr[aria-selected=true]"), ""
        page.keyboard.press("s")  # to the first tree to review; an answer leads to the next one
        for count in (1, 2, 3):
            expect(chosen).to_have_count(1)
            expect(chosen).not_to_have_attribute("data-tree", number)
            number = chosen.get_attribute("data-tree") or ""
            dashboard.card_shown()
            page.keyboard.press("y")
            dashboard.until_server("/api/annotations", f"it.trees.length === {count}")
        # Export.
        tab_to(page, page.locator("#tab-annotate"), "Shift+Tab")
        page.keyboard.press("Home")
        while page.locator("#tab-trees").get_attribute("aria-selected") != "true":
            page.keyboard.press("ArrowLeft")
        tab_to(page, page.locator("#trees-csv"))
        with page.expect_download() as download:
            page.keyboard.press("Enter")
        rows = Path(download.value.path()).read_text().splitlines()
        assert len(rows) > 3
        assert rows[0].startswith("tree,x_m,y_m")
        dashboard.reset()


@pytest.mark.usefixtures("calm")
def test_escape_closes_the_welcome_card_while_the_scene_loads(chromium: Browser, server: Server):
    context = chromium.new_context(viewport={"width": 1260, "height": 720})
    try:
        page = context.new_page()
        page.goto(f"{server.link}&fixedDpr=0.3")
        expect(page.locator("#welcome")).to_be_visible()
        page.wait_for_function("() => document.querySelector('#scene').contentWindow?.__viserMutable?.scene")
        page.wait_for_timeout(2000)  # viser's client takes the focus once it is drawn
        assert page.evaluate("() => document.activeElement.id") == "welcome-on"
        page.keyboard.press("Escape")
        expect(page.locator("#welcome")).to_be_hidden()
    finally:
        context.close()


def test_the_marks_and_the_rows_have_one_tab_stop_each_and_arrows_move_inside(dashboard: Dashboard):
    page = dashboard.page
    dashboard.tab("Trees")
    for group, item, on in (("#marks", ".mark", "ArrowRight"), ("#trees tbody", "tr", "ArrowDown")):
        items = page.locator(f"{group} {item}")
        expect(items.nth(1)).to_be_attached()
        expect(page.locator(f"{group} {item}[tabindex='0']")).to_have_count(1)
        scan = dashboard.ask("/api/status")["scan_index"]
        tab_to(page, page.locator(f"{group} {item}[tabindex='0']"))
        page.keyboard.press("Home")
        page.keyboard.press(on)
        expect(items.nth(1)).to_be_focused()
        page.keyboard.press("End")
        expect(items.last).to_be_focused()
        expect(page.locator(f"{group} {item}[tabindex='0']")).to_have_count(1)
        assert dashboard.ask("/api/status")["scan_index"] == scan, "an arrow inside steps the run"
    number = page.locator("#trees tbody tr").last.get_attribute("data-tree")
    page.keyboard.press("Enter")
    expect(page.locator("#panel-story")).to_contain_text(re.compile(rf"[Tt]ree {number}(?!\d)"))
    page.locator("#map").press("Escape")
