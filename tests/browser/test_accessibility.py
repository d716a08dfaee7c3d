"""Each tab, dialog and page in both themes: axe-core finds no violation, and every text can be read."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, Frame, Page, expect

from tests.browser.conftest import opened
from tests.browser.contrast import too_low
from tests.browser.dashboard import COMPILING_S, SCENE, Dashboard, leave_empty
from tests.browser.serving import Server

DIALOGS = ("source-button", "share-button", "keys-button", "palette-button")
# Buttons with the part of the page that each of them shows.
OVERLAYS = {
    "views-button": "#view-list",
    "layers-button": "#layer-list",
    "stages-button": "#over-stages",
    "compare-button": "#over-compare",
    "layout-button": "#layout-menu",
}
FRAME = "#scene"  # its elements are those of viser; see test_scene.py
THEMES = ("dark", "light")
SIZES = [(1440, 900), (390, 844)]
# The rules of axe-core on colours: all others give the same in both themes.
COLOUR_RULES = ["color-contrast", "link-in-text-block"]


def violations(page: Page | Frame, part: str | None = None, rules: list[str] | None = None) -> list[str]:
    """The violations in a page or a part of it without the frame of the scene: rule and element of each.

    In a part, the rule of contrast is left out, which is the slowest one: `too_low` measures the same.
    """
    if page.evaluate("() => !window.axe"):
        page.evaluate(Axe().axe_script)
    context: dict[str, Any] = {"exclude": [[FRAME]]}
    options: dict[str, Any] = {"resultTypes": ["violations"]}
    if part is not None:
        context["include"] = [[part]]
        options["rules"] = {"color-contrast": {"enabled": False}}
    if rules is not None:
        options["runOnly"] = rules
    run = "([context, options]) => axe.run(context, options).then((found) => found.violations)"
    found = page.evaluate(run, [context, options])
    return [f"{rule['id']}: {node['target'][0]}" for rule in found for node in rule["nodes"]]


def unreadable(page: Page) -> list[str]:
    """The texts whose contrast stays too low (WCAG AA 1.4.3). A plot takes a moment to be painted again."""
    found = too_low(page)
    for _ in range(20):
        if not found:
            break
        page.wait_for_timeout(250)
        found = too_low(page)
    return [f"contrast: {each}" for each in found]


def in_both_themes(page: Page, part: str | None = None) -> list[str]:
    """What is wrong with a page under each theme; axe-core looks only at a part of it where one is given."""
    found = []
    for theme in THEMES:
        expect(page.locator("html")).to_have_attribute("data-theme", theme)
        wrong = unreadable(page)
        if theme == THEMES[0]:
            wrong += violations(page, part)
        elif part is None:
            wrong += violations(page, rules=COLOUR_RULES)
        found += [f"{theme} {each}" for each in wrong]
        # Not by a click of the mouse: a dialog may lie over the button.
        page.evaluate("() => document.querySelector('#theme-button').click()")
    return found


@pytest.fixture(params=SIZES, ids=["desk", "phone"])
def page_of_a_run(request: pytest.FixtureRequest, chromium: Browser, server: Server) -> Iterator[Dashboard]:
    with opened(chromium, server.link, *request.param) as dashboard:
        dashboard.page.emulate_media(reduced_motion="reduce")  # colours change at once
        trees = "() => document.querySelectorAll('#trees tbody tr').length > 0"
        dashboard.page.wait_for_function(trees, polling=200, timeout=1000 * COMPILING_S)
        dashboard.pause()
        drawer = dashboard.page.locator("#drawer-button")
        if drawer.is_visible():
            drawer.click()
        yield dashboard
        dashboard.page.emulate_media(reduced_motion="null")


def test_no_tab_no_dialog_and_no_page_has_a_violation_or_a_text_that_cannot_be_read(page_of_a_run: Dashboard):
    dashboard, page = page_of_a_run, page_of_a_run.page
    found: dict[str, list[str]] = {}
    page.locator("#map").press("Escape")  # what was selected before
    expect(page.locator("#trees [aria-selected=true]")).to_have_count(0)
    page.locator("#trees tbody tr").first.click()  # a row that is selected has another background
    expect(page.locator("#panel-story .verdict")).to_be_visible()
    dashboard.tab("Trees")
    found["the whole page"] = in_both_themes(page)
    for tab in dashboard.tabs():
        dashboard.tab(tab)
        found[tab] = in_both_themes(page, f"#panel-{tab.lower()}")
    for button in DIALOGS:
        if page.locator(f"#{button}").is_visible():
            page.locator(f"#{button}").click()
            expect(page.locator("dialog[open]")).to_be_visible()
            found[button] = in_both_themes(page, "dialog[open]")
            page.keyboard.press("Escape")
    for button, part in OVERLAYS.items():
        if page.locator(f"#{button}").is_visible():
            page.locator(f"#{button}").click()
            expect(page.locator(part)).to_be_visible()
            found[button] = in_both_themes(page, part)
            page.locator(f"#{button}").dispatch_event("click")
    page.goto(page.url.split("?")[0] + "runs")
    page.locator("#runs tbody tr button").first.click()
    expect(page.locator(".run-map canvas")).to_be_visible()
    found["runs"] = in_both_themes(page)
    wrong = [f"{where}: {each}" for where, rules in found.items() for each in rules]
    assert not wrong, "\n".join(wrong)


def test_the_card_of_the_first_visit_and_a_lost_link(chromium: Browser, server: Server):
    context = chromium.new_context(reduced_motion="reduce", color_scheme="dark")
    try:
        page = context.new_page()
        page.route(SCENE, leave_empty)
        page.goto(server.link)
        expect(page.locator("#welcome")).to_be_visible()
        found = in_both_themes(page)
        page.goto(server.link.split("?")[0] + "?token=another")
        found += violations(page)
    finally:
        context.close()
    assert found == []


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
