"""A click on a tree or a cluster explains its verdict."""

from __future__ import annotations

import re

import pytest
from playwright.sync_api import expect

from tests.browser.dashboard import Dashboard


@pytest.fixture(autouse=True)
def _standing(dashboard: Dashboard):
    dashboard.stand()
    dashboard.page.locator("#map").press("Escape")


def test_the_story_of_a_selected_tree_is_updated_while_the_run_plays(dashboard: Dashboard):
    page = dashboard.page
    dashboard.tab("Trees")
    page.locator("#trees tbody tr").nth(3).click()
    panel = page.locator("#panel-story")
    number = dashboard.page.locator("#trees tr[aria-selected=true]").get_attribute("data-tree")
    expect(panel).to_have_attribute("data-story", f"tree {number}")
    story = dashboard.ask(f"/api/story/tree/{number}")
    expect(panel.locator("[data-gathered]")).to_have_attribute("data-gathered", "tree")
    expect(panel.locator(".picture path.sector")).to_have_count(sum(story["sides"]))
    if any(story["sides"]):  # in a wide window as well
        expect(panel.locator(".picture path.sector").first).to_be_visible()
    if story["dbh"] is not None:
        expect(panel.locator(".story-fit .list")).to_contain_text(f"{100 * story['dbh']:#.3g} ±")
    assert len(story["history"]["x"]) > 5
    assert panel.locator("ellipse.sigma").count() >= 3
    expect(panel.locator(".influence > div").first).to_be_visible()
    before = int(panel.get_attribute("data-scan") or -1)
    page.get_by_role("button", name="Play", exact=True).click()
    dashboard.until("was => Number(document.querySelector('#panel-story').dataset.scan) > was + 5", before)
    expect(panel).to_have_attribute("data-story", f"tree {number}")
    page.locator("#map").press("Escape")
    expect(panel.locator(".empty")).to_contain_text("Nothing selected")


def test_the_needed_share_of_votes_leads_to_its_slider(dashboard: Dashboard):
    page = dashboard.page
    dashboard.tab("Trees")
    page.locator("#trees tbody tr").nth(3).click()
    page.locator("#panel-story").get_by_role("button", name="40 %", exact=True).click()
    expect(page.locator("#tab-tune")).to_have_attribute("aria-selected", "true")
    expect(page.locator("[id='tune-classification.tree_share']")).to_be_focused()


def test_the_story_of_a_tree_that_a_person_rejected_says_so(dashboard: Dashboard):
    page = dashboard.page
    dashboard.tab("Trees")
    page.locator("#trees tbody tr").nth(3).click()
    story = page.locator("#panel-story")
    expect(story.locator("[data-gathered]")).to_be_visible()
    expect(story.locator("[data-rejected]")).to_have_count(0)
    dashboard.tab("Annotate")
    page.locator("#annotate-kind").select_option("pole")
    dashboard.answer("n")
    expect(page.locator("#annotations tbody tr")).to_have_count(1)
    dashboard.tab("Trees")
    page.locator("#trees tbody tr").nth(3).click()
    expect(story.locator("[data-rejected=pole]")).to_contain_text("A person rejected this tree")
    dashboard.reset()
    expect(story.locator("[data-rejected]")).to_have_count(0)


def test_a_place_that_no_scan_viewed_clearly_has_no_sentence_of_views(dashboard: Dashboard):
    say = "async (counts) => (await import('/static/js/explain/columns.js')).clearViewText(...counts)"
    assert dashboard.page.evaluate(say, [0, 0]) == ""
    assert "In 0 of 1 scan with" in dashboard.page.evaluate(say, [0, 1])


def test_the_story_of_a_cluster_remains_while_the_run_plays(dashboard: Dashboard):
    page = dashboard.page
    panel = dashboard.tab("Clusters")
    scan = dashboard.ask("/api/status")["scan_index"]
    dashboard.until("scan => Number(document.querySelector('[data-scan]').dataset.scan) === scan", scan)
    row = panel.locator("#cluster-table tbody tr", has_text="tree").first
    cluster = row.get_attribute("data-cluster")
    row.click()
    story = page.locator("#panel-story")
    expect(story).to_have_attribute("data-story", f"cluster {scan} {cluster}")
    expect(story.locator("svg.picture").nth(1)).to_be_visible()  # the residuals
    page.get_by_role("button", name="Play", exact=True).click()
    dashboard.until_server("/api/status", f"it.scan_index > {scan} + 8")
    expect(story).to_have_attribute("data-story", f"cluster {scan} {cluster}")
    expect(story.locator(".story-head [aria-pressed=true]")).to_contain_text(f"scan {scan}")
    # One that comes late reads the same standing picture.
    page.reload()
    dashboard.tab("Story")
    expect(story).to_have_attribute("data-story", f"cluster {scan} {cluster}")
    tree = story.locator(".story-head button", has_text="Tree")
    tree.click()
    expect(story).to_have_attribute("data-story", (tree.text_content() or "").lower())


