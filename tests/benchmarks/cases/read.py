"""How many times real time a recording is read: from MCAP to scans, odometry and IMU readings."""

from __future__ import annotations

import statistics
import tempfile
import time
from pathlib import Path

from tests.benchmarks.table import Cell, Table, verdict

NAME = "read"
LINE = "Reading a recording from MCAP to scans"

SECONDS, REPEATS, ASKED = 20, 5, 20.0


def run() -> list[Table]:
    """Write a simulated run of standard messages and read it again."""
    from pipeline.io.readers import open_source

    rows: list[tuple[Cell, ...]] = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        _write(path)
        for name, scans_alone in (("everything", False), ("opening", True)):
            times = []
            scans = points = 0
            for _ in range(REPEATS + 1):  # the first finds the file cold
                begun = time.perf_counter()
                source = open_source(str(path))
                if not scans_alone:
                    scans, points = _read(source)
                source.close()
                times.append(time.perf_counter() - begun)
            median = statistics.median(times[1:])
            rows.append((name, scans, points, 1000.0 * median, None if scans_alone else SECONDS / median))
    ratio = float(str(rows[0][4]))
    return [
        Table(
            f"{SECONDS} s of sim:stand as MCAP (PointCloud2 at 10 Hz, odometry, IMU, transforms; lz4)",
            ("what", "scans", "points", "ms", "times real time"),
            tuple(rows),
            (
                f"Median of {REPEATS} readings, opening included. Asked for: {ASKED:g} times real time: "
                f"{verdict(ratio >= ASKED)}.",
            ),
        )
    ]


def _read(source: object) -> tuple[int, int]:
    from pipeline.io.readers import Source
    from pipeline.types.records import Scan

    records: Source = source  # type: ignore[assignment]
    sizes = [len(record.points) for record in records.records() if isinstance(record, Scan)]
    return len(sizes), sum(sizes)


def _write(path: Path) -> None:
    from app.cli import main

    if main(["simulate", f"stand?duration={SECONDS}", "--out", str(path)]) != 0:
        raise RuntimeError("the run could not be written")
