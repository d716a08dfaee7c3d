"""`stemmap serve` in a real process, with real sockets and signals."""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import socket
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest
import viser
from websockets.asyncio.client import ClientConnection, connect

from app.cli import main
from app.common.settings import Settings
from app.web.serving import bind
from pipeline.errors import StemmapError
from pipeline.io.readers import open_source
from pipeline.io.recording.mcap_writer import write_recording
from tests.app.robot.test_velodyne import turn

ROOT = Path(__file__).resolve().parents[3]
LINK = re.compile(r"stemmap is ready: (http://127\.0\.0\.1:(\d+)/)\?token=(\S+)")


@dataclass
class Server:
    process: asyncio.subprocess.Process
    url: str
    token: str

    @asynccontextmanager
    async def browser(self) -> AsyncIterator[tuple[httpx.AsyncClient, Page]]:
        """A browser that has opened the link."""
        async with httpx.AsyncClient(base_url=self.url, trust_env=False, timeout=30) as client:
            assert (await client.get(f"/?token={self.token}")).status_code == 303
            cookies = "; ".join(f"{name}={value}" for name, value in client.cookies.items())
            headers = {"Cookie": cookies, "Origin": self.url.rstrip("/")}
            url = self.url.replace("http", "ws") + "api/live"
            async with connect(url, additional_headers=headers, proxy=None, max_size=None) as live:
                yield client, Page(live)


async def start(*words: str) -> asyncio.subprocess.Process:
    own = ("STEMMAP_FOLDER",)  # that of the tests, and not of the user who runs them
    environment = {k: v for k, v in os.environ.items() if k in own or not k.startswith("STEMMAP_")}
    return await asyncio.create_subprocess_exec(
        sys.executable,
        "-c",
        "import sys; from app.cli import main; sys.exit(main())",
        *words,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        cwd=ROOT,
        env=environment,
    )


@asynccontextmanager
async def serving(*words: str) -> AsyncIterator[Server]:
    process = await start("serve", "--no-browser", "--port", "0", *words)
    try:
        assert process.stdout is not None
        async with asyncio.timeout(60):
            line = (await process.stdout.readline()).decode()
        found = LINK.match(line)
        assert found, line + (await process.communicate())[1].decode()
        yield Server(process, found[1], found[3])
    finally:
        if process.returncode is None:
            process.kill()
        await process.communicate()


class Page:
    """What a browser knows: the newest message of each kind, and the whole path."""

    def __init__(self, live: ClientConnection) -> None:
        self._live = live
        self.known: dict[str, dict[str, Any]] = {}
        self.path: list[list[float]] = []

    async def until(self, kind: str, is_wanted: Callable[[Any], bool] = lambda _: True) -> Any:
        """The newest message of a kind, once it is as wanted."""
        async with asyncio.timeout(90):
            while kind not in self.known or not is_wanted(self.known[kind]):
                message = json.loads(await self._live.recv())
                self.known[message["type"]] = message
                if message["type"] == "map":
                    assert message["path"]["start"] <= len(self.path)
                    self.path[message["path"]["start"] :] = message["path"]["points"]
        return self.known[kind]

    async def state(self, state: str) -> Any:
        return await self.until("status", lambda status: status["state"] == state)

    async def scan(self, index: int) -> Any:
        return await self.until("map", lambda shown: shown["index"] == index)

    async def passed(self, index: int) -> Any:
        return await self.until("map", lambda shown: shown["index"] >= index)


def children(server: Server) -> list[int]:
    pid = server.process.pid
    return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


async def test_a_whole_session_over_sockets() -> None:
    async with serving("sim:stand?duration=20") as server, server.browser() as (client, page):
        assert (await client.get("/")).status_code == 200
        await page.until("map")
        assert (await page.until("truth"))["trees"]
        await client.post("/api/command", json={"type": "pause"})
        await page.state("paused")
        await client.post("/api/command", json={"type": "seek", "time_s": 6.0})
        before = (await page.scan(60))["verdicts"]
        assert len(page.path) == 61
        changed = await client.patch("/api/parameters", json={"changes": {"clustering.eps": 0.9}})
        assert changed.status_code == 200
        assert (await page.until("map", lambda shown: shown["verdicts"] != before))["index"] == 60
        assert (await page.until("parameters"))["changed"] == ["clustering.eps"]
        refused = await client.post("/api/open", json={"uri": "no/such/file.mcap"})
        assert (refused.status_code, refused.json()["error"]["where"]) == (409, "no/such/file.mcap")
        assert (await client.get("/api/status")).json()["scan_index"] == 60
        await client.post("/api/open", json={"uri": "sim:paper", "seed": 2})
        await page.until("status", lambda s: s["source"] == "sim:paper" and s["state"] == "playing")
        await page.passed(2)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="the system does not list loaded libraries")
async def test_the_web_process_shows_a_recording_without_numerical_libraries(tmp_path: Path) -> None:
    recording, source = tmp_path / "drive.mcap", open_source("sim:stand?duration=6")
    known = source.description
    write_recording(recording, source.records(), sensor=known.sensor, T_base_lidar=known.T_base_lidar)
    async with serving(str(recording)) as server, server.browser() as (_, page):
        await page.until("map", lambda shown: len(shown["trees"]) > 3)
        loaded = Path(f"/proc/{server.process.pid}/maps").read_text(encoding="utf-8")
        assert not [name for name in ("llvmlite", "scipy", "sklearn", "open3d") if f"/{name}/" in loaded]


