"""Connections that send their header slowly, or no request at all, are closed."""

from __future__ import annotations

import asyncio
import contextlib

import httpx
import pytest

from app.web import serving
from tests.app.server_for_tests import BEARER, served

HEADER_S = 0.6


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serving, "HEADER_S", HEADER_S)


async def connect(host: str) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    return await asyncio.open_connection(*host.split(":"))


async def slow_header(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> float:
    """Send a header byte by byte until the server closes the connection; return how long it took [s]."""
    loop = asyncio.get_running_loop()
    begun = loop.time()
    with contextlib.suppress(ConnectionError):
        for byte in b"GET / HTTP/1.1\r\nHost: x\r\n" + b"X: " + b"y" * 200:
            writer.write(bytes([byte]))
            await writer.drain()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(0.05):
                    if await reader.read(1000) == b"":
                        break
    writer.close()
    return loop.time() - begun


async def test_a_header_that_arrives_byte_by_byte_ends_the_connection() -> None:
    async with served() as (host, _):
        times = await asyncio.gather(*[slow_header(*await connect(host)) for _ in range(20)])
        assert max(times) < HEADER_S + 2.0
        assert min(times) > 0.5 * HEADER_S


async def test_the_limit_holds_for_the_second_request_of_a_connection() -> None:
    async with served() as (host, _):
        reader, writer = await connect(host)
        writer.write(f"GET /api/status HTTP/1.1\r\nHost: {host}\r\n".encode())
        writer.write(f"Authorization: {BEARER['Authorization']}\r\n\r\n".encode())
        assert (await reader.readline()).startswith(b"HTTP/1.1 200")
        await asyncio.sleep(0.1)
        await reader.read(10_000)
        assert await slow_header(reader, writer) < HEADER_S + 2.0


async def test_a_request_whose_answer_takes_longer_is_not_closed() -> None:
    async with served() as (host, _), httpx.AsyncClient(base_url=f"http://{host}", headers=BEARER) as client:

        async def slow_body() -> object:
            yield b'{"type": '
            await asyncio.sleep(2 * HEADER_S)
            yield b'"pause"}'

        headers = {"Content-Type": "application/json"}
        reply = await client.post("/api/command", content=slow_body(), headers=headers)  # type: ignore[arg-type]
        assert reply.status_code == 202
        assert (await client.get("/api/status")).status_code == 200


async def test_connections_without_a_request_are_limited_per_address(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serving, "MOST_WAITING", 5)
    monkeypatch.setattr(serving, "HEADER_S", 30.0)
    async with served() as (host, _):
        held = [await connect(host) for _ in range(5)]
        await asyncio.sleep(0.1)
        reader, refused = await connect(host)
        with contextlib.suppress(ConnectionError):
            assert await reader.read(1) == b""
        refused.close()
        held[0][1].close()
        await asyncio.sleep(0.1)
        async with httpx.AsyncClient(base_url=f"http://{host}", headers=BEARER) as client:
            assert (await client.get("/api/status")).status_code == 200
        for _, writer in held:
            writer.close()


UPGRADE = (
    "GET /api/live HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)


@pytest.mark.parametrize("request_text", ["GARBAGE\r\n\r\n", UPGRADE], ids=["no HTTP", "no token"])
async def test_a_refused_client_prints_nothing(request_text: str, capsys: pytest.CaptureFixture[str]) -> None:
    async with served() as (host, _):
        reader, writer = await connect(host)
        writer.write(request_text.format(host=host).encode())
        assert (await reader.read(100)).startswith(b"HTTP/1.1 40")
        writer.close()
        await asyncio.sleep(0.2)
    told = capsys.readouterr()
    assert told.out + told.err == ""
