"""An obstacle in the way of the robot is reported below the strip."""

from __future__ import annotations

from playwright.sync_api import expect

from tests.browser.dashboard import Dashboard


def test_a_person_in_the_way_is_reported(dashboard: Dashboard):
    way = dashboard.page.locator("#way")
    dashboard.open("sim:crossing?duration=12")  # a person crosses the way at 9 s
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
