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
