"""The overlays of the scene: the four stages of a scan, and the comparison of two parameter sets."""

from __future__ import annotations

import re

import pytest
from playwright.sync_api import Locator, expect

from tests.browser.dashboard import Dashboard


@pytest.fixture(autouse=True)
def _standing(dashboard: Dashboard):
    dashboard.stand()


def coloured(canvas: Locator) -> int:
    """How many pixels of a canvas are painted."""
    count = """node => {
      const { data } = node.getContext('2d').getImageData(0, 0, node.width, node.height);
      let n = 0;
      for (let i = 3; i < data.length; i += 4) n += data[i] > 0;
      return n;
    }"""
    return int(canvas.evaluate(count))


def test_the_four_stages_of_a_scan_are_drawn_side_by_side(dashboard: Dashboard):
    page = dashboard.page
    scan = dashboard.ask("/api/status")["scan_index"]
    page.locator("#map").press("s")
    over = page.locator("#over-stages")
    expect(over).to_have_attribute("data-scan", str(scan))
    raw, filtered, clusters, trunks = (
        over.locator(f"[data-stage={name}] b") for name in ("raw", "filtered", "clusters", "trunks")
    )
    returns, kept = dashboard.points()
    expect(raw).to_have_text(f"{returns:,} points")
    expect(filtered).to_have_text(f"{kept:,} points")
    expect(trunks).to_have_text(re.compile(r"\d+ of " + (clusters.inner_text().split()[0])))
    canvases = over.locator("canvas")
    painted = [coloured(canvases.nth(k)) for k in range(4)]
    assert min(painted) > 50
    assert painted[0] > painted[2] > painted[3] * 0.5
    before = canvases.first.evaluate("node => node.toDataURL()")
    canvases.nth(2).press("ArrowRight")  # all four turn together
    dashboard.until("was => document.querySelector('#stages-grid canvas').toDataURL() !== was", before)
    page.keyboard.press("Escape")
    expect(over).to_be_hidden()
    expect(page.locator("#stages-button")).to_be_focused()


def test_two_sets_are_compared_on_the_same_scan(dashboard: Dashboard):
    page = dashboard.page
    status = dashboard.ask("/api/status")
    page.get_by_role("button", name="A | B", exact=True).last.click()
    over = page.locator("#over-compare")
    expect(over.locator("[data-set=a]")).to_have_value("forest")
    expect(page.locator("#compare-tables .empty")).to_contain_text("The two sets are equal")
    over.locator("[data-set=b]").select_option("paper")
    row = page.locator("#compare-differences [data-row='clustering.eps'] td")
    expect(row.nth(0)).to_have_text("0.15 m")
    expect(row.nth(1)).to_have_text("0.25 m")
    trees = page.locator("#compare-verdicts [data-row=tree] td")
    chip = dashboard.tab("Tune").locator("[data-chip=tree] b").inner_text()
    expect(trees.nth(0)).to_have_text(chip.split()[-1])
    expect(page.locator("#compare-shared")).to_contain_text("Trees found by both")
    assert coloured(over.locator("canvas").nth(0)) > 50
    over.get_by_role("button", name="Swap").click()
    expect(row.nth(0)).to_have_text("0.25 m")
    expect(trees.nth(1)).to_have_text(chip.split()[-1])
    # Nothing of it touches the run.
    after = dashboard.ask("/api/status")
    assert (after["scan_index"], after["trees"], after["state"]) == (
        status["scan_index"],
        status["trees"],
        "paused",
    )
    assert dashboard.ask("/api/parameters")["changed"] == []
    over.locator("[data-set=a] + button").click()
    dashboard.until_server("/api/parameters", "it.preset === 'paper'")
    page.locator("#tune-set").select_option("forest")
    dashboard.until_server("/api/parameters", "it.preset === 'forest'")
    over.get_by_role("button", name="Close").click()
    expect(over).to_be_hidden()
    assert dashboard.errors == []
