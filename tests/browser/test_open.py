"""The dialog Open: places to choose from, near misses, and what extensions add to it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, Route, expect

from tests.app.robot.conftest import free_port
from tests.browser.conftest import opened
from tests.browser.serving import Server

SOURCE = "sim:stand?duration=5"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data folder with recordings in folders; they are listed by their names."""
    made: Path = tmp_path_factory.mktemp("data") / "recordings"
    for name in ("spring/north stand.mcap", "spring/south stand.mcap", "autumn/plot.laz"):
        file = made / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(b"0")
    return made


@pytest.fixture(scope="module", params=["", "clouds,stand"], ids=["core", "extensions"])
def extensions(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def page(chromium: Browser, folder: Path, extensions: str) -> Iterator[Page]:
    with (
        Server(SOURCE, STEMMAP_FOLDER=str(folder.parent), STEMMAP_EXTENSIONS=extensions) as server,
        opened(chromium, server.link) as made,
    ):
        made.until_server("/api/runs", "it.runs.length >= 1")
        made.pause()
        yield made.page


@pytest.fixture
def dialog(page: Page) -> Iterator[Page]:
    page.locator("#source-button").click()
    page.locator("#source-uri").fill("")
    expect(page.locator("#source-list summary").last).to_be_visible()
    yield page
    page.locator("#source-close").click()


def test_recordings_are_a_tree_and_simulated_runs_are_folded(dialog: Page) -> None:
    listed = dialog.locator("#source-list")
    expect(listed.get_by_text("spring/", exact=True)).to_be_visible()
    expect(listed.get_by_text("sim:long", exact=True)).to_be_hidden()
    listed.get_by_text("spring/", exact=True).click()
    expect(listed.get_by_text("north stand.mcap", exact=True)).to_be_visible()
    listed.get_by_text("Simulated, with ground truth").click()
    expect(listed.get_by_text("sim:long", exact=True)).to_be_visible()


def test_what_is_typed_filters_and_tab_completes(dialog: Page, folder: Path) -> None:
    field, shown = dialog.locator("#source-uri"), dialog.locator("#source-list button:visible")
    field.press_sequentially("south")
    expect(shown).to_have_count(1)
    expect(shown).to_contain_text("south stand.mcap")
    field.press("Tab")
    expect(field).to_have_value(str(folder / "spring" / "south stand.mcap"))
    field.fill("sim:stand")  # an address that others begin with
    field.press("Tab")
    expect(field).to_have_value("sim:stand")
    expect(field).not_to_be_focused()
    field.fill("nothing like it")
    expect(dialog.locator("#source-none")).to_be_visible()


def test_a_near_miss_is_suggested(dialog: Page, folder: Path) -> None:
    dialog.locator("#source-uri").fill(str(folder / "spring" / "nort stand.mcap"))
    dialog.locator("#source-open").click()
    near = dialog.locator("#source-near")
    expect(near).to_contain_text("Did you mean")
    expect(near.get_by_role("button").first).to_have_text(str(folder / "spring" / "north stand.mcap"))


def test_a_host_and_port_are_suggested_as_the_address_of_a_router(dialog: Page) -> None:
    for typed in ("127.0.0.1:7447", "tcp/robot.local:7447?robot=red"):
        dialog.locator("#source-uri").fill(typed)
        dialog.locator("#source-open").click()
        near = dialog.locator("#source-near button").first
        expect(near).to_have_text(f"zenoh:tcp/{typed.removeprefix('tcp/')}")
        near.click()
        expect(dialog.locator("#source-uri")).to_have_value(f"zenoh:tcp/{typed.removeprefix('tcp/')}")


def test_the_choices_of_a_cloud_and_the_boxes_of_two_runs_are_of_their_extensions(
    dialog: Page, folder: Path, extensions: str
) -> None:
    dialog.locator("#source-uri").fill("plot.laz")
    assert dialog.locator("#source-cloud").count() == (1 if extensions else 0)
    if extensions:
        expect(dialog.locator("#source-cloud")).to_be_visible()
    runs = dialog.evaluate("async () => (await (await fetch('/api/runs')).json()).runs.length")
    assert runs >= 1  # those of the other server are in the same folder
    address = dialog.url
    dialog.goto(address.split("?")[0] + "runs")
    expect(dialog.locator("#runs tbody tr")).to_have_count(runs)
    assert dialog.locator("#runs input[type=checkbox]").count() == (runs if extensions else 0)
    heads = dialog.locator("#runs thead tr > *").count()
    assert dialog.locator("#runs tbody tr > *").count() == runs * heads
    dialog.goto(address)
    dialog.locator("#source-button").click()


def test_the_dialog_keeps_its_size_while_it_is_open(dialog: Page) -> None:
    box = dialog.locator("#source-dialog").bounding_box()
    dialog.locator("#source-robot summary").click()
    dialog.locator("#source-inside summary").click()
    assert dialog.locator("#source-dialog").bounding_box() == box
    dialog.locator("#source-inside summary").click()
    dialog.locator("#source-robot summary").click()
    dialog.locator("#source-uri").fill("nothing like it")
    expect(dialog.locator("#source-none")).to_be_visible()
    assert dialog.locator("#source-dialog").bounding_box() == box


def test_a_dialog_that_was_left_begins_with_the_whole_list_and_records_again(dialog: Page) -> None:
    field, record = dialog.locator("#source-uri"), dialog.locator("#source-record")
    listed = dialog.locator("#source-list button:visible")
    expect(listed.first).to_be_visible()
    shown = listed.count()
    dialog.locator("#source-robot summary").click()
    expect(field).to_have_value("zenoh:tcp/127.0.0.1:7447")
    expect(listed).to_have_count(shown)  # an address is no filter
    record.uncheck()
    dialog.keyboard.press("Escape")
    expect(dialog.locator("#source-dialog")).to_be_hidden()
    dialog.locator("#source-button").click()
    expect(field).to_have_value("")
    expect(listed).to_have_count(shown)
    dialog.locator("#source-robot summary").click()
    expect(record).to_be_checked()
    dialog.locator("#source-robot summary").click()


def test_the_topics_are_read_again_after_another_address_of_a_robot(dialog: Page) -> None:
    asked: list[str] = []

    def answer(route: Route) -> None:
        asked.append(json.loads(route.request.post_data or "")["uri"])
        route.fulfill(json={"topics": [], "mount": None, "warnings": [f"Topics of {asked[-1]}"]})

    dialog.route("**/api/inside", answer)
    dialog.locator("#source-robot summary").click()
    host, listed = dialog.locator("#robot-fields [name=host]"), dialog.locator("#inside-body")
    host.fill("10.0.0.6")
    dialog.locator("#source-inside summary").click()
    expect(listed).to_contain_text("Topics of zenoh:tcp/10.0.0.6:7447")
    host.fill("10.0.0.7")
    host.press("Tab")
    expect(listed).to_contain_text("Topics of zenoh:tcp/10.0.0.7:7447")
    dialog.locator("#robot-kind").select_option("velodyne")
    expect(listed).to_contain_text("Topics of velodyne:0.0.0.0:2368?from=192.168.1.201")
    assert len(asked) == 3
    dialog.unroute("**/api/inside")
    dialog.locator("#robot-kind").select_option("zenoh")
    dialog.locator("#source-inside summary").click()
    dialog.locator("#source-robot summary").click()


def test_a_sensor_is_opened_by_the_form_and_its_run_is_recorded(page: Page, folder: Path) -> None:
    page.locator("#source-button").click()
    page.locator("#source-robot summary").click()
    page.locator("#robot-fields [name=host]").fill("forest.local")
    page.locator("#robot-fields [name=robot]").fill("anymal b")
    expect(page.locator("#source-uri")).to_have_value("zenoh:tcp/forest.local:7447?robot=anymal%20b")
    page.locator("#robot-kind").select_option("velodyne")
    expect(page.locator("#source-uri")).to_have_value("velodyne:0.0.0.0:2368?from=192.168.1.201")
    page.locator("#robot-fields [name=from]").fill("127.0.0.1")
    page.locator("#robot-fields [name=port]").fill(str(free_port()))
    expect(page.locator("#source-record")).to_be_checked()
    page.locator("#source-open").click()
    expect(page.locator("#recording")).to_contain_text("recording 0 MB")
    assert len(list(folder.glob("live-*.mcap"))) >= 1
    page.locator("#recording").click()
    expect(page.locator("#recording")).to_have_text("End recording?")
    page.locator("#recording").click()
    expect(page.locator("#recording")).to_have_text("○ Record")  # no packet came, so that there is no file
    assert not list(folder.glob("live-*.mcap"))
