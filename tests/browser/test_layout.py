"""Map, scene and tabs have sizes and places that a person chooses, and that are there again."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Locator, expect

from tests.browser.conftest import opened
from tests.browser.dashboard import Dashboard
from tests.browser.serving import Server

WIDTH, HEIGHT = 1600, 900


@pytest.fixture
def wide(chromium: Browser, server: Server) -> Iterator[Dashboard]:
    with opened(chromium, server.link, WIDTH, HEIGHT) as dashboard:
        dashboard.pause()  # while a run is opened, a notice takes a line of the window
        expect(dashboard.page.locator("#notice")).to_be_hidden()
        yield dashboard
        assert dashboard.errors == []


def box(part: Locator) -> dict[str, float]:
    found = part.bounding_box()
    assert found is not None
    return {name: float(value) for name, value in found.items()}  # type: ignore[arg-type]


def test_the_scene_has_half_of_the_window_and_is_exchanged_with_the_map(wide: Dashboard):
    page = wide.page
    plan, scene = page.locator("#map"), page.locator("section.scene")
    for width, height in ((WIDTH, HEIGHT), (1440, 900), (1280, 720)):
        page.set_viewport_size({"width": width, "height": height})
        assert box(scene)["x"] == 0
        assert box(scene)["width"] * box(scene)["height"] >= 0.5 * width * height
        assert box(plan)["x"] > box(scene)["width"]
        assert box(plan)["height"] > 200
    page.set_viewport_size({"width": WIDTH, "height": HEIGHT})
    page.locator("body").press("x")
    assert box(plan)["x"] == 0
    assert box(plan)["width"] * box(plan)["height"] >= WIDTH * HEIGHT / 3
    page.locator("#map-exchange").click()
    assert box(scene)["x"] == 0


def test_each_layout_has_a_key_that_opens_its_tab(wide: Dashboard):
    page = wide.page
    names = page.locator("#layout-names")
    for key, name, tab in (
        ("Shift+R", "Results", "scores"),
        ("Shift+T", "Tune", "tune"),
        ("Shift+A", "Annotate", "annotate"),
        ("Shift+M", "Monitor", "trees"),
    ):
        page.locator("body").press(key)
        expect(page.locator(f"#panel-{tab}")).to_be_visible()
        expect(names).to_have_value(name)


def test_edges_are_dragged_and_moved_by_keys_and_are_there_after_a_reload(wide: Dashboard):
    page = wide.page
    page.locator("body").press("x")  # the map is on the left
    plan, edge = page.locator("section.map"), page.locator("#split-left")
    before, at = box(plan)["width"], box(edge)
    page.mouse.move(at["x"] + 3, at["y"] + 300)
    page.mouse.down()
    page.mouse.move(at["x"] + 203, at["y"] + 300, steps=5)  # over the frame of the scene
    page.mouse.up()
    assert box(plan)["width"] == pytest.approx(before + 200, abs=5)
    edge.press("ArrowLeft")
    wanted = before + 200 - 0.02 * WIDTH
    assert box(plan)["width"] == pytest.approx(wanted, abs=6)
    assert float(edge.get_attribute("aria-valuenow") or 0) == pytest.approx(100 * wanted / WIDTH, abs=1)
    page.reload()
    expect(plan).to_be_visible()
    assert box(plan)["width"] == pytest.approx(wanted, abs=6)
    edge.dblclick()
    assert box(plan)["width"] == pytest.approx(0.62 * WIDTH, abs=6)
    for _ in range(60):
        edge.press("ArrowRight")
    assert box(page.locator(".panel:visible"))["width"] > 0.15 * WIDTH, "nothing is pushed out of the window"


def test_parts_are_collapsed_and_a_layout_is_saved_by_name(wide: Dashboard):
    page = wide.page
    plan, panel, scene = (
        page.locator("section.map"),
        page.locator("#panel-trees"),
        page.locator("section.scene"),
    )
    page.locator("#layout-button").click()
    page.get_by_role("checkbox", name="2D map").uncheck()
    expect(plan).to_be_hidden()
    assert box(scene)["width"] == WIDTH
    page.get_by_role("checkbox", name="Tabs and table").uncheck()
    expect(panel).to_be_hidden()
    assert box(scene)["height"] > 0.8 * HEIGHT
    page.get_by_label("Name of the layout").fill("only the scene")
    page.locator("#layout-save").click()
    saved = page.locator("#layout-names")
    expect(saved).to_have_value("only the scene")
    saved.select_option("Monitor")
    expect(plan).to_be_visible()
    expect(panel).to_be_visible()
    page.reload()
    page.locator("#layout-button").click()
    saved.select_option("only the scene")
    expect(plan).to_be_hidden()
    page.locator("body").press("/")  # finds a tree: the tabs come back
    expect(panel).to_be_visible()
    saved.select_option("only the scene")
    page.locator("#layout-delete").click()
    expect(saved).to_have_value("")
    saved.select_option("Monitor")


def test_one_box_is_open_and_escape_or_a_press_elsewhere_closes_it(wide: Dashboard):
    page = wide.page
    layers, views, layout = (page.locator(f"#{name}") for name in ("layer-list", "view-list", "layout-menu"))
    page.locator("#layers-button").click()
    expect(layers).to_be_visible()
    page.locator("#views-button").click()
    expect(views).to_be_visible()
    expect(layers).to_be_hidden()
    page.locator("#view-name").press("Escape")
    expect(views).to_be_hidden()
    expect(page.locator("#views-button")).to_be_focused()
    page.locator("#layout-button").click()
    page.locator("#layout-name").click()
    expect(layout).to_be_visible()
    page.locator(".figures").click()
    expect(layout).to_be_hidden()
    expect(page.locator("#layout-button")).to_have_attribute("aria-expanded", "false")


def test_a_stored_layout_that_is_not_one_is_ignored(wide: Dashboard):
    page = wide.page
    for stored in ("{", '{"left": "wide", "top": 1e9}', "[]"):
        page.evaluate("stored => localStorage.setItem('stemmap.layout', stored)", stored)
        page.reload()
        expect(page.locator("section.map")).to_be_visible()
        assert box(page.locator("section.map"))["width"] >= 0.14 * WIDTH
    page.evaluate("localStorage.removeItem('stemmap.layout')")


def test_the_scene_can_be_hidden_and_comes_back_with_what_lies_over_it(wide: Dashboard):
    page = wide.page
    scene, plan = page.locator("section.scene"), page.locator("#map")
    wide.tab("Annotate")
    page.locator("#layout-button").click()
    page.locator("#layout-scene").uncheck()
    page.locator("body").press("Escape")
    expect(scene).not_to_be_visible()
    assert box(page.locator("#panel-annotate"))["height"] > 0.6 * HEIGHT
    assert box(plan)["width"] > 0.4 * WIDTH
    page.reload()
    wide.pause()
    expect(scene).not_to_be_visible()
    page.locator("body").press("c")  # A | B lies over the scene
    expect(scene).to_be_visible()
    expect(page.locator("#over-compare")).to_be_visible()
    page.locator("body").press("Escape")

    # One part is always there.
    page.locator("#layout-button").click()
    for part in ("map", "tabs", "scene"):
        page.locator(f"#layout-{part}").click()
    expect(page.locator("#layout-scene")).to_be_checked()
    for part in ("map", "tabs"):
        page.locator(f"#layout-{part}").check()
