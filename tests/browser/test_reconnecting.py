"""A page that loses its server reports it and reconnects."""

from __future__ import annotations

from playwright.sync_api import Browser, expect

from tests.browser.conftest import opened
from tests.browser.serving import Server

TOKEN = "a-token-only-for-this-test"
POINTS = """() => {
  const raw = window.__viserSceneTree?.getState()['/world/robot/scan/raw'];
  return raw?.message.props.points.length > 100;
}"""


def test_a_lost_server_is_reported_and_the_page_reconnects(chromium: Browser):
    first = Server(token=TOKEN)
    with first, opened(chromium, first.link, scene=True) as dashboard:
        page = dashboard.page
        dashboard.scene.wait_for_function(POINTS)
        dashboard.until("() => document.querySelectorAll('#trees tbody tr').length > 0")
        first.stop()
        expect(page.locator("#state b")).to_have_text("No connection")
        expect(page.locator("#notice")).to_contain_text("last state")
        assert page.locator("#trees tbody tr").count() > 0
        dashboard.scene.evaluate("window.wasHere = true")
        second = Server(port=first.port, token=TOKEN)
        try:
            expect(page.locator("#state b")).to_have_text("Playing")
            expect(page.locator("#notice")).not_to_be_visible()
            dashboard.scene.wait_for_function(POINTS)
            assert dashboard.scene.evaluate(
                "window.wasHere"
            )  # the frame came back without being loaded again
        finally:
            second.stop()
