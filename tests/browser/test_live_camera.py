"""The camera of a live robot: its pictures with the trees of the map."""

from __future__ import annotations

import re
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

SECONDS = 6
#: Colours of a picture where a mark has its middle, of trees that stand near enough to be seen for certain.
SEEN_AT_TREES = """() => {
  const image = document.querySelector('#camera-image');
  const canvas = new OffscreenCanvas(image.naturalWidth, image.naturalHeight);
  const pen = canvas.getContext('2d');
  pen.drawImage(image, 0, 0);
  const part = (mark, side) => Number.parseFloat(mark.style[side]) / 100;
  return [...document.querySelectorAll('#camera-marks .seen.tree')]
    .filter((mark) => Number.parseFloat(mark.title.split(', ')[1]) < 15
      && part(mark, 'left') > 0.02 && part(mark, 'left') + part(mark, 'width') < 0.98)
    .map((mark) => {
      const x = (part(mark, 'left') + part(mark, 'width') / 2) * canvas.width;
      const y = (part(mark, 'top') + part(mark, 'height') / 2) * canvas.height;
      return [...pen.getImageData(Math.floor(x), Math.floor(y), 1, 1).data].slice(0, 3);
    });
}"""


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Robot, int]]:
    """A robot with a camera of two pictures a second that knows nothing of us, at a router; and its port."""
    pytest.importorskip("zenoh_ros2_sdk", reason="zenoh-ros2-sdk, the independent robot, is not installed")
    run = tmp_path_factory.mktemp("live") / "run.mcap"
    words = ["simulate", "stand", "--duration", str(SECONDS), "--camera", "--out", str(run)]
    assert main(words) == 0
    port = free_port()
    router = Child("-m", "tests.app.robot.router", str(port))
    assert router.hear() == "ready"
    made = Robot(port, run, "red")
    yield made, port
    made.kill()
    router.kill()


def test_pictures_of_a_live_robot_show_the_trees_of_its_map(
    chromium: Browser, robot: tuple[Robot, int], tmp_path: Path
):
    sender, port = robot
    server = Server(f"zenoh:tcp/127.0.0.1:{port}", STEMMAP_FOLDER=str(tmp_path))
    context = chromium.new_context(viewport={"width": 1260, "height": 720})
    context.set_default_timeout(PATIENCE_MS)
    with server, closing(context):
        page = context.new_page()
        made = Dashboard(page)
        page.goto(f"{server.link}&fixedDpr=0.3")
        expect(page.locator("#camera-button")).to_be_hidden()
        made.until_server("/api/status", "JSON.stringify(it).includes('announced and silent')")
        sender.send()
        page.locator("#camera-button").click()
        assert sender.sent() == 10 * SECONDS
        # On a busy machine scans are left out, and pictures come in heaps, of which some are left out too.
        made.until_server("/api/status", "it.detail.startsWith('Nothing heard') && it.scans_behind === 0")
        last = made.ask("/api/status")["scan_index"]
        expect(page.locator("#over-camera")).to_have_attribute("data-scan", str(last))
        expect(page.locator("#camera-lead")).to_contain_text(re.compile(r"Trees of the map in view: [1-9]"))
        expect(page.locator("#camera-received")).to_contain_text(
            re.compile(r"Live: of \d+ pictures \d+ were taken in")
        )
        made.until("() => document.querySelector('#camera-image').naturalWidth > 100")
        seen = page.evaluate(SEEN_AT_TREES)
        # Stems were drawn brown, the sky blue, ground and bushes green; a bush may stand before a stem.
        brown = [colour for colour in seen if colour[0] > colour[1] > colour[2]]
        assert len(brown) > 0.5 * len(seen), seen
        assert made.errors == []
