"""A recording that is dropped on the page is uploaded and opened; another file is refused."""

from __future__ import annotations

import base64
from pathlib import Path

from playwright.sync_api import expect

from app.cli import main
from tests.browser.dashboard import Dashboard
from tests.browser.serving import Server

DROP = """([name, content]) => {
  const bytes = Uint8Array.from(atob(content), letter => letter.charCodeAt(0));
  const dropped = new DataTransfer();
  dropped.items.add(new File([bytes], name));
  for (const type of ['dragenter', 'dragover', 'drop'])
    document.querySelector('main').dispatchEvent(
      new DragEvent(type, { dataTransfer: dropped, bubbles: true, cancelable: true }));
}"""


AT_THE_END = """() => {
  const { value, max } = document.querySelector('#timeline');
  return value === max;
}"""


def test_a_dropped_recording_is_opened_and_a_picture_is_refused(
    dashboard: Dashboard, server: Server, tmp_path: Path
):
    run = tmp_path / "north stand.mcap"
    assert main(["simulate", "stand", "--duration", "1", "--out", str(run)]) == 0
    page = dashboard.page
    page.evaluate(DROP, ["holiday.jpg", base64.b64encode(b"\xff\xd8\xff\xe0 a picture").decode()])
    expect(page.locator("#upload [role=alert]")).to_contain_text("holiday.jpg")
    assert list((server.folder / "recordings").iterdir()) == []
    dashboard.errors = [error for error in dashboard.errors if "422" not in error]
    page.locator("#upload").get_by_role("button", name="Close").click()
    page.evaluate(DROP, [run.name, base64.b64encode(run.read_bytes()).decode()])
    expect(page.locator("#source-name")).to_have_text("north stand.mcap")
    dashboard.until_server("/api/status", "it.source.includes('/recordings/upload-') && it.scan_index >= 0")
    dashboard.command({"type": "play"})
    dashboard.until_server("/api/status", "it.state === 'finished'")
    dashboard.until(AT_THE_END)
    page.locator("#source-button").click()
    expect(page.locator("#source-list").get_by_text("north stand.mcap")).to_be_visible()
    page.keyboard.press("Escape")
