"""The search for parameters in the tab Tune: start, result, use, undo, save, stop and resume."""

from __future__ import annotations

import re

from playwright.sync_api import expect

from tests.browser.dashboard import Dashboard

SHARE = "it.values['classification.tree_share']"


def test_a_search_finds_a_better_set_and_a_stopped_search_is_resumed(dashboard: Dashboard):
    page = dashboard.page
    dashboard.open("sim:stand?duration=2")
    dashboard.pause()
    dashboard.tab("Tune")
    # With this share few columns are trees.
    page.locator("#tune-find").fill("tree_share")
    share = page.locator("[id='tune-classification.tree_share']")
    share.fill("0.9")
    share.press("Enter")
    dashboard.until_server("/api/parameters", f"{SHARE} === 0.9")

    page.get_by_text("Search for better values").click()
    page.locator("#search-open").click()
    rows = page.locator("#search-axes li")
    expect(rows).to_have_count(8)
    for name in ("detection.e_max", "detection.arc_min", "tracking.hits_to_confirm"):
        page.locator(f"[data-axis='{name}'] button").click()
    expect(rows).to_have_count(5)
    low = page.locator("[data-axis='classification.tree_share'] input").first
    low.fill("0.9")
    page.locator("#search-trials").fill("5")
    page.locator("#search-start").click()  # its bounds contradict one another
    expect(page.locator("#tune-error")).to_contain_text("must be less than")
    low.fill("0.1")
    page.locator("#search-start").click()
    status = page.locator("#search-status")
    expect(status).to_be_in_viewport()  # although the button is below a long form
    expect(status).to_contain_text("Best of 5 trials", timeout=120_000)
    expect(page.locator("#search-drawn .trial")).to_have_count(5)
    expect(page.locator("#search-changes li")).to_have_count(5)
    resume, stop = page.locator("#search-go-on"), page.locator("#search-stop")
    expect(resume).to_be_hidden()  # every trial is done

    page.locator("#search-use").click()
    dashboard.until_server("/api/parameters", f"{SHARE} < 0.9 && it.undo")
    page.locator("#tune-undo").click()
    dashboard.until_server("/api/parameters", f"{SHARE} === 0.9")
    page.locator("#search-save").click()
    page.locator("#search-name").fill("found here")
    page.locator("#search-name").press("Enter")
    expect(page.locator("#search-name-form")).to_be_hidden()
    expect(page.locator("#tune-set option", has_text="found here")).to_have_count(1)
    text = page.evaluate("fetch('/api/sets/found here.toml').then(answer => answer.text())")
    assert "# [tuned]" in text

    page.locator("#search-again").click()
    page.locator("#search-trials").fill("5000")
    page.locator("#search-start").click()
    expect(status).to_have_text(re.compile(r"^\d+ of 5,?000 trials: best \S"), timeout=120_000)
    expect(resume).to_be_hidden()
    stop.click()
    expect(status).to_contain_text("left.", timeout=60_000)
    expect(stop).to_be_hidden()
    tried, left = (
        int(number.replace(",", "")) for number in re.findall(r"([\d,]+) trials?", status.inner_text())
    )
    assert tried + left == 5000
    resume.click()
    more = re.compile(rf"^(?!{tried} of)\d+ of 5,?000 trials: best \S")
    expect(status).to_have_text(more, timeout=120_000)
    stop.click()
    expect(resume).to_be_visible(timeout=60_000)
    dashboard.errors = [error for error in dashboard.errors if "422" not in error and "409" not in error]
    page.locator("#search-name-form").wait_for(state="hidden")
    page.evaluate(
        "fetch('/api/sets/delete', { method: 'POST', body: '{\"name\": \"found here\"}',"
        " headers: { 'Content-Type': 'application/json' } })"
    )
