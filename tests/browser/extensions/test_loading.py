"""Modules of extensions in the page."""

from __future__ import annotations

from playwright.sync_api import Route, expect

from tests.browser.dashboard import Dashboard

MODULES = "**/js/extensions/*/main.js"


def test_a_click_right_after_loading_counts_though_a_module_is_slow(dashboard: Dashboard):
    page = dashboard.page

    def late(route: Route) -> None:
        page.wait_for_timeout(700)
        route.continue_()

    page.route(MODULES, late)
    page.reload()
    page.locator("#keys-button").click()
    expect(page.get_by_label("Large controls")).to_be_visible(timeout=3000)
    page.keyboard.press("Escape")
    page.unroute(MODULES)


def test_a_module_that_fails_is_named_and_the_page_works(dashboard: Dashboard):
    page = dashboard.page
    broken = MODULES.replace("*/main", "search/main")
    page.route(broken, lambda route: route.fulfill(body="no script", content_type="text/javascript"))
    page.reload()
    expect(page.get_by_text("The extension search of the page is left out")).to_be_visible()
    expect(dashboard.tab("Annotate")).to_be_visible()
    page.unroute(broken)
    assert all("Unexpected identifier" in error for error in dashboard.errors), dashboard.errors
    dashboard.errors.clear()
