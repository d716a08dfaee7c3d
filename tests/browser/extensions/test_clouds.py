"""A whole cloud in the page: its stems with sections and heights, tuned and exported; or driven through."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect

from tests.app.extensions.clouds.test_crowns import flat, tree
from tests.browser.conftest import opened
from tests.browser.dashboard import Dashboard
from tests.browser.serving import Server
from tests.browser.test_annotate import place_of
from tests.pipeline.plots import bush, write_las

PLACES = ((2.5, 2.5, 10.0), (7.5, 2.5, 12.0), (2.5, 7.5, 9.0), (7.5, 7.5, 11.0))  # x, y, height [m]
BUSH = (5.0, 5.0)
UTM = (470600.0, 3810200.0, 300.0)


@pytest.fixture(scope="module")
def cloud(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rng = np.random.default_rng(2)
    stems = [tree(x, y, rng, top) for x, y, top in PLACES]
    points = np.concatenate([flat(10.0, rng), *stems, bush(*BUSH, rng)])
    file: Path = tmp_path_factory.mktemp("clouds") / "plot.laz"
    write_las(file, points, offset=UTM, crs="EPSG:26912")
    return file


@pytest.fixture(scope="module")
def page(chromium: Browser, tmp_path_factory: pytest.TempPathFactory, cloud: Path) -> Iterator[Dashboard]:
    folder = str(tmp_path_factory.mktemp("stemmap"))
    with (
        Server("sim:stand?duration=5", STEMMAP_FOLDER=folder) as server,
        opened(chromium, server.link) as made,
    ):
        made.pause()
        yield made
        assert made.errors == []


def open_cloud(page: Dashboard, cloud: Path, drive: bool = False) -> None:
    """Open the cloud in the dialog, as a person does."""
    page.page.locator("#source-button").click()
    page.page.locator("#source-uri").fill("run.mcap")
    expect(page.page.locator("#source-cloud")).to_be_hidden()
    odometry = page.page.locator("#source-odometry")
    expect(odometry).to_be_visible()
    page.page.locator("#source-uri").fill(str(cloud))
    expect(page.page.get_by_label("Map this cloud")).to_be_checked()
    expect(odometry).to_be_hidden()
    if drive:
        page.page.get_by_label("Drive a simulated robot").check()
        expect(odometry).to_be_visible()
    page.page.locator("#source-open").click()
    expect(page.page.locator("#source-dialog")).to_be_hidden()


@pytest.fixture
def dialog(page: Dashboard) -> Iterator[Page]:
    """The open dialog, of which nothing reaches the server."""
    page.page.route("**/api/open", lambda route: route.fulfill(status=202, json={}))
    page.page.locator("#source-button").click()
    yield page.page
    page.page.locator("#source-close").click()
    page.page.unroute("**/api/open")


def sent_by(page: Page) -> dict[str, Any]:
    """Press *Open*, and return what the page asks for."""
    with page.expect_request("**/api/open") as request:
        page.locator("#source-open").click()
    return dict(request.value.post_data_json or {})


def test_what_is_chosen_for_a_file_of_points_is_sent(dialog: Page) -> None:
    dialog.locator("#source-uri").fill("wood.ply")
    dialog.get_by_label("Read as").select_option("scan")
    dialog.locator("#source-unit").select_option("ft")
    dialog.get_by_label("Up axis").select_option("-y")
    sent = sent_by(dialog)
    assert [sent[name] for name in ("uri", "form", "unit", "up")] == ["wood.ply", "scan", "ft", "-y"]


def test_what_is_chosen_for_one_source_does_not_count_for_the_next(dialog: Page) -> None:
    dialog.locator("#source-uri").fill("")
    dialog.locator("#source-odometry").select_option("static")  # before a path, for the one to come
    dialog.locator("#source-uri").fill("wood.ply")
    dialog.get_by_label("Drive a simulated robot").check()
    expect(dialog.locator("#source-odometry")).to_have_value("static")
    dialog.get_by_label("Read as").select_option("scan")
    dialog.locator("#source-unit").select_option("ft")
    dialog.get_by_label("Up axis").select_option("y")
    dialog.locator("#source-uri").fill("utm.laz")
    expect(dialog.get_by_label("Map this cloud")).to_be_checked()
    assert sent_by(dialog) == {"uri": "utm.laz", "odometry": "auto"}


def test_a_cloud_is_opened_and_its_stems_have_sections_and_heights(page: Dashboard, cloud: Path) -> None:
    open_cloud(page, cloud)
    rows = page.page.locator("#trees tbody tr")
    expect(rows).to_have_count(len(PLACES))
    expect(page.page.locator("#state b")).to_have_text("Mapped")
    expect(page.page.locator("#timeline")).to_be_hidden()
    expect(page.page.locator("[data-figure=health]")).to_be_hidden()
    heads = [text.strip(" ▲▼") for text in page.page.locator("#trees thead th:visible").all_inner_texts()]
    assert heads == ["tree", "x m", "y m", "position ± cm", "DBH cm", "height m", "lean °"]
    for found in page.ask("/api/trees")["trees"]:
        x, y, height = min(PLACES, key=lambda at: np.hypot(at[0] - found["x"], at[1] - found["y"]))
        assert np.hypot(x - found["x"], y - found["y"]) < 0.05
        assert abs(found["height_m"] - height) < 0.3
        assert abs(found["dbh_cm"] - 28.0) < 1.5
    rows.first.click()
    story = page.page.locator("#panel-story")
    expect(story.locator("[data-sections] .section")).to_have_count(9)
    expect(story.locator(".section.breast .fitted")).to_have_count(1)
    assert story.locator(".section .point").count() > 200
    expect(story.get_by_text("Stem curve")).to_be_visible()


def test_the_card_of_a_tree_shows_all_cross_sections(page: Dashboard) -> None:
    before = page.page.viewport_size
    page.page.set_viewport_size({"width": 1440, "height": 900})
    page.tab("Trees")
    page.page.locator("#trees tbody tr").nth(1).click()
    page.tab("Annotate")
    page.card_shown()
    evidence = page.page.locator("#review-evidence")
    expect(evidence.get_by_text("9 cross-sections")).to_be_in_viewport(ratio=1)
    expect(page.page.get_by_text(re.compile(r"^Tree \d+, fitted in \d+ slices"))).to_be_visible()
    sections = evidence.locator(".section")
    expect(sections).to_have_count(9)
    for k in range(9):
        expect(sections.nth(k)).to_be_in_viewport(ratio=0.95)
    assert before is not None
    page.page.set_viewport_size(before)
    page.tab("Story")


def test_a_candidate_that_is_no_tree_shows_why(page: Dashboard) -> None:
    page.page.locator("#map").click(position=place_of(page, *BUSH))
    story = page.page.locator("#panel-story")
    expect(story.locator(".verdict")).not_to_have_attribute("data-verdict", "tree")
    pictures = story.locator(".gathered-views .picture")
    expect(pictures).to_have_count(2)
    assert len(pictures.last.locator("path.cloud").first.get_attribute("d") or "") > 1000
    expect(story.get_by_text("points around it")).to_be_visible()
    expect(story.locator(".vote-list li").first).to_contain_text("%")


def test_a_slider_maps_the_cloud_again_and_only_those_of_the_inventory_are_shown(page: Dashboard) -> None:
    panel = page.tab("Tune")
    expect(panel.locator("[id^='tune-detection.']:visible").first).to_be_visible()
    expect(panel.locator("[id='tune-clustering.eps']")).to_be_hidden()
    least = panel.locator("[id='tune-detection.radius_min']")
    least.fill("0.2")
    least.press("Enter")
    page.until_server("/api/trees", "it.trees.length === 0")
    panel.locator("#tune-undo").click()
    page.until_server("/api/trees", f"it.trees.length === {len(PLACES)}")
    assert [tree["number"] for tree in page.ask("/api/trees")["trees"]] == [1, 2, 3, 4]


def test_the_page_shows_the_numbers_of_the_files(page: Dashboard) -> None:
    page.tab("Trees")
    with page.page.expect_download() as download:
        page.page.locator("#trees-csv").click()
    with Path(str(download.value.path())).open(newline="", encoding="utf-8") as file:
        written = list(csv.DictReader(file))
    for row in written:
        cells = page.page.locator(f"#trees tr[data-tree='{row['tree']}'] td")
        shown = [cells.nth(k).inner_text() for k in (1, 2, 4, 5)]
        diameter = f"{row['dbh_cm']} \N{PLUS-MINUS SIGN} {row['sigma_dbh_cm']}"
        height = f"{row['height_m']} \N{PLUS-MINUS SIGN} {row['sigma_height_m']}"
        assert shown == [row["x_m"], row["y_m"], diameter, height]
    first = written[0]
    page.page.locator("#find").fill(f"x = {first['x_m']} y = {first['y_m']}")
    expect(page.page.locator("#trees tbody tr")).to_have_count(1)
    page.page.locator("#find").fill("")
    page.page.locator("#trees tbody tr[data-tree='1']").click()
    story = page.page.locator("#panel-story")
    expect(story).to_contain_text(f"{first['x_m']}, {first['y_m']} m")
    expect(story).to_contain_text(f"{first['dbh_cm']} \N{PLUS-MINUS SIGN} {first['sigma_dbh_cm']} cm")
    with page.page.expect_download() as download:
        page.page.locator("#map-csv").click()
    places = [line.split(",")[2:4] for line in Path(str(download.value.path())).read_text().splitlines()]
    assert [float(value) for value in places[1]] == [float(first["x_m"]), float(first["y_m"])]


def test_the_colours_of_heights_have_numbers(page: Dashboard) -> None:
    page.page.locator("#layers-button").click()
    choice = page.page.locator("[data-choice=colour_by]")
    choice.select_option("height")
    ticks = page.page.locator("#colour-bar li")
    expect(ticks).to_have_text([re.compile(r"^.?\d+\.\d m$")] * 2)
    choice.select_option("verdict")
    page.page.keyboard.press("Escape")


def test_a_robot_drives_through_the_cloud_as_the_second_choice(page: Dashboard, cloud: Path) -> None:
    open_cloud(page, cloud, drive=True)
    page.until_server("/api/status", "it.source.startsWith('sim:cloud') && it.scan_index >= 0")
    expect(page.page.locator("#timeline")).to_be_visible()
    expect(page.page.locator("[data-figure=health]")).to_be_visible()
    heads = page.page.locator("#trees thead th[data-key=height]")
    expect(heads).to_be_hidden()


US_FT = 1200 / 3937  # m


def test_a_cloud_in_feet_has_the_coordinates_of_its_files_and_says_their_unit(
    page: Dashboard, tmp_path: Path
) -> None:
    rng = np.random.default_rng(2)
    points = np.concatenate([flat(10.0, rng), *(tree(x, y, rng, top) for x, y, top in PLACES)])
    file = tmp_path / "feet.laz"
    write_las(file, points / US_FT, offset=(2_800_000.0, 1_200_000.0, 5_000.0), crs="EPSG:6430+6360")
    page.tab("Trees")
    heads = page.page.locator("#trees thead th").filter(visible=True)
    open_cloud(page, file)
    page.until_server("/api/status", "it.source.endsWith('feet.laz') && it.state === 'finished'")
    expect(heads.nth(1)).to_contain_text("x US ft")
    expect(page.page.locator("#trees tbody tr")).to_have_count(len(PLACES))
    with page.page.expect_download() as download:
        page.page.locator("#trees-csv").click()
    with Path(str(download.value.path())).open(newline="", encoding="utf-8") as written:
        row = next(csv.DictReader(written))
    cells = page.page.locator(f"#trees tr[data-tree='{row['tree']}'] td")
    assert [cells.nth(k).inner_text() for k in (1, 2)] == [row["x"], row["y"]]
    with page.page.expect_download() as download:
        page.page.locator("#map-csv").click()
    head, first, *_ = Path(str(download.value.path())).read_text(encoding="utf-8").splitlines()
    assert head.split(",")[2:4] == ["x", "y"]
    assert first.split(",")[2:4] == [row["x"], row["y"]]
    page.page.locator(f"#trees tbody tr[data-tree='{row['tree']}']").click()
    expect(page.page.locator("#panel-story")).to_contain_text(f"{row['x']}, {row['y']} US ft")
