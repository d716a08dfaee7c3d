"""Browsers without rendering: each reads both websockets of the page as fast as possible.

`python -m tests.benchmarks.served.browsers PORT TOKEN` answers each line of JSON on stdin with one on stdout.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
import time
from collections.abc import AsyncIterator
from typing import Any

import httpx
import viser
from websockets.asyncio.client import ClientConnection, connect
from websockets.typing import Subprotocol

from tests.benchmarks.child import answers

_CLOUD_BYTES = 10_000  # messages of viser with points of a scan are larger, those of sliders are smaller
_LONGEST_S = 60.0
_EXPORT_S = 300.0


class Browser:
    """One page: times at which it received each scan, and at which its scene received points [s]."""

    def __init__(self, port: int, token: str) -> None:
        self._address, self._headers = f"ws://127.0.0.1:{port}", {"Authorization": f"Bearer {token}"}
        self.maps: list[tuple[int, float]] = []
        self.clouds: list[float] = []
        self._tasks = [asyncio.create_task(self._page()), asyncio.create_task(self._scene())]

    async def leave(self) -> None:
        """Close the page."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _page(self) -> None:
        async with self._open("/api/live") as live:
            async for message in live:
                if message[:13] == '{"type":"map"':
                    self.maps.append((int(json.loads(message)["index"]), time.monotonic()))

    async def _scene(self) -> None:
        async with self._open("/viser/", Subprotocol(f"viser-v{viser.__version__}")) as scene:
            async for message in scene:
                if len(message) > _CLOUD_BYTES:
                    self.clouds.append(time.monotonic())

    @contextlib.asynccontextmanager
    async def _open(self, path: str, *protocols: Subprotocol) -> AsyncIterator[ClientConnection]:
        async with connect(
            self._address + path,
            subprotocols=protocols or None,
            additional_headers=self._headers,
            compression=None,
            max_size=None,
            proxy=None,
        ) as connection:
            yield connection


class Browsers:
    """All browsers, and the actions of a user."""

    def __init__(self, port: int, token: str) -> None:
        self._port, self._token = port, token
        self._open: list[Browser] = []
        self._web = httpx.AsyncClient(
            base_url=f"http://127.0.0.1:{port}",
            headers={"Authorization": f"Bearer {token}"},
            timeout=_LONGEST_S,
            # A connection that stays open may be closed by the server while the next request is on its way.
            limits=httpx.Limits(max_keepalive_connections=0),
        )

    async def answer(self, question: dict[str, Any]) -> dict[str, Any]:
        """Execute a request."""
        match question:
            case {"do": "browsers", "count": count}:
                while len(self._open) > count:
                    await self._open.pop().leave()
                while len(self._open) < count:
                    self._open.append(Browser(self._port, self._token))
                return {}
            case {"do": "heard"}:
                told = [[browser.maps, browser.clouds] for browser in self._open]
                for browser in self._open:
                    browser.maps, browser.clouds = [], []
                return {"browsers": told}
            case {"do": "command", "command": command}:
                (await self._web.post("/api/command", json=command)).raise_for_status()
                return {}
            case {"do": "open", "uri": uri}:
                return {"code": (await self._web.post("/api/open", json={"uri": uri})).status_code}
            case {"do": "get", "path": path}:
                return {"code": (await self._web.get(path, timeout=_EXPORT_S)).status_code}
            case {"do": "status"}:
                status: dict[str, Any] = (await self._web.get("/api/status")).json()
                return status
            case {"do": "change", "changes": changes}:
                return await self._change(changes)
            case {"do": "go", "command": command, "index": index}:
                return await self._go(command, index)
            case {"do": "late"}:
                return await self._late()
        raise ValueError(question)

    async def _change(self, changes: dict[str, float]) -> dict[str, Any]:
        """Move a slider while the run stands; milliseconds until the first browser has the answer."""
        (browser, *_) = self._open
        browser.maps, browser.clouds = [], []
        start = time.monotonic()
        sending = asyncio.create_task(self._web.patch("/api/parameters", json={"changes": changes}))
        await _until(lambda: bool(browser.maps and browser.clouds))
        (await sending).raise_for_status()
        return {"map": 1e3 * (browser.maps[0][1] - start), "scene": 1e3 * (browser.clouds[0] - start)}

    async def _go(self, command: dict[str, Any], index: int) -> dict[str, Any]:
        """Step or seek to a scan while the run stands; milliseconds until the first browser has it."""
        (browser, *_) = self._open
        browser.maps, browser.clouds = [], []
        start = time.monotonic()
        sending = asyncio.create_task(self._web.post("/api/command", json=command))
        await _until(lambda: any(each == index for each, _ in browser.maps))
        shown = next(at for each, at in browser.maps if each == index)
        # The scene is drawn after the map is sent; earlier points belong to an intermediate scan.
        await _until(lambda: any(at >= shown for at in browser.clouds))
        drawn = next(at for at in browser.clouds if at >= shown)
        (await sending).raise_for_status()
        return {"map": 1e3 * (shown - start), "scene": 1e3 * (drawn - start)}

    async def _late(self) -> dict[str, Any]:
        """Seconds until a browser that connects later has the map and the points of the scan."""
        start = time.monotonic()
        late = Browser(self._port, self._token)
        await _until(lambda: bool(late.maps and late.clouds))
        told = {"map": late.maps[0][1] - start, "scene": late.clouds[0] - start}
        await late.leave()
        return told


async def _until(holds: Any) -> None:
    async with asyncio.timeout(_LONGEST_S):
        while not holds():
            await asyncio.sleep(0.002)


async def _main(port: int, token: str) -> None:
    browsers = Browsers(port, token)
    with answers() as pipe:
        while line := await asyncio.to_thread(sys.stdin.readline):
            pipe.write(json.dumps(await browsers.answer(json.loads(line))) + "\n")
            pipe.flush()
        await browsers.answer({"do": "browsers", "count": 0})


if __name__ == "__main__":
    asyncio.run(_main(int(sys.argv[1]), sys.argv[2]))
