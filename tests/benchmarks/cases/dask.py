"""Runs mapped by two Dask workers, one of which is killed, compared with two local processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

from tests.benchmarks.table import Table

NAME = "dask"
LINE = "Runs mapped by two Dask workers, one killed on the way, beside two processes"
RUNS, DURATION_S = 24, 5
KILLED_AFTER = 6  # runs
TURNS = 2


def run() -> list[Table]:
    """One row per method: time of each repetition, and whether the files equal those of the first method."""
    with TemporaryDirectory(prefix="stemmap-dask-") as name:
        folder = Path(name)
        runs = folder / "runs"
        runs.mkdir()
        for seed in range(RUNS):
            where = runs / f"run_{seed:02}.mcap"
            _stemmap("simulate", f"sim:stand?duration={DURATION_S}&seed={seed}", "--out", str(where))
        times: dict[str, list[float]] = {}
        same: dict[str, bool] = {}
        expected: dict[str, bytes] = {}
        for turn in range(TURNS):
            for way, time_of in _WAYS.items():
                out = folder / f"{way} {turn}"
                times.setdefault(way, []).append(time_of(runs, out))
                files = sorted(file for file in out.rglob("*") if file.is_file())
                found = {str(file.relative_to(out)): file.read_bytes() for file in files}
                expected = expected or found
                same[way] = same.get(way, True) and found == expected
                print(
                    f"{way}: {times[way][-1]:.1f} s, {'same' if same[way] else 'OTHER'} bytes",
                    file=sys.stderr,
                )
    local = median(times["two processes"])
    rows = tuple(
        (way, RUNS, median(each), median(each) / local, "yes" if same[way] else "no")
        for way, each in times.items()
    )
    return [Table(LINE, ("way", "runs", "median of the turns [s]", "ratio", "same bytes"), rows)]


def _stemmap(*words: str) -> None:
    """Run a command, which must succeed."""
    program = [sys.executable, "-c", "from app.cli import command; command()"]
    subprocess.run([*program, *words], check=True, stdout=subprocess.DEVNULL)


def _locally(runs: Path, out: Path) -> float:
    """Map all runs in two processes; return the time [s]."""
    begun = time.perf_counter()
    _stemmap("map", str(runs), "--out", str(out), "--jobs", "2")
    return time.perf_counter() - begun


def _by_workers(runs: Path, out: Path, killed_after: int = RUNS) -> float:
    """Map all runs by two workers; return the time [s] without their start."""
    from distributed import Client

    from tests.app.extensions.cluster.dask_cluster import dask_cluster

    with TemporaryDirectory(prefix="stemmap-dask-") as work, dask_cluster(Path(work)) as address:
        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)
            victim = next(iter(client.run(os.getpid).values()))
        ended = threading.Event()

        def kill() -> None:
            while not ended.wait(0.2):
                if len(list(out.glob("*/run.json"))) >= killed_after:
                    os.kill(victim, signal.SIGKILL)
                    return

        killer = threading.Thread(target=kill)
        killer.start()
        begun = time.perf_counter()
        _stemmap("map", str(runs), "--out", str(out), "--dask", address)
        taken = time.perf_counter() - begun
        ended.set()
        killer.join()
    return taken


def _by_killed(runs: Path, out: Path) -> float:
    """As `_by_workers`; one worker is killed when KILLED_AFTER runs are mapped."""
    return _by_workers(runs, out, KILLED_AFTER)


_WAYS = {
    "two processes": _locally,
    "two workers": _by_workers,
    "two workers, one killed": _by_killed,
}
