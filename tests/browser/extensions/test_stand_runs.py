"""Two runs compared on the page of runs."""

from __future__ import annotations

from playwright.sync_api import Route, expect

from tests.browser.dashboard import Dashboard
from tests.browser.test_runs import listed_twice
from tests.browser.test_runs import own as own_server

own = own_server


def test_two_runs_are_compared(own: Dashboard) -> None:
    page = own.page
    listed_twice(own)
    rows = page.locator("#runs tbody tr")
    expect(rows).to_have_count(2)
    rows.nth(1).get_by_role("button").click()
    expect(page.locator("#run-report")).to_be_visible()
    for row in rows.all():
        row.get_by_role("checkbox").click()
    page.get_by_role("button", name="Compare two").click()
    keys = [run["key"] for run in own.ask("/api/runs")["runs"]][::-1]
    told = own.ask(f"/api/runs/compare?a={keys[0]}&b={keys[1]}")
    assert told["parameters"] == [{"name": "tracking.hits_to_confirm", "a": 3, "b": 25}]
    expect(page.locator("#compare-figures dd").first).to_have_text(str(told["record"]["pairs"]))
    expect(page.get_by_text("tracking.hits_to_confirm")).to_be_visible()

    def unaligned(route: Route) -> None:
        route.fulfill(json={**told, "aligned": False})

    page.route("**/api/runs/compare?*", unaligned)  # as of two places
    rows.nth(1).get_by_role("button").click()
    page.get_by_role("button", name="Compare two").click()
    expect(page.locator("#run-detail [role=alert]")).to_contain_text("The two maps do not fit together")
    expect(page.locator("#run-detail h2")).to_contain_text("A: ")
    page.unroute("**/api/runs/compare?*")
    assert own.errors == []
