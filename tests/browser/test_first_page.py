"""The file that a browser is started with leads on to the dashboard, logged in."""

from __future__ import annotations

from playwright.sync_api import Browser, expect

from app.web.serving import page_that_leads_to
from tests.browser.conftest import PATIENCE_MS
from tests.browser.serving import Server


def test_the_file_leads_to_the_dashboard(chromium: Browser, server: Server):
    context = chromium.new_context()
    context.set_default_timeout(PATIENCE_MS)
    page = context.new_page()
    with page_that_leads_to(server.link) as file:
        page.goto(file.as_uri())
        expect(page.locator("#source-name")).to_have_text("sim:stand")
    assert "token" not in page.url
    context.close()
