"""The page of a fleet: a card for each run, one map of all, and links to the dashboards."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator

import pytest
from playwright.sync_api import Browser, WebSocketRoute, expect

from tests.browser.conftest import PATIENCE_MS
from tests.browser.dashboard import Dashboard
from tests.browser.serving import Server

RIGHT_OF_STRIP = (
    "Math.max(...[...document.querySelectorAll('.strip *')].map((e) => e.getBoundingClientRect().right))"
)
RUNS = "sim:paper?duration=4 sim:paper?duration=5"


@pytest.fixture(scope="module")
def fleet() -> Iterator[Server]:
    """A server of two runs."""
    with Server(RUNS) as running:
        yield running


MEMBER = {
    "source": "zenoh:tcp/h:7447",
    "answers": True,
    "state": "playing",
    "detail": "",
    "live": True,
    "rate_hz": 10.0,
    "behind": None,
    "health": None,
    "trees": 3,
    "distance_m": 2.0,
    "recording": "",
    "clearance": None,
}
MAP = {"trees": [], "path": [[0, 0], [1, 0]], "pose": [1, 0, 0], "common": [0, 0, 0], "how": "fake"}


def test_a_robot_keeps_its_letter_and_colour_when_another_leaves(chromium: Browser, fleet: Server):
    context = chromium.new_context(viewport={"width": 1280, "height": 800}, color_scheme="dark")
    context.set_default_timeout(PATIENCE_MS)
    told: list[WebSocketRoute] = []
    page = context.new_page()
    page.route_web_socket("**/api/fleet", lambda socket: told.append(socket))
    page.add_init_script(
        "window.letters = []; const write = CanvasRenderingContext2D.prototype.fillText;"
        "CanvasRenderingContext2D.prototype.fillText = function (text, ...place) {"
        " if (/^[A-Z]$/.test(text)) window.letters.push(text); write.call(this, text, ...place); };"
    )
    page.goto(fleet.link)
    cards = page.locator(".card")

    def wait(condition: Callable[[], bool]) -> None:
        for _ in range(PATIENCE_MS // 20):
            if condition():
                return
            page.wait_for_timeout(20)
        raise AssertionError("it was waited for in vain")

    wait(lambda: bool(told))

    def tell(*names: str) -> None:
        page.evaluate("window.letters.length = 0")
        members = [{**MEMBER, "name": name} for name in names]
        told[0].send(json.dumps({"type": "fleet", "members": members, "notice": ""}))
        told[0].send(json.dumps({"type": "maps", "maps": dict.fromkeys(names, MAP)}))
        expect(cards).to_have_count(len(names))
        wait(lambda: page.evaluate("window.letters.length") >= len(names))

    def letter(name: str) -> str:
        return page.locator(f".card[data-robot={name}] h2 i").inner_text()

    tell("red", "blue")
    assert (letter("red"), letter("blue")) == ("A", "B")
    tell("blue")
    assert letter("blue") == "B"
    assert set(page.evaluate("window.letters")) == {"B"}
    tell("green", "blue", "red")
    assert [letter(name) for name in ("green", "blue", "red")] == ["C", "B", "A"]
    assert set(page.evaluate("window.letters")) == {"A", "B", "C"}
    context.close()


def test_two_runs_on_one_page(chromium: Browser, fleet: Server):
    context = chromium.new_context(viewport={"width": 1280, "height": 800}, color_scheme="dark")
    context.set_default_timeout(PATIENCE_MS)
    with fleet as server:
        page = context.new_page()
        seen = Dashboard(page)
        page.goto(server.link)
        cards = page.locator(".card")
        expect(cards).to_have_count(2)
        for run in RUNS.split():
            card = page.locator(f".card[data-robot='{run}']")
            expect(card.locator(".state")).to_contain_text("Finished")
            expect(card.locator("[data-figure=trees] dd")).not_to_have_text("0")
        assert "token" not in page.url
        assert page.evaluate("document.documentElement.scrollWidth") <= 1280
        page.locator(f".card[data-robot='{RUNS.split()[1]}'] a").click()
        expect(page.locator("#source-name")).to_have_text("sim:paper")
        assert "token" not in page.url
        assert f":{server.port}/" not in page.url, "a dashboard has a port of its own"
        assert seen.ask("/api/status")["source"] == RUNS.split()[1]
        for width in (390, 800, 1024, 1280):
            page.set_viewport_size({"width": width, "height": 800})
            expect(page.locator("#robots-link")).to_be_visible()
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            assert page.evaluate(RIGHT_OF_STRIP) <= width
        page.keyboard.press("Escape")  # the welcome
        page.locator("#robots-link").click()
        expect(page).to_have_url(f"http://127.0.0.1:{server.port}/")
        expect(cards).to_have_count(2)
        page.set_viewport_size({"width": 390, "height": 844})
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        assert seen.errors == []
    # The server has ended; this test is the last one of the file.
    expect(page.locator("#fleet-notice")).to_contain_text("No connection")
    context.close()
