"""Links to share: to a moment of a run with its camera, and view-only."""

from __future__ import annotations

import re

from playwright.sync_api import Browser, expect

from tests.browser.conftest import opened, opened_by_another
from tests.browser.dashboard import Dashboard
from tests.browser.serving import Server

AT = """() => window.__viserMutable?.cameraControl?.getPosition(
  window.__viserMutable.camera.position.clone()).toArray() ?? []"""
POINTS = (
    "() => window.__viserSceneTree?.getState()['/world/robot/scan/raw']?.message.props.points.length > 100"
)


def test_a_link_restores_a_moment_and_a_view_only_link_changes_nothing(chromium: Browser, server: Server):
    with opened(chromium, server.link, scene=True) as dashboard:
        page = dashboard.page
        dashboard.reset()
        dashboard.command({"type": "seek", "time_s": 4.05})
        dashboard.until("() => document.querySelector('#time-now').value === '0:04.0'")
        dashboard.scene.wait_for_function(POINTS)
        dashboard.scene.evaluate(
            "() => window.__viserMutable.cameraControl.setLookAt(1, 12, 3, 0, 0, 0, false)"
        )
        dashboard.scene.wait_for_function(f"() => Math.abs(({AT})()[1] - 12) < 0.01")
        page.locator("#share-button").click()
        moment = page.locator("#share-here").input_value()
        viewers = page.locator("#share-viewer").input_value()
        stands_s = dashboard.ask("/api/status")["time_s"]
        assert 0.0 <= float(moment.split("t=")[1].split("&")[0]) - stands_s < 0.002
        page.get_by_role("button", name="Close").click()
        dashboard.command({"type": "seek", "time_s": 9.05})
        dashboard.until("() => document.querySelector('#time-now').value === '0:09.0'")

        page.goto(f"{moment}&fixedDpr=0.3")
        dashboard.until("() => document.querySelector('#time-now').value === '0:04.0'")
        dashboard.scene.wait_for_function(f"() => Math.abs(({AT})()[1] - 12) < 0.02")
        assert "run=" not in page.url
        assert dashboard.errors == []
        scan = dashboard.ask("/api/status")["scan_index"]
    looks(chromium, viewers, scan)


def test_an_ended_view_only_link_closes_its_pages_and_the_box_shows_the_new_one(
    chromium: Browser, server: Server
):
    with opened(chromium, server.link) as owner:
        page = owner.page
        page.locator("#share-button").click()
        old = page.locator("#share-viewer").input_value()
        expect(page.locator("#share-viewers")).to_have_text("No page is open with this link.")
        page.get_by_role("button", name="Close").click()
        with opened_by_another(chromium, old) as viewer:
            expect(viewer.page.locator("#trees tbody tr").first).to_be_visible()
            page.locator("#map").press("Control+k")
            find = page.get_by_role("combobox", name="Search all actions")
            for word in ("end", "access", "revoke"):
                find.fill(word)
                entry = page.get_by_role("option", name="Share: end the view-only link")
                expect(entry).to_be_visible()
            find.press("Enter")
            end = page.get_by_role("button", name="End this link")
            expect(end).to_be_focused()
            assert "lose access at once" in str(end.get_attribute("title"))
            expect(page.locator("#share-viewers")).to_have_text("1 page is open with this link.")
            end.click()
            expect(page.locator("#share-viewers")).to_contain_text("The previous link has ended")
            new = page.locator("#share-viewer").input_value()
            assert new != old
            expect(viewer.page.locator("#notice")).to_contain_text("This view-only link is no longer valid")
            expect(viewer.page.locator("#state b")).to_have_text("No access")
        assert owner.ask("/api/access")["role"] == "owner"
        assert owner.errors == []
    an_old_link_shows_a_styled_page(chromium, old)
    with opened_by_another(chromium, new) as viewer:
        expect(viewer.page.locator("#looks-only")).to_be_visible()


def an_old_link_shows_a_styled_page(chromium: Browser, link: str) -> None:
    context = chromium.new_context()
    page = context.new_page()
    messages: list[str] = []
    page.on("console", lambda message: messages.append(message.text))
    answer = page.goto(link)
    assert answer is not None
    assert answer.status == 401
    expect(page.get_by_role("heading", name="Open the link that stemmap printed")).to_be_visible()
    assert page.locator("body").evaluate("node => getComputedStyle(node).maxWidth") != "none"
    assert [text for text in messages if "Content Security Policy" in text or "violates" in text] == []
    context.close()


def looks(chromium: Browser, link: str, scan: int) -> None:
    with opened_by_another(chromium, link) as viewer:
        page = viewer.page
        expect(page.locator("#looks-only")).to_be_visible()
        expect(page.locator("#trees tbody tr").first).to_be_visible()
        page.locator("#map").press("ArrowRight")
        page.locator("#map").press("y")
        refused = page.evaluate(
            "() => fetch('/api/command', { method: 'POST', body: '{\"type\": \"play\"}',"
            " headers: { 'Content-Type': 'application/json' } }).then(answer => answer.status)"
        )
        assert refused == 403
        page.locator("#map").press("Escape")  # what is selected already, a click would leave
        expect(page.locator("#trees tr[aria-selected=true]")).to_have_count(0)
        page.locator("#trees tbody tr").first.click()
        expect(page.locator("#panel-story")).to_have_attribute("data-story", "tree 1")
        nothing_that_changes_is_offered(viewer)
        status = viewer.ask("/api/status")
        assert (status["scan_index"], status["state"]) == (scan, "paused")
        assert [error for error in viewer.errors if "403" not in error] == []
        # One request was refused, the one above: it is heard of by its answer and in the console.
        assert len(viewer.errors) <= 2


def nothing_that_changes_is_offered(viewer: Dashboard) -> None:
    page = viewer.page
    map_ = page.locator("#map")
    map_.press("Control+k")
    find = page.get_by_role("combobox", name="Search all actions")
    for word in (
        "preset paper",
        "play or pause",
        "speed 2",
        "annotate:",
        "open another",
        "layer raw",
    ):
        find.fill(word)
        expect(page.locator("#palette-none")).to_be_visible()
    find.fill("stages")
    find.press("Enter")
    expect(page.locator("#over-stages")).to_have_attribute("data-scan", re.compile(r"\d+"))
    map_.press("Escape")
    map_.press("c")
    page.locator("#over-compare [data-set=b]").select_option("paper")
    expect(page.locator("#compare-differences")).to_be_visible()
    expect(page.locator("#over-compare").get_by_role("button", name="Use").first).to_be_hidden()
    map_.press("Escape")
    for name in ("Tune", "Annotate"):
        panel = viewer.tab(name)
        expect(panel.locator("> *").first).to_be_attached()
        assert panel.locator("> *").evaluate_all("nodes => nodes.every(node => node.inert)")
    expect(page.locator("#annotate-ask")).to_be_hidden()  # which could not be dismissed
    map_.press("n")
    expect(page.locator("#trees-export option[value=laz]")).to_have_css("display", "none")
    viewer.tab("Clusters").locator("#cluster-table tbody tr").first.click()
    expect(page.locator("#panel-story")).to_have_attribute("data-story", re.compile("^cluster "))
