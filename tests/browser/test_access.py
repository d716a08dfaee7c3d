"""What people need who use no mouse, speech input, or the theme of their system."""

from __future__ import annotations

import re

import pytest
from playwright.sync_api import Browser, expect

from tests.browser.conftest import PATIENCE_MS
from tests.browser.contrast import too_low
from tests.browser.dashboard import SCENE, Dashboard
from tests.browser.serving import Server


@pytest.mark.usefixtures("calm")
def test_single_keys_are_switched_off(dashboard: Dashboard):
    page = dashboard.page
    measure = page.locator("#map-measure")
    page.locator("body").press("?")
    page.get_by_label("Keyboard shortcuts without Ctrl").uncheck()
    page.keyboard.press("Escape")
    page.locator("body").press("m")
    expect(measure).to_have_attribute("aria-pressed", "false")
    page.locator("body").press("Control+k")
    expect(page.locator("#palette")).to_be_visible()
    page.keyboard.press("Escape")
    page.locator("#keys-button").click()
    page.get_by_label("Keyboard shortcuts without Ctrl").check()
    page.keyboard.press("Escape")
    page.locator("body").press("m")
    expect(measure).to_have_attribute("aria-pressed", "true")
    page.locator("body").press("m")


def test_settings_tell_what_the_run_keeps(dashboard: Dashboard):
    page = dashboard.page
    page.locator("body").press("?")
    expect(page.locator("#run-storage")).to_contain_text(
        re.compile(r"^This run keeps \d+\.\d of 2\.0 GB in temporary files and \d+ of 450 MB in memory")
    )
    page.keyboard.press("Escape")


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_the_first_theme_is_that_of_the_system_and_tab_leads_to_the_map(
    chromium: Browser, server: Server, theme: str
):
    context = chromium.new_context(color_scheme=theme)  # type: ignore[arg-type]
    context.set_default_timeout(PATIENCE_MS)
    page = context.new_page()
    page.route(SCENE, lambda route: route.fulfill(body="", content_type="text/html"))
    page.goto(server.link)
    page.locator("#welcome-on").click()
    expect(page.locator("html")).to_have_attribute("data-theme", theme)
    expect(page.get_by_role("heading", level=1)).to_have_count(1)
    page.locator("body").evaluate("node => { document.activeElement?.blur(); node.scrollTop = 0; }")
    page.keyboard.press("Tab")
    skip = page.get_by_role("link", name="Skip to the map")
    if not skip.evaluate("node => node === document.activeElement"):
        skip.focus()  # the focus begins where the card of the first visit was
    expect(skip).to_be_in_viewport()
    page.keyboard.press("Enter")
    expect(page.locator("#map")).to_be_focused()
    context.close()


def test_controls_are_large_for_gloves_and_the_page_is_readable_in_the_sun(dashboard: Dashboard):
    page = dashboard.page
    page.set_viewport_size({"width": 820, "height": 1180})
    expect(page.locator("#side")).to_be_visible()  # a tablet begins with the map
    page.locator("#keys-button").click()
    page.get_by_label("Large controls").check()
    page.locator("#theme-choice").select_option("sunlight")
    page.keyboard.press("Escape")
    for tab in dashboard.tabs():
        dashboard.tab(tab)
        assert page.evaluate(LOW) == [], tab
        assert page.evaluate("document.documentElement.scrollWidth") <= 820
        assert page.evaluate(OUTSIDE) == [], tab
        assert too_low(page, 7.0, 4.5) == [], tab
    for width in (360, 390, 440):
        page.set_viewport_size({"width": width, "height": 740})
        assert page.evaluate(COVERED) == [], width
    page.reload()
    expect(page.locator("html")).to_have_attribute("data-controls", "large")
    expect(page.locator("html")).to_have_attribute("data-contrast", "high")
    page.locator("#keys-button").click()
    page.get_by_label("Large controls").uncheck()
    page.locator("#theme-choice").select_option("dark")
    page.keyboard.press("Escape")
    page.set_viewport_size({"width": 1260, "height": 720})


# Controls that the drawer cuts.
OUTSIDE = """() => {
  const { right: edge } = document.querySelector('#side').getBoundingClientRect();
  const isCut = (node) => node.offsetWidth && node.getBoundingClientRect().right > edge + 1
    && !node.closest('.scroll, [class$=-list]'); // these scroll
  const all = [...document.querySelectorAll('#side :is(button, select, input)')];
  return all.filter(isCut).map(node => node.id || node.textContent);
}"""

# Controls of the playback that another one covers in part.
COVERED = """() => {
  const all = [...document.querySelectorAll('.transport :is(button:not(.mark), select)')];
  const boxes = all.filter(node => node.offsetWidth).map(node => [node.id, node.getBoundingClientRect()]);
  return boxes.flatMap(([id, a], k) => boxes.slice(k + 1)
    .filter(([, b]) => a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom)
    .map(([other]) => `${id} ${other}`));
}"""

# Controls lower than a finger in a glove needs; the marks of the timeline are as narrow as time is.
LOW = """() => [...document.querySelectorAll(':is(header, main, footer) :is(button, select)')]
  .filter(node => node.offsetWidth > 0 && node.offsetHeight < 44 && !node.matches('.mark'))
  .map(node => `${node.id || node.textContent}: ${node.offsetHeight} px`)"""
