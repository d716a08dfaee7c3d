"""`stemmap serve` as a person runs it: a real process, real sockets, real signals."""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import socket
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest
from websockets.asyncio.client import ClientConnection, connect

from app.serving import bind
from app.settings import Settings
from pipeline.errors import StemmapError

ROOT = Path(__file__).resolve().parents[2]
LINK = re.compile(r"stemmap is ready: (http://127\.0\.0\.1:(\d+)/)\?token=(\S+)")


@dataclass
class Server:
    process: asyncio.subprocess.Process
    url: str
    token: str

    async def cookie(self) -> httpx.AsyncClient:
        """A browser that has opened the link."""
        client = httpx.AsyncClient(base_url=self.url, trust_env=False, timeout=30)
        answer = await client.get(f"/?token={self.token}")
        assert answer.status_code == 303
        return client

    def live(self, client: httpx.AsyncClient) -> connect:
        cookies = "; ".join(f"{name}={value}" for name, value in client.cookies.items())
        headers = {"Cookie": cookies, "Origin": self.url.rstrip("/")}
        url = self.url.replace("http", "ws") + "api/live"
        return connect(url, additional_headers=headers, proxy=None, max_size=None)


async def start(*words: str) -> asyncio.subprocess.Process:
    environment = {k: v for k, v in os.environ.items() if not k.startswith("STEMMAP_")}
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


async def until(live: ClientConnection, kind: str, **wanted: Any) -> dict[str, Any]:
    """The first message of a kind with these values."""
    async with asyncio.timeout(90):
        while True:
            message: dict[str, Any] = json.loads(await live.recv())
            if message["type"] == kind and all(message.get(k) == v for k, v in wanted.items()):
                return message


async def test_a_whole_session_over_sockets() -> None:
    async with serving("sim:stand?duration=20") as server:
        client = await server.cookie()
        assert (await client.get("/")).status_code == 200
        async with server.live(client) as live:
            await until(live, "map")
            assert (await until(live, "truth"))["trees"]
            await client.post("/api/command", json={"type": "pause"})
            await until(live, "status", state="paused")
            await client.post("/api/command", json={"type": "seek", "time_s": 6.0})
            shown = await until(live, "map", index=60)
            assert shown["trees"]
            assert shown["path"]["start"] + len(shown["path"]["points"]) == 61
            changed = await client.patch("/api/parameters", json={"changes": {"clustering.eps": 0.9}})
            assert changed.status_code == 200
            again = await until(live, "map", index=60)
            assert again["verdicts"] != shown["verdicts"]
            assert (await until(live, "parameters"))["changed"] == ["clustering.eps"]
            await client.post("/api/open", json={"uri": "no/such/file.mcap"})
            assert "no/such/file.mcap" in (await until(live, "status", state="failed"))["detail"]
            await client.post("/api/open", json={"uri": "sim:paper", "seed": 2})
            await until(live, "map")
            assert (await client.get("/api/status")).json()["source"] == "sim:paper"
        await client.aclose()


async def test_a_killed_worker_is_replaced_under_the_page() -> None:
    async with serving("sim:stand?duration=20") as server:
        client = await server.cookie()
        async with server.live(client) as live:
            await until(live, "map")
            children = (
                Path(f"/proc/{server.process.pid}/task/{server.process.pid}/children").read_text().split()
            )
            os.kill(int(children[0]), signal.SIGKILL)
            assert "SIGKILL" in (await until(live, "status", state="failed"))["detail"]
            standing = await until(live, "map", index=0)
            assert standing["path"]["start"] == 0
            assert "started again" in (await until(live, "status", state="paused"))["detail"]
            await client.post("/api/command", json={"type": "play"})
            await until(live, "map", index=3)
        await client.aclose()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
async def test_a_signal_ends_all_of_it_quietly(number: signal.Signals) -> None:
    async with serving("sim:stand?duration=20") as server:
        client = await server.cookie()
        async with server.live(client) as live:
            await until(live, "map")
            children = (
                Path(f"/proc/{server.process.pid}/task/{server.process.pid}/children").read_text().split()
            )
            server.process.send_signal(number)
            async with asyncio.timeout(20):
                _, errors = await server.process.communicate()
        await client.aclose()
        assert server.process.returncode == 0
        assert errors.decode() == ""
        for child in children:
            assert (
                not Path(f"/proc/{child}/cmdline").exists() or not Path(f"/proc/{child}/cmdline").read_bytes()
            )


async def ended(*words: str) -> tuple[int | None, str]:
    process = await start(*words)
    async with asyncio.timeout(60):
        _, errors = await process.communicate()
    return process.returncode, errors.decode()


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["no/such/run.mcap"], 1, "there is no such file or folder (no/such/run.mcap)"),
        (["serve", "--port", "x"], 2, "not a port"),
        (["serve", "--preset", "best"], 2, "no preset 'best'"),
        (["serve", "--set", "clustering.eps=99"], 2, "clustering.eps"),
        (["serve", "--host", "203.0.113.9", "--port", "0"], 1, "cannot listen"),
    ],
)
async def test_a_wrong_start_is_one_line(words: list[str], code: int, said: str) -> None:
    returned, errors = await ended(*words)
    assert returned == code
    assert said in errors
    assert len(errors.strip().splitlines()) == 1


async def test_a_port_in_use_is_one_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        returned, errors = await ended("serve", "--no-browser", "--port", str(port))
    assert returned == 1
    assert "address already in use" in errors
    assert "--port" in errors
    assert len(errors.strip().splitlines()) == 1


def test_without_a_port_the_next_free_one_is_taken(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        first = taken.getsockname()[1]
        monkeypatch.setattr("app.serving.DEFAULT_PORT", first)
        with bind(Settings()) as listening:
            port = listening.getsockname()[1]
            assert first < port < first + 10
            assert f"Port {first} is in use; {port} is taken" in capsys.readouterr().out
        with pytest.raises(StemmapError, match=f"127.0.0.1:{first}"):
            bind(Settings(port=first))
