"""A page that loses its server reports it, and reconnects if the server still accepts it."""

from __future__ import annotations

from playwright.sync_api import Browser, expect

from tests.browser.conftest import opened
from tests.browser.serving import Server

TOKEN = "a-token-only-for-this-test"
POINTS = """() => {
  const raw = window.__viserSceneTree?.getState()['/world/robot/scan/raw'];
  return raw?.message.props.points.length > 100;
}"""


def test_a_lost_server_is_reported_and_the_page_reconnects_unless_it_is_refused(chromium: Browser):
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
        expect(page.locator("#state b")).to_have_text("No connection")
        with Server(port=first.port, token=f"another-{TOKEN}"):
            expect(page.locator("#state b")).to_have_text("No access")
            expect(page.locator("#notice")).to_contain_text(
                "started again with a new link, or the session is older than a week."
                " Open the link that stemmap printed"
            )
            attempts: list[str] = []
            page.on("websocket", lambda socket: attempts.append(socket.url))
            page.wait_for_timeout(6000)  # longer than the pause between attempts without an answer
            assert [url for url in attempts if "/api/live" in url] == []
