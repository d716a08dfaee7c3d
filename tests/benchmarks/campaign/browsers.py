"""Browsers that connect and disconnect; some of them never read."""

from __future__ import annotations

import random
import socket
import time
from contextlib import ExitStack, suppress
from pathlib import Path

import viser
from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from tests.benchmarks.campaign import Result
from tests.benchmarks.campaign.service import SHORT_RUN, TOKEN, Service
from tests.benchmarks.machine import resident_mib

CONNECTIONS, SECONDS = 60, 20.0
MOST_GROWTH_MIB = 100.0  # queues of twelve browsers that do not read
_AT_ONCE = 12


def run(turn: int, folder: Path) -> Result:
    """Open and close connections while a run plays. The run must continue, and its map must be that without
    browsers."""
    result, rng = Result(), random.Random(turn)
    with Service(result, SHORT_RUN, folder / f"browsers{turn}") as service, ExitStack() as stack:
        undisturbed = service.map_of(SHORT_RUN)
        service.ask("POST", "/api/open", {"uri": "sim:stand?duration=600"})
        service.ask("POST", "/api/command", {"type": "set_speed", "factor": 1.0})
        service.until_scan(10)
        before_mib, before = resident_mib(service.process.pid), service.scan()
        there: list[ClientConnection] = []
        end = time.monotonic() + SECONDS
        while result.done < CONNECTIONS and time.monotonic() < end:
            with suppress(OSError, WebSocketException):
                there.append(_browser(service.port, rng, stack))
            result.done += 1
            for browser in there[: len(there) // 2]:
                with suppress(OSError, WebSocketException, TimeoutError):
                    browser.recv(timeout=0.01)
            if len(there) > _AT_ONCE:
                gone = there.pop(rng.randrange(len(there)))
                if rng.random() < 0.5:
                    gone.socket.shutdown(socket.SHUT_RDWR)  # as a cable that is pulled
                else:
                    gone.close()
            service.ask("GET", "/api/status")
            time.sleep(0.1)
        grown = resident_mib(service.process.pid) - before_mib
        if grown > MOST_GROWTH_MIB:
            result.faults.append(f"the server grew by {grown:.0f} MiB")
        if service.scan() <= before:
            result.faults.append("mapping stood still")
        for browser in there:
            browser.socket.shutdown(socket.SHUT_RDWR)
        if service.map_of(SHORT_RUN) != undisturbed:
            result.faults.append("another map than before the browsers")
    return result


def _browser(port: int, rng: random.Random, stack: ExitStack) -> ClientConnection:
    """Open one of the two websockets of a page."""
    is_scene = rng.random() < 0.5
    protocols = [Subprotocol(f"viser-v{viser.__version__}")] if is_scene else None
    browser = connect(
        f"ws://127.0.0.1:{port}{'/viser/' if is_scene else '/api/live'}",
        additional_headers={"Authorization": f"Bearer {TOKEN}"},
        subprotocols=protocols,
        compression=None,
        max_size=None,
        max_queue=1,
        proxy=None,
        close_timeout=1.0,
        ping_interval=None,
    )
    stack.callback(browser.socket.close)
    return browser
