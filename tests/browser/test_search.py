"""A person has the parameters searched for, takes what was found, takes it back and keeps it."""

from __future__ import annotations

import re
from pathlib import Path

from playwright.sync_api import Browser, expect

from tests.browser.conftest import opened
from tests.browser.serving import Server

SHARE = "it.values['classification.tree_share']"


def test_a_better_set_is_found_used_undone_and_saved(chromium: Browser, tmp_path: Path):
    with (
        Server("sim:stand?duration=2", STEMMAP_FOLDER=str(tmp_path)) as server,
        opened(chromium, server.link) as dashboard,
    ):
        page = dashboard.page
        dashboard.pause()
        dashboard.tab("Tune")
        # With this share a few columns alone are trees.
        page.locator("#tune-find").fill("tree_share")
        share = page.locator("[id='tune-classification.tree_share']")
        share.fill("0.9")
        share.press("Enter")
        dashboard.until_server("/api/parameters", f"{SHARE} === 0.9")

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
        expect(page.locator("#search-told")).to_be_in_viewport()  # though the button stood below a long form
        expect(page.locator("#search-told")).to_contain_text("Best of 5 trials", timeout=120_000)
        expect(page.locator("#search-drawn .trial")).to_have_count(5)
        expect(page.locator("#search-changes li")).to_have_count(5)

        expect(page.locator("#search-go-on")).to_be_hidden()  # nothing is left to be tried

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
        dashboard.errors = [error for error in dashboard.errors if "422" not in error]
        assert dashboard.errors == []


def test_a_search_that_was_stopped_goes_on_with_the_trials_it_has(chromium: Browser, tmp_path: Path):
    with (
        Server("sim:stand?duration=2", STEMMAP_FOLDER=str(tmp_path)) as server,
        opened(chromium, server.link) as dashboard,
    ):
        page = dashboard.page
        told, go_on, stop = (page.locator(f"#search-{name}") for name in ("told", "go-on", "stop"))
        dashboard.pause()
        dashboard.tab("Tune")
        page.locator("#search-open").click()
        page.locator("#search-trials").fill("5000")
        page.locator("#search-start").click()
        made = 0
        for _ in range(2):  # stopped, gone on with and stopped again
            more = re.compile(rf"^(?!{made} of)\d+ of 5,?000 trials: best \S")
            expect(told).to_have_text(more, timeout=120_000)
            expect(go_on).to_be_hidden()
            stop.click()
            expect(told).to_contain_text("left.", timeout=60_000)
            tried, left = map(digits, re.findall(r"([\d,]+) trials?", told.inner_text()))
            assert tried > made, "those of before count"
            assert tried + left == 5000
            made = tried
            expect(stop).to_be_hidden()
            go_on.click()
        expect(stop).to_be_visible()
        page.locator("#search-stop").click()
        expect(go_on).to_be_visible(timeout=60_000)
        eps = page.locator("[id='tune-clustering.eps']")
        eps.fill("0.3")
        eps.press("Enter")
        dashboard.until_server("/api/parameters", "it.values['clustering.eps'] === 0.3")
        go_on.click()  # what it would find now is another search
        expect(page.locator("#tune-error")).to_contain_text("parameters were changed since the search began")
        dashboard.errors = [error for error in dashboard.errors if "409" not in error]
        assert dashboard.errors == []


def digits(number: str) -> int:
    return int(number.replace(",", ""))
