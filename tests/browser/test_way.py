"""What stands in the robot's way is warned of below the strip, and the robot waits for it."""

from __future__ import annotations

from playwright.sync_api import Browser, expect

from tests.browser.conftest import opened
from tests.browser.serving import Server

SECONDS = 12  # a person crosses the way of this run at 9 s


def test_a_person_in_the_way_is_warned_of(chromium: Browser):
    with (
        Server(f"sim:crossing?duration={SECONDS}") as server,
        opened(chromium, server.link, 1280, 800) as dashboard,
    ):
        way = dashboard.page.locator("#way")
        dashboard.until_server("/api/status", "it.state === 'finished'")
        for time_s, zone, text in ((10.6, "stop", "Stop: obstacle"), (6.5, "clear", "")):
            dashboard.command({"type": "seek", "time_s": time_s})
            dashboard.until("zone => document.getElementById('way').dataset.zone === zone", zone)
            if text:
                expect(way).to_contain_text(text)
                box = way.bounding_box()
                assert box is not None
                assert box["height"] > 20
            else:
                expect(way).to_be_hidden()
        assert dashboard.errors == []
