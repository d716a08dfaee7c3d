"""Opening another run while a robot is open: the page asks first, and names the recording that ended."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from app.cli import main
from tests.app.robot.conftest import Child, Robot, free_port
from tests.browser.conftest import PATIENCE_MS
from tests.browser.dashboard import Dashboard
from tests.browser.serving import Server

SECONDS = 3
OTHER = "sim:stand?duration=2"
QUESTION = "The robot's run and its recording end. Open anyway?"
DROP = """() => {
  const dropped = new DataTransfer();
  dropped.items.add(new File(['1'], 'other.mcap'));
  for (const type of ['dragenter', 'dragover', 'drop']) document.body.dispatchEvent(
    new DragEvent(type, { dataTransfer: dropped, bubbles: true, cancelable: true }));
}"""


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Robot, int]]:
    """A robot that sends a short run, and the port of its router."""
    pytest.importorskip("zenoh_ros2_sdk", reason="zenoh-ros2-sdk, the independent robot, is not installed")
    run = tmp_path_factory.mktemp("live") / "run.mcap"
    assert main(["simulate", "stand", "--duration", str(SECONDS), "--out", str(run)]) == 0
    port = free_port()
    router = Child("-m", "tests.app.robot.router", str(port))
    assert router.hear() == "ready"
    made = Robot(port, run, "red")
    yield made, port
    made.kill()
    router.kill()


def test_another_run_is_opened_by_a_second_press_while_a_robot_is_open(
    chromium: Browser, robot: tuple[Robot, int], tmp_path: Path
) -> None:
    sender, port = robot
    file = tmp_path / "run.mcap"
    uri = f"zenoh:tcp/127.0.0.1:{port}"
    context = chromium.new_context(viewport={"width": 1260, "height": 720})
    context.set_default_timeout(PATIENCE_MS)
    with Server(f"{uri} --record {file}", STEMMAP_FOLDER=str(tmp_path)) as server, closing(context):
        page = context.new_page()
        made = Dashboard(page)
        page.goto(server.link)
        made.until_server("/api/status", "JSON.stringify(it).includes('announced and silent')")
        sender.send()
        sender.sent()
        made.until_server("/api/runs", "it.runs.some((each) => each.scans > 20)")

        def asks() -> None:
            expect(page.locator("#leaving")).to_contain_text(QUESTION)
            assert made.ask("/api/status")["source"] == uri

        page.locator("#source-button").click()
        page.locator("#source-uri").fill(str(tmp_path / "missing.mcap"))
        page.locator("#source-open").click()
        expect(page.locator("#source-error")).to_contain_text("missing.mcap")
        expect(page.locator("#leaving")).to_have_count(0)
        assert all("409" in error for error in made.errors)
        made.errors.clear()
        page.locator("#source-uri").fill(OTHER)
        page.locator("#source-open").click()
        asks()
        page.keyboard.press("Escape")
        expect(page.locator("#leaving")).to_have_count(0)
        page.route("**/api/uploads?*", lambda route: route.fulfill(status=201, json={
            "uri": OTHER, "name": "other.mcap", "kind": "MCAP", "bytes": 1}))  # fmt: skip
        page.evaluate(DROP)
        asks()
        page.goto(f"{server.link.split('?')[0]}?run={OTHER.replace('?', '%3F')}")
        asks()
        page.goto(f"{server.link.split('?')[0]}runs")
        page.locator("#runs tbody button").first.click()
        page.get_by_role("button", name=file.name).click()
        asks()
        page.get_by_role("button", name="Open anyway").click()
        expect(page.locator("#problem")).to_contain_text(f"Recorded: {file}")
        made.until_server("/api/status", f"it.source === '{file}' && it.scan_index >= 0")
        assert made.errors == []
