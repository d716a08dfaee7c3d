"""Views of the scene that are saved by name."""

from __future__ import annotations

import pytest
from playwright.sync_api import expect

from tests.browser.dashboard import Dashboard

# Position of the camera in the frame of the map, to a centimetre.
CAMERA = """() => {
  const { camera, nodeRefFromName: nodes } = window.__viserMutable;
  const at = camera.position.clone().applyMatrix4(nodes['/world'].matrixWorld.clone().invert());
  return at.toArray().map(value => Math.round(10 * value) / 10);
}"""


@pytest.mark.usefixtures("calm")
def test_a_saved_view_returns_to_the_same_place_of_the_map(dashboard: Dashboard):
    page = dashboard.page
    dashboard.load_scene()
    scene = dashboard.scene
    page.locator("#views-button").click()
    dashboard.settled_places("/world/trees")
    before = scene.evaluate(CAMERA)
    page.get_by_label("Name of the view").fill("<b>gate</b>")
    page.locator("#view-save").click()
    dashboard.command({"type": "advance", "scans": 40})  # the scene follows the robot
    page.locator("#look-top").click()
    dashboard.until_shown()
    dashboard.settled_places("/world/trees")
    assert scene.evaluate(CAMERA) != before
    page.locator("#views-button").click()  # the press on Top has closed the list
    page.get_by_role("button", name="<b>gate</b>", exact=True).click()
    dashboard.eventually(lambda: scene.evaluate(CAMERA) == before, lambda: scene.evaluate(CAMERA))

    page.get_by_role("button", name="Delete the view <b>gate</b>").click()
    expect(page.locator("#view-list")).to_contain_text("Save this view of the scene")
    page.locator("#view-name").press("Escape")
    expect(page.locator("#view-list")).to_be_hidden()


@pytest.mark.usefixtures("calm")
def test_the_whole_map_is_shown_and_home_returns_to_the_first_view(dashboard: Dashboard):
    page = dashboard.page
    dashboard.load_scene()
    scene = dashboard.scene
    page.locator("#look-home").click()
    dashboard.settled_places("/world/trees")
    first = scene.evaluate(CAMERA)
    page.locator("#look-fit").click()
    dashboard.eventually(lambda: scene.evaluate(CAMERA)[2] > first[2] + 5.0, lambda: scene.evaluate(CAMERA))
    page.locator("#look-home").click()
    dashboard.eventually(lambda: scene.evaluate(CAMERA) == first, lambda: scene.evaluate(CAMERA))
    dashboard.page.evaluate(CHOOSE, ["colour_by", "eccentricity"])
    expect(page.locator("#colour-bar")).to_contain_text("Eccentricity e of a cluster")
    dashboard.page.evaluate(CHOOSE, ["colour_by", "intensity"])
    expect(page.locator("#colour-bar")).to_contain_text("Intensity of the raw points")
    dashboard.page.evaluate(CHOOSE, ["colour_by", "verdict"])
    expect(page.locator("#colour-bar")).to_be_hidden()


CHOOSE = """([name, value]) => fetch('/api/view', { method: 'PATCH', body: JSON.stringify({ name, value }),
  headers: { 'Content-Type': 'application/json' } })"""


# Pixels per metre of the map.
SCALE = """async () => {
  const { screenOf } = await import('/static/js/map/map.js');
  return screenOf(1, 0)[0] - screenOf(0, 0)[0];
}"""
OTHER_SOURCE = """async (source) => {
  const { state, changed } = await import('/static/js/core/store.js');
  const before = state.status.source;
  state.status = { ...state.status, source: source ?? before };
  changed('status');
  return before;
}"""


def test_the_part_of_the_map_that_a_person_chose_is_left_with_the_run(dashboard: Dashboard):
    page = dashboard.page
    page.locator("#map-fit").click()
    whole = page.evaluate(SCALE)
    page.locator("#map").hover()
    page.mouse.wheel(0, -600)
    dashboard.until(f"async () => await ({SCALE})() > {1.5 * whole}")
    source = page.evaluate(OTHER_SOURCE, "sim:other")
    assert page.evaluate(SCALE) == pytest.approx(whole)
    page.evaluate(OTHER_SOURCE, source)
