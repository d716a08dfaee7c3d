"""Feed of state changes to a browser over a websocket."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator

from starlette.websockets import WebSocket, WebSocketDisconnect

from app.dashboard.broadcast import Listener, Live


@contextlib.asynccontextmanager
async def telling(browser: WebSocket, live: Live) -> AsyncIterator[None]:
    """Send all state changes to a browser while the context is active."""
    with live.listener() as listener:
        sending = asyncio.create_task(_send(browser, listener))
        try:
            yield
        finally:
            sending.cancel()
            with contextlib.suppress(asyncio.CancelledError, WebSocketDisconnect, RuntimeError):
                await sending


async def _send(browser: WebSocket, listener: Listener) -> None:
    async for message in listener.messages():
        await browser.send_text(message.decode())
