"""The sensitivity of the score to a parameter, in the tab Tune."""

from __future__ import annotations

import re

from playwright.sync_api import expect

from tests.browser.dashboard import Dashboard
from tests.browser.test_whole_run import opened

POINTS = """() => import('/static/js/core/store.js').then(({ state, changed }) => {
  const point = (value, f1) => ({
    value, f1, TA: 10 * f1, TA_of: 10, false: 1, position_rmse_m: 0.02, mean_pair_error_percent: null });
  const points = [point(0.4, 0.8), point(0, 0.5), point(1, 0), { value: 0.9, error: "it cannot be" }];
  state.sensitivity = { name: "classification.tree_share", of: 4, error: "", asked_with: {}, points };
  changed("sensitivity");
})"""


def test_the_sensitivity_is_drawn_and_a_click_sets_the_value(dashboard: Dashboard):
    dashboard.stand()
    dashboard.tab("Tune")
    page = dashboard.page
    share = opened(dashboard)
    row = page.locator("[data-parameter='classification.tree_share']")
    row.hover()
    row.locator(".matter").click()
    section = page.locator(".sensitivity")
    expect(section).to_contain_text(re.compile("of 1[0-9]|to set the value"))
    # The run is scored in the background, at its leisure: points that were computed are put in here.
    page.evaluate("() => fetch('/api/sensitivity', { method: 'DELETE' })")
    expect(section).to_have_count(0)
    page.evaluate(POINTS)
    expect(section.locator("circle")).to_have_count(3)
    picture = section.locator("svg")
    expect(picture).to_have_attribute("aria-label", re.compile("F1, % from 0 to 80 over"))
    expect(section).to_contain_text("0.9: it cannot be")
    section.locator("select").select_option("position error, cm")
    expect(picture).to_have_attribute("aria-label", re.compile("position error, cm from 2 to 2"))
    expect(section).to_contain_text("does not depend on this parameter")
    box = picture.bounding_box()
    assert box is not None
    picture.click(position={"x": 0.9 * box["width"], "y": 0.5 * box["height"]})
    dashboard.until_server("/api/parameters", "it.values['classification.tree_share'] > 0.8")
    expect(share).not_to_have_value("0.4")
    assert dashboard.errors == []
