"""Faults of the link to a robot: a TCP proxy delays, slows down, stalls and cuts the connection."""

from __future__ import annotations

import contextlib
import json
import selectors
import socket
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from queue import SimpleQueue

from tests.app.robot.conftest import free_port
from tests.benchmarks.campaign import Result
from tests.benchmarks.campaign.kills import ROBOT, drive_in, started
from tests.benchmarks.campaign.service import Service, check_recording

FAULTS = ("delay", "stall", "slow", "cut")
_DELAY_S, _STALL_S, _CUT_S = 0.3, 4.0, 2.0
_SLOW_BYTES_PER_S = 500_000  # a tenth of the data rate of the robot
_PART = 65_536


class Proxy:
    """Passes connections of a port on to another port, each direction in a thread.

    Args:
        target: Port on this machine.
        fault: Fault of the link while `is_faulty`.
    """

    def __init__(self, target: int, fault: str) -> None:
        self._target, self._fault = target, fault
        self.is_faulty = False
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listening.getsockname()[1])
        self._open: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        """End all connections."""
        for each in self._open:
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()
        self._open.clear()

    def close(self) -> None:
        """End all connections and accept no more."""
        self._listening.close()
        self.cut()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listening.accept()
                if self.is_faulty and self._fault == "cut":
                    client.close()
                    continue
                server = socket.create_connection(("127.0.0.1", self._target))
                self._open += [client, server]
                for source, sink in ((client, server), (server, client)):
                    threading.Thread(target=self._pass_on, args=(source, sink), daemon=True).start()

    def _pass_on(self, source: socket.socket, sink: socket.socket) -> None:
        """Pass one direction of a connection on until it ends. A delayed part waits in a queue, so that the
        link keeps its throughput."""
        parts = SimpleQueue[tuple[float, bytes]]()
        threading.Thread(target=self._send, args=(parts, sink), daemon=True).start()
        with contextlib.suppress(OSError), selectors.DefaultSelector() as ready:
            ready.register(source, selectors.EVENT_READ)
            while True:
                ready.select()
                part = source.recv(_PART)
                if part and self.is_faulty and self._fault == "slow":
                    time.sleep(len(part) / _SLOW_BYTES_PER_S)
                while self.is_faulty and self._fault == "stall":
                    time.sleep(0.05)
                delay = _DELAY_S if self.is_faulty and self._fault == "delay" else 0.0
                parts.put((time.monotonic() + delay, part))
                if not part:
                    return
        parts.put((0.0, b""))

    def _send(self, parts: SimpleQueue[tuple[float, bytes]], sink: socket.socket) -> None:
        """Send each part at its time; an empty part ends the connection."""
        with contextlib.suppress(OSError):
            while True:
                due, part = parts.get()
                time.sleep(max(due - time.monotonic(), 0.0))
                if not part:
                    sink.shutdown(socket.SHUT_WR)
                    return
                sink.sendall(part)


def run(turn: int, folder: Path) -> Result:
    """Map and record a robot behind a link with one fault. The run must continue, and the file must be
    complete."""
    result, fault, place = Result(1), FAULTS[turn % len(FAULTS)], folder / f"network{turn}"
    with ExitStack() as stack:
        port = free_port()
        started(stack, "-m", "tests.app.robot.router", str(port))
        proxy = Proxy(port, fault)
        stack.callback(proxy.close)
        robot = started(stack, "-m", "tests.benchmarks.live_robot", str(port), str(drive_in(folder)), ROBOT)
        uri = f"zenoh:tcp/127.0.0.1:{proxy.port}?robot={ROBOT}"
        service = stack.enter_context(Service(result, uri, place, "--record", str(place / "live.mcap")))
        service.until_found()
        mapping = service.worker()
        robot.go()
        service.until_scan(20)
        proxy.is_faulty = True
        if fault == "cut":
            proxy.cut()
        time.sleep({"stall": _STALL_S, "cut": _CUT_S}.get(fault, 6.0))
        before = service.scan()
        proxy.is_faulty = False
        sent = json.loads(robot.hear())["sent"]
        if before < sent - 20:
            service.until_scan(before + 1)
        if service.worker() != mapping:
            result.faults.append("the mapping process was started again")
    kept = check_recording(result, place / "live.mcap", period_s=1e6 if fault != "delay" else 0.1)
    if fault == "delay" and kept < sent:
        result.faults.append(f"{kept} of {sent} scans recorded over a link that only delays")
    return result
