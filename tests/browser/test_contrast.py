"""Every text can be read: WCAG AA (1.4.3) in both themes, on each tab and dialog, on a desk and a phone."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, expect

from tests.browser.conftest import opened
from tests.browser.contrast import too_low
from tests.browser.dashboard import COMPILING_S, Dashboard
from tests.browser.serving import Server

TABS = ("Trees", "Clusters", "Story", "Tune", "Annotate", "Scores", "Plots")
DIALOGS = ("source-button", "share-button", "keys-button", "palette-button")
SIZES = [(1440, 900), (390, 844)]


@pytest.fixture(params=SIZES, ids=["desk", "phone"])
def page_of_a_run(request: pytest.FixtureRequest, chromium: Browser, server: Server) -> Iterator[Dashboard]:
    with opened(chromium, server.link, *request.param) as dashboard:
        trees = "() => document.querySelectorAll('#trees tbody tr').length > 0"
        dashboard.page.wait_for_function(trees, polling=200, timeout=1000 * COMPILING_S)
        drawer = dashboard.page.locator("#drawer-button")
        if drawer.is_visible():
            drawer.click()
        yield dashboard


def in_both_themes(dashboard: Dashboard) -> list[str]:
    """Texts that stay too low in a theme. A plot takes a moment to be painted anew."""
    low = []
    for _ in range(2):
        found = too_low(dashboard.page)
        for _ in range(20):
            if not found:
                break
            dashboard.page.wait_for_timeout(250)
            found = too_low(dashboard.page)
        low += found
        # Not by a click: a dialog may lie over the button.
        dashboard.page.evaluate("() => document.querySelector('#theme-button').click()")
    return low


def test_texts_have_enough_contrast(page_of_a_run: Dashboard):
    dashboard, page = page_of_a_run, page_of_a_run.page
    low: dict[str, list[str]] = {}
    page.locator("#map").press("Escape")  # what was selected before, by whomever
    expect(page.locator("#trees [aria-selected=true]")).to_have_count(0)
    page.locator("#trees tbody tr").first.click()  # a row that is selected has another background
    expect(page.locator("#panel-story .verdict")).to_be_visible()
    for tab in TABS:
        dashboard.tab(tab)
        low[tab] = in_both_themes(dashboard)
    for button in DIALOGS:
        if page.locator(f"#{button}").is_visible():
            page.locator(f"#{button}").click()
            expect(page.locator("dialog[open]")).to_be_visible()
            low[button] = in_both_themes(dashboard)
            page.keyboard.press("Escape")
    page.goto(dashboard.page.url.split("?")[0] + "runs")
    page.locator("#runs tbody tr button").first.click()
    expect(page.locator(".run-map canvas")).to_be_visible()
    low["runs"] = in_both_themes(dashboard)
    assert {where: told for where, told in low.items() if told} == {}


def test_the_measure_of_contrast_is_that_of_wcag(chromium: Browser):
    """Grey #767676 on white has 4.54, #777777 has 4.48, #808080 on black 5.32; half of black is #7f7f7f."""
    context = chromium.new_context()
    try:
        page = context.new_page()
        page.set_content(
            "<body style='background: white; font: 16px serif'>"
            + "<p style='color: #767676'>enough</p>" * 12
            + "<p style='color: #777777'>little</p>"
            "<p style='color: #777777; font-size: 24px'>large</p>"
            "<div style='background: #000'><p style='color: #808080'>dark</p></div>"
            "<p style='color: rgb(0 0 0 / 50%)'>glass</p><p style='opacity: 0.5; color: black'>faded</p>"
            "<input style='color: black' placeholder='hint'>"
            "<style>::placeholder { color: #999; opacity: 1 }</style>"
        )
        found = {told.split("“")[1].rstrip("”"): float(told.split()[0]) for told in too_low(page)}
    finally:
        context.close()
    assert found == {
        "little": pytest.approx(4.48, abs=0.01),
        "glass": pytest.approx(3.98, abs=0.06),
        "faded": pytest.approx(3.98, abs=0.06),
        "hint": pytest.approx(2.85, abs=0.01),
    }


FOCUSED = """() => {
  const node = document.activeElement;
  const { outlineStyle, outlineWidth, boxShadow } = getComputedStyle(node);
  const outlined = outlineStyle !== 'none' && parseFloat(outlineWidth) >= 1;
  return {
    name: node.id || node.textContent.trim().slice(0, 30) || node.tagName,
    page: node === document.body || node.tagName === 'IFRAME',
    seen: outlined || boxShadow !== 'none',
  };
}"""


def test_the_focused_control_is_visible(chromium: Browser, server: Server):
    with opened(chromium, server.link) as dashboard:
        page = dashboard.page
        dashboard.until("() => document.querySelectorAll('#trees tbody tr').length > 0")
        page.locator("#source-button").focus()
        reached = []
        for _ in range(24):
            page.keyboard.press("Tab")
            at = page.evaluate(FOCUSED)
            if at["page"]:
                break
            assert at["seen"], at["name"]
            reached.append(at["name"])
        assert len(set(reached)) > 15
        assert "find" in reached
