"""A long drive in accelerated time: memory, time of a scan, and files of the dashboard."""

from __future__ import annotations

import os
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from pipeline.errors import StemmapError
from tests.benchmarks.machine import anonymous_mib, resident_mib
from tests.benchmarks.process import Side
from tests.benchmarks.served.looped_worker import VARIABLE
from tests.benchmarks.table import Cell, Table, verdict

NAME = "soak"
LINE = "A robot that drives the same lap for hours, in accelerated time, with one browser"

SCANS = int(os.environ.get(VARIABLE, "72000"))
READINGS = 20
SCANS_PER_HOUR = 36_000  # at 10 Hz
WARM_SHARE = 0.4  # of the run; caches of fixed size are filled until then
MOST_MIB_PER_HOUR, MOST_SLOWER = 1.0, 0.10
LONGEST_SILENCE_S = 300.0


@dataclass(frozen=True, slots=True)
class Reading:
    """State of the processes after a number of scans. Memory is the least of the part before it, as each
    state that is stored takes 10 MB for a moment; `own` is without the pages of files."""

    scans: int
    web_mib: float
    worker_mib: float
    web_own_mib: float
    worker_own_mib: float
    web_cpu_s: float
    worker_cpu_s: float
    files_mib: float
    trees: int


def run() -> list[Table]:
    """Play the drive as fast as possible, and read memory and time during it."""
    os.environ[VARIABLE] = str(SCANS)  # for the worker
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        served = "tests.benchmarks.served"
        server = Side(f"{served}.server", "sim:stand", folder, f"{served}.looped_worker")
        stack.callback(server.end)
        link = server.ask({"do": "link"})
        browser = Side(f"{served}.browsers", str(link["port"]), link["token"])
        stack.callback(browser.end)
        browser.ask({"do": "browsers", "count": 1})
        browser.ask({"do": "command", "command": {"type": "set_speed", "factor": 0.0}})
        readings = follow(server, browser)
    return [_table(readings)]


def follow(server: Side, browser: Side) -> list[Reading]:
    """Return a reading after each part of the drive.

    Raises:
        StemmapError: No scan was mapped for LONGEST_SILENCE_S, or the drive ended before SCANS.
    """
    readings: list[Reading] = []
    samples: list[tuple[float, ...]] = []  # of the memory in this part
    pids, heard_at, last = server.ask({"do": "pids"}), time.monotonic(), -1
    while len(readings) <= READINGS:
        time.sleep(1.0)
        status = browser.ask({"do": "status"})
        server.ask({"do": "heard"})  # or their lists would grow
        browser.ask({"do": "heard"})
        samples.append(
            tuple(read(pids[name]) for read in (resident_mib, anonymous_mib) for name in ("web", "worker"))
        )
        now = status["scan_index"] + 1
        if now != last:
            heard_at, last = time.monotonic(), now
        elif status["state"] == "finished" and now < 0.99 * SCANS:
            raise StemmapError(f"the drive ended before {SCANS:,} scans", where=f"scan {now:,}")
        elif status["state"] == "failed" or time.monotonic() > heard_at + LONGEST_SILENCE_S:
            raise StemmapError(
                "no scan was mapped", where=f"scan {now}: {status['state']} {status['detail']}"
            )
        if now >= max(1, len(readings) * SCANS // READINGS) or status["state"] == "finished":
            cpu = server.ask({"do": "cpu"})
            web, worker, web_own, worker_own = map(min, zip(*samples, strict=True))
            readings.append(
                Reading(
                    now,
                    web,
                    worker,
                    web_own,
                    worker_own,
                    cpu["web"],
                    cpu["worker"],
                    _unnamed_files_mib(pids["worker"]),
                    status["trees"],
                )
            )
            samples.clear()
            print(readings[-1], flush=True)
    return readings


def _unnamed_files_mib(pid: int) -> float:
    """Size of the open files of a process that have no name [MiB]."""
    total = 0
    for link in Path(f"/proc/{pid}/fd").iterdir():
        try:
            if str(link.readlink()).endswith(" (deleted)"):
                total += link.stat().st_size
        except OSError:
            continue
    return total / 2**20


def _table(readings: list[Reading]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    costs: list[float] = []
    for before, now in pairwise(readings):
        scans = max(now.scans - before.scans, 1)
        costs.append(1e3 * (now.worker_cpu_s - before.worker_cpu_s) / scans)
        web_ms = 1e3 * (now.web_cpu_s - before.web_cpu_s) / scans
        memory = (now.worker_mib, now.web_mib, now.worker_own_mib, now.web_own_mib)
        rows.append(
            (now.scans, now.scans / SCANS_PER_HOUR, *memory, costs[-1], web_ms, now.files_mib, now.trees)
        )
    warm = [reading for reading in readings if reading.scans >= WARM_SHARE * SCANS]
    hours = [reading.scans / SCANS_PER_HOUR for reading in warm]
    slopes = {
        name: float(np.polyfit(hours, [getattr(reading, f"{name}_mib") for reading in warm], 1)[0])
        for name in ("worker", "web", "worker_own", "web_own")
    }
    tenth = max(1, len(costs) // 5)
    start, end = np.mean(costs[1 : 1 + tenth]), np.mean(costs[-tenth:])
    return Table(
        f"{SCANS:,} scans of a lap of sim:stand with poor odometry, replayed as fast as possible",
        (
            *("scans", "hours", "worker MiB", "web MiB", "worker without files MiB", "web without files MiB"),
            *("worker ms", "web ms", "files MiB", "trees"),
        ),
        tuple(rows),
        (
            f"Slope from {100 * WARM_SHARE:.0f} % of the run on, without the pages of files, which the "
            f"system takes back where it needs them: worker {slopes['worker_own']:.2f}, web "
            f"{slopes['web_own']:.2f} MiB an hour. Required: at most {MOST_MIB_PER_HOUR:g}: "
            + ", ".join(
                f"{name} {verdict(slopes[f'{name}_own'] <= MOST_MIB_PER_HOUR)}" for name in ("worker", "web")
            )
            + f". With them: worker {slopes['worker']:.2f}, web {slopes['web']:.2f}.",
            f"CPU time of the worker for a scan: {start:.2f} ms at the start, {end:.2f} ms at the end. "
            f"Required: within {100 * MOST_SLOWER:.0f} %: {verdict(end <= (1 + MOST_SLOWER) * start)}.",
            "The lap is simulated once; its scans return, its wheels drift on, and the robot stands for 20 s "
            "after every fifth lap. Times are CPU times for a scan, with storage of steps and frames and "
            "pictures for the browser. Files: temporary files of the worker. Memory: the least of each part.",
            f"Load of the machine at the end: {os.getloadavg()[0]:.1f}.",
        ),
    )
