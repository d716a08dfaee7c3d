"""The dialog that chooses topics and mounting of a recording, and the panel of its camera."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from app.cli import main
from tests.browser.conftest import opened
from tests.browser.dashboard import RUN, Dashboard
from tests.browser.serving import Server


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A second of a robot with a camera."""
    path = tmp_path_factory.mktemp("camera") / "run.mcap"
    assert main(["simulate", "stand", "--duration", "1.1", "--camera", "--out", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def dashboard(chromium: Browser, run: Path, server: Server) -> Iterator[Dashboard]:
    """The recording, opened with another mounting."""
    with opened(chromium, server.link) as made:
        page = made.page
        page.locator("#source-button").click()
        page.locator("#source-uri").fill(str(run))
        page.locator("#source-inside summary").click()
        expect(page.locator("#inside-body tr", has_text="/velodyne_points")).to_contain_text("10 Hz")
        expect(page.locator("#inside-body .inside-detail", has_text="velodyne > base_link")).to_be_attached()
        expect(page.locator("#inside-body .inside-detail", has_text="used as scan")).to_be_attached()
        page.locator("#inside-body input[name=z]").fill("2")
        page.locator("#source-open").click()
        expect(page.locator("#source-dialog")).to_be_hidden()
        made.until_server("/api/status", f"it.source === {str(run)!r} && it.scan_index >= 0")
        yield made
        made.open(RUN)


def test_topics_and_mounting_are_stored_with_the_run(dashboard: Dashboard):
    dashboard.until_server("/api/runs", "it.runs.some(run => run.chosen && run.chosen.mount[2] === 2)")
    assert dashboard.errors == []


def test_the_picture_of_the_current_scan_marks_its_objects(dashboard: Dashboard):
    page = dashboard.page
    dashboard.pause()
    dashboard.command({"type": "seek", "time_s": 0.55})
    dashboard.until_server("/api/status", "it.state === 'paused' && it.scan_index === 5")
    page.locator("#camera-button").click()
    expect(page.locator("#over-camera")).to_have_attribute("data-scan", "5")
    dashboard.until("() => document.querySelector('#camera-image').naturalWidth > 100")
    marks = page.locator("#camera-marks button")
    expect(marks.first).to_be_attached()
    marks.last.dispatch_event("click")  # others may lie over its middle
    expect(marks.last).to_have_attribute("aria-pressed", "true")
    expect(page.get_by_role("tab", name="Story")).to_have_attribute("aria-selected", "true")
    page.locator("#over-camera").get_by_role("button", name="Close").click()
    expect(page.locator("#over-camera")).to_be_hidden()
    assert dashboard.errors == []
