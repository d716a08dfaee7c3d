"""Uploads: what is kept, what is refused and why, and that nothing stays of what was refused or cancelled."""

from __future__ import annotations

import asyncio
import json
import re
import shutil
import socket
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from app.common.settings import Settings
from app.sources import opening
from app.store.async_store import AsyncStore
from app.web import uploads
from app.web.uploads import UploadError, Uploads
from pipeline.errors import SourceError
from tests.app.server_for_tests import BEARER, running

FILE = {**BEARER, "Content-Type": "application/octet-stream"}


@pytest.fixture
def recordings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of uploads; a file that begins with "good" is a recording, without another process."""

    async def look(question: dict[str, Any], **_options: object) -> dict[str, Any]:
        path = Path(question["path"])
        if path.is_dir():
            path = next(file for file in sorted(path.rglob("*")) if file.is_file())
        if path.read_bytes().startswith(b"good"):
            return {"kind": "fake recording", "scans": 3}
        raise SourceError("unknown format", where=str(path), remedy="Readable are: good ones.")

    monkeypatch.setattr(opening, "ask", look)
    return tmp_path / "recordings"


def kept(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []


async def send(client: httpx.AsyncClient, content: bytes, name: str = "north stand.MCAP") -> httpx.Response:
    return await client.post("/api/uploads", params={"name": name}, headers=FILE, content=content)


async def test_a_recording_is_kept_under_a_made_up_name_and_offered(recordings: Path) -> None:
    content = b"good" + bytes(range(256)) * 40_000  # 10 MB: several pieces, beyond the limit of other bodies
    async with running(Settings(folder=recordings.parent)) as (client, _):
        answer = await send(client, content, "../../etc/north stand.MCAP")
        assert answer.status_code == 201
        told = answer.json()
        assert (told["name"], told["kind"], told["bytes"]) == (
            "north stand.MCAP",
            "fake recording",
            len(content),
        )
        place = Path(told["uri"])
        assert place.parent == recordings
        assert re.fullmatch(r"upload-\d{8}-\d{6}-[0-9a-f]{6}-[\w-]*(\.\w+)?", place.name, re.ASCII)
        assert place.suffix == ".mcap"
        assert place.read_bytes() == content
        assert kept(recordings) == [place.name]
        offered = (await client.get("/api/sources", headers=BEARER)).json()["recordings"]
        assert offered == [{"uri": str(place), "name": "north stand.MCAP", "doc": "fake recording, uploaded"}]


def folder_of(files: dict[str, bytes]) -> bytes:
    """The body of an upload of several files."""
    return (
        json.dumps([[name, len(content)] for name, content in files.items()]).encode()
        + b"\n"
        + b"".join(files.values())
    )


async def send_many(client: httpx.AsyncClient, content: bytes, name: str = "drive 00") -> httpx.Response:
    return await client.post(
        "/api/uploads", params={"name": name, "many": True}, headers=FILE, content=content
    )


async def test_the_files_of_one_recording_are_kept_as_a_folder(recordings: Path) -> None:
    scans = {f"velodyne/{k:06d}.bin": b"good" + bytes(k * 300_000) for k in range(12)}
    files = {"calib.txt": b"good", "times.txt": b"", **scans}
    async with running(Settings(folder=recordings.parent)) as (client, _):
        answer = await send_many(client, folder_of(files))
        assert answer.status_code == 201
        uploaded = answer.json()
        place = Path(uploaded["uri"])
        assert (uploaded["name"], uploaded["kind"], place.parent) == (
            "drive 00",
            "fake recording",
            recordings,
        )
        assert kept(recordings) == [place.name]
        found = {str(path.relative_to(place)): path for path in place.rglob("*") if path.is_file()}
        assert {name: path.read_bytes() for name, path in found.items()} == files
        offered = (await client.get("/api/sources", headers=BEARER)).json()["recordings"]
        assert offered == [{"uri": str(place), "name": "drive 00", "doc": "fake recording, uploaded"}]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (folder_of({"holiday.jpg": b"\xff\xd8", "more.jpg": b"\xff\xd8"}), "unknown format"),
        (folder_of({"a/../../b": b"good"}), "cannot be used"),
        (folder_of({"/etc/b": b"good"}), "cannot be used"),
        (folder_of({"a\\b": b"good"}), "cannot be used"),
        (folder_of({".ssh/keys": b"good"}), "cannot be used"),
        (folder_of({"a/b/c/d/e": b"good"}), "cannot be used"),
        (folder_of({"x" * 61: b"good"}), "cannot be used"),
        (folder_of({}), "0 files"),
        (b'[["a", 4], ["a", 4]]\ngoodgood', "the same name"),
        (b'[["a", 4], ["a/b", 4]]\ngoodgood', "the same name"),
        (b'[["a/b/c", 4], ["a", 4]]\ngoodgood', "the same name"),
        (b'[["a", -4], ["b", 8]]\ngood', "cannot be read"),
        (folder_of({"a": b"good"}) + b"more", "sizes of the files"),
        (b"good", "cannot be read"),
    ],
)
async def test_what_is_no_folder_of_a_recording_is_refused(
    recordings: Path, content: bytes, words: str
) -> None:
    async with running(Settings(folder=recordings.parent)) as (client, _):
        answer = await send_many(client, content)
        assert answer.status_code == 422
        assert words in answer.json()["error"]["what"]
    assert kept(recordings) == []


async def test_what_is_no_recording_is_refused_by_its_own_name(recordings: Path) -> None:
    async with running(Settings(folder=recordings.parent)) as (client, _):
        for name in ("holiday.jpg", "x" * 300, "a/../b", "<b>.exe", ".mcap", "ä\u202e.bag"):
            answer = await send(client, b"\xff\xd8 not one", name)
            assert answer.status_code == 422
            error = answer.json()["error"]
            assert error["what"] == "unknown format"
            assert ".upload-" not in answer.text
    assert kept(recordings) == []


async def test_too_large_empty_and_without_a_length(
    recordings: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def pieces() -> AsyncIterator[bytes]:
        yield b"good"

    settings = Settings(folder=recordings.parent, upload_limit=2_000_000)
    async with running(settings) as (client, _):
        assert (await client.get("/api/uploads", headers=BEARER)).json() == {
            "room": 2_000_000,
            "limit": 2_000_000,
        }
        assert (await send(client, b"good" + bytes(2_000_000))).status_code == 413
        assert (await send(client, b"")).status_code == 422
        unsaid = await client.post("/api/uploads", params={"name": "a"}, headers=FILE, content=pieces())
        assert unsaid.status_code == 411
        form = {**BEARER, "Content-Type": "text/plain"}
        plain = await client.post("/api/uploads", params={"name": "a"}, headers=form, content=b"good")
        assert plain.status_code == 422
        monkeypatch.setattr(uploads, "SPARE_BYTES", 1 << 60)
        full = await send(client, b"good")
        assert (full.status_code, "the disk has free" in full.text) == (413, True)
    assert kept(recordings) == []


async def test_two_uploads_at_once_share_the_room(recordings: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = shutil.disk_usage(recordings.parent)._replace(free=uploads.SPARE_BYTES + 100)
    monkeypatch.setattr(shutil, "disk_usage", lambda _place: usage)
    go_on = asyncio.Event()

    async def slow() -> AsyncIterator[bytes]:
        await go_on.wait()
        yield b"good" + bytes(66)

    async def quick(size: int) -> AsyncIterator[bytes]:
        yield b"good".ljust(size)

    room_of_uploads = Uploads(recordings, 1000, AsyncStore(None))
    assert room_of_uploads.room() == 100
    first = asyncio.create_task(room_of_uploads.take("a.mcap", 70, slow()))
    async with asyncio.timeout(30):
        while room_of_uploads.room() == 100:
            await asyncio.sleep(0.01)
    assert room_of_uploads.room() == 30
    with pytest.raises(UploadError, match="what the disk has free"):
        await room_of_uploads.take("b.mcap", 40, quick(40))
    go_on.set()
    await first
    assert room_of_uploads.room() == 100  # of the disk, which this test holds still
    with pytest.raises(UploadError, match="3 of 40 bytes"):
        await room_of_uploads.take("b.mcap", 40, quick_short())
    assert room_of_uploads.room() == 100


async def test_uploads_that_start_together_do_not_take_the_same_space(
    recordings: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage(recordings.parent)._replace(free=uploads.SPARE_BYTES + 100)
    monkeypatch.setattr(shutil, "disk_usage", lambda _place: usage)

    async def content() -> AsyncIterator[bytes]:
        await asyncio.sleep(0.05)
        yield b"good" + bytes(66)

    together = Uploads(recordings, 1000, AsyncStore(None))
    done = await asyncio.gather(
        *(together.take(f"{name}.mcap", 70, content()) for name in "ab"), return_exceptions=True
    )
    assert sum(isinstance(one, UploadError) for one in done) == 1


async def quick_short() -> AsyncIterator[bytes]:
    yield b"goo"


async def test_without_a_folder_nothing_is_taken() -> None:
    async with running() as (client, _):
        answer = await send(client, b"good")
        assert (answer.status_code, "STEMMAP_FOLDER" in answer.text) == (409, True)


async def test_an_upload_that_breaks_off_leaves_nothing(recordings: Path) -> None:
    uploads = Uploads(recordings, 10**9, AsyncStore(None))

    async def short() -> AsyncIterator[bytes]:
        yield b"good"

    with pytest.raises(UploadError, match="only 4 of 100 bytes arrived"):
        await uploads.take("a.mcap", 100, short())
    begun = asyncio.Event()

    async def endless() -> AsyncIterator[bytes]:
        yield b"good"
        begun.set()
        await asyncio.Event().wait()

    tasks = [asyncio.create_task(uploads.take("a.mcap", 100, endless())) for _ in range(2)]
    await begun.wait()
    with pytest.raises(UploadError, match="2 uploads are under way"):
        await uploads.take("a.mcap", 4, short())
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    assert kept(recordings) == []
    assert (await uploads.take("a.mcap", 4, short()))["bytes"] == 4


async def test_an_upload_that_stalls_is_ended(recordings: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uploads, "_STALLED_S", 0.05)

    async def stalls() -> AsyncIterator[bytes]:
        yield b"good"
        await asyncio.Event().wait()

    with pytest.raises(UploadError, match="no data arrived") as refused:
        await Uploads(recordings, 10**9, AsyncStore(None)).take("a.mcap", 100, stalls())
    assert refused.value.status == 408
    assert kept(recordings) == []


async def test_a_browser_that_leaves_in_the_middle_leaves_nothing(recordings: Path) -> None:
    import uvicorn

    from app.web.serving import bind, uvicorn_config
    from tests.app.server_for_tests import build_app

    settings = Settings(port=0, folder=recordings.parent)
    listening = bind(settings)
    port = listening.getsockname()[1]
    server = uvicorn.Server(uvicorn_config(build_app(settings, port=port)))
    task = asyncio.create_task(server._serve([listening]))
    head = (
        f"POST /api/uploads?name=a.mcap HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n"
        f"Authorization: {BEARER['Authorization']}\r\nContent-Type: application/octet-stream\r\n"
        "Content-Length: 50000000\r\n\r\n"
    )
    async with asyncio.timeout(30):
        _, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(head.encode() + b"good" + bytes(9_000_000))
        await writer.drain()
        while not any(name.startswith(".upload-") for name in kept(recordings)):
            await asyncio.sleep(0.01)
        writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
        writer.close()
        while kept(recordings):
            await asyncio.sleep(0.01)
        server.should_exit = True
        await task


def test_what_a_killed_server_left_is_removed_when_nobody_writes_to_it(recordings: Path) -> None:
    import os

    recordings.mkdir()
    old, new = recordings / ".upload-a.mcap", recordings / ".upload-b.mcap"
    for part in (old, new):
        part.write_bytes(b"x")
    os.utime(old, (time.time() - 7200, time.time() - 7200))
    Uploads(recordings, 1, AsyncStore(None)).clear()
    assert kept(recordings) == [new.name]


def test_a_folder_of_which_a_file_is_being_written_is_not_removed(recordings: Path) -> None:
    import os

    old, active = recordings / ".upload-a", recordings / ".upload-b"
    for part in (old, active):
        (part / "velodyne").mkdir(parents=True)
        (part / "velodyne" / "0.bin").write_bytes(b"x")
        for path in (part / "velodyne" / "0.bin", part / "velodyne", part):
            os.utime(path, (time.time() - 7200, time.time() - 7200))
    os.utime(active / "velodyne" / "0.bin")
    Uploads(recordings, 1, AsyncStore(None)).clear()
    assert kept(recordings) == [active.name]


@pytest.mark.slow
async def test_a_real_file_is_recognised_by_its_contents(tmp_path: Path) -> None:
    from app.cli import main

    run = tmp_path / "run.mcap"
    assert main(["simulate", "stand", "--duration", "1", "--out", str(run)]) == 0
    async with running(Settings(folder=tmp_path)) as (client, _):
        answer = await send(client, run.read_bytes(), "without a suffix")
        assert answer.status_code == 201
        assert "MCAP" in answer.json()["kind"] or "ROS 2" in answer.json()["kind"]
        refused = await send(client, json.dumps({"no": "recording"}).encode(), "run.mcap")
        assert refused.status_code == 422
        assert "mcap" in refused.json()["error"]["what"].lower()
    assert len(kept(tmp_path / "recordings")) == 1
