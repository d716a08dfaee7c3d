"""The open run is located in a stored map."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from playwright.sync_api import expect

from tests.app.batch.finished_runs import write_run
from tests.browser.dashboard import COMPILING_S, Dashboard
from tests.browser.test_runs import map_again
from tests.browser.test_runs import own as own_server

own = own_server


TITLE = "async (uri) => (await import('/static/js/open/run_title.js')).titleOf(uri)"


def test_a_run_is_located_in_the_map_of_another(own: Dashboard, tmp_path: Path) -> None:
    page = own.page
    assert page.evaluate(TITLE, "sim:stand?duration=4&drive=1") == "sim:stand, drive 1"
    assert page.evaluate(TITLE, "sim:stand?duration=4") == "sim:stand"
    own.until_server("/api/status", "it.state === 'finished'")
    map_again(own, {"tracking.hits_to_confirm": 4})
    own.until_server("/api/status", "it.state === 'finished' && it.revision > 0")
    own.until_server("/api/runs", "it.runs.length === 2 && it.runs.every(run => run.scans === 40)")

    def ask() -> None:
        page.keyboard.press("Control+k")
        page.keyboard.type("Locate in")
        page.keyboard.press("Enter")

    ask()
    listed = page.get_by_label("Run with the map")
    expect(listed.locator("option")).to_have_text(re.compile(r"^sim:stand\?duration=4, \d+ trees, \d{4}-"))
    listed.select_option(index=0)
    locate = page.get_by_role("button", name="Locate", exact=True)
    locate.click()
    status = page.locator("#localise-status")
    expect(status).to_contain_text(
        re.compile(r"found: \d+ of \d+ stems in view agree, 0\.\d\d m"), timeout=1000 * COMPILING_S
    )
    expect(page.locator("#legend-stored")).to_be_visible()
    status.get_by_role("button", name="Stop").click()
    expect(status).to_be_hidden()
    stored = Path(write_run(tmp_path / "elsewhere", np.array([[500.0, 0.0], [510.0, 0.0]]), np.full(2, 0.3)))
    ask()
    path = page.get_by_label("Or a path on the server")
    path.fill(str(tmp_path / "none"))
    expect(listed).to_be_disabled()
    locate.click()
    expect(page.get_by_role("alert").filter(has_text="There is no such folder or file")).to_be_visible()
    own.errors.clear()  # the browser logs an answer that refuses
    path.fill(str(stored))
    page.keyboard.press("Enter")
    expect(status).to_have_text(re.compile(r"In the map of elsewhere: not found in \d+ m of driving; play"))
    assert own.errors == []