def test_a_cluster_is_clicked_on_the_map(dashboard: Dashboard):
    page = dashboard.page
    page.get_by_role("button", name="Fit").click()
    dashboard.drawn()
    places = page.evaluate(SQUARES)
    for _ in range(6):  # from far away trees and their numbers may cover all of them
        if places:
            break
        page.locator("#map").hover()
        page.mouse.wheel(0, -240)
        dashboard.drawn()
        places = page.evaluate(SQUARES)
    assert places, "no cluster that is no tree is drawn"
    page.locator("#map").click(position={"x": places[0][0], "y": places[0][1]})
    assert page.evaluate(COVERS_FIT) == "map-fit", "what is pointed at must not cover the map's buttons"
    panel = page.locator("#panel-story")
    expect(panel).to_be_visible()
    expect(panel.locator("table.checks .decides")).to_be_visible()
    expect(panel.locator("[data-verdict]")).not_to_have_attribute("data-verdict", "tree")
    assert dashboard.errors == []


COVERS_FIT = """() => {
  const { x, y } = document.querySelector('#map-fit').getBoundingClientRect();
  return document.elementFromPoint(x + 6, y + 6).id;
}"""

# Middles of the squares of clusters that are no trees.
SQUARES = """() => {
  const canvas = document.querySelector('#map');
  const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
  const colours = ['888888', '999933', 'f0e442', 'd55e00', 'cc79a7'];
  const hex = i => [0, 1, 2].map(k => data[i + k].toString(16).padStart(2, '0')).join('');
  const is = (x, y) => colours.indexOf(hex(4 * (y * canvas.width + x)));
  const around = [-1, 0, 1].flatMap(dx => [-1, 0, 1].map(dy => [dx, dy]));
  const places = [];
  for (let y = 45; y < canvas.height - 30; y += 1) {
    for (let x = 30; x < canvas.width - 30; x += 1) {
      const colour = is(x, y);
      if (colour >= 0 && around.every(([dx, dy]) => is(x + dx, y + dy) === colour)) {
        places.push([x / devicePixelRatio, y / devicePixelRatio]);
      }
    }
  }
  return places;
}"""


def test_an_object_without_a_cluster_says_why_and_when_the_robot_was_nearest(dashboard: Dashboard):
    page = dashboard.page
    at = page.evaluate(FAR_OBJECT)
    page.locator("#map").click(position={"x": at[0], "y": at[1]})
    panel = page.locator("#panel-story")
    expect(panel).to_have_attribute("data-story", "truth")
    expect(panel).to_contain_text("No cluster of this scan and no tree of the map is at this place")
    page.locator("#map").press("Escape")
    expect(panel.locator(".empty")).to_contain_text("Nothing selected")


def test_a_click_on_an_object_beside_a_tree_means_the_object(dashboard: Dashboard):
    """The object of the ground truth that is nearest to a tree of the map, a pixel from its middle."""
    page = dashboard.page
    x, y, gap = page.evaluate(BESIDE_A_TREE)
    assert 3 < gap < 30, "a click there is within reach of the tree"
    page.locator("#map").click(position={"x": x, "y": y})
    panel = page.locator("#panel-story")
    expect(panel).to_have_attribute("data-story", re.compile("truth|cluster"))
    page.locator("#map").press("Escape")


BESIDE_A_TREE = """async () => {
  const { state, trees } = await import('/static/js/core/store.js');
  const { screenOf } = await import('/static/js/map/map.js');
  const others = state.truth.filter(({ kind }) => kind !== 'tree');
  const all = others.flatMap(({ x, y }) => trees().map(tree => {
    const [[a, b], [c, d]] = [screenOf(x, y), screenOf(tree.x, tree.y)];
    return [a, b, Math.hypot(a - c, b - d)];
  }));
  return all.filter(([, , gap]) => gap > 3).sort((a, b) => a[2] - b[2])[0];
}"""


def test_a_typed_time_is_gone_to(dashboard: Dashboard):
    field = dashboard.page.locator("#time-now")
    field.fill("0:10")
    field.press("Enter")
    dashboard.until_server("/api/status", "Math.abs(it.time_s - 10) < 0.06")
    field.fill("ten")
    field.press("Enter")
    assert field.evaluate("node => node.validationMessage").startswith("Enter seconds")
    field.press("Escape")
    expect(field).to_have_value("0:10.0")


# Where an object of the ground truth that is no tree is drawn, far from trees and clusters.
FAR_OBJECT = """async () => {
  const { state } = await import('/static/js/core/store.js');
  const { screenOf } = await import('/static/js/map/map.js');
  const { x, y } = state.map.clusters;
  const others = [...state.map.trees, ...x.map((px, k) => ({ x: px, y: y[k] }))];
  const gap = (each) => Math.min(...others.map((other) => Math.hypot(each.x - other.x, each.y - other.y)));
  const [found] = state.truth.filter(({ kind }) => kind !== 'tree').sort((a, b) => gap(b) - gap(a));
  return screenOf(found.x, found.y);
}"""