@pytest.mark.slow
async def test_a_killed_worker_is_replaced_under_the_page() -> None:
    async with serving("sim:stand?duration=20") as server, server.browser() as (client, page):
        await page.passed(5)
        os.kill(children(server)[0], signal.SIGKILL)
        assert "SIGKILL" in (await page.state("failed"))["detail"]
        assert "started again" in (await page.state("paused"))["detail"]
        await page.scan(0)
        assert len(page.path) == 1
        await client.post("/api/command", json={"type": "play"})
        await page.passed(3)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
async def test_a_signal_ends_server_and_worker_without_output(number: signal.Signals) -> None:
    async with serving("sim:stand?duration=20") as server, server.browser() as (_, page):
        await page.until("map")
        workers = children(server)
        server.process.send_signal(number)
        async with asyncio.timeout(20):
            _, errors = await server.process.communicate()
        assert server.process.returncode == 0
        assert errors.decode() == ""
        assert len(workers) == 1
        assert not runs(workers[0])


@pytest.mark.slow
async def test_the_recording_is_named_at_the_end(tmp_path: Path) -> None:
    file = tmp_path / "run.pcap"
    with socket.socket(type=socket.SOCK_DGRAM) as sender:
        sender.bind(("127.0.0.1", 0))
        port = sender.getsockname()[1]
    async with (
        serving(f"velodyne:127.0.0.1:{port}", "--record", str(file)) as server,
        server.browser() as (client, _),
    ):
        with socket.socket(type=socket.SOCK_DGRAM) as sender:
            async with asyncio.timeout(60):
                while not (await client.get("/api/status")).json()["recording"] or not file.stat().st_size:
                    for packet in turn():
                        sender.sendto(packet, ("127.0.0.1", port))
                    await asyncio.sleep(0.1)
        server.process.send_signal(signal.SIGINT)
        async with asyncio.timeout(20):
            output, errors = await server.process.communicate()
        assert errors.decode() == ""
        assert output.decode().endswith(f"Recording: {file}\n")


@pytest.mark.slow
async def test_a_browser_that_never_reads_leaves_no_traceback_at_the_end() -> None:
    async with serving("sim:stand?duration=20") as server, server.browser() as (_, page):
        address = httpx.URL(server.url)
        _, writer = await asyncio.open_connection(address.host, address.port, limit=1)
        headers = {
            "Host": f"{address.host}:{address.port}",
            "Authorization": f"Bearer {server.token}",
            "Upgrade": "websocket",
            "Connection": "Upgrade",
            "Sec-WebSocket-Version": "13",
            "Sec-WebSocket-Key": "MDEyMzQ1Njc4OWFiY2RlZg==",
            "Sec-WebSocket-Protocol": f"viser-v{viser.__version__}",
        }
        lines = ["GET /viser/ HTTP/1.1", *(f"{name}: {value}" for name, value in headers.items())]
        writer.write("\r\n".join([*lines, "", ""]).encode())
        await page.passed(30)
        server.process.send_signal(signal.SIGTERM)
        async with asyncio.timeout(20):
            _, errors = await server.process.communicate()
        writer.close()
        assert server.process.returncode == 0
        assert errors.decode() == ""


def runs(pid: int) -> bool:
    """Whether a process is there and more than a corpse that nobody has fetched yet."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes() != b""
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["serve", "--host", "203.0.113.9", "--port", "0"], 1, "an address of this machine with --host"),
        (["serve", "~nobody-of-this-name/x"], 1, "no such file or folder (~nobody-of-this-name/x)"),
        (["serve", ""], 2, "the source is empty"),
    ],
)
def test_a_wrong_start_prints_one_line(
    words: list[str], code: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == code
    errors = capsys.readouterr().err
    assert said in errors
    assert len(errors.strip().splitlines()) == 1


async def test_a_port_in_use_prints_one_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        process = await start("serve", "--no-browser", "--port", str(taken.getsockname()[1]))
        async with asyncio.timeout(60):
            _, errors = await process.communicate()
    assert process.returncode == 1
    told = errors.decode()
    assert "address already in use" in told
    assert "--port" in told
    assert len(told.strip().splitlines()) == 1


@pytest.mark.slow
async def test_the_browser_is_started_without_the_token_and_no_file_remains(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A browser of our own writes down what it was called with, and what it read there."""
    seen = tmp_path / "seen"
    browser = tmp_path / "browser"
    browser.write_text(
        "#!/bin/sh\n"
        f'file="${{1#file://}}"\necho "$1" > {seen}.new\nstat -c %a "$file" >> {seen}.new\n'
        f'cat "$file" >> {seen}.new\nmv {seen}.new {seen}\n'
    )
    browser.chmod(0o755)
    monkeypatch.setenv("DISPLAY", ":99")
    monkeypatch.setenv("BROWSER", str(browser))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    process = await start("serve", "--port", "0", "sim:stand?duration=20")
    try:
        assert process.stdout is not None
        async with asyncio.timeout(60):
            found = LINK.match((await process.stdout.readline()).decode())
            while not seen.exists():
                await asyncio.sleep(0.05)
        assert found
        address, rights, page = seen.read_text().split("\n", 2)
        assert found[3] not in address
        assert rights == "600"
        assert f"url={found[1]}?token={found[3]}" in page
        process.send_signal(signal.SIGTERM)
        async with asyncio.timeout(20):
            await process.wait()
        assert list(tmp_path.glob("stemmap-*")) == []
    finally:
        if process.returncode is None:
            process.kill()
        await process.communicate()


def test_without_a_port_the_next_free_one_is_taken(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        first = taken.getsockname()[1]
        monkeypatch.setattr("app.web.serving.DEFAULT_PORT", first)
        with bind(Settings()) as listening:
            port = listening.getsockname()[1]
            assert first < port < first + 10
            assert f"Port {first} is in use; {port} is taken" in capsys.readouterr().out
        with pytest.raises(StemmapError, match=f"127.0.0.1:{first}"):
            bind(Settings(port=first))
