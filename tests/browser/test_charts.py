"""The tab Charts: quantities over time with a common cursor."""

from __future__ import annotations

import re

import pytest
from playwright.sync_api import expect

from tests.browser.dashboard import Dashboard

DRAWN = """() => {
  const chart = document.getElementById('chart');
  if (chart.hidden || chart.dataset.kind !== 'quantities' || !chart.data) return null;
  const [line] = chart.layout.shapes;
  return { names: chart.data.map(({ name }) => name), times: chart.data[0].x, cursor: line.x0,
    line: [line.yref, line.y0, line.y1] };
}"""


@pytest.mark.usefixtures("calm")
def test_quantities_are_chosen_have_one_cursor_and_a_click_goes_there(dashboard: Dashboard):
    page = dashboard.page
    dashboard.tab("Charts")
    page.locator("#chart-choice").select_option("quantities")
    start = dashboard.ask("/api/status")["scan_index"]
    for _ in range(5):
        page.locator("#on1").click()
    dashboard.until_server("/api/status", f"it.scan_index === {start} + 5")
    page.locator("#chart-add").select_option("innovation")
    names = ["trees", "sigma of the position", "normalised innovation"]
    dashboard.until(f"names => ({DRAWN})()?.names.join() === names.join()", names)
    page.get_by_role("button", name="Remove trees").click()
    dashboard.until(f"() => ({DRAWN})()?.names.length === 2")

    last = dashboard.ask("/api/status")["time_s"]
    page.locator("#back1").click()
    dashboard.until_server("/api/status", f"it.time_s < {last} - 0.05")
    dashboard.until(
        f"last => ({DRAWN})()?.times.at(-1) > last - 0.05 && ({DRAWN})().cursor < last - 0.05", last
    )
    drawn = page.evaluate(DRAWN)
    assert drawn["line"] == ["paper", 0, 1], "one line over all curves"
    assert drawn["times"] == sorted(drawn["times"]), "a step back adds no second branch"

    chart = page.locator("#chart")
    first = drawn["times"][0]
    chart.evaluate(
        "(node, time) => node.emit('plotly_click', { points: [{ x: time, data: { type: 'scatter' } }] })",
        first,
    )
    dashboard.until_server("/api/status", f"Math.abs(it.time_s - {first}) < 0.06")

    page.reload()
    dashboard.tab("Charts")
    expect(page.locator("#chart-choice")).to_have_value("quantities")
    expect(page.get_by_role("button", name="Remove normalised innovation")).to_be_visible()
    dashboard.until(f"times => ({DRAWN})()?.times.join() === times.join()", drawn["times"])  # no gap
    mapped = dashboard.ask("/api/course?names=x")
    assert len(mapped["scans"]) > 5
    assert mapped["scans"] == list(range(len(mapped["scans"]))), "from the first scan on"
    dashboard.until(
        "() => import('/static/js/core/store.js').then(({ state }) =>"
        " { window.rowsWithOdometry = state.path.every((row) => Number.isFinite(row[2])); })"
        " && window.rowsWithOdometry"
    )
    page.evaluate("() => localStorage.setItem('stemmap.quantities', 'trees,of an earlier version')")
    page.reload()
    dashboard.tab("Charts")
    dashboard.until(f"() => ({DRAWN})()?.names.join() === 'trees'")
    page.locator("#chart-choice").select_option("distance")


def test_a_curve_is_not_drawn_over_a_silence(dashboard: Dashboard):
    page = dashboard.page
    times = [0.0, 0.1, 0.2, 0.3, 4.0, 4.1, 4.2]
    course = {
        "scans": list(range(7)), "time_s": times, "values": {"trees": [1, 1, 2, 2, 3, 3, 3]}, "stages": {},
        "quantities": {"trees": {"title": "trees", "unit": ""}},
    }  # fmt: skip
    page.route("**/api/course*", lambda route: route.fulfill(json=course))
    page.evaluate("() => localStorage.setItem('stemmap.quantities', 'trees')")
    page.reload()
    dashboard.tab("Charts")
    page.locator("#chart-choice").select_option("quantities")
    dashboard.until(f"() => ({DRAWN})()?.times.length === 8")
    curve = page.evaluate("() => document.getElementById('chart').data[0]")
    assert curve["x"] == [*times[:4], 0.3, *times[4:]]
    assert curve["y"] == [1, 1, 2, 2, None, 3, 3, 3]
    assert curve["mode"] == "lines"
    page.unroute("**/api/course*")
    page.locator("#chart-choice").select_option("distance")


