"""The page of all runs: details, rename, delete, undo and replay."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Route, expect

from tests.browser.conftest import opened
from tests.browser.dashboard import Dashboard
from tests.browser.serving import Server


@pytest.fixture
def own(chromium: Browser, tmp_path: Path) -> Iterator[Dashboard]:
    """A server with a folder of its own, in which one short run was mapped to its end."""
    server = Server("sim:stand?duration=4", STEMMAP_FOLDER=str(tmp_path))
    with server, opened(chromium, server.link) as dashboard:
        yield dashboard


def map_again(dashboard: Dashboard, changes: dict[str, object]) -> None:
    """Map the same run once more to its end, with other parameters."""
    dashboard.page.evaluate(
        "() => fetch('/api/open', { method: 'POST', body: JSON.stringify({ uri: 'sim:stand?duration=4' }),"
        " headers: { 'Content-Type': 'application/json' } })"
    )
    # Not before: the run that stands would be mapped with them too, and its record would say so.
    dashboard.page.evaluate(
        "body => fetch('/api/parameters', { method: 'PATCH', body: JSON.stringify(body),"
        " headers: { 'Content-Type': 'application/json' } })",
        {"changes": changes},
    )


def listed_twice(dashboard: Dashboard) -> None:
    """Map the run twice, the second time with another parameter, and open the page of runs."""
    dashboard.until_server("/api/status", "it.state === 'finished'")
    dashboard.until_server("/api/runs", "it.runs.length === 1 && it.runs[0].scans === 40")
    map_again(dashboard, {"tracking.hits_to_confirm": 25})
    dashboard.until_server("/api/status", "it.state === 'finished' && it.revision > 0")
    dashboard.until_server("/api/runs", "it.runs.length === 2 && it.runs.every(run => run.scans === 40)")
    dashboard.page.get_by_role("link", name="Runs").click()


def test_runs_are_stored_renamed_deleted_and_replayed(own: Dashboard, tmp_path: Path):
    page = own.page
    listed_twice(own)
    rows = page.locator("#runs tbody tr")
    expect(rows).to_have_count(2)
    older = own.ask("/api/runs")["runs"][1]
    rows.nth(1).get_by_role("button").click()
    expect(page.locator("[data-figure=trees] dd")).to_have_text(str(older["trees"]))
    expect(page.locator("[data-figure='pose lost'] dd")).to_have_text("0 %")
    expect(page.locator(".run-map canvas")).to_be_visible()

    rows.nth(1).get_by_role("button").click()
    page.get_by_role("button", name="Rename").click()
    page.get_by_label("Name of the run").fill("<b>north</b> stand")
    page.get_by_role("button", name="Save").click()
    expect(page.get_by_role("heading", name="<b>north</b> stand")).to_be_visible()
    page.get_by_role("button", name="Delete").click()
    expect(rows).to_have_count(1)
    page.get_by_role("button", name="Undo").click()
    expect(rows).to_have_count(2)
    expect(page.get_by_role("heading", name="<b>north</b> stand")).to_be_visible()

    assert own.errors == []
    folder = tmp_path / "recordings" / "north+south & 50%#1"
    folder.mkdir(parents=True)
    for name in ("run.json", "trees.csv"):
        (folder / name).write_text("")
    page.reload()
    page.get_by_role("button", name=folder.name).click()
    expect(page.locator("#run-detail .empty")).to_contain_text("run.json is damaged")

    def as_live(route: Route) -> None:
        run = route.fetch().json()
        run["map"]["recordings"] = ["/data/north.mcap", "/data/south.mcap"]
        stop = {"t": 3.0, "kind": "stop", "text": "Obstacle in the stop zone", "for_s": 2.5, "noted_s": 1.7e9}
        tree = {"t": 4.0, "kind": "tree", "text": "Tree 1 mapped"}
        run["map"]["logs"] = [{"events": [stop, tree], "start_s": 0.0}]
        route.fulfill(json={**run, "live": True})

    page.route("**/api/runs/*", as_live)
    rows.nth(1).get_by_role("button").click()
    expect(page.get_by_role("button", name="Rename")).to_be_visible()
    expect(page.get_by_role("button", name="Replay")).to_be_hidden()  # nothing can be replayed
    expect(page.locator("#run-recordings")).to_have_text("Recorded tonorth.mcapsouth.mcap")
    south = page.get_by_role("button", name="south.mcap")
    expect(south).to_have_attribute("title", re.compile("^/data/south.mcap\n"))
    expect(page.locator("#run-log tbody tr")).to_have_count(1)
    expect(page.locator("#run-log tbody tr")).to_contain_text("2.50 sObstacle in the stop zone")
    page.unroute("**/api/runs/*")
    rows.nth(1).get_by_role("button").click()
    page.get_by_role("button", name="Replay").click()
    expect(page.locator("#source-name")).to_have_text("sim:stand")
    own.until_server("/api/status", "it.source === 'sim:stand?duration=4'")
    own.until_server("/api/parameters", "it.values['tracking.hits_to_confirm'] === 3")
    own.until_server("/api/runs", "it.runs.length === 3")
