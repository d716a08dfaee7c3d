"""How long a person waits: for the help, and for the first scan on the dashboard."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import IO
from urllib.parse import parse_qs, urlsplit

from pipeline.errors import StemmapError
from tests.benchmarks.table import Cell, Table, verdict
from tests.benchmarks.timing import middle

NAME = "start"
LINE = (
    "Time of `stemmap --help`, and from a start to the first scan on the dashboard, warm and on a new machine"
)

ROOT = Path(__file__).resolve().parents[3]
HELP_S, DASHBOARD_S, NEW_S = 0.5, 10.0, 30.0  # asked for
HELP_ROUNDS, DASHBOARD_ROUNDS, NEW_ROUNDS = 11, 3, 3
LONGEST_S = 300.0
NO_SETTINGS: Mapping[str, str] = MappingProxyType({})


def run() -> list[Table]:
    """Both, each once before for warmth."""
    help_s = [seconds_of_help() for _ in range(HELP_ROUNDS + 1)][1:]
    rows = [_row("stemmap --help", help_s, HELP_S)]
    notes = ["Whole processes; the first start, which warms the disk's cache, is left out."]
    if find_spec("app.cli.serve") is not None:
        waits = [seconds_to_link_and_first_scan() for _ in range(DASHBOARD_ROUNDS + 1)][1:]
        rows.append(_row("stemmap serve sim:stand, to its link", [link for link, _ in waits], None))
        rows.append(_row("the same, to its first scan", [shown for _, shown in waits], DASHBOARD_S))
        notes.append(
            "The first scan is there when /api/status tells of one; a browser's own start is not in it."
        )
        rows.append(_row("the same, without compiled kernels", new_machine(), NEW_S))
        notes.append("Without compiled kernels: as in the first start of a clone.")
    columns = ("start", "times", "median s", "slowest s", "asked for s", "by the median")
    return [Table("Waiting times", columns, tuple(rows), tuple(notes))]


def new_machine() -> list[float]:
    """Seconds to the first scan, each time from a copy of the sources without compiled kernels."""
    waits = []
    for _ in range(NEW_ROUNDS):
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as clone:
            for name in ("app", "pipeline", "static"):
                shutil.copytree(ROOT / name, Path(clone) / name, ignore=shutil.ignore_patterns("*.nb[ci]"))
            waits.append(seconds_to_link_and_first_scan({"PYTHONPATH": clone})[1])
    return waits


def _row(name: str, seconds: list[float], asked: float | None) -> tuple[Cell, ...]:
    reached = "" if asked is None else verdict(middle(seconds) <= asked)
    return name, len(seconds), middle(seconds), max(seconds), asked, reached


def command(*words: str) -> list[str]:
    """The installed command, or the same by way of Python where there is none."""
    script = Path(sys.executable).with_name("stemmap")
    by_python = [sys.executable, "-c", "import sys; from app.cli import main; sys.exit(main())"]
    return [str(script), *words] if script.is_file() else [*by_python, *words]


def seconds_of_help() -> float:
    """From nothing to the end of `stemmap --help`."""
    start = time.perf_counter()
    subprocess.run(command("--help"), stdout=subprocess.DEVNULL, timeout=LONGEST_S, check=True)
    return time.perf_counter() - start


def seconds_to_link_and_first_scan(settings: Mapping[str, str] = NO_SETTINGS) -> tuple[float, float]:
    """From nothing to the printed link, and to the first scan in /api/status, with more settings of the
    environment.

    Raises:
        StemmapError: It did not come.
    """
    start = time.perf_counter()
    server = subprocess.Popen(
        command("serve", "sim:stand", "--no-browser", "--port", "0"),
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1", **settings},
    )
    try:
        if server.stdout is None:
            raise StemmapError("the dashboard has no pipe")
        link = _first_link(server.stdout, start + LONGEST_S)
        linked = time.perf_counter() - start
        while time.perf_counter() < start + LONGEST_S:
            if server.poll() is None and _scan_index(link) >= 0:
                return linked, time.perf_counter() - start
            time.sleep(0.02)
        raise StemmapError(f"the dashboard showed no scan within {LONGEST_S:g} s")
    finally:
        _end(server)


def _first_link(lines: IO[str], until: float) -> str:
    """The link that the server prints; a thread reads, so that a silent server cannot hold us."""
    read: queue.Queue[str] = queue.Queue()
    threading.Thread(target=_read_into, args=(lines, read), daemon=True).start()
    while time.perf_counter() < until:
        with contextlib.suppress(queue.Empty):
            words = read.get(timeout=0.5).split()
            links = [word for word in words if word.startswith("http://") and "token=" in word]
            if links:
                return links[0]
    raise StemmapError(f"the dashboard printed no link within {LONGEST_S:g} s")


def _read_into(lines: IO[str], read: queue.Queue[str]) -> None:
    for line in lines:
        read.put(line)


def _scan_index(link: str) -> int:
    parts = urlsplit(link)
    token = parse_qs(parts.query)["token"][0]
    request = urllib.request.Request(
        f"http://{parts.netloc}/api/status", headers={"Authorization": f"Bearer {token}"}
    )
    try:
        with urllib.request.urlopen(request, timeout=5.0) as reply:  # noqa: S310
            return int(json.load(reply).get("scan_index", -1))
    except urllib.error.HTTPError as error:
        raise StemmapError(f"the dashboard answered {error.code}", where="/api/status") from None
    except OSError:
        return -1


def _end(server: subprocess.Popen[str]) -> None:
    server.terminate()
    try:
        server.wait(10.0)
    except subprocess.TimeoutExpired:
        server.kill()
        server.wait()
