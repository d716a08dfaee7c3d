"""A change of a parameter re-maps the run: map, trees, score and the list of changes follow."""

from __future__ import annotations

import re

from playwright.sync_api import Locator, Page, expect

from tests.browser.dashboard import Dashboard

STATE = "import('/static/js/core/store.js').then(({ state }) =>"


ANEW = """() => import('/static/js/core/store.js').then(({ state, changed }) => {
  state.status = { ...state.status, remapped: 0.431 };
  changed("status");
})"""


def trees(dashboard: Dashboard) -> int:
    return len(dashboard.ask("/api/trees")["trees"])


def opened(dashboard: Dashboard) -> Locator:
    """The value of a parameter that decides what is a tree, in a stage that is folded at first."""
    dashboard.page.locator("#tune-find").fill("tree_share")
    return dashboard.page.locator("[id='tune-classification.tree_share']")


def drag(page: Page, slider: Locator, begin: float, ends: list[float]) -> None:
    """Take the thumb of a slider from one part of its range to others, and let go at the last one; the range
    is 400 pixels of a drag.
    """
    slider.scroll_into_view_if_needed()
    box = slider.bounding_box()
    assert box is not None
    thumb = 16.0  # its middle never comes to the ends

    def to(part: float, steps: int) -> None:
        x = box["x"] + thumb / 2 + begin * (box["width"] - thumb) + 400 * (part - begin)
        page.mouse.move(x, box["y"] + box["height"] / 2, steps=steps)

    to(begin, 1)
    page.mouse.down()
    for end in ends:
        to(end, 8)
        page.wait_for_timeout(2000)  # as a hand that looks: the map of this value is there meanwhile
    page.mouse.up()


def drawn(page: Page) -> str:
    """What the canvas of the map shows."""
    return str(page.evaluate("() => document.querySelector('#map').toDataURL()"))


def test_the_whole_map_and_its_score_follow_a_slider(dashboard: Dashboard):
    dashboard.stand()
    dashboard.tab("Tune")
    page = dashboard.page
    told = page.locator("#tune-whole-status")
    expect(page.locator("#tune-whole")).to_be_checked()
    known = trees(dashboard)
    assert known > 3
    score = page.locator("[data-figure=f1] dd").inner_text()
    completeness = dashboard.ask("/api/evaluation")["TA"]["count"]
    assert completeness > 0

    share = opened(dashboard)
    before = float(share.input_value())
    dashboard.drawn()
    picture = drawn(page)
    slider = page.locator("[data-parameter='classification.tree_share'] input[type=range]")
    drag(page, slider, before, [0.75, 0.95])
    expect(told).to_contain_text("Re-mapped to 0:15.0: ", timeout=60_000)
    assert 0.9 < float(share.input_value()) < 1.0
    fewer = int(re.search(r": (\d+) trees", told.inner_text()).group(1))  # type: ignore[union-attr]
    assert fewer < known
    dashboard.until_server("/api/trees", f"it.trees.length === {fewer}")
    dashboard.until_server("/api/evaluation", f"it.TA.count < {completeness}")
    assert page.evaluate(f"{STATE} state.rough.places.length)") < known  # it came before
    expect(page.locator("[data-figure=trees] dd")).to_have_text(str(fewer))
    whole = page.locator("#tune-changes-all")
    expect(whole.locator("summary")).to_contain_text("change")
    assert whole.get_attribute("open") is None  # the list would take the place of the sliders
    whole.locator("summary").click()
    assert page.locator("#scene").bounding_box()["height"] > 200  # type: ignore[index]
    rows = page.locator("#tune-changes li[data-kind=vanished]")
    assert rows.count() >= known - fewer
    expect(rows.first).to_contain_text("votes for a tree")
    assert page.evaluate(f"{STATE} state.ghost.ghost.length)") == known
    expect(page.locator("#map")).to_have_attribute("aria-label", re.compile(f"Map: {fewer} trees"))
    expect(page.locator("[data-figure=f1] dd")).not_to_have_text(score)
    assert drawn(page) != picture

    # Back again: the same trees, which now appear; a click selects one of them everywhere.
    share.fill(str(before))
    share.press("Enter")
    expect(told).to_contain_text(f"Re-mapped to 0:15.0: {known} trees", timeout=60_000)
    dashboard.until_server("/api/trees", f"it.trees.length === {known}")
    dashboard.until_server("/api/evaluation", f"it.TA.count === {completeness}")
    came = page.locator("#tune-changes li[data-kind=appeared] button").first
    whole.evaluate("node => { node.open = true; }")
    number = int(re.search(r"\d+", came.inner_text()).group())  # type: ignore[union-attr]
    came.click()
    dashboard.tab("Story")
    expect(page.locator("#panel-story")).to_contain_text(f"Tree {number}")
    # The ghost is of this tab alone; that the map is made anew is said wherever one looks.
    dashboard.tab("Trees")
    assert page.evaluate(f"{STATE} state.ghost)") is None
    page.evaluate(ANEW)
    expect(page.locator("[data-figure=trees]")).to_have_class(re.compile("remapping"))
    expect(page.locator("[data-figure=trees] dt")).to_have_text("re-mapping 43 %")
    assert dashboard.errors == []


def test_a_change_can_apply_from_the_current_scan_onwards(dashboard: Dashboard):
    dashboard.stand()
    dashboard.tab("Tune")
    page = dashboard.page
    known = trees(dashboard)
    try:
        page.locator("#tune-whole").uncheck()
        dashboard.until_server("/api/parameters", "it.whole === false")
        share = opened(dashboard)
        share.fill("0.95")
        share.press("Enter")
        dashboard.until_server("/api/parameters", "it.changed.length === 1")
        dashboard.until_server("/api/status", "it.revision > 0 && it.remapped === null")
        assert trees(dashboard) == known
        expect(page.locator("#tune-whole-status")).to_contain_text("from the current scan onwards")
    finally:
        page.locator("#tune-whole").check()
        dashboard.until_server("/api/parameters", "it.whole === true")
    # Now the whole run is mapped with what was changed before.
    dashboard.until_server("/api/trees", f"it.trees.length < {known}")
