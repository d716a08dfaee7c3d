"""The open run is located in the map of a stored run."""

from __future__ import annotations

import re

from playwright.sync_api import expect

from tests.browser.dashboard import COMPILING_S, Dashboard
from tests.browser.test_runs import map_again
from tests.browser.test_runs import own as own_server

own = own_server


def test_a_run_is_located_in_the_map_of_another(own: Dashboard) -> None:
    page = own.page
    own.until_server("/api/status", "it.state === 'finished'")
    map_again(own, {"tracking.hits_to_confirm": 4})
    own.until_server("/api/status", "it.state === 'finished' && it.revision > 0")
    own.until_server("/api/runs", "it.runs.length === 2 && it.runs.every(run => run.scans === 40)")
    page.keyboard.press("Control+k")
    page.keyboard.type("Locate in")
    page.keyboard.press("Enter")
    page.get_by_label("Run with the map").select_option(index=0)
    page.get_by_role("button", name="Locate", exact=True).click()
    status = page.locator("#localise-status")
    expect(status).to_contain_text(
        re.compile(r"found: \d+ of \d+ stems agree, 0\.\d\d m"), timeout=1000 * COMPILING_S
    )
    expect(page.locator("#legend-stored")).to_be_visible()
    status.get_by_role("button", name="Stop").click()
    expect(status).to_be_hidden()
    assert own.errors == []
