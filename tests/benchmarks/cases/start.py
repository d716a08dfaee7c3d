"""Waiting times of a user: for the help, and for points, a scan and trees on the dashboard."""

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
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import IO, Any
from urllib.parse import parse_qs, urlsplit

from pipeline.errors import StemmapError
from tests.benchmarks.process import CLONE
from tests.benchmarks.table import Cell, Table, verdict
from tests.benchmarks.timing import middle

NAME = "start"
LINE = (
    "Time of `stemmap --help`, and from a start to the link, points, the first scan and trees on the "
    "dashboard, warm and on a new machine"
)

ROOT = Path(__file__).resolve().parents[3]
HELP_S, DASHBOARD_S, NEW_S = 0.5, 10.0, 30.0  # asked for
HELP_ROUNDS, DASHBOARD_ROUNDS, NEW_ROUNDS = 11, 3, 3
LONGEST_S = 900.0


@dataclass(frozen=True, slots=True)
class Moment:
    """Time at which something was observed.

    Attributes:
        s: Time since the command [s].
        cpu_s: CPU time of all processes of the program until then [s].
    """

    s: float
    cpu_s: float


#: Events that a user waits for, in this order, with the words of the table.
WAITS = {
    "link": "its link",
    "points": "points in the scene",
    "scan": "the first scan",
    "trees": "the first trees",
}


def run() -> list[Table]:
    """Run both benchmarks; a first run of each, which fills the caches, is not counted."""
    clone = Path(os.environ.get(CLONE, ROOT))
    help_s = [seconds_of_help() for _ in range(HELP_ROUNDS + 1)][1:]
    rows = [_row("stemmap --help", help_s, None, HELP_S)]
    notes = ["Whole processes; the first start, which warms the disk's cache, is left out."]
    if find_spec("app.cli.serve") is not None:
        warm = [moments({"PYTHONPATH": str(clone)}) for _ in range(DASHBOARD_ROUNDS + 1)][1:]
        new = new_machine(clone)
        for state, waits, asked_s in (("warm", warm, DASHBOARD_S), ("without compiled kernels", new, NEW_S)):
            for what, words in WAITS.items():
                seen = [each[what] for each in waits]
                asked = asked_s if what == "scan" else None
                name = f"stemmap serve sim:stand, {state}, to {words}"
                rows.append(_row(name, [m.s for m in seen], [m.cpu_s for m in seen], asked))
        notes.append(
            "By /api/status: points are there when it tells of a scan, mapped or not; "
            "a browser's own start is not in it."
        )
        notes.append("Without compiled kernels: as in the first start of a clone.")
    columns = ("start", "times", "median s", "slowest s", "median CPU s", "asked for s", "by the median")
    return [Table("Waiting times", columns, tuple(rows), tuple(notes))]


def new_machine(clone: Path) -> list[dict[str, Moment]]:
    """The moments of starts, each from a copy of the sources of a clone without compiled kernels."""
    waits = []
    for _ in range(NEW_ROUNDS):
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as copy:
            for name in ("app", "pipeline", "static"):
                shutil.copytree(clone / name, Path(copy) / name, ignore=shutil.ignore_patterns("*.nb[ci]"))
            waits.append(moments({"PYTHONPATH": copy}))
    return waits


def _row(name: str, seconds: list[float], cpu_s: list[float] | None, asked: float | None) -> tuple[Cell, ...]:
    reached = "" if asked is None else verdict(middle(seconds) <= asked)
    return name, len(seconds), middle(seconds), max(seconds), middle(cpu_s) if cpu_s else None, asked, reached


def command(*words: str) -> list[str]:
    """The installed command, or the equivalent call of Python if it is not installed."""
    script = Path(sys.executable).with_name("stemmap")
    by_python = [sys.executable, "-c", "import sys; from app.cli import main; sys.exit(main())"]
    return [str(script), *words] if script.is_file() else [*by_python, *words]


def seconds_of_help() -> float:
    """Time of the process `stemmap --help` [s]."""
    start = time.perf_counter()
    subprocess.run(command("--help"), stdout=subprocess.DEVNULL, timeout=LONGEST_S, check=True)
    return time.perf_counter() - start


def moments(settings: Mapping[str, str]) -> dict[str, Moment]:
    """Return the times of the events of WAITS after `stemmap serve sim:stand`, with further environment
    variables.

    Raises:
        StemmapError: An event did not occur in time.
    """
    start = time.perf_counter()
    server = subprocess.Popen(
        command("serve", "sim:stand", "--no-browser", "--port", "0"),
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1", **settings},
    )
    seen: dict[str, Moment] = {}

    def see(what: str) -> None:
        if what not in seen:
            seen[what] = Moment(time.perf_counter() - start, computing_s(server.pid))

    try:
        if server.stdout is None:
            raise StemmapError("the dashboard has no pipe")
        link = _first_link(server.stdout, start + LONGEST_S)
        see("link")
        while time.perf_counter() < start + LONGEST_S and server.poll() is None:
            status = _status(link)
            if status.get("unmapped", 0) > 0 or status.get("scan_index", -1) >= 0:
                see("points")
            if status.get("scan_index", -1) >= 0:
                see("scan")
            if status.get("trees", 0) > 0:
                see("trees")
                return seen
            time.sleep(0.02)
        raise StemmapError(f"the dashboard showed no tree within {LONGEST_S:g} s")
    finally:
        _end(server)


def computing_s(pid: int) -> float:
    """Return the CPU time [s] of a process and of all its children, by /proc; 0 without it."""
    ticks, children = dict[int, int](), dict[int, list[int]]()
    for file in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it has ended
            fields = file.read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
            children.setdefault(int(fields[1]), []).append(int(file.parent.name))
            ticks[int(file.parent.name)] = sum(map(int, fields[11:15]))  # also of children that have ended
    total, waiting = 0, [pid]
    while waiting:
        each = waiting.pop()
        total += ticks.get(each, 0)
        waiting += children.get(each, [])
    return total / os.sysconf("SC_CLK_TCK") if ticks else 0.0


def _first_link(lines: IO[str], until: float) -> str:
    """The link that the server prints, read by a thread, so that a silent server does not block us."""
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


def _status(link: str) -> dict[str, Any]:
    """The status of the run; empty while the server does not answer."""
    parts = urlsplit(link)
    token = parse_qs(parts.query)["token"][0]
    request = urllib.request.Request(
        f"http://{parts.netloc}/api/status", headers={"Authorization": f"Bearer {token}"}
    )
    try:
        with urllib.request.urlopen(request, timeout=5.0) as reply:  # noqa: S310
            return dict(json.load(reply))
    except urllib.error.HTTPError as error:
        raise StemmapError(f"the dashboard answered {error.code}", where="/api/status") from None
    except OSError:
        return {}


def _end(server: subprocess.Popen[str]) -> None:
    server.terminate()
    try:
        server.wait(10.0)
    except subprocess.TimeoutExpired:
        server.kill()
        server.wait()
