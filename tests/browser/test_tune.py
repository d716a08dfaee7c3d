"""The tab Tune: values, sliders, reset, undo, search and parameter sets."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from tests.browser.dashboard import Dashboard


@pytest.fixture(autouse=True)
def _standing(dashboard: Dashboard):
    dashboard.stand()
    dashboard.tab("Tune")
    expect(dashboard.page.locator("#tune-set")).to_have_value("forest")


def value(page: Page, name: str):
    return page.locator(f"[id='tune-{name}']")


def test_a_value_is_typed_marked_undone_and_reset(dashboard: Dashboard):
    page = dashboard.page
    row = page.locator("[data-parameter='clustering.eps']")
    trees = page.locator("[data-chip=tree] b")
    eps = value(page, "clustering.eps")
    expect(eps).to_have_value("0.15")
    expect(row).not_to_have_class("tune-row changed")
    clusters = int(page.locator("[data-chip=tree] b").inner_text().split()[-1])
    eps.fill("5")
    eps.press("Enter")
    dashboard.until_server("/api/parameters", "it.values['clustering.eps'] === 5")
    expect(row).to_have_class("tune-row changed")
    expect(page.locator("#tune-summary")).to_contain_text("1 of ")
    expect(trees).to_contain_text(f"{clusters} → ")  # before and after the change, of the same scan
    expect(page.locator("[data-stage='Main parameters'] summary")).to_contain_text("1 changed")
    expect(page.locator("[data-figure=f1] dt")).to_contain_text("this scan")

    page.locator("#tune-undo").focus()
    page.keyboard.press("Control+z")
    dashboard.until_server("/api/parameters", "it.changed.length === 0")
    expect(eps).to_have_value("0.15")
    page.locator("#panel-tune summary").first.press("Control+Shift+z")
    dashboard.until_server("/api/parameters", "it.values['clustering.eps'] === 5")
    row.get_by_role("button", name="Reset Radius eps").click()
    dashboard.until_server("/api/parameters", "it.changed.length === 0")
    expect(row.get_by_role("button", name="Reset Radius eps")).to_be_hidden()


def test_a_refused_value_stays_with_the_reason_below_it_until_another_is_accepted(dashboard: Dashboard):
    page = dashboard.page
    lowest = value(page, "detection.e_min")
    reason = page.locator("[data-parameter='detection.e_min'] .error")
    for typed, words in (("900", "must be less than"), ("many", "is not a number"), ("-3", "greater than")):
        lowest.fill(typed)
        lowest.press("Enter")
        expect(reason).to_contain_text(words)
        expect(lowest).to_have_value(typed)
        box, below = lowest.bounding_box(), reason.bounding_box()
        assert box is not None
        assert below is not None
        assert 0 <= below["y"] - box["y"] - box["height"] < 20
    assert dashboard.ask("/api/parameters")["values"]["detection.e_min"] == 1
    dashboard.errors.clear()  # the browser logs an answer that refuses
    lowest.press("Escape")
    expect(reason).to_be_hidden()
    expect(lowest).to_have_value("1")
    lowest.fill("1.5")
    lowest.press("Enter")
    dashboard.until_server("/api/parameters", "it.values['detection.e_min'] === 1.5")
    expect(reason).to_be_hidden()


def test_parameters_are_found_by_words(dashboard: Dashboard):
    page = dashboard.page
    page.locator("#tune-find").fill("Heading distance")
    rows = page.locator(".tune-row:visible")
    expect(rows.first).to_be_visible()
    names = rows.evaluate_all("all => all.map(row => row.dataset.words)")
    assert all("heading" in words and "distance" in words for words in names)
    # Matches in a title rank before matches in the description of an earlier stage (Shape).
    page.locator("#tune-find").fill("eccentricity")
    titles = page.locator(".tune-row:visible label")
    expect(titles.first).to_have_text(re.compile("Minimum eccentricity"))
    assert titles.count() > 1
    page.locator("#tune-find").fill("no such thing at all")
    expect(page.locator("#tune-none")).to_contain_text("No parameter matches")
    page.locator("#tune-find").fill("")
    stages = page.locator("#tune-rows details")
    expect(stages.first).to_have_attribute("data-stage", "Main parameters")
    expect(stages.nth(1)).to_have_attribute("data-stage", "Acquisition")
    page.get_by_label("changed only").check()
    expect(page.locator("#tune-none")).to_contain_text("No value differs")
    page.get_by_label("changed only").uncheck()


def test_a_set_is_saved_and_shared_as_a_file(dashboard: Dashboard, tmp_path: Path):
    page = dashboard.page
    sets = page.locator("#tune-set")
    eps = value(page, "clustering.eps")
    eps.fill("0.25")
    eps.press("Enter")
    expect(sets).to_have_value("")
    page.get_by_text("Sets and files").click()
    page.locator("#tune-save").click()
    page.locator("#tune-name").fill("wet larches")
    page.locator("#tune-name").press("Enter")
    expect(sets).to_have_value("wet larches")
    with page.expect_download() as download:
        page.locator("#tune-download").click()
    file = tmp_path / "shared.toml"
    download.value.save_as(file)
    assert tomllib.loads(file.read_text())["clustering"]["eps"] == 0.25

    sets.select_option("paper")
    dashboard.until_server("/api/parameters", "it.preset === 'paper'")
    sets.select_option("wet larches")
    dashboard.until_server(
        "/api/parameters", "it.values['clustering.eps'] === 0.25 && it.preset === 'forest'"
    )
    page.locator("#tune-delete").click()
    expect(sets.locator("option", has_text="wet larches")).to_have_count(0)
    sets.select_option("forest")
    page.locator("#tune-file").set_input_files(file)
    dashboard.until_server("/api/parameters", "it.values['clustering.eps'] === 0.25")
    page.locator("#tune-reset").click()
    dashboard.until_server("/api/parameters", "it.changed.length === 0")
    assert dashboard.errors == []


IN_VIEW = """() => {
  const { bottom } = document.querySelector('#panel-tune').getBoundingClientRect();
  const top = document.querySelector('.tune-top').getBoundingClientRect().bottom;
  return [...document.querySelectorAll('#panel-tune input[type=range]')]
    .map(node => node.getBoundingClientRect())
    .filter(box => box.height > 0 && box.top >= top - 1 && box.bottom <= bottom).length;
}"""


@pytest.mark.parametrize(("width", "height", "least"), [(1440, 900, 12), (1280, 720, 8)])
def test_sliders_are_in_view_and_none_moves_while_one_is_dragged(
    dashboard: Dashboard, width: int, height: int, least: int
):
    page = dashboard.page
    before = page.viewport_size
    assert before is not None
    page.set_viewport_size({"width": width, "height": height})
    page.locator("#panel-tune").evaluate("panel => panel.scrollTo(0, 0)")
    assert page.evaluate(IN_VIEW) >= least
    for part in (".map", ".scene"):  # what the sliders change is seen beside them
        box = page.locator(part).bounding_box()
        assert box is not None
        assert box["width"] * box["height"] > 0.15 * width * height
    sliders = page.locator("#tune-rows input[type=range]:visible")

    def places() -> list[float]:
        return [float(y) for y in sliders.evaluate_all("all => all.map(s => s.getBoundingClientRect().y)")]

    at = places()
    box = page.get_by_role("slider", name="Radius eps, slider").bounding_box()
    assert box is not None
    middle = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + 0.3 * box["width"], middle)
    page.mouse.down()
    for k in range(30):  # the clusters change, and the run is re-mapped
        page.mouse.move(box["x"] + 0.3 * box["width"] + 4 * k, middle)
        page.wait_for_timeout(100)
        assert places() == pytest.approx(at, abs=1.0)
    page.mouse.up()
    dashboard.until_server("/api/status", "it.remapped === null")
    assert places() == pytest.approx(at, abs=1.0)
    # A refusal covers the row below instead of moving it.
    lowest = value(page, "detection.e_min")
    lowest.fill("900")
    lowest.press("Enter")
    expect(page.locator("[data-parameter='detection.e_min'] .error")).to_be_visible()
    assert places() == pytest.approx(at, abs=1.0)
    lowest.press("Escape")
    dashboard.errors.clear()
    page.set_viewport_size(before)


def test_a_change_that_does_not_alter_the_map_is_said(dashboard: Dashboard):
    field = value(dashboard.page, "filters.z_max")
    field.fill("19.95")
    field.press("Enter")
    expect(dashboard.page.locator("#tune-whole-status")).to_contain_text("the same as before")
