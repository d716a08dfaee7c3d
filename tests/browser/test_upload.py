"""A recording that is dropped on the page, as a file, a folder or several files, is uploaded and opened;
others are refused."""

from __future__ import annotations

import base64
from contextlib import closing
from pathlib import Path

import numpy as np
from playwright.sync_api import expect

from app.cli import main
from pipeline.io.readers import open_source
from pipeline.types.records import Scan
from tests.browser.dashboard import Dashboard
from tests.browser.serving import Server

# Files by their paths; those of folders as the entries that a browser gives for a dropped folder.
DROP = """files => {
  const dropped = new DataTransfer();
  const root = {};
  for (const [path, content] of Object.entries(files)) {
    const parts = path.split('/');
    const name = parts.pop();
    const made = new File([Uint8Array.from(atob(content), letter => letter.charCodeAt(0))], name);
    parts.reduce((at, part) => (at[part] ??= {}), root)[name] = made;
    dropped.items.add(made);
  }
  const entry = ([name, content]) => content instanceof File
    ? { name, isFile: true, file: found => found(content) }
    : { name, isDirectory: true, createReader: () => {
        const parts = [Object.entries(content).slice(0, 1), Object.entries(content).slice(1), []];
        return { readEntries: found => found(parts.shift().map(entry)) };
      } };
  const entries = Object.entries(root).map(entry);
  DataTransferItem.prototype.webkitGetAsEntry = () => entries.shift() ?? null;
  for (const type of ['dragenter', 'dragover', 'drop'])
    document.querySelector('main').dispatchEvent(
      new DragEvent(type, { dataTransfer: dropped, bubbles: true, cancelable: true }));
}"""


AT_THE_END = """() => {
  const { value, max } = document.querySelector('#timeline');
  return value === max;
}"""


def drop(dashboard: Dashboard, files: dict[str, bytes]) -> None:
    """Drop files, by their paths."""
    encoded = {path: base64.b64encode(content).decode() for path, content in files.items()}
    dashboard.page.evaluate(DROP, encoded)


def test_a_dropped_recording_is_opened_and_a_picture_is_refused(
    dashboard: Dashboard, server: Server, tmp_path: Path
):
    run = tmp_path / "north stand.mcap"
    assert main(["simulate", "stand", "--duration", "1", "--out", str(run)]) == 0
    page = dashboard.page
    drop(dashboard, {"holiday.jpg": b"\xff\xd8\xff\xe0 a picture"})
    expect(page.locator("#upload [role=alert]")).to_contain_text("holiday.jpg")
    assert list((server.folder / "recordings").iterdir()) == []
    dashboard.errors = [error for error in dashboard.errors if "422" not in error]
    page.locator("#upload").get_by_role("button", name="Close").click()
    drop(dashboard, {run.name: run.read_bytes()})
    expect(page.locator("#source-name")).to_have_text("north stand.mcap")
    dashboard.until_server("/api/status", "it.source.includes('/recordings/upload-') && it.scan_index >= 0")
    dashboard.command({"type": "play"})
    dashboard.until_server("/api/status", "it.state === 'finished'")
    dashboard.until(AT_THE_END)
    page.locator("#source-button").click()
    expect(page.locator("#source-list").get_by_text("north stand.mcap").first).to_be_visible()
    page.keyboard.press("Escape")


def test_the_files_of_one_recording_are_opened_as_one_and_others_are_refused(dashboard: Dashboard):
    page = dashboard.page
    with closing(open_source("sim:stand?duration=1")) as source:
        clouds = [record.points for record in source.records() if isinstance(record, Scan)]
    scans = {
        f"{k:06d}.bin": np.column_stack([points[:, :3], np.zeros(len(points))]).astype("<f4").tobytes()
        for k, points in enumerate(clouds)
    }
    folder = {f"00/velodyne/{name}": content for name, content in scans.items()}
    drop(
        dashboard,
        {
            **folder,
            "00/.hidden": b"",
            "00/times.txt": b"\n".join(b"%.1f" % (0.1 * k) for k in range(len(scans))),
        },
    )
    expect(page.locator("#source-name")).to_have_text("00")
    dashboard.until_server("/api/status", f"it.kind.includes('KITTI') && it.scans === {len(scans)}")
    drop(dashboard, scans)
    expect(page.locator("#source-name")).to_have_text(f"000000.bin and {len(scans) - 1} more")
    dashboard.until_server("/api/status", f"it.kind.includes('KITTI') && it.scans === {len(scans)}")
    drop(dashboard, {"holiday.jpg": b"\xff\xd8\xff", "more.jpg": b"\xff\xd8\xff"})
    refusal = page.locator("#upload [role=alert]")
    expect(refusal).to_contain_text("Nothing in the folder can be read (holiday.jpg and 1 more)")
    dashboard.errors = [error for error in dashboard.errors if "422" not in error]
    drop(dashboard, {"empty/.hidden": b""})
    expect(refusal).to_have_text("The folder empty has no files.")
