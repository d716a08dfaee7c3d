"""Marks of events, a loop of a part of the run, and a distance on the map."""

from __future__ import annotations

import re
import time

import pytest
from playwright.sync_api import expect

from tests.browser.dashboard import Dashboard


def test_a_mark_seeks_to_its_event_and_a_loop_is_repeated(dashboard: Dashboard):
    page = dashboard.page
    dashboard.stand(12.05)
    confirmed = page.locator("#marks .mark.tree")
    expect(confirmed.first).to_be_attached()
    expect(confirmed.first).to_have_attribute("title", re.compile(r"Tree \d+ mapped"))
    page.evaluate(CHANGE)
    change = page.locator("#marks .mark.change[title*='clustering.eps'][title*='→ 0.2']").last
    expect(change).to_be_visible()
    page.get_by_role("button", name="Ten scans forward").click()
    dashboard.until_server("/api/status", "it.time_s > 12.9")
    change.press("Enter")  # a mark of another change may cover it for the mouse
    dashboard.until_server("/api/status", "it.state === 'paused' && it.time_s > 11.9 && it.time_s < 12.1")

    loop = page.locator("#loop")
    loop.click()
    expect(loop).to_contain_text("Loop from 0:12.0")
    page.get_by_role("button", name="Ten scans forward").click()
    dashboard.until_server("/api/status", "it.time_s > 12.9")
    loop.click()
    expect(loop).to_have_text("Loop 0:12.0 to 0:13.0 ✕")
    expect(page.locator("#loop-bar")).to_be_visible()
    page.get_by_role("button", name="Play", exact=True).click()
    page.evaluate("window.latest = 0")
    dashboard.until(GOES_ROUND)
    assert dashboard.ask("/api/status")["time_s"] < 14.5
    page.locator("#map").press("l")
    expect(loop).to_have_text("Loop")
    dashboard.until_server("/api/status", "it.time_s > 13.6")
    dashboard.pause()


CHANGE = """() => fetch('/api/parameters', { method: 'PATCH', body: '{"changes": {"clustering.eps": 0.2}}',
  headers: { 'Content-Type': 'application/json' } })"""

RESET = """() => fetch('/api/parameters/reset', { method: 'POST', body: '{}',
  headers: { 'Content-Type': 'application/json' } })"""

GOES_ROUND = """() => {
  const now = Number(document.querySelector('#timeline').value);
  window.latest = Math.max(window.latest, now);
  return window.latest > 12.7 && now < window.latest - 0.4;
}"""


def test_a_distance_is_measured_between_two_trees(dashboard: Dashboard):
    page = dashboard.page
    dashboard.pause()
    page.get_by_role("button", name="Fit").click()
    page.locator("#map").press("m")
    expect(page.locator("#map-measure")).to_have_attribute("aria-pressed", "true")
    box = page.locator("#map").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 0.5 * box["height"])
    expect(page.locator("#map-tip")).to_have_text("Click where the distance begins")
    page.mouse.click(box["x"] + 0.3 * box["width"], box["y"] + 0.5 * box["height"])
    page.mouse.move(box["x"] + 0.7 * box["width"], box["y"] + 0.6 * box["height"])
    page.mouse.click(box["x"] + 0.7 * box["width"], box["y"] + 0.6 * box["height"])
    told = re.compile(r"Measured: (\d+\.\d\d) m")
    expect(page.locator("#map")).to_have_attribute("aria-label", told)
    found = told.search(page.locator("#map").get_attribute("aria-label") or "")
    assert found is not None
    assert float(found.group(1)) > 1.0
    expect(page.locator("#panel-story")).not_to_be_visible()  # measuring selects nothing
    page.locator("#map").press("Escape")
    expect(page.locator("#map-measure")).to_have_attribute("aria-pressed", "false")
    page.evaluate(RESET)
    assert dashboard.errors == []


# The strip, the notice, the timeline's thumb and its time under another status, which is then taken back.
UNDER = """async changes => {
  const { state, changed } = await import('/static/js/core/store.js');
  const text = selector => document.querySelector(selector).textContent;
  const before = state.status;
  const tell = async () => {
    for (const _ of [1, 2]) { // the first one asks for the server's clock
      state.status = { ...before, ...changes };
      changed('status');
      await new Promise(done => setTimeout(done, 400));
    }
    const line = document.querySelector('#seeking');
    const progress = [line.ariaLabel, line.ariaValueNow, line.firstChild.style.width];
    const seeking = line.hidden ? '' : progress.join(' ');
    return [text('#state b'), text('#notice p'), Number(document.querySelector('#timeline').value), seeking];
  };
  const told = await tell();
  state.status = before;
  changed('status');
  return told;
}"""


def test_a_seek_shows_its_target_and_compiling_counts_from_its_start(dashboard: Dashboard):
    page = dashboard.page
    dashboard.stand()
    going = {
        "going_to": "0:40",
        "going_to_s": 40.0,
        "going_far": True,
        "time_s": 12.0,
        "detail": "Going to 0:40 …",
    }
    word, notice, thumb, seeking = page.evaluate(UNDER, going)
    assert (word, notice) == ("Seeking", "")  # nothing covers the buttons of the map
    assert seeking == "Mapping up to 0:40 30 30%"
    assert thumb == pytest.approx(40.0, abs=0.05)  # to a step of the line
    compiling = {
        "state": "waiting",
        "detail": "Compiling",
        "compiling_since_s": time.time() - 100.0,
        "compiled": 0.437,
        "kernels_left": 135,
    }
    word, notice, _, seeking = page.evaluate(UNDER, compiling)
    assert (word, seeking) == ("Waiting", "")
    passed = re.search(r"Compiling\. 43 % done after (\d+) s, 135 kernels left, about 2 min\.", notice)
    assert passed is not None, notice
    assert int(passed[1]) >= 98, "from its start, not from the opening of the page"
    expect(page.locator("#state b")).to_have_text("Paused")


WARN = """async (live) => {
  const { state, changed } = await import("/static/js/core/store.js");
  const warnings = [1, 2, 3].map((n) => `Scan ${n} has ${10 * n} points only`).concat("The clock went back");
  state.status = { ...state.status, warnings };
  state.events = [...state.events, { t: 12.0, kind: "warning", text: "Scan 3 has 30 points only" }];
  state.status.live = live;
  changed("status");
  return document.querySelector("#warnings li").innerText;
}"""


def test_equal_warnings_are_one_line_that_leads_to_the_last(dashboard: Dashboard):
    page = dashboard.page
    lines = page.locator("#warnings li")
    assert (
        page.evaluate(WARN, True) == "Scan 3 has 30 points only (3 times) at 0:12.0"
    )  # no seek in a live run
    page.evaluate(WARN, False)
    page.locator("#warnings-button").click()
    expect(lines).to_have_count(2)
    expect(lines.first).to_contain_text("Scan 3 has 30 points only (3 times)")
    lines.first.get_by_role("button", name="0:12.0").click()
    dashboard.until_server("/api/status", "Math.abs(it.time_s - 12) < 0.06")
