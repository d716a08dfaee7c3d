"""Each layer of the scene has its switch, and says how much it shows."""

from __future__ import annotations

from playwright.sync_api import expect

from tests.browser.dashboard import Dashboard

SEEN = """name => {
  const node = window.__viserSceneTree?.getState()[name];
  return Boolean(node) && node.visibility !== false;
}"""


def test_what_was_gathered_and_where_the_map_errs_are_layers(dashboard: Dashboard):
    page = dashboard.page
    dashboard.stand()
    page.get_by_role("button", name="Layers").click()
    rows = page.locator("#layer-list label:has(input)")
    titles = rows.locator("span:not(.count)").all_inner_texts()
    assert {
        "Raw scan",
        "Filtered",
        "Voxels",
        "Clusters",
        "Fitted circles",
        "Ground",
        "Accumulated map",
    } <= set(titles)
    assert {"Particles", "Path", "Trees", "Ground truth", "Errors (10 times as long)"} <= set(titles)
    for layer, node in (("gathered", "/world/gathered/0"), ("voxels", "/world/robot/scan/voxels")):
        page.locator(f"[data-layer={layer}]").check()
        dashboard.scene.wait_for_function(SEEN, arg=node)
        expect(page.locator(f"label:has([data-layer={layer}]) .count")).not_to_have_text("0")
    page.locator("[data-layer=errors]").check()
    dashboard.scene.wait_for_function(SEEN, arg="/world/errors")
    for layer in ("gathered", "voxels", "errors"):
        page.locator(f"[data-layer={layer}]").uncheck()
    dashboard.scene.wait_for_function(f"name => !({SEEN})(name)", arg="/world/errors")
    assert dashboard.errors == []