# Events as of a live run, whose clock is known.
LOGGED = """async (live) => {
  const { state, changed } = await import('/static/js/core/store.js');
  const { receive } = await import('/static/js/core/live_feed.js');
  receive('status', () => {}); // the one below stays
  state.events = [
    { t: 2, kind: 'tree', text: 'Tree 1 mapped' },
    { t: 65, kind: 'stop', text: 'Obstacle, 0.8 m ahead', for_s: 3.25, noted_s: 1795997106 },
    { t: 68.25, kind: 'stop', text: 'No obstacle in the stop zone' },
    { t: 70, kind: 'silence', text: 'gone', for_s: null },
  ];
  state.eventsStart = 1764460800;
  state.status = { ...state.status, live };
  changed('status');
  changed('events');
}"""


# What of the log is wider than its panel, and headings that touch one another.
CRAMPED = """() => {
  const log = document.getElementById('log'), wide = [...log.querySelectorAll('*')]
    .filter((node) => node.getBoundingClientRect().right > log.getBoundingClientRect().right);
  const boxes = [...log.querySelectorAll('th')].map((node) => {
    const range = document.createRange();
    range.selectNodeContents(node);
    return [node, range.getBoundingClientRect()];
  });
  const touch = boxes.filter(([node, a]) => boxes.some(([other, b]) => other !== node
    && a.left < b.right + 4 && b.left < a.right + 4 && a.top < b.bottom && b.top < a.bottom));
  return [...wide, ...touch.map(([node]) => node)].map((node) => node.outerHTML.slice(0, 80));
}"""


def test_the_log_lists_stops_and_silences_with_their_times(dashboard: Dashboard):
    page = dashboard.page
    dashboard.pause()
    dashboard.tab("Charts")
    page.locator("#chart-choice").select_option("log")
    rows, titles = page.locator("#log tbody tr"), page.locator("#log th")
    page.evaluate(LOGGED, False)
    expect(titles).to_have_text(["run", "robot's clock", "lasted", "what"])
    page.evaluate(LOGGED, True)
    expect(titles).to_have_text(["run", "computer's clock", "robot's clock", "lasted", "what"])
    expect(rows).to_have_count(2)
    expect(rows.first).to_contain_text("lasts")  # the newest first
    expect(rows.last.locator("td").first).to_have_text("1:05.0")
    expect(rows.last).to_contain_text("3.25 s")
    for width, height in ((390, 844), (1024, 700), (1260, 720)):
        page.set_viewport_size({"width": width, "height": height})
        dashboard.drawn()
        assert page.evaluate(CRAMPED) == [], width
    page.locator("#log-kind").select_option("tree")
    expect(rows).to_have_count(1)
    page.locator("#log-kind").select_option("lasting")
    with page.expect_download() as saved:
        page.locator("#chart-csv").click()
    assert saved.value.path().read_text().splitlines() == [
        "time_s,computer_clock,robot_clock,kind,duration_s,what",
        '65,2026-11-30T00:05:06.000Z,2025-11-30T00:01:05.000Z,stop,3.25,"Obstacle, 0.8 m ahead"',
        "70,,2025-11-30T00:01:10.000Z,silence,,gone",
    ]
    assert re.fullmatch(r"sim_stand_log_2025-11-(29|30)\.csv", saved.value.suggested_filename)
    page.locator("#chart-choice").select_option("time")
    expect(page.locator("#log")).to_be_hidden()
    page.reload()
